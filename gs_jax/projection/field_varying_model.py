"""The field-varying forward model: the spots' cores on the sensor's pixels, and the stray light on coarse pixels."""

import math
import operator
from collections.abc import Callable
from functools import partial, reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..linear.fourier import upsample_by_two
from ..microscope.geometry import Imager, falloff, field_limit
from ..microscope.grid import Grid, Sensor
from ..optics.field_varying import FieldVaryingPsf
from ..optics.psf_core import ring_edges
from .bilinear import Shapes, volume_to_image
from .convolution import sum_of_convolutions, with_margin
from .rays import OUTSIDE, Rays, RingLight, trace
from .stray_light import cubic, stray_light_image, to_nodes

# Share of a voxel by which whole numbers of voxels may differ from a pixel.
_ROUNDING = 0.02
# Windows are used if all of them have fewer pixels than this share of the sensor's. So many are computed at once: their
# images stay in a CPU's cache, and lenses with none of a ring's light are left out.
_FEW, _WINDOWS = 0.6, 16


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
    dtype = volume.dtype
    outer_grid, outer_volume = wider_voxels(grid, volume, _wider_by(imager, grid, optics))
    # The rays of all rings of a resolution are those of the largest, so that one program serves them all.
    limits = [float(field_limit(edges[number - 1, 1])) for number in (inner, len(edges))]
    side, wide_side = optics.windows

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
        fine = _add_rings(fine, here, near, kernels, harmonics, whole=False, side=side)
        coarse = _add_rings(coarse, there, far, wide_kernels, wide_harmonics, whole=True, side=wide_side)
        return (fine, coarse), None

    tables = optics.kernels, optics.wide_kernels, optics.harmonics, optics.wide_harmonics
    kernels = (part.astype(dtype) for part in tables)
    planes = grid.depths, volume, outer_volume, optics.distortion, optics.light, *kernels
    whole = [n + size - 1 for n in wide_half.sensor.shape]
    # With room for windows that are partly beyond the edges.
    sizes = (sensor.shape, side), (whole, wide_side)
    dark = tuple(jnp.zeros([n + 2 * beyond for n in shape], dtype) for shape, beyond in sizes)
    images = lax.scan(add_depth, dark, planes)[0]
    fine, coarse = (
        image[beyond : beyond + shape[0], beyond : beyond + shape[1]]
        for image, (shape, beyond) in zip(images, sizes, strict=True)
    )
    return fine + upsample_by_two(coarse, size, sensor.shape)


def _add_rings(total, plane: _Plane, rings: _Rings, kernels, harmonics, *, whole: bool, side: int):
    """Add the light of rings, convolved with their kernels; the last of them are oriented."""
    plain = len(kernels) - len(harmonics)
    first, last = (jax.tree.map(lambda part, at=at: part[at], rings) for at in (slice(plain), slice(plain, None)))
    if side:
        size = kernels.shape[-1]
        shift = side + (size - 1) // 2 if whole else side - (size + 1) // 2
        add = partial(_add_windows, plane, side, shift)
        if plain:
            total = lax.scan(add, total, (first, kernels[:plain, None]))[0]
        if len(harmonics):
            total = lax.scan(add, total, (last, jnp.concatenate([kernels[plain:, None], harmonics], 1)))[0]
        return total
    if plain:
        images = lax.map(lambda ring: _sharp_image(plane, ring)(plane.voxels), first)
        total = total + sum_of_convolutions(list(images), kernels[:plain], whole=whole, symmetric=True)

    def add_oriented(total, ring):
        # Ring by ring, so that few images are held at once.
        ring, kernel, waves = ring
        pixels = [jnp.arange(n, dtype=jnp.int32) for n in plane.imager.sensor.shape]
        images = _by_powers_of_field(_sharp_image(plane, ring), plane, ring, pixels[0][:, None], pixels[1][None])
        return total + sum_of_convolutions(images, jnp.concatenate([kernel[None], waves]), whole=whole), None

    if len(harmonics):
        total = lax.scan(add_oriented, total, (last, kernels[plain:], harmonics))[0]
    return total


def _sharp_image(plane: _Plane, ring: _Rings) -> Callable[[Float[Array, "y x"]], Float[Array, "row column"]]:
    """The image of a plane of voxels in one ring's cores before they are spread."""
    shapes, rays = Shapes(plane.imager.sensor.shape, (1, *plane.grid.shape)), _ring_rays(plane, ring)
    return lambda voxels: volume_to_image(shapes, rays, voxels[None])


