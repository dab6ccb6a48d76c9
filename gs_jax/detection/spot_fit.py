"""Positions and intensities of points, fitted to the shapes of their spots under all lenses that help.

Exact rays make the spots. In each view the light, the background and the shift of the spot are fitted to the pixels;
the shifts of all views then move the point, each weighted by its own accuracy. Lenses beyond the field radius see a
point obliquely: their spots are dark and wide, but tell its depth best. Host code.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64
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

# Field points in a field radius, rays of each, and depths.
_FIELDS, _RAYS, _DEPTHS = 6, 8192, 7
# Half the side of the window about a spot's middle that is fitted, pixels, and of its table, which is turned and moved.
_HALF, _TABLE = 5, 11
# Bins of a table in a pixel, and how far from the chief ray the middle may be, pixels.
_BINS, _FARTHEST = 2, 64
# Standard deviation of a pixel's square, pixels.
_PIXEL = math.sqrt(1 / 12)
# Lenses that hold this part of what is known of a point's depth are used.
_INFORMATION = 0.9
# Steps of the fit. A view counts if its light is within this factor of the median and its spot is at most so far from
# its place, pixels; its own error is at least so large, pixels, as no table is exact.
_STEPS, _FACTOR, _FARTHEST_SHIFT, _TABLE_ERROR = 2, 3.0, 3.0, 0.05
# Robust weights: Cauchy's, at this multiple of the spread; and how often they are renewed.
_CAUCHY, _RENEWALS = 2.0, 8
# Fewest views of a fit, and views that are fitted at once.
_MIN_VIEWS, _AT_ONCE = 3, 4096


class SpotTables(NamedTuple):
    """Spots of the mean lens, by exact rays, at some depths and fields.

    `middle`: of the core, along the field, from the chief ray, pixels. `spots`: fraction of a point's light in a pixel,
    and its derivatives along and across the field, about the middle in half pixels. `reach`: distance from a lens's
    axis, mm, within which its views are worth reading.
    """

    depths: Float64[np.ndarray, " depth"]
    step: float
    middle: Float64[np.ndarray, "depth field"]
    spots: Float[np.ndarray, "depth field derivative along across"]
    reach: float


class Fit(NamedTuple):
    """Fitted positions, mm, and intensities: all that a point emits, in the image's unit."""

    positions: Float64[np.ndarray, "point 3"]
    intensities: Float64[np.ndarray, " point"]


@cache_by_value(maxsize=8)
def spot_tables(imager: Imager, near: float, far: float) -> SpotTables:
    """Trace the spots of the mean lens between two depths, mm."""
    imager, height = imager.level()
    depths, pitch = np.linspace(near, far, _DEPTHS), imager.sensor.pixel_pitch
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
    coarse = gaussian_filter(np.histogram2d(*rays, [edges, edges], weights=light)[0], 2 * blur)
    peak = edges[np.unravel_index(coarse.argmax(), coarse.shape)[0]] + 0.5 / _BINS
    weight = light * np.exp(-((rays[0] - peak) ** 2 + rays[1] ** 2) / 8)
    middle = (weight @ rays[0]) / weight.sum()
    size = (np.arange(-_TABLE * _BINS, _TABLE * _BINS + 2) - 0.5) / _BINS
    counts = np.histogram2d(rays[0] - middle, rays[1], [size, size], weights=light)[0]
    spot = gaussian_filter(counts, blur, mode="constant") * _BINS**2
    return middle, np.stack([spot, *np.gradient(spot, 1 / _BINS)]).astype(np.float32)


