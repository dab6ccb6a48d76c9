"""Reconstruction of volumes from captures, by any method."""
