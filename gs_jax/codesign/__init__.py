"""Co-design: what is free, what is wanted, and the search for a better microscope."""
