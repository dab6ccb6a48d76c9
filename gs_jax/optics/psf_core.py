"""The bright core of a lens's spot: where it lands, how bright it is, its shape and its kernels. Host code.

With the lens's full aperture a spot is a core, a few pixels wide, in stray light that holds more than half of its
energy. Spherical aberration and coma move the core off the chief ray by up to a percent of its distance from the lens's
axis. Over a ring of the field that is nearly a change of the magnification, which keeps the map separable in x and y.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float, Float64

from ..base.arrays import array_namespace
from ..base.caches import cache_by_value
from ..base.errors import InputWarning
from ..base.progress import Progress
from ..base.workers import map_in_threads
from ..microscope.geometry import Imager, falloff
from ..microscope.grid import Grid
from .apertures import split_groups
from .pupil import ApertureProfile, PupilSamples, add_diffraction, aperture_profile, sample_pupil, vogel_spiral
from .raytrace import to_numpy

# Outer radii of the rings of the field, in field radii. Farther out cores are as wide as the pixels of stray light.
RINGS = (1.0, 1.33, 1.67, 2.0, 2.5, 3.0)
# Degree of a ring's light in the squared field; field points in a field radius, and rays of each.
_DEGREE, _FIELDS, _RAYS = 6, 16, 8192
# Search of the magnification: largest difference to the chief ray's, coarse steps, the fraction of the rays that these
# use, and the final step (a twentieth of a pixel where cores are farthest from the axis).
_FARTHEST, _STEPS, _SPARSE, _FINE = 0.08, 81, 8, 1e-4
# Spots are blurred by a square of so many pixels before their sharpness is judged: it is as wide as a voxel's image.
_BLUR = 3.0
# Largest pixel by which sharpness is judged, in images of the widest field; depths traced before interpolating.
_SHARP, _MOST = 0.006, 9
# Samples of a rendered kernel.
_SAMPLES = 2**15
# Smallest fraction of a spot's light in its core for finding points. The paper's microscope has 21 to 51 % in focus,
# over 18 to 22 mm, and 1 % with its sensor at 4 mm; its first lenses on pixels three times as wide have 6 % there, and
# show one of three points.
MIN_SHARPNESS = 0.08
# Half the side of the square that collects a core's light, in pixels, and fields at which that is computed.
HALF_SIDE, FIELDS = 3, 17
# Angular harmonics m of oriented cores: coma, astigmatism.
HARMONICS = (1, 2)
# Radial bins in a pixel, which are fine beside the nodes of stray light.
BINS = 16


class PsfCores(NamedTuple):
    """The cores of all rings at one depth, or with a leading axis at several.

    `distortion`: magnification over the chief ray's. `light`: coefficients of `ring_light`. `profile`: light in radial
    bins of a sixteenth of a pixel, with the sum 1. `harmonics`: in the same bins, the amplitudes of `cos(m t)`, where
    `t` is the angle from the direction of the field, at the outer end of the ring; within it they are proportional to
    the m-th power of the field. Those of `HARMONICS`, or none.
    """

    distortion: Float64[np.ndarray, "*depth ring"]
    light: Float64[np.ndarray, "*depth ring coefficient"]
    profile: Float64[np.ndarray, "*depth ring bin"]
    harmonics: Float64[np.ndarray, "*depth ring order bin"]


def ring_window(distance_squared, inner, outer):
    """1 within a ring of the field, with the envelope's smooth falloff at both ends; all rings add up to a disc."""
    # The ends may be traced; a disc has no falloff inside.
    xp = array_namespace(distance_squared)
    hole = falloff(distance_squared, xp.where(inner > 0, inner, 1.0))
    return falloff(distance_squared, outer) - xp.where(inner > 0, hole, 0)


def ring_light(distance_squared, coefficients, inner, outer):
    """Light of a ring's cores at a squared field, mm^2: a polynomial within the ring.

    `coefficients` `(..., coefficient)` broadcast, but for the last axis, against `distance_squared`.
    """
    # Beyond the ring, where it does not count, a polynomial would overflow.
    t = array_namespace(distance_squared).minimum(distance_squared / outer**2, 2)
    value = coefficients[..., -1]
    for power in range(coefficients.shape[-1] - 2, -1, -1):
        value = value * t + coefficients[..., power]
    return value * ring_window(distance_squared, inner, outer)


