"""The field-varying forward model: the spots' cores on the sensor's pixels, and the stray light on coarse pixels."""

import math
import operator
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..geometry import Imager
from ..grid import Grid, Sensor
from ..optics.field_varying import FieldVaryingPsf
from ..optics.psf_core import ring_edges
from .bilinear import Shapes, volume_to_image
from .convolution import scan_in_groups, sum_of_convolutions, upsample_by_two, with_margin
from .rays import RingLight, trace
from .stray_light import cubic, stray_light_image, to_nodes

# Depths whose cores are convolved at once.
_DEPTHS = 1
# Share of a voxel by which whole numbers of voxels may differ from a pixel.
_ROUNDING = 0.02


def full_image(
    volume: Float[Array, "depth y x"], imager: Imager, grid: Grid, optics: FieldVaryingPsf
) -> Float[Array, "row column"]:
    """`gs_jax.forward` with `FieldVaryingPsf`."""
    nodes = to_nodes(volume, grid, optics.stray_light.grid)
    return _cores_image(volume, imager, grid, optics) + stray_light_image(
        nodes, imager, optics.stray_light, grid.origin
    )


def _cores_image(volume, imager, grid, optics):
    """The inner rings on the sensor's pixels, the others, whose cores are wider, on pixels twice as large.

    The light of the others comes from voxels as wide as these pixels, if that is several of the volume's.
    """
    sensor, rings = imager.sensor, ring_edges(imager, optics.rings)
    (_, inner, reach, _), size = optics.kernels.shape, optics.wide_kernels.shape[-1]
    wide, wide_half = with_margin(imager, reach), with_margin(_half_resolution(imager), size)
    dtype, nodes = volume.dtype, optics.stray_light.grid
    voxels_per_pixel = 2 * sensor.pixel_pitch / (grid.pitch * nodes.pixel / nodes.step)
    outer_grid, outer_volume = wider_voxels(grid, volume, max(int(voxels_per_pixel + _ROUNDING), 1))

    def sharp(imager, plane, number):
        depth, fine_voxels, wide_voxels, distortion, light, _, _ = plane
        grid_here, voxels = (grid, fine_voxels) if number < inner else (outer_grid, wide_voxels)
        # Chief rays of this apparent depth land where the cores of the true one do.
        magnification = imager.magnification(depth) * distortion[number]
        at = grid_here.at(imager.depth_of(imager.reduced_sensor_distance / magnification))
        if imager.tilt is not None:
            # The distortion is about the lens's axis, which is tilted.
            offset = (1 / distortion[number] - 1) * imager.axis_offset(depth[None])[0]
            at = eqx.tree_at(lambda g: g.origin, at, at.origin + offset)
        weight = RingLight(*rings[number])
        rays = trace(imager, at, nearest=False, dtype=dtype, limit=weight.limit, parameters=light[number][None])
        return volume_to_image(Shapes(imager.sensor.shape, at.volume_shape, weight), rays, voxels[None])

    # Not kept for the gradient: the sharp images of all depths are larger than the volume.
    @jax.checkpoint
    def add_depths(images, planes):
        fine, coarse = images
        depths = [jax.tree.map(lambda a, n=n: a[n], planes) for n in range(len(planes[0]))]
        kernels, wide_kernels = (part.reshape(-1, *part.shape[2:]) for part in planes[-2:])
        near = [sharp(wide, plane, number) for plane in depths for number in range(inner)]
        far = [sharp(wide_half, plane, number) for plane in depths for number in range(inner, len(rings))]
        fine = fine + sum_of_convolutions(near, kernels, symmetric=True)
        return fine, coarse + sum_of_convolutions(far, wide_kernels, whole=True, symmetric=True)

    kernels = (part.astype(dtype) for part in (optics.kernels, optics.wide_kernels))
    planes = grid.depths, volume, outer_volume, optics.distortion, optics.light, *kernels
    whole = [n + size - 1 for n in wide_half.sensor.shape]
    dark = jnp.zeros(sensor.shape, dtype), jnp.zeros(whole, dtype)
    fine, coarse = scan_in_groups(add_depths, dark, planes, _DEPTHS)
    return fine + upsample_by_two(coarse, size, sensor.shape)


def wider_voxels(grid, volume, factor):
    """A grid of voxels that are wider by a whole factor, and the volume's light, shared by these."""
    if factor == 1:
        return grid, volume
    volume = _share_lines(_share_lines(volume, factor, 1), factor, 2)
    return Grid(grid.depths, volume.shape[1:], factor * grid.pitch, grid.origin), volume


def _share_lines(volume, factor, axis):
    """Share lines along an axis by Keys' cubic, which keeps a spot's width: linear shares would blur."""
    size = volume.shape[axis]
    count = 2 * math.ceil(size / factor / 2) + 3
    # Place of the first new line, and the first line that shares its light with it.
    place = (size - 1) / 2 - factor * (count - 1) / 2
    first = math.floor(place) - 2 * factor + 1
    padding = [(0, 0)] * volume.ndim
    padding[axis] = -first, factor * (count + 3) - size + first
    padded, parts = jnp.pad(volume, padding), []
    for number in range(4 * factor):
        lines = lax.slice_in_dim(padded, number, number + factor * (count - 1) + 1, factor, axis)
        parts.append(float(cubic(np.array(abs(first + number - place) / factor))) * lines)
    return reduce(operator.add, parts)


def _half_resolution(imager: Imager) -> Imager:
    """The imager with pixels twice as large, the first of which covers the first two each way."""
    sensor = imager.sensor
    # An odd number of pixels gets one more, which moves the middle.
    columns, rows = (n % 2 * sensor.pixel_pitch / 2 for n in sensor.shape[::-1])
    middle = sensor.origin[0] + columns, sensor.origin[1] + rows
    large = Sensor([-(-n // 2) for n in sensor.shape], 2 * sensor.pixel_pitch, middle)
    return eqx.tree_at(lambda i: i.sensor, imager, large)
