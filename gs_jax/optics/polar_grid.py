"""Polar nodes about a lens's axis, for stray light: where they are, and how light is shared by them.

Sparse tables resample between square nodes (or pixels) and polar ones.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64, Int, Num

from ..geometry import Imager
from ..linear.sparse_table import SparseTable
from .raytrace import to_numpy

# Widest field, in reduced depths of the nearest plane: beyond, a lens transmits a third of its light and less.
_WIDEST = 0.9
# The object's nodes are evenly spaced up to about this part of the widest field, then exponentially; nodes in that
# part.
_LINEAR, _NODES = 0.45, 44
# How far beyond the widest field's chief ray light is followed on the sensor, in images of the widest field.
_BEYOND = 0.35
# Nodes around may be wider apart than outward by so much, so that their number is a power of two or three times one.
_WIDER = 1.1
# Tables and kernels have so many radii at once.
RADII = 8
# Inner rings of polar nodes, which are closer to each other than pixels.
_INNER_RINGS = 4


class PolarGrid(NamedTuple):
    """Polar nodes about a lens's axis, on the object's side and on the sensor's.

    `step`: spacing of the inner nodes in the object, mm; `pixel`: of those on the sensor. `bend`: radius from which on
    the spacing grows, in steps. `angles`, `fields`, `radii`: numbers of nodes around, and outward on either side.
    """

    step: float
    pixel: float
    bend: float
    angles: int
    fields: int
    radii: int

    def nodes(self, count: int) -> Float64[np.ndarray, " node"]:
        """Radii of the nodes, in steps. Where the spacing grows, it is that around."""
        return self.bend * np.sinh(np.arange(count) / self.bend)

    def areas(self, count: int) -> Float64[np.ndarray, " node"]:
        """Area of a node's cell, in squared steps."""
        edges = self.bend * np.sinh((np.arange(count + 1) - 0.5) / self.bend)
        edges[0] = 0
        return np.pi * np.diff(edges**2) / self.angles


def make_polar_grid(imager: Imager, depths: Float64[np.ndarray, " depth"], *, extent: float | None = None) -> PolarGrid:
    """Nodes of the stray light for a range of depths and an object's extent, mm; by default the sensor's.

    Fields are from the axes of the lenses, which lean if the array is tilted.
    """
    extent = extent or 2 * max(map(abs, imager.sensor.extent))
    lean = float(np.linalg.norm(to_numpy(imager).axis_offset(depths.max())))
    imager, height = imager.level()
    depths = depths - float(height)
    largest_field = math.sqrt(2) * (float(jnp.abs(imager.array.centers).max()) + extent / 2) + lean
    near = float(imager.reduced_depth(float(depths.min())))
    widest = min(_WIDEST * near, largest_field)
    middle = float(imager.magnification(float(depths.min() + depths.max()) / 2))
    linear = _LINEAR * _WIDEST * near
    # A whole number of pixels.
    pixels = max(round(middle * linear / _NODES / imager.sensor.pixel_pitch), 1)
    pixel = pixels * imager.sensor.pixel_pitch
    step = pixel / middle
    bend = linear / step
    count = lambda reach: math.ceil(bend * math.asinh(reach / bend)) + 2
    largest = float(imager.magnification(float(depths.min()))) / middle
    radii = math.ceil(count((1 + _BEYOND) * largest * widest / step) / RADII) * RADII
    around = math.log2(2 * math.pi * bend / _WIDER)
    angles = min(2 ** math.ceil(around), 3 * 2 ** math.ceil(around - math.log2(3)))
    return PolarGrid(step, pixel, bend, angles, count(widest / step), radii)


