"""Which lenses can see a point, and where, if lenses differ: each type by its own cores, where they are sharp.

Lenses that are alike are one type, whose points lie, while they are looked for, at the depths of chief rays.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from ..geometry import Imager
from ..lenses import lenses_by_type
from ..optics.lens_types import split_by_type, type_weights
from ..optics.psf_core import apparent_depths
from .consistency import Readings, Signal, readings

# A type can see points where it brings at least this part of the light into a core that the best type does.
_SHARP = 0.5


class LensType(NamedTuple):
    """Lenses that are alike, and how they see points of some depths.

    `apparent`: where the chief rays of their cores meet, mm. `sharp`: light in a core over the best lens_type's. None
    where all lenses are alike: points are at the chief rays' depths then, and all lenses can see them.
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


def lens_types_of(imager: Imager, depths: Float64[np.ndarray, " depth"], side: float) -> list[LensType]:
    """The types of an imager's lenses, for points about these depths, by the light in squares of this side, mm."""
    if imager.array.alike:
        return [LensType(imager, depths)]
    each = split_by_type(imager, lenses_by_type(imager.array))
    weights = type_weights(each, depths, side)
    sharp = weights / weights.max(0)
    apparent = [np.asarray(apparent_depths(one, depths), np.float64) for one in each]
    return [LensType(one, depths, *how) for one, *how in zip(each, apparent, sharp, strict=True)]


def readings_of(points: Float[np.ndarray, "point 3"], signal: Signal, lens_types: Sequence[LensType]) -> Readings:
    """`readings` by all types that can see each point, side by side."""
    if len(lens_types) == 1:
        return readings(points, signal, lens_types[0].imager)
    parts = []
    for number, lens_type in enumerate(lens_types):
        placed = np.column_stack([points[:, :2], lens_type.place(points[:, 2])])
        found = readings(placed, signal, lens_type.imager)
        seen = found.seen & lens_type.sees(points[:, 2])[:, None]
        light, noise = (np.where(seen, part, 0) for part in (found.light, found.noise))
        kept = found._replace(light=light, noise=noise, seen=seen, lens_type=np.full(seen.shape, number))
        parts.append(kept)
    return Readings(*(np.concatenate(columns, 1) for columns in zip(*parts, strict=True)))
