"""Images of point sources, on the host: each lens that sees a point adds a spot, a stamp of its PSF."""

import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int
from scipy.spatial import KDTree

from ..base.caches import cached_on_disk, key_of
from ..base.machine import cpu_device
from ..base.progress import Progress
from ..base.typing import Points
from ..base.workers import map_in_threads
from ..linear.linear_map import compiled_for_cpu
from ..microscope.geometry import FALLOFF, Imager
from ..microscope.media import object_index
from ..optics.field_varying import (
    CORE_REACH,
    StrayLight,
    has_sharp_cores,
    kernel_size,
    make_polar_grid,
    trace_stray_light,
)
from ..optics.psf_core import PsfCores, render_harmonics, render_kernel, ring_edges, trace_cores
from ..optics.raytrace import to_numpy
from .rays import Envelope, RingLight
from .stray_light import stray_light_image

# Positions of a stamp within a pixel, along each axis: the error is at most a tenth of a pixel.
STEPS = 5
# Points and spots computed at once, which bounds the memory (the built-in design has 13 spots per point); spots of few
# points.
_POINTS, _SPOTS, _FEW_POINTS, _FEW_SPOTS = 2048, 32768, 256, 2048
# Side, in pixels, of the tiles in which the image is summed; they stay in the CPU's cache.
_TILE = 512
# Distance of the reduced depths of stray light, mm; cores are computed half-way, too.
_STEP = 0.7
# Edges of the rings with a stamp each, in field radii: narrower than those of volumes, as they cost points nothing.
_RINGS = tuple(np.arange(1, 29) / 8)


class Ring(NamedTuple):
    """A ring of the field, with the distortion and light of its cores (`gs_jax.optics.psf_core.PsfCores`)."""

    edges: tuple[float, float]  # mm
    distortion: Float[np.ndarray, " depth"]
    light: Float[np.ndarray, "depth coefficient"]


class Stamps(NamedTuple):
    """PSF_o at some depths, or the cores of a ring and their harmonics, shifted by fifths of a pixel.

    `kernels[d, w, i, j]` is on the sensor's pixels, with its chief ray (or core) `(i - 2, j - 2)` fifths of a pixel
    (row, column) from the middle of the central one.
    """

    depths: Float[np.ndarray, " depth"]
    kernels: Float[np.ndarray, "depth wave 5 5 size size"]
    ring: Ring | None = None


def make_stamps(
    depths: Float[np.ndarray, " depth"], fine: Float[np.ndarray, "depth *wave fine fine"], ring: Ring | None = None
) -> Stamps:
    """Stamps from PSFs, or waves of PSFs, on pixels a fifth as large: `(depth, 5 size, 5 size)` with an odd size.

    Raises
    ------
    ValueError
        If the depths do not ascend, or the size is not five times an odd number.
    """
    size = fine.shape[-1] // STEPS
    if (len(fine), *fine.shape[-2:]) != (len(depths), STEPS * size, STEPS * size) or size % 2 == 0:
        raise ValueError(f"`fine` must be ({len(depths)}, n, n) with n five times an odd number, got {fine.shape}.")
    if (np.diff(depths) <= 0).any():
        raise ValueError(f"`depths` must ascend, got {depths}.")
    return Stamps(depths, np.stack(list(map(_shifted, fine.reshape(len(depths), -1, *fine.shape[-2:])))), ring)


def _shifted(fine: Float[np.ndarray, "wave fine fine"]) -> Float[np.ndarray, "wave 5 5 size size"]:
    """Stamps of one depth, at every fifth of a pixel."""
    size, half = fine.shape[-1] // STEPS, STEPS // 2
    wide = np.pad(fine, ((0, 0), (half, half), (half, half)), "wrap")
    # Pixels that begin at every fifth, along one axis after the other; a stamp that is moved up begins later.
    for _ in range(2):
        last = wide.shape[1] - STEPS + 1
        wide = sum((wide[:, step : step + last] for step in range(1, STEPS)), wide[:, :last]).swapaxes(1, 2)
    pixels = wide.reshape(-1, size, STEPS, size, STEPS)[:, :, ::-1, :, ::-1]
    return np.ascontiguousarray(pixels.transpose(0, 2, 4, 1, 3))