def polar_weights(
    grid: PolarGrid, count: int, x: Num[np.ndarray, " place"], y: Num[np.ndarray, " place"]
) -> tuple[Int[np.ndarray, " entry"], Int[np.ndarray, " entry"], Float64[np.ndarray, " entry"]]:
    """Bilinear weights of the four nodes around each place (in steps), as entries (place, node, weight).

    Places beyond the nodes, `count` outward, have no entries.
    """
    outward = grid.bend * np.arcsinh(np.hypot(x, y) / grid.bend)
    place = np.flatnonzero(outward < count - 1)
    outward = outward[place]
    turned = np.arctan2(y, x)[place] * (grid.angles / (2 * np.pi)) % grid.angles
    radius, around = outward.astype(int), turned.astype(int)
    parts = []
    for step, turn in np.ndindex(2, 2):
        node = (radius + step) * grid.angles + (around + turn) % grid.angles
        share = np.abs(1 - step - (outward - radius)) * np.abs(1 - turn - (turned - around))
        parts.append((place, node, share))
    place, node, share = (np.concatenate(part) for part in zip(*parts, strict=True))
    return place, node, share


@lru_cache(maxsize=4)
def to_polar_table(polar_grid: PolarGrid) -> SparseTable:
    """From the square nodes about a lens to the polar ones: what each node holds is shared by the four around it."""
    reach = math.ceil(polar_grid.nodes(polar_grid.fields)[-2])
    node, polar, share = polar_weights(polar_grid, polar_grid.fields, *_square(reach))
    polar = _angle_first(polar_grid, polar_grid.fields, polar)
    side, polars = 2 * reach + 1, polar_grid.fields * polar_grid.angles
    return SparseTable.of(side, polar, node, share, (polars, side**2))


@lru_cache(maxsize=4)
def to_pixels_table(polar_grid: PolarGrid) -> SparseTable:
    """From polar nodes to the pixels about a lens: the density of light, interpolated, so that no ring loses any.

    Up to the radius `bend` nodes are closer around than pixels, and some are near no pixel: the nodes of a ring keep
    their light together, not each its own. About the axis they are closer outward, too, and are shared by the four
    pixels around them instead.
    """
    reach = math.ceil(polar_grid.nodes(polar_grid.radii)[-2])
    pixel, node, share = polar_weights(polar_grid, polar_grid.radii, *_square(reach))
    outer = (node >= _INNER_RINGS * polar_grid.angles) & (share > 0)
    pixel, node, share = pixel[outer], node[outer], share[outer]
    ring = node // polar_grid.angles
    total = np.bincount(ring, share, polar_grid.radii) / polar_grid.angles
    # The last rings are cut by the window's edge, and have no more light than that.
    share = share / np.where(ring < polar_grid.radii - 3, total[ring], polar_grid.areas(polar_grid.radii)[ring])
    parts = [(pixel, node, share), *_near_axis(polar_grid, reach)]
    pixel, node, share = (np.concatenate(part) for part in zip(*parts, strict=True))
    node = _angle_first(polar_grid, polar_grid.radii, node)
    side, polars = 2 * reach + 1, polar_grid.radii * polar_grid.angles
    return SparseTable.of(side, pixel, node, share, (side**2, polars))


def _angle_first(polar_grid, radii, node):
    """Numbers of nodes `(radius, angle)` as those of `(angle, radius)`."""
    return node % polar_grid.angles * radii + node // polar_grid.angles


def _near_axis(polar_grid: PolarGrid, reach: int):
    """Entries (pixel, polar node, share) of the inner polar nodes, for each of the four pixels around them."""
    node = np.arange(_INNER_RINGS * polar_grid.angles)
    radius, angle = (
        polar_grid.nodes(_INNER_RINGS)[node // polar_grid.angles],
        2 * np.pi * (node % polar_grid.angles) / polar_grid.angles,
    )
    place = np.stack([radius * np.sin(angle), radius * np.cos(angle)], -1) + reach
    whole = np.floor(place).astype(int)
    for corner in np.ndindex(2, 2):
        row, column = (whole + corner).T
        yield row * (2 * reach + 1) + column, node, np.where(corner, place - whole, 1 - (place - whole)).prod(-1)


def _square(reach: int):
    side = np.arange(-reach, reach + 1)
    y, x = np.meshgrid(side, side, indexing="ij")
    return x.ravel(), y.ravel()
