"""The projections by NVIDIA Warp: one thread for each voxel goes through the lenses that reach its tile.

Warp compiles the kernels when they are first called: for the GPU, or, in tests, for the processor.
"""

from typing import Any

import jax
import jax.numpy as jnp
import warp as wp

from .rays import Rays, Shapes, weight_numbers
from .tiles import VOXELS, lenses_of_voxels

# Without a message about devices at the first call.
wp.config.log_level = wp.LOG_WARNING
wp.set_module_options({"enable_backward": False})
_VOXELS = wp.constant(VOXELS)
Numbers, Parameters = wp.array(dtype=float), wp.array2d(dtype=float)
Start, Index, Table = wp.array2d(dtype=int), wp.array3d(dtype=int), wp.array3d(dtype=float)


@wp.func
def falloff(distance2: float, limit2: float, slope: float):
    t = wp.clamp((limit2 - distance2) * slope, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.func
def weight(numbers: Numbers, parameters: Parameters, d: int, distance2: float):
    share = falloff(distance2, numbers[1], numbers[2])
    if numbers[0] == 0.0:
        depth2 = parameters[d, 0] * parameters[d, 0]
        cos2 = depth2 / (depth2 + distance2)
        return cos2 * cos2 * share
    if numbers[3] > 0.0:
        share -= falloff(distance2, numbers[3], numbers[4])
    t, value = distance2 * numbers[5], wp.float32(0.0)
    for n in range(parameters.shape[1]):
        value = value * t + parameters[d, parameters.shape[1] - 1 - n]
    return value * share


@wp.func
def pixel_of(pixel: Index, fraction: Table, lens: int, d: int, k: int, pixels: int):
    """The pixel below a ray, which has a neighbour above it, and the fraction of the way to that."""
    low = wp.clamp(pixel[lens, d, k], 0, pixels - 2)
    return low, fraction[lens, d, k] + float(pixel[lens, d, k] - low)


@wp.func
def ray(
    numbers: Numbers, parameters: Parameters,
    y_start: Start, y_pixel: Index, y_fraction: Table, y_distance2: Table,
    x_start: Start, x_pixel: Index, x_fraction: Table, x_distance2: Table,
    lens: int, d: int, row: int, column: int, height: int, width: int,
):  # fmt: skip
    """A voxel's weight through a lens, the pixel above to the left of its ray, and fractions of the way to the next."""
    k = row - y_start[lens, wp.min(d, y_start.shape[1] - 1)]
    n = column - x_start[lens, wp.min(d, x_start.shape[1] - 1)]
    if k < 0 or n < 0 or k >= y_pixel.shape[2] or n >= x_pixel.shape[2]:
        return 0.0, 0, 0, 0.0, 0.0
    distance2 = y_distance2[lens, d, k] + x_distance2[lens, d, n]
    if distance2 >= numbers[1]:
        return 0.0, 0, 0, 0.0, 0.0
    i, down = pixel_of(y_pixel, y_fraction, lens, d, k, height)
    j, right = pixel_of(x_pixel, x_fraction, lens, d, n, width)
    return weight(numbers, parameters, d, distance2), i, j, down, right


@wp.kernel
def gather_kernel(
    numbers: Numbers, parameters: Parameters,
    y_start: Start, y_pixel: Index, y_fraction: Table, y_distance2: Table,
    x_start: Start, x_pixel: Index, x_fraction: Table, x_distance2: Table,
    lists: Index, lengths: Start, image: wp.array2d(dtype=Any), volume: Table,
):  # fmt: skip
    d, row, column = wp.tid()
    tall, wide, total = row // _VOXELS, column // _VOXELS, wp.float32(0.0)
    for n in range(lengths[tall, wide]):
        share, i, j, down, right = ray(
            numbers, parameters, y_start, y_pixel, y_fraction, y_distance2, x_start, x_pixel, x_fraction, x_distance2,
            lists[tall, wide, n], d, row, column, image.shape[0], image.shape[1],
        )  # fmt: skip
        if share != 0.0:
            upper = wp.lerp(float(image[i, j]), float(image[i, j + 1]), right)
            lower = wp.lerp(float(image[i + 1, j]), float(image[i + 1, j + 1]), right)
            total += share * wp.lerp(upper, lower, down)
    volume[d, row, column] = total


@wp.kernel
def scatter_kernel(
    numbers: Numbers, parameters: Parameters,
    y_start: Start, y_pixel: Index, y_fraction: Table, y_distance2: Table,
    x_start: Start, x_pixel: Index, x_fraction: Table, x_distance2: Table,
    lists: Index, lengths: Start, volume: Table, image: wp.array2d(dtype=float),
):  # fmt: skip
    d, row, column = wp.tid()
    tall, wide = row // _VOXELS, column // _VOXELS
    for n in range(lengths[tall, wide]):
        share, i, j, down, right = ray(
            numbers, parameters, y_start, y_pixel, y_fraction, y_distance2, x_start, x_pixel, x_fraction, x_distance2,
            lists[tall, wide, n], d, row, column, image.shape[0], image.shape[1],
        )  # fmt: skip
        if share != 0.0:
            upper, lower = share * volume[d, row, column] * (1.0 - down), share * volume[d, row, column] * down
            wp.atomic_add(image, i, j, upper * (1.0 - right))
            wp.atomic_add(image, i, j + 1, upper * right)
            wp.atomic_add(image, i + 1, j, lower * (1.0 - right))
            wp.atomic_add(image, i + 1, j + 1, lower * right)


# One module, so that Warp compiles it once.
_gather = {
    jnp.dtype(name): wp.jax_kernel(wp.overload(gather_kernel, {"image": wp.array2d(dtype=kind)}))
    for name, kind in (("uint8", wp.uint8), ("uint16", wp.uint16), ("float32", wp.float32))
}
_scatter = wp.jax_kernel(scatter_kernel, in_out_argnames=["image"])


def gather(shapes: Shapes, rays: Rays, image) -> jax.Array:
    """`bilinear.image_to_volume`."""
    # Rays are moved onto the image, which may be small if it is of ones.
    image = jnp.ones((2, 2), jnp.float32) if image is None else image
    image = image if image.dtype in _gather else image.astype(jnp.float32)
    size = {"launch_dims": shapes.volume, "output_dims": shapes.volume}
    return _gather[image.dtype](*_tables(shapes, rays), image, **size)[0]


def scatter(shapes: Shapes, rays: Rays, volume) -> jax.Array:
    """`bilinear.volume_to_image`."""
    empty = jnp.zeros(shapes.image, jnp.float32)
    return _scatter(*_tables(shapes, rays), volume, empty, launch_dims=shapes.volume)[0]


def _tables(shapes: Shapes, rays: Rays) -> tuple:
    axes = [part for axis in (rays.y, rays.x) for part in (axis.start, axis.pixel, axis.fraction, axis.distance2)]
    return weight_numbers(rays.weight), rays.parameters, *axes, *lenses_of_voxels(shapes, rays)
