"""Positions and intensities of points, fitted to the shapes of their spots under all lenses that help.

Exact rays make the spots. In each view the light, the background and the shift of the spot are fitted to the pixels;
the shifts of all views then move the point, each weighted by its own accuracy. Lenses beyond the field radius see a
point obliquely: their spots are dark and wide, but tell its depth best. Host code.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import KDTree

from ..base.caches import cache_by_value
from ..base.workers import map_in_threads
from ..microscope.geometry import Imager
from ..optics.psf_core import RINGS
from ..optics.pupil import add_diffraction, aperture_profile, sample_pupil
from ..optics.raytrace import to_numpy
from .background import SMOOTHING, DetectionImage
from .view_samples import LensType

# Field points in a field radius, and rays of each. Tables are evenly spaced in the reciprocal depth, 1/mm, with a least
# and a largest number: between them spots are interpolated.
_FIELDS, _RAYS, _STEP, _LEAST, _MOST = 6, 4096, 0.0025, 6, 48
# Half the side of the window about a spot's middle that is fitted, pixels, and of its table, which is turned and moved.
_HALF, _TABLE = 5, 11
# Bins of a table in a pixel, and how far from the chief ray the middle may be, pixels.
_BINS, _FARTHEST = 2, 64
# Standard deviation of a pixel's square, pixels.
_PIXEL = math.sqrt(1 / 12)
# Lenses that hold this part of what is known of a point's depth are used.
_INFORMATION = 0.9
# Steps of the fit. A view counts if its light is within this factor of the median and its spot is at most so far from
# its place, pixels; its own error is at least so large, pixels, as no table is exact. A point is not moved by a larger
# part of its depth: few lenses side by side do not tell it.
_STEPS, _FACTOR, _FARTHEST_SHIFT, _TABLE_ERROR, _FARTHEST_MOVE = 2, 3.0, 3.0, 0.05, 0.02
# Robust weights: Cauchy's, at this multiple of the spread; and how often they are renewed.
_CAUCHY, _RENEWALS = 2.0, 8
# Fewest views of a fit, and views that are fitted at once.
_MIN_VIEWS, _AT_ONCE = 3, 1024
# Movement of a point for derivatives, mm.
_MOVE = 1e-3
# Against divisions by zero.
_TINY = 1e-30


class SpotTables(NamedTuple):
    """Spots of the mean lens, by exact rays, at some depths and fields.

    `middle`: of the core, along the field, from the chief ray, pixels. `spots`: fraction of a point's light in a pixel,
    and its derivatives along and across the field, about the middle in half pixels. `reach`: distance from a lens's
    axis, mm, within which its views are worth reading.
    """

    depths: Float64[np.ndarray, " depth"]
    step: float
    middle: Float64[np.ndarray, "depth field"]
    spots: Float32[np.ndarray, "depth field derivative along across"]
    reach: float

    def height_at(self, depth) -> Float64[np.ndarray, " point"]:
        """Mean light in the middle pixel of the spots of points at these depths, near the axis."""
        middle = self.spots.shape[-1] // 2
        return np.interp(depth, self.depths, self.spots[:, : _FIELDS + 1, 0, middle, middle].mean(1))

    def _between(self, depth, field, part: np.ndarray) -> np.ndarray:
        """Values of a table at depths and fields, bilinear between their neighbours."""
        at = np.interp(depth, self.depths, np.arange(len(self.depths))), field / self.step
        low = [np.minimum(x.astype(int), n - 2) for x, n in zip(at, part.shape, strict=False)]
        shape = -1, *[1] * (part.ndim - 2)
        down, across = ((x - lower).reshape(shape).astype(part.dtype) for x, lower in zip(at, low, strict=True))
        upper = (1 - across) * part[low[0], low[1]] + across * part[low[0], low[1] + 1]
        lower = (1 - across) * part[low[0] + 1, low[1]] + across * part[low[0] + 1, low[1] + 1]
        return (1 - down) * upper + down * lower

    def middle_at(self, depth, field) -> Float64[np.ndarray, " view"]:
        """Middle of the core of each view."""
        return self._between(depth, field, self.middle)

    def spots_at(self, depth, field, along, across) -> Float32[np.ndarray, "3 view pixel"]:
        """Spot of each view, and its derivatives, in pixels at these distances from its middle."""
        spots = self._between(depth, field, self.spots)
        view = np.broadcast_to(np.arange(len(spots))[:, None], along.shape)
        place = np.stack([view, *(_BINS * x + spots.shape[-1] // 2 for x in (along, across))])
        return np.stack([map_coordinates(spots[:, k], place, np.float32, order=1, mode="nearest") for k in range(3)])


class Fit(NamedTuple):
    """Fitted positions, mm, and intensities: all that a point emits, in the image's unit."""

    positions: Float64[np.ndarray, "point 3"]
    intensities: Float64[np.ndarray, " point"]


