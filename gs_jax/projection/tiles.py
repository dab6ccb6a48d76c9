"""The projections of XLA for GPUs and TPUs: each voxel, or pixel, sums over the lenses that reach it.

The forms in `bilinear` take one lens after the other, as suits a CPU's caches. A GPU would wait for hundreds of small
kernels. Here the volume, or the image, is cut into square tiles, each with a list of the lenses that reach it, and one
kernel computes all tiles for the next lenses of each list: gathers fused with the sum over lenses or depths. Nothing
depends on a condition, and only tables of an axis and the result are stored. `scatter` gathers, too, for TPUs and for
versions of JAX that add floats on GPUs by loops that wait for each other; `add_to_pixels` scatters.

The length of the lists depends on the centres and the magnification, which may be traced. So each projection has one
loop with a traced number of steps. The bound that is known before, the number of lenses, would be several times as much
work.
"""

import math
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .rays import OUTSIDE, Axis, Rays, Shapes, interpolate, pairs

# Sides of a tile of voxels and of a tile of pixels.
VOXELS, _PIXELS = 16, 32
# Lenses of each tile of voxels that are summed in one step: lists are long. Those of pixels hold a few lenses.
_LENSES = 8
# Pixels times depths that are computed at once, which bounds the memory: the tables take 1.5 bytes for each.
_BAND = 2**25
# Rays reach pixels less than one pixel away; the rest is for rounding.
_REACH = 1.01


