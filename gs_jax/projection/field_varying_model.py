"""The field-varying forward model: the spots' cores on the sensor's pixels, and the stray light on coarse pixels."""

import math
import operator
from functools import partial, reduce

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
from .convolution import sum_of_convolutions, upsample_by_two, with_margin
from .rays import RingLight, trace
from .stray_light import cubic, stray_light_image, to_nodes

# Share of a voxel by which whole numbers of voxels may differ from a pixel.
_ROUNDING = 0.02


def full_image(
    volume: Float[Array, "depth y x"], imager: Imager, grid: Grid, optics: FieldVaryingPsf
) -> Float[Array, "row column"]:
    """`gs_jax.forward` with `FieldVaryingPsf`."""
    nodes = to_nodes(volume, grid, optics.stray_light.grid)
    return _cores_image(volume, imager, grid, optics) + stray_light_image(
        nodes, imager, optics.stray_light, grid.depths, grid.origin
    )


def _cores_image(volume, imager, grid, optics):
    """The inner rings on the sensor's pixels, the others, whose cores are wider, on pixels twice as large.

    The light of the others comes from voxels as wide as these pixels, if that is several of the volume's.
    """
    sensor, rings = imager.sensor, ring_edges(imager, optics.rings)
    (_, inner, reach, _), size = optics.kernels.shape, optics.wide_kernels.shape[-1]
    wide, wide_half = with_margin(imager, reach), with_margin(_half_resolution(imager), size)
    # The first ring with harmonics.
    oriented = len(rings) - optics.harmonics.shape[1] - optics.wide_harmonics.shape[1]
    dtype, nodes = volume.dtype, optics.stray_light.grid
    voxels_per_pixel = 2 * sensor.pixel_pitch / (grid.pitch * nodes.pixel / nodes.step)
    outer_grid, outer_volume = wider_voxels(grid, volume, max(int(voxels_per_pixel + _ROUNDING), 1))

    def sharp(plane, number):
        """The light of a ring's cores before they are spread, and if they are oriented, that of each harmonic."""
        depth, fine_voxels, wide_voxels, distortion, light = plane
        fine, coarse = (wide, grid, fine_voxels), (wide_half, outer_grid, wide_voxels)
        imager, grid_here, voxels = fine if number < inner else coarse
        at, weight = grid_here.at(depth), RingLight(*rings[number])
        rays = trace(
            imager,
            at,
            nearest=False,
            dtype=dtype,
            distortion=distortion[number][None],
            limit=weight.limit,
            parameters=light[number][None],
        )
        image = partial(volume_to_image, Shapes(imager.sensor.shape, at.volume_shape, weight), rays)
        if number < oriented:
            return [image(voxels[None])]
        return _by_powers_of_field(image, voxels, imager, at, distortion[number], rings[number][1])

    def add_rings(total, plane, numbers, kernels, harmonics, *, whole):
        """Add the light of some of the rings, convolved with their kernels."""
        plain = [number for number in numbers if number < oriented]
        if plain:
            images = [sharp(plane, number)[0] for number in plain]
            total = total + sum_of_convolutions(images, kernels[: len(plain)], whole=whole, symmetric=True)
        for number, kernel, waves in zip(numbers[len(plain) :], kernels[len(plain) :], harmonics, strict=True):
            # Ring by ring, so that few images are held at once.
            images = sharp(plane, number)
            total = total + sum_of_convolutions(images, jnp.concatenate([kernel[None], waves]), whole=whole)
        return total

    # Not kept for the gradient: the sharp images of all depths are larger than the volume.
    @jax.checkpoint
    def add_depth(images, plane):
        fine, coarse = images
        *at, kernels, wide_kernels, harmonics, wide_harmonics = plane
        fine = add_rings(fine, at, range(inner), kernels, harmonics, whole=False)
        coarse = add_rings(coarse, at, range(inner, len(rings)), wide_kernels, wide_harmonics, whole=True)
        return (fine, coarse), None

    tables = optics.kernels, optics.wide_kernels, optics.harmonics, optics.wide_harmonics
    kernels = (part.astype(dtype) for part in tables)
    planes = grid.depths, volume, outer_volume, optics.distortion, optics.light, *kernels
    whole = [n + size - 1 for n in wide_half.sensor.shape]
    dark = jnp.zeros(sensor.shape, dtype), jnp.zeros(whole, dtype)
    fine, coarse = lax.scan(add_depth, dark, planes)[0]
    return fine + upsample_by_two(coarse, size, sensor.shape)


def _by_powers_of_field(image, voxels, imager, at, distortion, unit):
    """The image of voxels, and those of their light times `x`, `y`, `x^2 - y^2` and `2 x y`.

    Here `(x, y)` is the field: the voxel's place from the axis of the lens that sees it, in a unit, mm. A lens that
    images the voxel at X to u has it at the field (X - u) / (1 + M), less the offset of a tilted axis. So voxels are
    weighted by powers of X, and pixels by those of u, along the same rays.
    """
    sensor, scale = imager.sensor, unit * (1 + distortion * imager.magnification(at.depths)[0])
    pixels = Grid(at.depths, sensor.shape, sensor.pixel_pitch, sensor.origin)
    # The lens's axis and its image, of the lens in the middle.
    offset = imager.axis_offset(at.depths)[0] - imager.image_of_axis
    voxel = at.x[None] / scale, at.y[:, None] / scale
    pixel = (pixels.x[None] + offset[0]) / scale, (pixels.y[:, None] + offset[1]) / scale
    (X, Y), (u, v) = ([each.astype(voxels.dtype) for each in pair] for pair in (voxel, pixel))
    by = lambda weight: image((voxels * weight)[None])
    plain, by_x, by_y = image(voxels[None]), by(X), by(Y)
    second = by(X**2 - Y**2) - 2 * (u * by_x - v * by_y) + (u**2 - v**2) * plain
    mixed = by(2 * X * Y) - 2 * (u * by_y + v * by_x) + 2 * u * v * plain
    return [plain, by_x - u * plain, by_y - v * plain, second, mixed]


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
