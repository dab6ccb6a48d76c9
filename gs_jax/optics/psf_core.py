"""How much of a point's light a lens passes on: solid angle, reflection, and where neighbours cut the aperture.

The bright cores of a lens's spots: where they land, how bright they are, and what they look like.

With the lens's full aperture a spot is a core, a few pixels wide, in a halo that holds more than half of its light. The
core is not on the chief ray: spherical aberration and coma move it by up to a percent of its distance from the lens's
axis. Over a ring of the field that is all but a change of the magnification, which leaves the map separable in x and y.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Float64

from ..base.machine import in_threads
from ..base.progress import Progress
from ..geometry import Imager, falloff
from ..lenses import EACH, MicrolensArray, sag
from .apertures import aperture_area
from .psf import GOLDEN_ANGLE
from .raytrace import refract, solid_angle, to_numpy, transmittance
from .theory import airy_sigma

# Radii and angles at which an aperture is asked whether it is open.
_RADII, _ANGLES = 64, 64


class ApertureProfile(NamedTuple):
    """The clear apertures of all lenses, averaged over lenses and angles: how open they are at each radius.

    `radius`, mm. `open`: share of the lenses, 0 to 1. `by_area`: how that grows with a lens's clear area, 1/mm^2, by
    linear regression over the lenses; 0 if they are alike.
    """

    radius: Float64[np.ndarray, " zone"]
    open: Float64[np.ndarray, " zone"]
    by_area: Float64[np.ndarray, " zone"]


class PupilSamples(NamedTuple):
    """Rays of one depth to the sensor, for points at `(field, 0)` from a lens's axis.

    `landing`: from the axis, mm. `light`: share of what the point sends out in all directions, of a mean lens;
    `light_per_area`: what that changes with a lens's clear area, 1/mm^2.
    """

    landing: Float64[np.ndarray, "field ray 2"]
    light: Float64[np.ndarray, "field ray"]
    light_per_area: Float64[np.ndarray, "field ray"]


def clear_area(array: MicrolensArray) -> Float[Array, " lens"]:
    """Area of each lens's clear aperture where light is concerned, mm^2: outer lenses are as wide as their discs.

    What is beyond the plate's nominal size lets light through too: the ray-traced captures of the authors' array have
    it, and edges that are cut there make the model 20 % too dark at the sensor's rim.
    """
    return aperture_area(dataclasses.replace(array, size=(math.inf, math.inf)))


def mean_aperture_profile(array: MicrolensArray) -> ApertureProfile:
    """How open the lenses of an array are, by radius, as if they were alike: enough for the light of a mean lens."""
    radius, shares = _open_shares(array)
    return ApertureProfile(radius, shares.mean(0), np.zeros(_RADII))


def aperture_profile(array: MicrolensArray) -> ApertureProfile:
    """How open the lenses of an array are, by radius, each with its own area."""
    radius, shares = _open_shares(array)
    areas = np.asarray(clear_area(array), np.float64)
    excess = areas - areas.mean()
    spread = (excess**2).sum()
    slope = excess @ shares / spread if spread > 1e-6 * (areas**2).sum() else np.zeros(_RADII)
    return ApertureProfile(radius, shares.mean(0), slope)


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
    whole, mine = to_numpy(array.whole), to_numpy(array)
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


def sample_pupil(
    imager: Imager, depth: float, fields: Float64[np.ndarray, " field"], aperture: ApertureProfile, count: int
) -> PupilSamples:
    """Rays of a point at each field, `count` of them evenly over the lens's disc."""
    order, rim = np.arange(count) + 0.5, float(imager.array.aperture_diameter) / 2
    radius = rim * np.sqrt(order / count)
    points = radius[:, None] * np.stack([np.cos(GOLDEN_ANGLE * order), np.sin(GOLDEN_ANGLE * order)], -1)
    host, landing, light = to_numpy(imager), np.empty((len(fields), count, 2)), np.empty((len(fields), count))
    # Field by field: what each makes stays in the processor's cache.
    for k, field in enumerate(fields):
        at, light[k] = _light(host, float(depth), points.T, np.array([[field], [0.0]]))
        landing[k] = at.T
    light *= np.pi * rim**2 / count
    share, slope = (np.interp(radius, aperture.radius, part) for part in (aperture.open, aperture.by_area))
    return PupilSamples(landing, light * share, light * slope)