# Captures of a microscope share the tables of all its types of lenses.
@cache_by_value(maxsize=4)
def spot_tables(imagers: tuple[Imager, ...], near: float, far: float) -> tuple[SpotTables, ...]:
    """Trace the spots of the mean lens of each imager between two depths, mm."""
    count = min(max(math.ceil((1 / near - 1 / far) / _STEP) + 1, _LEAST), _MOST)
    depths = 1 / np.linspace(1 / near, 1 / far, count)
    return tuple(_tables(imager, depths) for imager in imagers)


def _tables(imager: Imager, depths: Float64[np.ndarray, " depth"]) -> SpotTables:
    imager, height = imager.level()
    pitch = imager.sensor.pixel_pitch
    fields = imager.field_radius * np.arange(0, RINGS[-1] + 1e-9, 1 / _FIELDS)
    aperture = aperture_profile(imager.array, by_area=False)
    edges = np.arange(-_FARTHEST * _BINS, _FARTHEST * _BINS + 1) / _BINS

    def at_depth(depth):
        depth = float(depth - height)
        rays = add_diffraction(imager, sample_pupil(imager, depth, fields, aperture, _RAYS), aperture)
        along = (rays.landing[..., 0] + float(imager.magnification(depth)) * fields[:, None]) / pitch
        across = rays.landing[..., 1] / pitch
        return zip(*map(_spot, along, across, rays.light, [edges] * len(fields)), strict=True)

    middle, spots = (np.array(part) for part in zip(*map_in_threads(at_depth, depths), strict=True))
    # What a view knows of the depth grows with its lever, squared; the number of lenses with the circle.
    information = np.cumsum((spots[:, :, 1] ** 2).sum((-2, -1)).mean(0) * fields**3)
    reach = fields[np.searchsorted(information, _INFORMATION * information[-1])]
    return SpotTables(depths, float(fields[1]), middle, spots, max(float(reach), imager.field_radius))


def _spot(along, across, light, edges):
    """Middle of one spot's core, and the spot about it as smoothed pixels see it."""
    rays, light = np.stack([np.tile(along, 2), np.concatenate([across, -across])]), np.tile(light / 2, 2)
    blur = _BINS * math.hypot(SMOOTHING, _PIXEL)
    coarse = gaussian_filter(np.histogram2d(rays[0], rays[1], [edges, edges], weights=light)[0], 2 * blur)
    peak = edges[np.unravel_index(coarse.argmax(), coarse.shape)[0]] + 0.5 / _BINS
    weight = light * np.exp(-((rays[0] - peak) ** 2 + rays[1] ** 2) / 8)
    middle = (weight @ rays[0]) / weight.sum()
    size = (np.arange(-_TABLE * _BINS, _TABLE * _BINS + 2) - 0.5) / _BINS
    counts = np.histogram2d(rays[0] - middle, rays[1], [size, size], weights=light)[0]
    spot = gaussian_filter(counts, blur, mode="constant") * _BINS**2
    return middle, np.stack([spot, *np.gradient(spot, 1 / _BINS)]).astype(np.float32)


