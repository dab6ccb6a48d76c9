"""What single lenses see of points, and whether they agree: a true emitter is seen by all of its lenses.

Back-projection adds the lenses up and cannot tell one bright pixel from many lit ones. Here they stay apart. Host
code. Images are `[row, column]`, lengths mm; what is lit is told from what is not by the image's own background and
noise, so that offset and gain of the camera do not matter.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Float64, Int, Shaped
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree
from scipy.special import bdtrc

from ..base.arrays import check_finite
from ..geometry import Imager
from ..optics.raytrace import to_numpy
from .background import between, smoothed, square_levels

# Of the Gaussian that evens out where in a pixel a spot is, pixels: most that keeps spots 2.5 pixels apart apart.
_SMOOTHING = 0.7
# The noise is taken to be this part of the brightest spot at least: images without noise, and camera steps.
_DYNAMIC_RANGE = 1000
# How far the light of a spot is followed, pixels.
REACH = 24
# Spots that are enough to show what a spot looks like.
_EXAMPLES = 500


class Signal(NamedTuple):
    """An image less its background, smoothed a little, and the noise (standard deviation) of each pixel."""

    light: Float32[np.ndarray, "row column"]
    noise: Float32[np.ndarray, "row column"]


def signal(image: Shaped[Array | np.ndarray, "row column"]) -> Signal:
    """Smooths an image a little and takes its background off; `InputError` if a pixel is not finite."""
    check_finite("image", image)
    light = smoothed(np.asarray(image), _SMOOTHING)
    background, noise = (between(levels, light.shape) for levels in square_levels(light))
    light -= background
    least = max(float(np.median(_some(noise))), float(light.max()) / _DYNAMIC_RANGE)
    return Signal(light, np.maximum(noise, least, out=noise))


class Readings(NamedTuple):
    """What lenses read of points, one row a point; where `seen` is false no lens sees it, and zeros fill the row.

    `lens_type` says of which type a lens is, if lenses differ.
    """

    pixels: Float64[np.ndarray, "point lens 2"]
    light: Float64[np.ndarray, "point lens"]
    noise: Float64[np.ndarray, "point lens"]
    field: Float64[np.ndarray, "point lens"]
    seen: Bool[np.ndarray, "point lens"]
    lens_type: Int[np.ndarray, "point lens"] | None = None


def readings(points: Float[np.ndarray, "point 3"], signal: Signal, imager: Imager) -> Readings:
    """Reads a signal where each lens within the field radius images each point `(x, y, z)`, linear between pixels.

    Returns
    -------
    Readings
        `pixels` are fractional `(row, column)`, `field` is the distance from the lens's axis, mm; lenses that
        image a point beyond the sensor do not see it.
    """
    # In NumPy: other numbers of points need no other program.
    host = to_numpy(imager)
    beside = points[:, :2] - host.axis_offset(points[:, 2])
    tree = KDTree(host.centers)
    most = max(tree.query_ball_point(beside, imager.field_radius, return_length=True), default=0)
    # With two or more there is an axis of lenses.
    distance, lens = tree.query(beside, k=max(most, 2), distance_upper_bound=imager.field_radius)
    seen = np.isfinite(distance)
    distance, lens = np.where(seen, distance, 0), np.where(seen, lens, 0)
    pixels = np.asarray(imager.sensor.to_pixels(host.views(points[:, None], lens).spot))
    seen &= ((pixels >= 0) & (pixels <= np.array(imager.sensor.shape) - 1)).all(-1)
    pixels = np.where(seen[..., None], pixels, 0)
    row, column = np.moveaxis(np.floor(pixels + 0.5).astype(int), -1, 0)
    between = map_coordinates(signal.light, np.moveaxis(pixels, -1, 0), np.float64, order=1, mode="nearest")
    light, noise = (np.where(seen, read, 0) for read in (between, signal.noise[row, column].astype(np.float64)))
    return Readings(pixels, light, noise, distance, seen)


def select_readings(readings: Readings, which) -> Readings:
    """The readings of some points, by index, slice or mask."""
    return Readings(**{name: part[which] for name, part in readings._asdict().items() if part is not None})


def agreed_level(
    light: Float[np.ndarray, "point lens"], seen: Bool[np.ndarray, "point lens"], share: float
) -> Float64[np.ndarray, " point"]:
    """The light that at least this share of a point's lenses reads, `0 < share <= 1`; -infinity without a lens."""
    count = seen.sum(1)
    highest_first = -np.sort(np.where(seen, -light, np.inf), axis=1)
    place = np.maximum(_of(share, count), 1) - 1
    return np.take_along_axis(highest_first, place[:, None], axis=1)[:, 0].astype(np.float64)


