"""How well a microscope must be made: what tolerances do to its spots and depths, and how many devices are good."""