def ring_edges(imager: Imager, ends: Sequence[float] = RINGS) -> list[tuple[float, float]]:
    """Inner and outer radius of each ring, mm, from the outer ones in field radii."""
    radius = imager.field_radius
    return [(radius * float(a), radius * float(b)) for a, b in zip((0.0, *ends), ends, strict=False)]


def trace_cores(
    imager: Imager,
    depths: Float64[np.ndarray, " depth"],
    reach: float,
    ends: Sequence[float] = RINGS,
    progress: Progress | None = None,
    *,
    oriented: bool = False,
) -> PsfCores:
    """The cores of the mean lens at some depths, by exact rays.

    Each ring has one kernel: the mean of its spots up to `reach` (mm), about the magnification at which that mean is
    the sharpest. The light of each spot in it is a least-squares fit. `ends` are outer radii of the rings, in field
    radii. Cores that are `oriented` have harmonics.
    """
    imager, height = imager.level()
    depths = depths - float(height)
    aperture = aperture_profile(imager.array, by_area=False)
    tables = map_in_threads(lambda depth: _cores_at_depth(imager, depth, aperture, reach, ends, oriented), depths)
    tracked = zip((progress or Progress()).track(depths, "Tracing cores"), tables, strict=True)
    return PsfCores(*map(np.stack, zip(*(table for _, table in tracked), strict=True)))


def _cores_at_depth(imager: Imager, depth: float, aperture: ApertureProfile, reach: float, ends, oriented) -> PsfCores:
    pitch = imager.sensor.pixel_pitch
    rings = ring_edges(imager, ends)
    fields = np.arange(0, rings[-1][1] * 1.06, imager.field_radius / _FIELDS)
    rays = add_diffraction(imager, sample_pupil(imager, depth, fields, aperture, _RAYS), aperture)
    chief = float(imager.magnification(float(depth)))
    edges = np.arange(0, math.ceil(reach / pitch) * BINS + 1) * pitch / BINS
    parts = [_ring_core(rays, fields, chief, pitch, edges, oriented, *ring) for ring in rings]
    return PsfCores(*map(np.stack, zip(*parts, strict=True)))


def _ring_core(rays, fields, chief, pitch, edges, oriented, inner, outer):
    """Distortion, light coefficients, radial profile and harmonics of one ring."""
    share = ring_window(fields**2, inner, outer)
    used = share > 1e-6
    mine = PupilSamples(*(part[used] for part in rays))
    # Lenses are spread evenly: their number at a field is proportional to the circle's length.
    weight = share[used] * np.maximum(fields[used], fields[1] / 8)
    distortion = _sharpest(mine, fields[used], weight, chief, pitch)
    radius = _distance_from_core(mine, fields[used], chief * distortion)
    count = edges.size - 1
    bins = np.minimum((radius / edges[1]).astype(int), count)
    histogram = lambda light: np.bincount(bins.ravel(), light.ravel(), count + 1)[:count]
    profile = histogram(mine.light * weight[:, None])
    profile = profile / profile.sum()
    # As pixels see it: without differences within a pixel.
    density = np.repeat(profile.reshape(-1, BINS).sum(1) / np.diff(edges[::BINS] ** 2), BINS)
    amount = (mine.light * np.append(density, 0)[bins]).sum(1) / (profile * density).sum()
    powers = (fields[used] / outer)[:, None] ** (2 * np.arange(_DEGREE + 1))
    root = np.sqrt(weight)
    # Ridge regression: a ring that begins far out leaves the low powers undetermined.
    system = np.concatenate([powers * root[:, None], 1e-4 * root.max() * np.eye(_DEGREE + 1)])
    light = np.linalg.lstsq(system, np.append(amount * root, np.zeros(_DEGREE + 1)))[0]
    if not oriented:
        return distortion, light, profile, np.zeros((0, profile.size))
    angle = np.arctan2(mine.landing[..., 1], mine.landing[..., 0] + chief * distortion * fields[used][:, None])
    harmonics = []
    for order in HARMONICS:
        # Least squares of what grows as this power of the field.
        field = (fields[used] / outer) ** order
        waves = mine.light * np.cos(order * angle) * (2 * weight * field)[:, None]
        harmonics.append(histogram(waves) / (weight * field**2 @ amount))
    return distortion, light, profile, _positive_spots(profile, np.array(harmonics))


