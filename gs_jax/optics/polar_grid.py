"""Polar nodes about a lens's axis, for stray light: where they are, and how light is shared by them."""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64, Int, Num

from ..geometry import Imager
from .raytrace import to_numpy

# Widest field, in reduced depths of the nearest plane: beyond, a lens transmits a third of its light and less.
_WIDEST = 0.9
# The object's nodes are evenly spaced up to about this part of the widest field, then exponentially; nodes in that
# part.
_LINEAR, _NODES = 0.45, 44
# How far beyond the widest field's chief ray light is followed on the sensor, in images of the widest field.
_BEYOND = 0.35


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
    radii = count((1 + _BEYOND) * largest * widest / step)
    return PolarGrid(step, pixel, bend, 4 * round(2 * math.pi * bend / 4), count(widest / step), radii)


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
