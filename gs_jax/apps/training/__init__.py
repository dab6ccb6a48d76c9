"""Training of the networks that come with the package, and of a user's own."""