def fit_points(
    points: Float[np.ndarray, "point 3"],
    brightness: Float[np.ndarray, " point"],
    image: DetectionImage,
    lens_types: Sequence[LensType],
) -> Fit:
    """Move points to where their spots are, from at most three pixels beside, and measure their light.

    The spots of all other points are subtracted from those of a point. `brightness` is about that of the middle of a
    point's spots. A point that fewer than three lenses show keeps its position.
    """
    positions = np.array(points, np.float64)
    if not len(positions):
        return Fit(positions, np.zeros(0))
    ends = float(lens_types[0].depths[0]), float(lens_types[0].depths[-1])
    tables = spot_tables(tuple(one.imager for one in lens_types), *ends)
    sharp = np.stack([one.sees(positions[:, 2]) for one in lens_types])
    heights = np.stack([one.height_at(positions[:, 2]) for one in tables])
    intensities = brightness / (np.maximum((sharp * heights).sum(0), _TINY) / np.maximum(sharp.sum(0), 1))
    for _ in range(_STEPS):
        views = [_find_views(positions, *pair, image.light.shape) for pair in zip(lens_types, tables, strict=True)]
        rest = image.light.copy()
        for one in views:
            np.subtract.at(rest, one.pixels, intensities[one.point, None].astype(np.float32) * one.spot[0])
        fits = [_fit_views(rest, one, intensities) for one in views]
        fits = map(np.concatenate, zip(*fits, strict=True))
        move, intensities = _combine(positions, intensities, *fits)
        positions += move
    return Fit(positions, intensities)


class _Views(NamedTuple):
    """Views of points: where, and what is expected there.

    `point`: its number. `is_inner`: whether the lens is within the field radius. `slope`: derivatives of the spot's
    place along and across the field by the point's position, pixels per mm. `pixels`: row and column of each pixel of
    the window. `spot`: light of a point of intensity 1 in them, and its derivatives along and across the field.
    """

    point: Int[np.ndarray, " view"]
    is_inner: Bool[np.ndarray, " view"]
    slope: Float64[np.ndarray, "view 2 3"]
    pixels: tuple[Int[np.ndarray, "view pixel"], Int[np.ndarray, "view pixel"]]
    spot: Float32[np.ndarray, "3 view pixel"]


def _find_views(points, lens_type: LensType, tables: SpotTables, shape: tuple[int, int]) -> _Views:
    """Views of all points by the lenses of one type whose windows are on the image."""
    imager, pitch = to_numpy(lens_type.imager), lens_type.imager.sensor.pixel_pitch
    from_axis, tree = points[:, :2] - imager.axis_offset(points[:, 2]), KDTree(imager.centers)
    lenses = tree.query_ball_point(from_axis, tables.reach)
    point = np.repeat(np.arange(len(points)), [len(near) for near in lenses])
    lens = np.concatenate(lenses).astype(int)
    sharp = lens_type.sees(points[:, 2])[point]
    point, lens = point[sharp], lens[sharp]
    at, views = points[point], imager.views(points[point], lens)
    field = np.hypot(*views.offset.T)
    # On a lens's axis any direction will do.
    along = np.where(field[:, None] > 0, views.offset / np.maximum(field, _TINY)[:, None], [1.0, 0.0])
    axes = np.stack([along, along[:, ::-1] * [-1, 1]], 1)
    moved = [(imager.views(at + move, lens).spot - views.spot) / _MOVE for move in _MOVE * np.eye(3)]
    slope = np.einsum("vij,kvj->vik", axes, np.stack(moved)) / pitch
    place, middle = np.asarray(imager.sensor.to_pixels(views.spot)), tables.middle_at(at[:, 2], field)
    core = np.floor(place + middle[:, None] * axes[:, 0, ::-1] + 0.5).astype(int)
    use = ((core >= _HALF) & (core < np.array(shape) - _HALF)).all(-1)
    point, field, slope, axes, place, middle, core, depth = (
        part[use] for part in (point, field, slope, axes, place, middle, core, at[:, 2])
    )
    side = np.mgrid[-_HALF : _HALF + 1, -_HALF : _HALF + 1].reshape(2, 1, -1)
    row, column = core.astype(np.int32).T[:, :, None] + side.astype(np.int32)
    down, right = row - place[:, :1], column - place[:, 1:]
    along = axes[:, 0, :1] * right + axes[:, 0, 1:] * down - middle[:, None]
    across = axes[:, 1, :1] * right + axes[:, 1, 1:] * down
    spot = np.empty((3, *row.shape), np.float32)

    def fill(some: slice) -> None:
        spot[:, some] = tables.spots_at(depth[some], field[some], along[some], across[some])

    list(map_in_threads(fill, _parts(len(point))))
    return _Views(point, field <= float(imager.field_radius), slope, (row, column), spot)


