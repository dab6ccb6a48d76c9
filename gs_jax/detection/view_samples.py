"""Samples of an image where each lens sees a point, and detection statistics of whether the lenses agree.

Back-projection sums over the lenses and cannot tell one bright pixel from many lit ones; here the views of a point stay
apart. Pixels are compared with the background and noise of the image itself, so that offset and gain of the camera do
not matter. Host code; images are `[row, column]`, lengths are in mm.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Shaped
from scipy.ndimage import label, map_coordinates
from scipy.spatial import KDTree
from scipy.special import bdtrc

from ..base.caches import cache_by_value
from ..base.typing import Image
from ..microscope.geometry import Imager
from ..microscope.grid import Grid
from ..optics.apertures import height_bands, split_groups
from ..optics.psf_core import core_distortion, core_width, type_weights
from ..optics.raytrace import to_numpy
from .background import DetectionImage, Pixels, subsample, subtract_background

# Share of its lenses that must see a point; the others may be blocked, scratched, or under a brighter point.
VIEW_SHARE = 0.7
# A view is lit where it exceeds the noise this many times.
THRESHOLD_SNR = 5.0
# Radius within which the light of a spot is followed, pixels; every third pixel beyond the second one is enough.
REACH, _DENSE = 24, 8
# Pixels this bright, relative to a spot's position, are its top; it is flat and round with so many of them, and with
# this ratio of the smaller to the larger variance of their positions.
_FLAT, _FEW, _ROUND = 0.8, 6, 0.5
# Lenses of a type see points at depths where they bring this part of the light into the core that the best type does.
_MIN_SHARPNESS = 0.5
# Depths at which sharpness is traced for statistics.
_DEPTHS = 9
# Width of the voxels that are searched first, pixels.
COARSE = 2
# Stands in files for the logarithm of 0.
_LOWEST_LOG = -999.0


class ViewSamples(NamedTuple):
    """Samples of an image at the views of points, a row for each point; where `seen` is false the others are 0.

    `pixels` are fractional `(row, column)`, `field` is the distance of the point from the lens's axis, mm, `lens_type`
    is None if all lenses are alike.
    """

    pixels: Float64[np.ndarray, "point lens 2"]
    light: Float64[np.ndarray, "point lens"]
    noise: Float64[np.ndarray, "point lens"]
    field: Float64[np.ndarray, "point lens"]
    seen: Bool[np.ndarray, "point lens"]
    lens_type: Int[np.ndarray, "point lens"] | None = None

    def select(self, which) -> "ViewSamples":
        """Samples of some points, by index, slice or mask."""
        return ViewSamples(**{name: part[which] for name, part in self._asdict().items() if part is not None})


class LensType(NamedTuple):
    """Lenses of one type, and how they image points at `depths`.

    `distortion`: that of the cores of their spots, as for `Imager.views`. `sharpness`: light in a core relative to the
    sharpest type; None if all lenses are alike.
    """

    imager: Imager
    depths: Float64[np.ndarray, " depth"]
    distortion: Float64[np.ndarray, " depth"]
    sharpness: Float64[np.ndarray, " depth"] | None = None

    def distortion_at(self, depth: Float[np.ndarray, " point"]) -> Float[np.ndarray, " point"]:
        """Distortion of points at these depths."""
        return np.interp(depth, self.depths, self.distortion)

    def sees(self, depth: Float[np.ndarray, " point"]) -> Bool[np.ndarray, " point"]:
        """Whether these lenses are among the sharp ones at each depth."""
        if self.sharpness is None:
            return np.ones(len(depth), bool)
        return np.interp(depth, self.depths, self.sharpness) >= _MIN_SHARPNESS


# Exact rays take a second: captures of a microscope share them.
@cache_by_value(maxsize=8)
def lens_types_of(imager: Imager, depths: Float64[np.ndarray, " depth"]) -> tuple[LensType, ...]:
    """Split an imager by the types of its lenses, with the sharpness of each type by exact rays."""
    imagers, groups = split_groups(imager)
    types = [LensType(lenses, depths, core_distortion(lenses, depths)) for lenses in imagers]
    if imager.array.alike:
        return tuple(types)
    bands = height_bands(imager)[[lenses[0] for lenses in groups]]
    weights = type_weights(imagers, depths, core_width(imager), bands)
    best = np.stack([weights[bands == band].max(0) for band in bands])
    return tuple(t._replace(sharpness=sharpness) for t, sharpness in zip(types, weights / best, strict=True))


def sample_views(
    points: Float[np.ndarray, "point 3"],
    image: DetectionImage,
    imager: Imager,
    distortion: Float[np.ndarray, " point"] | float = 1.0,
) -> ViewSamples:
    """Interpolate an image where each lens within the field radius images each point `(x, y, z)`.

    Lenses that image a point beyond the sensor do not see it. `distortion` is that of `Imager.views`.
    """
    # NumPy: another number of points would compile another program.
    host = to_numpy(imager)
    from_axis = points[:, :2] - host.axis_offset(points[:, 2])
    tree = KDTree(host.centers)
    most = max(tree.query_ball_point(from_axis, imager.field_radius, return_length=True), default=0)
    # k = 1 would drop the axis of lenses.
    distance, lens = tree.query(from_axis, k=max(most, 2), distance_upper_bound=imager.field_radius)
    seen = np.isfinite(distance)
    distortion = np.broadcast_to(distortion, len(points))[:, None]
    views = host.views(points[:, None], np.where(seen, lens, 0), distortion=distortion)
    pixels = np.asarray(imager.sensor.to_pixels(views.spot))
    seen &= ((pixels >= 0) & (pixels <= np.array(imager.sensor.shape) - 1)).all(-1)
    pixels = np.where(seen[..., None], pixels, 0)
    row, column = np.moveaxis(np.floor(pixels + 0.5).astype(int), -1, 0)
    interpolated = map_coordinates(image.light, np.moveaxis(pixels, -1, 0), np.float64, order=1, mode="nearest")
    light, noise = (np.where(seen, part, 0) for part in (interpolated, image.noise[row, column].astype(np.float64)))
    return ViewSamples(pixels, light, noise, np.where(seen, distance, 0), seen)


def sample_views_by_type(
    points: Float[np.ndarray, "point 3"], image: DetectionImage, lens_types: Sequence[LensType]
) -> ViewSamples:
    """Concatenate the samples by all types of lenses that are sharp at the depth of each point."""
    parts = []
    for number, lens_type in enumerate(lens_types):
        samples = sample_views(points, image, lens_type.imager, lens_type.distortion_at(points[:, 2]))
        if len(lens_types) == 1:
            return samples
        seen = samples.seen & lens_type.sees(points[:, 2])[:, None]
        light, noise = (np.where(seen, part, 0) for part in (samples.light, samples.noise))
        own_type = np.full(seen.shape, number)
        parts.append(samples._replace(light=light, noise=noise, seen=seen, lens_type=own_type))
    return ViewSamples(*(np.concatenate(columns, 1) for columns in zip(*parts, strict=True)))


def view_quantile(
    light: Float[np.ndarray, "point lens"], seen: Bool[np.ndarray, "point lens"], share: float = VIEW_SHARE
) -> Float64[np.ndarray, " point"]:
    """Largest level that at least this share of a point's views reaches, `0 < share <= 1`; -inf without a view."""
    descending = -np.sort(np.where(seen, -light, np.inf), axis=1)
    order = np.maximum(_rounded_up(share, seen.sum(1)), 1) - 1
    return np.take_along_axis(descending, order[:, None], axis=1)[:, 0].astype(np.float64)


