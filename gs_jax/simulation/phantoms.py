"""Scenes to image: emitters finer than any voxel, and the volume that they make on a grid.

A scene is `(emitter, 4)`, rows of `(x, y, z, intensity)`, in mm and the frame of `geometry`; `np.concatenate` joins
scenes. Areas and volumes are filled with emitters, whose intensity is the area (mm^2) or volume (mm^3) that each stands
for: brightness does not depend on their spacing, `pitch`, the largest distance of neighbouring emitters in mm. Scenes
are made in NumPy, volumes in JAX. Lengths and counts out of range raise `InputError`.
"""

import math
from collections.abc import Sequence
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float
from PIL import Image, ImageDraw, ImageFont

from ..base.errors import InputError, short_repr
from ..grid import Grid
from ..layouts import check_positive, half_size
from ..typing import Number

Emitters = Float[np.ndarray, "emitter 4"]

# Bars of a USAF element of width 1, a corner at the origin: three across x, a gap of two widths, three across y.
_ELEMENT = np.array([(x, x + 1, 0, 5) for x in (0, 2, 4)] + [(7, 12, y, y + 1) for y in (0, 2, 4)], float)
# Centre lines of a snowflake's arm along +x, of length 1, from and to x + iy.
_SIDES = np.exp(1j * np.pi / 3 * np.array([1, -1]))
_ARM = np.array([(0, 1), *((x, x + length * side) for x, length in ((0.45, 0.27), (0.72, 0.2)) for side in _SIDES)])
# Smallest height of rendered text in pixels, as Pillow fits letters to whole pixels.
_LEAST_ROWS = 600


def random_points(count: int, size: Sequence[Number], depth_range: Sequence[Number], *, seed: int = 0) -> Emitters:
    """Points of intensity 1, uniform in a box of the size `(x, y)` on the axis and the depths `(near, far)`, mm."""
    return _emitters(_uniform(count, half_size(size), _range(depth_range), seed).T, 1)


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
    half, (near, far), radius = half_size(size), _range(depth_range), diameter / 2
    if diameter > (room := min(*(2 * half), far - near)):
        raise InputError(f"`diameter` must be at most {room:.4g} mm to fit into the slab, got {diameter}.")
    middles = _uniform(count, half - radius, (near + radius, far - radius), seed)
    ball = np.array(list(product(_cells(-radius, radius, pitch)[0], repeat=3)))
    ball = ball[(ball**2).sum(axis=1) <= radius**2]
    return _emitters((middles[:, None] + ball).reshape(-1, 3).T, math.pi * diameter**3 / 6 / len(ball))


def usaf_bars(groups: Sequence[int] = (2, 3)) -> Float[np.ndarray, "bar 4"]:
    """Bars of the 1951 USAF target (MIL-STD-150A): rows of `(x_min, x_max, y_min, y_max)`, mm.

    Element `e` of group `g` has `2^(g + (e - 1) / 6)` line pairs per mm: three bars across x, then three across y, five
    times as long as wide, as far apart as wide. The arrangement is ours: each group is a column of six elements, the
    first at the top (the least y), columns go from left to right, and the middle of the whole is on the axis.
    """
    if len(groups) == 0:
        raise InputError("`groups` must be one group or more, got none.")
    elements, left = [], 0.0
    for group in groups:
        widths = 0.5 / 2.0 ** (group + np.arange(6) / 6)
        tops = 7 * (np.cumsum(widths) - widths)
        elements += [width * _ELEMENT + [left, left, top, top] for width, top in zip(widths, tops, strict=True)]
        left += 15 * widths[0]
    bars = np.concatenate(elements)
    middle = (bars[:, [0, 2]].min(axis=0) + bars[:, [1, 3]].max(axis=0)) / 2
    return bars - np.repeat(middle, 2)


def usaf_1951(groups: Sequence[int] = (2, 3), *, depth: Number, pitch: Number) -> Emitters:
    """The bars of `usaf_bars`, glowing, in the plane `depth` (Fig. 6)."""
    _check_lengths(depth=depth, pitch=pitch)
    cells = [(_cells(a, b, pitch), _cells(c, d, pitch)) for a, b, c, d in usaf_bars(groups)]
    grids = [(np.tile(x, len(y)), np.repeat(y, len(x)), dx * dy) for (x, dx), (y, dy) in cells]
    return np.concatenate([_emitters([x, y, depth], area) for x, y, area in grids])


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
    near, far = _range(depth_range)
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
    return _emitters([lateral.real, lateral.imag, (near + far) / 2 + sine * slope], np.tile(area, 6))


