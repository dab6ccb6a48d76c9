"""Where the lenses go, and how they cover the plate."""
