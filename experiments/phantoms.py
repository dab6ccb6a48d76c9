"""Scenes of the paper's figures: fluorescent beads in a slab (Fig. 7), and an inclined snowflake (Fig. 8).

As those of `gs_jax.simulation.phantoms`, which says what emitters are.
"""

import math
from collections.abc import Sequence
from itertools import product

import numpy as np

from gs_jax import InputError
from gs_jax.layouts import check_positive, half_size
from gs_jax.simulation.phantoms import Emitters, as_emitters, check_range, uniform_points
from gs_jax.typing import Number

# Centre lines of a snowflake's arm along +x, of length 1, from and to x + iy.
_SIDES = np.exp(1j * np.pi / 3 * np.array([1, -1]))
_ARM = np.array([(0, 1), *((x, x + length * side) for x, length in ((0.45, 0.27), (0.72, 0.2)) for side in _SIDES)])


def beads(
    count: int,
    size: Sequence[Number],
    depth_range: Sequence[Number],
    *,
    diameter: Number = 0.005,
    pitch: Number,
    seed: int = 0,
) -> Emitters:
    """Fluorescent balls at random in a slab, as those in PDMS of Fig. 7 (5 um, in 2.5 mm), which clump there.

    Balls lie wholly inside and may overlap. Each is filled with a cubic lattice of emitters.

    Parameters
    ----------
    count, seed
        Number of balls, and the seed of their positions.
    size, depth_range
        `(x, y)` of the slab, its middle on the axis, and its `(near, far)` sides, mm.
    diameter, pitch
        Of a ball, and the spacing of its emitters, mm.
    """
    _check_lengths(diameter=diameter, pitch=pitch)
    half, (near, far), radius = half_size(size), check_range(depth_range), diameter / 2
    if diameter > (room := min(*(2 * half), far - near)):
        raise InputError(f"`diameter` must be at most {room:.4g} mm to fit into the slab, got {diameter}.")
    middles = uniform_points(count, half - radius, (near + radius, far - radius), seed)
    ball = np.array(list(product(_cells(-radius, radius, pitch)[0], repeat=3)))
    ball = ball[(ball**2).sum(axis=1) <= radius**2]
    return as_emitters((middles[:, None] + ball).reshape(-1, 3).T, math.pi * diameter**3 / 6 / len(ball))


def snowflake(
    depth_range: Sequence[Number] = (20.0, 25.0),
    size: Number = 20.0,
    tilt: Number = 0.0,
    *,
    width: Number = 0.7,
    pitch: Number,
) -> Emitters:
    """A flat six-armed snowflake, inclined so that it just spans a range of depths, as that of Fig. 8.

    An arm is a line with two pairs of branches at 60 degrees, its ends round. The paper gives the width of its features
    and the depths; the rest is ours.

    Parameters
    ----------
    depth_range
        `(near, far)` of the outline, mm; emitters on it stand out half a pitch. The same twice: not inclined.
    size, width, pitch
        From tip to tip, of its lines, and the spacing of its emitters, mm. The size is at least 14 widths.
    tilt
        The direction toward which it becomes deeper, radians from +x (along an arm) to +y.
    """
    near, far = check_range(depth_range)
    _check_lengths(size=size, width=width, pitch=pitch)
    if size < 14 * width:
        raise InputError(f"`size` must be at least 14 widths, {14 * width:.4g} mm, got {size}.")
    # Points of the plane as x + iy: a product with exp(i a) turns by a.
    arm, turns, along = _ARM * (size - width) / 2, np.exp(1j * np.pi / 3 * np.arange(6)), np.exp(1j * tilt)
    reach = float(np.real(np.multiply.outer(turns, arm) / along).max()) + width / 2
    if (sine := (far - near) / (2 * reach)) > 1:
        raise InputError(f"`depth_range` must span at most {2 * reach:.4g} mm for that size, got {far - near:.4g}.")
    sixth, area = _filled_sixth(arm, width, pitch)
    flat = np.multiply.outer(turns, sixth).ravel()
    slope = np.real(flat / along)
    lateral = flat - (1 - math.sqrt(1 - sine**2)) * slope * along
    return as_emitters([lateral.real, lateral.imag, (near + far) / 2 + sine * slope], np.tile(area, 6))


def _check_lengths(**lengths):
    """Raise `InputError` unless lengths are positive."""
    for name, length in lengths.items():
        check_positive(name, length)


def _cells(start, end, pitch):
    """Middles and length of the fewest equal parts of an interval that are no longer than `pitch`."""
    count = math.ceil((end - start) / pitch * (1 - 1e-9))
    step = (end - start) / count
    return start + (np.arange(count) + 0.5) * step, step


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