def log_false_alarms(
    level: Float[np.ndarray, " point"],
    count: Shaped[np.ndarray, " point"],
    survival: Callable,
    tests: int,
    share: float = VIEW_SHARE,
) -> Float64[np.ndarray, " point"]:
    """Natural logarithm of the expected number of false alarms, the a-contrario rule.

    Desolneux, Moisan and Morel, Int. J. Comput. Vis. 40, 7, 2000: if `count` lenses looked at random pixels, a share of
    them would reach `level` (`view_quantile`) with the tail probability of a binomial distribution. `tests` is the
    number of hypotheses.
    """
    with np.errstate(divide="ignore"):  # a probability below the smallest number
        chance = np.log(bdtrc(_rounded_up(share, count) - 1, count, survival(level)))
    return np.where(count > 0, math.log(tests) + chance, np.inf)


def survival_function(light: Pixels, least: float = -math.inf) -> Callable:
    """Function from levels, `least` or higher, to the share of pixels that reach them: at least one pixel's share."""
    pixels = subsample(light)
    # float64 as levels are: otherwise each call would convert the whole array.
    bright = np.sort(pixels[pixels >= least]).astype(np.float64)
    return lambda level: np.maximum(bright.size - np.searchsorted(bright, level), 1) / pixels.size


def _pixels_around() -> Int[np.ndarray, "pixel 2"]:
    offset = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1].reshape(2, -1).T
    radius = np.hypot(*offset.T)
    return np.concatenate([offset[radius < _DENSE], offset[(radius >= _DENSE) & (radius < REACH)][::3]])


_AROUND = _pixels_around()