def gather(shapes: Shapes, rays: Rays, image) -> Float[Array, "depth y x"]:
    """`bilinear.image_to_volume`."""
    lists, lengths = lenses_of_voxels(shapes, rays)
    tall, wide, lenses = lists.shape
    lists = jnp.pad(lists, [(0, 0), (0, 0), (0, -lenses % _LENSES)], constant_values=lenses)

    def add_lenses(step, volume):
        weight, pixel, fractions = _rays_of_tiles(shapes, rays, lists, step, _LENSES)
        if image is not None:
            corners = [_take(image, pixel + down + right) for down in (0, shapes.image[1]) for right in (0, 1)]
            weight = weight * interpolate([corner.astype(weight.dtype) for corner in corners], *fractions)[0]
        return volume + weight.sum(0)

    depths, *sides = shapes.volume
    volume = jnp.zeros((depths, tall, VOXELS, wide, VOXELS), rays.parameters.dtype)
    volume = lax.fori_loop(0, -(-lengths.max() // _LENSES), add_lenses, volume)
    return volume.reshape(depths, tall * VOXELS, wide * VOXELS)[:, : sides[0], : sides[1]]


def add_to_pixels(shapes: Shapes, rays: Rays, volume) -> Float[Array, "row column"]:
    """`scatter` as a scatter-add, one lens of each tile at a time, for compilers that add floats without loops."""
    lists, lengths = lenses_of_voxels(shapes, rays)
    tall, wide, _ = lists.shape
    missing = [(0, 0), *((0, count * VOXELS - n) for count, n in zip((tall, wide), shapes.volume[1:], strict=True))]
    volume = jnp.pad(volume, missing).reshape(1, 1, -1, tall, VOXELS, wide, VOXELS)
    # The first axis has the four pixels around each ray.
    corner = _numbers(4, axis=0, of=7)
    down, right = corner // 2, corner % 2

    def add_lens(step, image):
        weight, pixel, fractions = _rays_of_tiles(shapes, rays, lists, step, 1)
        light = weight[None] * volume
        for is_next, fraction in zip((down, right), fractions, strict=True):
            light = light * jnp.where(is_next == 1, fraction[None], 1 - fraction[None])
        # What adds nothing is beyond the image, and dropped.
        place = jnp.where(weight != 0, pixel, image.size)[None] + down * shapes.image[1] + right
        return image.at[place].add(light, mode="drop", wrap_negative_indices=False)

    image = jnp.zeros(math.prod(shapes.image), volume.dtype)
    return lax.fori_loop(0, lengths.max(), add_lens, image).reshape(shapes.image)


def _rays_of_tiles(shapes, rays, lists, step, count):
    """The rays of some lenses of each tile: weights, pixels above to the left, fractions of the way down and right.

    Axes: lens, depth, row of tiles, row, column of tiles, column.
    """
    tall, wide, _ = lists.shape
    lens = jnp.moveaxis(lax.dynamic_slice_in_dim(lists, step * count, count, axis=2), 2, 0)
    lens = lens[:, None, :, None, :, None]
    depth = _numbers(shapes.volume[0], axis=1, of=6)
    row = _numbers(tall, axis=2, of=6) * VOXELS + _numbers(VOXELS, axis=3, of=6)
    column = _numbers(wide, axis=4, of=6) * VOXELS + _numbers(VOXELS, axis=5, of=6)
    y_pair, x_pair = pairs(shapes, rays)
    y = _place(rays.y, lens, depth, row - _start(rays.y, lens, depth))
    x = _place(rays.x, lens, depth, column - _start(rays.x, lens, depth))
    distance2 = _distance2(rays.y, y) + _distance2(rays.x, x)
    pixel = _take(y_pair.low, y.at) * shapes.image[1] + _take(x_pair.low, x.at)
    fractions = _take(y_pair.fraction, y.at), _take(x_pair.fraction, x.at)
    return rays.weight(distance2, rays.parameters[None, :, None, None, None, None]), pixel, fractions


def scatter(shapes: Shapes, rays: Rays, volume) -> Float[Array, "row column"]:
    """`bilinear.volume_to_image`, one band of tiles after the other."""
    depths, *sides = shapes.volume
    tall, wide = (-(-n // _PIXELS) for n in shapes.image)
    band = min(max(_BAND // (depths * wide * _PIXELS**2), 1), tall)
    bands = -(-tall // band)
    ends = [(axis.pixel // _PIXELS, (axis.pixel + 1) // _PIXELS) for axis in (rays.y, rays.x)]
    lists, lengths = _lenses_of_tiles(shapes, rays, ends, [bands * band, wide])
    # Axes: depth, row of tiles, row, column of tiles, column.
    depth = _numbers(depths, axis=0, of=5)
    row = _numbers(band, axis=1, of=5) * _PIXELS + _numbers(_PIXELS, axis=2, of=5)
    column = _numbers(wide, axis=3, of=5) * _PIXELS + _numbers(_PIXELS, axis=4, of=5)
    parameters = rays.parameters[:, None, None, None, None]
    # The rays that may reach a pixel are neighbours; so many pairs of them, each way.
    count = jnp.floor(2 * _REACH / rays.spacing.min()).astype(jnp.int32) // 2 + 1

    def image_of_band(of_band):
        first, lists, lengths = of_band

        def add_pairs(step, image):
            lens = lax.dynamic_index_in_dim(lists, step // count**2, axis=2, keepdims=False)[None, :, None, :, None]
            down, right = step // count % count, step % count
            terms = []
            for y, x in product(
                _two_rays(rays.y, rays.spacing, lens, depth, first + row, 2 * down),
                _two_rays(rays.x, rays.spacing, lens, depth, column, 2 * right),
            ):
                share = rays.weight(y.distance2 + x.distance2, parameters) * (y.share * x.share)
                voxel = (depth * sides[0] + y.voxel) * sides[1] + x.voxel
                terms.append(share * _take(volume, voxel))
            return image + sum(terms[1:], terms[0]).sum(0)

        image = jnp.zeros((band, _PIXELS, wide, _PIXELS), volume.dtype)
        return lax.fori_loop(0, lengths.max() * count**2, add_pairs, image)

    first = _numbers(bands, axis=0, of=1) * (band * _PIXELS)
    in_bands = [a.reshape(bands, band, *a.shape[1:]) for a in (lists, lengths)]
    image = lax.map(image_of_band, (first, *in_bands))
    return image.reshape(bands * band * _PIXELS, wide * _PIXELS)[: shapes.image[0], : shapes.image[1]]


def lenses_of_voxels(shapes: Shapes, rays: Rays) -> tuple[Int[Array, "row column place"], Int[Array, "row column"]]:
    """`_lenses_of_tiles` of `VOXELS` x `VOXELS` voxels."""
    voxels = [axis.start[..., None] + _numbers(axis.pixel.shape[2], axis=2, of=3) for axis in (rays.y, rays.x)]
    counts = [-(-n // VOXELS) for n in shapes.volume[1:]]
    return _lenses_of_tiles(shapes, rays, [(n // VOXELS, n // VOXELS) for n in voxels], counts)


def _lenses_of_tiles(shapes, rays, ends, counts) -> tuple[Int[Array, "row column place"], Int[Array, "row column"]]:
    """Numbers of the lenses that reach each tile, filled up with the number of no lens, and how many they are.

    `ends` are, for each axis, the first and the last tile that each ray reaches, `counts` the tiles each way.
    """
    rows, columns = (
        _nearest(axis.distance2, first, last, count)
        for axis, (first, last), count in zip((rays.y, rays.x), ends, counts, strict=True)
    )
    reached = rows.T[:, None, :] + columns.T[None] < rays.weight.limit**2
    lenses = reached.shape[2]
    lists = jnp.where(reached, _numbers(lenses, axis=2, of=3), lenses)
    return jnp.sort(lists, stable=False), reached.sum(2, dtype=jnp.int32)


def _nearest(distance2, first, last, count) -> Float[Array, "lens tile"]:
    """The least squared distance, at any depth, of the rays that reach each tile along one axis."""
    tile = _numbers(count, axis=3, of=4)
    reached = (first[..., None] <= tile) & (tile <= last[..., None])
    return jnp.where(reached, lax.stop_gradient(distance2)[..., None], OUTSIDE).min((1, 2))


class _Place(NamedTuple):
    """A place in the tables of an axis, and whether there is such a lens that may see such a voxel."""

    at: Int[Array, "..."]
    exists: Bool[Array, "..."]


def _place(axis: Axis, lens, depth, voxel) -> _Place:
    """The place of a voxel, counted from the first of a lens's patch."""
    size = axis.pixel.shape[2]
    exists = (lens < len(axis.pixel)) & (voxel >= 0) & (voxel < size)
    return _Place(_of_lens(axis, lens, depth) * size + jnp.clip(voxel, 0, size - 1), exists)


def _distance2(axis: Axis, place: _Place):
    return jnp.where(place.exists, _take(axis.distance2, place.at), OUTSIDE)


def _of_lens(axis: Axis, lens, depth):
    """The place in tables `(lens, depth)`; that of another lens for no lens."""
    return jnp.minimum(lens, len(axis.pixel) - 1) * axis.pixel.shape[1] + depth


def _start(axis: Axis, lens, depth):
    """The first voxel of a lens's patch."""
    return _take(jnp.broadcast_to(axis.start, axis.origin.shape), _of_lens(axis, lens, depth))


class _Ray(NamedTuple):
    """The ray of a voxel along one axis: what it adds to a pixel, and its squared distance from the lens's axis."""

    voxel: Int[Array, "..."]
    share: Float[Array, "..."]
    distance2: Float[Array, "..."]


def _two_rays(axis: Axis, spacing, lens, depth, pixel, number) -> list[_Ray]:
    """Two neighbours of the rays that may reach a pixel, from this number on; the rays' pixels fall with the voxels."""
    size, of_lens = axis.pixel.shape[2], _of_lens(axis, lens, depth)
    origin, step = _take(axis.origin, of_lens), _take(spacing, of_lens)
    first = jnp.ceil((origin - pixel.astype(origin.dtype) - _REACH) / step)
    first = jnp.clip(first, 0, size).astype(jnp.int32) + number
    rays = []
    for voxel in (first, first + 1):
        at, exists = _place(axis, lens, depth, voxel)
        low, fraction = _take(axis.pixel, at), _take(axis.fraction, at)
        share = jnp.where(low == pixel, 1 - fraction, jnp.where(low == pixel - 1, fraction, 0))
        voxel = _start(axis, lens, depth) + jnp.minimum(voxel, size - 1)
        rays.append(_Ray(voxel, jnp.where(exists, share, 0), _take(axis.distance2, at)))
    return rays


def _take(table, index):
    """From a flat table: indices along several axes would be stored before they are used."""
    return table.ravel().at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _numbers(count: int, *, axis: int, of: int) -> Int[Array, "..."]:
    """0 to `count - 1` along one of several axes."""
    return jnp.arange(count, dtype=jnp.int32).reshape([-1 if n == axis else 1 for n in range(of)])
