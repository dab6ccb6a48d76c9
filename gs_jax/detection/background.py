"""Background, noise and smoothing of an image. Filters work on bands of rows, which fit into the CPU cache."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Float32, Shaped

from ..base.arrays import array_namespace, check_finite
from ..base.errors import input_error
from ..base.typing import Image
from ..base.workers import map_in_threads

# Side of a tile with one background and one noise level, pixels: wider than a spot, narrower than haze. A band has as
# many rows.
_TILE = 32
# Half width of the Gaussian kernel in standard deviations.
_TRUNCATE = 4
# Smoothing before points are looked for, pixels: spots 2.5 pixels apart still have two maxima.
SMOOTHING = 0.7
# Least noise, relative to the brightest spot: for images without noise, and for the steps of the camera's counts.
_DYNAMIC_RANGE = 1000

Pixels = Float32[np.ndarray, "row column"]


class DetectionImage(NamedTuple):
    """An image less its background, slightly smoothed, and the standard deviation of the noise of each pixel."""

    light: Pixels
    noise: Pixels


def subtract_background(image: Image) -> DetectionImage:
    """Smooth an image slightly and subtract its background; `InputError` if a pixel is not real and finite."""
    if np.iscomplexobj(image):
        raise input_error("image", "real", "complex numbers")
    check_finite("image", image)
    light = gaussian_smooth(np.asarray(image), SMOOTHING)
    background, noise = (interpolate_tiles(tiles, light.shape) for tiles in background_tiles(light))
    light -= background
    least = max(float(np.median(subsample(noise))), float(light.max()) / _DYNAMIC_RANGE)
    return DetectionImage(light, np.maximum(noise, least, out=noise))


def subsample(image: Pixels) -> Float32[np.ndarray, " pixel"]:
    """Every tenth pixel of a large image, enough for quantiles; all pixels of a small one."""
    return image.ravel()[:: max(1, min(10, image.size // 10**6))]


def filter_bands(
    image: Shaped[np.ndarray, "row column"], reach: int, function: Callable[[np.ndarray], np.ndarray]
) -> Pixels:
    """Filter an image in bands of rows, on all cores; `function` gets `reach` more pixels at each side, mirrored."""
    rows, result = len(image), np.empty(image.shape, np.float32)

    def work(start):
        stop = min(start + _TILE, rows)
        tall = image[mirror_indices(np.arange(start - reach, stop + reach), rows)]
        result[start:stop] = function(np.pad(tall, [(0, 0), (reach, reach)], mode="symmetric"))

    list(map_in_threads(work, range(0, rows, _TILE)))
    return result


def gaussian_smooth(image: Shaped[np.ndarray, "row column"], deviation: float) -> Pixels:
    """`scipy.ndimage.gaussian_filter` with mirrored edges, in float32 and on all cores; `deviation` in pixels."""
    reach = int(_TRUNCATE * deviation + 0.5)
    weights = np.exp(-((np.arange(-reach, reach + 1) / deviation) ** 2) / 2)
    weights = (weights / weights.sum()).astype(np.float32)

    def smooth(tall) -> Any:
        x: Any = sum(w * tall[i : len(tall) - 2 * reach + i] for i, w in enumerate(weights))
        return sum(w * x[:, i : x.shape[1] - 2 * reach + i] for i, w in enumerate(weights))

    return filter_bands(image, reach, smooth)


def mirror_indices(index: np.ndarray, size: int) -> np.ndarray:
    """Mirror indices beyond an axis of this size at its ends, as `mode="symmetric"` of `numpy.pad`."""
    index = index % (2 * size)
    return np.minimum(index, 2 * size - 1 - index)


def background_tiles(light: Float[Array | np.ndarray, "row column"]) -> tuple[Any, Any]:
    """Background and noise `(tile_row, tile)` of each tile of 32 pixels; incomplete tiles repeat the image's edge.

    The background is the median, the noise the root mean square of the darker pixels, to which no spot contributes.
    """
    xp = array_namespace(light)
    pixels = xp.pad(light, [(0, -n % _TILE) for n in light.shape], mode="edge")
    tall, wide = (n // _TILE for n in pixels.shape)
    # Every third pixel is enough.
    pixels = pixels.reshape(tall, _TILE, wide, _TILE).swapaxes(1, 2).reshape(tall, wide, -1)[..., ::3]
    median = xp.median(pixels, axis=-1)
    return median, xp.sqrt(2 * xp.mean(xp.minimum(pixels - median[..., None], 0) ** 2, axis=-1))


def interpolate_tiles(tiles: Float[Array | np.ndarray, "tile_row tile"], shape: tuple[int, ...]) -> Any:
    """Interpolate the levels of tiles linearly between their centers, at each pixel of an image of this shape."""
    rows, columns = (_between_tiles(n, count, tiles.dtype) for n, count in zip(shape, tiles.shape, strict=True))
    return rows @ tiles @ columns.T


def _between_tiles(size, count, dtype):
    position = np.clip((np.arange(size) + 0.5) / _TILE - 0.5, 0, count - 1)
    return np.maximum(1 - np.abs(position[:, None] - np.arange(count)), 0).astype(dtype)