def spot_profile(
    pixels: Float64[np.ndarray, "spot 2"], height: Float64[np.ndarray, " spot"], light: Pixels
) -> Float64[np.ndarray, " radius"]:
    """Radial profile of spots of these heights at 0, 1, 2, ... pixels, from 1 down to 0.

    The median over the pixels of all spots, so that neighbours on one side do not count.
    """
    lit = height > 0
    around = np.floor(pixels[lit] + 0.5).astype(int)[:, None] + _AROUND
    inside = ((around >= 0) & (around < np.array(light.shape))).all(-1)
    row, column = around[inside].T
    values = light[row, column] / np.broadcast_to(height[lit, None], inside.shape)[inside]
    radius = np.hypot(*(around - pixels[lit, None])[inside].T).round().astype(np.int8)
    profile = [np.median(ring) if (ring := values[radius == r]).size else 0.0 for r in range(1, REACH)]
    return np.minimum.accumulate(np.clip([1.0, *profile, 0.0], 0, 1))


def subtract_spots(
    light: Pixels,
    pixels: Float64[np.ndarray, "spot 2"],
    height: Float64[np.ndarray, " spot"],
    profile: Float64[np.ndarray, " radius"],
) -> None:
    """Subtract spots of this profile from an image, in place."""
    reach = int((profile > 0).sum())
    side = np.arange(-reach, reach + 1)
    for pixel, its_height in zip(pixels, height, strict=True):
        around = [at + side for at in np.floor(pixel + 0.5).astype(int)]
        row, column = (at[(at >= 0) & (at < size)] for at, size in zip(around, light.shape, strict=True))
        if not (row.size and column.size):
            continue
        distance = np.hypot((row - pixel[0])[:, None], column - pixel[1])
        square = light[row[0] : row[-1] + 1, column[0] : column[-1] + 1]
        square -= (its_height * np.interp(distance, np.arange(REACH + 1), profile)).astype(light.dtype)


def spot_shift(
    pixels: Float64[np.ndarray, "spot 2"], height: Float64[np.ndarray, " spot"], light: Pixels
) -> Float64[np.ndarray, "2"]:
    """Distance from where spots are sampled to their middle, `(row, column)`, pixels, the same for all.

    The brightest position in a flat spot is anywhere in it. The middle is that of the pixels about as bright as this
    position in most views. There is no shift if these are few, as in sharp spots, if they are in a row, as those of two
    points, or if no spot's surroundings are on the image.
    """
    side, middle = np.arange(-_DENSE, _DENSE + 1), np.floor(pixels + 0.5).astype(int)
    use = ((middle >= _DENSE) & (middle < np.array(light.shape) - _DENSE)).all(-1) & (height > 0)
    if not use.any():
        return np.zeros(2)
    row, column = middle[use].T[:, :, None] + side
    stamp = np.median(light[row[:, :, None], column[:, None]] / height[use, None, None], 0)
    stamp[_DENSE, _DENSE] = 1
    flat = np.zeros(stamp.shape, int)
    label(stamp >= _FLAT, output=flat)
    top = np.argwhere(flat == flat[_DENSE, _DENSE])
    if len(top) < _FEW:
        return np.zeros(2)
    narrow, wide = np.linalg.eigvalsh(np.cov(top.T))
    # A ring has a dark middle.
    is_full = flat[tuple((top.mean(0) + 0.5).astype(int))] == flat[_DENSE, _DENSE]
    return top.mean(0) - _DENSE if narrow > _ROUND * wide and is_full else np.zeros(2)


class OwnLight(NamedTuple):
    """Which points are taken, the light of their views without that of the others, and an image without any of them."""

    taken: Bool[np.ndarray, " point"]
    light: Float64[np.ndarray, "taken lens"]
    rest: Pixels


def separate_points(
    samples: ViewSamples,
    light: Pixels,
    take: Callable[[int, Float64[np.ndarray, " lens"]], bool] = lambda number, left: True,
) -> OwnLight:
    """Share the light of an image among points, the brighter ones first.

    The light of a point is subtracted from the views of the others. Its spots are as high as the median over its views,
    and shaped as the median over the pixels of its own views: spots of other depths are wider or narrower, and what is
    left of a wide spot would look like a point beside it. Lenses of several types differ in height and shape.

    Parameters
    ----------
    samples
        Of candidates.
    light
        Of the image that is sampled.
    take
        Whether a candidate is a point, from its number and its light without that of the points before it.
    """
    order = np.argsort(-view_quantile(samples.light, samples.seen), kind="stable")
    spots, owner = samples.pixels[samples.seen], np.argwhere(samples.seen)
    tree = KDTree(spots)
    left, height, rest = samples.light.copy(), np.zeros_like(samples.light), light.copy()
    taken, spots_taken = np.zeros(len(left), bool), []
    for number in order.tolist():
        if not take(number, left[number]):
            continue
        taken[number], own = True, left[number].copy()
        for lenses in _lenses_by_type(samples, number):
            height[number, lenses] = high = np.full(len(lenses), max(np.median(left[number, lenses]), 0))
            pixels = samples.pixels[number, lenses]
            pixels = pixels + spot_shift(pixels, high, rest)
            profile = spot_profile(pixels, high, rest)
            spots_taken.append((number, lenses, pixels, profile))
            subtract_spots(rest, pixels, high, profile)
            for pixel, others in zip(pixels, tree.query_ball_point(pixels, REACH), strict=True):
                distance = np.hypot(*(spots[others] - pixel).T)
                left[tuple(owner[others].T)] -= high[0] * np.interp(distance, np.arange(REACH + 1), profile)
        left[number] = own - height[number]
    # Views are a little brighter or darker than their median.
    unexplained = np.maximum(left, -height)
    for number, lenses, pixels, profile in spots_taken:
        subtract_spots(rest, pixels, unexplained[number, lenses], profile)
    return OwnLight(taken, (left + height)[taken], rest)


