"""Size of a point's spot by exact rays over the field of a lens."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..base.arrays import safe_sqrt
from ..geometry import Imager, envelope
from ..optics import theory
from ..optics.pupil import pupil_quadrature
from ..optics.raytrace import trace_lenslet
from .conditions import Depths, as_conditions, best_type, clear_diameter, field_heights, field_radius

# Share of the light within the encircled radius.
_ENCIRCLED = 0.8


@best_type
def spot_width(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Width of the spot on the sensor, seen in the object, mm: that of a Gaussian of the same variance, at half height.

    Exact rays through the clear aperture, with all that defocus and aberrations do, averaged over the lens's field
    with its envelope; plus the variances of the pixel and of a Gaussian as wide as the Airy disc. Light far from the
    core counts, so for a caustic this is wider than the core.
    """
    at = as_conditions(imager, depths)
    landing, weight, lit = _spots(imager, at)
    squared = jnp.sum(lit * jnp.sum((landing - _centroid(landing, lit)) ** 2, -1), -1) / 2
    rays = jnp.sum(weight * squared, -1)
    airy = theory.airy_sigma(imager.wavelength, imager.reduced_sensor_distance, clear_diameter(imager, at))
    total = rays + airy**2 + imager.sensor.pixel_pitch**2 / 12
    return theory.FWHM * jnp.sqrt(total) / imager.magnification(at.depths)


@best_type
def encircled_radius(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Radius about the rays' centroid that holds 80 % of them, seen in the object, mm; rays as for `spot_width`.

    A ray counts as within by a logistic curve half a pixel wide: without it the radius would have a kink wherever
    one ray overtakes another.
    """
    at = as_conditions(imager, depths)
    landing, weight, lit = _spots(imager, at)
    radius = safe_sqrt(jnp.sum((landing - _centroid(landing, lit)) ** 2, -1))
    share = weight[..., None] * lit
    radius, share = (x.reshape(x.shape[0], -1) for x in (radius, share))
    on_sensor = jax.vmap(_quantile, (0, 0, None))(radius, share, imager.sensor.pixel_pitch / 2)
    return on_sensor / imager.magnification(at.depths)


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


def _spots(imager, at):
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
