"""Spots in captures: middles of sharp ones, and middles and widths of wide ones of any shape.

The middle of a spot is where a Gaussian window that moves to the centroid of what it sees comes to rest (mean shift),
so that rays far from the core do not count.

Wide spots are out of focus, aberrated, or lenses' images of an even surface. Their window is as wide as the spot
itself, so that it does not stop at structure within the spot. It ends half-way to the nearest neighbour, so that discs
that touch do not shift each other's middles: it then contains the whole disc, with its edges. The background is the
light between neighbouring spots, and the smooth part of the light that falls on the pattern is divided out.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Float64
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import minimum_filter
from scipy.spatial import KDTree
from skimage.feature import peak_local_max

from ..detection.background import gaussian_smooth, subtract_background
from ..geometry import Imager
from ..layouts import nearest_neighbour_distances
from ..typing import Image
from .spot_model import MAX_MOVES, MOVE_TOLERANCE, WINDOW

# Sharp spots: half width of the square that the window sees, and distance from the maximum that a middle may have,
# pixels; threshold over the noise; least distance of spots, pixels; spots looked for, for each source of a capture.
_HALF, _FARTHEST_SHARP, _THRESHOLD_SNR, MIN_DISTANCE, SPOTS_PER_SOURCE = 4, 2.0, 8.0, 6, 60
# Wide spots looked for, over the number of lenses.
MOST_BLURRED = 2
# Smoothing before maxima are looked for and least distance of maxima, in pitches of the pattern; threshold of a
# maximum, relative to the brightest.
_SMOOTHING, _APART, _THRESHOLD = 1 / 7, 1 / 3, 0.02
# The background is the darkest light within half a pitch, smoothed before, and after for maxima, in pitches. Of a spot
# it is this quantile of it and its nearest ones.
_BEFORE, _AFTER, _BESIDE, _OF_BESIDE = 1 / 14, 1 / 2, 9, 0.75
# Share of the variance of the spots' logarithmic light that a smooth surface may leave to count.
_UNEXPLAINED = 0.5
# The light of a spot is that within this distance of its middle, in pitches, less the light of the darkest share.
_REACH, _DARKEST = 0.5, 0.1
# Least distance of the nearest neighbour that counts, in pitches; the most is one.
_NEAREST = 0.6
# Rounds in which middles and widths are found by turns; distance from the maximum that a middle may have, in pitches.
_BLURRED_ROUNDS, _FARTHEST = 3, 0.25
# Standard deviation of the window over the half-light radius, which is 1.18 of a Gaussian spot. A narrower window
# rests where a disc is brightest: of real white images the pitch changes by 0.1 % from 0.5 to 1.2, by 0.01 % above.
BLURRED_WINDOW, NARROW_WINDOW = 1.2, 0.7
# Pixels that are worked on at once.
_PIXELS = 1_000_000


def find_spots(image: Image, most: int) -> Float64[np.ndarray, "spot 2"]:
    """Find the brightest spots, brightest first, as fractional `(row, column)`; none within six pixels of the edge."""
    light, noise = subtract_background(image)
    threshold = _THRESHOLD_SNR * float(np.median(noise))
    peaks = peak_local_max(light, min_distance=MIN_DISTANCE, threshold_abs=threshold, num_peaks=most)
    same = np.ones(len(peaks))
    farthest, tolerance = _FARTHEST_SHARP * same, MOVE_TOLERANCE / WINDOW
    return mean_shift(light, peaks, WINDOW * same, np.inf * same, farthest, half=_HALF, tolerance=tolerance)


def find_spots_mm(image: Image, imager: Imager, sources: int = 1) -> Float64[np.ndarray, "spot 2"]:
    """The brightest spots of so many sources, `(x, y)` on the sensor, mm."""
    return np.asarray(imager.sensor.to_mm(find_spots(image, SPOTS_PER_SOURCE * sources)), np.float64)


def find_blurred_spots_mm(
    image: Image, imager: Imager, window: float = BLURRED_WINDOW
) -> tuple[Float64[np.ndarray, "spot 2"], float]:
    """Wide spots, as far apart as lenses, `(x, y)` on the sensor, mm, and their median width in that of a sharp one."""
    centers = np.asarray(imager.array.centers, np.float64)
    pitch = float(nearest_neighbour_distances(centers).mean()) / imager.sensor.pixel_pitch
    middles, radii = find_blurred_spots(image, pitch, MOST_BLURRED * len(centers), window)
    width = BLURRED_WINDOW * float(np.median(radii)) / WINDOW if len(radii) else 1.0
    return np.asarray(imager.sensor.to_mm(middles), np.float64), max(width, 1 + 1e-6)


def find_blurred_spots(
    image: Image, pitch: float, most: int, window: float = BLURRED_WINDOW
) -> tuple[Float64[np.ndarray, "spot 2"], Float64[np.ndarray, " spot"]]:
    """Find wide spots that are about a `pitch` apart, pixels, from the middle of the pattern outward.

    Middles are seen through windows whose standard deviation is `window` half-light radii.

    Returns
    -------
    middles
        Fractional `(row, column)`, none within half a pitch of the edge.
    radii
        Half-light radius of each, pixels.
    """
    image = np.asarray(image, np.float64)
    # The darkest light within half a pitch: where discs touch, it is all that is left of the background.
    even = gaussian_smooth(image, _BEFORE * pitch)
    darkness = minimum_filter(even, size=2 * int(np.ceil(pitch / 2)) + 1, mode="nearest")
    smooth = gaussian_smooth(image - gaussian_smooth(darkness, _AFTER * pitch), _SMOOTHING * pitch)
    least = _THRESHOLD * max(float(smooth.max()), 0)
    peaks = peak_local_max(smooth, min_distance=max(int(_APART * pitch), 1), threshold_abs=least, exclude_border=False)
    border = np.minimum(peaks, np.array(image.shape) - 1 - peaks).min(1)
    peaks = peaks[border >= _REACH * pitch][:most]
    if len(peaks) < 2:
        return np.zeros((0, 2)), np.zeros(0)
    distances, nearest = map(np.asarray, KDTree(peaks).query(peaks, min(_BESIDE, len(peaks))))
    pitches = np.clip(distances[:, 1], _NEAREST * pitch, pitch)
    dark = darkness[tuple(peaks.T)]
    light, dark, bright = image - dark.min(), dark - dark.min(), even[tuple(peaks.T)] - dark.min()
    slopes = _light_slopes(bright, peaks)
    # Of a disc at the pattern's edge, which the dark touches, the background is that of its neighbours.
    dark, peaks = np.quantile(dark[nearest], _OF_BESIDE, axis=1), peaks.astype(float)
    middles, radii = peaks, _REACH * pitches / 2
    for _ in range(_BLURRED_ROUNDS):
        ends, farthest = _REACH * pitches, _FARTHEST * pitches
        middles = mean_shift(light, peaks, window * radii, ends, farthest, dark=dark, slopes=slopes)
        radii = np.maximum(half_light_radii(light, middles, pitches), 1.0)
    order = np.argsort(np.linalg.norm(middles - np.median(middles, 0), axis=1))
    return middles[order], radii[order]


def _light_slopes(light, peaks) -> Float64[np.ndarray, "spot 2"]:
    """Relative slope of the light that falls on a pattern at each spot, per pixel, if it changes smoothly; else 0.

    Where it does, discs are brighter on one side, by which their middles would all be drawn to one place.
    """
    middle = peaks.mean(0)
    size = max(float(np.abs(peaks - middle).max()), 1.0)
    y, x = ((peaks - middle) / size).T
    logs = np.log(np.maximum(light, 1e-3 * light.max()))
    terms = np.stack([np.ones_like(x), y, x, y * y, x * y, x * x], -1)
    c = np.linalg.lstsq(terms, logs)[0]
    if len(peaks) < 2 * len(c) or np.var(logs - terms @ c) > _UNEXPLAINED * np.var(logs):
        return np.zeros(peaks.shape)
    return np.stack([c[1] + 2 * c[3] * y + c[4] * x, c[2] + c[4] * y + 2 * c[5] * x], -1) / size


def half_light_radii(
    image: Image, middles: Float64[np.ndarray, "spot 2"], pitches: Float64[np.ndarray, " spot"]
) -> Float64[np.ndarray, " spot"]:
    """Radius within which half of the light of each spot is, pixels.

    The light is that within half a pitch, pixels, of the middle `(row, column)`, less the darkest tenth's.
    """
    reaches, radii = _REACH * pitches, np.zeros(len(middles))
    for spots, squares, side, start in _squares(image, middles, _half(reaches)):
        away = side + (start - middles[spots])[:, :, None]
        distances = np.hypot(away[:, 0, :, None], away[:, 1, None, :])
        for spot, square, distance in zip(spots, squares, distances, strict=True):
            inside = np.isfinite(square) & (distance <= reaches[spot])
            light, distance = square[inside], distance[inside]
            order = np.argsort(distance)
            total = np.cumsum(np.maximum(light - np.quantile(light, _DARKEST), 0)[order])
            radii[spot] = np.interp(total[-1] / 2, total, distance[order]) if total[-1] > 0 else 0.0
    return radii


def mean_shift(
    light: Float[np.ndarray, "row column"],
    peaks: Float[np.ndarray, "spot 2"],
    deviations: Float64[np.ndarray, " spot"],
    ends: Float64[np.ndarray, " spot"],
    farthest: Float64[np.ndarray, " spot"],
    *,
    half: int | None = None,
    tolerance: float = MOVE_TOLERANCE,
    dark: Float[np.ndarray, " spot"] | None = None,
    slopes: Float64[np.ndarray, "spot 2"] | None = None,
) -> Float64[np.ndarray, "spot 2"]:
    """Where Gaussian windows come to rest that move from maxima to the centroids of what they see, `(row, column)`.

    A window has a standard deviation, `ends` at a distance from its middle, and rests at most `farthest` from its
    maximum; all in pixels. It sees the square `half` about the maximum, by default all that it may reach: the light
    divided by what the relative `slopes` make of even light, above `dark`, by default 0. It rests when it moves by less
    than `tolerance` of its standard deviation.
    """
    dark = np.zeros(len(peaks)) if dark is None else dark
    slopes = np.zeros((len(peaks), 2)) if slopes is None else slopes
    middles = np.array(peaks, np.float64)
    for spots, squares, side, start in _squares(light, peaks, _half(ends + farthest) if half is None else half):
        up = slopes[spots, :, None] * side
        squares = squares * np.exp(-up[:, 0, :, None] - up[:, 1, None, :]) - dark[spots, None, None]
        squares = np.nan_to_num(np.maximum(squares, 0))
        moving = np.arange(len(spots))
        for _ in range(MAX_MOVES):
            which = spots[moving]
            away = side + (start[moving] - middles[which])[:, :, None]
            weights = np.exp(-((away / deviations[which, None, None]) ** 2) / 2)
            distance = np.sqrt(away[:, 0, :, None] ** 2 + away[:, 1, None, :] ** 2)
            seen = squares[moving] * np.clip(ends[which, None, None] - distance + 0.5, 0, 1)
            seen *= weights[:, 0, :, None] * weights[:, 1, None, :]
            along = np.stack([seen.sum(2), seen.sum(1)], 1)
            total = along[:, 0].sum(1)
            step = (along * away).sum(2) / np.where(total > 0, total, 1)[:, None]
            off = middles[which] + step - peaks[which]
            far = np.linalg.norm(off, axis=1)
            moved = peaks[which] + off * np.minimum(1.0, farthest[which] / np.maximum(far, 1e-9))[:, None]
            still = np.abs(moved - middles[which]).max(1) < tolerance * deviations[which]
            middles[which] = moved
            moving = moving[~still & (total > 0)]
            if not len(moving):
                break
    return middles


def _half(reaches) -> int:
    return int(np.ceil(reaches.max(initial=1))) + 1


def _squares(image, middles, half: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Yields as many spots as fit into the memory: indices, squares of pixels, their offsets, and the middle pixels.

    Pixels beyond the image are NaN.
    """
    side, start = np.arange(-half, half + 1), np.rint(middles).astype(int)
    padded = np.pad(np.asarray(image, np.float64), half, constant_values=np.nan)
    windows = sliding_window_view(padded, (len(side), len(side)))
    count = -(-len(middles) * len(side) ** 2 // _PIXELS)
    for spots in np.array_split(np.arange(len(middles)), count) if count else ():
        yield spots, windows[tuple(start[spots].T)], side, start[spots]
