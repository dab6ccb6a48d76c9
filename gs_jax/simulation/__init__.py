"""Scenes, their images, and what a camera makes of them."""
