"""What a design is wanted to do: named terms, each a pure function of a `Microscope`.

A term has a name with its unit, and gives a number or an array of them (over depths, lenses, places) in that unit.
Lengths are mm everywhere else in the package; here they are what a study file says. All are differentiable in
everything that may be free, and finite where lenses coincide or rays do not get through.
Bare equation numbers mean the GEOMScope paper.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.safe import safe_sqrt
from ..designs.microscope import Microscope
from ..geometry import envelope
from ..optics import aberrations, theory
from ..optics.unit import pupil_disc, unit_rays
from .layout_terms import conditioning, flatness, ghosts, localization, log_error, shortage

Result = Float[Array, "..."]

UM = 1000.0
# Heights at which a lens is judged over its field, at the middles of rings of equal area.
_FIELDS = 4
_ENCIRCLED = 0.8
# Places along a side of the plate where a hole is looked for.
_PLACES = 41


class Term(NamedTuple):
    """A term: what it says in words, and its function.

    With `log` the function gives the value's logarithm; with `random` it takes a key after the candidate.
    """

    meaning: str
    function: Callable[..., Result]
    log: bool = False
    random: bool = False


def focus_offset(c: Microscope) -> Float[Array, ""]:
    """How far the depth in focus (thin lens) is from the middle of the depths: 1 at the nearest and the farthest.

    In vergence, where focus at infinity and beyond is nothing special.
    """
    f, near, far = c.imager.array.focal_length, c.reduced[0], c.reduced[-1]
    in_focus = 1 / f - 1 / c.imager.sensor_distance
    return jnp.abs(2 * in_focus - 1 / near - 1 / far) / (1 / near - 1 / far)


def log_strehl(c: Microscope) -> Float[Array, "depth field"]:
    """Logarithm of Eq. 9 with Eq. 10, sensor where it is, at four heights of the field."""
    return aberrations.log_strehl(aberrations.linear_rms(c.wavefront(_heights(c))), c.imager.wavelength)


def wavefront(c: Microscope) -> Float[Array, "depth field"]:
    """RMS of the third-order wavefront with astigmatism and field curvature, in waves, at four heights."""
    return aberrations.independent_rms(c.wavefront(_heights(c))) / c.imager.wavelength


def light(c: Microscope) -> Float[Array, " depth"]:
    """Share of a point's light that its `N_e` lenses take, `N_e pi a^2 / (4 pi z'^2)` for a clear radius `a`."""
    return 100 * c.lenses_per_point * (c.clear_diameter / 4 / c.reduced) ** 2


def field_of_view(c: Microscope) -> Float[Array, "depth axis"]:
    """Width of the object that is seen at all, along x and y."""
    sensor = c.imager.sensor
    widths = jnp.array(sensor.shape[::-1], c.plate.dtype) * sensor.pixel_pitch
    return theory.field_of_view(c.plate[None], widths[None], c.magnification[:, None], c.imager.field_radius)


def thickness(c: Microscope) -> Float[Array, ""]:
    """From the plate's front to the sensor, `t + v`."""
    return c.imager.sensor_distance + c.imager.array.substrate_thickness


def psf_width(c: Microscope) -> Float[Array, " depth"]:
    """Width of the spot on the sensor, seen in the object: that of a Gaussian of the same variance, at half height.

    Exact rays through the clear aperture, with all that defocus and aberrations do, averaged over the lens's field
    with its envelope; plus the variances of the pixel and of a Gaussian as wide as the Airy disc. Light far from the
    core counts, so for a caustic this is wider than the core.
    """
    landing, weight, lit = _spots(c)
    squared = jnp.sum(lit * jnp.sum((landing - _centroid(landing, lit)) ** 2, -1), -1) / 2
    rays = jnp.sum(weight * squared, -1)
    airy = theory.airy_deviation(c.imager.wavelength, c.imager.sensor_distance, c.clear_diameter)
    total = rays + airy**2 + c.imager.sensor.pixel_pitch**2 / 12
    return UM * theory.FWHM * jnp.sqrt(total) / c.magnification


def encircled_radius(c: Microscope) -> Float[Array, " depth"]:
    """Radius about the rays' centroid that holds 80 % of them, seen in the object; rays as for `psf_width`.

    A ray counts as within by a logistic curve half a pixel wide: without it the radius would have a kink wherever
    one ray overtakes another.
    """
    landing, weight, lit = _spots(c)
    radius = safe_sqrt(jnp.sum((landing - _centroid(landing, lit)) ** 2, -1))
    share = weight[..., None] * lit
    radius, share = (x.reshape(x.shape[0], -1) for x in (radius, share))
    return UM * jax.vmap(_quantile, (0, 0, None))(radius, share, c.imager.sensor.pixel_pitch / 2) / c.magnification


def _quantile(x: Float[Array, " entry"], share: Float[Array, " entry"], width: float) -> Float[Array, ""]:
    """Where `_ENCIRCLED` of the entries are below, each counted by a logistic curve; bisection, then Newton's step.

    The step changes next to nothing but has the derivatives of the implicit function.
    """
    below = lambda at: jnp.sum(share * jax.nn.sigmoid((at - x) / width)) - _ENCIRCLED
    fixed = jax.lax.stop_gradient

    def halve(_, ends):
        low, high = ends
        middle = (low + high) / 2
        under = fixed(below(middle)) < 0
        return jnp.where(under, middle, low), jnp.where(under, high, middle)

    top = fixed(jnp.max(x)) + 20 * width
    at, _ = jax.lax.fori_loop(0, 40, halve, (jnp.zeros_like(top), top))
    slope = fixed(jax.grad(below)(at))
    lit = slope > 0
    return at - jnp.where(lit, below(at) / jnp.where(lit, slope, 1), 0)


def _spots(c: Microscope):
    """Where rays land, `(depth, field, ray, 2)`; the share of each height, and of each ray of it."""
    points, weights = pupil_disc(c.clear_diameter / 2)
    heights = _heights(c)
    trace = lambda z, h: unit_rays(c.imager, z, points, (h, jnp.zeros_like(h)))
    rays = jax.vmap(jax.vmap(trace, (None, 0)), (0, None))(c.depths, heights)
    lit = jnp.where(rays.valid, weights[None, None], 0)
    total = jnp.sum(lit, -1, keepdims=True)
    weight = envelope(heights[None] ** 2, c.reduced[:, None], c.imager.field_radius)
    return rays.landing, weight / jnp.sum(weight, -1, keepdims=True), lit / jnp.where(total > 0, total, 1)


def _centroid(landing, lit):
    return jnp.sum(lit[..., None] * landing, -2, keepdims=True)


def _heights(c: Microscope) -> Float[Array, " field"]:
    rings = (np.arange(_FIELDS) + 0.5) / _FIELDS
    return c.imager.field_radius * jnp.sqrt(jnp.asarray(rings, c.depths.dtype))


def spacing(c: Microscope) -> Float[Array, " lens"]:
    """Distance of each lens from its nearest neighbour; infinite for a single lens."""
    centers = c.imager.array.centers
    squared = jnp.sum((centers[:, None] - centers[None]) ** 2, -1)
    nearest = jnp.min(jnp.where(jnp.eye(len(centers), dtype=bool), jnp.inf, squared), 1)
    return safe_sqrt(nearest)


def web(c: Microscope) -> Float[Array, " lens"]:
    """What is left between apertures that do not touch, `nearest neighbour - D`; negative where they overlap.

    The least feature of a mask that stops the light between the lenses.
    """
    return spacing(c) - c.imager.array.aperture_diameter


def hole(c: Microscope) -> Float[Array, " place"]:
    """Distance of places of the plate, 41 x 41 from edge to edge, from the nearest lens."""
    side = jnp.linspace(-0.5, 0.5, _PLACES, dtype=c.plate.dtype)
    places = jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2) * c.plate[None]
    squared = jnp.sum((places[:, None] - c.imager.array.centers[None]) ** 2, -1)
    return safe_sqrt(jnp.min(squared, 1))


def sag(c: Microscope) -> Float[Array, ""]:
    """Height of a whole lens, `R - sqrt(R^2 - D^2/4)`: the deepest that the mold can be."""
    radius, half = c.imager.array.radius_of_curvature, c.imager.array.aperture_diameter / 2
    return half**2 / (radius + safe_sqrt(radius**2 - half**2))


def edge_slope(c: Microscope) -> Float[Array, ""]:
    """Slope of the surface at the rim of the clear disc, `asin(a / R)`, degrees; at most 90."""
    sine = jnp.minimum(c.clear_diameter / 2 / c.imager.array.radius_of_curvature, 1 - 1e-6)
    return jnp.rad2deg(jnp.arcsin(sine))


TERMS: dict[str, Term] = {
    "lateral_resolution_um": Term("lateral resolution in focus (Eq. 5)", lambda c: UM * c.lateral_resolution),
    "axial_resolution_um": Term("axial resolution in focus (Eq. 6)", lambda c: UM * c.axial_resolution),
    "depth_of_field_mm": Term("depth of field (Eq. 8)", lambda c: c.middle.depth_of_field[0]),
    "depth_of_field_eq7_mm": Term("depth of field (Eq. 7)", lambda c: c.middle.approximate_depth_of_field[0]),
    "focus_offset": Term("focus from the middle of the depths, 1 at their ends", focus_offset),
    "blur_um": Term("diameter of the thin lens's blur, in the object", lambda c: UM * c.object_blur),
    "strehl": Term("Strehl ratio over the field (Eqs. 9, 10)", log_strehl, log=True),
    "wavefront_waves": Term("RMS wavefront error over the field", wavefront),
    "lenses_per_point": Term("lenses that see a point, N_e", lambda c: c.lenses_per_point),
    "occupancy": Term("occupancy V (Eq. 11)", lambda c: c.occupancy),
    "light_percent": Term("share of a point's light that is used", light),
    "field_of_view_mm": Term("width of the field of view", field_of_view),
    "thickness_mm": Term("thickness, plate and sensor distance", thickness),
    "psf_width_um": Term("width of the spot (FWHM of its variance), in the object", psf_width),
    "encircled_radius_um": Term("radius of 80 % of the rays, in the object", encircled_radius),
    "depth_span_mm": Term("span of the depths", lambda c: c.depths[-1] - c.depths[0]),
    "spacing_mm": Term("distance of nearest lenses", spacing),
    "web_mm": Term("mask left between neighbouring apertures", web),
    "hole_mm": Term("distance of a place on the plate from a lens", hole),
    "coverage": Term("share of the plate that is clear aperture", lambda c: c.coverage),
    "sag_mm": Term("height of a whole lens", sag),
    "ghosts": Term("RMS ghost of a point over its image", ghosts, random=True),
    "lens_shortage": Term("mean over the plate of one over the lenses that see a point", shortage),
    "spectral_flatness": Term("flatness of a point's comb's spectrum, 1 if white", flatness, random=True),
    "condition_number": Term("largest over smallest power of that spectrum", conditioning, random=True),
    "localization_um": Term("least error of locating a point, x, y, z", localization, random=True),
    "reconstruction_error": Term("relative error of reconstructed scenes", log_error, log=True, random=True),
    "edge_slope_deg": Term("slope at the clear aperture's rim", edge_slope),
}

_UNITS = {"um": "um", "mm": "mm", "deg": "degrees", "percent": "%", "waves": "waves"}


def unit_of(name: str) -> str:
    """The unit that a term's name ends in, as people write it; empty for a number without one."""
    return _UNITS.get(name.rpartition("_")[2], "")
