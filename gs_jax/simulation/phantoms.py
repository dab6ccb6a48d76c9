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

# Smallest height of rendered text in pixels, as Pillow fits letters to whole pixels.
_LEAST_ROWS = 600


def random_points(count: int, size: Sequence[Number], depth_range: Sequence[Number], *, seed: int = 0) -> Emitters:
    """Points of intensity 1, uniform in a box of the size `(x, y)` on the axis and the depths `(near, far)`, mm."""
    return as_emitters(uniform_points(count, half_size(size), check_range(depth_range), seed).T, 1)


def letters(text: str, *, depth: Number, height: Number, pitch: Number) -> Emitters:
    """Glowing text, one line or more, upright in an image with row 0 at the top, its middle on the axis.

    In Pillow's own font, with capitals of a `height`, in the plane `depth`, mm.
    """
    for name, length in (("depth", depth), ("height", height), ("pitch", pitch)):
        check_positive(name, length)
    rows = math.ceil(height / pitch)
    parts = math.ceil(_LEAST_ROWS / rows)
    ink = _render_text(text, rows * parts * 1000 / len(_render_text("H", 1000)))
    if not ink.any():
        raise InputError(f"`text` must have a visible character, got {text!r}.")
    padded, square = np.pad(ink, [(0, -n % parts) for n in ink.shape]), height / rows
    covered = padded.reshape(len(padded) // parts, parts, -1, parts).mean(axis=(1, 3))
    row, column = np.nonzero(covered)
    y, x = (square * (at + 0.5 - n / (2 * parts)) for at, n in zip((row, column), ink.shape, strict=True))
    return as_emitters([x, y, depth], covered[row, column] * square**2)


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


def check_range(depth_range) -> tuple[float, float]:
    """The depths `(near, far)`, mm, as floats; `InputError` unless they are positive and ascend."""
    if len(depth_range) != 2 or not 0 < depth_range[0] <= depth_range[1] < math.inf:
        raise InputError(f"`depth_range` must be (near, far), positive and ascending, mm, got {tuple(depth_range)}.")
    return float(depth_range[0]), float(depth_range[1])


def uniform_points(count, half, depth_range, seed):
    """Random points `(point, 3)` of a box from `-half` to `half` (x, y), and of a range of depths."""
    if count < 1:
        raise InputError(f"`count` must be 1 or more, got {count}.")
    return np.random.default_rng(seed).uniform([*-half, depth_range[0]], [*half, depth_range[1]], (count, 3))


def as_emitters(xyz, intensity) -> Emitters:
    """Emitters of coordinates and intensities that broadcast."""
    return np.stack(np.broadcast_arrays(*xyz, intensity), axis=1, dtype=float)


def _render_text(text, font_size):
    """Coverage, 0 to 1, of each pixel `(row, column)` of a text's bounding box."""
    font = ImageFont.load_default(size=font_size)
    left, top, right, bottom = ImageDraw.Draw(Image.new("L", (1, 1))).textbbox((0, 0), text, font=font)
    page = Image.new("L", (math.ceil(right - left) + 2, math.ceil(bottom - top) + 2))
    ImageDraw.Draw(page).text((1 - left, 1 - top), text, fill=255, font=font)
    return np.asarray(page.crop(page.getbbox())) / 255
