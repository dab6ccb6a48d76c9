"""The geometry of a real microscope from captures of point sources."""