def _positive_spots(profile, harmonics):
    """Harmonics, smaller where the spot would be negative: Richardson-Lucy's ratios suppose that it is not."""
    waves = np.cos(np.outer(HARMONICS, np.linspace(0, np.pi, 33)))
    lowest = (harmonics.T @ waves).min(-1)
    return harmonics * np.minimum(1, np.divide(profile, -lowest, out=np.ones_like(profile), where=lowest < 0))


def core_magnification(imager: Imager, depths: Float[ArrayLike, " depth"]) -> Float64[np.ndarray, " depth"]:
    """Magnification of the core, by exact rays within the field radius; a constant to derivatives.

    The chief ray's is `M_z = v/z'` (Eq. 3); the authors' lenses have 0.4 % less to 0.8 % more, by depth. It is that of
    the lenses' mean height if the array is tilted.
    """
    imager, height = imager.level()
    depths = np.asarray(depths, np.float64) - float(height)
    if np.unique(depths).size > _MOST:
        # Imported here, as few depths are traced without SciPy, whose import takes long.
        from scipy.interpolate import CubicSpline

        some = np.linspace(depths.min(), depths.max(), _MOST)
        reduced = to_numpy(imager).reduced_depth
        return CubicSpline(some, core_magnification(imager, some) * reduced(some))(depths) / reduced(depths)
    aperture, fields = aperture_profile(imager.array, by_area=False), np.linspace(0, imager.field_radius, _FIELDS + 1)
    return np.array(list(map_in_threads(lambda depth: _core(imager, float(depth), fields, aperture)[0], depths)))


def core_distortion(imager: Imager, depths: Float[ArrayLike, " depth"]) -> Float64[np.ndarray, " depth"]:
    """Magnification of the core over the chief ray's: the `distortion` of `Imager.views`, a constant to derivatives.

    The authors' lenses, focused on 20 mm, would show points 0.16 mm too near at 18 mm without it, and 0.09 mm too far
    at 22 mm.
    """
    imager, height = imager.level()
    depths = np.asarray(depths, np.float64) - float(height)
    return core_magnification(imager, depths) / to_numpy(imager).magnification(depths)


def ensquared_light(
    imager: Imager, depths: Float64[np.ndarray, " depth"], fields: Float64[np.ndarray, " field"], side: float
) -> Float64[np.ndarray, "depth field"]:
    """Fraction of a point's light that the mean lens brings into a square of this side (mm) about the core."""
    imager, height = imager.level()
    depths = depths - float(height)
    aperture = aperture_profile(imager.array, by_area=False)

    def share(depth):
        magnification, rays = _core(imager, float(depth), fields, aperture)
        away = np.abs(rays.landing + np.stack([magnification * fields, 0 * fields], -1)[:, None])
        return np.where((away < side / 2).all(-1), rays.light, 0).sum(1)

    return np.array(list(map_in_threads(share, depths)))


def _core(imager: Imager, depth: float, fields: Float64[np.ndarray, " field"], aperture: ApertureProfile):
    rays = sample_pupil(imager, depth, fields, aperture, _RAYS)
    chief = float(imager.magnification(depth))
    return chief * _sharpest(rays, fields, fields, chief, imager.sensor.pixel_pitch), rays


def _distance_from_core(rays: PupilSamples, fields, magnification) -> np.ndarray:
    # NumPy's `hypot` takes three times as long.
    return np.sqrt((rays.landing[..., 0] + magnification * fields[:, None]) ** 2 + rays.landing[..., 1] ** 2)


def _sharpest(rays: PupilSamples, fields, weight, chief: float, pitch: float) -> float:
    """Distortion at which the weighted mean of the spots, blurred, has the largest sum of squares."""
    # A spot with coma is brightest beside the middle of its light: by less than a pixel, which is 0.1 mm in depth.
    blur = np.random.default_rng(0).uniform(-_BLUR / 2, _BLUR / 2, rays.landing.shape) * pitch
    # Large pixels find the maximum as well as small ones.
    pitch = min(pitch, _SHARP * chief * float(np.max(fields)))
    x, y = np.moveaxis(2 / pitch * (rays.landing + blur), -1, 0)
    moved = np.broadcast_to(2 / pitch * chief * fields[:, None], x.shape)
    all_rays = x, moved, y * y, rays.light * weight[:, None]

    def cost(distortion, x, moved, square, light):
        # In place, as this takes most of the time of the tables.
        place = distortion * moved
        place += x
        place *= place
        place += square
        np.sqrt(place, out=place)
        # Light is shared by two rings: counts of single rings would jump, and rounding would move the maximum.
        ring = place.astype(int)
        place -= ring
        place *= light
        count = ring.max() + 2
        total, outer = np.bincount(ring, light, count), np.bincount(ring, place, count)
        total -= outer
        total[1:] += outer[:-1]
        # Area under a ring's triangular weight; in the middle a cone.
        area = 2.0 * np.arange(count)
        area[0] = 1 / 3
        return -(total**2 / area).sum()

    tried = np.linspace(1 - _FARTHEST, 1 + _FARTHEST, _STEPS)
    some = [part[:, ::_SPARSE].ravel() for part in all_rays]
    best = int(np.argmin([cost(distortion, *some) for distortion in tried]))
    every = [part.ravel() for part in all_rays]
    ends = tried[max(best - 1, 0)], tried[min(best + 1, _STEPS - 1)]
    return _golden_section(lambda distortion: cost(distortion, *every), *ends)


