"""The image of the stray light on coarse pixels.

It is computed in polar coordinates about each lens, where a spot that turns with the field is a product of angular
harmonics. Sparse tables resample between square nodes (or pixels) and polar ones.
"""

import dataclasses
import math
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..geometry import Imager
from ..optics.apertures import clear_area
from ..optics.field_varying import PolarGrid, StrayLight, polar_weights
from .linear_map import LinearMap

# Lenses whose stray light is computed at once, which bounds the memory.
_LENSES = 64
# Linear interpolations blur the stray light by about this variance, in squared pixels. A Wiener filter undoes that
# where the blur leaves more than this share of a frequency's power.
_BLUR, _NOISE = 0.7, 0.02
# Coarse pixels around the sensor, for that filter and for the interpolation.
_MARGIN = 12
# Inner rings of polar nodes, which are closer to each other than pixels.
_INNER_RINGS = 4
# Rows of a table with at most so many entries are summed entry by entry, without a copy.
_FEW = 8


def stray_light_image(
    nodes: Float[Array, "depth y x"], imager: Imager, optics: StrayLight, origin: Float[Array, "2"]
) -> Float[Array, "row column"]:
    """The stray light of a volume whose light is given on coarse nodes, an odd number each way, about an origin, mm."""
    dtype = nodes.dtype
    polar_grid, v = optics.grid, (imager.reduced_sensor_distance / optics.sensor_distance).astype(dtype)
    # The spots' pattern grows with the sensor's distance, and the coarse pixels with it.
    pixel = polar_grid.pixel * v
    to_polar, to_pixels = _to_polar_table(polar_grid), _to_pixels_table(polar_grid)
    inner, outer = to_polar.patch, to_pixels.patch
    coarse = [math.ceil(n * imager.sensor.pixel_pitch / polar_grid.pixel) + 2 * _MARGIN for n in imager.sensor.shape]
    nodes = jnp.pad(nodes, [(0, 0), (inner + 1, inner + 1), (inner + 1, inner + 1)])
    table = optics.table.astype(dtype)

    def add_lenses(image, lenses):
        centers, excess = lenses

        def add_depth(spots, plane):
            nodes, table = plane
            start, fraction = _window_start(centers, origin.astype(dtype), polar_grid.step, nodes.shape, inner)
            objects = _interpolated_windows(nodes, start, fraction, inner)
            polar = _times_table(to_polar, (), objects.reshape(len(centers), -1).T)
            spectrum = jnp.fft.rfft(polar.reshape(polar_grid.fields, polar_grid.angles, -1), axis=1)
            images = lax.complex(*(_mix_harmonics(table, part, excess) for part in (spectrum.real, spectrum.imag)))
            return spots + images, None

        empty = jnp.zeros((polar_grid.radii, polar_grid.angles // 2 + 1, len(centers)), dtype)
        spots = lax.scan(jax.checkpoint(add_depth), lax.complex(empty, empty), (nodes, table))[0]
        # The image lies opposite to the object: half a turn.
        half_turn = (jnp.arange(polar_grid.angles // 2 + 1) % 2 == 1)[None, :, None]
        polar = jnp.fft.irfft(jnp.where(half_turn, -spots, spots), polar_grid.angles, axis=1).reshape(-1, len(centers))
        spots = _times_table(to_pixels, (), polar).T.reshape(-1, outer, outer)
        start, fraction = _window_start(centers, jnp.asarray(imager.sensor.origin, dtype), pixel, image.shape, outer)
        return _add_interpolated_windows(image, spots, start, fraction), None

    # Outer pixels for spots that lie partly beyond; lenses that are farther off do not count.
    image = jnp.zeros([n + 2 * outer + 2 for n in coarse], dtype)
    image = lax.scan(jax.checkpoint(add_lenses), image, _lens_groups(imager, optics, dtype))[0]
    image = image[outer + 1 : -outer - 1, outer + 1 : -outer - 1]
    rows, columns = (
        _upsampling_matrix(fine, rough, imager.sensor.pixel_pitch / pixel, dtype)
        for fine, rough in zip(imager.sensor.shape, coarse, strict=True)
    )
    return (rows @ image @ columns.T) * (imager.sensor.pixel_pitch / pixel) ** 2


def _mix_harmonics(table, spectrum, excess):
    """Harmonics `(field, harmonic, lens)` of the object to those of the image `(radius, harmonic, lens)`."""
    product = lambda table, part: jnp.einsum("mrf,fml->rml", table, part)
    return product(table[0], spectrum) + product(table[1], spectrum * excess[None, None])


def _lens_groups(imager, optics, dtype):
    """Centres and excess areas of the lenses, `_LENSES` at a time; the last are filled up with lenses far away."""
    centers, excess = imager.centers.astype(dtype), clear_area(imager.array).astype(dtype) - optics.area.astype(dtype)
    count = len(excess)
    groups = -(-count // _LENSES)
    size = -(-count // groups)
    missing = groups * size - count
    centers = jnp.pad(centers, [(0, missing), (0, 0)], constant_values=1e6)
    return centers.reshape(groups, size, 2), jnp.pad(excess, (0, missing)).reshape(groups, size)


def to_nodes(volume, grid, polar_grid):
    """The volume's light, shared linearly by coarse nodes, which are centred as the grid is."""

    def shares(voxels):
        count = math.ceil(voxels * grid.pitch / polar_grid.step / 2) * 2 + 1
        place = (np.arange(voxels) - (voxels - 1) / 2) * grid.pitch / polar_grid.step + (count - 1) / 2
        return jnp.asarray(np.maximum(1 - np.abs(np.arange(count)[:, None] - place), 0), volume.dtype)

    rows, columns = map(shares, grid.shape)
    return jnp.einsum("ay,dyx,bx->dab", rows, volume, columns)


def _window_start(centers, origin, step, shape, size):
    """First `(row, column)` of the window about each lens on nodes with this step, and the fraction of a node."""
    middle = (jnp.asarray(shape, centers.dtype) - 1) / 2
    place = ((centers - origin[None]) / step)[:, ::-1] + middle[None]
    whole = jnp.floor(lax.stop_gradient(place))
    return whole.astype(jnp.int32) - size // 2, place - whole


def _interpolated_windows(nodes, start, fraction, size):
    """Square windows of the nodes, centred on the lenses: `(lens, size, size)`; zero where they end."""
    windows = _read_windows((nodes.shape, (size + 1, size + 1)), start, nodes)
    down, right = fraction[:, 0, None, None], fraction[:, 1, None, None]
    windows = (1 - down) * windows[:, :-1] + down * windows[:, 1:]
    return (1 - right) * windows[..., :-1] + right * windows[..., 1:]


def _add_interpolated_windows(image, spots, start, fraction):
    """The adjoint of `_interpolated_windows`, added to an image."""
    down, right = fraction[:, 0, None, None], fraction[:, 1, None, None]
    spots = jnp.pad((1 - down) * spots, [(0, 0), (0, 1), (0, 0)]) + jnp.pad(down * spots, [(0, 0), (1, 0), (0, 0)])
    spots = jnp.pad((1 - right) * spots, [(0, 0), (0, 0), (0, 1)]) + jnp.pad(right * spots, [(0, 0), (0, 0), (1, 0)])
    return image + _read_windows.T((image.shape, spots.shape[1:]), start, spots)


def _gather_windows(shapes, start, image):
    """Windows of an image, `shapes` being of both; zero if they are not within it."""
    dimensions = lax.GatherDimensionNumbers(offset_dims=(1, 2), collapsed_slice_dims=(), start_index_map=(0, 1))
    return lax.gather(image, start, dimensions, shapes[1], mode="fill", fill_value=0)


def _add_windows(shapes, start, windows):
    """The transpose of `_gather_windows`, window by window: JAX before 0.11.1 compiles a scatter-add slowly for GPUs.

    On a CPU it takes 0.8 to 2.5 of the time of a scatter-add, a hundredth of all; a gather, by which each pixel
    looks into every window, takes 2 to 15.
    """
    shape, size = shapes
    within = ((start >= 0) & (start <= jnp.asarray(np.subtract(shape, size), start.dtype)[None])).all(1)
    windows = jnp.where(within[:, None, None], windows, 0)

    def add(image, one):
        at, window = one
        return lax.dynamic_update_slice(image, lax.dynamic_slice(image, at, size) + window, at), None

    return lax.scan(add, jnp.zeros(shape, windows.dtype), (start, windows))[0]


_read_windows = LinearMap(_gather_windows, _add_windows)


def _upsampling_matrix(fine: int, coarse: int, ratio, dtype) -> Float[Array, "fine coarse"]:
    """Along one axis, from the coarse pixels, sharpened, to the sensor's: Keys' cubic interpolation."""
    place = (jnp.arange(fine, dtype=dtype) - (fine - 1) / 2) * ratio + (coarse - 1) / 2
    x = jnp.abs(place[:, None] - jnp.arange(coarse, dtype=dtype)[None])
    near, far = (1.5 * x - 2.5) * x**2 + 1, ((-0.5 * x + 2.5) * x - 4) * x + 2
    cubic = jnp.where(x <= 1, near, jnp.where(x < 2, far, 0))
    return cubic @ jnp.asarray(_wiener_matrix(coarse), dtype)


@cache
def _wiener_matrix(count: int) -> Float[np.ndarray, "pixel pixel"]:
    blur = np.exp(-2 * np.pi**2 * _BLUR * np.fft.fftfreq(2 * count) ** 2)
    kernel = np.fft.ifft(blur * (1 + _NOISE) / (blur**2 + _NOISE)).real
    return kernel[np.arange(count)[:, None] - np.arange(count)]


class _Rows(NamedTuple):
    """The rows of a sparse matrix, in parts with about as many entries.

    `parts`: columns and shares `(row, entry)` of each, filled up with zeros. `order`: the place of each row among all
    the parts' rows.
    """

    parts: tuple[tuple[np.ndarray, np.ndarray], ...]
    order: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class _Table:
    """A sparse matrix and its transpose; `patch` is the side of the square of pixels."""

    patch: int
    rows: _Rows
    transposed: _Rows


def _times_rows(rows, columns):
    """Both directions gather whole rows: the scatter of a transpose is much slower."""
    products = [_times_part(index, weight.astype(columns.dtype), columns) for index, weight in rows.parts]
    return jnp.concatenate(products).at[rows.order].get(mode="promise_in_bounds")


def _times_part(index, weight, columns):
    take = lambda at: columns.at[at].get(mode="promise_in_bounds")
    if index.shape[1] > _FEW:
        return jnp.einsum("re,rec->rc", weight, take(index))
    total = jnp.zeros((len(index), columns.shape[1]), columns.dtype)
    for at, share in zip(index.T, weight.T, strict=True):
        total = total + share[:, None] * take(at)
    return total


_times_table = LinearMap(
    lambda table, _, columns: _times_rows(table.rows, columns),
    lambda table, _, columns: _times_rows(table.transposed, columns),
)


@cache
def _to_polar_table(polar_grid: PolarGrid) -> _Table:
    """From the square nodes about a lens to the polar ones: what each node holds is shared by the four around it."""
    reach = math.ceil(polar_grid.nodes(polar_grid.fields)[-2])
    node, polar, share = polar_weights(polar_grid, polar_grid.fields, *_square(reach))
    side, polars = 2 * reach + 1, polar_grid.fields * polar_grid.angles
    return _Table(side, _by_row(polar, node, share, polars), _by_row(node, polar, share, side**2))


@cache
def _to_pixels_table(polar_grid: PolarGrid) -> _Table:
    """From polar nodes to the pixels about a lens: the density of light, interpolated, so that none is lost.

    About the axis the nodes are closer than the pixels, and are shared by the four around them instead.
    """
    reach = math.ceil(polar_grid.nodes(polar_grid.radii)[-2])
    pixel, node, share = polar_weights(polar_grid, polar_grid.radii, *_square(reach))
    outer = (node >= _INNER_RINGS * polar_grid.angles) & (share > 0)
    pixel, node, share = pixel[outer], node[outer], share[outer]
    total = np.bincount(node, share, polar_grid.radii * polar_grid.angles)
    # The last rings are cut by the window's edge, and have no more light than that.
    whole = node < (polar_grid.radii - 3) * polar_grid.angles
    share = share / np.where(whole, total[node], np.repeat(polar_grid.areas(polar_grid.radii), polar_grid.angles)[node])
    parts = [(pixel, node, share), *_near_axis(polar_grid, reach)]
    pixel, node, share = (np.concatenate(part) for part in zip(*parts, strict=True))
    side, polars = 2 * reach + 1, polar_grid.radii * polar_grid.angles
    return _Table(side, _by_row(pixel, node, share, side**2), _by_row(node, pixel, share, polars))


def _near_axis(polar_grid: PolarGrid, reach: int):
    """Entries (pixel, polar node, share) of the inner polar nodes, for each of the four pixels around them."""
    node = np.arange(_INNER_RINGS * polar_grid.angles)
    radius, angle = (
        polar_grid.nodes(_INNER_RINGS)[node // polar_grid.angles],
        2 * np.pi * (node % polar_grid.angles) / polar_grid.angles,
    )
    place = np.stack([radius * np.sin(angle), radius * np.cos(angle)], -1) + reach
    whole = np.floor(place).astype(int)
    for corner in np.ndindex(2, 2):
        row, column = (whole + corner).T
        yield row * (2 * reach + 1) + column, node, np.where(corner, place - whole, 1 - (place - whole)).prod(-1)


def _square(reach: int):
    side = np.arange(-reach, reach + 1)
    y, x = np.meshgrid(side, side, indexing="ij")
    return x.ravel(), y.ravel()


def _by_row(row, column, share, rows) -> _Rows:
    """Entries of a sparse matrix, sorted by row; parts have rows of 1, 2, 3-4, 5-8, ... entries."""
    sorting = np.argsort(row, kind="stable")
    row, column, share = row[sorting], column[sorting], share[sorting]
    number = np.arange(row.size) - np.searchsorted(row, row)
    count = np.bincount(row, minlength=rows)
    size = np.ceil(np.log2(np.maximum(count, 1))).astype(int)
    parts = []
    for one in np.unique(size):
        place = np.cumsum(size == one) - 1
        mine = size[row] == one
        shape = np.count_nonzero(size == one), max(count[size == one].max(), 1)
        index, weight, at = np.zeros(shape, np.int32), np.zeros(shape), (place[row[mine]], number[mine])
        index[at], weight[at] = column[mine], share[mine]
        parts.append((index, weight))
    return _Rows(tuple(parts), np.argsort(np.argsort(size, kind="stable")).astype(np.int32))
