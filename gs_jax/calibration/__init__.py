"""Calibration: estimates the geometry of a real microscope from captures of point sources."""
