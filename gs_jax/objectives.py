"""What a microscope is judged by, as functions of an imager and depths; all *differentiable*.

Depths `(depth,)` are counted from the array's front, lengths are mm. `gs_jax.optimize` takes any function that is made
of these. The terms of a study (`gs_jax.codesign.objectives`) are the same in its units. Lenses must be alike, but where
it is said.

Examples
--------
>>> import gs_jax as gs
>>> scope = gs.geomscope().imager()
>>> print(gs.objectives.occupancy(scope, [20.0]).round(2))  # N_e M^2, Eq. 11
[1.11]
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .base.arrays import as_float
from .codesign import objectives as terms
from .design.microscope import Microscope
from .design.spots import encircled_radius as _encircled_radius, psf_width
from .geometry import Imager

Depths = Float[ArrayLike, " depth"] | Sequence[float]


def spot_width(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Width of a spot in the object (FWHM of its variance), by exact rays over the field, diffraction and pixel."""
    return psf_width(_of_alike(imager, depths))


def encircled_radius(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Radius in the object that holds 80 % of a spot's rays."""
    return _encircled_radius(_of_alike(imager, depths))


def strehl(imager: Imager, depths: Depths) -> Float[Array, "depth field"]:
    """Strehl ratio (Eqs. 9, 10) at four heights of the field, 0 to 1, with the sensor where it is."""
    return jnp.exp(terms.log_strehl(_of_alike(imager, depths)))


def lateral_resolution(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """In focus, without aberrations (Eq. 5)."""
    return _of_alike(imager, depths).lateral_resolution


def axial_resolution(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """In focus, without aberrations (Eq. 6)."""
    return _of_alike(imager, depths).axial_resolution


def depth_of_field(
    imager: Imager, depths: Depths, *, circle_of_confusion: ArrayLike | None = None
) -> Float[Array, " depth"]:
    """Of a sensor that is focused on each depth (Eq. 8); `circle_of_confusion` is a diameter, by default two pixels."""
    return _of_alike(imager, depths, circle_of_confusion).depth_of_field


def blur(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Diameter of a thin lens's patch in the object, with the sensor where it is."""
    return _of_alike(imager, depths).object_blur


def lenses_per_point(imager: Imager) -> Float[Array, ""]:
    """`N_e`, lenses on the plate over its area times `A_e`; lenses may differ."""
    return _judged(imager, jnp.ones(1)).lenses_per_point


def occupancy(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """`V = N_e M^2` (Eq. 11); lenses may differ."""
    return _judged(imager, depths).occupancy


def coverage(imager: Imager) -> Float[Array, ""]:
    """Share of the plate that is clear aperture."""
    return _of_alike(imager, jnp.ones(1)).coverage


def light(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Share of a point's light that its `N_e` lenses take, 0 to 1."""
    return terms.light(_of_alike(imager, depths)) / 100


def spacing(imager: Imager) -> Float[Array, " lens"]:
    """Distance of each lens from its nearest neighbour; lenses may differ."""
    return terms.spacing(_judged(imager, jnp.ones(1)))


def _of_alike(imager, depths, circle_of_confusion=None) -> Microscope:
    imager.array.check_alike()
    return _judged(imager, depths, circle_of_confusion)


def _judged(imager, depths, circle_of_confusion=None) -> Microscope:
    kind = imager.sensor_distance.dtype
    circle_of_confusion = 2 * imager.sensor.pixel_pitch if circle_of_confusion is None else circle_of_confusion
    return Microscope(
        imager, jnp.asarray(depths, kind), jnp.asarray(imager.field_radius, kind), as_float(circle_of_confusion)
    )
