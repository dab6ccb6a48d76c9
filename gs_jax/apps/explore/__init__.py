"""A page on this machine whose sliders move a design, and show at once what becomes of it."""
