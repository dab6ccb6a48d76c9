"""Scenes of the paper's figures: fluorescent beads in a slab (Fig. 7), and an inclined snowflake (Fig. 8).

They return emitters, as `gs_jax.simulation` does; lengths in mm, angles in radians.
"""

import math
from collections.abc import Sequence
from itertools import product

import numpy as np

from gs_jax.microscope.layouts import half_size
from gs_jax.simulation import Emitters, as_emitters, uniform_points

# Centre lines of a snowflake's arm along +x, of length 1, from and to x + iy.
_SIDES = np.exp(1j * np.pi / 3 * np.array([1, -1]))
_ARM = np.array([(0, 1), *((x, x + length * side) for x, length in ((0.45, 0.27), (0.72, 0.2)) for side in _SIDES)])


def beads(
    count: int, size: Sequence[float], depths: tuple[float, float], *, diameter=0.005, pitch: float, seed: int = 0
) -> Emitters:
    """Balls at random places within a slab, each filled with a cubic lattice of emitters; they may overlap.

    The slab is `size` wide along x and y, its middle on the axis, between the near and the far of `depths`.
    """
    half, (near, far), radius = half_size(size), depths, diameter / 2
    middles = uniform_points(count, half - radius, (near + radius, far - radius), seed)
    cells = math.ceil(diameter / pitch * (1 - 1e-9))
    along = ((np.arange(cells) + 0.5) / cells - 0.5) * diameter
    ball = np.array(list(product(along, repeat=3)))
    ball = ball[(ball**2).sum(axis=1) <= radius**2]
    return as_emitters((middles[:, None] + ball).reshape(-1, 3).T, math.pi * diameter**3 / 6 / len(ball))


def snowflake(
    depths: tuple[float, float] = (20.0, 25.0), size=20.0, tilt=0.0, *, width: float = 0.7, pitch: float
) -> Emitters:
    """A flat six-armed snowflake, inclined so that its outline just spans the near and the far of `depths`.

    An arm is a line of this width with two pairs of branches at 60 degrees, its ends round. It becomes deeper toward
    `tilt`, from +x (along an arm) to +y. The paper gives the width and the depths; the rest is ours.
    """
    near, far = depths
    # Points of the plane as x + iy: a product with exp(i a) turns by a.
    arm, turns, along = _ARM * (size - width) / 2, np.exp(1j * np.pi / 3 * np.arange(6)), np.exp(1j * tilt)
    reach = float(np.real(np.multiply.outer(turns, arm) / along).max()) + width / 2
    sine = (far - near) / (2 * reach)
    sixth, area = _filled_sixth(arm, width, pitch)
    flat = np.multiply.outer(turns, sixth).ravel()
    slope = np.real(flat / along)
    lateral = flat - (1 - math.sqrt(1 - sine**2)) * slope * along
    return as_emitters([lateral.real, lateral.imag, (near + far) / 2 + sine * slope], np.tile(area, 6))


def _filled_sixth(arm, width, pitch):
    """Square lattice over the arm in its sector, 30 degrees to both sides, and the covered area of each square."""
    count = math.ceil((arm.real.max() + width) / pitch)
    x, y = (np.arange(count) + 0.5) * pitch, (np.arange(-count, count) + 0.5) * pitch
    points = (x + 1j * y[:, None]).ravel()
    points = points[np.abs(points.imag) < math.tan(math.pi / 6) * points.real]
    steps = [(points - start, end - start) for start, end in arm]
    distances = [np.abs(step - line * np.clip((step / line).real, 0, 1)) for step, line in steps]
    covered = np.clip((width / 2 - np.min(distances, axis=0)) / pitch + 0.5, 0, 1)
    return points[covered > 0], covered[covered > 0] * pitch**2
