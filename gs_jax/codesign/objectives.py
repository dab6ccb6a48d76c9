"""What a design is wanted to do: named terms, each a pure function of a `Microscope`.

A term has a name with its unit, and gives a number or an array of them (over depths, lenses, places) in that unit. If
lenses differ it is of the whole plate, of each type (`of_each`), or of the best type (`of_best`).
Lengths are mm everywhere else in the package; here they are what a study file says. All are differentiable in
everything that may be free, and finite where lenses coincide or rays do not get through.
Bare equation numbers mean the GEOMScope paper.
"""

import difflib
from collections.abc import Callable, Iterable
from functools import partial
from importlib.metadata import entry_points
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..base.arrays import safe_sqrt
from ..base.errors import short_repr
from ..design.microscope import Microscope
from ..design.spots import encircled_radius, field_heights, psf_width
from ..optics import aberrations, theory
from ..typing import Result
from .exposure_terms import crowded, volume_error
from .layout_terms import (
    conditioning,
    flatness,
    ghosts,
    localization,
    log_error,
    log_error_for_exposure,
    shortage,
)

Built = TypeVar("Built")

UM = 1000.0
# Of the entry points that are terms.
_GROUP = "gs_jax.terms"
# Places along a side of the plate where a hole is looked for, and along a lens's radius.
_PLACES = 41
# A curvature that is none, 1/mm.
_FLAT = 1e-6


class Term(NamedTuple):
    """A term: what it says in words, and its function.

    With `log` the function gives the value's logarithm; with `random` it takes a key after the candidate; with `types`
    it also takes microscopes whose lenses differ.
    """

    meaning: str
    function: Callable[..., Result]
    log: bool = False
    random: bool = False
    types: bool = False


def of_each(function: Callable[[Microscope], Result]) -> Callable[[Microscope], Result]:
    """A function of lenses that are alike, of each type: all of its entries count."""
    return lambda c: jnp.stack([function(one) for one in c.types]) if c.types else function(c)


def of_best(
    function: Callable[[Microscope], Result], best: Callable[..., Result] = jnp.argmin
) -> Callable[[Microscope], Result]:
    """A function of lenses that are alike, of the type that is best at each depth: the one in focus there."""

    def at_best(c: Microscope) -> Result:
        if not c.types:
            return function(c)
        found = jnp.stack([function(one) for one in c.types])
        return jnp.take_along_axis(found, best(found, axis=0, keepdims=True), 0)[0]

    return at_best


def focus_offset(c: Microscope) -> Float[Array, ""]:
    """How far the depth in focus (thin lens) is from the middle of the depths: 1 at the nearest and the farthest.

    In vergence, where focus at infinity and beyond is nothing special.
    """
    f, near, far = c.imager.array.focal_length, c.reduced[0], c.reduced[-1]
    in_focus = 1 / f - 1 / c.imager.reduced_sensor_distance
    return jnp.abs(2 * in_focus - 1 / near - 1 / far) / (1 / near - 1 / far)


def log_strehl(c: Microscope) -> Float[Array, "depth field"]:
    """Logarithm of Eq. 9 with Eq. 10, sensor where it is, at four heights of the field."""
    return aberrations.log_strehl(aberrations.linear_rms(c.wavefront(field_heights(c))), c.imager.wavelength)


def wavefront(c: Microscope) -> Float[Array, "depth field"]:
    """RMS of the third-order wavefront with astigmatism and field curvature, in waves, at four heights."""
    return aberrations.independent_rms(c.wavefront(field_heights(c))) / c.imager.wavelength


def light(c: Microscope) -> Float[Array, " depth"]:
    """Share of a point's light that its `N_e` lenses take, `N_e pi a^2 / (4 pi z'^2)` for a clear radius `a`."""
    return 100 * c.lenses_per_point * (c.clear_diameter / 4 / c.reduced) ** 2


def field_of_view(c: Microscope) -> Float[Array, "depth axis"]:
    """Width of the object that is seen at all, along x and y."""
    sensor = c.imager.sensor
    widths = jnp.array(sensor.shape[::-1], c.plate.dtype) * sensor.pixel_pitch
    return theory.field_of_view(c.plate[None], widths[None], c.magnification[:, None], c.field_radius)


def thickness(c: Microscope) -> Float[Array, ""]:
    """From the plate's front to the sensor, `t + v`."""
    return c.imager.sensor_distance + c.imager.array.substrate_thickness


