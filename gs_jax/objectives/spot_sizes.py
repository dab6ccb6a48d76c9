"""Sizes of a point's image (PSF), seen in the object: full width at half maximum, RMS width, radii of half and 80 %.

They differ by a factor of ten where a sharp core stands in wide stray light: `fwhm` is the width of the core, while
`rms_width` and `spot_width` are of all the light, and so are mostly of the stray light.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.arrays import safe_sqrt
from ..geometry import Imager, envelope
from ..optics import theory
from ..optics.diffraction import AxialPupil, axial_irradiance, axial_pupil
from ..optics.pupil import pupil_quadrature
from ..optics.raytrace import trace_lenslet
from .conditions import Conditions, Depths, as_conditions, best_type, clear_diameter, field_heights, field_radius
from .quantities import light

# Radii at which a profile is computed, and of arcs within a pixel.
_RADII, _ARCS = 256, 48
# FWHM in pixels and Airy discs above which rays alone give the profile: fringes do not count there.
_WIDE = 6.0
# Width of the Gaussian that smooths ray counts, over the mean squared radius of the rays and then over that of half the
# height, in so many passes; a number that is nothing beside a squared radius, mm^2.
_COARSE, _FINE, _PASSES, _NOTHING = 0.1, 0.06, 5, 1e-16
# Random moves of each ray by the pixel and the Airy disc, for the radius of half the light, and the width over which a
# ray counts in part, over the standard deviation of the moves.
_MOVES, _SMOOTH = 16, 0.2


@best_type
def fwhm(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Full width at half maximum of the PSF of a point on a lens's axis, seen in the object, mm.

    The profile through the middle of the image, as pixels see it: diffraction with the exact wavefront of the round
    clear aperture, averaged over the area of a pixel. The width is that between the outermost points of half the
    height. A blur of more than six pixels and Airy discs is that of rays.
    """
    at = as_conditions(imager, depths)
    diameter, pixel = clear_diameter(imager, at), imager.sensor.pixel_pitch
    airy = theory.airy_sigma(imager.wavelength, imager.reduced_sensor_distance, diameter)

    def on_sensor(depth):
        pupil = axial_pupil(imager, depth, radius=diameter / 2)
        by_rays = _width_by_rays(pupil)
        narrow = _WIDE * jnp.maximum(pixel, theory.FWHM * airy)
        places = (narrow + pixel) * jnp.linspace(0, 1, _RADII, dtype=narrow.dtype)
        # Dense in the middle: the core may be much smaller than a pixel.
        irradiance = axial_irradiance(imager, pupil, places**2 / places[-1])
        by_waves = _outermost_half(places, _over_pixels(places, irradiance, pixel))
        return jnp.where(by_rays > narrow, by_rays, by_waves)

    return jax.lax.map(on_sensor, at.depths) / imager.magnification(at.depths)


def _over_pixels(places, irradiance, pixel) -> Float[Array, " place"]:
    """Light in square pixels whose middles are at places along an axis, of a round image given at places squared.

    The circle of each radius has an arc within the pixel, which is exact: images may be much smaller than a pixel, or
    larger.
    """
    half, count, last = pixel / 2, irradiance.shape[0], places[-1]
    # Radii that meet the pixel, dense at the lower end, where the middle of the image may be.
    low, high = jnp.maximum(places - math.sqrt(2) * half, 0), jnp.minimum(places + math.sqrt(2) * half, last)
    t = jnp.asarray((np.arange(_ARCS) + 0.5) / _ARCS, places.dtype)[None]
    span = (high - low)[:, None]
    radius = low[:, None] + span * t**2
    index = (count - 1) * jnp.sqrt(radius / last)
    floor = jnp.minimum(jnp.floor(index), count - 2)
    below, above = (irradiance[floor.astype(int) + step] for step in (0, 1))
    first, end = (_arccos((places[:, None] + side) / radius) for side in (half, -half))
    side = jnp.pi / 2 - _arccos(half / radius)
    arc = jnp.maximum(jnp.minimum(end, side) - first, 0) + jnp.maximum(end - jnp.maximum(first, jnp.pi - side), 0)
    return jnp.sum(arc * (below + (index - floor) * (above - below)) * radius * span * t, 1)


def _arccos(cosine):
    """The angle of a cosine, or of the nearest one; at the ends without a derivative, which is infinite."""
    inside = jnp.abs(cosine) < 1
    return jnp.where(inside, jnp.arccos(jnp.where(inside, cosine, 0)), jnp.where(cosine < 0, jnp.pi, 0))


def _width_by_rays(pupil: AxialPupil) -> Float[Array, ""]:
    """Full width at half of the highest density of rays, mm: density over squared radii, blurred a little."""
    share, squared = jnp.where(pupil.lit, pupil.weight, 0), pupil.landing**2
    mean = jnp.sum(share * squared) / jnp.maximum(jnp.sum(share), _NOTHING)

    def width_squared(reach, blur):
        places = reach * jnp.linspace(0, 1, _RADII, dtype=share.dtype)
        gauss = lambda apart: jnp.exp(-((apart / blur) ** 2) / 2)
        away, mirrored = (places[:, None] + sign * squared[None] for sign in (-1, 1))
        return _outermost_half(places, jnp.sum(share[None] * (gauss(away) + gauss(mirrored)), 1)) / 2

    # Stray light makes the mean large: the core shows once the blur is small beside it.
    finer = lambda width, _: (width_squared(2 * width, _FINE * width), None)
    first = width_squared(4 * mean + _NOTHING, _COARSE * mean + _NOTHING)
    return 2 * safe_sqrt(jax.lax.scan(finer, first, length=_PASSES)[0])


