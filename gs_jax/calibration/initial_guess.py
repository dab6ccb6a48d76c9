"""Initial guess of a calibration: rotation, mirroring, shift and sensor distance from the pattern of the lenses.

The spots of a point source are the lens centers, rotated, scaled, shifted and perhaps mirrored, whatever is between
them. Two spots and two lenses determine such a similarity; of all with a plausible scale, the one that puts most spots
on lenses is taken. Lenses of no list are where rays of several captures meet.
"""

import cmath
import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ..base.errors import InputError
from ..base.typing import Image
from ..detection.background import subtract_background
from ..microscope.geometry import Imager
from ..microscope.lenses import EACH, MicrolensArray
from ..optics.psf_core import FIELDS, ensquared_light
from ..optics.raytrace import to_numpy
from .spot_model import match_radius, trace_core_offsets, with_centers
from .spots import CaptureFit, Sources, SpotLists, assign_spots, capture_fits

# Brightest spots of each source that pairs begin with, and that are matched; sources and neighbours at most.
_FIRST, _TRIED, _MOST_SOURCES, _NEIGHBOURS = 5, 20, 3, 12
# Fewest spots on lenses of a clear pattern, and their share of those tried.
MIN_SPOTS, _MIN_SHARE = 6, 0.5
# Of blurred spots: their distance from lenses of the pattern, over `match_radius`, which chance meets more often, and
# the share that has to be on lenses.
_BLURRED, _BLURRED_SHARE = 3.0, 0.7
# How far a similarity is from the expected one must count less than a spot on a lens.
_FARTHEST = 1e3
# Similarities that are tried at once, and spots that are looked at before some are given up.
_BATCH, _FEW = 20_000, 5
# Relative error of a scale that is fitted.
_FREE_SCALE = 0.5
# Relative error of the sensor distance, and steps in which it is searched for without known lenses.
_DISTANCE_ERROR = 0.25
_DISTANCES = np.linspace(1 - _DISTANCE_ERROR, 1 + _DISTANCE_ERROR, 51)
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
# Half widths of the squares by whose light types of lenses are told apart, pixels; rounds of alternation; least share.
_SQUARES, _ROUNDS, _LEAST_LIGHT = (1, 5), 10, 1e-12


class Similarity(NamedTuple):
    """`p = factor c + shift` in complex numbers `x + iy`, of lens centers `c`, conjugated first if mirrored."""

    factor: complex
    shift: complex
    mirrored: bool
    on_lenses: int
    tried: int
    sources: int
    share: float = _MIN_SHARE

    @property
    def rotation(self) -> float:
        """Rotation of the array, radians."""
        return cmath.phase(self.factor)

    @property
    def is_clear(self) -> bool:
        """Whether enough spots are on lenses: a share of those of one source."""
        return self.on_lenses >= max(MIN_SPOTS, self.share * self.tried / self.sources)


