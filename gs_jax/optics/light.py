"""How much of a point's light a lens passes on: solid angle, reflection, and where neighbours cut the aperture."""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64
from scipy.spatial import KDTree

from ..geometry import Imager, MicrolensArray
from .aperture import aperture_area
from .psf import GOLDEN_ANGLE
from .unit import as_air, slope_in_glass, unit_rays

# Radii and angles at which an aperture is asked whether it is open.
_RADII, _ANGLES = 64, 64


class Zones(NamedTuple):
    """The clear apertures of all lenses, averaged over lenses and angles: how open they are at each radius.

    `radius`, mm. `open`: share of the lenses, 0 to 1. `by_area`: how that grows with a lens's clear area, 1/mm^2, by
    linear regression over the lenses; 0 if they are alike. `area`: the mean clear area, mm^2.
    """

    radius: Float64[np.ndarray, " zone"]
    open: Float64[np.ndarray, " zone"]
    by_area: Float64[np.ndarray, " zone"]
    area: float


class SpotRays(NamedTuple):
    """Rays of one depth to the sensor, for points at `(field, 0)` from a lens's axis.

    `landing`: from the axis, mm. `light`: share of what the point sends out in all directions, of a mean lens;
    `light_by_area`: what that changes with a lens's clear area, 1/mm^2.
    """

    landing: Float64[np.ndarray, "field ray 2"]
    light: Float64[np.ndarray, "field ray"]
    light_by_area: Float64[np.ndarray, "field ray"]


def clear_area(array: MicrolensArray) -> Float[Array, " lens"]:
    """Area of each lens's clear aperture where light is concerned, mm^2: outer lenses are as wide as their discs.

    What is beyond the plate's nominal size lets light through too: the ray-traced captures of the authors' array have
    it, and edges that are cut there make the model 20 % too dark at the sensor's rim.
    """
    return aperture_area(dataclasses.replace(array, size=(math.inf, math.inf)))


def zones(array: MicrolensArray) -> Zones:
    """How open the lenses of an array are, by radius."""
    centers = np.asarray(array.centers, np.float64)
    diameter = float(array.aperture_diameter)
    radius = (np.arange(_RADII) + 0.5) * diameter / 2 / _RADII
    angle = 2 * np.pi * (np.arange(_ANGLES) + 0.5) / _ANGLES
    points = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    tree = KDTree(centers)
    shares = np.empty((len(centers), _RADII))
    for lens, near in enumerate(tree.query_ball_point(centers, diameter)):
        offsets = centers[[other for other in near if other != lens]] - centers[lens]
        beyond = points @ offsets.T > (offsets**2).sum(1) / 2
        shares[lens] = 1 - beyond.any(-1).mean(1)
    areas = np.asarray(clear_area(array), np.float64)
    excess = areas - areas.mean()
    spread = (excess**2).sum()
    slope = excess @ shares / spread if spread > 1e-6 * (areas**2).sum() else np.zeros(_RADII)
    return Zones(radius, shares.mean(0), slope, float(areas.mean()))


def spot_rays(
    imager: Imager, depth: float, fields: Float64[np.ndarray, " field"], aperture: Zones, count: int
) -> SpotRays:
    """Rays of a point at each field, `count` of them evenly over the lens's disc."""
    order, rim = np.arange(count) + 0.5, float(imager.array.aperture_diameter) / 2
    radius = rim * np.sqrt(order / count)
    points = radius[:, None] * np.stack([np.cos(GOLDEN_ANGLE * order), np.sin(GOLDEN_ANGLE * order)], -1)
    landing, light = (np.asarray(part, np.float64) for part in _traced(imager, float(depth), points, fields))
    light = light * np.pi * rim**2 / count
    share, slope = (np.interp(radius, aperture.radius, part) for part in (aperture.open, aperture.by_area))
    return SpotRays(landing, light * share, light * slope)


@jax.jit
def _traced(imager, depth, points, fields):
    def of_field(field):
        beside = jnp.stack([field, jnp.zeros_like(field)])
        rays = unit_rays(imager, depth, points, beside)
        return rays.landing, jnp.where(rays.valid, transmitted(imager, depth, points, beside), 0)

    return jax.lax.map(of_field, jnp.asarray(fields, imager.sensor_distance.dtype), batch_size=16)


@jax.jit
def transmitted(
    imager: Imager,
    depth: Float[Array, ""] | float,
    pupil_points: Float[Array | np.ndarray, "point 2"],
    field: Float[Array | np.ndarray, "2"],
) -> Float[Array, " point"]:
    """Light that leaves the lens at its points, per area: the share of all that an isotropic point sends out, 1/mm^2.

    The solid angle that a piece of the lens takes of the point's light (the cosine's third power: a point that sends
    out as much in all directions has no cosine of its own), less what both faces reflect (Fresnel's equations,
    unpolarised). An ideal lens reflects nothing.

    Parameters
    ----------
    imager, depth, pupil_points, field
        As for `gs_jax.optics.unit.unit_rays`; where its rays are not valid, this means nothing.
    """
    dtype = imager.sensor_distance.dtype
    depth, field = jnp.asarray(depth, dtype), jnp.asarray(field, dtype)
    slope, through = (
        (_thick_slope, _through_both_faces)
        if imager.array.thin_lens_focal_length is None
        else (_thin_slope, lambda *_: jnp.ones((), dtype))
    )

    def of_point(point):
        q = slope(point, imager, depth, field)
        (a, b), (c, d) = jax.jacfwd(slope)(point, imager, depth, field)
        solid_angle = jnp.abs(a * d - b * c) * (1 + jnp.sum(q**2)) ** -1.5
        return solid_angle / (4 * jnp.pi) * through(point, q, imager)

    return jax.vmap(of_point, 1)(jnp.asarray(pupil_points, dtype).T)


def _thin_slope(point, imager, depth, field):
    return (point - field) / imager.reduced_depth(depth)


def _thick_slope(point, imager, depth, field):
    """Of the ray in front of the lens."""
    array = imager.array
    radius, r2 = array.radius_of_curvature, jnp.sum(point**2)
    sag = r2 / (radius + jnp.sqrt(jnp.maximum(radius**2 - r2, 1e-6 * radius**2)))
    return (point - field) / (
        depth + as_air(array.refractive_index, array.substrate_thickness - sag, depth, point - field)
    )


def _through_both_faces(point, slope, imager):
    n, radius = imager.array.refractive_index, imager.array.radius_of_curvature
    glass = slope_in_glass(n, slope)
    outside, inside = (1 / jnp.sqrt(1 + jnp.sum(s**2)) for s in (slope, glass))
    normal_z = jnp.sqrt(jnp.maximum(radius**2 - jnp.sum(point**2), 0)) / radius
    cosine = inside * (jnp.sum(glass * point) / radius + normal_z)
    behind = jnp.sqrt(jnp.maximum(1 - n**2 * (1 - cosine**2), 0))
    return _passed(1, outside, n, inside) * _passed(n, cosine, 1, behind)


def _passed(n_in, cos_in, n_out, cos_out):
    """Share of the light that a face lets through."""
    across = (n_in * cos_in - n_out * cos_out) / (n_in * cos_in + n_out * cos_out)
    along = (n_out * cos_in - n_in * cos_out) / (n_out * cos_in + n_in * cos_out)
    return 1 - (across**2 + along**2) / 2
