"""Initial guess of a calibration: rotation, mirroring, shift and sensor distance from the pattern of the lenses."""

import cmath
import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from ..base.errors import InputError
from ..geometry import Imager
from ..lenses import EACH
from ..optics.raytrace import to_numpy
from ..typing import Image
from .pattern_matching import BLURRED, Similarity, match_pattern, match_shift, triangulate_lenses
from .sources import CaptureFit, Sources, SpotLists, assign_spots, capture_fits, classify_lenses
from .spot_model import match_radius, trace_core_offsets, with_centers

# Relative error of a scale that is fitted.
_FREE_SCALE = 0.5
# Relative error of the sensor distance, and number of steps in which it is searched for without known lenses.
_DISTANCE_ERROR, _STEPS = 0.25, 51
# Scale of the pattern for an unknown depth, and its relative error.
_SCALE, _SCALE_ERROR = 1.3, 0.2
# Initial guesses that are compared.
_GUESSES = 6
# Least share of the spots on lenses that other captures show, too, where lenses are searched for.
_MIN_SHARED = 0.5
# Range on either side and step of the search for the rotation, radians.
_ROTATION, _ROTATION_STEP = np.radians(5.0), np.radians(0.4)
# Distance on the sensor within which rays meet in a point, over `match_radius`.
_MEETING_ON_SENSOR = 0.5
# Distance within which rays meet in an unlisted lens, in field radii: 0.06 mm of the paper's.
_MEETING = 0.02


class InitialGuess(NamedTuple):
    """An imager and sources that explain most spots; `scale` is that of its array, in that of the design."""

    imager: Imager
    mirrored: bool
    sources: Sources
    scale: float = 1.0


def guess_from_pattern(
    spots: SpotLists, sources: Sources, imager: Imager, *, free_scale: bool = False, cache: dict | None = None
) -> InitialGuess:
    """Guess from the clearest pattern; of several sources in a capture, from the one that explains most spots.

    `cache` holds matches by capture and depth, which are added to it: they do not depend on where the source is beside
    the axis, except for those of a regular array.
    With `free_scale` the array behind blurred spots may have half to one and a half times the design's scale.
    `InputError` if no capture has a clear pattern.
    """
    centers = np.asarray(imager.array.centers, np.float64)
    cache, matches = {} if cache is None else cache, []
    for source, point in enumerate(sources.points):
        capture = int(sources.captures[source])
        in_capture = int((sources.captures == capture).sum())
        factor, shift, error = _expected(imager, point)
        blurred = not sources.sharp[source]
        error = _FREE_SCALE if free_scale and blurred else error
        if (key := (capture, float(point[2]))) not in cache:
            cache[key] = match_pattern(spots[capture], centers, factor, error, in_capture, blurred=blurred, shift=shift)
        matches.append((cache[key], source))
    matches.sort(key=lambda match: -match[0].on_lenses)
    best = matches[0][0]
    if not best.is_clear:
        needs = "most captures must show spots of point sources through this array"
        if not sources.sharp[matches[0][1]]:
            needs = "a pattern must show an image of each lens of this array, apart from its neighbours"
            needs += "" if free_scale else ", at the design's scale unless that is fitted"
        raise InputError(f"captures: {needs}, got {best.on_lenses} of {best.tried} bright spots on lenses at best.")
    clear = [(match, source) for match, source in matches if match.is_clear]
    # Points that lack a coordinate determine less of the geometry.
    clear.sort(key=lambda match: int(np.isnan(sources.points[match[1]]).sum()))
    # With one source in each capture, the clearest pattern is unambiguous.
    single = len(np.unique(sources.captures)) == len(sources.captures)
    guesses = []
    for match, source in clear[: 1 if single else _GUESSES]:
        free = free_scale and not sources.sharp[source] and not np.isnan(sources.points[source, 2])
        scale = abs(match.factor) / float(imager.scale(sources.points[source, 2])) if free else 1.0
        posed = _pose(match, sources.points[source], imager, scale)
        if not sources.sharp[source]:
            posed = _pose_by_known(spots, sources, posed)
        guesses.append(InitialGuess(posed, match.mirrored, _locate_sources(spots, sources, posed), scale))
    return (
        guesses[0]
        if len(guesses) == 1
        else max(guesses, key=lambda guess: sum(fit.spots for fit in explained(spots, guess)))
    )


def guess_from_pose(spots: SpotLists, sources: Sources, imager: Imager) -> InitialGuess:
    """The imager as it is, and the sources whose coordinates are unknown where it sees them."""
    return InitialGuess(imager, False, _locate_sources(spots, sources, imager))