def spacing(c: Microscope) -> Float[Array, " lens"]:
    """Distance of each lens from its nearest neighbour; infinite for a single lens."""
    centers = c.imager.array.centers
    squared = jnp.sum((centers[:, None] - centers[None]) ** 2, -1)
    nearest = jnp.min(jnp.where(jnp.eye(len(centers), dtype=bool), jnp.inf, squared), 1)
    return safe_sqrt(nearest)


def web(c: Microscope) -> Float[Array, " lens"]:
    """What is left between a lens's aperture and the nearest, `nearest neighbour - D`; negative where they overlap.

    The least feature of a mask that stops the light between the lenses.
    """
    centers = c.imager.array.centers
    radius = jnp.broadcast_to(c.imager.array.aperture_diameter, len(centers)) / 2
    apart = safe_sqrt(jnp.sum((centers[:, None] - centers[None]) ** 2, -1))
    return jnp.min(jnp.where(jnp.eye(len(centers), dtype=bool), jnp.inf, apart - radius[:, None] - radius[None]), 1)


def hole(c: Microscope) -> Float[Array, " place"]:
    """Distance of places of the plate, 41 x 41 from edge to edge, from the nearest lens."""
    side = jnp.linspace(-0.5, 0.5, _PLACES, dtype=c.plate.dtype)
    places = jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2) * c.plate[None]
    squared = jnp.sum((places[:, None] - c.imager.array.centers[None]) ** 2, -1)
    return safe_sqrt(jnp.min(squared, 1))


def sag(c: Microscope) -> Float[Array, ""]:
    """Height of a whole lens, of a sphere `R - sqrt(R^2 - D^2/4)`: the deepest that the mold can be."""
    array = c.imager.array
    return array.sag(_within(c, (array.aperture_diameter / 2) ** 2))


def edge_slope(c: Microscope) -> Float[Array, ""]:
    """Slope of the surface at the rim of the clear disc, of a sphere `asin(a / R)`, degrees; at most 90."""
    square = _within(c, (c.clear_diameter / 2) ** 2)
    return jnp.rad2deg(jnp.arctan(safe_sqrt(square) * c.imager.array.sag_slope_over_r(square)))


def least_radius(c: Microscope) -> Float[Array, " place"]:
    """Least radius of curvature of the surface at places from the vertex to the rim: of a tool that would cut it."""
    radii = jnp.linspace(0, 1, _PLACES, dtype=c.clear_diameter.dtype) * c.clear_diameter / 2
    array, square = c.imager.array, _within(c, radii**2)
    ratio, change = jax.jvp(array.sag_slope_over_r, (square,), (jnp.ones_like(square),))
    length2 = 1 + square * ratio**2
    # Along the radius s'' / (1 + s'^2)^(3/2), across it s' / r / (1 + s'^2)^(1/2).
    along, across = (ratio + 2 * square * change) / length2**1.5, ratio / length2**0.5
    return 1 / jnp.maximum(jnp.maximum(along, across), _FLAT)