def match_pattern(
    spots: Float[np.ndarray, "spot 2"],
    centers: Float[np.ndarray, "lens 2"],
    expected: complex | float,
    tolerance: float,
    sources: int = 1,
    *,
    blurred: bool = False,
    shift: complex = 0j,
) -> Similarity:
    """Find the similarity from lens centers to spots `(x, y)`, mm, brightest first, of one of some sources.

    The scale is that of the `expected` factor within a relative `tolerance`, the rotation is any. Middles of `blurred`
    spots may be three times as far from lenses. Of several similarities that fit equally, as with a regular array, it
    is the one nearest to what is expected: not mirrored, of this factor and `shift`, mm.
    """
    most = min(sources, _MOST_SOURCES)
    p, c = spots[: _TRIED * most] @ (1, 1j), centers @ (1, 1j)
    best = Similarity(1 + 0j, 0j, False, 0, len(p), sources, _BLURRED_SHARE if blurred else _MIN_SHARE)
    if len(p) < 3 or len(c) < 3:
        return best
    tree, radius = KDTree(centers), match_radius(centers) * (_BLURRED if blurred else 1)
    beside = np.asarray(tree.query(centers, k=min(_NEIGHBOURS + 1, len(c)))[1])
    first, second = np.repeat(np.arange(len(c)), beside.shape[1] - 1), beside[:, 1:].ravel()
    begin, end = np.meshgrid(np.arange(min(_FIRST * most, len(p))), np.arange(len(p)))
    begin, end, highest = begin[begin != end], end[begin != end], 0.0
    for mirrored in (False, True):
        lenses = c.conj() if mirrored else c
        factors = (p[end] - p[begin])[:, None] / (lenses[second] - lenses[first])
        pair, lens = np.nonzero(np.abs(np.abs(factors / expected) - 1) < tolerance)
        factor = factors[pair, lens]
        moved = p[begin[pair]] - factor * lenses[first[lens]]
        away = np.abs(np.log(factor / expected)) + np.abs(moved - shift) / np.abs(p).max() + mirrored
        order = np.argsort(away)
        for start in range(0, len(order), _BATCH):
            some = order[start : start + _BATCH]
            penalty = away[some] / _FARTHEST
            count = _count_on_lenses(p, factor[some], moved[some], highest + penalty, tree, mirrored, radius)
            rank = count - penalty
            top = int(rank.argmax())
            if rank[top] > highest:
                highest, k = float(rank[top]), some[top]
                best = best._replace(mirrored=mirrored, on_lenses=int(count[top]))
                best = best._replace(factor=complex(factor[k]), shift=complex(moved[k]))
    if best.on_lenses < 2:
        return best
    # Least squares over the spots on lenses.
    nearest = _nearest_lens(p, best.factor, best.shift, tree, best.mirrored, radius)
    distance, lens = (np.asarray(values)[0] for values in nearest)
    use = distance < radius
    lenses = (c.conj() if best.mirrored else c)[lens[use]]
    factor, moved = np.linalg.lstsq(np.stack([lenses, np.ones_like(lenses)], -1), p[use])[0]
    return best._replace(factor=complex(factor), shift=complex(moved))


