"""The bilinear form of the chief rays, and its three derivatives.

Back-projection, its adjoint and its gradient are derivatives of one bilinear form,

    B(volume, image, rays) = sum_j sum_q C_j(q) volume(q) image(p_j(q)),

the sum over lenses j and voxels q of the lens weight, the voxel and the image at the pixel p_j(q) of the chief ray:
back-projection is dB/d(volume), the ray-optics image of a volume is dB/d(image), and dB/d(rays) is the gradient by the
geometry, which JAX propagates to lens positions, distances and depths. Each is written out because JAX would transpose
the gather to a scatter, which is twenty times slower on a CPU.

The forms here are for CPUs without kernels; those for GPUs and TPUs are in `tiles` and `cuda`. Each scans the lenses,
one patch of voxels at a time and all depths at once, so that the memory is image + volume + one patch. `lax.cond` skips
lenses that see no voxel. It also stops XLA from fusing the loop body into one in-place update on one core: what a
branch returns is computed separately, on all cores.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ..linear.linear_map import LinearMap
from . import cuda, tiles
from .cpu.loading import kernels
from .rays import Axis, Pair, Rays, Shapes, interpolate, pairs

# Side of the square of pixels that the adjoint writes at once: its buffers stay in the cache. The magnification, which
# may be traced, changes the number of squares and not their size.
_BLOCK = 160
# Lenses at once in the gradient by the rays on GPUs and TPUs, which bounds the memory.
_LENSES = 16


def _gather(shapes: Shapes, rays: Rays, image):
    """dB/d(volume). None is an image of ones, which costs less."""

    def add_lens(volume, lens):
        y, x, y_pair, x_pair = lens

        def patch():
            weight = _weights(rays, y, x)
            if image is None:
                return weight
            return weight * _between(_corners(image, y_pair, x_pair), y_pair, x_pair)[0]

        new = _patch(volume, y, x) + _if_seen(rays, y, x, patch)
        return _update_patch(volume, new, y, x), None

    volume = jnp.zeros(shapes.volume, rays.parameters.dtype)
    return lax.scan(add_lens, volume, (rays.y, rays.x, *pairs(shapes, rays)))[0]


def _scatter(shapes: Shapes, rays: Rays, volume):
    """dB/d(image), by gathers: each pixel looks up the voxels that reach it, along x and then along y."""
    # Neighbouring rays are `spacing` apart, and a pixel is reached from less than one pixel on either side.
    taps = jnp.floor(2 / rays.spacing.min() + 1e-3).astype(jnp.int32) + 1

    def add_lens(image, lens):
        y, x, spacing = lens
        weighted = lambda: _weights(rays, y, x) * _patch(volume, y, x)
        patch = _if_seen(rays, y, x, weighted)
        column_blocks, row_blocks = _blocks(x, shapes.image[1]), _blocks(y, shapes.image[0])

        def add_columns(block, image):
            left, columns, fresh = column_blocks.block(block)
            spread = _spread_columns(patch, x, spacing, columns, fresh, taps)

            def add_rows(block, image):
                top, rows, fresh = row_blocks.block(block)
                return _add_rows(image, spread, y, spacing, rows, fresh, taps, (top, left))

            return lax.fori_loop(0, row_blocks.blocks, add_rows, image)

        return lax.fori_loop(0, column_blocks.blocks, add_columns, image), None

    image = jnp.zeros(shapes.image, volume.dtype)
    return lax.scan(add_lens, image, (rays.y, rays.x, rays.spacing))[0]


def _continuous(rays: Rays):
    return rays.y.fraction, rays.y.distance2, rays.x.fraction, rays.x.distance2, rays.parameters


def _rays_vjp(shapes: Shapes, constants, volume, at_once=None):
    """dB/d(rays), of the `_continuous` ones: sums over one axis of the derivatives along the other."""
    rays, image = constants

    def of_lens(lens):
        y, x, y_pair, x_pair = lens
        patch = _patch(volume, y, x)
        distance2 = y.distance2[:, :, None] + x.distance2[:, None, :]
        weight, weight_vjp = jax.vjp(rays.weight, distance2, rays.parameters[:, None, None])
        if image is None:
            sample, along_y, along_x = jnp.ones_like(patch), jnp.zeros_like(patch), jnp.zeros_like(patch)
        else:
            corners = _if_seen(rays, y, x, lambda: _corners(image, y_pair, x_pair))
            sample, along_y, along_x = _between(corners, y_pair, x_pair)
        by_distance2, by_parameters = weight_vjp(patch * sample)
        by_y, by_x = patch * weight * along_y, patch * weight * along_x
        return by_y.sum(2), by_distance2.sum(2), by_x.sum(1), by_distance2.sum(1), by_parameters[:, 0, 0]

    *by_axes, by_parameters = lax.map(of_lens, (rays.y, rays.x, *pairs(shapes, rays)), batch_size=at_once)
    return *by_axes, by_parameters.sum(0)


def _rays_vjp_transpose(shapes: Shapes, constants, cotangents):
    volume = jax.ShapeDtypeStruct(shapes.volume, cotangents[0].dtype)
    return jax.linear_transpose(lambda volume: _rays_vjp(shapes, constants, volume), volume)(cotangents)[0]


_continuous_vjp = LinearMap(
    _rays_vjp,
    _rays_vjp_transpose,
    kernels=kernels("rays_vjp", None),
    accelerated=(partial(_rays_vjp, at_once=_LENSES), None),
)


def rays_vjp(shapes: Shapes, rays: Rays, image, volume) -> Rays:
    """dB/d(rays), zero for integers and for what follows from others."""
    gradient = _continuous_vjp(shapes, (rays, image), volume)
    return eqx.tree_at(_continuous, jax.tree.map(jnp.zeros_like, rays), gradient)


# `(shapes, rays, image)` to dB/d(volume), `(shapes, rays, volume)` to dB/d(image); both differentiable.
image_to_volume = LinearMap(
    _gather,
    _scatter,
    rays_vjp,
    kernels=kernels("gather", "scatter"),
    accelerated=(tiles.gather, tiles.scatter),
    cuda=(cuda.gather, cuda.scatter),
)
volume_to_image = image_to_volume.T


def _patch(volume, y: Axis, x: Axis) -> Float[Array, "depth y x"]:
    """The voxels that one lens may see."""
    size = y.pixel.shape[1], x.pixel.shape[1]
    if y.start.size == 1:
        return lax.dynamic_slice(volume, _corner(y, x), (len(volume), *size))
    return jax.vmap(lambda plane, row, column: lax.dynamic_slice(plane, (row, column), size))(volume, y.start, x.start)


def _update_patch(volume, patch, y: Axis, x: Axis) -> Float[Array, "depth y x"]:
    if y.start.size == 1:
        return lax.dynamic_update_slice(volume, patch, _corner(y, x))
    put = lambda plane, new, row, column: lax.dynamic_update_slice(plane, new, (row, column))
    return jax.vmap(put)(volume, patch, y.start, x.start)


def _corner(y: Axis, x: Axis):
    return jnp.zeros_like(y.start[0]), y.start[0], x.start[0]


def _weights(rays: Rays, y: Axis, x: Axis) -> Float[Array, "depth y x"]:
    distance2 = y.distance2[:, :, None] + x.distance2[:, None, :]
    return rays.weight(distance2, rays.parameters[:, None, None])


def _if_seen(rays: Rays, y: Axis, x: Axis, compute):
    """`compute()`, or zeros if the lens sees no voxel on the sensor."""
    seen = y.distance2.min() + x.distance2.min() < rays.weight.limit**2
    zeros = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(compute))
    return lax.cond(seen, compute, lambda: zeros)


def _corners(image, y: Pair, x: Pair):
    """The four pixels around each ray, `(depth, y, x)` each."""
    row, column = y.low[:, :, None], x.low[:, None, :]
    read = lambda down, right: (
        image.at[row + down, column + right].get(mode="promise_in_bounds").astype(y.fraction.dtype)
    )
    return read(0, 0), read(0, 1), read(1, 0), read(1, 1)


def _between(corners, y: Pair, x: Pair):
    return interpolate(corners, y.fraction[:, :, None], x.fraction[:, None, :])


class _Blocks(NamedTuple):
    """Consecutive blocks of pixels that cover all rays of a lens along one axis."""

    first: Int[Array, ""]
    blocks: Int[Array, ""]
    pixels: int

    def block(self, number):
        """First pixel, pixels `(block,)` and whether they are in no earlier block (the last one ends at the sensor)."""
        size = min(_BLOCK, self.pixels)
        wanted = self.first + number * size
        start = jnp.minimum(wanted, self.pixels - size)
        pixels = start + jnp.arange(size, dtype=jnp.int32)
        return start, pixels, pixels >= wanted


def _blocks(axis: Axis, pixels: int) -> _Blocks:
    first = jnp.clip(axis.pixel.min(), 0, pixels - 1)
    last = jnp.clip(axis.pixel.max() + 1, 0, pixels - 1)
    return _Blocks(first, (last - first) // min(_BLOCK, pixels) + 1, pixels)


def _taps(axis: Axis, spacing, pixels, fresh):
    """A function from n to the n-th voxel that reaches each pixel, and its share there: `(depth, pixel)` both.

    The rays' pixels fall with the voxel's number: those that reach a pixel are neighbours.
    """
    reach = pixels[None, :]
    last = axis.pixel.shape[1] - 1
    at = lambda table, voxel: jnp.take_along_axis(table, voxel, axis=1, mode="promise_in_bounds")
    # The first voxel whose pixel is not above this one: guessed one or two too low, as rounding allows, and corrected.
    guess = jnp.floor((axis.origin[:, None] - (reach + 1).astype(axis.origin.dtype)) / spacing[:, None] - 0.5)
    first = jnp.clip(guess, 0, last).astype(jnp.int32)
    for _ in range(2):
        first = jnp.minimum(first + (at(axis.pixel, first) > reach).astype(jnp.int32), last)

    def tap(count):
        voxel = jnp.minimum(first + count, last)
        pixel, fraction = at(axis.pixel, voxel), at(axis.fraction, voxel)
        part = jnp.where(pixel == reach, 1 - fraction, jnp.where(pixel == reach - 1, fraction, 0))
        return voxel, jnp.where(fresh[None, :] & (first + count <= last), part, 0)

    return tap


def _spread_columns(patch, x: Axis, spacing, columns, fresh, taps):
    """A patch of voxels `(depth, y, x)` spread over pixel columns, `(depth, y, column)`."""
    tap = _taps(x, spacing, columns, fresh)

    def add(count, state):
        spread, voxel, part = state
        return spread + part[:, None, :] * _take(patch, voxel, axis=2), *tap(count + 1)

    # The next tap is carried, so that it is computed once and not for every row.
    empty = jnp.zeros((*patch.shape[:2], columns.size), patch.dtype)
    return lax.fori_loop(0, taps, add, (empty, *tap(0)))[0]


def _add_rows(image, spread, y: Axis, spacing, rows, fresh, taps, start):
    """Adds the result of `_spread_columns` to a block of the image, spread over pixel rows and summed over depths."""
    tap = _taps(y, spacing, rows, fresh)

    def add(count, state):
        image, voxel, part = state
        block = lax.dynamic_slice(image, start, (rows.size, spread.shape[2]))
        voxels = _take(spread, voxel, axis=1)
        for depth in range(spread.shape[0]):  # unrolled: one pass over the block
            block = block + part[depth, :, None] * voxels[depth]
        return lax.dynamic_update_slice(image, block, start), *tap(count + 1)

    return lax.fori_loop(0, taps, add, (image, *tap(0)))[0]


def _take(array: Float[Array, "depth y x"], index: Int[Array, "depth new"], *, axis: int):
    """`array[d].take(index[d], axis - 1)` for each depth, in a form that keeps whole rows together."""
    dimensions = lax.GatherDimensionNumbers(
        offset_dims=(3 - axis,),
        collapsed_slice_dims=(axis,),
        start_index_map=(axis,),
        operand_batching_dims=(0,),
        start_indices_batching_dims=(0,),
    )
    sizes = [1, *array.shape[1:]]
    sizes[axis] = 1
    return lax.gather(array, index[..., None], dimensions, tuple(sizes), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)