def forward_points(
    points: Points, imager: Imager, stamps: Stamps | Iterable[Stamps], progress: Progress | None = None
) -> Float[np.ndarray, "row column"]:
    """The image of points, Eq. (2), as `forward` computes it for voxels.

    The PSF is interpolated linearly between the depths of `stamps` and shifted by fifths of a pixel. This takes the
    memory of three images and one more copy of the stamps, for any number of points.

    Parameters
    ----------
    points
        `(x, y, z, intensity)`, mm. Each lens adds `intensity` times the envelope C, or times the light of the core.
    imager
        The microscope.
    stamps
        PSF_o, or the cores of each ring, of one size. Points beyond its depths take the nearest.
    progress
        Shows how many points are done.

    Returns
    -------
    ndarray
        `sensor.shape`, of the type of the stamps.
    """
    # In order of depth, so that few stamps at a time are in use.
    points = np.asarray(points, np.float64)
    points = points[np.argsort(points[:, 2])]
    progress, tiles = progress or Progress(), None
    for part in [stamps] if isinstance(stamps, Stamps) else stamps:
        tiles = _add_points(tiles, points, imager, part, progress)
    assert tiles is not None
    (rows, columns), overlap = _tiles(imager.sensor.shape, tiles.shape[-1] - _TILE + 1), tiles.shape[-1] - _TILE
    image, side = np.zeros((rows * _TILE + overlap, columns * _TILE + overlap), tiles.dtype), tiles.shape[-1]
    for tile, (row, column) in zip(np.asarray(tiles), np.ndindex(rows, columns), strict=True):
        image[row * _TILE :, column * _TILE :][:side, :side] += tile
    return image[overlap:, overlap:][: imager.sensor.shape[0], : imager.sensor.shape[1]]


def _add_points(tiles: Array | None, points: Points, imager: Imager, stamps: Stamps, progress: Progress) -> Array:
    """Add the spots of points to tiles, or begin them."""
    # Spots are added one after the other, which suits a CPU, also beside a GPU.
    host, device = to_numpy(imager), cpu_device()
    imager, depths, kernels = jax.device_put((imager, stamps.depths, stamps.kernels), device)
    size, weight = kernels.shape[-1], _weight(imager, stamps)
    if tiles is None:
        rows, columns = _tiles(imager.sensor.shape, size)
        tiles = jax.device_put(np.zeros((rows * columns, *2 * (_TILE + size - 1,)), kernels.dtype), device)
    lenses, starts = KDTree(host.centers), range(0, len(points), _POINTS)
    most = _FEW_SPOTS if len(points) <= _FEW_POINTS else _SPOTS
    for start in progress.track(starts, "Imaging points"):
        batch = points[start : start + _POINTS]
        lateral = batch[:, :2] - host.axis_offset(batch[:, 2])
        pairs = KDTree(lateral).sparse_distance_matrix(lenses, weight.limit, output_type="ndarray")
        if stamps.ring:
            # Those in the ring's hole have no light.
            pairs = pairs[pairs["v"] >= stamps.ring.edges[0] * (1 - FALLOFF)]
        for first in range(0, len(pairs), most):
            # Always as many, so that one shape is compiled; repetitions at the end are not added.
            count = min(most, len(pairs) - first)
            spots = pairs[first + np.arange(most) % count]
            core = _core(batch[:, 2], imager, stamps)
            spot_arguments = (batch[spots["i"]], spots["j"], *(part[spots["i"]] for part in core))
            tiles = _add_spots(tiles, count, *spot_arguments, imager, depths, kernels, weight)
    assert tiles is not None
    return tiles