def log_false_alarms(
    level: Float[np.ndarray, " point"], count: Shaped[np.ndarray, " point"], share: float, survival, tests: int
) -> Float64[np.ndarray, " point"]:
    """How many of `tests` places would by chance be as lit as a point is, as a natural logarithm.

    The a-contrario rule of Desolneux, Moisan and Morel (Int. J. Comput. Vis. 40, 7, 2000): if `count` lenses looked at
    random pixels, `share` of them would find `level` or more with the tail probability of a binomial distribution.

    Parameters
    ----------
    level, count, share
        From `agreed_level`, with the number of lenses that see the point.
    survival
        Function from a level to the share of pixels that are as bright.
    tests
        Number of places that were tried.
    """
    with np.errstate(divide="ignore"):  # smaller than any number
        chance = np.log(bdtrc(_of(share, count) - 1, count, survival(level)))
    return np.where(count > 0, math.log(tests) + chance, np.inf)


def survival(light: Float32[np.ndarray, "row column"], least: float = -math.inf):
    """Function from a level, `least` or higher, to the share of pixels that reach it: at least one pixel's."""
    pixels = _some(light)
    # As float64, which levels are: or all of it would be converted for each of them.
    bright = np.sort(pixels[pixels >= least]).astype(np.float64)
    return lambda level: np.maximum(bright.size - np.searchsorted(bright, level), 1) / pixels.size


def spot_profile(readings: Readings, light: Float32[np.ndarray, "row column"]) -> Float64[np.ndarray, " radius"]:
    """The shape of spots as the image shows it: light at 0, 1, 2 ... pixels from the middle, which is 1.

    The median over every pixel of up to 500 spots, of the brightest points where these come first: neighbours on one
    side do not change it. It falls from 1 to 0.
    """
    offset = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1].reshape(2, -1).T
    middle = np.floor(readings.pixels + 0.5).astype(int)
    whole = ((middle >= REACH) & (middle < np.array(light.shape) - REACH)).all(-1)
    use = readings.seen & whole & (readings.light > 0)
    place = middle[use][:_EXAMPLES, None] + offset
    values = light[place[..., 0], place[..., 1]] / readings.light[use][:_EXAMPLES, None]
    radius = np.hypot(*np.moveaxis(place - readings.pixels[use][:_EXAMPLES, None], -1, 0)).round().astype(np.int8)
    profile = [np.median(some) if (some := values[radius == r]).size else 0.0 for r in range(1, REACH)]
    return np.minimum.accumulate(np.clip([1.0, *profile, 0.0], 0, 1))


def without_spots(
    light: Float32[np.ndarray, "row column"], readings: Readings, height: Float64[np.ndarray, "point lens"]
) -> Float32[np.ndarray, "row column"]:
    """The light that is left when each spot is taken away: its height times the profile of these spots."""
    profile = spot_profile(readings, light)
    side = np.arange(-REACH, REACH + 1)
    left = light.copy()
    for pixel, own in zip(readings.pixels[readings.seen], height[readings.seen], strict=True):
        place = [at + side for at in np.floor(pixel + 0.5).astype(int)]
        row, column = (at[(at >= 0) & (at < size)] for at, size in zip(place, light.shape, strict=True))
        distance = np.hypot((row - pixel[0])[:, None], column - pixel[1])
        square = left[row[0] : row[-1] + 1, column[0] : column[-1] + 1]
        square -= (max(own, 0) * np.interp(distance, np.arange(REACH + 1), profile)).astype(light.dtype)
    return left


def _some(image: Float32[np.ndarray, "row column"]) -> Float32[np.ndarray, " pixel"]:
    """A tenth of a large image tells shares of pixels well enough; a tenth of a small one would not."""
    return image.ravel()[:: max(1, min(10, image.size // 10**6))]


def _of(share: float, count: Shaped[np.ndarray, " point"]) -> Shaped[np.ndarray, " point"]:
    """A share of a number of lenses, rounded up."""
    return np.ceil(share * count - 1e-9).astype(int)