def _golden_section(cost: Callable[[float], float], low: float, high: float) -> float:
    """Minimum of a cost between two numbers, to `_FINE`."""
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


def half_light_radii(cores: PsfCores) -> Float64[np.ndarray, " ring"]:
    """Radius that holds half of the light of each ring's cores, in pixels, at the depth where it is least."""
    return (np.cumsum(cores.profile, -1) < 0.5).sum(-1).min(0) / BINS


def sample_profile(profile: Float64[np.ndarray, " bin"], count: int) -> Float64[np.ndarray, "point 2"]:
    """Points `(x, y)` in pixels whose density follows a core's profile."""
    order = np.arange(count) + 0.5
    edges = np.arange(profile.size + 1) / BINS
    radius = np.sqrt(np.interp(order / count, np.append(0, np.cumsum(profile)), edges**2))
    return radius[:, None] * _directions(count)


@lru_cache(maxsize=3)
def _directions(count: int) -> Float64[np.ndarray, "point 2"]:
    """Those of a spiral, the same for all profiles."""
    return vogel_spiral(np.ones(count), np.arange(count) + 0.5)


def harmonic_shares(
    points: Float64[np.ndarray, "point 2"],
    profile: Float64[np.ndarray, " bin"],
    harmonics: Float64[np.ndarray, "order bin"],
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The cosine and the sine of each harmonic at points of `sample_profile`, relative to the profile there."""
    bins = np.minimum((np.hypot(*points.T) * BINS).astype(int), profile.size - 1)
    ratios = np.divide(harmonics, profile, out=np.zeros_like(harmonics), where=profile > 0)
    angle = np.arctan2(*points.T[::-1])
    return [
        (ratio[bins] * np.cos(m * angle), ratio[bins] * np.sin(m * angle))
        for m, ratio in zip(HARMONICS[: len(ratios)], ratios, strict=True)
    ]


def render_kernel(
    profile: Float64[np.ndarray, " bin"], size: int, parts: float | int = 1
) -> Float64[np.ndarray, "row column"]:
    """Symmetric kernel with a radial profile, on `size` x `size` (odd) pixels or `parts` of a pixel, with the sum 1."""
    points = sample_profile(profile, _SAMPLES)
    (light,) = _on_pixels(points, [np.full(_SAMPLES, 1 / _SAMPLES)], size, parts)
    light = light + light[::-1] + light[:, ::-1] + light[::-1, ::-1]
    return (light + light.T) / 8


def render_harmonics(
    profile: Float64[np.ndarray, " bin"],
    harmonics: Float64[np.ndarray, "order bin"],
    size: int,
    parts: float | int = 1,
) -> Float64[np.ndarray, "wave row column"]:
    """Kernels of a core's harmonics on such pixels as `render_kernel`'s, for each order a cosine's and a sine's."""
    points = sample_profile(profile, _SAMPLES // 8)
    kernels = []
    # The points, and those in the other seven octants: both waves change their signs, or each other's places.
    for order, both in zip(HARMONICS, harmonic_shares(points, profile, harmonics), strict=False):
        cosine, sine = (
            wave + up * wave[::-1] + left * wave[:, ::-1] + up * left * wave[::-1, ::-1]
            for wave, up, left in zip(
                _on_pixels(points, both, size, parts), (1, -1), ((-1) ** order, -((-1) ** order)), strict=True
            )
        )
        kernels += [cosine + sine.T, sine + cosine.T] if order % 2 else [cosine - cosine.T, sine + sine.T]
    return np.reshape(kernels, (-1, size, size)) / _SAMPLES


def _on_pixels(points, waves, size, parts):
    """Sums of each wave's values at points, on the pixels around the middle."""
    column, row = np.floor(parts * points + size / 2).astype(int).T
    inside = (row >= 0) & (row < size) & (column >= 0) & (column < size)
    place = (row * size + column)[inside]
    return [np.bincount(place, wave[inside], size * size).reshape(size, size) for wave in waves]


def narrow_kernel(kernel: Float64[np.ndarray, "row column"], variance: float) -> Float64[np.ndarray, "row column"]:
    """Subtract a variance in squared pixels, each way, from a kernel; what would be negative is zero."""
    kernel = np.maximum(sharpen(kernel, variance), 0)
    return kernel / kernel.sum()


def sharpen(
    kernels: Float64[np.ndarray, "*wave row column"], variance: float
) -> Float64[np.ndarray, "*wave row column"]:
    """Subtract a variance in squared pixels, each way, from kernels that may be negative."""
    for axis in (-2, -1):
        around = np.roll(kernels, 1, axis) + np.roll(kernels, -1, axis)
        kernels = kernels - variance / 2 * (around - 2 * kernels)
    return kernels


def type_weights(
    imagers: Sequence[Imager], depths: Float64[np.ndarray, " depth"], side: float, bands: ArrayLike | None = None
) -> Float64[np.ndarray, "type depth"]:
    """Weights of the types in a sum over the lenses, at each depth; their mean over the lenses of each band is 1.

    Matched filter: a point of brightness a gives the pixel that lens j reads for its voxel `y_j = s_j a + noise`, and
    of all sums `w_j y_j` that with `w_j = s_j / var_j` has the largest signal over noise. The variance (camera, and
    light of all voxels) is about the same under every lens, so the weight is `s_j`: the fraction of the point's light
    in a square of `side` (mm, on the sensor) about the core, by exact rays over the field. `imagers` are
    `split_by_type`'s. Lenses of other bands of height see other points, and are not compared.
    """
    fields = np.linspace(0, imagers[0].field_radius, FIELDS)
    # Lenses are spread evenly: their number at a field is proportional to the circle's length.
    signal = np.stack([ensquared_light(one, depths, fields, side) @ fields for one in imagers])
    count = np.array([len(one.array.centers) for one in imagers], np.float64)
    same = np.equal.outer(*2 * (np.zeros(len(imagers)) if bands is None else np.asarray(bands),)) * count
    mean = same @ signal / same.sum(1, keepdims=True)
    return np.divide(signal, mean, out=np.ones_like(signal), where=mean > 0)


def core_width(imager: Imager) -> float:
    """Side of the square that collects a core's light, mm."""
    return (2 * HALF_SIDE + 1) * imager.sensor.pixel_pitch


# Captures of a microscope share it.
@cache_by_value(maxsize=8)
def sharpness(imager: Imager, grid: Grid) -> float:
    """Fraction of a spot's light in its core, for lenses within the field radius: the least over the grid's depths.

    By exact rays, for the sharpest type at each depth. Below `MIN_SHARPNESS` bright places are caustics, not points.
    """
    depths = np.asarray(grid.depths, np.float64)
    depths = np.unique([depths.min(), depths.max()])
    fields = np.linspace(0, imager.field_radius, FIELDS)
    each = split_groups(imager)[0]
    light = lambda one, side: ensquared_light(one, depths, fields, side) @ fields
    core = core_width(imager)
    return float(np.max([light(one, core) / light(one, math.inf) for one in each], 0).min())


def blur_warning(fraction: float, what: str, then: str) -> str | None:
    """Text for a `sharpness` below `MIN_SHARPNESS`: `what` needs more, else `then`; None if it is sharp enough."""
    if fraction >= MIN_SHARPNESS:
        return None
    share = f"{fraction:.1%} of a spot's light falls into its core"
    return f"out of focus at these depths: {share}, where {what} need {MIN_SHARPNESS:.0%}; {then}"


def warn_if_blurred(imager: Imager, grid: Grid, what: str, then: str) -> None:
    """Issue `blur_warning` as an `InputWarning`."""
    if text := blur_warning(sharpness(imager, grid), what, then):
        warnings.warn(text, InputWarning, stacklevel=3)
