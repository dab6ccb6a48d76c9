"""The bright cores of a lens's spots: where they land, how bright they are, and what they look like.

With the lens's full aperture a spot is a core, a few pixels wide, in a halo that holds more than half of its light. The
core is not on the chief ray: spherical aberration and coma move it by up to a percent of its distance from the lens's
axis. Over a ring of the field that is all but a change of the magnification, which leaves the map separable in x and y.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Float64

from ..base.machine import in_threads
from ..base.progress import Progress
from ..geometry import Imager, falloff
from .light import SpotRays, Zones, mean_zones, spot_rays
from .psf import GOLDEN_ANGLE
from .theory import airy_deviation

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


class Cores(NamedTuple):
    """The cores of all rings at one depth.

    `stretch`: magnification over the chief ray's, one a ring. `light`: coefficients of `ring_light`. `profile`: light
    in radial bins of a sixteenth of a pixel, with the sum 1.
    """

    stretch: Float64[np.ndarray, " ring"]
    light: Float64[np.ndarray, "ring coefficient"]
    profile: Float64[np.ndarray, "ring bin"]


def ring_share(distance_squared, inner, outer):
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
    return value * ring_share(distance_squared, inner, outer)


def ring_edges(imager: Imager, ends: Sequence[float] = RINGS) -> list[tuple[float, float]]:
    """Inner and outer end of each ring, mm, from their ends in field radii."""
    radius = imager.field_radius
    return [(radius * float(a), radius * float(b)) for a, b in zip((0.0, *ends), ends, strict=False)]


def core_table(imager: Imager, depth: float, aperture: Zones, reach: float, ends: Sequence[float] = RINGS) -> Cores:
    """The cores at one depth, by exact rays of a mean lens.

    A ring has one kernel: the mean of its spots up to `reach` (mm) about the magnification at which that mean is the
    sharpest. Each spot counts with as much of it as explains the spot best, by least squares.
    """
    pitch = imager.sensor.pixel_pitch
    rings = ring_edges(imager, ends)
    fields = np.arange(0, rings[-1][1] * 1.06, imager.field_radius / _FIELDS)
    rays = diffracted(imager, spot_rays(imager, depth, fields, aperture, _RAYS))
    chief = float(imager.magnification(float(depth)))
    edges = np.arange(0, math.ceil(reach / pitch) * _BINS + 1) * pitch / _BINS
    parts = [_ring_cores(rays, fields, chief, pitch, edges, *ring) for ring in rings]
    return Cores(*map(np.stack, zip(*parts, strict=True)))


def core_tables(
    imager: Imager,
    depths: Float64[np.ndarray, " depth"],
    reach: float,
    ends: Sequence[float] = RINGS,
    progress: Progress | None = None,
) -> Cores:
    """The cores at some depths: `core_table` of each, with the depths first."""
    aperture = mean_zones(imager.array)
    tables = in_threads(lambda depth: core_table(imager, depth, aperture, reach, ends), depths)
    tracked = zip((progress or Progress()).track(depths, "Tracing cores"), tables, strict=True)
    return Cores(*map(np.stack, zip(*(table for _, table in tracked), strict=True)))


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
    aperture, fields = mean_zones(imager.array), np.linspace(0, imager.field_radius, _FIELDS + 1)
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


def core_shares(
    imager: Imager, depths: Float64[np.ndarray, " depth"], fields: Float64[np.ndarray, " field"], side: float
) -> Float64[np.ndarray, "depth field"]:
    """Share of a point's light that a mean lens brings into a square of this side (mm) about its spot's core."""
    aperture = mean_zones(imager.array)

    def share(depth):
        magnification, rays = _core(imager, float(depth), fields, aperture)
        away = np.abs(rays.landing + np.stack([magnification * fields, 0 * fields], -1)[:, None])
        return np.where((away < side / 2).all(-1), rays.light, 0).sum(1)

    return np.array(list(in_threads(share, depths)))


def _core(imager: Imager, depth: float, fields: Float64[np.ndarray, " field"], aperture: Zones):
    """Magnification of the bright core at one depth, and the rays of the fields that say so."""
    rays = spot_rays(imager, depth, fields, aperture, _RAYS)
    chief = float(imager.magnification(depth))
    return chief * _sharpest(rays, fields, fields, chief, imager.sensor.pixel_pitch), rays


def diffracted(imager: Imager, rays: SpotRays) -> SpotRays:
    """Rays moved at random, but always the same, by as much as the aperture diffracts: a Gaussian as wide as Airy's."""
    width = float(airy_deviation(imager.wavelength, imager.reduced_sensor_distance, imager.array.aperture_diameter))
    moves = np.random.default_rng(0).normal(0, width, rays.landing.shape[1:])
    return rays._replace(landing=rays.landing + moves)


