"""Which spot is of which lens, from a poor start: any rotation, mirrored or not, and a rough scale.

The spots of a point source are the lens centres, turned, scaled, shifted and perhaps mirrored. Two spots and two lenses
say how; of all such guesses with a likely scale the one counts that puts most spots on lenses.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import KDTree

# The brightest spots that guesses are made from and tried on, and lenses that make a pair.
_FIRST, _TRIED, _NEIGHBOURS = 5, 20, 12
# A spot is on a lens within this, mm on the plate: a twentieth of the pitch of the paper's array.
_NEAR = 0.06
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

    @property
    def rotation(self) -> float:
        """Of the array, radians."""
        return math.atan2(self.factor.imag, self.factor.real)

    @property
    def is_clear(self) -> bool:
        """Whether enough spots are on lenses."""
        return self.on_lenses >= max(_FEWEST, _SHARE * self.tried)


def match(
    spots: Float[np.ndarray, "spot 2"], centers: Float[np.ndarray, "lens 2"], scale: float, tolerance: float
) -> Similarity:
    """How spots `(x, y)`, mm, brightest first, lie on the lenses of an array.

    Parameters
    ----------
    scale, tolerance
        Of the pattern, and how far it may be off, relative.
    """
    p, c = spots[:_TRIED] @ (1, 1j), centers @ (1, 1j)
    best = Similarity(1 + 0j, 0j, False, 0, len(p))
    if len(p) < 3 or len(c) < 3:
        return best
    tree = KDTree(centers)
    near = np.asarray(tree.query(centers, k=min(_NEIGHBOURS + 1, len(c)))[1])
    first, second = np.repeat(np.arange(len(c)), near.shape[1] - 1), near[:, 1:].ravel()
    some, every = np.meshgrid(np.arange(min(_FIRST, len(p))), np.arange(len(p)))
    one, other = some[some != every], every[some != every]
    for mirrored in (False, True):
        lenses = c.conj() if mirrored else c
        factors = (p[other] - p[one])[:, None] / (lenses[second] - lenses[first])
        pairs = np.argwhere(np.abs(np.abs(factors) / scale - 1) < tolerance)
        for start in range(0, len(pairs), _AT_ONCE):
            pair, lens = pairs[start : start + _AT_ONCE].T
            factor = factors[pair, lens]
            shift = p[one[pair]] - factor * lenses[first[lens]]
            count = (_distance(p, factor, shift, tree, mirrored) < _NEAR).sum(1)
            top = int(count.argmax())
            if count[top] > best.on_lenses:
                best = Similarity(complex(factor[top]), complex(shift[top]), mirrored, int(count[top]), len(p))
    return _improved(best, p, c, tree)


def _distance(p, factor, shift, tree, mirrored) -> Float64[np.ndarray, "guess spot"]:
    """Of each spot, put back on the plate, from the nearest lens."""
    back = (p[None] - np.atleast_1d(shift)[:, None]) / np.atleast_1d(factor)[:, None]
    back = back.conj() if mirrored else back
    return tree.query(np.stack([back.real, back.imag], -1))[0]


def _improved(found: Similarity, p, c, tree) -> Similarity:
    """By least squares over the spots that are on lenses."""
    if found.on_lenses < 2:
        return found
    back = (p - found.shift) / found.factor
    back = back.conj() if found.mirrored else back
    distance, lens = tree.query(np.stack([back.real, back.imag], -1))
    use = distance < _NEAR
    lenses = (c.conj() if found.mirrored else c)[lens[use]]
    system = np.stack([lenses, np.ones_like(lenses)], -1)
    factor, shift = np.linalg.lstsq(system, p[use])[0]
    return found._replace(factor=complex(factor), shift=complex(shift))
