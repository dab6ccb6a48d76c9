"""Pictures of volumes: projections to scale, slices to look through, and both as text of a page."""
