"""The image of the stray light on coarse pixels.

It is computed in polar coordinates about each lens, where a spot that turns with the field is a product of angular
harmonics. Sparse tables resample between square nodes (or pixels) and polar ones.
"""

import math
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..base.arrays import array_namespace
from ..linear.linear_map import LinearMap
from ..linear.sparse_table import times_entries
from ..microscope.geometry import Imager
from ..optics.apertures import clear_area
from ..optics.field_varying import StrayLight
from .cpu.loading import kernels
from .cuda import SCATTERS

# Lenses whose stray light is computed at once: few stay in a CPU's cache, many keep an accelerator busy.
_LENSES, _LENSES_ON_CPU = 112, 32
# Kernels take sixteen lenses at once, and read so many pixels beyond a window.
_SPARE = 16
# Linear interpolations blur the stray light by about this variance, in squared pixels. A Wiener filter undoes that
# where the blur leaves more than this share of a frequency's power.
_BLUR, _NOISE = 0.7, 0.02
# Coarse pixels around the sensor, for that filter and for the interpolation.
_MARGIN = 12
# Rows of pixels that are interpolated at once, and by how much pixels may be larger than those of the tables.
_BLOCK, _STRETCH = 256, 1.1


def stray_light_image(
    nodes: Float[Array, "depth y x"],
    imager: Imager,
    optics: StrayLight,
    depths: Float[Array, " depth"],
    origin: Float[Array, "2"],
) -> Float[Array, "row column"]:
    """The stray light of a volume whose light is given on coarse nodes, an odd number each way, about an origin, mm.

    It turns with a tilted array: it is symmetric about the axes of the lenses and about their images.
    """
    dtype = nodes.dtype
    distance = imager.reduced_sensor_distance + imager.heights.mean()
    polar_grid, v = optics.grid, (distance / optics.sensor_distance).astype(dtype)
    # The spots' pattern grows with the sensor's distance, and the coarse pixels with it.
    pixel = polar_grid.pixel * v
    inner, outer = optics.to_polar.side, optics.to_pixels.side
    coarse = [math.ceil(n * imager.sensor.pixel_pitch / polar_grid.pixel) + 2 * _MARGIN for n in imager.sensor.shape]
    nodes = jnp.pad(nodes, [(0, 0), *[(inner + 1, inner + 1 + _SPARE)] * 2])
    axes, image_of_axis = imager.axis_offset(depths).astype(dtype), imager.image_of_axis.astype(dtype)
    # One matrix for both orders.
    table = optics.table.astype(dtype)
    table = table.reshape(*table.shape[:3], -1, table.shape[-1])

    def add_lenses(image, lenses):
        centers, excess = lenses

        def add_depth(spectra, plane):
            depth, nodes, axis = plane
            places = _window_places(centers + axis[None], origin.astype(dtype), polar_grid.step, nodes.shape, inner)
            objects = interpolate_windows(Windows(nodes.shape, inner), places, nodes).reshape(-1, len(centers))
            fields = angular_spectra(polar_grid.angles, optics.to_polar, objects)
            return add_products((), (table, depth, excess), (spectra, fields)), None

        dark = jnp.zeros((2 * table.shape[1], polar_grid.radii, len(centers)), dtype)
        planes = jnp.arange(len(table), dtype=jnp.int32), nodes, axes
        spectra = lax.scan(jax.checkpoint(add_depth), dark, planes)[0]
        spots = angular_spectra.T(polar_grid.angles, optics.to_pixels.T, spectra).reshape(outer, outer, -1)
        middle = jnp.asarray(imager.sensor.origin, dtype)
        places = _window_places(centers + image_of_axis[None], middle, pixel, image.shape, outer)
        return image + interpolate_windows.T(Windows(image.shape, outer), places, spots), None

    # Outer pixels for spots that lie partly beyond; lenses that are farther off do not count.
    image = jnp.zeros([n + 2 * outer + 2 + _SPARE for n in coarse], dtype)
    image = lax.scan(jax.checkpoint(add_lenses), image, _lens_groups(imager, optics, dtype))[0]
    image = lax.dynamic_slice(image, (outer + 1, outer + 1), coarse)
    upsample = partial(
        _upsample_rows, (imager.sensor.pixel_pitch / pixel, imager.sensor.pixel_pitch / polar_grid.pixel)
    )
    rows, columns = (jnp.asarray(_wiener_matrix(count), dtype) for count in coarse)
    # Columns first, where there are few rows.
    across = upsample(imager.sensor.shape[1], (rows @ image @ columns).T)
    return upsample(imager.sensor.shape[0], across.T) * (imager.sensor.pixel_pitch / pixel) ** 2


