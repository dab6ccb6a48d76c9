"""Pixels that do not say how much light there was: hot, dead or masked ones are found, and filled from neighbours."""

import numpy as np
from jaxtyping import Bool, Float32, Num

# A pixel of a dark frame is hot if it is so many standard deviations brighter than the median of its neighbourhood of
# 5 x 5; a count is rounded by half of one.
_HOT, _ROUNDING = 10.0, 0.5
# In a capture, a pixel is hot if it is brighter than all is dark by so many standard deviations, and none of its eight
# neighbours has more than this share of what it has. In 24 ray-traced captures of points, whose spots are a pixel wide
# at half their height, the brightest neighbour of a spot has 7 % or more, binned or not.
_BRIGHT, _NEIGHBOUR = 100.0, 0.03


def hot_in_dark(dark: Num[np.ndarray, "row column"]) -> Bool[np.ndarray, "row column"]:
    """Which pixels of a dark frame are hot. Slow changes over the sensor, as an amplifier's glow, do not count."""
    dark = np.asarray(dark, np.float32)
    middle = float(np.median(dark))
    deviation = max(1.4826 * float(np.median(np.abs(dark - middle))), _ROUNDING)
    hot = dark > middle + _HOT * deviation
    for some in _in_parts(np.argwhere(hot)):
        local = np.median(_around(dark, some, 2), axis=1)
        hot[tuple(some.T)] = dark[tuple(some.T)] > local + _HOT * deviation
    return hot


def hot_in_capture(image: Num[np.ndarray, "row column"]) -> Bool[np.ndarray, "row column"]:
    """Which single pixels of a capture no light can have made: a spot, however sharp, shows in its neighbours.

    Pixels that have their neighbours beside them; not those of a mosaic. It finds only what is far above the noise.
    """
    image = np.asarray(image)
    # Levels of a part of the pixels are as good.
    some = np.asarray(image[::3, ::3], np.float32)
    level = float(np.median(some))
    noise = float(np.sqrt(2 * np.mean(np.minimum(some - level, 0) ** 2)))
    # Images without noise have bright pixels, too.
    least = (float(image.max()) - level) / 100 if image.dtype.kind == "f" else _BRIGHT * _ROUNDING
    hot = image > level + max(_BRIGHT * noise, least)
    for some in _in_parts(np.argwhere(hot)):
        brightest = np.delete(_around(image, some, 1), 4, axis=1).max(1)
        hot[tuple(some.T)] = brightest - level < _NEIGHBOUR * (image[tuple(some.T)] - level)
    return hot


def repaired(
    image: Num[np.ndarray, "row column"], bad: Bool[np.ndarray, "row column"]
) -> Float32[np.ndarray, "row column"]:
    """An image with bad pixels filled by the median of their good neighbours of 3 x 3, larger defects from their edge.

    Raises
    ------
    ValueError
        If there is no good pixel.
    """
    image, bad = np.array(image, np.float32), bad.copy()
    if bad.all():
        raise ValueError("`bad` must leave a pixel, got none.")
    places = np.argwhere(bad)
    while len(places):
        near = np.where(_around(bad, places, 1), np.nan, _around(image, places, 1))
        reached = ~np.isnan(near).all(1)
        filled = tuple(places[reached].T)
        image[filled], bad[filled] = np.nanmedian(near[reached], axis=1), False
        places = places[~reached]
    return image


def _in_parts(places):
    """A few at a time, for the memory of their neighbourhoods."""
    return np.array_split(places, len(places) // 100_000 + 1)


def _around(image, places, reach):
    """The pixels of the square around each place, `(place, pixel)`; at the image's edge, the edge's."""
    offsets = np.stack(np.meshgrid(*2 * [np.arange(-reach, reach + 1)], indexing="ij"), -1).reshape(1, -1, 2)
    near = np.clip(places[:, None] + offsets, 0, np.array(image.shape) - 1)
    return image[near[..., 0], near[..., 1]]