def _ring_rays(plane: _Plane, ring: _Rings) -> Rays:
    weight, (distortion, light) = RingLight(ring.inner, ring.outer), (ring.distortion[None], ring.light[None])
    options: Any = {"nearest": False, "dtype": plane.voxels.dtype, "limit": plane.limit}
    return trace(plane.imager, plane.grid, weight=weight, distortion=distortion, parameters=light, **options)


def _add_windows(plane: _Plane, side: int, shift: int, total, ring):
    """Add the light of a ring, which each lens shows in a window of the sensor, in squares of `side` pixels.

    A scene that is small beside the sensor lights few of its pixels. Windows are convolved each by itself, so that
    their cores must end within them, and those without light of this ring are left out. `shift` is the place on `total`
    of the sensor's first pixel. The first of the ring's kernels is that of all light, those of harmonics follow.
    """
    ring, kernels = ring
    rays, half = _ring_rays(plane, ring), kernels.shape[-1] // 2
    lowest, highest = ([f(axis.pixel, (1, 2)) for axis in (rays.y, rays.x)] for f in (jnp.min, jnp.max))
    spread = jnp.stack(highest) - jnp.stack(lowest) + 2 + 2 * half
    # Tables of another geometry, with smaller windows than its images need, must not pass for a dark scene.
    kernels = jnp.where((spread <= side).all(), kernels, jnp.nan)
    first = jnp.stack(lowest, -1) - half
    # With the middle in the corner.
    padded = jnp.pad(kernels, [(0, 0), *[(0, side - kernels.shape[-1])] * 2])
    spectra = jnp.fft.rfft2(jnp.roll(padded, (-half, -half), (1, 2)))
    # From the lenses near the scene outward: each ring is seen by some that follow each other.
    near, far = (f(rays.y.distance2, (1, 2)) + f(rays.x.distance2, (1, 2)) for f in (jnp.min, jnp.max))
    hole = jnp.where(ring.inner > 0, falloff(far, jnp.where(ring.inner > 0, ring.inner, 1)), 0)
    lit = (falloff(near, ring.outer) > 0) & (hole < 1)
    count, lenses = -(-len(near) // _WINDOWS) * _WINDOWS, len(near)
    order = jnp.pad(jnp.argsort(near), (0, count - lenses))
    exists = jnp.arange(count) < lenses
    shapes = Shapes((_WINDOWS * side, side), (1, *plane.grid.shape))

    def groups(leaf):
        return leaf[order].reshape(-1, _WINDOWS, *leaf.shape[1:])

    # Not kept for the gradient, as the images of all groups are larger than the sensor's.
    @jax.checkpoint
    def add_group(total, group):
        (y, x), spacing, first, lit, exists = group

        def fold(axis, first, below):
            moved = below - first
            pixel, origin = axis.pixel + moved[:, None, None], axis.origin + moved[:, None].astype(axis.origin.dtype)
            distance2 = jnp.where(exists[:, None, None], axis.distance2, OUTSIDE)
            return axis._replace(pixel=pixel, origin=origin, distance2=distance2)

        below = side * jnp.arange(_WINDOWS, dtype=first.dtype)
        folded = rays._replace(y=fold(y, first[:, 0], below), x=fold(x, first[:, 1], 0 * below), spacing=spacing)
        rows, columns = (first[:, axis, None] + jnp.arange(side, dtype=first.dtype)[None] for axis in (0, 1))

        def image(voxels):
            return volume_to_image(shapes, folded, voxels[None]).reshape(_WINDOWS, side, side)

        def windows():
            images = [image(plane.voxels)]
            if len(kernels) > 1:
                images = _by_powers_of_field(image, plane, ring, rows[:, :, None], columns[:, None, :])
            products = [jnp.fft.rfft2(part) * spectrum[None] for part, spectrum in zip(images, spectra, strict=True)]
            return jnp.fft.irfft2(reduce(operator.add, products), (side, side))

        def dark():
            return jnp.zeros((_WINDOWS, side, side), total.dtype)

        seen = lax.cond((lit & exists).any(), windows, dark)
        dimensions = lax.ScatterDimensionNumbers((1, 2), (), (0, 1))
        mode = lax.GatherScatterMode.CLIP
        return lax.scatter_add(total, first + shift, seen, dimensions, mode=mode), None

    parts = jax.tree.map(groups, ((rays.y, rays.x), rays.spacing, first, lit))
    return lax.scan(add_group, total, (*parts, exists.reshape(-1, _WINDOWS)))[0], None


def _by_powers_of_field(image, plane: _Plane, ring: _Rings, rows, columns):
    """The image of voxels, and those of their light times `x`, `y`, `x^2 - y^2` and `2 x y`.

    Here `(x, y)` is the field: the voxel's place from the axis of the lens that sees it, over the ring's outer radius.
    A lens that images the voxel at X to u has it at the field (X - u) / (1 + M), less the offset of a tilted axis. So
    voxels are weighted by powers of X, and pixels, numbered by `rows` and `columns`, by those of u, along the same
    rays.
    """
    imager, grid, sensor = plane.imager, plane.grid, plane.imager.sensor
    dtype, depths = plane.voxels.dtype, grid.depths
    scale = ring.outer.astype(depths.dtype) * (
        1 + ring.distortion.astype(depths.dtype) * imager.magnification(depths)[0]
    )
    pixels = Grid(depths, sensor.shape, sensor.pixel_pitch, jnp.asarray(sensor.origin, depths.dtype))
    # The lens's axis and its image, of the lens in the middle.
    offset = imager.axis_offset(depths)[0] - imager.image_of_axis
    x, y = (
        first + sensor.pixel_pitch * n.astype(depths.dtype)
        for first, n in ((pixels.x[0], columns), (pixels.y[0], rows))
    )
    voxel = grid.x[None] / scale, grid.y[:, None] / scale
    pixel = (x + offset[0]) / scale, (y + offset[1]) / scale
    (X, Y), (u, v) = ([part.astype(dtype) for part in pair] for pair in (voxel, pixel))
    powers = jnp.stack([jnp.broadcast_to(power, grid.shape) for power in (X**0, X, Y, X**2 - Y**2, 2 * X * Y)])
    plain, by_x, by_y, by_squares, by_product = lax.map(image, powers * plane.voxels[None])
    second = by_squares - 2 * (u * by_x - v * by_y) + (u**2 - v**2) * plain
    mixed = by_product - 2 * (u * by_y + v * by_x) + 2 * u * v * plain
    return [plain, by_x - u * plain, by_y - v * plain, second, mixed]


def window_sides(imager: Imager, grid: Grid, optics: FieldVaryingPsf) -> tuple[int, int]:
    """Sides of the windows in which each lens shows the whole grid, in pixels of the inner and of the outer rings.

    A side is 0 where the windows of all lenses are not much smaller than the sensor together.
    """
    spacing = float(imager.magnifications(grid.depths).max()) * float(np.max(optics.distortion)) * grid.pitch
    spacing /= imager.sensor.pixel_pitch
    factor = _wider_by(imager, grid, optics)
    counts = max(grid.shape), max(factor * _wide_count(n, factor) for n in grid.shape)
    sides: list[int] = []
    for count, kernels, larger in zip(counts, (optics.kernels, optics.wide_kernels), (1, 2), strict=True):
        # A pixel more on both sides, for rounding and for small changes of the geometry.
        needed = math.ceil(count * spacing / larger) + 2 + kernels.shape[-1]
        # A power of two, or three or nine times one: few sizes, of fast FFTs.
        side = min(n * 2 ** max(math.ceil(math.log2(needed / n)), 4) for n in (1, 3, 9))
        few = len(imager.array.centers) * side**2 < _FEW * math.prod(imager.sensor.shape) / larger**2
        sides.append(side if few else 0)
    return sides[0], sides[1]


def _wider_by(imager: Imager, grid: Grid, optics: FieldVaryingPsf) -> int:
    """Factor by which voxels of the outer rings are wider: their pixels are twice as large."""
    nodes = optics.stray_light.grid
    return max(int(2 * imager.sensor.pixel_pitch / (grid.pitch * nodes.pixel / nodes.step) + _ROUNDING), 1)


def _wide_count(size: int, factor: int) -> int:
    """Number of voxels that are wider by a factor, for the light of `size` voxels."""
    return size if factor == 1 else 2 * math.ceil(size / factor / 2) + 3


def wider_voxels(grid, volume, factor):
    """A grid of voxels that are wider by a whole factor, and the volume's light, shared by these."""
    if factor == 1:
        return grid, volume
    volume = _share_lines(_share_lines(volume, factor, 1), factor, 2)
    return Grid(grid.depths, volume.shape[1:], factor * grid.pitch, grid.origin), volume


def _share_lines(volume, factor, axis):
    """Share lines along an axis by Keys' cubic, which keeps a spot's width: linear shares would blur."""
    size = volume.shape[axis]
    count = _wide_count(size, factor)
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
