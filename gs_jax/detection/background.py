"""Background, noise and smoothing of an image. Host code that works on bands of rows, which fit into the CPU cache."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Shaped

from ..base.arrays import check_finite
from ..base.errors import input_error
from ..base.workers import map_in_threads
from ..typing import Image

# Side of a tile with one background and one noise level, pixels: wider than a spot, narrower than haze. A band has as
# many rows.
_TILE = 32
# Half width of the Gaussian kernel in standard deviations.
_TRUNCATE = 4
# Smoothing before points are looked for, pixels: spots 2.5 pixels apart still have two maxima.
_SMOOTHING = 0.7
# Least noise, relative to the brightest spot: for images without noise, and for the steps of the camera's counts.
_DYNAMIC_RANGE = 1000

Pixels = Float32[np.ndarray, "row column"]
Tiles = Float32[np.ndarray, "tile_row tile"]


class DetectionImage(NamedTuple):
    """An image less its background, slightly smoothed, and the standard deviation of the noise of each pixel."""

    light: Pixels
    noise: Pixels


def subtract_background(image: Image) -> DetectionImage:
    """Smooth an image slightly and subtract its background; `InputError` if a pixel is not real and finite."""
    if np.iscomplexobj(image):
        raise input_error("image", "real", "complex numbers")
    check_finite("image", image)
    light = gaussian_smooth(np.asarray(image), _SMOOTHING)
    background, noise = (interpolate_tiles(tiles, light.shape) for tiles in background_tiles(light))
    light -= background
    least = max(float(np.median(subsample(noise))), float(light.max()) / _DYNAMIC_RANGE)
    return DetectionImage(light, np.maximum(noise, least, out=noise))


def subsample(image: Pixels) -> Float32[np.ndarray, " pixel"]:
    """Every tenth pixel of a large image, enough for quantiles; all pixels of a small one."""
    return image.ravel()[:: max(1, min(10, image.size // 10**6))]


def for_each_band(rows: int, work: Callable[[slice], object]) -> None:
    """Call `work` for every band of rows, on all cores."""
    list(map_in_threads(work, [slice(start, min(start + _TILE, rows)) for start in range(0, rows, _TILE)]))


def gaussian_smooth(image: Shaped[np.ndarray, "row column"], deviation: float) -> Pixels:
    """`scipy.ndimage.gaussian_filter` with mirrored edges, in float32 and ten times as fast; `deviation` in pixels."""
    reach = int(_TRUNCATE * deviation + 0.5)
    weights = np.exp(-((np.arange(reach + 1) / deviation) ** 2) / 2)
    weights = (weights / (2 * weights.sum() - weights[0])).astype(np.float32)
    rows, columns = image.shape
    result = np.empty(image.shape, np.float32)

    def smooth(band):
        first, last = band.start - reach, band.stop + reach
        inside = first >= 0 and last <= rows
        tall = image[first:last] if inside else image[mirror_indices(np.arange(first, last), rows)]
        wide = np.empty((len(tall) - 2 * reach, columns + 2 * reach), np.float32)
        _convolve_rows(tall, weights, wide[:, reach : reach + columns])
        for ends in (np.arange(reach), np.arange(-reach, 0)):
            wide[:, ends] = wide[:, reach + mirror_indices((ends % wide.shape[1]) - reach, columns)]
        _convolve_rows(wide.T, weights, result[band].T)

    for_each_band(rows, smooth)
    return result


def _convolve_rows(rows, weights, total):
    """Write the convolution of `rows` with a symmetric kernel, given from its middle on, into `total`."""
    reach = len(weights) - 1
    shifted = lambda by: rows[reach + by : reach + by + len(total)]
    np.multiply(shifted(0), weights[0], out=total)
    pair = np.empty_like(total)
    for distance in range(1, reach + 1):
        np.add(shifted(-distance), shifted(distance), out=pair, dtype=np.float32)
        pair *= weights[distance]
        total += pair


def mirror_indices(index: np.ndarray, size: int) -> np.ndarray:
    """Mirror indices beyond an axis of this size at its ends, as `mode="symmetric"` of `numpy.pad`."""
    index = index % (2 * size)
    return np.minimum(index, 2 * size - 1 - index)


def background_tiles(image: Float[np.ndarray, "row column"]) -> tuple[Tiles, Tiles]:
    """Background and noise of each tile of 32 pixels; incomplete tiles repeat the image's edge.

    The background is the median, the noise the root mean square of the darker pixels, to which no spot contributes.
    """
    rows, columns = image.shape
    median, noise = np.empty((2, -(-rows // _TILE), -(-columns // _TILE)), np.float32)

    def measure(band):
        padding = ((0, -(band.stop - band.start) % _TILE), (0, -columns % _TILE))
        pixels = np.pad(image[band], padding, mode="edge").reshape(_TILE, -1, _TILE)
        # Every third pixel is enough.
        pixels = pixels.swapaxes(0, 1).reshape(-1, _TILE**2)[:, ::3]
        # Sorting is faster than NumPy's median.
        middle = np.sort(pixels, axis=1)[:, [(pixels.shape[1] - 1) // 2, pixels.shape[1] // 2]].mean(1)
        row = band.start // _TILE
        median[row] = middle
        noise[row] = np.sqrt(2 * np.mean(np.minimum(pixels - middle[:, None], 0) ** 2, axis=1))

    for_each_band(rows, measure)
    return median, noise


def interpolate_tiles(tiles: Tiles, shape: tuple[int, int]) -> Pixels:
    """Interpolate the levels of tiles linearly between their centers, at each pixel of an image of this shape."""
    offset = (np.arange(_TILE) + 0.5) / _TILE - 0.5
    # Weights of the previous tile, the pixel's own tile and the next.
    weights = np.stack([np.maximum(-offset, 0), 1 - np.abs(offset), np.maximum(offset, 0)], 1).astype(np.float32)
    around = np.pad(tiles, 1, mode="edge")
    neighbours = np.stack([around[:, :-2], around[:, 1:-1], around[:, 2:]], -1)
    wide = (neighbours @ weights.T).reshape(len(around), -1)[:, : shape[1]]
    result = np.empty(shape, np.float32)

    def interpolate(band):
        row, count = band.start // _TILE, band.stop - band.start
        np.matmul(weights[:count], wide[row : row + 3], out=result[band])

    for_each_band(shape[0], interpolate)
    return result


def level_of_tiles(light: Float[Array, "y x"]) -> Float[Array, "y x"]:
    """What `background_tiles` and `interpolate_tiles` compute, for what JAX traces."""
    pixels = jnp.pad(light, [(0, -n % _TILE) for n in light.shape], mode="edge")
    tall, wide = (n // _TILE for n in pixels.shape)
    pixels = pixels.reshape(tall, _TILE, wide, _TILE).swapaxes(1, 2).reshape(tall, wide, -1)
    rows, columns = (_between_tiles(*size, light.dtype) for size in zip(light.shape, (tall, wide), strict=True))
    return rows @ jnp.median(pixels[..., ::3], axis=-1) @ columns.T


def _between_tiles(size, count, dtype):
    position = np.clip((np.arange(size) + 0.5) / _TILE - 0.5, 0, count - 1)
    return jnp.asarray(np.maximum(1 - np.abs(position[:, None] - np.arange(count)), 0), dtype)