def _expected(imager: Imager, point) -> tuple[complex, complex, float]:
    """Factor and shift of the pattern `p = s c - M q`, `s = 1 + M`, with the imager's pose; relative error of `s`."""
    x, y = np.nan_to_num(point[:2])
    scale, error = _SCALE, _SCALE_ERROR
    if not np.isnan(point[2]):
        scale = float(imager.scale(point[2]))
        error = _DISTANCE_ERROR * (1 - 1 / scale)
    factor = cmath.rect(scale, float(imager.rotation))
    return factor, scale * complex(*np.asarray(imager.shift)) - (scale - 1) * complex(x, y), error


def explained(spots: SpotLists, guess: InitialGuess) -> list[CaptureFit]:
    """What a guess explains of each capture."""
    imager, sources = guess.imager, guess.sources
    offsets = trace_core_offsets(imager, sources.points[sources.sharp, 2])
    assigned = assign_spots(spots, sources, imager, offsets, match_radius(imager.array.centers))
    return capture_fits(assigned, spots, sources, imager.sensor.pixel_pitch)


def _pose(match: Similarity, point, imager: Imager, of_array: float = 1.0) -> Imager:
    """The imager whose pattern `p = s c - M q`, `s = 1 + M`, is the matched one, of an array scaled by `of_array`."""
    scale, (x, y, z), array = abs(match.factor) / of_array, point, imager.array
    magnification = scale - 1
    array = with_centers(array, array.centers * jnp.asarray(of_array, array.centers.dtype))
    if match.mirrored:
        # The complex conjugate: y becomes -y.
        array = with_centers(array, array.centers * jnp.asarray([[1.0, -1.0]], array.centers.dtype))
    reduced = imager.reduced_sensor_distance if np.isnan(z) else magnification * float(imager.reduced_depth(z))
    distance = imager.sensor_distance_of(reduced)
    shift = (match.shift + magnification * complex(x, y)) / scale
    shift = imager.shift if np.isnan(shift) else (shift.real, shift.imag)
    where = lambda i: (i.array, i.sensor_distance, i.rotation, i.shift)
    typed = lambda value: jnp.asarray(value, imager.sensor_distance.dtype)
    return eqx.tree_at(where, imager, (array, typed(distance), typed(match.rotation), typed(shift)))


def _pose_by_known(spots: SpotLists, sources: Sources, imager: Imager) -> Imager:
    """Sensor distance and shift at which the posed array explains most spots of a known source, if there is one.

    That source may show too few lenses for a pattern of its own.
    """
    known = np.flatnonzero(~np.isnan(sources.points).any(1) & sources.sharp)
    best: tuple[int, float, tuple[float, float]] = 0, 1.0, (0.0, 0.0)
    centers, radius = to_numpy(imager).centers, match_radius(imager.array.centers)
    for source in known:
        found, point = spots[int(sources.captures[source])], sources.points[source]
        for step in np.linspace(1 - _DISTANCE_ERROR, 1 + _DISTANCE_ERROR, _STEPS):
            magnification = step * float(imager.magnification(point[2]))
            pattern = (1 + magnification) * centers - magnification * point[:2]
            moved, count = match_shift(found, pattern, radius)
            if count > best[0]:
                x, y = moved / (1 + magnification)
                best = count, float(step), (float(x), float(y))
    _, step, moved = best
    distance = imager.sensor_distance_of(imager.reduced_sensor_distance * step)
    where, dtype = lambda i: (i.sensor_distance, i.shift), imager.sensor_distance.dtype
    return eqx.tree_at(where, imager, (jnp.asarray(distance, dtype), imager.shift + jnp.asarray(moved, dtype)))


def _locate_sources(spots: SpotLists, sources: Sources, imager: Imager) -> Sources:
    """Fill in unknown coordinates from where the pattern of the lenses is in the captures."""
    points, left = sources.points.copy(), [np.asarray(found) for found in spots]
    # Known sources first: their spots are not those of the others.
    for source in np.argsort(np.isnan(points).any(1), kind="stable"):
        capture = int(sources.captures[source])
        missing = np.isnan(points[source])
        if missing.any():
            radius = match_radius(imager.array.centers) * (1 if sources.sharp[source] else BLURRED)
            found = _locate(left[capture], points[source, 2], imager, radius)
            points[source] = np.where(missing, found, points[source])
        left[capture] = _remove_spots(left[capture], points[source], imager)
    return sources._replace(points=points)


def _locate(spots, depth: float, imager: Imager, radius: float) -> tuple[float, float, float]:
    """The source that most of the spots belong to, at a depth, or at any if that is NaN."""
    if np.isnan(depth):
        match = match_pattern(spots, np.asarray(imager.array.centers, np.float64), _SCALE, _SCALE_ERROR)
        magnification = max(abs(match.factor) - 1, 1e-3)
        depth = max(float(imager.depth_of(imager.reduced_sensor_distance / magnification)), 1e-3)
    magnification = float(imager.magnification(depth))
    pattern = (1 + magnification) * to_numpy(imager).centers
    shift, _ = match_shift(spots, pattern, radius)
    x, y = -shift / magnification
    return float(x), float(y), depth


