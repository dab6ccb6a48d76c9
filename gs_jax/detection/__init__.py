"""Finds points in captures and volumes, and suppresses the background of back-projections."""
