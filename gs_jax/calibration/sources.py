"""Point sources of a calibration, the assignment of spots to them and to lenses, and other positions that would fit."""

from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.spatial import KDTree

from ..base.errors import InputError
from ..geometry import Imager
from ..optics.raytrace import to_numpy
from .spot_model import CoreOffsets, blurred_radius, match_radius, predict_spots
from .spots import MIN_DISTANCE, MOST_BLURRED, SPOTS_PER_SOURCE

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
