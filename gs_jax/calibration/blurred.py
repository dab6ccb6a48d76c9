"""Middles and widths of spots that are wide, of any shape: out of focus, aberrated, or a lens's image of a surface.

The window of the mean shift is as wide as the spot itself, so that it does not stop at structure within the spot. It
ends half-way to the nearest neighbour, so that discs that touch do not shift each other's middles: it then contains the
whole disc, with its edges.
"""

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree
from skimage.feature import peak_local_max

from ..detection.background import gaussian_smooth
from ..typing import Image
from .spot_model import MAX_MOVES, MOVE_TOLERANCE

# Smoothing before maxima are looked for and least distance of maxima, in pitches of the pattern; threshold of a
# maximum, relative to the brightest.
_SMOOTHING, _APART, _THRESHOLD = 1 / 7, 1 / 3, 0.02
# The light of a spot is that within this distance of its middle, in pitches, less the light of the darkest share.
_REACH, _DARKEST = 0.5, 0.1
# Least distance of the nearest neighbour that counts, in pitches; the most is one.
_NEAREST = 0.6
# Rounds in which middles and widths are found by turns; distance from the maximum that a middle may have, in pitches.
_ROUNDS, _FARTHEST = 3, 0.25
# Standard deviation of the window over the half-light radius, which is 1.18 of a Gaussian spot.
BLURRED_WINDOW = 0.85


def find_blurred_spots(
    image: Image, pitch: float, most: int
) -> tuple[Float64[np.ndarray, "spot 2"], Float64[np.ndarray, " spot"]]:
    """Find wide spots that are about a `pitch` apart, pixels, from the middle of the pattern outward.

    Returns
    -------
    middles
        Fractional `(row, column)`, none within half a pitch of the edge.
    radii
        Half-light radius of each, pixels.
    """
    light = np.asarray(image, np.float64) - np.median(image)
    smooth = gaussian_smooth(light, _SMOOTHING * pitch)
    least = _THRESHOLD * max(float(smooth.max()), 0)
    peaks = peak_local_max(smooth, min_distance=max(int(_APART * pitch), 1), threshold_abs=least, exclude_border=False)
    border = np.minimum(peaks, np.array(image.shape) - 1 - peaks).min(1)
    peaks = peaks[border >= _REACH * pitch][:most].astype(float)
    nearest = np.asarray(KDTree(peaks).query(peaks, 2)[0])[:, 1] if len(peaks) else np.zeros(0)
    found = [_settle(light, *each) for each in zip(peaks, np.clip(nearest, _NEAREST * pitch, pitch), strict=True)]
    middles = np.array([middle for middle, _ in found]).reshape(-1, 2)
    radii = np.array([radius for _, radius in found])
    if len(middles):
        order = np.argsort(np.linalg.norm(middles - np.median(middles, 0), axis=1))
        middles, radii = middles[order], radii[order]
    return middles, radii


def half_light_radius(image: Image, middle: Float64[np.ndarray, "2"], pitch: float) -> float:
    """Radius within which half of a spot's light is, pixels.

    The light is that within half a `pitch`, pixels, of the middle `(row, column)`, less the darkest tenth's.
    """
    light, distance, _ = _around(np.asarray(image, np.float64), middle, _REACH * pitch)
    inside = distance <= _REACH * pitch
    light, distance = light[inside], distance[inside]
    order = np.argsort(distance)
    total = np.cumsum(np.maximum(light - np.quantile(light, _DARKEST), 0)[order])
    return float(np.interp(total[-1] / 2, total, distance[order])) if total[-1] > 0 else 0.0


def _settle(light, peak, pitch: float):
    """Middle and half-light radius of the spot at a maximum, which is a `pitch` from the next."""
    middle, radius = peak, _REACH * pitch / 2
    for _ in range(_ROUNDS):
        middle = mean_shift(light, peak, BLURRED_WINDOW * radius, pitch)
        radius = max(half_light_radius(light, middle, pitch), 1.0)
    return middle, radius


def mean_shift(
    light: Float64[np.ndarray, "row column"], peak: Float64[np.ndarray, "2"], deviation: float, pitch: float
) -> Float64[np.ndarray, "2"]:
    """Where a Gaussian window comes to rest that moves from a maximum to the centroid of what it sees.

    The window ends at half a `pitch`, and rests within a quarter of the maximum; all in pixels, `(row, column)`.
    """
    middle, end, farthest = peak, _REACH * pitch, _FARTHEST * pitch
    for _ in range(MAX_MOVES):
        near, distance, places = _around(light, middle, end)
        inside = np.clip(end - distance + 0.5, 0, 1)
        seen = np.maximum(near, 0) * inside * np.exp(-((distance / deviation) ** 2) / 2)
        if not seen.sum() > 0:
            break
        last, middle = middle, np.array([(seen * place).sum() for place in places]) / seen.sum()
        away = float(np.linalg.norm(middle - peak))
        middle = peak + (middle - peak) * min(1.0, farthest / max(away, 1e-9))
        if np.abs(middle - last).max() < MOVE_TOLERANCE * deviation:
            break
    return middle


def _around(light, middle, reach: float):
    """Pixels about a place, with their distances from it, and rows and columns."""
    half, (row, column) = int(np.ceil(reach)) + 1, np.rint(middle).astype(int)
    rows, columns = (
        np.arange(max(at - half, 0), min(at + half + 1, size))
        for at, size in zip((row, column), light.shape, strict=True)
    )
    near = light[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return near, np.hypot(*np.ix_(rows - middle[0], columns - middle[1])), (rows[:, None], columns[None])
