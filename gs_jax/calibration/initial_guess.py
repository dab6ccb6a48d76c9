"""Initial guess of a calibration: rotation, mirroring, shift and sensor distance from the pattern of the lenses.

The spots of a point source are the lens centers, rotated, scaled, shifted and perhaps mirrored. Two spots and two
lenses determine such a similarity; of all with a plausible scale, the one that puts most spots on lenses is taken.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ..base.errors import InputError
from ..geometry import Imager
from ..lenses import EACH, lenses_by_type
from ..optics.raytrace import to_numpy
from ..typing import Image
from .spot_model import match_radius, trace_core_offsets, with_centers
from .spots import Sources, SpotLists, assign_spots, classify_lenses

# Brightest spots of each source that pairs begin with, and that are matched; sources and neighbours at most.
_FIRST, _TRIED, _MOST_SOURCES, _NEIGHBOURS = 5, 20, 3, 12
# Fewest spots on lenses of a clear pattern, and their share of those tried.
_MIN_SPOTS, _MIN_SHARE = 6, 0.5
# Similarities that are tried at once.
_BATCH = 20_000
# Relative error of the sensor distance, and number of steps in which it is searched for without known lenses.
_DISTANCE_ERROR, _STEPS = 0.25, 51
# Scale of the pattern for an unknown depth, and its relative error.
_SCALE, _SCALE_ERROR = 1.3, 0.2
# Initial guesses that are compared.
_GUESSES = 6
# Least share of the spots on lenses that other captures show, too, where lenses are searched for.
_MIN_SHARED = 0.5
# Distance within which rays meet in an unlisted lens, in field radii: 0.06 mm of the paper's.
_MEETING = 0.02


class Similarity(NamedTuple):
    """`p = factor c + shift` in complex numbers `x + iy`, of lens centers `c`, conjugated first if mirrored."""

    factor: complex
    shift: complex
    mirrored: bool
    on_lenses: int
    tried: int
    sources: int

    @property
    def rotation(self) -> float:
        """Rotation of the array, radians."""
        return math.atan2(self.factor.imag, self.factor.real)

    @property
    def is_clear(self) -> bool:
        """Whether enough spots are on lenses: half of those of one source."""
        return self.on_lenses >= max(_MIN_SPOTS, _MIN_SHARE * self.tried / self.sources)


def match_pattern(
    spots: Float[np.ndarray, "spot 2"],
    centers: Float[np.ndarray, "lens 2"],
    scale: float,
    tolerance: float,
    sources: int = 1,
) -> Similarity:
    """Find the similarity from lens centers to spots `(x, y)`, mm, brightest first, of one of some sources.

    `scale` is expected within a relative `tolerance`.
    """
    most = min(sources, _MOST_SOURCES)
    p, c = spots[: _TRIED * most] @ (1, 1j), centers @ (1, 1j)
    best = Similarity(1 + 0j, 0j, False, 0, len(p), sources)
    if len(p) < 3 or len(c) < 3:
        return best
    tree, radius = KDTree(centers), match_radius(centers)
    beside = np.asarray(tree.query(centers, k=min(_NEIGHBOURS + 1, len(c)))[1])
    first, second = np.repeat(np.arange(len(c)), beside.shape[1] - 1), beside[:, 1:].ravel()
    begin, end = np.meshgrid(np.arange(min(_FIRST * most, len(p))), np.arange(len(p)))
    one, other = begin[begin != end], end[begin != end]
    for mirrored in (False, True):
        lenses = c.conj() if mirrored else c
        factors = (p[other] - p[one])[:, None] / (lenses[second] - lenses[first])
        pairs = np.argwhere(np.abs(np.abs(factors) / scale - 1) < tolerance)
        for start in range(0, len(pairs), _BATCH):
            pair, lens = pairs[start : start + _BATCH].T
            factor = factors[pair, lens]
            shift = p[one[pair]] - factor * lenses[first[lens]]
            count = (_nearest_lens(p, factor, shift, tree, mirrored)[0] < radius).sum(1)
            top = int(count.argmax())
            if count[top] > best.on_lenses:
                best = Similarity(complex(factor[top]), complex(shift[top]), mirrored, int(count[top]), len(p), sources)
    if best.on_lenses < 2:
        return best
    # Least squares over the spots on lenses.
    nearest = _nearest_lens(p, best.factor, best.shift, tree, best.mirrored)
    distance, lens = (np.asarray(part)[0] for part in nearest)
    use = distance < radius
    lenses = (c.conj() if best.mirrored else c)[lens[use]]
    factor, shift = np.linalg.lstsq(np.stack([lenses, np.ones_like(lenses)], -1), p[use])[0]
    return best._replace(factor=complex(factor), shift=complex(shift))


def _nearest_lens(p, factor, shift, tree, mirrored):
    """Distance of each spot, mapped back to the plate, from the nearest lens, and that lens: `(similarity, spot)`."""
    back = (p[None] - np.atleast_1d(shift)[:, None]) / np.atleast_1d(factor)[:, None]
    back = back.conj() if mirrored else back
    return tree.query(np.stack([back.real, back.imag], -1))


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
    """An imager and sources that explain most spots."""

    imager: Imager
    mirrored: bool
    sources: Sources


def guess_from_pattern(spots: SpotLists, sources: Sources, imager: Imager) -> InitialGuess:
    """Guess from the clearest pattern; of several sources in a capture, from the one that explains most spots.

    `InputError` if no capture has a clear pattern.
    """
    centers = np.asarray(imager.array.centers, np.float64)
    matches = []
    for source, point in enumerate(sources.points):
        capture = int(sources.captures[source])
        in_capture = int((sources.captures == capture).sum())
        matches.append((match_pattern(spots[capture], centers, *_scale(imager, point[2]), in_capture), source))
    matches.sort(key=lambda match: -match[0].on_lenses)
    best = matches[0][0]
    if not best.is_clear:
        needs = "most captures must show spots of point sources through this array"
        raise InputError(f"captures: {needs}, got {best.on_lenses} of {best.tried} bright spots on lenses at best.")
    clear = [(match, source) for match, source in matches if match.is_clear]
    # Points that lack a coordinate determine less of the geometry.
    clear.sort(key=lambda match: int(np.isnan(sources.points[match[1]]).sum()))
    # With one source in each capture, the clearest pattern is unambiguous.
    single = len(np.unique(sources.captures)) == len(sources.captures)
    guesses = []
    for match, source in clear[: 1 if single else _GUESSES]:
        posed = _pose(match, sources.points[source], imager)
        guesses.append(InitialGuess(posed, match.mirrored, _locate_sources(spots, sources, posed)))
    return guesses[0] if len(guesses) == 1 else max(guesses, key=lambda guess: _explained(spots, guess))


def guess_from_pose(spots: SpotLists, sources: Sources, imager: Imager) -> InitialGuess:
    """The imager as it is, and the sources whose coordinates are unknown where it sees them."""
    return InitialGuess(imager, False, _locate_sources(spots, sources, imager))


def _scale(imager: Imager, depth: float) -> tuple[float, float]:
    """Expected scale of the pattern on the sensor, and its relative error."""
    if np.isnan(depth):
        return _SCALE, _SCALE_ERROR
    scale = float(imager.scale(depth))
    return scale, _DISTANCE_ERROR * (1 - 1 / scale)


def _explained(spots: SpotLists, guess: InitialGuess) -> int:
    offsets = trace_core_offsets(guess.imager, guess.sources.points[:, 2])
    return len(
        assign_spots(spots, guess.sources, guess.imager, offsets, match_radius(guess.imager.array.centers)).lenses
    )


def _pose(match: Similarity, point, imager: Imager) -> Imager:
    """The imager whose pattern `p = s c - M q`, `s = 1 + M`, is the matched one."""
    scale, (x, y, z), array = abs(match.factor), point, imager.array
    magnification = scale - 1
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


def _locate_sources(spots: SpotLists, sources: Sources, imager: Imager) -> Sources:
    """Fill in unknown coordinates from where the pattern of the lenses is in the captures."""
    points, left = sources.points.copy(), [np.asarray(found) for found in spots]
    # Known sources first: their spots are not those of the others.
    for source in np.argsort(np.isnan(points).any(1), kind="stable"):
        capture = int(sources.captures[source])
        missing = np.isnan(points[source])
        if missing.any():
            points[source] = np.where(missing, _locate(left[capture], points[source, 2], imager), points[source])
        left[capture] = _remove_spots(left[capture], points[source], imager)
    return sources._replace(points=points)


def _locate(spots, depth: float, imager: Imager) -> tuple[float, float, float]:
    """The source that most of the spots belong to, at a depth, or at any if that is NaN."""
    if np.isnan(depth):
        match = match_pattern(spots, np.asarray(imager.array.centers, np.float64), *_scale(imager, depth))
        magnification = max(abs(match.factor) - 1, 1e-3)
        depth = max(float(imager.depth_of(imager.reduced_sensor_distance / magnification)), 1e-3)
    magnification = float(imager.magnification(depth))
    pattern = (1 + magnification) * np.asarray(imager.centers, np.float64)
    shift, _ = match_shift(spots, pattern, match_radius(imager.array.centers))
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
    types = [imager.array.lens(int(which[0])) for which in lenses_by_type(imager.array)]
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