def _lenses_by_type(samples: ViewSamples, point: int) -> list[Int[np.ndarray, " lens"]]:
    """Columns of the lenses that see a point, type by type: types differ in sharpness."""
    seen = np.flatnonzero(samples.seen[point])
    if samples.lens_type is None:
        return [seen] if seen.size else []
    of_lens = samples.lens_type[point, seen]
    return [seen[of_lens == number] for number in np.unique(of_lens)]


def median_of_type(samples: ViewSamples, point: int) -> Float64[np.ndarray, " lens"]:
    """Median light of one point over the lenses of each lens's type; 0 where unseen."""
    median = np.zeros(samples.light.shape[1])
    for lenses in _lenses_by_type(samples, point):
        median[lenses] = np.median(samples.light[point, lenses])
    return median


def _rounded_up(share: float, count: Shaped[np.ndarray, " point"]) -> Shaped[np.ndarray, " point"]:
    return np.ceil(share * count - 1e-9).astype(int)


def search_grid(imager: Imager, grid: Grid) -> Grid:
    """Coarse voxels over the sensor and the grid's depths, with a plane beyond both ends, as maxima need neighbours."""
    depths, host = np.asarray(grid.depths, np.float64), to_numpy(imager)
    near, far = depths.min(), depths.max()
    middle = (near + far) / 2
    pitch = COARSE * imager.sensor.pixel_pitch / float(host.magnification(middle))
    # A lens at the field radius sees a point move from plane to plane as from voxel to voxel.
    step = pitch * float(host.depth_in_medium(middle)) / imager.field_radius
    planes = near + step * np.arange(-1, math.ceil((far - near) / step) + 2)
    voxels = Grid.over(imager.sensor, depths=[middle], pitch=pitch)
    # The outer planes may lie behind the array's front, which a grid of one's own may not.
    return eqx.tree_at(lambda g: g.depths, voxels, jax.device_put(planes.astype(grid.depths.dtype)))


def num_hypotheses(voxels: Grid) -> int:
    """Number of positions that are told apart: voxels of one pixel."""
    return voxels.depths.size * math.prod(voxels.shape) * COARSE**3


class DetectionStats(NamedTuple):
    """Detection statistics, one entry for each point, of its own light: that of the other points is subtracted.

    `lit`, `lenses`: number of lenses that see the point above the noise, and that could. `log10_false_alarms`: expected
    number of chance points as good as this one in such a capture. `signal_to_noise`: light that 7 in 10 of the lenses
    reach, over the noise there.
    """

    lit: Int[np.ndarray, " point"]
    lenses: Int[np.ndarray, " point"]
    log10_false_alarms: Float64[np.ndarray, " point"]
    signal_to_noise: Float64[np.ndarray, " point"]


def detection_stats(
    points: Float[np.ndarray, "point 4"], image: Image | DetectionImage, imager: Imager, grid: Grid
) -> DetectionStats:
    """Compute the statistics of points that `find_points` found, with the same arguments and errors."""
    image = image if isinstance(image, DetectionImage) else subtract_background(image)
    depths = np.concatenate([np.asarray(grid.depths, np.float64), points[:, 2]])
    lens_types = lens_types_of(imager, np.linspace(depths.min(), depths.max(), _DEPTHS))
    samples = sample_views_by_type(points[:, :3], image, lens_types)
    samples = samples._replace(light=separate_points(samples, image.light).light)
    lenses, noise = samples.seen.sum(1), samples.noise.max(1, initial=0)
    level = view_quantile(samples.light, samples.seen)
    tests = num_hypotheses(search_grid(imager, grid))
    log = log_false_alarms(level, lenses, survival_function(image.light), tests) / math.log(10)
    lit = (samples.seen & (samples.light > THRESHOLD_SNR * samples.noise)).sum(1)
    signal_to_noise = np.divide(level, noise, out=np.zeros_like(level), where=noise > 0)
    return DetectionStats(lit, lenses, np.clip(log, _LOWEST_LOG, -_LOWEST_LOG), signal_to_noise)
