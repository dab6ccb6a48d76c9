"""What single lenses see of points, and whether they agree: a true emitter is seen by all of its lenses.

Back-projection adds the lenses up and cannot tell one bright pixel from many lit ones. Here they stay apart. Host
code. Images are `[row, column]`, lengths mm; what is lit is told from what is not by the image's own background and
noise, so that offset and gain of the camera do not matter.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Float64, Shaped
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import KDTree
from scipy.special import bdtrc

from ..geometry import Imager, chief_ray
from .background import local_levels

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
    """Smooths an image a little and takes its background off."""
    smooth: np.ndarray = gaussian_filter(np.asarray(image, np.float32), _SMOOTHING)
    background, noise = local_levels(smooth)
    light = smooth - background
    least = max(float(np.median(noise)), float(light.max()) / _DYNAMIC_RANGE)
    return Signal(light, np.maximum(noise, least))


class Readings(NamedTuple):
    """What lenses read of points, one row a point; where `seen` is false no lens sees it, and zeros fill the row."""

    pixels: Float64[np.ndarray, "point lens 2"]
    light: Float64[np.ndarray, "point lens"]
    noise: Float64[np.ndarray, "point lens"]
    field: Float64[np.ndarray, "point lens"]
    seen: Bool[np.ndarray, "point lens"]


def readings(points: Float[np.ndarray, "point 3"], signal: Signal, imager: Imager) -> Readings:
    """Reads a signal where each lens within the field radius images each point `(x, y, z)`, linear between pixels.

    Returns
    -------
    Readings
        `pixels` are fractional `(row, column)`, `field` is the distance from the lens's axis, mm; lenses that
        image a point beyond the sensor do not see it.
    """
    centers = np.asarray(imager.centers, np.float64)
    tree, depth = KDTree(centers), jnp.asarray(points[:, 2], imager.sensor_distance.dtype)
    beside = points[:, :2] - np.asarray(imager.lean(depth), np.float64)
    most = max(tree.query_ball_point(beside, imager.field_radius, return_length=True), default=0)
    # With two or more there is an axis of lenses.
    distance, lens = tree.query(beside, k=max(most, 2), distance_upper_bound=imager.field_radius)
    seen = np.isfinite(distance)
    distance, lens = np.where(seen, distance, 0), np.where(seen, lens, 0)
    magnification = np.asarray(imager.magnifications(depth), np.float64)
    of_each = (
        magnification[0][:, None] if len(magnification) == 1 else magnification[lens, np.arange(len(lens))[:, None]]
    )
    landing = chief_ray(centers[lens], points[:, None, :2], of_each[..., None])
    pixels = np.asarray(imager.sensor.to_pixels(landing), np.float64)
    seen &= ((pixels >= 0) & (pixels <= np.array(imager.sensor.shape) - 1)).all(-1)
    pixels = np.where(seen[..., None], pixels, 0)
    read = lambda part, order: map_coordinates(part, pixels.reshape(-1, 2).T, np.float64, order=order, mode="nearest")
    light, noise = (
        np.where(seen, read(part, order).reshape(seen.shape), 0)
        for part, order in ((signal.light, 1), (signal.noise, 0))
    )
    return Readings(pixels, light, noise, distance, seen)


def select_readings(readings: Readings, which) -> Readings:
    """The readings of some points, by index, slice or mask."""
    return Readings(*(part[which] for part in readings))


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


def survival(light: Float32[np.ndarray, "row column"]):
    """Function from a level to the share of pixels that reach it: at least one pixel's."""
    # A tenth of a large image tells the shares well enough; a tenth of a small one would not.
    pixels = np.sort(light.ravel()[:: max(1, min(10, light.size // 10**6))])
    return lambda level: np.maximum(pixels.size - np.searchsorted(pixels, level), 1) / pixels.size


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
    radius = np.hypot(*np.moveaxis(place - readings.pixels[use][:_EXAMPLES, None], -1, 0)).round().astype(int)
    profile = [np.median(some) if (some := values[radius == r]).size else 0.0 for r in range(1, REACH)]
    return np.minimum.accumulate(np.clip([1.0, *profile, 0.0], 0, 1))


def without_spots(
    light: Float32[np.ndarray, "row column"], readings: Readings, height: Float64[np.ndarray, "point lens"]
) -> Float32[np.ndarray, "row column"]:
    """The light that is left when each spot is taken away: its height times the profile of these spots."""
    profile = spot_profile(readings, light)
    side = np.arange(-REACH, REACH + 1)
    left = np.pad(light, REACH)
    for pixel, own in zip(readings.pixels[readings.seen], height[readings.seen], strict=True):
        row, column = np.floor(pixel + 0.5).astype(int)
        distance = np.hypot((row + side - pixel[0])[:, None], column + side - pixel[1])
        square = left[row : row + 2 * REACH + 1, column : column + 2 * REACH + 1]
        square -= (max(own, 0) * np.interp(distance, np.arange(REACH + 1), profile)).astype(light.dtype)
    return left[REACH:-REACH, REACH:-REACH]


def _of(share: float, count: Shaped[np.ndarray, " point"]) -> Shaped[np.ndarray, " point"]:
    """A share of a number of lenses, rounded up."""
    return np.ceil(share * count - 1e-9).astype(int)