def _remove_spots(spots, point, imager: Imager):
    """The spots that do not belong to a source."""
    views = to_numpy(imager).views_of_all(np.asarray(point, np.float64)[None])
    seen = np.linalg.norm(views.offset[:, 0], axis=1) < imager.field_radius
    if not len(spots) or not seen.any():
        return spots
    return spots[np.asarray(KDTree(views.spot[seen, 0]).query(spots)[0]) > match_radius(imager.array.centers)]


def guess_without_lenses(
    spots: SpotLists, sources: Sources, imager: Imager, images: Sequence[Image] = ()
) -> InitialGuess:
    """Find lens centers where rays of known points meet, at the sensor distance at which most do.

    If the design has lenses of several types, the type of each is estimated from its spots in `images`. `InputError` if
    a point is unknown, a capture has several, or too few rays meet.
    """
    points = sources.points
    if np.isnan(points).any() or len(np.unique(sources.captures)) < len(points) or len(points) < 2:
        unknown = f"{int(np.isnan(points).any(1).sum())} of {len(points)} points unknown"
        needs = "two or more known points, one in each capture, are needed to find lenses"
        raise InputError(f"positions: {needs}, got {unknown}.")
    spots = [spots[int(k)] for k in sources.captures]
    nominal = np.asarray(imager.magnification(points[:, 2]), np.float64)
    steps = np.linspace(1 - _DISTANCE_ERROR, 1 + _DISTANCE_ERROR, _STEPS)
    radius = _MEETING * imager.field_radius
    met = np.array([triangulate_lenses(spots, points[:, :2], step * nominal, radius / 4)[2] for step in steps])
    step = float(steps[met == met.max()].mean())
    centers, count, _ = triangulate_lenses(spots, points[:, :2], step * nominal, radius)
    if not count or count < _MIN_SHARED * sum(map(len, spots)):
        got = f"{count} of {sum(map(len, spots))} spots on lenses that several captures show"
        raise InputError(f"captures: got {got}, half are needed; are positions and the sensor's pixels right?")
    distance = imager.sensor_distance_of(imager.reduced_sensor_distance * step)
    types = [imager.array.of_type(number) for number in range(imager.array.type_count)]
    where = lambda i: (i.array, i.sensor_distance, i.rotation, i.shift, i.tilt)
    zero = jnp.zeros((), imager.sensor_distance.dtype)
    # Rotation, shift and tilt are contained in the lenses' positions.
    pose = (distance, zero, jnp.zeros(2, zero.dtype), None)
    of_type = [
        eqx.tree_at(where, imager, (with_centers(one, centers), *pose), is_leaf=lambda leaf: leaf is None)
        for one in types
    ]
    guess = of_type[0]
    if len(types) > 1:
        which = classify_lenses([images[int(k)] for k in sources.captures], spots, points, of_type)
        numbers = {name: np.array([float(getattr(one, name)) for one in types])[which] for name in EACH}
        guess = eqx.tree_at(lambda i: i.array, guess, dataclasses.replace(guess.array, **numbers))
    return InitialGuess(guess, False, sources)


def search_rotation(spots: Float64[np.ndarray, "spot 2"], imager: Imager, depths: tuple[float, float]) -> Imager:
    """The imager at the rotation at which most rays through spots and lenses meet."""
    near, far = (float(imager.magnification(depth)) for depth in depths)
    within = _MEETING_ON_SENSOR * match_radius(imager.array.centers)
    step = within / imager.field_radius
    magnifications = np.linspace(far, near, max(int(np.ceil((near - far) / step)) + 1, 2))
    steps = np.floor(_ROTATION / _ROTATION_STEP)
    turns = imager.rotation + jnp.asarray(np.arange(-steps, steps + 1) * _ROTATION_STEP, imager.rotation.dtype)
    rotated = [eqx.tree_at(lambda i: i.rotation, imager, turn) for turn in turns]
    return max(rotated, key=lambda one: max(_concentration(spots, one, m, within) for m in magnifications))


def _concentration(spots, imager: Imager, magnification: float, within: float) -> float:
    """How clearly rays meet in a plane: the sum of cubes of the number of rays near each."""
    centers = to_numpy(imager).centers
    points = ((1 + magnification) * centers - spots[:, None]) / magnification
    points = points[np.linalg.norm(points - centers, axis=-1) < imager.field_radius]
    if not len(points):
        return 0.0
    count = KDTree(points).query_ball_point(points, within / magnification, return_length=True)
    return float((np.asarray(count, float) ** 3).sum())
