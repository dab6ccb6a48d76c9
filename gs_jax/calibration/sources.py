"""Point sources of a calibration, their spots in captures, and the assignment of spots to sources and lenses.

The middle of a spot is where a Gaussian window that moves to the centroid of what it sees comes to rest (mean shift),
so that rays far from the core do not count. Wide spots are in `spots.py`.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.spatial import KDTree
from skimage.feature import peak_local_max

from ..base.errors import InputError
from ..detection.background import subtract_background
from ..geometry import Imager
from ..layouts import nearest_neighbour_distances
from ..optics.lens_types import FIELDS
from ..optics.psf_core import ensquared_light
from ..optics.raytrace import to_numpy
from ..typing import Image
from .spot_model import MAX_MOVES, MOVE_TOLERANCE, WINDOW, CoreOffsets, blurred_radius, match_radius, predict_spots
from .spots import BLURRED_WINDOW, find_blurred_spots

# Half width of the square that the window sees, pixels.
_HALF = 4
# Threshold of a spot over the noise, and least distance of spots, pixels.
_THRESHOLD_SNR, _MIN_DISTANCE = 8.0, 6
# Spots looked for in a capture, for each of its sources.
_SPOTS = 60
# Wide spots looked for, over the number of lenses.
_MOST_BLURRED = 2
# Least share of expected spots in a capture that fits, sharp and wide ones: chance puts a spot of twenty, and a wide
# one of five, near to where it is expected.
_LEAST_SHARE, _LEAST_SHARE_WIDE = 0.25, 0.5
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
        said = f"{self.spots} of {self.expected} expected spots"
        return f"{said}, {self.rms:.3f} pixels RMS" if self.spots else said


class MisfitError(InputError):
    """Captures that the geometry of the others does not explain; `fits` has what it explains of each."""

    def __init__(self, fits: Sequence[CaptureFit], message: str):
        super().__init__(message)
        self.fits = fits


def find_spots(image: Image, most: int) -> Float64[np.ndarray, "spot 2"]:
    """Find the brightest spots, brightest first, as fractional `(row, column)`; none within six pixels of the edge."""
    light, noise = subtract_background(image)
    threshold = _THRESHOLD_SNR * float(np.median(noise))
    peaks = peak_local_max(light, min_distance=_MIN_DISTANCE, threshold_abs=threshold, num_peaks=most)
    return np.array([_middle_of_pixels(light, peak) for peak in peaks]).reshape(-1, 2)


def find_blurred_spots_mm(
    image: Image, imager: Imager, window: float = BLURRED_WINDOW
) -> tuple[Float64[np.ndarray, "spot 2"], float]:
    """Wide spots, as far apart as lenses, `(x, y)` on the sensor, mm, and their median width in that of a sharp one."""
    centers = np.asarray(imager.array.centers, np.float64)
    pitch = float(nearest_neighbour_distances(centers).mean()) / imager.sensor.pixel_pitch
    middles, radii = find_blurred_spots(image, pitch, _MOST_BLURRED * len(centers), window)
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
    centers = to_numpy(imager).centers
    sharp = sources.sharp
    predicted = np.asarray(predict_spots(imager, np.nan_to_num(sources.points, nan=1.0), offsets, sharp), np.float64)
    beside = np.linalg.norm(centers[None] - sources.points[:, None, :2], axis=-1)
    seen = ((beside < imager.field_radius) | ~sharp[:, None]) & ~np.isnan(sources.points.sum(1))[:, None]
    # Lenses beside the sensor show nothing.
    inside = np.abs(np.asarray(imager.sensor.to_pixels(predicted)) - (np.array(imager.sensor.shape) - 1) / 2)
    seen &= (inside < np.array(imager.sensor.shape) / 2 - _MIN_DISTANCE).all(-1)
    rows, blurred = [], _BLURRED * match_radius(imager.array.centers)
    expected, away = np.zeros(len(spots), int), np.full(len(spots), np.nan)
    for capture, found in enumerate(spots):
        source, lens = np.argwhere(seen & (sources.captures == capture)[:, None]).T
        if not len(source):
            continue
        wanted = predicted[source, lens]
        alone = np.asarray(KDTree(wanted).query_ball_point(wanted, blurred, return_length=True)) == 1
        most = _SPOTS * len(np.unique(source)) if sharp[source[0]] else _MOST_BLURRED * len(centers)
        expected[capture] = min(int(alone.sum()), most)
        if not len(found):
            continue
        distance, nearest = (np.asarray(part) for part in KDTree(found).query(wanted))
        away[capture] = np.median(distance)
        near = distance < (within if sharp[source[0]] else blurred_radius(imager.array.centers))
        rows += [
            (source[k], lens[k], *found[nearest[k]])
            for k in np.flatnonzero(alone * near)
            # A spot belongs to the nearest prediction only.
            if distance[k] == distance[nearest == nearest[k]].min()
        ]
    table = np.array(rows, np.float64).reshape(-1, 4)
    return Spots(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:], expected, away)


def capture_fits(
    spots: Spots, lists: SpotLists, sources: Sources, pixel: float, off: Float64[np.ndarray, "spot 2"] | None = None
) -> list[CaptureFit]:
    """How assigned spots, of those of each capture, explain the captures; `off` are their residuals, pixels.

    A capture fits if a share of the spots that it can show are where they are expected, more than chance puts there.
    """
    assert spots.expected is not None and spots.away is not None
    of, fits = sources.captures[spots.sources], []
    for capture, found in enumerate(lists):
        mine = of == capture
        expected, count = int(spots.expected[capture]), int(mine.sum())
        wide = not sources.sharp[sources.captures == capture].all()
        least = (_LEAST_SHARE_WIDE if wide else _LEAST_SHARE) * min(expected, len(found))
        rms = float(np.sqrt((off[mine] ** 2).sum(1).mean())) if off is not None and count else np.nan
        away = float(spots.away[capture]) / pixel
        fits.append(CaptureFit(count, expected, rms, away, count > 0 and count >= least))
    return fits


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
