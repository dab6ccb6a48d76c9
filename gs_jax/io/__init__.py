"""Files: captures, points, volumes, and writing them whole or not at all."""