def fit_points(
    points: Float[np.ndarray, "point 3"], image: DetectionImage, lens_types: Sequence[LensType]
) -> Fit:
    """Move points to where their spots are, from at most three pixels beside, and measure their light.

    A point that fewer than three lenses show keeps its position.
    """
    positions, intensities = np.array(points, np.float64), np.zeros(len(points))
    if not len(points):
        return Fit(positions, intensities)
    for _ in range(_STEPS):
        parts = [_fit_views(positions, image, lens_type) for lens_type in lens_types]
        views = _Views(*(np.concatenate(part, 1) for part in zip(*parts, strict=True)))
        move, intensities = _combine(views)
        positions += move
    return Fit(positions, intensities)


class _Views(NamedTuple):
    """Fits of the views of each point; `light` is NaN where there is none.

    `field`: distance of the point from the lens's axis, in field radii. `shift`: of a spot from its place, along and across the field, pixels. `variance`: of these. `slope`: their
    derivatives by the point's position, per mm.
    """

    light: Float64[np.ndarray, "point lens"]
    field: Float64[np.ndarray, "point lens"]
    shift: Float64[np.ndarray, "point lens 2"]
    variance: Float64[np.ndarray, "point lens 2"]
    slope: Float64[np.ndarray, "point lens 2 3"]


def _fit_views(points, image: DetectionImage, lens_type: LensType) -> _Views:
    """Fit the spots of all points under the lenses of one type."""
    imager, pitch = to_numpy(lens_type.imager), lens_type.imager.sensor.pixel_pitch
    tables = spot_tables(lens_type.imager, lens_type.depths[0], lens_type.depths[-1])
    from_axis, tree = points[:, :2] - imager.axis_offset(points[:, 2]), KDTree(imager.centers)
    most = max(tree.query_ball_point(from_axis, tables.reach, return_length=True))
    distance, lens = tree.query(from_axis, k=max(most, 2), distance_upper_bound=tables.reach)
    seen = np.isfinite(distance) & lens_type.sees(points[:, 2])[:, None]
    light, both = np.full(seen.shape, np.nan), (*seen.shape, 2)
    field = distance / float(imager.field_radius)
    views = _Views(light, field, np.zeros(both), np.ones(both), np.zeros((*both, 3)))
    point, column = np.nonzero(seen)
    for first in range(0, len(point), _AT_ONCE):
        some = point[first : first + _AT_ONCE], column[first : first + _AT_ONCE]
        at, center = points[some[0]], lens[some]
        offset = imager.views(at, center).offset
        from_lens = np.hypot(*offset.T)
        along = offset / np.maximum(from_lens, 1e-9)[:, None]
        axes = np.stack([along, along[:, ::-1] * [-1, 1]], 1)
        spot = imager.views(at, center).spot
        moved = [(imager.views(at + step, center).spot - spot) / (pitch * 1e-3) for step in 1e-3 * np.eye(3)]
        pixels = np.asarray(imager.sensor.to_pixels(spot))
        light, shift, variance = _fit_spots(pixels, axes, at[:, 2], from_lens, tables, image.light)
        slope = np.einsum("vij,kvj->vik", axes, np.stack(moved))
        for part, values in zip((views.light, *views[2:]), (light, shift, variance, slope), strict=True):
            part[some] = values
    return views


