"""Which lens of a plate is of which kind, so that neighbours are of different kinds. Host code; lengths in mm."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from .cells import nearest_neighbour_distances

# Neighbours whose kinds a lens looks at.
_NEIGHBOURS = 6


def dealt(centers: Float[np.ndarray, "lens 2"], kinds: int) -> Int[np.ndarray, " lens"]:
    """The kind of each lens, 0 to `kinds - 1`, as many of each to a few lenses.

    Column after column, each lens gets the kind that its six nearest neighbours so far have least of, and of those the
    rarest on the plate.
    """
    found = np.full(len(centers), -1)
    if kinds == 1 or len(centers) == 1:
        return found + 1
    tree: Any = KDTree(centers)
    near = tree.query(centers, k=min(_NEIGHBOURS + 1, len(centers)))[1][:, 1:]
    columns = np.round(centers[:, 0] / nearest_neighbour_distances(centers).mean())
    for lens in np.lexsort((centers[:, 1], columns)):
        others = np.bincount(found[near[lens]][found[near[lens]] >= 0], minlength=kinds)
        rare = np.bincount(found[found >= 0], minlength=kinds)
        found[lens] = np.lexsort((rare, others))[0]
    return found