def _tiles(shape: tuple[int, int], size: int) -> tuple[int, int]:
    """Rows and columns of tiles. The first begins `size - 1` pixels before the sensor, as the first stamps do."""
    rows, columns = (-(-(n + size - 1) // _TILE) for n in shape)
    return rows, columns


def _weight(imager: Imager, stamps: Stamps) -> Envelope | RingLight:
    return RingLight(*stamps.ring.edges) if stamps.ring else Envelope(imager.field_radius)


def _core(depth, imager, stamps):
    """The core's distortion and the parameters of its weight, for each point."""
    if stamps.ring is None:
        return np.ones_like(depth), to_numpy(imager).reduced_depth(depth)[:, None]
    between = lambda part: np.interp(depth, stamps.depths, part)
    return between(stamps.ring.distortion), np.stack([between(part) for part in stamps.ring.light.T], -1)


@partial(jax.jit, donate_argnums=0)
def _add_spots(
    tiles: Float[Array, "tile side side"],
    count: Int[ArrayLike, ""],
    points: Float[Array | np.ndarray, "spot 4"],
    lenses: Int[Array | np.ndarray, " spot"],
    distortion: Float[Array | np.ndarray, " spot"],
    parameters: Float[Array | np.ndarray, "spot parameter"],
    imager: Imager,
    depths: Float[Array, " depth"],
    kernels: Float[Array, "depth wave 5 5 size size"],
    weight: Envelope | RingLight,
) -> Float[Array, "tile side side"]:
    """Add the first `count` spots, each of a point and a lens, to the tiles, which overlap by a stamp."""
    size, dtype = kernels.shape[-1], imager.sensor_distance.dtype
    points, distortion, parameters = (jnp.asarray(part, dtype) for part in (points, distortion, parameters))
    views = imager.views(points[:, :3], lenses, distortion=distortion)
    light = (points[:, 3] * weight(jnp.sum(views.offset**2, -1), parameters)).astype(kernels.dtype)
    waves = _waves(views.offset, weight, kernels.shape[1]).astype(kernels.dtype)
    between = jnp.interp(points[:, 2], depths.astype(dtype), jnp.arange(len(depths), dtype=dtype))
    near = between.astype(int)
    far, part = jnp.minimum(near + 1, len(depths) - 1), (between - near.astype(dtype)).astype(kernels.dtype)

    fifths = jnp.floor(imager.sensor.to_pixels(views.spot) * STEPS + 0.5).astype(int) + STEPS // 2
    (i, j), corner = (fifths % STEPS).T, fifths // STEPS + size // 2
    last = jnp.array(imager.sensor.shape) + size - 2
    lit = (jnp.arange(len(points)) < count) & jnp.all((corner >= 0) & (corner <= last[None]), -1)
    tile = corner // _TILE @ jnp.array([_tiles(imager.sensor.shape, size)[1], 1])
    row, column = (corner % _TILE).T
    # Sorted by tile; spots off the sensor last.
    order = jnp.argsort(jnp.where(lit, tile, len(tiles)))

    def add(number, tiles):
        n = order[number]
        stamps = (1 - part[n]) * kernels[near[n], :, i[n], j[n]] + part[n] * kernels[far[n], :, i[n], j[n]]
        stamp = jnp.tensordot(waves[n], stamps, 1)
        at = tile[n], row[n], column[n]
        patch = lax.dynamic_slice(tiles, at, (1, size, size))
        return lax.dynamic_update_slice(tiles, patch + light[n] * stamp[None], at)

    return lax.fori_loop(0, jnp.sum(lit), add, tiles)


def _waves(offset: Float[Array, "spot 2"], weight: Envelope | RingLight, count: int) -> Float[Array, "spot wave"]:
    """Factors of a spot's stamps: 1, and powers of the field in units of a ring's end, as in the full model."""
    plain = jnp.ones((len(offset), 1), offset.dtype)
    if count == 1:
        return plain
    assert isinstance(weight, RingLight)
    x, y = (offset / weight.outer).T
    return jnp.concatenate([plain, jnp.stack([x, y, x**2 - y**2, 2 * x * y], -1)], -1)


def full_image_of_points(
    points: Float[np.ndarray, "point 4"], imager: Imager, progress: Progress | None = None
) -> Float[np.ndarray, "row column"]:
    """The image of points with the field-varying PSF, as `forward` computes it for voxels.

    Cores are stamps in narrow rings of the field, interpolated between reduced depths that are 0.35 mm apart; stray
    light is interpolated between some that are 0.7 mm apart. Nearer depths change the image of 120 ray-traced points by
    less than 0.05 dB.

    Parameters
    ----------
    points
        `(x, y, z, intensity)`, mm: the intensity is the light that a point emits in all directions.
    imager
        The microscope.
    progress
        Shows how much is done.
    """
    return _full_image(points, imager, _trace(points, imager, progress), progress)


def full_imager_of_points(
    bounds: Float[np.ndarray, "point _"], imager: Imager, progress: Progress | None = None
) -> Callable[[Float[np.ndarray, "point 4"]], Float[np.ndarray, "row column"]]:
    """Trace a microscope once, and return `full_image_of_points` of the points between some, `bounds`.

    `bounds` are to have more depths than are traced, or the function interpolates between theirs alone.
    """
    optics = _trace(bounds, imager, progress)
    return partial(_full_image, imager=imager, optics=optics._replace(stamps=list(optics.stamps)))


class _FullOptics(NamedTuple):
    """Stray light, the depths and nodes of its table, and the stamps of each ring."""

    depths: Float[np.ndarray, " depth"]
    stray_light: StrayLight
    stamps: Iterable[Stamps]


def _trace(points, imager: Imager, progress: Progress | None) -> _FullOptics:
    depths = np.unique(points[:, 2])
    steps = math.ceil((depths[-1] - depths[0]) / _STEP / float(object_index(imager.sample)))
    few = depths.size <= steps + 1
    fine = depths if few else np.linspace(depths[0], depths[-1], 2 * steps + 1)
    every = 1 if few else 2
    level, height = imager.level()
    lower = fine - float(height)
    grid = make_polar_grid(imager, fine, extent=2 * float(np.abs(points[:, :2]).max()))

    def trace() -> dict[str, np.ndarray]:
        sharp = has_sharp_cores(level, lower[::every], grid)
        tables = trace_cores(level, lower, CORE_REACH * grid.pixel, _RINGS, progress, oriented=sharp)
        cores = PsfCores(*(part[::every] for part in tables))
        return tables._asdict() | trace_stray_light(level, lower[::every], grid, cores, _RINGS, progress).arrays()

    # The next image of these points by this microscope finds the tables on the disk.
    arrays = cached_on_disk([b"points", *key_of((level, lower, every, grid, _RINGS))], trace)
    tables = PsfCores(*(arrays.pop(name) for name in PsfCores._fields))
    stray_light = StrayLight.on(grid, **{name: jax.device_put(part) for name, part in arrays.items()})
    return _FullOptics(fine[::every], stray_light, _stamps_of_rings(imager, fine, tables, kernel_size(imager, grid)))


def _stamps_of_rings(imager: Imager, depths, tables: PsfCores, size: int) -> Iterator[Stamps]:
    shapes = STEPS * size, STEPS

    def render(core):
        profile, harmonics = core
        kernel, waves = render_kernel(profile, *shapes), render_harmonics(profile, harmonics, *shapes)
        # Depth by depth, so that few copies are held at once.
        return _shifted(np.concatenate([kernel[None], waves]).astype(np.float32))

    rings = zip(ring_edges(imager, _RINGS), *(np.moveaxis(part, 1, 0) for part in tables), strict=True)
    for edges, distortion, light, *cores in rings:
        kernels = np.stack(list(map_in_threads(render, zip(*cores, strict=True))))
        yield Stamps(depths, kernels, Ring(edges, distortion, light))


def _full_image(points, imager: Imager, optics: _FullOptics, progress: Progress | None = None) -> np.ndarray:
    stray_light = optics.stray_light
    nodes = jnp.asarray(_to_nodes(points, optics.depths, stray_light.grid), imager.sensor_distance.dtype)
    planes = jnp.asarray(optics.depths, nodes.dtype)
    # Kernels would take longer to compile than they save.
    with compiled_for_cpu("xla"):
        image = np.array(jax.jit(stray_light_image)(nodes, imager, stray_light, planes, jnp.zeros(2, nodes.dtype)))
    image += forward_points(points, imager, optics.stamps, progress)
    # The stray light ripples below zero in places; clipping adds light, which scaling removes.
    clipped = np.maximum(image, 0)
    return clipped * (image.sum() / max(clipped.sum(), np.finfo(image.dtype).tiny))


def _to_nodes(points, depths, polar_grid):
    """Light of points, shared linearly by coarse nodes and depths: `(depth, y, x)`."""
    count = 2 * math.ceil(np.abs(points[:, :2]).max() / polar_grid.step + 1) + 1
    place = np.column_stack(
        [
            np.interp(points[:, 2], depths, np.arange(len(depths))),
            points[:, 1] / polar_grid.step + count // 2,
            points[:, 0] / polar_grid.step + count // 2,
        ]
    )
    whole = np.floor(place).astype(int)
    nodes = np.zeros((len(depths) + 1, count, count))
    for corner in np.ndindex(2, 2, 2):
        share = np.prod(np.where(corner, place - whole, 1 - (place - whole)), -1)
        np.add.at(nodes, tuple((whole + corner).T), points[:, 3] * share)
    return nodes[:-1]