def _ring_cores(rays, fields, chief, pitch, edges, inner, outer):
    share = np.asarray(ring_share(jnp.asarray(fields**2), inner, outer), np.float64)
    used = share > 1e-6
    mine = SpotRays(*(part[used] for part in rays))
    # Lenses are spread evenly: there are as many more at a field as its circle is longer.
    weight = share[used] * np.maximum(fields[used], fields[1] / 8)
    stretch = _sharpest(mine, fields[used], weight, chief, pitch)
    radius = _from_map(mine, fields[used], chief * stretch)
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
    return stretch, light, profile


def _from_map(rays: SpotRays, fields, magnification) -> np.ndarray:
    """Distances of the rays from where a magnification puts the spot."""
    # NumPy's `hypot` takes three times as long.
    return np.sqrt((rays.landing[..., 0] + magnification * fields[:, None]) ** 2 + rays.landing[..., 1] ** 2)


def _sharpest(rays: SpotRays, fields, weight, chief: float, pitch: float) -> float:
    """The magnification, over the chief ray's, that gives the weighted mean of the spots the largest sum of squares."""
    rays = rays._replace(light=rays.light * weight[:, None])
    # Where pixels are large, it is found as well as if they were not.
    pitch = min(pitch, _SHARP * chief * float(np.max(fields)))

    def squares(stretch, rays=rays):
        # Shared by two rings: what is counted in one alone jumps, and rounding would decide where the largest sum is.
        place = (2 / pitch * _from_map(rays, fields, chief * stretch)).ravel()
        ring, light = place.astype(int), rays.light.ravel()
        outer = light * (place - ring)
        count = ring.max() + 2
        total = np.bincount(ring, light - outer, count) + np.bincount(ring + 1, outer, count)
        # The area that a ring's share is of, a triangle across: in the middle a cone.
        area = 2.0 * np.arange(count)
        area[0] = 1 / 3
        return -(total**2 / area).sum()

    tried = np.linspace(1 - _FARTHEST, 1 + _FARTHEST, _STEPS)
    some = SpotRays(*(part[:, ::_SPARSE] for part in rays))
    best = int(np.argmin([squares(stretch, some) for stretch in tried]))
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


def drawn(profile: Float64[np.ndarray, " bin"], size: int, parts: float | int = 1) -> Float64[np.ndarray, "row column"]:
    """A kernel from its radial light, on pixels (or their `parts` each way), odd `size` in all; its sum is 1.

    Light is put down point by point, so that none is lost between the pixels; turned and mirrored, it is symmetric.
    """
    column, row = np.floor(parts * spread(profile, _SAMPLES) + size / 2).astype(int).T
    inside = (row >= 0) & (row < size) & (column >= 0) & (column < size)
    light = np.bincount((row * size + column)[inside], minlength=size * size).reshape(size, size) / _SAMPLES
    light = light + light[::-1] + light[:, ::-1] + light[::-1, ::-1]
    return (light + light.T) / 8


def spread(profile: Float64[np.ndarray, " bin"], count: int) -> Float64[np.ndarray, "point 2"]:
    """Points `(x, y)` in pixels that are as dense as a core is bright, along Vogel's spiral."""
    order = np.arange(count) + 0.5
    edges = np.arange(profile.size + 1) / _BINS
    radius = np.sqrt(np.interp(order / count, np.append(0, np.cumsum(profile)), edges**2))
    return radius[:, None] * np.stack([np.cos(GOLDEN_ANGLE * order), np.sin(GOLDEN_ANGLE * order)], -1)
