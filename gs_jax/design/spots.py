"""The spots of a microscope's lenses by exact rays, over the field; differentiable."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.arrays import safe_sqrt
from ..geometry import envelope
from ..optics import theory
from ..optics.raytrace import pupil_quadrature, trace_lenslet
from .microscope import Microscope

_FIELDS = 4
_ENCIRCLED = 0.8


def psf_width(c: Microscope) -> Float[Array, " depth"]:
    """Width of the spot on the sensor, seen in the object, mm: that of a Gaussian of the same variance, at half height.

    Exact rays through the clear aperture, with all that defocus and aberrations do, averaged over the lens's field
    with its envelope; plus the variances of the pixel and of a Gaussian as wide as the Airy disc. Light far from the
    core counts, so for a caustic this is wider than the core.
    """
    landing, weight, lit = _spots(c)
    squared = jnp.sum(lit * jnp.sum((landing - _centroid(landing, lit)) ** 2, -1), -1) / 2
    rays = jnp.sum(weight * squared, -1)
    airy = theory.airy_sigma(c.imager.wavelength, c.imager.reduced_sensor_distance, c.clear_diameter)
    total = rays + airy**2 + c.imager.sensor.pixel_pitch**2 / 12
    return theory.FWHM * jnp.sqrt(total) / c.magnification


def encircled_radius(c: Microscope) -> Float[Array, " depth"]:
    """Radius about the rays' centroid that holds 80 % of them, seen in the object, mm; rays as for `psf_width`.

    A ray counts as within by a logistic curve half a pixel wide: without it the radius would have a kink wherever
    one ray overtakes another.
    """
    landing, weight, lit = _spots(c)
    radius = safe_sqrt(jnp.sum((landing - _centroid(landing, lit)) ** 2, -1))
    share = weight[..., None] * lit
    radius, share = (x.reshape(x.shape[0], -1) for x in (radius, share))
    return jax.vmap(_quantile, (0, 0, None))(radius, share, c.imager.sensor.pixel_pitch / 2) / c.magnification


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
    points, weights = pupil_quadrature(c.clear_diameter / 2)
    heights = field_heights(c)
    trace = lambda z, h: trace_lenslet(c.imager, z, points, (h, jnp.zeros_like(h)))
    rays = jax.vmap(jax.vmap(trace, (None, 0)), (0, None))(c.depths, heights)
    lit = jnp.where(rays.valid, weights[None, None], 0)
    total = jnp.sum(lit, -1, keepdims=True)
    weight = envelope(heights[None] ** 2, c.reduced[:, None], c.field_radius)
    return rays.landing, weight / jnp.sum(weight, -1, keepdims=True), lit / jnp.where(total > 0, total, 1)


def _centroid(landing, lit):
    return jnp.sum(lit[..., None] * landing, -2, keepdims=True)


def field_heights(c: Microscope) -> Float[Array, " field"]:
    """Heights at which a lens is judged over its field, mm: the middles of rings of equal area."""
    rings = (np.arange(_FIELDS) + 0.5) / _FIELDS
    return c.field_radius * jnp.sqrt(jnp.asarray(rings, c.depths.dtype))
