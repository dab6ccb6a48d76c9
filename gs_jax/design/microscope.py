"""What the paper's formulas promise of a microscope, Eqs. 1-11, differentiable in everything.

A datasheet and the terms of a co-design are both made of this.
"""

import dataclasses
import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.arrays import POSITIVE, as_float, check_fields
from ..geometry import Imager
from ..lenses import MicrolensArray
from ..optics import aberrations, theory
from ..optics.aberrations import WavefrontCoefficients
from ..optics.apertures import VoronoiCells, clear_diameter, clear_diameters
from ..optics.lens_types import split_by_type


class Microscope(eqx.Module):
    """An imager and where it is judged. Results are lengths in mm, one for each depth.

    Parameters
    ----------
    imager
        On a plate of finite size.
    depths
        From the plate, mm.
    field_radius
        `sqrt(A_e / pi)`, mm: the imager's, which decides shapes and cannot be traced.
    circle_of_confusion
        Diameter of the circle of confusion, mm.
    plate_scale
        The plate's size over that of the imager's array, which cannot be traced.
    largest_magnification
        What magnifications stay below whatever is free, for windows that have to hold all images.
    exposure
        Electrons that a mm^2 of clear aperture, 20 mm away, gets of a lit place of 40 um x 40 um.
    cells, directions
        How clear apertures are found, as of `gs_jax.optics.apertures`: of lenses that are alike, and of others.
    lenses
        Which are of each type, where they differ; none if all are alike. What follows from a lens's shape is of the
        `kinds` then, the rest also of the whole, whose clear diameter is the mean lens's.
    found_diameter
        Of one of `kinds`, which are made anew whenever they are asked for: those of all are found at once.

    Raises
    ------
    ValueError
        If the plate is infinite, which has no density of lenses, or a depth is not positive and finite.
    """

    imager: Imager
    depths: Float[Array, " depth"]
    field_radius: Float[Array, ""]
    circle_of_confusion: Float[Array, ""]
    plate_scale: Float[Array, ""] = eqx.field(converter=as_float, default=1.0)
    largest_magnification: float = eqx.field(static=True, default=math.inf)
    exposure: float = eqx.field(static=True, default=1e4)
    cells: VoronoiCells | None = None
    directions: int = eqx.field(static=True, default=512)
    lenses: tuple[tuple[int, ...], ...] = eqx.field(static=True, default=())
    found_diameter: Float[Array, ""] | None = None

    def __check_init__(self):
        if not math.isfinite(math.prod(self.imager.array.size)):
            raise ValueError(f"`imager.array.size` must be finite, got {self.imager.array.size}.")
        check_fields(self, depths=POSITIVE)

    @property
    def plate(self) -> Float[Array, "2"]:
        """`(x, y)` of the plate."""
        return self.plate_scale * jnp.array(self.imager.array.size, self.plate_scale.dtype)

    @property
    def types(self) -> tuple["Microscope", ...]:
        """The lenses of each type alone, where they differ."""
        if not self.lenses:
            return ()
        pairs = zip(split_by_type(self.imager, self.lenses), self._clear_diameters, strict=True)
        return tuple(dataclasses.replace(self, imager=one, lenses=(), found_diameter=own) for one, own in pairs)

    @property
    def each(self) -> tuple["Microscope", ...]:
        """Of each type of lens; of lenses that are alike this itself."""
        return self.types or (self,)

    @property
    def middle(self) -> "Microscope":
        """The same at the middle of the depths alone."""
        return dataclasses.replace(self, depths=(self.depths[:1] + self.depths[-1:]) / 2)

    @property
    def clear_diameter(self) -> Float[Array, ""]:
        """Of the disc whose area is the mean clear aperture of the lenses."""
        if self.found_diameter is not None:
            return self.found_diameter
        each = self._clear_diameters
        if not self.lenses:
            return each[0]
        shares = np.array([len(which) for which in self.lenses]) / len(self.imager.array.centers)
        return jnp.sqrt(jnp.sum(jnp.asarray(shares, each.dtype) * each**2))

    @property
    def _clear_diameters(self):
        return _clear_diameters(self.imager.array, self.plate_scale, self.cells, self.directions, self.lenses)

    @property
    def focal_length(self) -> Float[Array, ""]:
        """Of a lens in air."""
        return self.imager.array.focal_length

    @property
    def f_number(self) -> Float[Array, ""]:
        """Of the clear aperture (below Eq. 8)."""
        return theory.f_number(self.focal_length, self.clear_diameter)

    @property
    def numerical_aperture(self) -> Float[Array, ""]:
        """Of the clear aperture, on the sensor's side."""
        return theory.numerical_aperture(self.focal_length, self.clear_diameter)

    @property
    def reduced(self) -> Float[Array, " depth"]:
        """The depths as the optics sees them, `z'`."""
        return self.imager.reduced_depth(self.depths)

    @property
    def magnification(self) -> Float[Array, " depth"]:
        """`M_z` (Eq. 3)."""
        return self.imager.magnification(self.depths)

    @property
    def scale(self) -> Float[Array, " depth"]:
        """`s_z` (Eq. 1)."""
        return self.imager.scale(self.depths)

    @property
    def lateral_resolution(self) -> Float[Array, " depth"]:
        """In focus, without aberrations (Eq. 5)."""
        pixel = self.imager.sensor.pixel_pitch
        return theory.lateral_resolution(self.imager.wavelength, self.numerical_aperture, pixel, self.magnification)

    @property
    def axial_resolution(self) -> Float[Array, " depth"]:
        """In focus, without aberrations (Eq. 6)."""
        return theory.axial_resolution(self.lateral_resolution, self.reduced, self.field_radius)

    @property
    def _sharp(self):
        return self.focal_length, self.f_number, self.reduced, self.circle_of_confusion

    @property
    def depth_of_field(self) -> Float[Array, " depth"]:
        """Of a sensor that is focused on the depth (Eq. 8); infinite from the hyperfocal distance on."""
        return theory.depth_of_field(*self._sharp)

    @property
    def approximate_depth_of_field(self) -> Float[Array, " depth"]:
        """The same by Eq. 7."""
        return theory.approximate_depth_of_field(*self._sharp)

    @property
    def near_limit(self) -> Float[Array, " depth"]:
        """The nearest depth `z` that is sharp then."""
        return theory.near_limit(*self._sharp) - self.imager.reduced_depth(0.0)

    @property
    def far_limit(self) -> Float[Array, " depth"]:
        """The farthest depth `z` that is sharp then."""
        return theory.far_limit(*self._sharp) - self.imager.reduced_depth(0.0)

    @property
    def lenses_per_point(self) -> Float[Array, ""]:
        """`N_e`: lenses on the plate over its area, times `A_e`."""
        count = float(self.imager.array.centers.shape[0])
        return theory.lenses_per_point(count, jnp.prod(self.plate), self.field_radius)

    @property
    def occupancy(self) -> Float[Array, " depth"]:
        """`V = N_e M^2` (Eq. 11)."""
        return theory.occupancy(self.lenses_per_point, self.magnification)

    @property
    def coverage(self) -> Float[Array, ""]:
        """Share of the plate that is clear aperture."""
        count = self.imager.array.centers.shape[0]
        return count * math.pi / 4 * self.clear_diameter**2 / jnp.prod(self.plate)

    def wavefront(self, heights: Float[Array, " field"]) -> WavefrontCoefficients:
        """Third-order errors at heights beside a lens's axis, sensor where it is: `(depth, field)`, or broadcast."""
        array, v = self.imager.array, self.imager.reduced_sensor_distance
        return aberrations.seidel_of_array(array, self.clear_diameter / 2, self.reduced[:, None], heights[None], v)

    @property
    def focus_distance(self) -> Float[Array, " depth"]:
        """The sensor's distance `v` at which a thin lens images the depth; infinite if it does not."""
        return theory.focus_distance(self.focal_length, self.reduced) - self.imager.array.air_behind

    @property
    def blur(self) -> Float[Array, " depth"]:
        """Diameter of the thin lens's patch on the sensor where it is."""
        return theory.blur(self.focal_length, self.clear_diameter, self.reduced, self.imager.reduced_sensor_distance)

    @property
    def object_blur(self) -> Float[Array, " depth"]:
        """The same as seen in the object."""
        v = self.imager.reduced_sensor_distance
        return theory.object_blur(self.focal_length, self.clear_diameter, self.reduced, v)


@partial(jax.jit, static_argnames=("directions", "lenses"))
def _clear_diameters(array: MicrolensArray, plate_scale, cells: VoronoiCells | None, directions: int, lenses):
    """Of each type, or of all lenses."""
    # As large as the plate's size says.
    array = _shrunk(array, plate_scale)
    if lenses:
        return plate_scale * clear_diameters(array, lenses, directions=directions)
    return plate_scale * clear_diameter(array, cells=cells)[None]


def _shrunk(array: MicrolensArray, scale) -> MicrolensArray:
    """The lenses over a scale, on the same plate."""
    terms = array.aspheric_terms
    return dataclasses.replace(
        array,
        centers=array.centers / scale,
        radius_of_curvature=array.radius_of_curvature / scale,
        aperture_diameter=array.aperture_diameter / scale,
        aspheric_terms=terms * scale ** jnp.arange(3, 2 * terms.size + 3, 2, dtype=scale.dtype),
        others=None if array.others is None else _shrunk(array.others, scale),
    )