def _fit_spots(pixels, axes, depth, field, tables: SpotTables, image):
    """Light, shift and its variance of each view, by linear least squares in its window."""
    # Bilinear between the tables of neighbouring depths and fields.
    at = np.interp(depth, tables.depths, np.arange(len(tables.depths))), field / tables.step
    low = [np.minimum(x.astype(int), n - 2) for x, n in zip(at, tables.middle.shape, strict=True)]
    part = [x - lower for x, lower in zip(at, low, strict=True)]
    shares = [(i, j, abs(1 - i - part[0]) * abs(1 - j - part[1])) for i in (0, 1) for j in (0, 1)]
    middle = sum(share * tables.middle[low[0] + i, low[1] + j] for i, j, share in shares)
    spots = sum(
        share[:, None, None, None].astype(np.float32) * tables.spots[low[0] + i, low[1] + j] for i, j, share in shares
    )
    side = np.arange(-_HALF, _HALF + 1)
    core = np.floor(pixels + middle[:, None] * axes[:, 0, ::-1] + 0.5).astype(int)
    inside = ((core >= _HALF) & (core < np.array(image.shape) - _HALF)).all(-1)
    core = np.where(inside[:, None], core, _HALF)
    row, column = core[:, 0, None, None] + side[:, None], core[:, 1, None, None] + side
    data = image[row, column].reshape(len(core), -1).astype(np.float64)
    down, right = row - pixels[:, 0, None, None], column - pixels[:, 1, None, None]
    along, across = (
        _BINS * (axes[:, k, 0, None, None] * right + axes[:, k, 1, None, None] * down - start) + spots.shape[-1] // 2
        for k, start in enumerate((middle[:, None, None], 0.0))
    )
    view = np.broadcast_to(np.arange(len(core))[:, None, None], along.shape)
    place = np.stack([view, along, across]).reshape(3, -1)
    shape, d_along, d_across = (
        map_coordinates(spots[:, k], place, np.float64, order=1, mode="nearest").reshape(data.shape) for k in range(3)
    )
    # A spot that is moved by s is the spot less s times its derivative.
    columns = np.stack([shape, np.ones_like(shape), -d_along, -d_across], -1)
    scale = np.sqrt((columns**2).sum(1)) + 1e-30
    columns /= scale[:, None]
    inverse = np.linalg.inv(np.einsum("vpi,vpj->vij", columns, columns) + 1e-9 * np.eye(4))
    solution = np.einsum("vij,vpj,vp->vi", inverse, columns, data)
    noise = ((data - np.einsum("vpi,vi->vp", columns, solution)) ** 2).mean(1)
    solution /= scale
    light = np.where(inside & (solution[:, 0] > 0), solution[:, 0], np.nan)
    variance = noise[:, None] * np.diagonal(inverse, axis1=1, axis2=2)[:, 2:] / scale[:, 2:] ** 2
    return light, solution[:, 2:] / light[:, None], variance / light[:, None] ** 2


def _combine(views: _Views) -> tuple[Float64[np.ndarray, "point 3"], Float64[np.ndarray, " point"]]:
    """Movement and intensity of each point from all of its views."""
    light, inner = views.light, np.isfinite(views.light) & (views.field <= 1)
    # Beyond the field radius a field stop may take the light.
    bright = np.array([np.median(row[use]) if use.any() else 0.0 for row, use in zip(light, inner, strict=True)])
    with np.errstate(invalid="ignore"):
        good = (light > bright[:, None] / _FACTOR) & (light < bright[:, None] * _FACTOR)
        good &= (np.abs(views.shift) < _FARTHEST_SHIFT).all(-1)
    good = np.repeat(good, 2, 1)
    shift = np.where(good, views.shift.reshape(good.shape), 0)
    accuracy = np.where(good, 1 / np.sqrt(views.variance.reshape(good.shape) + _TABLE_ERROR**2), 0)
    slope = views.slope.reshape(*good.shape, 3)
    weight, move = accuracy**2, np.zeros((len(good), 3))
    for _ in range(_RENEWALS):
        normal = np.einsum("pv,pvi,pvj->pij", weight, slope, slope) + 1e-9 * np.eye(3)
        move = np.linalg.solve(normal, np.einsum("pv,pvi,pv->pi", weight, slope, shift)[..., None])[..., 0]
        error = np.abs(shift - np.einsum("pvi,pi->pv", slope, move)) * accuracy
        spread = 1.4826 * np.array([np.median(e[g]) if g.any() else 1.0 for e, g in zip(error, good, strict=True)])
        weight = accuracy**2 / (1 + (error / (_CAUCHY * np.maximum(spread, 1e-9))[:, None]) ** 2)
    return np.where(good.sum(1)[:, None] >= 2 * _MIN_VIEWS, move, 0), bright
