"""Optics of one microlens: the formulas of the paper, exact rays, wavefronts and point spread functions."""