def _lens_groups(imager, optics, dtype):
    """Centres and excess areas of groups of lenses, which are filled up with lenses far away.

    They are in the order of their rows: kernels read windows that are near each other at once.
    """
    centers, excess = imager.centers.astype(dtype), clear_area(imager.array).astype(dtype) - optics.area.astype(dtype)
    order, count = jnp.argsort(centers[:, 1]), len(excess)
    groups = -(-count // (_LENSES_ON_CPU if jax.default_backend() == "cpu" else _LENSES))
    size = -(-count // (groups * _SPARE)) * _SPARE
    missing = groups * size - count
    centers = jnp.pad(centers[order], [(0, missing), (0, 0)], constant_values=1e6)
    return centers.reshape(groups, size, 2), jnp.pad(excess[order], (0, missing)).reshape(groups, size)


def to_nodes(volume, grid, polar_grid):
    """The volume's light, shared linearly by coarse nodes, which are centred as the grid is."""

    def shares(voxels):
        count = math.ceil(voxels * grid.pitch / polar_grid.step / 2) * 2 + 1
        place = (np.arange(voxels) - (voxels - 1) / 2) * grid.pitch / polar_grid.step + (count - 1) / 2
        return jnp.asarray(np.maximum(1 - np.abs(np.arange(count)[:, None] - place), 0), volume.dtype)

    rows, columns = map(shares, grid.shape)
    return jnp.einsum("ay,dyx,bx->dab", rows, volume, columns)


class Windows(NamedTuple):
    """Shape of an image, with `_SPARE` lines at its end, and side of the windows about lenses."""

    shape: tuple[int, int]
    side: int


def _window_places(centers, origin, step, shape, side):
    """First `(row, column)` of the window about each lens on nodes with this step, and the fraction of a node."""
    middle = (jnp.asarray(shape, centers.dtype) - _SPARE - 1) / 2
    place = ((centers - origin[None]) / step)[:, ::-1] + middle[None]
    whole = jnp.floor(lax.stop_gradient(place))
    return whole.astype(jnp.int32) - side // 2, place - whole


def _window_values(windows, places, image):
    """Windows `(row, column, lens)` of an image, centred on the lenses; zero if they are not within it."""
    start, fraction = places
    dimensions = lax.GatherDimensionNumbers(offset_dims=(1, 2), collapsed_slice_dims=(), start_index_map=(0, 1))
    image = image[: windows.shape[0] - _SPARE, : windows.shape[1] - _SPARE]
    size = windows.side + 1
    return _between_lines(fraction, lax.gather(image, start, dimensions, (size, size), mode="fill", fill_value=0))


def _between_lines(fraction, read):
    """Interpolate windows `(lens, row, column)`, which have one more line each way."""
    down, right = fraction[:, 0, None, None], fraction[:, 1, None, None]
    read = (1 - down) * read[:, :-1] + down * read[:, 1:]
    return jnp.moveaxis((1 - right) * read[..., :-1] + right * read[..., 1:], 0, -1)


def _add_windows(windows, places, spots):
    """The adjoint of `_window_values`, a scatter-add."""
    image = jax.ShapeDtypeStruct(windows.shape, spots.dtype)
    return jax.linear_transpose(partial(_window_values, windows, places), image)(spots)[0]


def _sum_windows(windows, places, spots):
    """`_add_windows` for accelerators whose scatter-add is slow: each pixel looks into every window, in one sum.

    On a CPU this takes 2 to 15 times as long as a scatter-add.
    """
    (start, fraction), size = places, windows.side + 1
    read = jax.ShapeDtypeStruct((len(start), size, size), spots.dtype)
    values = jax.linear_transpose(partial(_between_lines, fraction), read)(spots)[0]

    def lines(axis):
        """Each line of the image within each window, and whether it is in it, and that in the image."""
        line = jnp.arange(windows.shape[axis] - _SPARE, dtype=start.dtype)[None] - start[:, axis, None]
        whole = (line[:, :1] <= 0) & (line[:, -1:] >= size - 1)
        return jnp.clip(line, 0, size - 1), whole & (line >= 0) & (line < size)

    (row, in_rows), (column, in_columns) = lines(0), lines(1)
    window = jnp.arange(len(start), dtype=start.dtype)[:, None] * size
    place = ((window + row) * size)[:, :, None] + column[:, None, :]
    found = values.ravel().at[place].get(mode="promise_in_bounds", wrap_negative_indices=False)
    image = jnp.where(in_rows[:, :, None] & in_columns[:, None, :], found, 0).sum(0)
    return jnp.pad(image, [(0, _SPARE)] * 2)


interpolate_windows = LinearMap(
    _window_values,
    _add_windows,
    kernels=kernels("read_windows", "add_windows"),
    accelerated=(None, _sum_windows),
    cuda=(None, _add_windows if SCATTERS else None),
)


def _upsample_rows(ratio, fine: int, image: Float[Array, "coarse column"]) -> Float[Array, "fine column"]:
    """Coarse rows to the sensor's by Keys' cubic interpolation, in blocks, each of which needs a few of them.

    `ratio` is the sensor's pixel over the coarse one, and about the same as a Python number.
    """
    (ratio, about), coarse = ratio, len(image)
    lines = min(_BLOCK, fine)
    index = np.arange(-(-fine // lines) * lines).reshape(-1, lines) - (fine - 1) / 2
    place = jnp.asarray(index, image.dtype) * ratio + (coarse - 1) / 2
    size = min(math.ceil(_STRETCH * lines * about) + 6, coarse)
    first = jnp.clip(jnp.floor(lax.stop_gradient(place[:, 0])).astype(jnp.int32) - 2, 0, coarse - size)
    parts = jax.vmap(lambda start: lax.dynamic_slice_in_dim(image, start, size))(first)
    row = (first[:, None] + jnp.arange(size, dtype=jnp.int32)[None]).astype(image.dtype)
    weights = cubic(jnp.abs(place[:, :, None] - row[:, None, :]))
    return (weights @ parts).reshape(-1, image.shape[1])[:fine]


def cubic(distance):
    """Weight of Keys' cubic interpolation at an absolute distance, in steps."""
    xp, x = array_namespace(distance), distance
    near, far = (1.5 * x - 2.5) * x**2 + 1, ((-0.5 * x + 2.5) * x - 4) * x + 2
    return xp.where(x <= 1, near, xp.where(x < 2, far, 0))


@lru_cache(maxsize=4)
def _wiener_matrix(count: int) -> Float[np.ndarray, "pixel pixel"]:
    blur = np.exp(-2 * np.pi**2 * _BLUR * np.fft.fftfreq(2 * count) ** 2)
    kernel = np.fft.ifft(blur * (1 + _NOISE) / (blur**2 + _NOISE)).real
    return kernel[np.arange(count)[:, None] - np.arange(count)]


def _to_spectra(angles, table, x):
    polar = times_entries(table.rows, x)
    return _transform(polar.reshape(angles, -1, x.shape[1]))


def _from_spectra(angles, table, y):
    polar = jax.linear_transpose(_transform, jax.ShapeDtypeStruct((angles, *y.shape[1:]), y.dtype))(y)[0]
    return times_entries(table.columns, polar.reshape(-1, y.shape[2]))


def _transform(polar):
    spectra = jnp.fft.rfft(polar, axis=0)
    return jnp.stack([spectra.real, spectra.imag], 1).reshape(-1, *polar.shape[1:])


# `(angles, table, x)`: spectra over the angle, `(2 harmonics, field, lens)`, of a sparse table's products; of each
# harmonic the real part before the imaginary one.
angular_spectra = LinearMap(_to_spectra, _from_spectra, kernels=kernels("to_spectra", "from_spectra"))


def _add_products(_, constants, parts):
    (table, depth, excess), (total, x) = constants, parts
    x = x.reshape(table.shape[1], 2, -1, x.shape[-1])
    products = jnp.einsum("hbfr,hcfl->hcbrl", table[depth], jnp.concatenate([x, excess[None, None, None] * x], 2))
    return total + products.reshape(total.shape)


def _products_back(_, constants, y):
    table, depth, excess = constants
    image = y.reshape(table.shape[1], 2, table.shape[2], table.shape[4], -1)
    x = jnp.einsum("hbfr,hcbrl->hcfl", table[depth], image)
    mean, change = jnp.split(x, 2, 2)
    return y, (mean + excess[None, None, None] * change).reshape(len(y), -1, y.shape[-1])


# `((), (table, depth, excess), (total, x))`: a sum, and each harmonic's product with its table at this depth.
add_products = LinearMap(_add_products, _products_back, kernels=kernels("add_products", "products_back"))
