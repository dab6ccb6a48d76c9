"""Which lenses can see a point, and where, if lenses differ: each kind by its own cores, where they are sharp.

Lenses that are alike are one kind, whose points lie, while they are looked for, at the depths of chief rays.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from ..geometry import Imager
from ..optics.lens_types import kind_weights, lenses_by_kind, of_kinds
from ..optics.psf_core import apparent_depths
from .consistency import Readings, Signal, readings

# A kind can see points where it brings at least this part of the light into a core that the best kind does.
_SHARP = 0.5


class Kind(NamedTuple):
    """Lenses that are alike, and how they see points of some depths.

    `apparent`: where the chief rays of their cores meet, mm. `sharp`: light in a core over the best kind's. None where
    all lenses are alike: points are at the chief rays' depths then, and all lenses can see them.
    """

    imager: Imager
    depths: Float64[np.ndarray, " depth"]
    apparent: Float64[np.ndarray, " depth"] | None = None
    sharp: Float64[np.ndarray, " depth"] | None = None

    def place(self, depth: Float[np.ndarray, " place"]) -> Float[np.ndarray, " place"]:
        """The depth whose chief rays land where cores of points at these depths do."""
        return depth if self.apparent is None else np.interp(depth, self.depths, self.apparent)

    def sees(self, depth: Float[np.ndarray, " place"]) -> Bool[np.ndarray, " place"]:
        """Whether points at these depths have cores that are nearly as bright as any."""
        if self.sharp is None:
            return np.ones(len(depth), bool)
        return np.interp(depth, self.depths, self.sharp) >= _SHARP


def kinds_of(imager: Imager, depths: Float64[np.ndarray, " depth"], side: float) -> list[Kind]:
    """The kinds of an imager's lenses, for points about these depths, by the light in squares of this side, mm."""
    if imager.array.alike:
        return [Kind(imager, depths)]
    each = of_kinds(imager, lenses_by_kind(imager))
    weights = kind_weights(each, depths, side)
    sharp = weights / weights.max(0)
    apparent = [np.asarray(apparent_depths(one, depths), np.float64) for one in each]
    return [Kind(one, depths, *how) for one, *how in zip(each, apparent, sharp, strict=True)]


def readings_of(points: Float[np.ndarray, "point 3"], signal: Signal, kinds: Sequence[Kind]) -> Readings:
    """`readings` by all kinds that can see each point, side by side."""
    if len(kinds) == 1:
        return readings(points, signal, kinds[0].imager)
    parts = []
    for number, kind in enumerate(kinds):
        placed = np.column_stack([points[:, :2], kind.place(points[:, 2])])
        found = readings(placed, signal, kind.imager)
        seen = found.seen & kind.sees(points[:, 2])[:, None]
        light, noise = (np.where(seen, part, 0) for part in (found.light, found.noise))
        kept = found._replace(light=light, noise=noise, seen=seen, kind=np.full(seen.shape, number))
        parts.append(kept)
    return Readings(*(np.concatenate(columns, 1) for columns in zip(*parts, strict=True)))
