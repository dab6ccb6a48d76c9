"""The volumes that a part must have, by quadrature of its lenses' surfaces; mm^3."""

import math

import manifold3d as m3
import numpy as np

from ..layouts.cells import cell_edges
from ..lenses import MicrolensArray
from .caps import Cap, cap_sag, caps_of, surface
from .solids import MoldShape, engravings, mold_block, plate_thickness

# Of a solid's volume against the analytic one. Facets within 0.5 um of the lenses come within 1e-5.
VOLUME_TOLERANCE = 1e-4
# Places at which lenses that differ are integrated, a side of the plate.
_PLACES = 1400


def caps_volume(array: MicrolensArray) -> float:
    """Volume of the lenses over the land, mm^3.

    Raises
    ------
    InputError
        If a lens lies outside the plate, or the plate is infinite.
    """
    caps = caps_of(array)
    if array.alike:
        return _alike_volume(caps[0], np.asarray(array.centers, float), array.size)
    return _surface_volume(caps, array.size)


def _alike_volume(cap: Cap, centers, size, nodes: int = 64) -> float:
    """By quadrature over the sectors of the lenses' Voronoi cells, where lenses that are alike end.

    In the direction `phi` a cap ends at `r = min(D/2, d / cos(phi))`, with `d` the distance of the cell's edge, and
    holds `int h r dr`. What ends at the rim is a constant. For what ends at the edge, `r = d cosh(u)` and
    `dphi = du / cosh(u)`: smooth even where the edge passes by the vertex.
    """
    x, weights = np.polynomial.legendre.leggauss(nodes)

    def held(r2):
        inner = r2[..., None] * (1 + x) / 2
        return r2 / 4 * ((cap.rim - cap.sag(inner)) @ weights)

    edges = cell_edges(centers, size)
    # An edge through the vertex has no sector.
    off, *ends = (x[edges.height > 1e-12] for x in (edges.height, edges.low, edges.high))
    half = np.sqrt(np.maximum(cap.reach**2 - off**2, 0))
    within = [np.clip(t, -half, half) for t in ends]
    at_rim = (
        np.arctan2(ends[1], off) - np.arctan2(ends[0], off) - np.arctan2(within[1], off) + np.arctan2(within[0], off)
    )
    low, high = (np.arcsinh(t / off)[:, None] for t in within)
    cosh = np.cosh((high + low) / 2 + (high - low) / 2 * x)
    at_edge = (high - low)[:, 0] / 2 * ((held(np.minimum(off[:, None] * cosh, cap.reach) ** 2) / cosh) @ weights)
    return float((held(np.array(cap.reach**2)) * at_rim + at_edge).sum())


def _surface_volume(caps: list[Cap], size) -> float:
    """By Gauss's rule of two nodes in each of the cells of a grid: where a lens or a wall ends in one, errors of either
    sign, some 1e-7 of the whole together."""
    half = np.array([-1, 1]) / (2 * math.sqrt(3))
    x, y = (((np.arange(_PLACES // 2)[:, None] + 0.5 + half).ravel() / (_PLACES // 2) - 0.5) * side for side in size)
    height, _ = surface(caps, np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2))
    return float(height.mean() * math.prod(size))


def array_volume(array: MicrolensArray) -> float:
    """Volume of the array: plate and lenses, mm^3."""
    return math.prod(array.size) * plate_thickness(array) + caps_volume(array)


def mold_volume(array: MicrolensArray, shape: MoldShape) -> float:
    """Volume of the mold: the block, less lenses, what the walls enclose, and engraved marks and label, mm^3."""
    low, high = mold_block(array, shape)
    deep = plate_thickness(array) * shape.scale + shape.headroom
    flare = deep * math.tan(shape.draft)
    areas = [math.prod(side * shape.scale + wider for side in array.size) for wider in (0.0, flare, 2 * flare)]
    enclosed = deep * (areas[0] + 4 * areas[1] + areas[2]) / 6
    above = m3.Manifold.cube([*(high - low)[:2], 1e3]).translate([*low[:2], high[2]])
    engraved = sum((tool - above).volume() for tool in engravings(array, shape))
    return math.prod(high - low) - shape.scale**3 * caps_volume(array) - enclosed - engraved


def volume_tolerance(array: MicrolensArray, chord: float) -> float:
    """How far a volume may be from the analytic one, as a fraction: coarse facets cannot do as well as fine ones.

    Facets are right on average but for their rims: a quarter of the chord error over the plate is more than they miss.
    Walls are as far off as their circles' chords, and less.
    """
    caps, land = caps_of(array), cap_sag(array)
    walls = sum(2 * math.pi * cap.reach * (land - cap.rim) for cap in caps)
    return max(VOLUME_TOLERANCE, chord * (math.prod(array.size) / 4 + walls) / array_volume(array))
