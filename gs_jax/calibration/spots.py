"""Point sources of a calibration, their spots in captures, and the assignment of spots to sources and lenses.

The middle of a spot is where a Gaussian window that moves to the centroid of what it sees comes to rest (mean shift),
so that rays far from the core do not count. Spots that are wide, of any shape (out of focus, aberrated, or a lens's
image of a surface), have a window as wide as the spot itself, so that it does not stop at structure within the spot. It
ends half-way to the nearest neighbour, so that discs that touch do not shift each other's middles: it then contains the
whole disc, with its edges.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.ndimage import minimum_filter
from scipy.spatial import KDTree
from skimage.feature import peak_local_max

from ..base.errors import InputError
from ..detection.background import gaussian_smooth, subtract_background
from ..geometry import Imager
from ..layouts import nearest_neighbour_distances
from ..optics.lens_types import FIELDS
from ..optics.psf_core import ensquared_light
from ..optics.raytrace import to_numpy
from ..typing import Image
from .spot_model import MAX_MOVES, MOVE_TOLERANCE, WINDOW, CoreOffsets, blurred_radius, match_radius, predict_spots

# Half width of the square that the window sees, pixels.
_HALF = 4
# Threshold of a spot over the noise, and least distance of spots, pixels.
_THRESHOLD_SNR, _MIN_DISTANCE = 8.0, 6
# Spots looked for in a capture, for each of its sources.
_SPOTS = 60
# Wide spots looked for, over the number of lenses.
_MOST_BLURRED = 2
# Predicted spots closer than this, over `match_radius`, are blurred into one.
_BLURRED = 0.5
# Half widths of the squares by whose light types of lenses are told apart, pixels; rounds of alternation; least share.
_SQUARES, _ROUNDS, _MIN_SHARE = (1, 5), 10, 1e-12

SpotLists = Sequence[Float64[np.ndarray, "_ 2"]]


class Sources(NamedTuple):
    """Points `(x, y, z)`, mm, NaN where unknown, and the capture of each, from 0.

    `blur` is the width of each capture's spots, in that of a sharp one; None where all are sharp. Blurred spots are
    those of one source, which all lenses see.
    """

    points: Float64[np.ndarray, "source 3"]
    captures: Int[np.ndarray, " source"]
    blur: Float64[np.ndarray, " capture"] | None = None

    @property
    def blurs(self) -> Float64[np.ndarray, " source"]:
        """`blur` of each source, 1 of a sharp one."""
        return np.ones(len(self.captures)) if self.blur is None else self.blur[self.captures]

    @property
    def sharp(self) -> Bool[np.ndarray, " source"]:
        """Whether each source has sharp spots."""
        return self.blurs == 1

    def check(self, count: int, imager: Imager, fit: Sequence[str], blurred: Collection[int] = ()) -> None:
        """`InputError` unless each of `count` captures has a source where the imager's object may be.

        Also if the known coordinates cannot determine what is to be fitted, whatever the spots are.
        """
        without = sorted(set(range(count)) - set(self.captures.tolist()))
        if not count or without or len(self.points) != len(self.captures):
            which = f", none in capture {without[0] + 1}" if without else ""
            got = f"got {len(self.points)} sources for {count} captures{which}"
            raise InputError(f"positions: every capture needs one or more sources, {got}.")
        if not ((self.captures >= 0) & (self.captures < count)).all():
            worst = int(self.captures[(self.captures < 0) | (self.captures >= count)][0]) + 1
            raise InputError(f"positions: captures are numbered 1 to {count}, got a source in capture {worst}.")
        depths = self.points[:, 2]
        if (depths <= 0).any():
            raise InputError(f"positions: depths must be positive, got {np.nanmin(depths):g} mm.")
        begins = float(imager.sample_surface)
        # Where the sample begins may be a guess.
        if "sample_at" not in fit and (depths < begins * (1 - 1e-6)).any():
            what = "filters end" if imager.sample is None else "sample begins"
            needs = f"depths must be {begins:g} mm, where the {what}, or more"
            raise InputError(f"positions: {needs}, got {np.nanmin(depths):g} mm.")
        self._check_fit(fit)
        for number in blurred:
            if (count := int((self.captures == number).sum())) != 1:
                needs = f"capture {number + 1} must have one source, as each lens has one image in it"
                raise InputError(f"positions: {needs}, got {count}.")

    def _check_fit(self, fit):
        of_depth = [name for name in ("sensor_distance", "depth_offset") if name in fit]
        if of_depth and np.isnan(self.points[:, 2]).all():
            remedy = f"give the depth of a source, or hold {of_depth[0]}"
            raise InputError(f"positions: no known depth to fit {' and '.join(of_depth)} by; {remedy}.")
        if "shift" in fit and np.isnan(self.points[:, :2]).any(1).all():
            remedy = "give x and y of a source, or hold shift"
            raise InputError(f"positions: no source with known x and y to fit shift by; {remedy}.")


class Spots(NamedTuple):
    """Spots with their sources and lenses; positions on the sensor, mm."""

    sources: Int[np.ndarray, " spot"]
    lenses: Int[np.ndarray, " spot"]
    positions: Float64[np.ndarray, "spot 2"]


def find_spots(image: Image, most: int) -> Float64[np.ndarray, "spot 2"]:
    """Find the brightest spots, brightest first, as fractional `(row, column)`; none within six pixels of the edge."""
    light, noise = subtract_background(image)
    threshold = _THRESHOLD_SNR * float(np.median(noise))
    peaks = peak_local_max(light, min_distance=_MIN_DISTANCE, threshold_abs=threshold, num_peaks=most)
    return np.array([_middle_of_pixels(light, peak) for peak in peaks]).reshape(-1, 2)


def find_blurred_spots_mm(image: Image, imager: Imager) -> tuple[Float64[np.ndarray, "spot 2"], float]:
    """Wide spots, as far apart as lenses, `(x, y)` on the sensor, mm, and their median width in that of a sharp one."""
    centers = np.asarray(imager.array.centers, np.float64)
    pitch = float(nearest_neighbour_distances(centers).mean()) / imager.sensor.pixel_pitch
    middles, radii = find_blurred_spots(image, pitch, _MOST_BLURRED * len(centers))
    width = BLURRED_WINDOW * float(np.median(radii)) / WINDOW if len(radii) else 1.0
    return np.asarray(imager.sensor.to_mm(middles), np.float64), max(width, 1 + 1e-6)


def find_spots_mm(image: Image, imager: Imager, sources: int = 1) -> Float64[np.ndarray, "spot 2"]:
    """The brightest spots of so many sources, `(x, y)` on the sensor, mm."""
    return np.asarray(imager.sensor.to_mm(find_spots(image, _SPOTS * sources)), np.float64)


def _middle_of_pixels(light, peak):
    middle, side = peak.astype(float), np.arange(-_HALF, _HALF + 1)
    square = np.maximum(light[tuple(slice(at - _HALF, at + _HALF + 1) for at in peak)], 0)
    for _ in range(MAX_MOVES):
        weights = [np.exp(-((side - offset) ** 2) / (2 * WINDOW**2)) for offset in middle - peak]
        seen = square * np.outer(*weights)
        if not seen.sum() > 0:
            break
        step = np.array([seen.sum(1) @ side, seen.sum(0) @ side]) / seen.sum() - (middle - peak)
        middle = np.clip(middle + step, peak - 2, peak + 2)
        if np.abs(step).max() < MOVE_TOLERANCE:
            break
    return middle


def assign_spots(spots: SpotLists, sources: Sources, imager: Imager, offsets: CoreOffsets, within: float) -> Spots:
    """Assign to each source and lens within the field radius the spot nearest to its prediction, at most `within` away.

    Blurred spots may be `blurred_radius` away. A source with an unknown coordinate has no spots. Lengths are in mm.
    """
    centers = np.asarray(imager.centers, np.float64)
    sharp = sources.sharp
    predicted = np.asarray(predict_spots(imager, np.nan_to_num(sources.points, nan=1.0), offsets, sharp), np.float64)
    beside = np.linalg.norm(centers[None] - sources.points[:, None, :2], axis=-1)
    seen = ((beside < imager.field_radius) | ~sharp[:, None]) & ~np.isnan(sources.points.sum(1))[:, None]
    rows, blurred = [], _BLURRED * match_radius(imager.array.centers)
    for capture, found in enumerate(spots):
        source, lens = np.argwhere(seen & (sources.captures == capture)[:, None]).T
        if not len(found) or not len(source):
            continue
        wanted = predicted[source, lens]
        alone = np.asarray(KDTree(wanted).query_ball_point(wanted, blurred, return_length=True)) == 1
        distance, nearest = (np.asarray(part) for part in KDTree(found).query(wanted))
        near = distance < (within if sharp[source[0]] else blurred_radius(imager.array.centers))
        rows += [
            (source[k], lens[k], *found[nearest[k]])
            for k in np.flatnonzero(alone * near)
            # A spot belongs to the nearest prediction only.
            if distance[k] == distance[nearest == nearest[k]].min()
        ]
    table = np.array(rows, np.float64).reshape(-1, 4)
    return Spots(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:])


def classify_lenses(
    images: Sequence[Image], spots: SpotLists, points: Float64[np.ndarray, "image 3"], imagers: Sequence[Imager]
) -> Int[np.ndarray, " lens"]:
    """Estimate the type of each lens from the light of its spots in a small and in a large square.

    Exact rays predict the light for each type up to a factor for each capture and square, as the brightness of the
    source and the camera's blur are unknown. Types and factors minimise the sum of absolute deviations of logarithms.
    Each image shows one point; `imagers` have all lenses of the first type, of the second, and so on.
    """
    host, count = to_numpy(imagers[0]), len(imagers[0].array.centers)
    fields, depths = np.linspace(0, host.field_radius, FIELDS), np.unique(points[:, 2])
    widths = [(2 * half + 1) * host.sensor.pixel_pitch for half in _SQUARES]
    tables = np.array([[ensquared_light(one, depths, fields, width) for width in widths] for one in imagers])
    off = np.full((len(imagers), len(images), len(widths), count), np.nan)
    for number, (image, found, point) in enumerate(zip(images, spots, points, strict=True)):
        views = host.views_of_all(point[None])
        field = np.linalg.norm(views.offset[:, 0], axis=1)
        distance, nearest = map(np.asarray, KDTree(found).query(views.spot[:, 0]))
        seen = np.flatnonzero((distance < match_radius(host.array.centers)) & (field < host.field_radius))
        light = subtract_background(image).light
        middle = np.rint(np.asarray(host.sensor.to_pixels(found[nearest[seen]]))).astype(int)
        for square, half in enumerate(_SQUARES):
            side = np.arange(-half, half + 1)
            row, column = (np.clip(at[:, None] + side, 0, n - 1) for at, n in zip(middle.T, light.shape, strict=True))
            total = light[row[:, :, None], column[:, None]].sum((1, 2))
            table = tables[:, square, np.searchsorted(depths, point[2])]
            expected = np.stack([np.interp(field[seen], fields, shares) for shares in table])
            logs = np.log(np.where(total > 0, total, np.nan)) - np.log(np.maximum(expected, _MIN_SHARE))
            off[:, number, square, seen] = logs
    off = off[:, np.isfinite(off).any((0, 2, 3))]
    cost = lambda factors: np.nansum(np.abs(off - factors[..., None]), (1, 2))
    solutions = []
    # Alternate between types and factors, starting from each lens as each type.
    for number, lens in np.ndindex(len(imagers), count):
        factors = off[number, :, :, lens]
        for _ in range(_ROUNDS):
            factors = np.nanmedian(off[cost(factors).argmin(0), :, :, np.arange(count)], 0)
        solutions.append(cost(factors))
    return min(solutions, key=lambda each: each.min(0).sum()).argmin(0)


# Smoothing before maxima are looked for and least distance of maxima, in pitches of the pattern; threshold of a
# maximum, relative to the brightest.
_SMOOTHING, _APART, _THRESHOLD = 1 / 7, 1 / 3, 0.02
# The background is the darkest place within a pitch: smoothing of the image before and after, in pitches.
_BEFORE, _AFTER = 1 / 14, 1 / 2
# The light of a spot is that within this distance of its middle, in pitches, less the light of the darkest share.
_REACH, _DARKEST = 0.5, 0.1
# Least distance of the nearest neighbour that counts, in pitches; the most is one.
_NEAREST = 0.6
# Rounds in which middles and widths are found by turns; distance from the maximum that a middle may have, in pitches.
_BLURRED_ROUNDS, _FARTHEST = 3, 0.25
# Standard deviation of the window over the half-light radius, which is 1.18 of a Gaussian spot. A narrower window
# rests where a disc is brightest: of real white images the pitch changes by 0.1 % from 0.5 to 1.2, by 0.01 % above.
BLURRED_WINDOW = 1.2
# Pixels that are worked on at once.
_PIXELS = 1_000_000


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
    image = np.asarray(image, np.float64)
    light = image - _darkness(image, pitch)
    smooth = gaussian_smooth(light, _SMOOTHING * pitch)
    least = _THRESHOLD * max(float(smooth.max()), 0)
    peaks = peak_local_max(smooth, min_distance=max(int(_APART * pitch), 1), threshold_abs=least, exclude_border=False)
    border = np.minimum(peaks, np.array(image.shape) - 1 - peaks).min(1)
    peaks = peaks[border >= _REACH * pitch][:most].astype(float)
    if not len(peaks):
        return np.zeros((0, 2)), np.zeros(0)
    pitches = np.clip(np.asarray(KDTree(peaks).query(peaks, 2)[0])[:, 1], _NEAREST * pitch, pitch)
    middles, radii = peaks, _REACH * pitches / 2
    for _ in range(_BLURRED_ROUNDS):
        middles = mean_shift(light, peaks, BLURRED_WINDOW * radii, pitches)
        radii = np.maximum(half_light_radii(light, middles, pitches), 1.0)
    order = np.argsort(np.linalg.norm(middles - np.median(middles, 0), axis=1))
    return middles[order], radii[order]


def _darkness(image, pitch: float):
    """The light between spots: where discs touch, it is all that is left of the background."""
    smooth = gaussian_smooth(image, _BEFORE * pitch)
    darkest = minimum_filter(smooth, size=2 * int(np.ceil(pitch / 2)) + 1, mode="nearest")
    return gaussian_smooth(darkest, _AFTER * pitch)


def half_light_radii(
    image: Image, middles: Float64[np.ndarray, "spot 2"], pitches: Float64[np.ndarray, " spot"]
) -> Float64[np.ndarray, " spot"]:
    """Radius within which half of the light of each spot is, pixels.

    The light is that within half a pitch, pixels, of the middle `(row, column)`, less the darkest tenth's.
    """
    image, radii = np.asarray(image, np.float64), np.zeros(len(middles))
    for spots in _batches(pitches, _REACH):
        squares, inside, side, start = _squares(image, middles[spots], _REACH * pitches[spots])
        away = side + (start - middles[spots])[:, :, None]
        distance = np.hypot(away[:, 0, :, None], away[:, 1, None, :])
        inside &= distance <= _REACH * pitches[spots, None, None]
        for spot, square, apart, use in zip(spots, squares, distance, inside, strict=True):
            light, apart = square[use], apart[use]
            order = np.argsort(apart)
            total = np.cumsum(np.maximum(light - np.quantile(light, _DARKEST), 0)[order])
            radii[spot] = np.interp(total[-1] / 2, total, apart[order]) if total[-1] > 0 else 0.0
    return radii


def mean_shift(
    light: Float64[np.ndarray, "row column"],
    peaks: Float64[np.ndarray, "spot 2"],
    deviations: Float64[np.ndarray, " spot"],
    pitches: Float64[np.ndarray, " spot"],
) -> Float64[np.ndarray, "spot 2"]:
    """Where Gaussian windows come to rest that move from maxima to the centroids of what they see.

    A window ends at half a pitch, and rests within a quarter of its maximum; all in pixels, `(row, column)`.
    """
    middles = np.array(peaks, np.float64)
    for spots in _batches(pitches, _REACH + _FARTHEST):
        squares, inside, side, start = _squares(light, peaks[spots], (_REACH + _FARTHEST) * pitches[spots])
        squares = np.maximum(squares, 0) * inside
        moving = np.arange(len(spots))
        for _ in range(MAX_MOVES):
            which = spots[moving]
            away = side + (start[moving] - middles[which])[:, :, None]
            end, wide = _REACH * pitches[which, None, None], deviations[which, None, None]
            weights = np.exp(-((away / wide) ** 2) / 2)
            distance = np.sqrt(away[:, 0, :, None] ** 2 + away[:, 1, None, :] ** 2)
            seen = squares[moving] * np.clip(end - distance + 0.5, 0, 1)
            seen *= weights[:, 0, :, None] * weights[:, 1, None, :]
            along = np.stack([seen.sum(2), seen.sum(1)], 1)
            total = along[:, 0].sum(1)
            step = (along * away).sum(2) / np.where(total > 0, total, 1)[:, None]
            off = middles[which] + step - peaks[which]
            far = np.linalg.norm(off, axis=1, keepdims=True)
            moved = peaks[which] + off * np.minimum(1.0, _FARTHEST * pitches[which, None] / np.maximum(far, 1e-9))
            still = np.abs(moved - middles[which]).max(1) < MOVE_TOLERANCE * deviations[which]
            middles[which] = moved
            moving = moving[~still & (total > 0)]
            if not len(moving):
                break
    return middles


def _batches(pitches, reach: float) -> list[np.ndarray]:
    """Indices of spots whose squares hold so many pixels that they fit into the memory together."""
    side = 2 * reach * float(pitches.max(initial=1)) + 3
    return np.array_split(np.arange(len(pitches)), max(int(np.ceil(len(pitches) * side**2 / _PIXELS)), 1))


def _squares(image, middles, reaches):
    """Pixels about middles, which of them are in the image, their offsets, and the pixels that these count from."""
    half, start = int(np.ceil(reaches.max(initial=1))) + 1, np.rint(middles).astype(int)
    side = np.arange(-half, half + 1)
    rows, columns = (start[:, axis, None] + side for axis in (0, 1))
    inside = ((rows >= 0) & (rows < image.shape[0]))[:, :, None] & ((columns >= 0) & (columns < image.shape[1]))[
        :, None
    ]
    rows, columns = (np.clip(at, 0, size - 1) for at, size in zip((rows, columns), image.shape, strict=True))
    return image[rows[:, :, None], columns[:, None]], inside, side, start