def _fit_views(rest, views: _Views, intensities):
    """Light, shift along and across the field, and its variance, of each view by linear least squares."""

    def fit(some: slice) -> tuple[np.ndarray, ...]:
        expected = intensities[views.point[some], None] * views.spot[0, some]
        data = rest[tuple(part[some] for part in views.pixels)] + expected
        return _least_squares(data, *views.spot[:, some].astype(np.float64))

    fits = zip(*map_in_threads(fit, _parts(len(views.point))), strict=True)
    return views.point, views.is_inner, views.slope, *map(np.concatenate, fits)


def _parts(count: int) -> list[slice]:
    """Views that are computed at once, a part at least."""
    return [slice(first, first + _AT_ONCE) for first in range(0, max(count, 1), _AT_ONCE)]


def _least_squares(data, shape, d_along, d_across):
    # A spot that is moved by s is the spot less s times its derivative.
    columns = np.stack([shape, np.ones_like(shape), -d_along, -d_across], -1)
    scale = np.sqrt((columns**2).sum(1)) + _TINY
    columns /= scale[:, None]
    inverse = np.linalg.inv(np.einsum("vpi,vpj->vij", columns, columns) + 1e-9 * np.eye(4))
    solution = np.einsum("vij,vpj,vp->vi", inverse, columns, data)
    noise = ((data - np.einsum("vpi,vi->vp", columns, solution)) ** 2).mean(1)
    solution /= scale
    light = np.where(solution[:, 0] > 0, solution[:, 0], np.nan)
    variance = noise[:, None] * np.diagonal(inverse, axis1=1, axis2=2)[:, 2:] / scale[:, 2:] ** 2
    return light, solution[:, 2:] / light[:, None], variance / light[:, None] ** 2


def _combine(positions, intensities, point, is_inner, slope, light, shift, variance):
    """Movement and intensity of each point from all of its views; without any it keeps its own."""
    move, intensities = np.zeros(positions.shape), intensities.copy()
    order = np.argsort(point, kind="stable")
    numbers, first = np.unique(point[order], return_index=True)
    for number, mine in zip(numbers, np.split(order, first[1:]) if len(first) else [], strict=True):
        lit = mine[np.isfinite(light[mine])]
        # Beyond the field radius a field stop may take the light.
        inner = light[lit[is_inner[lit]]]
        if not inner.size:
            continue
        intensities[number] = np.median(inner)
        ratio = light[lit] / intensities[number]
        good = lit[(ratio > 1 / _FACTOR) & (ratio < _FACTOR) & (np.abs(shift[lit]) < _FARTHEST_SHIFT).all(-1)]
        if len(good) >= _MIN_VIEWS:
            accuracy = 1 / np.sqrt(variance[good].ravel() + _TABLE_ERROR**2)
            found = _robust_solution(slope[good].reshape(-1, 3), shift[good].ravel(), accuracy)
            if np.abs(found).max() <= _FARTHEST_MOVE * positions[number, 2]:
                move[number] = found
    return move, intensities


def _robust_solution(matrix, values, accuracy):
    """Least squares whose weights fall with the error, by Cauchy's function."""
    weight = accuracy
    solution = np.zeros(3)
    for _ in range(_RENEWALS):
        solution = np.linalg.lstsq(weight[:, None] * matrix, weight * values)[0]
        error = np.abs(values - matrix @ solution) * accuracy
        spread = max(1.4826 * float(np.median(error)), 1e-9)
        weight = accuracy / np.sqrt(1 + (error / (_CAUCHY * spread)) ** 2)
    return solution
