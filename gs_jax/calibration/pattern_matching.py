"""Matching of spots with the pattern of the lenses, whatever is between them.

The spots of a point source are the lens centers, rotated, scaled, shifted and perhaps mirrored. Two spots and two
lenses determine such a similarity; of all with a plausible scale, the one that puts most spots on lenses is taken.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from .sources import SpotLists
from .spot_model import match_radius

# Brightest spots of each source that pairs begin with, and that are matched; sources and neighbours at most.
_FIRST, _TRIED, _MOST_SOURCES, _NEIGHBOURS = 5, 20, 3, 12
# Fewest spots on lenses of a clear pattern, and their share of those tried.
MIN_SPOTS, _MIN_SHARE = 6, 0.5
# Of blurred spots: their distance from lenses of the pattern, over `match_radius`, which chance meets more often, and
# the share that has to be on lenses.
BLURRED, _BLURRED_SHARE = 3.0, 0.7
# How far a similarity is from the expected one must count less than a spot on a lens.
_FARTHEST = 1e3
# Similarities that are tried at once, and spots that are looked at before some are given up.
_BATCH, _FEW = 20_000, 5


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
        return math.atan2(self.factor.imag, self.factor.real)

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
    tree, radius = KDTree(centers), match_radius(centers) * (BLURRED if blurred else 1)
    beside = np.asarray(tree.query(centers, k=min(_NEIGHBOURS + 1, len(c)))[1])
    first, second = np.repeat(np.arange(len(c)), beside.shape[1] - 1), beside[:, 1:].ravel()
    begin, end = np.meshgrid(np.arange(min(_FIRST * most, len(p))), np.arange(len(p)))
    one, other, highest = begin[begin != end], end[begin != end], 0.0
    for mirrored in (False, True):
        lenses = c.conj() if mirrored else c
        factors = (p[other] - p[one])[:, None] / (lenses[second] - lenses[first])
        pair, lens = np.nonzero(np.abs(np.abs(factors / expected) - 1) < tolerance)
        factor = factors[pair, lens]
        moved = p[one[pair]] - factor * lenses[first[lens]]
        away = np.abs(np.log(factor / expected)) + np.abs(moved - shift) / np.abs(p).max() + mirrored
        order = np.argsort(away)
        for start in range(0, len(order), _BATCH):
            some = order[start : start + _BATCH]
            count = _count_on_lenses(
                p, factor[some], moved[some], highest + away[some] / _FARTHEST, tree, mirrored, radius
            )
            rank = count - away[some] / _FARTHEST
            top = int(rank.argmax())
            if rank[top] > highest:
                highest, k = float(rank[top]), some[top]
                found = {"factor": complex(factor[k]), "shift": complex(moved[k]), "on_lenses": int(count[top])}
                best = best._replace(mirrored=mirrored, **found)
    if best.on_lenses < 2:
        return best
    # Least squares over the spots on lenses.
    nearest = _nearest_lens(p, best.factor, best.shift, tree, best.mirrored, radius)
    distance, lens = (np.asarray(part)[0] for part in nearest)
    use = distance < radius
    lenses = (c.conj() if best.mirrored else c)[lens[use]]
    factor, moved = np.linalg.lstsq(np.stack([lenses, np.ones_like(lenses)], -1), p[use])[0]
    return best._replace(factor=complex(factor), shift=complex(moved))


def _count_on_lenses(p, factor, shift, least, tree, mirrored, radius):
    """Number of spots on lenses of each similarity; of those that cannot reach `least`, of the first spots alone."""
    count, left = np.zeros(len(factor), int), len(p)
    for few in np.array_split(p, -(-len(p) // _FEW)):
        which = np.flatnonzero(count + left > least)
        if len(which):
            count[which] += (_nearest_lens(few, factor[which], shift[which], tree, mirrored, radius)[0] < radius).sum(1)
        left -= len(few)
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