def _outermost_half(places, profile) -> Float[Array, ""]:
    """Twice the largest radius at which a profile has half of its maximum; linear between radii."""
    half = jnp.max(profile) / 2
    last = jnp.minimum(jnp.max(jnp.where(profile >= half, jnp.arange(len(profile)), 0)), len(profile) - 2)
    high, low = profile[last], profile[last + 1]
    part = (high - half) / jnp.where(high > low, high - low, 1)
    return 2 * (places[last] + part * (places[last + 1] - places[last]))


@best_type
def rms_width(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """RMS width of the PSF along an axis, the standard deviation of its light, seen in the object, mm.

    Exact rays through the clear aperture, with all that defocus and aberrations do, averaged over the lens's field
    with its envelope; plus the variances of the pixel and of a Gaussian as wide as the Airy disc. Light far from the
    core counts, so with stray light this is many times the width of the core, `fwhm`.
    """
    at = as_conditions(imager, depths)
    landing, weight, lit = _spots(imager, at)
    squared = jnp.sum(lit * jnp.sum((landing - _centroid(landing, lit)) ** 2, -1), -1) / 2
    rays = jnp.sum(weight * squared, -1)
    airy = theory.airy_sigma(imager.wavelength, imager.reduced_sensor_distance, clear_diameter(imager, at))
    total = rays + airy**2 + imager.sensor.pixel_pitch**2 / 12
    return jnp.sqrt(total) / imager.magnification(at.depths)


def spot_width(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Width of the spot, 2.355 times `rms_width`, seen in the object, mm: the FWHM of a Gaussian of that variance.

    Of a PSF that is no Gaussian it is not the FWHM, which `fwhm` is. Of the best type.
    """
    return theory.FWHM * rms_width(imager, depths)


def width_per_light(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """`spot_width` over the fourth root of the percentage of light that all lenses collect: sharpness and noise in one.

    In mm, as `spot_width` where the lenses collect 1 %. It ranks designs as Richardson-Lucy at equal exposure does
    (`experiments/design_ranks.py`).
    """
    at = as_conditions(imager, depths)
    return _per_light(spot_width(imager, at), light(imager, at))


@jax.jit
def _per_light(width, light):
    return width / (100 * light) ** 0.25


@best_type
def half_light_radius(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Radius about the centroid that holds half of the PSF's light, seen in the object, mm.

    Rays as for `rms_width`, each moved by numbers with the distribution of the pixel and of a Gaussian as wide as the
    Airy disc (fixed seed; right to 2 %).
    """
    at = as_conditions(imager, depths)
    landing, weight, lit = _spots(imager, at)
    airy = theory.airy_sigma(imager.wavelength, imager.reduced_sensor_distance, clear_diameter(imager, at))
    rng, shape, pixel = np.random.default_rng(0), (_MOVES, *landing.shape[2:]), imager.sensor.pixel_pitch
    even, normal = rng.uniform(-0.5, 0.5, shape), rng.normal(size=shape)
    moves = pixel * jnp.asarray(even, landing.dtype) + airy * jnp.asarray(normal, landing.dtype)
    moved = (landing[:, :, None] + moves[None, None]).reshape(*landing.shape[:2], -1, 2)
    smooth = _SMOOTH * jnp.sqrt(airy**2 + pixel**2 / 12)
    on_sensor = _radius_of(0.5, moved, weight, jnp.tile(lit, (1, 1, _MOVES)) / _MOVES, smooth)
    return on_sensor / imager.magnification(at.depths)


@best_type
def encircled_radius(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Radius about the rays' centroid that holds 80 % of them, seen in the object, mm; rays as for `rms_width`.

    A ray counts as within by a logistic curve half a pixel wide: without it the radius would have a kink wherever
    one ray overtakes another.
    """
    at = as_conditions(imager, depths)
    on_sensor = _radius_of(0.8, *_spots(imager, at), imager.sensor.pixel_pitch / 2)
    return on_sensor / imager.magnification(at.depths)


def _radius_of(part: float, landing, weight, lit, width) -> Float[Array, " depth"]:
    """Radius about the centroid that holds a part of the rays of all heights, each counted by a logistic curve."""
    radius = safe_sqrt(jnp.sum((landing - _centroid(landing, lit)) ** 2, -1))
    share = weight[..., None] * lit
    radius, share = (x.reshape(x.shape[0], -1) for x in (radius, share))
    return jax.vmap(lambda x, share: _quantile(part, x, share, width))(radius, share)


def _quantile(part: float, x: Float[Array, " entry"], share: Float[Array, " entry"], width) -> Float[Array, ""]:
    """Where a part of the entries is below, each counted by a logistic curve; bisection, then Newton's step.

    The step changes next to nothing but has the derivatives of the implicit function.
    """
    below = lambda at: jnp.sum(share * jax.nn.sigmoid((at - x) / width)) - part
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


def _spots(imager: Imager, at: Conditions):
    """Where rays land, `(depth, field, ray, 2)`; the share of each height, and of each ray of it."""
    points, weights = pupil_quadrature(clear_diameter(imager, at) / 2)
    heights = field_heights(imager, at)
    trace = lambda z, h: trace_lenslet(imager, z, points, (h, jnp.zeros_like(h)))
    rays = jax.vmap(jax.vmap(trace, (None, 0)), (0, None))(at.depths, heights)
    lit = jnp.where(rays.valid, weights[None, None], 0)
    total = jnp.sum(lit, -1, keepdims=True)
    weight = envelope(heights[None] ** 2, imager.reduced_depth(at.depths)[:, None], field_radius(imager, at))
    return rays.landing, weight / jnp.sum(weight, -1, keepdims=True), lit / jnp.where(total > 0, total, 1)


def _centroid(landing, lit):
    return jnp.sum(lit[..., None] * landing, -2, keepdims=True)