def letters(text: str, *, depth: Number, height: Number, pitch: Number) -> Emitters:
    """Glowing text, one line or more, upright in an image with row 0 at the top, its middle on the axis.

    In Pillow's own font, with capitals of a `height`, in the plane `depth`, mm.
    """
    _check_lengths(depth=depth, height=height, pitch=pitch)
    rows = math.ceil(height / pitch)
    parts = math.ceil(_LEAST_ROWS / rows)
    ink = _render_text(text, rows * parts * 1000 / len(_render_text("H", 1000)))
    if not ink.any():
        raise InputError(f"`text` must have a visible character, got {text!r}.")
    padded, square = np.pad(ink, [(0, -n % parts) for n in ink.shape]), height / rows
    covered = padded.reshape(len(padded) // parts, parts, -1, parts).mean(axis=(1, 3))
    row, column = np.nonzero(covered)
    y, x = (square * (at + 0.5 - n / (2 * parts)) for at, n in zip((row, column), ink.shape, strict=True))
    return _emitters([x, y, depth], covered[row, column] * square**2)


def rasterize(emitters: Float[Array | np.ndarray, "emitter 4"], grid: Grid) -> Float[Array, "depth y x"]:
    """The volume that a scene makes on a grid: linear weights along x, y and z.

    *Host.*

    The weights of an emitter between voxel centres keep its total and its centroid. In the outer half of a voxel at the
    grid's edge all goes to that voxel; what lies beyond is left out. Of a single depth, voxels are as thick as
    `grid.pitch`. Differentiable with respect to the emitters and the depths.

    Parameters
    ----------
    emitters, grid
        The scene, and the voxels, whose depths ascend, evenly or not. The volume has the grid's type.

    Raises
    ------
    ValueError
        If the depths do not ascend or a number is not finite (values traced by JAX are not checked).

    Examples
    --------
    >>> import gs_jax as gs, numpy as np
    >>> grid = gs.Grid([18.0, 20.0, 22.0], (41, 41), 0.1)
    >>> volume = gs.rasterize(np.array([[0.05, 0.0, 21.0, 1.0]]), grid)  # between two voxels and two planes
    >>> print(round(float(volume.sum()), 3), int((volume > 0.2).sum()))
    1.0 4
    """
    depths = grid.depths
    if not isinstance(depths, Tracer) and not (np.diff(np.asarray(depths)) > 0).all():
        raise ValueError(f"`grid.depths` must ascend, got {short_repr(depths.tolist())}.")
    if isinstance(emitters, Tracer):
        return _rasterize(emitters.astype(depths.dtype), grid)
    emitters = np.asarray(emitters, depths.dtype)
    if not (finite := np.isfinite(emitters).all(axis=1)).all():
        raise ValueError(f"`emitters` must be finite, got {emitters[np.argmin(finite)].tolist()}.")
    # Dark ones make it a power of two: scenes of about as many emitters share a program.
    size = 1 << max(len(emitters) - 1, 0).bit_length()
    return _rasterize(np.pad(emitters, [(0, size - len(emitters)), (0, 0)]), grid)


@jax.jit
def _rasterize(emitters, grid):
    x, y, z, intensity = jnp.asarray(emitters, grid.depths.dtype).T
    shape = grid.volume_shape
    places = ((y - grid.origin[1], grid.shape[0]), (x - grid.origin[0], grid.shape[1]))
    row, column = (at / grid.pitch + (n - 1) / 2 for at, n in places)
    axes = [_shares(index, n) for index, n in zip((_depth_index(z, grid), row, column), shape, strict=True)]
    volume = jnp.zeros(shape, intensity.dtype)
    for corner in product(*axes):
        indices, weights = zip(*corner, strict=True)
        volume = volume.at[indices].add(intensity * math.prod(weights), mode="drop")
    return volume


def _depth_index(z, grid):
    """Fractional index of a depth: linear between the grid's depths, and beyond them as between the last two."""
    depths = grid.depths
    if depths.size == 1:
        return (z - depths[0]) / grid.pitch
    below = jnp.clip(jnp.searchsorted(depths, z, side="right") - 1, 0, depths.size - 2)
    return below.astype(z.dtype) + (z - depths[below]) / jnp.diff(depths)[below]


def _shares(index, size):
    """The two neighbours of fractional indices along an axis, as `(index, weight)`; zero weight off the axis."""
    inside = ((index >= -0.5) & (index <= size - 0.5)).astype(index.dtype)
    index = jnp.clip(index, 0, size - 1)
    below = jnp.clip(jnp.floor(index), 0, max(size - 2, 0))
    fraction, below = index - below, below.astype(jnp.int32)
    return (below, inside * (1 - fraction)), (below + 1, inside * fraction)


def _check_lengths(**lengths):
    for name, length in lengths.items():
        check_positive(name, length)


def _range(depth_range) -> tuple[float, float]:
    if len(depth_range) != 2 or not 0 < depth_range[0] <= depth_range[1] < math.inf:
        raise InputError(f"`depth_range` must be (near, far), positive and ascending, mm, got {tuple(depth_range)}.")
    return float(depth_range[0]), float(depth_range[1])


def _uniform(count, half, depth_range, seed):
    if count < 1:
        raise InputError(f"`count` must be 1 or more, got {count}.")
    return np.random.default_rng(seed).uniform([*-half, depth_range[0]], [*half, depth_range[1]], (count, 3))


def _emitters(xyz, intensity) -> Emitters:
    return np.stack(np.broadcast_arrays(*xyz, intensity), axis=1, dtype=float)


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


def _render_text(text, font_size):
    """Coverage, 0 to 1, of each pixel `(row, column)` of a text's bounding box."""
    font = ImageFont.load_default(size=font_size)
    left, top, right, bottom = ImageDraw.Draw(Image.new("L", (1, 1))).textbbox((0, 0), text, font=font)
    page = Image.new("L", (math.ceil(right - left) + 2, math.ceil(bottom - top) + 2))
    ImageDraw.Draw(page).text((1 - left, 1 - top), text, fill=255, font=font)
    return np.asarray(page.crop(page.getbbox())) / 255
