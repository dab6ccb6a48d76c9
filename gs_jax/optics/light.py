"""How much of a point's light a lens passes on: solid angle, reflection, and where neighbours cut the aperture."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Float64

from ..geometry import Imager
from ..lenses import EACH, MicrolensArray, sag
from .aperture import aperture_area
from .psf import GOLDEN_ANGLE
from .refraction import on_host, passed, refracted, solid_angle

# Radii and angles at which an aperture is asked whether it is open.
_RADII, _ANGLES = 64, 64


class Zones(NamedTuple):
    """The clear apertures of all lenses, averaged over lenses and angles: how open they are at each radius.

    `radius`, mm. `open`: share of the lenses, 0 to 1. `by_area`: how that grows with a lens's clear area, 1/mm^2, by
    linear regression over the lenses; 0 if they are alike.
    """

    radius: Float64[np.ndarray, " zone"]
    open: Float64[np.ndarray, " zone"]
    by_area: Float64[np.ndarray, " zone"]


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


def mean_zones(array: MicrolensArray) -> Zones:
    """How open the lenses of an array are, by radius, as if they were alike: enough for the light of a mean lens."""
    radius, shares = _open_shares(array)
    return Zones(radius, shares.mean(0), np.zeros(_RADII))


def zones(array: MicrolensArray) -> Zones:
    """How open the lenses of an array are, by radius, each with its own area."""
    radius, shares = _open_shares(array)
    areas = np.asarray(clear_area(array), np.float64)
    excess = areas - areas.mean()
    spread = (excess**2).sum()
    slope = excess @ shares / spread if spread > 1e-6 * (areas**2).sum() else np.zeros(_RADII)
    return Zones(radius, shares.mean(0), slope)


def _open_shares(array):
    """Radii, and the share of each lens's circle that is open there."""
    array.check_alike()
    centers = np.asarray(array.centers, np.float64)
    diameter = float(array.aperture_diameter)
    radius = (np.arange(_RADII) + 0.5) * diameter / 2 / _RADII
    angle = 2 * np.pi * (np.arange(_ANGLES) + 0.5) / _ANGLES
    points = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    shares = np.empty((len(centers), _RADII))
    covered = _covered_by_alike(centers, diameter) if array.others is None else _covered_by_any(array)
    for lens in range(len(centers)):
        shares[lens] = 1 - covered(lens, points).mean(1)
    return radius, shares


def _covered_by_alike(centers, diameter):
    """Half-way to a neighbour and beyond."""

    def covered(lens, points):
        offsets = np.delete(centers, lens, 0) - centers[lens]
        offsets = offsets[(offsets**2).sum(1) <= diameter**2]
        return (points @ offsets.T > (offsets**2).sum(1) / 2).any(-1)

    return covered


def _covered_by_any(array):
    """Within the disc of a neighbour that is less below the plane of the vertices."""
    whole, mine = on_host(array.whole), on_host(array)
    radius, diameter, conic = (getattr(whole, name) for name in EACH)
    rim, own = diameter / 2, float(mine.aperture_diameter) / 2

    def covered(lens, points):
        offsets, squared = whole.centers - whole.centers[lens], (points**2).sum(-1)
        here, found = mine.sag(np.minimum(squared, own**2)), np.zeros(squared.shape, bool)
        for j in np.flatnonzero(np.hypot(*offsets.T) <= rim + own):
            apart = ((points - offsets[j]) ** 2).sum(-1)
            its = sag(np.minimum(apart, rim[j] ** 2), radius[j], conic[j], mine.aspheric_terms)
            found |= (j != lens) & (apart <= rim[j] ** 2) & (its < here)
        return found

    return covered


def spot_rays(
    imager: Imager, depth: float, fields: Float64[np.ndarray, " field"], aperture: Zones, count: int
) -> SpotRays:
    """Rays of a point at each field, `count` of them evenly over the lens's disc."""
    order, rim = np.arange(count) + 0.5, float(imager.array.aperture_diameter) / 2
    radius = rim * np.sqrt(order / count)
    points = radius[:, None] * np.stack([np.cos(GOLDEN_ANGLE * order), np.sin(GOLDEN_ANGLE * order)], -1)
    host, landing, light = on_host(imager), np.empty((len(fields), count, 2)), np.empty((len(fields), count))
    # Field by field: what each makes stays in the processor's cache.
    for k, field in enumerate(fields):
        at, light[k] = _light(host, float(depth), points.T, np.array([[field], [0.0]]))
        landing[k] = at.T
    light *= np.pi * rim**2 / count
    share, slope = (np.interp(radius, aperture.radius, part) for part in (aperture.open, aperture.by_area))
    return SpotRays(landing, light * share, light * slope)


def transmitted(
    imager: Imager,
    depth: float,
    pupil_points: Float[np.ndarray, "point 2"],
    field: Float[np.ndarray, "2"],
) -> Float64[np.ndarray, " point"]:
    """Light through points of a lens's curved side, per area: the share of all that a point sends out, 1/mm^2.

    The solid angle that a piece of the lens takes of the point's light (the cosine's third power: a point that sends
    out as much in all directions has no cosine of its own), less what both faces reflect (Fresnel's equations,
    unpolarised). An ideal lens reflects nothing.

    Parameters
    ----------
    imager, depth, pupil_points, field
        As for `gs_jax.optics.unit.unit_rays`; where its rays are not valid, there is no light.
    """
    return _light(on_host(imager), depth, pupil_points.T.astype(np.float64), field[:, None].astype(np.float64))[1]


def _light(imager, depth, points, field):
    """Of rays to a field, all with their coordinates first: where they land, and their light per area."""
    ray = refracted(imager, depth, points, field)
    light = solid_angle(imager, depth, ray) * passed(imager, ray) / (4 * np.pi)
    return ray.landing, np.where(ray.valid, light, 0)
