"""Chief rays between voxels and pixels: back-projection, its adjoint, and the forward model, Eq. (2)."""
