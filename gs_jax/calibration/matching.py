"""Which spot is of which lens, from a poor start: any rotation, mirrored or not, and a rough scale.

The spots of a point source are the lens centres, turned, scaled, shifted and perhaps mirrored. Two spots and two lenses
say how; of all such guesses with a likely scale the one counts that puts most spots on lenses.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Float64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ..layouts import nearest_neighbour_distances

# The brightest spots that guesses are made from and tried on, of each source and at most, and lenses that make a pair.
_FIRST, _TRIED, _MOST, _NEIGHBOURS = 5, 20, 3, 12
# A spot is on a lens within this, in pitches of the array: 0.06 mm on the plate of the paper's.
_NEAR = 0.0488
# Spots that must be on lenses at least, and their share of those tried.
_FEWEST, _SHARE = 6, 0.5
_AT_ONCE = 20_000


class Similarity(NamedTuple):
    """`p = factor c + shift` in complex numbers `x + iy`, of lens centres `c`, conjugated first if mirrored."""

    factor: complex
    shift: complex
    mirrored: bool
    on_lenses: int
    tried: int
    sources: int

    @property
    def rotation(self) -> float:
        """Of the array, radians."""
        return math.atan2(self.factor.imag, self.factor.real)

    @property
    def is_clear(self) -> bool:
        """Whether enough spots are on lenses: half of those that one of the sources has."""
        return self.on_lenses >= max(_FEWEST, _SHARE * self.tried / self.sources)


def near_of(centers: Float[Array | np.ndarray, "lens 2"]) -> float:
    """How near to a lens of an array a spot counts as on it, mm: a twentieth of the pitch."""
    return _NEAR * float(nearest_neighbour_distances(np.asarray(centers, np.float64)).mean())


def match(
    spots: Float[np.ndarray, "spot 2"],
    centers: Float[np.ndarray, "lens 2"],
    scale: float,
    tolerance: float,
    sources: int = 1,
) -> Similarity:
    """How spots `(x, y)`, mm, brightest first, of one or several sources lie on the lenses of an array.

    Parameters
    ----------
    scale, tolerance
        Of the pattern, and how far it may be off, relative.
    sources
        Whose spots these are; the pattern is that of one of them.
    """
    some = min(sources, _MOST)
    p, c = spots[: _TRIED * some] @ (1, 1j), centers @ (1, 1j)
    best = Similarity(1 + 0j, 0j, False, 0, len(p), sources)
    if len(p) < 3 or len(c) < 3:
        return best
    tree, near = KDTree(centers), near_of(centers)
    beside = np.asarray(tree.query(centers, k=min(_NEIGHBOURS + 1, len(c)))[1])
    first, second = np.repeat(np.arange(len(c)), beside.shape[1] - 1), beside[:, 1:].ravel()
    begin, end = np.meshgrid(np.arange(min(_FIRST * some, len(p))), np.arange(len(p)))
    one, other = begin[begin != end], end[begin != end]
    for mirrored in (False, True):
        lenses = c.conj() if mirrored else c
        factors = (p[other] - p[one])[:, None] / (lenses[second] - lenses[first])
        pairs = np.argwhere(np.abs(np.abs(factors) / scale - 1) < tolerance)
        for start in range(0, len(pairs), _AT_ONCE):
            pair, lens = pairs[start : start + _AT_ONCE].T
            factor = factors[pair, lens]
            shift = p[one[pair]] - factor * lenses[first[lens]]
            count = (_distance(p, factor, shift, tree, mirrored) < near).sum(1)
            top = int(count.argmax())
            if count[top] > best.on_lenses:
                best = Similarity(complex(factor[top]), complex(shift[top]), mirrored, int(count[top]), len(p), sources)
    return _improved(best, p, c, tree, near)


def _distance(p, factor, shift, tree, mirrored) -> Float64[np.ndarray, "guess spot"]:
    """Of each spot, put back on the plate, from the nearest lens."""
    back = (p[None] - np.atleast_1d(shift)[:, None]) / np.atleast_1d(factor)[:, None]
    back = back.conj() if mirrored else back
    return tree.query(np.stack([back.real, back.imag], -1))[0]


def _improved(found: Similarity, p, c, tree, near) -> Similarity:
    """By least squares over the spots that are on lenses."""
    if found.on_lenses < 2:
        return found
    back = (p - found.shift) / found.factor
    back = back.conj() if found.mirrored else back
    distance, lens = tree.query(np.stack([back.real, back.imag], -1))
    use = distance < near
    lenses = (c.conj() if found.mirrored else c)[lens[use]]
    system = np.stack([lenses, np.ones_like(lenses)], -1)
    factor, shift = np.linalg.lstsq(system, p[use])[0]
    return found._replace(factor=complex(factor), shift=complex(shift))


def match_shift(
    spots: Float[np.ndarray, "spot 2"], pattern: Float[np.ndarray, "lens 2"], near: float
) -> tuple[Float64[np.ndarray, "2"], int]:
    """By how much a pattern of spots, mm, is displaced on the sensor, and how many spots say so, each as `near`."""
    if not len(spots) or not len(pattern):
        return np.zeros(2), 0
    apart = (spots[:, None] - pattern[None]).reshape(-1, 2)
    tree = KDTree(apart)
    count = tree.query_ball_point(apart, near, return_length=True)
    together = tree.query_ball_point(apart[int(count.argmax())], near)
    return np.median(apart[together], axis=0), len(together)


def meeting_lenses(
    spots: Sequence[Float[np.ndarray, "_ 2"]],
    points: Float[np.ndarray, "image 2"],
    magnifications: Float[np.ndarray, " image"],
    near: float,
) -> tuple[Float64[np.ndarray, "lens 2"], int, int]:
    """Lens centres, mm, that spots of several captures of one point each have in common.

    And how many spots they have, and pairs of spots.

    A lens is where lines from the points to their spots pass: `c = (p + M q) / (1 + M)`.

    Parameters
    ----------
    spots, points, magnifications
        Of each capture: its spots and its point `(x, y)`, mm, and the point's magnification.
    near
        How far lines may pass from each other, mm.
    """
    passing = [(p + m * q) / (1 + m) for p, q, m in zip(spots, points, magnifications, strict=True)]
    places, capture = np.concatenate(passing), np.repeat(np.arange(len(spots)), [len(p) for p in spots])
    pairs, count = KDTree(places).query_pairs(near, output_type="ndarray"), len(places)
    pairs = pairs[capture[pairs[:, 0]] != capture[pairs[:, 1]]]
    _, group = connected_components(coo_array((np.ones(len(pairs)), tuple(pairs.T)), (count, count)), directed=False)
    size = np.bincount(group)
    several = np.flatnonzero(size > 1)
    sums = np.stack([np.bincount(group, column) for column in places.T], -1)
    return sums[several] / size[several, None], int(size[several].sum()), len(pairs)