def _count_on_lenses(p, factor, shift, least, tree, mirrored, radius):
    """Number of spots on lenses of each similarity; of those that cannot reach `least`, of the first spots alone."""
    count, remaining = np.zeros(len(factor), int), len(p)
    for few in np.array_split(p, -(-len(p) // _FEW)):
        which = np.flatnonzero(count + remaining > least)
        if len(which):
            count[which] += (_nearest_lens(few, factor[which], shift[which], tree, mirrored, radius)[0] < radius).sum(1)
        remaining -= len(few)
    return count


def _nearest_lens(p, factor, shift, tree, mirrored, radius):
    """Distance of each spot, mapped back to the plate, from the nearest lens, and that lens: `(similarity, spot)`.

    The distance is infinite if no lens is within the radius: that is all that counts, and much faster.
    """
    back = (p[None] - np.atleast_1d(shift)[:, None]) / np.atleast_1d(factor)[:, None]
    back = back.conj() if mirrored else back
    return tree.query(np.stack([back.real, back.imag], -1), distance_upper_bound=radius)


def match_shift(
    spots: Float[np.ndarray, "spot 2"], pattern: Float[np.ndarray, "lens 2"], radius: float
) -> tuple[Float64[np.ndarray, "2"], int]:
    """Find the displacement of a pattern of spots, mm, and the number of spots that agree on it within a radius."""
    if not len(spots) or not len(pattern):
        return np.zeros(2), 0
    apart = (spots[:, None] - pattern[None]).reshape(-1, 2)
    tree = KDTree(apart)
    count = tree.query_ball_point(apart, radius, return_length=True)
    together = tree.query_ball_point(apart[int(count.argmax())], radius)
    return np.median(apart[together], axis=0), len(together)


def triangulate_lenses(
    spots: SpotLists, points: Float[np.ndarray, "image 2"], magnifications: Float[np.ndarray, " image"], radius: float
) -> tuple[Float64[np.ndarray, "lens 2"], int, int]:
    """Find lens centers, mm, where rays of several captures meet, and the number of their spots and of pairs of spots.

    The ray from a point `q` of magnification M to its spot `p` passes the plate at `c = (p + M q) / (1 + M)`. Rays meet
    within `radius`.
    """
    passing = [(p + m * q) / (1 + m) for p, q, m in zip(spots, points, magnifications, strict=True)]
    positions, capture = np.concatenate(passing), np.repeat(np.arange(len(spots)), [len(p) for p in spots])
    pairs, count = KDTree(positions).query_pairs(radius, output_type="ndarray"), len(positions)
    pairs = pairs[capture[pairs[:, 0]] != capture[pairs[:, 1]]]
    _, group = connected_components(coo_array((np.ones(len(pairs)), tuple(pairs.T)), (count, count)), directed=False)
    size = np.bincount(group)
    several = np.flatnonzero(size > 1)
    sums = np.stack([np.bincount(group, column) for column in positions.T], -1)
    return sums[several] / size[several, None], int(size[several].sum()), len(pairs)


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
        start = _pose(match, sources.points[source], imager, scale)
        if not sources.sharp[source]:
            start = _pose_by_known(spots, sources, start)
        guesses.append(InitialGuess(start, match.mirrored, _locate_sources(spots, sources, start), scale))
    if len(guesses) == 1:
        return guesses[0]
    return max(guesses, key=lambda guess: sum(fit.spots for fit in explained(spots, guess)))


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
    # Mirrored is the complex conjugate: y becomes -y.
    flip = np.array([1.0, -1.0 if match.mirrored else 1.0])
    array = with_centers(array, np.asarray(array.centers) * of_array * flip)
    reduced = imager.reduced_sensor_distance if np.isnan(z) else magnification * float(imager.reduced_depth(z))
    distance = imager.sensor_distance_of(reduced)
    shift = (match.shift + magnification * complex(x, y)) / scale
    shift = imager.shift if np.isnan(shift) else (shift.real, shift.imag)
    return posed(imager, array=array, sensor_distance=distance, rotation=match.rotation, shift=shift)


def posed(imager: Imager, **values: Any) -> Imager:
    """The imager with other values of some fields, in its precision; None and arrays of lenses as they are."""
    dtype = imager.sensor_distance.dtype
    typed = [x if x is None or isinstance(x, MicrolensArray) else jnp.asarray(x, dtype) for x in values.values()]
    where = lambda i: [getattr(i, name) for name in values]
    return eqx.tree_at(where, imager, typed, is_leaf=lambda leaf: leaf is None)


def _pose_by_known(spots: SpotLists, sources: Sources, imager: Imager) -> Imager:
    """Sensor distance and shift at which the posed array explains most spots of a known source, if there is one.

    That source may show too few lenses for a pattern of its own.
    """
    best: tuple[int, float, np.ndarray] = 0, 1.0, np.zeros(2)
    centers, radius = to_numpy(imager).centers, match_radius(imager.array.centers)
    for source in np.flatnonzero(sources.known & sources.sharp):
        positions, point = spots[int(sources.captures[source])], sources.points[source]
        for step in _DISTANCES:
            magnification = step * float(imager.magnification(point[2]))
            pattern = (1 + magnification) * centers - magnification * point[:2]
            moved, count = match_shift(positions, pattern, radius)
            if count > best[0]:
                best = count, float(step), moved / (1 + magnification)
    _, step, moved = best
    distance = imager.sensor_distance_of(imager.reduced_sensor_distance * step)
    return posed(imager, sensor_distance=distance, shift=np.asarray(imager.shift) + moved)


def _locate_sources(spots: SpotLists, sources: Sources, imager: Imager) -> Sources:
    """Fill in unknown coordinates from where the pattern of the lenses is in the captures."""
    points, remaining = sources.points.copy(), [np.asarray(positions) for positions in spots]
    # Known sources first: their spots are not those of the others.
    for source in np.argsort(~sources.known, kind="stable"):
        capture = int(sources.captures[source])
        if not sources.known[source]:
            radius = match_radius(imager.array.centers) * (1 if sources.sharp[source] else _BLURRED)
            point = _locate(remaining[capture], points[source, 2], imager, radius)
            points[source] = np.where(np.isnan(points[source]), point, points[source])
        remaining[capture] = _remove_spots(remaining[capture], points[source], imager)
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
    if not sources.known.all() or len(np.unique(sources.captures)) < len(points) or len(points) < 2:
        unknown = f"{int((~sources.known).sum())} of {len(points)} points unknown"
        needs = "two or more known points, one in each capture, are needed to find lenses"
        raise InputError(f"positions: {needs}, got {unknown}.")
    spots = [spots[int(k)] for k in sources.captures]
    nominal = np.asarray(imager.magnification(points[:, 2]), np.float64)
    radius = _MEETING * imager.field_radius
    met = np.array([triangulate_lenses(spots, points[:, :2], step * nominal, radius / 4)[2] for step in _DISTANCES])
    step = float(_DISTANCES[met == met.max()].mean())
    centers, count, _ = triangulate_lenses(spots, points[:, :2], step * nominal, radius)
    if not count or count < _MIN_SHARED * sum(map(len, spots)):
        got = f"{count} of {sum(map(len, spots))} spots on lenses that several captures show"
        raise InputError(f"captures: got {got}, half are needed; are positions and the sensor's pixels right?")
    # Rotation, shift and tilt are contained in the lenses' positions.
    distance = imager.sensor_distance_of(imager.reduced_sensor_distance * step)
    imager = posed(imager, sensor_distance=distance, rotation=0.0, shift=np.zeros(2), tilt=None)
    types = [imager.array.of_type(number) for number in range(imager.array.type_count)]
    of_type = [posed(imager, array=with_centers(lenses, centers)) for lenses in types]
    guess = of_type[0]
    if len(types) > 1:
        which = classify_lenses([images[int(k)] for k in sources.captures], spots, points, of_type)
        numbers = {name: np.array([float(getattr(lenses, name)) for lenses in types])[which] for name in EACH}
        guess = posed(guess, array=dataclasses.replace(guess.array, **numbers))
    return InitialGuess(guess, False, sources)


def search_rotation(spots: Float64[np.ndarray, "spot 2"], imager: Imager, depths: tuple[float, float]) -> Imager:
    """The imager at the rotation at which most rays through spots and lenses meet."""
    near, far = (float(imager.magnification(depth)) for depth in depths)
    within = _MEETING_ON_SENSOR * match_radius(imager.array.centers)
    step = within / imager.field_radius
    magnifications = np.linspace(far, near, max(int(np.ceil((near - far) / step)) + 1, 2))
    steps = np.floor(_ROTATION / _ROTATION_STEP)
    turns = np.asarray(imager.rotation) + np.arange(-steps, steps + 1) * _ROTATION_STEP
    rotated = [posed(imager, rotation=turn) for turn in turns]
    return max(rotated, key=lambda imager: max(_concentration(spots, imager, m, within) for m in magnifications))


def _concentration(spots, imager: Imager, magnification: float, within: float) -> float:
    """How clearly rays meet in a plane: the sum of cubes of the number of rays near each."""
    centers = to_numpy(imager).centers
    points = ((1 + magnification) * centers - spots[:, None]) / magnification
    points = points[np.linalg.norm(points - centers, axis=-1) < imager.field_radius]
    if not len(points):
        return 0.0
    count = KDTree(points).query_ball_point(points, within / magnification, return_length=True)
    return float((np.asarray(count, float) ** 3).sum())


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
    tables = np.array([[ensquared_light(imager, depths, fields, width) for width in widths] for imager in imagers])
    off = np.full((len(imagers), len(images), len(widths), count), np.nan)
    for number, (image, positions, point) in enumerate(zip(images, spots, points, strict=True)):
        views = host.views_of_all(point[None])
        field = np.linalg.norm(views.offset[:, 0], axis=1)
        distance, nearest = map(np.asarray, KDTree(positions).query(views.spot[:, 0]))
        seen = np.flatnonzero((distance < match_radius(host.array.centers)) & (field < host.field_radius))
        light = subtract_background(image).light
        middle = np.rint(np.asarray(host.sensor.to_pixels(positions[nearest[seen]]))).astype(int)
        for square, half in enumerate(_SQUARES):
            side = np.arange(-half, half + 1)
            row, column = (np.clip(at[:, None] + side, 0, n - 1) for at, n in zip(middle.T, light.shape, strict=True))
            total = light[row[:, :, None], column[:, None]].sum((1, 2))
            table = tables[:, square, np.searchsorted(depths, point[2])]
            expected = np.stack([np.interp(field[seen], fields, shares) for shares in table])
            logs = np.log(np.where(total > 0, total, np.nan)) - np.log(np.maximum(expected, _LEAST_LIGHT))
            off[:, number, square, seen] = logs
    off = off[:, np.isfinite(off).any((0, 2, 3))]

    def cost(factors) -> np.ndarray:
        return np.nansum(np.abs(off - factors[..., None]), (1, 2))

    solutions = []
    # Alternate between types and factors, starting from each lens as each type.
    for number, lens in np.ndindex(len(imagers), count):
        factors = off[number, :, :, lens]
        for _ in range(_ROUNDS):
            factors = np.nanmedian(off[cost(factors).argmin(0), :, :, np.arange(count)], 0)
        solutions.append(cost(factors))
    return min(solutions, key=lambda costs: costs.min(0).sum()).argmin(0)
