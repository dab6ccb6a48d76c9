"""The image of a volume with all of its light: the spots' cores at full resolution, and their halo on coarse pixels."""

import math
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..geometry import Imager, Sensor
from ..grid import Grid
from ..optics.apertures import clear_area
from ..optics.field_varying import FieldVaryingPsf, StrayLight
from ..optics.psf_core import ring_edges
from .bilinear import Shapes, volume_to_image
from .convolution import convolved, doubled, image_in_groups, with_margin
from .linear_map import linear_call
from .polar import apply, splat_table, spread_table
from .rays import RingLight, trace

# Lenses whose halos are computed at once, which bounds the memory.
_LENSES = 64
# Depths whose cores are convolved at once.
_TOGETHER = 1
# The halo passes several linear interpolations, which blur it by about this variance, in squared pixels. Wiener's
# filter undoes that, as far as the blur leaves more than this share of a frequency's power.
_BLUR, _NOISE = 0.7, 0.02
# Pixels of the halo around the sensor, for that filter and for the interpolation.
_MARGIN = 12


def full_image(
    volume: Float[Array, "depth y x"], imager: Imager, grid: Grid, optics: FieldVaryingPsf
) -> Float[Array, "row column"]:
    """`gs_jax.forward` with `FieldVaryingPsf`."""
    nodes = _on_nodes(volume, grid, optics.stray_light.grid)
    return _cores_image(volume, imager, grid, optics) + halo_image(nodes, imager, optics.stray_light, grid.origin)


