"""The lenses on their plate, and the shape of their surface. Lengths are in millimetres."""

import math

import equinox as eqx
from jaxtyping import Array, Float

from .base.converters import as_float, as_float_or_none, as_pair


class MicrolensArray(eqx.Module):
    """Plano-convex microlenses on one plate, the plano side toward the object.

    Parameters
    ----------
    centers
        Lens vertices `(lens, 2)` in the array's own frame, mm.
    radius_of_curvature, refractive_index, aperture_diameter, substrate_thickness
        Of every lens and of the plate that carries them, mm. The aperture is the one before neighbours
        clip it to its Voronoi cell.
    thin_lens_focal_length
        Overrides the focal length that follows from the radius, mm, for a thin-lens study.
    size
        `(x, y)` of the plate, centred, mm: where the outer lenses end. By default they are as wide as their discs.

    Raises
    ------
    ValueError
        If `centers` is not `(lens, 2)` or holds no lens.
    """

    centers: Float[Array, "lens 2"] = eqx.field(converter=as_float)
    radius_of_curvature: Float[Array, ""] = eqx.field(converter=as_float, default=2.0)
    refractive_index: Float[Array, ""] = eqx.field(converter=as_float, default=1.43)
    aperture_diameter: Float[Array, ""] = eqx.field(converter=as_float, default=2.0)
    substrate_thickness: Float[Array, ""] = eqx.field(converter=as_float, default=1.0)
    thin_lens_focal_length: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    size: tuple[float, float] = eqx.field(static=True, converter=as_pair, default=(math.inf, math.inf))

    def __check_init__(self):
        if self.centers.ndim != 2 or self.centers.shape[1] != 2 or self.centers.shape[0] < 1:
            raise ValueError(f"`centers` must be (lens, 2) with a lens at least, got {self.centers.shape}.")

    @property
    def focal_length(self) -> Float[Array, ""]:
        """Focal length in air, `R / (n - 1)` for a plano-convex lens, mm."""
        if self.thin_lens_focal_length is None:
            return self.radius_of_curvature / (self.refractive_index - 1)
        return self.thin_lens_focal_length
