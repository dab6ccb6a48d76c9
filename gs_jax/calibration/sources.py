"""Point sources in captures, and which of the spots are theirs, under which lens."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial import KDTree

from ..base.errors import InputError
from ..geometry import Imager
from .matching import near_of
from .unknowns import Offsets, due

# Spots that are due nearer to each other than this on the sensor are blurred into one, over `near_of`.
_APART = 0.5


class Sources(NamedTuple):
    """Points `(x, y, z)`, mm, NaN where nobody knows, and the capture that each is in, from 0."""

    points: Float64[np.ndarray, "source 3"]
    captures: Int[np.ndarray, " source"]

    def check(self, count: int) -> None:
        """`InputError` unless each of `count` captures has a source, and every depth is in front of the plate."""
        without = sorted(set(range(count)) - set(self.captures.tolist()))
        if not count or without or len(self.points) != len(self.captures):
            which = f", none in capture {without[0] + 1}" if without else ""
            found = f"{len(self.points)} sources for {count} captures{which}"
            raise InputError(f"positions: found {found}, allowed: one or more in each.")
        if not ((self.captures >= 0) & (self.captures < count)).all():
            worst = int(self.captures[(self.captures < 0) | (self.captures >= count)][0]) + 1
            raise InputError(f"positions: found a source in capture {worst}, allowed: 1 to {count}.")
        depths = self.points[:, 2]
        if (depths <= 0).any():
            raise InputError(f"positions: found the depth {np.nanmin(depths):g} mm, allowed: above 0.")

    def check_fit(self, fit: Sequence[str]) -> None:
        """`InputError` if what is known of the sources cannot tell what is to be fitted, whatever their spots show."""
        of_depth = [name for name in ("sensor_distance", "depth_offset") if name in fit]
        if of_depth and np.isnan(self.points[:, 2]).all():
            found = f"no known depth to fit {' and '.join(of_depth)} by"
            raise InputError(f"positions: found {found}, allowed: the depth of a source, or hold {of_depth[0]}.")
        if "shift" in fit and np.isnan(self.points[:, :2]).any(1).all():
            found = "no source with known x and y to fit shift by"
            raise InputError(f"positions: found {found}, allowed: x and y of a source, or hold shift.")


class Spots(NamedTuple):
    """Spots that are of known lenses: their sources, lenses and places, mm on the sensor."""

    sources: Int[np.ndarray, " spot"]
    lenses: Int[np.ndarray, " spot"]
    places: Float64[np.ndarray, "spot 2"]


def assigned(
    found: Sequence[Float64[np.ndarray, "_ 2"]], sources: Sources, imager: Imager, offsets: Offsets, within: float
) -> Spots:
    """The spot nearest to where each lens within the field radius should have one, if it is near enough.

    Parameters
    ----------
    found
        Spots of each capture, mm.
    sources, imager, offsets
        Where they are due. A source with an unknown coordinate has none.
    within
        How near, mm.
    """
    centers = np.asarray(imager.centers, np.float64)
    places = np.asarray(due(imager, np.nan_to_num(sources.points, nan=1.0), offsets), np.float64)
    beside = np.linalg.norm(centers[None] - sources.points[:, None, :2], axis=-1)
    seen = (beside < imager.field_radius) & ~np.isnan(sources.points.sum(1))[:, None]
    rows, apart = [], _APART * near_of(imager.array.centers)
    for capture, spots in enumerate(found):
        source, lens = np.argwhere(seen & (sources.captures == capture)[:, None]).T
        if not len(spots) or not len(source):
            continue
        wanted = places[source, lens]
        alone = np.asarray(KDTree(wanted).query_ball_point(wanted, apart, return_length=True)) == 1
        distance, nearest = (np.asarray(part) for part in KDTree(spots).query(wanted))
        rows += [
            (source[k], lens[k], *spots[nearest[k]])
            for k in np.flatnonzero(alone * (distance < within))
            # A spot is of the one that it is nearest to.
            if distance[k] == distance[nearest == nearest[k]].min()
        ]
    table = np.array(rows, np.float64).reshape(-1, 4)
    return Spots(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:])