def _within(c: Microscope, squared_radius: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Squared radii, or that of the end of the surface if they are beyond it."""
    array = c.imager.array
    ends = 1 + array.conic_constant > 0
    end = (1 - 1e-6) ** 2 * array.radius_of_curvature**2 / jnp.where(ends, 1 + array.conic_constant, 1)
    return jnp.where(ends, jnp.minimum(squared_radius, end), squared_radius)


TERMS: dict[str, Term] = {
    "lateral_resolution_um": Term(
        "lateral resolution in focus (Eq. 5)", of_each(lambda c: UM * c.lateral_resolution), types=True
    ),
    "axial_resolution_um": Term(
        "axial resolution in focus (Eq. 6)", of_each(lambda c: UM * c.axial_resolution), types=True
    ),
    "depth_of_field_mm": Term("depth of field (Eq. 8)", of_each(lambda c: c.middle.depth_of_field[0]), types=True),
    "depth_of_field_eq7_mm": Term(
        "depth of field (Eq. 7)", of_each(lambda c: c.middle.approximate_depth_of_field[0]), types=True
    ),
    "focus_offset": Term("focus from the middle of the depths, 1 at their ends", of_each(focus_offset), types=True),
    "blur_um": Term(
        "diameter of the thin lens's blur, in the object", of_best(lambda c: UM * c.object_blur), types=True
    ),
    "strehl": Term("Strehl ratio over the field (Eqs. 9, 10)", of_best(log_strehl, jnp.argmax), log=True, types=True),
    "wavefront_waves": Term("RMS wavefront error over the field", of_best(wavefront), types=True),
    "lenses_per_point": Term("lenses that see a point, N_e", lambda c: c.lenses_per_point, types=True),
    "occupancy": Term("occupancy V (Eq. 11)", lambda c: c.occupancy, types=True),
    "light_percent": Term("share of a point's light that is used", light, types=True),
    "field_of_view_mm": Term("width of the field of view", field_of_view, types=True),
    "thickness_mm": Term("thickness, plate and sensor distance", thickness, types=True),
    "psf_width_um": Term(
        "width of the spot (FWHM of its variance), in the object", of_best(lambda c: UM * psf_width(c)), types=True
    ),
    "encircled_radius_um": Term(
        "radius of 80 % of the rays, in the object", of_best(lambda c: UM * encircled_radius(c)), types=True
    ),
    "depth_span_mm": Term("span of the depths", lambda c: c.depths[-1] - c.depths[0], types=True),
    "spacing_mm": Term("distance of nearest lenses", spacing, types=True),
    "web_mm": Term("mask left between neighbouring apertures", web, types=True),
    "hole_mm": Term("distance of a place on the plate from a lens", hole, types=True),
    "coverage": Term("share of the plate that is clear aperture", lambda c: c.coverage, types=True),
    "sag_mm": Term("height of a whole lens", of_each(sag), types=True),
    "ghosts": Term("RMS ghost of a point over its image", ghosts, random=True, types=True),
    "lens_shortage": Term("mean over the plate of one over the lenses that see a point", shortage, types=True),
    "spectral_flatness": Term("flatness of a point's comb's spectrum, 1 if white", flatness, random=True, types=True),
    "condition_number": Term("largest over smallest power of that spectrum", conditioning, random=True, types=True),
    "localization_um": Term("least error of locating a point, x, y, z", localization, random=True),
    "reconstruction_error": Term("relative error of reconstructed scenes", log_error, log=True, random=True),
    "scene_error": Term(
        "relative error of reconstructed scenes, for an exposure", log_error_for_exposure, log=True, random=True
    ),
    "volume_error": Term("relative error of volumes, best linear estimate, for an exposure", volume_error, types=True),
    "crowded_precision_um": Term(
        "least error of locating a point in a scene, x, y, z, for an exposure", crowded, types=True
    ),
    "edge_slope_deg": Term("slope at the clear aperture's rim", of_each(edge_slope), types=True),
    "least_radius_mm": Term("least radius of curvature of a lens's surface", of_each(least_radius), types=True),
}

# As they are in every process, whatever a caller puts into the table.
_OURS = dict(TERMS)

_UNITS = {"um": "um", "mm": "mm", "deg": "degrees", "percent": "%", "waves": "waves"}


def check_term(name: str) -> None:
    """Whether there is a term of this name; those of other installed packages are looked up when they are asked for.

    A package has its own as entry points of the group `gs_jax.terms`, whose names are the terms' and whose objects are
    `Term`s. Python callers may also put theirs into `TERMS`; workers of a search get them.

    Raises
    ------
    ValueError
        If there is none.
    """
    if name not in TERMS:
        TERMS.update({point.name: point.load() for point in entry_points(group=_GROUP, name=name)})
    if name not in TERMS:
        near = difflib.get_close_matches(name, TERMS, n=3) or list(TERMS)[:3]
        others = len(TERMS) - len(near)
        raise ValueError(f"found the name {short_repr(name)}, allowed: {', '.join(near)} or {others} others")


def with_terms(build: Callable[[], Built], names: Iterable[str]) -> Callable[[], Built]:
    """`build` for another process, whose `TERMS` then are of these names what they are here: its own go with it."""
    terms = {name: None if TERMS[name] is _OURS.get(name) else TERMS[name] for name in names}
    return partial(_built_with, build, terms)


def _built_with(build, terms):
    TERMS.update({name: term or _OURS[name] for name, term in terms.items()})
    return build()


def unit_of(name: str) -> str:
    """The unit that a term's name ends in, as people write it; empty for a number without one."""
    return _UNITS.get(name.rpartition("_")[2], "")
