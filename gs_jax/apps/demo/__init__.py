"""The demonstration: a microscope is judged, improved and used, and its mold is made."""
