"""Spots in captures: sharp and wide ones, and the assignment of spots to point sources and lenses.

The middle of a spot is where a Gaussian window that moves to the centroid of what it sees comes to rest (mean shift),
so that rays far from the core do not count.

Wide spots are out of focus, aberrated, or lenses' images of an even surface. Their window is as wide as the spot
itself, so that it does not stop at structure within the spot. It ends half-way to the nearest neighbour, so that discs
that touch do not shift each other's middles: it then contains the whole disc, with its edges. The background is the
light between neighbouring spots, and the smooth part of the light that falls on the pattern is divided out.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import minimum_filter
from scipy.spatial import KDTree
from skimage.feature import peak_local_max

from ..base.errors import InputError
from ..base.typing import Image
from ..detection.background import gaussian_smooth, subtract_background
from ..microscope.geometry import Imager
from ..microscope.layouts import nearest_neighbour_distances
from ..optics.raytrace import to_numpy
from .spot_model import MAX_MOVES, MOVE_TOLERANCE, WINDOW, CoreOffsets, blurred_radius, match_radius, predict_spots

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


# Least share of expected spots in a capture that fits, sharp and wide ones: chance puts a spot of twenty, and a wide
# one of five, near to where it is expected.
_LEAST_SHARE, _LEAST_SHARE_WIDE = 0.25, 0.5
# Predicted spots closer than this, over `match_radius`, are blurred into one.
_BLURRED = 0.5
# Most captures of which all pairs are swapped, alternatives that are fitted, and names of one that messages list.
_MOST_SWAPPED, _MOST_FITTED, _MOST_NAMED = 10, 3, 2

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

    @property
    def known(self) -> Bool[np.ndarray, " source"]:
        """Whether all coordinates of each source are known."""
        return np.asarray(np.isfinite(self.points).all(1))

    def check(self, count: int, imager: Imager, fit: Sequence[str], blurred: Collection[int] = ()) -> None:
        """`InputError` unless each of `count` captures has a source where the imager's object may be.

        Also if the known coordinates cannot determine what is to be fitted, whatever the spots are.
        """
        for fault in self._faults(count, imager, fit, blurred):
            raise InputError(f"positions: {fault}.")

    def _faults(self, count, imager: Imager, fit, blurred) -> Iterator[str]:
        x_y, depths, begins = self.points[:, :2], self.points[:, 2], float(imager.sample_surface)
        without = sorted(set(range(count)) - set(self.captures.tolist()))
        if not count or without or len(self.points) != len(self.captures):
            which = f", none in capture {without[0] + 1}" if without else ""
            got = f"got {len(self.points)} sources for {count} captures{which}"
            yield f"every capture needs one or more sources, {got}"
        for number in self.captures[(self.captures < 0) | (self.captures >= count)]:
            yield f"captures are numbered 1 to {count}, got a source in capture {number + 1}"
        if (depths <= 0).any():
            yield f"depths must be positive, got {np.nanmin(depths):g} mm"
        # Where the sample begins may be a guess.
        if "sample_at" not in fit and (depths < begins * (1 - 1e-6)).any():
            where = f"{begins:g} mm, where the {'filters end' if imager.sample is None else 'sample begins'}"
            yield f"depths must be {where}, or more, got {np.nanmin(depths):g} mm"
        of_depth = [name for name in ("sensor_distance", "depth_offset") if name in fit]
        if of_depth and np.isnan(depths).all():
            remedy = f"give the depth of a source, or hold {of_depth[0]}"
            yield f"no known depth to fit {' and '.join(of_depth)} by; {remedy}"
        if "shift" in fit and np.isnan(x_y).any(1).all():
            yield "no source with known x and y to fit shift by; give x and y of a source, or hold shift"
        for number in blurred:
            if (several := int((self.captures == number).sum())) != 1:
                needs = f"capture {number + 1} must have one source, as each lens has one image in it"
                yield f"{needs}, got {several}"


class Spots(NamedTuple):
    """Spots with their sources and lenses; positions on the sensor, mm.

    `expected` is the number of spots that each capture should show, `away` the median distance of these from the
    nearest spot of the capture, mm. NaN without any.
    """

    sources: Int[np.ndarray, " spot"]
    lenses: Int[np.ndarray, " spot"]
    positions: Float64[np.ndarray, "spot 2"]
    expected: Int[np.ndarray, " capture"] | None = None
    away: Float64[np.ndarray, " capture"] | None = None


class CaptureFit(NamedTuple):
    """How well a geometry explains a capture: spots used of those expected, and their residual.

    `away` is the median distance of expected spots from the nearest ones of the capture; lengths are in pixels.
    """

    spots: int
    expected: int
    rms: float
    away: float
    fits: bool

    def __str__(self) -> str:
        counts = f"{self.spots} of {self.expected} expected spots"
        return f"{counts}, {self.rms:.3f} pixels RMS" if self.spots else counts


class MisfitError(InputError):
    """Captures that the geometry of the others does not explain; `fits` has what it explains of each."""

    def __init__(self, fits: Sequence[CaptureFit], message: str):
        super().__init__(message)
        self.fits = fits


def assign_spots(spots: SpotLists, sources: Sources, imager: Imager, offsets: CoreOffsets, within: float) -> Spots:
    """Assign to each source and lens within the field radius the spot nearest to its prediction, at most `within` away.

    Blurred spots may be `blurred_radius` away. A source with an unknown coordinate has no spots. Lengths are in mm.
    """
    centers, sharp = to_numpy(imager).centers, sources.sharp
    predicted = np.asarray(predict_spots(imager, np.nan_to_num(sources.points, nan=1.0), offsets, sharp), np.float64)
    beside = np.linalg.norm(centers[None] - sources.points[:, None, :2], axis=-1)
    seen = ((beside < imager.field_radius) | ~sharp[:, None]) & sources.known[:, None]
    # Lenses beside the sensor show nothing.
    inside = np.abs(np.asarray(imager.sensor.to_pixels(predicted)) - (np.array(imager.sensor.shape) - 1) / 2)
    seen &= (inside < np.array(imager.sensor.shape) / 2 - MIN_DISTANCE).all(-1)
    rows: list[np.ndarray] = [np.zeros((0, 4))]
    blurred = _BLURRED * match_radius(imager.array.centers)
    expected, away = np.zeros(len(spots), int), np.full(len(spots), np.nan)
    for capture, positions in enumerate(spots):
        source, lens = np.argwhere(seen & (sources.captures == capture)[:, None]).T
        if not len(source):
            continue
        due = predicted[source, lens]
        alone = np.asarray(KDTree(due).query_ball_point(due, blurred, return_length=True)) == 1
        most = SPOTS_PER_SOURCE * len(np.unique(source)) if sharp[source[0]] else MOST_BLURRED * len(centers)
        expected[capture] = min(int(alone.sum()), most)
        if not len(positions):
            continue
        distance, nearest = map(np.asarray, KDTree(positions).query(due))
        away[capture] = np.median(distance)
        # A spot belongs to the nearest prediction only.
        least = np.full(len(positions), np.inf)
        np.minimum.at(least, nearest, distance)
        near = distance < (within if sharp[source[0]] else blurred_radius(imager.array.centers))
        use = alone & near & (distance == least[nearest])
        rows.append(np.column_stack([source[use], lens[use], positions[nearest[use]]]))
    table = np.concatenate(rows)
    return Spots(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:], expected, away)


def capture_fits(
    spots: Spots, lists: SpotLists, sources: Sources, pixel: float, off: Float64[np.ndarray, "spot 2"] | None = None
) -> list[CaptureFit]:
    """How assigned spots, of those of each capture, explain the captures; `off` are their residuals, pixels.

    A capture fits if a share of the spots that it can show are where they are expected, more than chance puts there.
    """
    assert spots.expected is not None and spots.away is not None
    of, fits = sources.captures[spots.sources], []
    for capture, positions in enumerate(lists):
        mine = of == capture
        expected, count = int(spots.expected[capture]), int(mine.sum())
        wide = not sources.sharp[sources.captures == capture].all()
        least = (_LEAST_SHARE_WIDE if wide else _LEAST_SHARE) * min(expected, len(positions))
        rms = float(np.sqrt((off[mine] ** 2).sum(1).mean())) if off is not None and count else np.nan
        away = float(spots.away[capture]) / pixel
        fits.append(CaptureFit(count, expected, rms, away, count > 0 and count >= least))
    return fits


def alternatives(sources: Sources) -> Iterator[tuple[str, Sources]]:
    """Other positions of sharp sources that a stage or a file may have meant, with what they change; none twice.

    Depths are reversed within their own range, as a stage's zero is not known better.
    """
    sharp = np.flatnonzero(sources.sharp)
    points, captures = sources.points[sharp], sources.captures[sharp]
    x, y, z = points.T
    back = np.nanmin(z) + np.nanmax(z) - z if np.isfinite(z).any() else z
    changes = [
        ("the sign of x reversed", np.stack([-x, y, z], -1)),
        ("the sign of y reversed", np.stack([x, -y, z], -1)),
        ("the direction of z reversed (near and far swapped)", np.stack([x, y, back], -1)),
        ("x and y swapped", np.stack([y, x, z], -1)),
        ("the signs of x and y reversed", np.stack([-x, -y, z], -1)),
    ]
    if len(np.unique(captures)) == len(captures):
        rows = np.arange(len(captures))
        for first, second in combinations(rows, 2) if len(rows) <= _MOST_SWAPPED else ():
            order = rows.copy()
            order[[first, second]] = second, first
            changes.append((f"captures {captures[first] + 1} and {captures[second] + 1} swapped", points[order]))
        changes.append(("the order of the captures reversed", points[::-1]))
    names: dict[bytes, list[str]] = {}
    for name, changed in changes:
        # Unknown coordinates stay unknown; -0 is 0.
        if (np.isnan(changed) == np.isnan(points)).all():
            names.setdefault((changed + 0.0).tobytes(), []).append(name)
    names.pop((points + 0.0).tobytes(), None)
    for key, alike in names.items():
        changed = sources.points.copy()
        changed[sharp] = np.frombuffer(key).reshape(points.shape)
        yield " or ".join(alike[:_MOST_NAMED]), sources._replace(points=changed)


def best_alternative(
    sources: Sources,
    explain: Callable[[Sources], Sequence[CaptureFit]],
    refine: Callable[[Sources], Sequence[CaptureFit]],
) -> str | None:
    """A remedy: the first alternative that explains most spots and fits all captures, with its residual.

    `explain` predicts spots without a fit, `refine` fits.
    """

    def fits_of(make: Callable[[Sources], Sequence[CaptureFit]], changed: Sources) -> Sequence[CaptureFit]:
        try:
            fits = make(changed)
        except InputError:
            return []
        return fits if all(fit.fits for fit in fits) else []

    candidates = []
    for name, changed in alternatives(sources):
        if fits := fits_of(explain, changed):
            candidates.append((sum(fit.spots for fit in fits), name, changed))
    for _, name, changed in sorted(candidates, key=lambda candidate: -candidate[0])[:_MOST_FITTED]:
        if fits := fits_of(refine, changed):
            spots = np.array([fit.spots for fit in fits])
            rms = float(np.sqrt((spots * np.array([fit.rms for fit in fits]) ** 2).sum() / spots.sum()))
            return f"with {name} all would fit, {rms:.2f} pixels RMS: correct the positions."
    return None


def describe_misfit(fits: Sequence[CaptureFit], remedy: str | None, *, tried: bool = True) -> str:
    """One line about captures that a geometry does not explain; `tried` says if other positions were."""
    wrong = [number for number, fit in enumerate(fits, 1) if not fit.fits]
    first = fits[wrong[0] - 1]
    which = f"capture {wrong[0]}" if len(wrong) == 1 else f"captures {', '.join(map(str, wrong))}"
    got = f"{which} of {len(fits)} {'does' if len(wrong) == 1 else 'do'} not fit, "
    got += f"{'the first ' * (len(wrong) > 1)}with {first.spots} of {first.expected} expected spots"
    if np.isfinite(first.away):
        got += f" (the nearest are {first.away:.0f} pixels away)"
    if not tried:
        return f"captures: {got}."
    cause = "are positions, order and pixel pitch right?"
    if len(wrong) > len(fits) / 2:
        cause = "are positions and pixel pitch right, and is there nothing but a lens array before the sensor?"
    return f"captures: {got}; {remedy or f'reversing an axis or swapping captures does not help: {cause}'}"
