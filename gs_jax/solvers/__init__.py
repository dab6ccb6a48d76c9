"""Iterative solvers for any linear operator."""
