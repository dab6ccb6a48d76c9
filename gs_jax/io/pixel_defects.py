"""Pixels that do not measure light: hot, bad and saturated ones."""

import math

import numpy as np
from jaxtyping import Bool, Float32, Num

# Full scale is that of a converter of so many bits, as such or in the upper bits of 16.
_BITS = (8, 10, 12, 14, 16)
# Images are also saturated if at least `_MIN_PILE` pixels have the maximum, more than twice those of the hundredth (or
# `_FEW_COUNTS`) below it, and there are at least `_MIN_LEVELS` levels among about `_LEVEL_PIXELS` pixels.
_MIN_PILE, _FEW_COUNTS, _MIN_LEVELS, _LEVEL_PIXELS = 10, 5, 32, 500_000
# A pixel of a dark frame is hot if it exceeds the median of its 5 x 5 neighbourhood by so many standard deviations,
# which are at least the rounding of a count.
_HOT, _ROUNDING = 10.0, 0.5
# A pixel of a capture is hot if it exceeds the background by so many standard deviations, and none of its eight
# neighbours by more than this share of that. In 24 ray-traced captures of points, whose spots are one pixel wide at
# half maximum, the brightest neighbour of a spot has 7 % or more, binned or not.
_BRIGHT, _NEIGHBOUR = 100.0, 0.03


def count_saturated(image: Num[np.ndarray, "row column"]) -> tuple[int, int] | None:
    """Number of saturated pixels and their value; None without such, or if the type is no camera's.

    The maximum is saturated if it is the full scale of 8 to 16 bits, or if many more pixels have it than values just
    below.
    """
    if image.dtype.kind != "u":
        return None
    top = int(image.max())
    count = int(np.count_nonzero(image == top))
    full = {2**bits - 1 for bits in _BITS} | {2**16 - 2 ** (16 - bits) for bits in _BITS}
    # Rounded noise piles up within a few counts, too; drawings have few levels.
    least = max(top - max(top // 100, _FEW_COUNTS), 0)
    below = int(np.count_nonzero(image >= least)) - count
    step = math.isqrt(image.size // _LEVEL_PIXELS) + 1
    levels = np.count_nonzero(np.bincount(image[::step, ::step].ravel()))
    piled = count >= max(_MIN_PILE, 2 * below + 1) and levels >= _MIN_LEVELS
    return (count, top) if piled or (top in full and count > 1) else None


def find_hot_in_dark(dark: Num[np.ndarray, "row column"]) -> Bool[np.ndarray, "row column"]:
    """Find hot pixels of a dark frame; gradual changes, such as an amplifier's glow, do not count."""
    dark = np.asarray(dark, np.float32)
    middle = float(np.median(dark))
    deviation = max(1.4826 * float(np.median(np.abs(dark - middle))), _ROUNDING)
    hot = dark > middle + _HOT * deviation
    for part in _parts(np.argwhere(hot)):
        local = np.median(_neighbourhoods(dark, part, 2), axis=1)
        hot[tuple(part.T)] = dark[tuple(part.T)] > local + _HOT * deviation
    return hot


def find_hot_in_capture(image: Num[np.ndarray, "row column"]) -> Bool[np.ndarray, "row column"]:
    """Find single pixels of a capture that light cannot have made: the sharpest spot is seen by its neighbours, too.

    It finds only pixels far above the noise. Mosaics and binned pixels have no such neighbours.
    """
    image = np.asarray(image)
    sample = np.asarray(image[::3, ::3], np.float32)
    level = float(np.median(sample))
    noise = float(np.sqrt(2 * np.mean(np.minimum(sample - level, 0) ** 2)))
    # Noiseless images have bright pixels, too.
    least = (float(image.max()) - level) / 100 if image.dtype.kind == "f" else _BRIGHT * _ROUNDING
    hot = image > level + max(_BRIGHT * noise, least)
    for part in _parts(np.argwhere(hot)):
        brightest = np.delete(_neighbourhoods(image, part, 1), 4, axis=1).max(1)
        hot[tuple(part.T)] = brightest - level < _NEIGHBOUR * (image[tuple(part.T)] - level)
    return hot


def fill_bad_pixels(
    image: Num[np.ndarray, "row column"], bad: Bool[np.ndarray, "row column"]
) -> Float32[np.ndarray, "row column"]:
    """Replace bad pixels by the median of their good 3 x 3 neighbours; larger defects are filled from their edge.

    Raises `ValueError` if all pixels are bad.
    """
    image, bad = np.array(image, np.float32), bad.copy()
    if bad.all():
        raise ValueError("`bad` must leave a good pixel.")
    places = np.argwhere(bad)
    while len(places):
        near = np.where(_neighbourhoods(bad, places, 1), np.nan, _neighbourhoods(image, places, 1))
        reached = ~np.isnan(near).all(1)
        filled = tuple(places[reached].T)
        image[filled], bad[filled] = np.nanmedian(near[reached], axis=1), False
        places = places[~reached]
    return image


def _parts(places):
    """Split pixels into parts whose neighbourhoods need little memory."""
    return np.array_split(places, len(places) // 100_000 + 1)


def _neighbourhoods(image, places, reach):
    """Squares around pixels, `(place, pixel)`; beyond the image's edge its nearest pixels."""
    offsets = np.stack(np.meshgrid(*2 * [np.arange(-reach, reach + 1)], indexing="ij"), -1).reshape(1, -1, 2)
    near = np.clip(places[:, None] + offsets, 0, np.array(image.shape) - 1)
    return image[near[..., 0], near[..., 1]]
