"""How the networks of the package are trained, and what on: simulated captures with all of their light."""