def transmission(
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
        As for `gs_jax.optics.raytrace.trace_lenslet`; where its rays are not valid, there is no light.
    """
    return _light(to_numpy(imager), depth, pupil_points.T.astype(np.float64), field[:, None].astype(np.float64))[1]


def _light(imager, depth, points, field):
    """Of rays to a field, all with their coordinates first: where they land, and their light per area."""
    ray = refract(imager, depth, points, field)
    light = solid_angle(imager, depth, ray) * transmittance(imager, ray) / (4 * np.pi)
    return ray.landing, np.where(ray.valid, light, 0)


# Ends of the rings in field radii. Farther out cores are as wide as the halo's pixels.
RINGS = (1.0, 1.33, 1.67, 2.0, 2.5, 3.0)
# Degree of the light's polynomial in the squared field, and its number of coefficients.
_DEGREE = 6
# Points of the field in a field radius, and rays of each.
_FIELDS, _RAYS = 16, 8192
# A core is looked for this far from the chief ray's magnification, relative to that.
_FARTHEST, _STEPS = 0.08, 81
# As finely as this: a twentieth of a pixel where cores are farthest from the axis.
_FINE = 1e-4
# Largest pixel by which sharpness is judged, in images of the widest field.
_SHARP = 0.006
# Depths that are traced for the cores' magnification; others are interpolated.
_MOST = 9
# One in so many rays is enough for the first search.
_SPARSE = 8
# Radial bins in a pixel, fine beside the nodes of a halo, and samples of a kernel when it is drawn.
_BINS, _SAMPLES = 16, 2**17


class PsfCores(NamedTuple):
    """The cores of all rings at one depth.

    `distortion`: magnification over the chief ray's, one a ring. `light`: coefficients of `ring_light`. `profile`:
    light in radial bins of a sixteenth of a pixel, with the sum 1.
    """

    distortion: Float64[np.ndarray, " ring"]
    light: Float64[np.ndarray, "ring coefficient"]
    profile: Float64[np.ndarray, "ring bin"]


def ring_window(distance_squared, inner, outer):
    """1 within a ring of the field, 0 beyond it, with the envelope's smooth falloff at both ends; all rings add up."""
    # The ends may be traced; a disc has no falloff inside.
    hole = falloff(distance_squared, jnp.where(inner > 0, inner, 1.0))
    return falloff(distance_squared, outer) - jnp.where(inner > 0, hole, 0)


def ring_light(distance_squared, coefficients, inner, outer):
    """Light of a ring's cores at a squared field, mm^2: a polynomial, within the ring.

    `coefficients` `(..., coefficient)` broadcast, but for the last axis, against `distance_squared`.
    """
    # Beyond the ring, where it does not count, a polynomial would overflow.
    t = jnp.minimum(distance_squared / outer**2, 2)
    value = coefficients[..., -1]
    for power in range(coefficients.shape[-1] - 2, -1, -1):
        value = value * t + coefficients[..., power]
    return value * ring_window(distance_squared, inner, outer)


def ring_edges(imager: Imager, ends: Sequence[float] = RINGS) -> list[tuple[float, float]]:
    """Inner and outer end of each ring, mm, from their ends in field radii."""
    radius = imager.field_radius
    return [(radius * float(a), radius * float(b)) for a, b in zip((0.0, *ends), ends, strict=False)]


def _cores_at_depth(
    imager: Imager, depth: float, aperture: ApertureProfile, reach: float, ends: Sequence[float] = RINGS
) -> PsfCores:
    """The cores at one depth, by exact rays of a mean lens.

    A ring has one kernel: the mean of its spots up to `reach` (mm) about the magnification at which that mean is the
    sharpest. Each spot counts with as much of it as explains the spot best, by least squares.
    """
    pitch = imager.sensor.pixel_pitch
    rings = ring_edges(imager, ends)
    fields = np.arange(0, rings[-1][1] * 1.06, imager.field_radius / _FIELDS)
    rays = add_diffraction(imager, sample_pupil(imager, depth, fields, aperture, _RAYS))
    chief = float(imager.magnification(float(depth)))
    edges = np.arange(0, math.ceil(reach / pitch) * _BINS + 1) * pitch / _BINS
    parts = [_ring_cores(rays, fields, chief, pitch, edges, *ring) for ring in rings]
    return PsfCores(*map(np.stack, zip(*parts, strict=True)))


def trace_cores(
    imager: Imager,
    depths: Float64[np.ndarray, " depth"],
    reach: float,
    ends: Sequence[float] = RINGS,
    progress: Progress | None = None,
) -> PsfCores:
    """The cores at some depths: `_cores_at_depth` of each, with the depths first."""
    aperture = mean_aperture_profile(imager.array)
    tables = in_threads(lambda depth: _cores_at_depth(imager, depth, aperture, reach, ends), depths)
    tracked = zip((progress or Progress()).track(depths, "Tracing cores"), tables, strict=True)
    return PsfCores(*map(np.stack, zip(*(table for _, table in tracked), strict=True)))


def core_magnification(imager: Imager, depths: Float[ArrayLike, " depth"]) -> Float64[np.ndarray, " depth"]:
    """Magnification of the bright core, by exact rays within the field radius; a constant to derivatives.

    The chief ray's is `M_z = v/z'` (Eq. 3); the authors' lenses have 0.4 % less to 0.8 % more, by depth.
    """
    depths = np.asarray(depths, np.float64)
    if np.unique(depths).size > _MOST:
        # A smooth function of the depth; imported here, as few depths are traced without SciPy, which takes its time.
        from scipy.interpolate import CubicSpline

        some = np.linspace(depths.min(), depths.max(), _MOST)
        beyond = float(imager.reduced_depth(0.0))
        return CubicSpline(some, core_magnification(imager, some) * (some + beyond))(depths) / (depths + beyond)
    aperture, fields = mean_aperture_profile(imager.array), np.linspace(0, imager.field_radius, _FIELDS + 1)
    return np.array(list(in_threads(lambda depth: _core(imager, float(depth), fields, aperture)[0], depths)))


def apparent_depths(imager: Imager, depths: Float[ArrayLike, " depth"]) -> Float[Array, " depth"]:
    """Where cores seem to lie by their chief rays: the depths at which `M_z` is the core's magnification, mm.

    Whoever follows chief rays at the apparent depth of a plane (back-projection, say) meets the cores of that plane.
    The authors' lenses, focused on 20 mm, show 18 mm 0.16 mm too near, and 22 mm 0.09 mm too far.
    """
    found = float(imager.reduced_sensor_distance) / core_magnification(imager, depths) - float(
        imager.reduced_depth(0.0)
    )
    return jnp.asarray(found, imager.sensor_distance.dtype)


def ensquared_light(
    imager: Imager, depths: Float64[np.ndarray, " depth"], fields: Float64[np.ndarray, " field"], side: float
) -> Float64[np.ndarray, "depth field"]:
    """Share of a point's light that a mean lens brings into a square of this side (mm) about its spot's core."""
    aperture = mean_aperture_profile(imager.array)

    def share(depth):
        magnification, rays = _core(imager, float(depth), fields, aperture)
        away = np.abs(rays.landing + np.stack([magnification * fields, 0 * fields], -1)[:, None])
        return np.where((away < side / 2).all(-1), rays.light, 0).sum(1)

    return np.array(list(in_threads(share, depths)))


def _core(imager: Imager, depth: float, fields: Float64[np.ndarray, " field"], aperture: ApertureProfile):
    """Magnification of the bright core at one depth, and the rays of the fields that say so."""
    rays = sample_pupil(imager, depth, fields, aperture, _RAYS)
    chief = float(imager.magnification(depth))
    return chief * _sharpest(rays, fields, fields, chief, imager.sensor.pixel_pitch), rays


def add_diffraction(imager: Imager, rays: PupilSamples) -> PupilSamples:
    """Rays moved at random, but always the same, by as much as the aperture diffracts: a Gaussian as wide as Airy's."""
    width = float(airy_sigma(imager.wavelength, imager.reduced_sensor_distance, imager.array.aperture_diameter))
    moves = np.random.default_rng(0).normal(0, width, rays.landing.shape[1:])
    return rays._replace(landing=rays.landing + moves)


def _ring_cores(rays, fields, chief, pitch, edges, inner, outer):
    share = np.asarray(ring_window(jnp.asarray(fields**2), inner, outer), np.float64)
    used = share > 1e-6
    mine = PupilSamples(*(part[used] for part in rays))
    # Lenses are spread evenly: there are as many more at a field as its circle is longer.
    weight = share[used] * np.maximum(fields[used], fields[1] / 8)
    distortion = _sharpest(mine, fields[used], weight, chief, pitch)
    radius = _from_map(mine, fields[used], chief * distortion)
    profile = np.histogram(radius, edges, weights=mine.light * weight[:, None])[0]
    profile = profile / profile.sum()
    # As pixels see it: parts of one are not told apart.
    density = np.repeat(profile.reshape(-1, _BINS).sum(1) / np.diff(edges[::_BINS] ** 2), _BINS)
    bins = np.minimum((radius / edges[1]).astype(int), density.size)
    amount = (mine.light * np.append(density, 0)[bins]).sum(1) / (profile * density).sum()
    powers = (fields[used] / outer)[:, None] ** (2 * np.arange(_DEGREE + 1))
    root = np.sqrt(weight)
    # Ridge: a ring that begins far out leaves the low powers undetermined.
    system = np.concatenate([powers * root[:, None], 1e-4 * root.max() * np.eye(_DEGREE + 1)])
    light = np.linalg.lstsq(system, np.append(amount * root, np.zeros(_DEGREE + 1)))[0]
    return distortion, light, profile


def _from_map(rays: PupilSamples, fields, magnification) -> np.ndarray:
    """Distances of the rays from where a magnification puts the spot."""
    # NumPy's `hypot` takes three times as long.
    return np.sqrt((rays.landing[..., 0] + magnification * fields[:, None]) ** 2 + rays.landing[..., 1] ** 2)


def _sharpest(rays: PupilSamples, fields, weight, chief: float, pitch: float) -> float:
    """The magnification, over the chief ray's, that gives the weighted mean of the spots the largest sum of squares."""
    rays = rays._replace(light=rays.light * weight[:, None])
    # Where pixels are large, it is found as well as if they were not.
    pitch = min(pitch, _SHARP * chief * float(np.max(fields)))

    def squares(distortion, rays=rays):
        # Shared by two rings: what is counted in one alone jumps, and rounding would decide where the largest sum is.
        place = (2 / pitch * _from_map(rays, fields, chief * distortion)).ravel()
        ring, light = place.astype(int), rays.light.ravel()
        outer = light * (place - ring)
        count = ring.max() + 2
        total = np.bincount(ring, light - outer, count) + np.bincount(ring + 1, outer, count)
        # The area that a ring's share is of, a triangle across: in the middle a cone.
        area = 2.0 * np.arange(count)
        area[0] = 1 / 3
        return -(total**2 / area).sum()

    tried = np.linspace(1 - _FARTHEST, 1 + _FARTHEST, _STEPS)
    some = PupilSamples(*(part[:, ::_SPARSE] for part in rays))
    best = int(np.argmin([squares(distortion, some) for distortion in tried]))
    return _least(squares, tried[max(best - 1, 0)], tried[min(best + 1, _STEPS - 1)])


def _least(cost: Callable[[float], float], low: float, high: float) -> float:
    """Where a cost is least between two numbers, by golden section."""
    part = (math.sqrt(5) - 1) / 2
    inner = [high - part * (high - low), low + part * (high - low)]
    costs = [cost(x) for x in inner]
    while high - low > _FINE:
        if costs[0] < costs[1]:
            high = inner[1]
            inner = [high - part * (high - low), inner[0]]
            costs = [cost(inner[0]), costs[0]]
        else:
            low = inner[0]
            inner = [inner[1], low + part * (high - low)]
            costs = [costs[1], cost(inner[1])]
    return inner[int(np.argmin(costs))]


def render_kernel(
    profile: Float64[np.ndarray, " bin"], size: int, parts: float | int = 1
) -> Float64[np.ndarray, "row column"]:
    """A kernel from its radial light, on pixels (or their `parts` each way), odd `size` in all; its sum is 1.

    Light is put down point by point, so that none is lost between the pixels; turned and mirrored, it is symmetric.
    """
    column, row = np.floor(parts * sample_profile(profile, _SAMPLES) + size / 2).astype(int).T
    inside = (row >= 0) & (row < size) & (column >= 0) & (column < size)
    light = np.bincount((row * size + column)[inside], minlength=size * size).reshape(size, size) / _SAMPLES
    light = light + light[::-1] + light[:, ::-1] + light[::-1, ::-1]
    return (light + light.T) / 8


def sample_profile(profile: Float64[np.ndarray, " bin"], count: int) -> Float64[np.ndarray, "point 2"]:
    """Points `(x, y)` in pixels that are as dense as a core is bright, along Vogel's spiral."""
    order = np.arange(count) + 0.5
    edges = np.arange(profile.size + 1) / _BINS
    radius = np.sqrt(np.interp(order / count, np.append(0, np.cumsum(profile)), edges**2))
    return radius[:, None] * np.stack([np.cos(GOLDEN_ANGLE * order), np.sin(GOLDEN_ANGLE * order)], -1)
