"""The field-varying forward model: the spots' cores on the sensor's pixels, and the stray light on coarse pixels."""

import math
import operator
from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..linear.fourier import upsample_by_two
from ..microscope.geometry import Imager, field_limit
from ..microscope.grid import Grid, Sensor
from ..optics.field_varying import FieldVaryingPsf
from ..optics.psf_core import ring_edges
from .bilinear import Shapes, volume_to_image
from .convolution import sum_of_convolutions, with_margin
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


class _Rings(NamedTuple):
    """Rings of the field, on a leading axis: where they are, mm, and their cores; see `FieldVaryingPsf`."""

    inner: Float[Array, " ring"]
    outer: Float[Array, " ring"]
    distortion: Float[Array, " ring"]
    light: Float[Array, "ring coefficient"]


class _Plane(NamedTuple):
    """Voxels of one depth, seen with pixels and their margins; `limit`: radius of the largest ring, mm."""

    imager: Imager
    grid: Grid
    voxels: Float[Array, "y x"]
    limit: float


def _cores_image(volume, imager, grid, optics):
    """The inner rings on the sensor's pixels, the others, whose cores are wider, on pixels twice as large.

    The light of the others comes from voxels as wide as these pixels, if that is several of the volume's.
    """
    sensor, edges = imager.sensor, np.array(ring_edges(imager, optics.rings))
    (_, inner, reach, _), size = optics.kernels.shape, optics.wide_kernels.shape[-1]
    wide, wide_half = with_margin(imager, reach), with_margin(_half_resolution(imager), size)
    dtype, nodes = volume.dtype, optics.stray_light.grid
    voxels_per_pixel = 2 * sensor.pixel_pitch / (grid.pitch * nodes.pixel / nodes.step)
    outer_grid, outer_volume = wider_voxels(grid, volume, max(int(voxels_per_pixel + _ROUNDING), 1))
    # The rays of all rings of a resolution are those of the largest, so that one program serves them all.
    limits = [float(field_limit(edges[number - 1, 1])) for number in (inner, len(edges))]

    # Not kept for the gradient: the sharp images of all depths are larger than the volume.
    @jax.checkpoint
    def add_depth(images, plane):
        fine, coarse = images
        depth, fine_voxels, coarse_voxels, distortion, light, kernels, wide_kernels, harmonics, wide_harmonics = plane
        inner_edge, outer_edge = jnp.asarray(edges, dtype).T
        rings = _Rings(inner_edge, outer_edge, distortion, light)
        near, far = (jax.tree.map(lambda part, at=at: part[at], rings) for at in (slice(inner), slice(inner, None)))
        here = _Plane(wide, grid.at(depth), fine_voxels, limits[0])
        there = _Plane(wide_half, outer_grid.at(depth), coarse_voxels, limits[1])
        fine = _add_rings(fine, here, near, kernels, harmonics, whole=False)
        coarse = _add_rings(coarse, there, far, wide_kernels, wide_harmonics, whole=True)
        return (fine, coarse), None

    tables = optics.kernels, optics.wide_kernels, optics.harmonics, optics.wide_harmonics
    kernels = (part.astype(dtype) for part in tables)
    planes = grid.depths, volume, outer_volume, optics.distortion, optics.light, *kernels
    whole = [n + size - 1 for n in wide_half.sensor.shape]
    dark = jnp.zeros(sensor.shape, dtype), jnp.zeros(whole, dtype)
    fine, coarse = lax.scan(add_depth, dark, planes)[0]
    return fine + upsample_by_two(coarse, size, sensor.shape)


def _add_rings(total, plane: _Plane, rings: _Rings, kernels, harmonics, *, whole: bool):
    """Add the light of rings, convolved with their kernels; the last of them are oriented."""
    plain = len(kernels) - len(harmonics)
    first, last = (jax.tree.map(lambda part, at=at: part[at], rings) for at in (slice(plain), slice(plain, None)))
    if plain:
        images = lax.map(lambda ring: _sharp_image(plane, ring)(plane.voxels), first)
        total = total + sum_of_convolutions(list(images), kernels[:plain], whole=whole, symmetric=True)

    def add_oriented(total, ring):
        # Ring by ring, so that few images are held at once.
        ring, kernel, waves = ring
        images = _by_powers_of_field(_sharp_image(plane, ring), plane, ring)
        return total + sum_of_convolutions(images, jnp.concatenate([kernel[None], waves]), whole=whole), None

    if len(harmonics):
        total = lax.scan(add_oriented, total, (last, kernels[plain:], harmonics))[0]
    return total


def _sharp_image(plane: _Plane, ring: _Rings) -> Callable[[Float[Array, "y x"]], Float[Array, "row column"]]:
    """The image of a plane of voxels in one ring's cores before they are spread."""
    dtype, shapes = plane.voxels.dtype, Shapes(plane.imager.sensor.shape, (1, *plane.grid.shape))
    of_ring = {"distortion": ring.distortion[None], "parameters": ring.light[None]}
    weight = RingLight(ring.inner, ring.outer)
    rays = trace(plane.imager, plane.grid, nearest=False, dtype=dtype, weight=weight, limit=plane.limit, **of_ring)
    return lambda voxels: volume_to_image(shapes, rays, voxels[None])


def _by_powers_of_field(image, plane: _Plane, ring: _Rings):
    """The image of voxels, and those of their light times `x`, `y`, `x^2 - y^2` and `2 x y`.

    Here `(x, y)` is the field: the voxel's place from the axis of the lens that sees it, over the ring's outer radius.
    A lens that images the voxel at X to u has it at the field (X - u) / (1 + M), less the offset of a tilted axis. So
    voxels are weighted by powers of X, and pixels by those of u, along the same rays.
    """
    imager, grid, sensor = plane.imager, plane.grid, plane.imager.sensor
    dtype, depths = plane.voxels.dtype, grid.depths
    scale = ring.outer.astype(depths.dtype) * (
        1 + ring.distortion.astype(depths.dtype) * imager.magnification(depths)[0]
    )
    pixels = Grid(depths, sensor.shape, sensor.pixel_pitch, jnp.asarray(sensor.origin, depths.dtype))
    # The lens's axis and its image, of the lens in the middle.
    offset = imager.axis_offset(depths)[0] - imager.image_of_axis
    voxel = grid.x[None] / scale, grid.y[:, None] / scale
    pixel = (pixels.x[None] + offset[0]) / scale, (pixels.y[:, None] + offset[1]) / scale
    (X, Y), (u, v) = ([part.astype(dtype) for part in pair] for pair in (voxel, pixel))
    powers = jnp.stack([jnp.broadcast_to(power, grid.shape) for power in (X**0, X, Y, X**2 - Y**2, 2 * X * Y)])
    plain, by_x, by_y, by_squares, by_product = lax.map(image, powers * plane.voxels[None])
    second = by_squares - 2 * (u * by_x - v * by_y) + (u**2 - v**2) * plain
    mixed = by_product - 2 * (u * by_y + v * by_x) + 2 * u * v * plain
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
