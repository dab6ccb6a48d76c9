"""What takes the background out of a back-projection: points that lenses agree on, and networks."""
