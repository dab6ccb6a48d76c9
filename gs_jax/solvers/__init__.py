"""Iterative reconstruction, for any linear operator."""