def halved(imager: Imager) -> Imager:
    """The imager with pixels twice as large: the first covers the first two each way, the last of an odd number one."""
    sensor = imager.sensor
    # A pixel too many moves the middle.
    columns, rows = (n % 2 * sensor.pixel_pitch / 2 for n in sensor.shape[::-1])
    middle = sensor.origin[0] + columns, sensor.origin[1] + rows
    large = Sensor([-(-n // 2) for n in sensor.shape], 2 * sensor.pixel_pitch, middle)
    return eqx.tree_at(lambda i: i.sensor, imager, large)


def _cores_image(volume, imager, grid, optics):
    """The inner ring on the sensor's pixels, the others on pixels twice as large: their cores are wider."""
    sensor, rings = imager.sensor, ring_edges(imager, optics.rings)
    small = optics.wide_kernels.shape[-1]
    wide, wide_halved = with_margin(imager, optics.kernel.shape[-1]), with_margin(halved(imager), small)
    dtype = volume.dtype

    def sharp(imager, plane, number):
        depth, voxels, distortion, light, _, _ = plane
        # Chief rays of this apparent depth land where the cores of the true one do.
        magnification = imager.magnification(depth) * distortion[number]
        at = grid.at(imager.reduced_sensor_distance / magnification - imager.reduced_depth(0.0))
        if imager.tilt is not None:
            # Cores are drawn to the axis of the lens, which leans.
            drawn = (1 / distortion[number] - 1) * imager.axis_offset(depth[None])[0]
            at = eqx.tree_at(lambda g: g.origin, at, at.origin + drawn)
        weight = RingLight(*rings[number])
        rays = trace(imager, at, nearest=False, dtype=dtype, limit=weight.limit, parameters=light[number][None])
        return volume_to_image(Shapes(imager.sensor.shape, at.volume_shape, weight), rays, voxels[None])

    # Not kept for the gradient: sharp images for each depth are more than the volume.
    @jax.checkpoint
    def add_depths(images, planes):
        fine, coarse = images
        each = [jax.tree.map(lambda a, n=n: a[n], planes) for n in range(len(planes[0]))]
        *_, kernels, wide_kernels = planes
        fine = fine + convolved([sharp(wide, plane, 0) for plane in each], kernels, symmetric=True)
        outer = [sharp(wide_halved, plane, number) for plane in each for number in range(1, len(rings))]
        wide_kernels = wide_kernels.reshape(-1, small, small)
        return fine, coarse + convolved(outer, wide_kernels, whole=True, symmetric=True)

    kernels = (part.astype(dtype) for part in (optics.kernel, optics.wide_kernels))
    planes = grid.depths, volume, optics.distortion, optics.light, *kernels
    whole = [n + small - 1 for n in wide_halved.sensor.shape]
    dark = jnp.zeros(sensor.shape, dtype), jnp.zeros(whole, dtype)
    fine, coarse = image_in_groups(add_depths, dark, planes, _TOGETHER)
    return fine + doubled(coarse, small, sensor.shape)


def halo_image(
    nodes: Float[Array, "depth y x"], imager: Imager, optics: StrayLight, origin: Float[Array, "2"]
) -> Float[Array, "row column"]:
    """The halo of a volume whose light is given on coarse nodes, an odd number each way, about an origin, mm."""
    dtype = nodes.dtype
    halo, v = optics.grid, (imager.reduced_sensor_distance / optics.sensor_distance).astype(dtype)
    # The spots' pattern grows with the sensor's distance, and the pixels of the halo with it.
    pixel = halo.pixel * v
    splat, spread = splat_table(halo), spread_table(halo)
    inner, outer = splat.patch, spread.patch
    coarse = [math.ceil(n * imager.sensor.pixel_pitch / halo.pixel) + 2 * _MARGIN for n in imager.sensor.shape]
    nodes = jnp.pad(nodes, [(0, 0), (inner + 1, inner + 1), (inner + 1, inner + 1)])
    table = optics.table.astype(dtype)

    def add_lenses(image, lenses):
        centers, excess = lenses

        def add_depth(spots, plane):
            nodes, table = plane
            start, fraction = _place(centers, origin.astype(dtype), halo.step, nodes.shape, inner)
            objects = _windows(nodes, start, fraction, inner)
            polar = apply(splat, objects.reshape(len(centers), -1).T)
            spectrum = jnp.fft.rfft(polar.reshape(halo.fields, halo.angles, -1), axis=1)
            turned = lax.complex(*(_mixed(table, part, excess) for part in (spectrum.real, spectrum.imag)))
            return spots + turned, None

        empty = jnp.zeros((halo.radii, halo.angles // 2 + 1, len(centers)), dtype)
        spots = lax.scan(jax.checkpoint(add_depth), lax.complex(empty, empty), (nodes, table))[0]
        # The image lies opposite to the object: half a turn.
        half_turn = (jnp.arange(halo.angles // 2 + 1) % 2 == 1)[None, :, None]
        polar = jnp.fft.irfft(jnp.where(half_turn, -spots, spots), halo.angles, axis=1).reshape(-1, len(centers))
        spots = apply(spread, polar).T.reshape(-1, outer, outer)
        start, fraction = _place(centers, jnp.asarray(imager.sensor.origin, dtype), pixel, image.shape, outer)
        return _add_windows(image, spots, start, fraction), None

    # Outer pixels for spots that lie partly beyond; lenses that are farther off do not count.
    image = jnp.zeros([n + 2 * outer + 2 for n in coarse], dtype)
    image = lax.scan(jax.checkpoint(add_lenses), image, _in_groups(imager, optics, dtype))[0]
    image = image[outer + 1 : -outer - 1, outer + 1 : -outer - 1]
    rows, columns = (
        _finer(fine, rough, imager.sensor.pixel_pitch / pixel, dtype)
        for fine, rough in zip(imager.sensor.shape, coarse, strict=True)
    )
    return (rows @ image @ columns.T) * (imager.sensor.pixel_pitch / pixel) ** 2


def _mixed(table, spectrum, excess):
    """Harmonics `(field, harmonic, lens)` of the object to those of the image `(radius, harmonic, lens)`."""
    product = lambda table, part: jnp.einsum("mrf,fml->rml", table, part)
    return product(table[0], spectrum) + product(table[1], spectrum * excess[None, None])


def _in_groups(imager, optics, dtype):
    """Centres and excess areas of the lenses, `_LENSES` at a time; the last are filled up with lenses far away."""
    centers, excess = imager.centers.astype(dtype), clear_area(imager.array).astype(dtype) - optics.area.astype(dtype)
    count = len(excess)
    groups = -(-count // _LENSES)
    size = -(-count // groups)
    missing = groups * size - count
    centers = jnp.pad(centers, [(0, missing), (0, 0)], constant_values=1e6)
    return centers.reshape(groups, size, 2), jnp.pad(excess, (0, missing)).reshape(groups, size)


def _on_nodes(volume, grid, halo):
    """The volume's light on the halo's coarse nodes, which are centred as the grid is: linear shares."""

    def shares(voxels):
        count = math.ceil(voxels * grid.pitch / halo.step / 2) * 2 + 1
        place = (np.arange(voxels) - (voxels - 1) / 2) * grid.pitch / halo.step + (count - 1) / 2
        return jnp.asarray(np.maximum(1 - np.abs(np.arange(count)[:, None] - place), 0), volume.dtype)

    rows, columns = map(shares, grid.shape)
    return jnp.einsum("ay,dyx,bx->dab", rows, volume, columns)


def _place(centers, origin, step, shape, window):
    """First `(row, column)` of the window about each lens on nodes with this step, and the fractions that are left."""
    middle = (jnp.asarray(shape, centers.dtype) - 1) / 2
    place = ((centers - origin[None]) / step)[:, ::-1] + middle[None]
    whole = jnp.floor(lax.stop_gradient(place))
    return whole.astype(jnp.int32) - window // 2, place - whole


def _windows(nodes, start, fraction, size):
    """Square windows of the nodes, whose middles are the lenses: `(lens, size, size)`; zero where they end."""
    taken = linear_call(_taken, _put, None, (nodes.shape, (size + 1, size + 1)), start, nodes)
    down, right = fraction[:, 0, None, None], fraction[:, 1, None, None]
    taken = (1 - down) * taken[:, :-1] + down * taken[:, 1:]
    return (1 - right) * taken[..., :-1] + right * taken[..., 1:]


def _add_windows(image, spots, start, fraction):
    """The adjoint of `_windows`, added to an image."""
    down, right = fraction[:, 0, None, None], fraction[:, 1, None, None]
    spots = jnp.pad((1 - down) * spots, [(0, 0), (0, 1), (0, 0)]) + jnp.pad(down * spots, [(0, 0), (1, 0), (0, 0)])
    spots = jnp.pad((1 - right) * spots, [(0, 0), (0, 0), (0, 1)]) + jnp.pad(right * spots, [(0, 0), (0, 0), (1, 0)])
    return image + linear_call(_put, _taken, None, (image.shape, spots.shape[1:]), start, spots)


def _taken(shapes, start, image):
    """Windows of an image, `shapes` being of both; zero if they are not within it."""
    dimensions = lax.GatherDimensionNumbers(offset_dims=(1, 2), collapsed_slice_dims=(), start_index_map=(0, 1))
    return lax.gather(image, start, dimensions, shapes[1], mode="fill", fill_value=0)


def _put(shapes, start, windows):
    """The transpose of `_taken`, window by window: for GPUs JAX before 0.11.1 compiles a scatter-add to slow loops.

    On a processor it takes 0.8 to 2.5 of the time of one, a hundredth of a halo's; a gather, by which each pixel looks
    into every window, takes 2 to 15.
    """
    shape, size = shapes
    within = ((start >= 0) & (start <= jnp.asarray(np.subtract(shape, size), start.dtype)[None])).all(1)
    windows = jnp.where(within[:, None, None], windows, 0)

    def add(image, one):
        at, window = one
        return lax.dynamic_update_slice(image, lax.dynamic_slice(image, at, size) + window, at), None

    return lax.scan(add, jnp.zeros(shape, windows.dtype), (start, windows))[0]


def _finer(fine: int, coarse: int, ratio, dtype) -> Float[Array, "fine coarse"]:
    """Along one axis, from the halo's pixels, sharpened, to the sensor's: Keys' cubic interpolation."""
    place = (jnp.arange(fine, dtype=dtype) - (fine - 1) / 2) * ratio + (coarse - 1) / 2
    x = jnp.abs(place[:, None] - jnp.arange(coarse, dtype=dtype)[None])
    near, far = (1.5 * x - 2.5) * x**2 + 1, ((-0.5 * x + 2.5) * x - 4) * x + 2
    cubic = jnp.where(x <= 1, near, jnp.where(x < 2, far, 0))
    return cubic @ jnp.asarray(_sharpening(coarse), dtype)


@cache
def _sharpening(count: int) -> Float[np.ndarray, "pixel pixel"]:
    """Wiener's filter against a Gaussian blur, as a matrix."""
    blur = np.exp(-2 * np.pi**2 * _BLUR * np.fft.fftfreq(2 * count) ** 2)
    kernel = np.fft.ifft(blur * (1 + _NOISE) / (blur**2 + _NOISE)).real
    return kernel[np.arange(count)[:, None] - np.arange(count)]
