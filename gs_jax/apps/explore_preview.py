"""Previews of a microscope whose numbers move: the ghosts of a point, and a small simulated reconstruction."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.signal import fftconvolve

from ..geometry import Imager, envelope
from ..grid import Grid, Sensor
from ..optics.psf import spot_image
from ..optics.raytrace import to_numpy
from ..simulation.phantoms import random_points
from .drawings import plate_and_sensor
from .explore_design import SIZE, Start, Values, lens_unit, moved_imager, pupil_samples

# Cells across the map of ghosts, and its depths.
_CELLS, _GHOST_DEPTHS = 141, 9
# Pixels across the small sensor; planes, points and voxels across of the reconstruction.
_PIXELS, _PLANES, _POINTS, _VOXELS = 640, 5, 20, 181


class GhostMap(NamedTuple):
    """How many rays of back-projection cross each cell of `box`, `(left, top, right, bottom)`, mm.

    `lenses` see the point.
    """

    crossings: Int[np.ndarray, "row column"]
    box: tuple[float, float, float, float]
    lenses: int


def map_ghosts(imager: Imager, near: float, far: float) -> GhostMap:
    """Count where back-projection puts the light of a point on the axis, in the middle of the depths, over all depths.

    Each lens throws each image back along its own chief ray. Rays meet at the point at its depth; all else is its blur
    at other depths, and ghosts, which are other lenses' images. Lenses count within the field radius.
    """
    depths = np.linspace(near, far, _GHOST_DEPTHS)
    left, right, bottom, top = imager.sensor.extent
    box = plate_and_sensor(imager)
    host = to_numpy(imager)
    # On the axis, at each depth and in the middle of them.
    axis = host.views_of_all(np.column_stack([np.zeros((_GHOST_DEPTHS + 1, 2)), [*depths, (near + far) / 2]]))
    images, offsets = axis.spot[:, -1], axis.offset
    on = (images >= (left, top)).all(1) & (images <= (right, bottom)).all(1)
    images = images[on & (np.hypot(*offsets[:, -1].T) <= imager.field_radius)]
    magnifications = np.broadcast_to(imager.magnifications(depths), (len(axis.spot), _GHOST_DEPTHS))
    # A spot moves by -M for a point that moves by 1.
    points = (axis.spot[:, None, :-1] - images[None, :, None]) / magnifications[:, None, :, None]
    kept = np.hypot(*np.moveaxis(points + offsets[:, None, :-1], -1, 0)) <= imager.field_radius
    edges = [np.linspace(low, high, _CELLS + 1) for low, high in ((box[1], box[3]), (box[0], box[2]))]
    crossings = np.histogram2d(points[kept][:, 1], points[kept][:, 0], edges)[0].astype(int)
    return GhostMap(crossings, box, len(images))


class Reconstruction(NamedTuple):
    """Maxima along z over `(left, top, right, bottom)`, mm, and the true points.

    `contrast` is the mean brightness of the points above the volume's median, over its standard deviation.
    """

    maxima: Float[np.ndarray, "row column"]
    points: Float[np.ndarray, "point 3"]
    box: tuple[float, float, float, float]
    contrast: float


def reconstruct_points(start: Start, values: Values, clear_diameters: Float[np.ndarray, " type"]) -> Reconstruction:
    """Image points in five planes with the spots of each lens type onto a coarse sensor, and back-project them.

    Light outside a spot's window is left out. `clear_diameters` are those of the types, mm.
    """
    near, far, imager = values["near_mm"], values["far_mm"], moved_imager(start, values)
    coarse = max(-(-max(imager.sensor.shape) // _PIXELS), 1)
    rows, columns = (max(n // coarse, 2) for n in imager.sensor.shape)
    sensor = Sensor((rows, columns), imager.sensor.pixel_pitch * coarse, imager.sensor.origin)
    small = dataclasses.replace(imager, sensor=sensor)
    depths = np.linspace(near, far, _PLANES)
    side = 0.7 * min(*imager.array.plate, *(n * sensor.pixel_pitch for n in sensor.shape))
    points = random_points(_POINTS, (side, side), (near, far), seed=2)[:, :3]
    plane = np.arange(_POINTS) % _PLANES
    points[:, 2] = depths[plane]
    image, samples = np.zeros(sensor.shape), pupil_samples(start)
    for number, (lenses, diameter) in enumerate(zip(start.types, clear_diameters, strict=True)):
        unit = lens_unit(start, values, number)
        for k, depth in enumerate(depths):
            binned = _bin(spot_image(unit, float(depth), 0.0, size=SIZE, radius=diameter / 2, samples=samples), coarse)
            image += fftconvolve(_dots(small, points[plane == k], lenses), binned, mode="same")
    grid = Grid.over(sensor, depths=depths, pitch=max(sensor.shape) * sensor.pixel_pitch / _VOXELS)
    volume = _backproject(np.maximum(image, 0), small, grid)
    left, right, bottom, top = grid.extent
    return Reconstruction(volume.max(0), points, (left, top, right, bottom), _contrast(volume, points, grid))


def _backproject(image, imager: Imager, grid: Grid) -> np.ndarray:
    """`gs_jax.backproject` more slowly, but compiled once for all field radii, which are static there."""
    image, radius = (jnp.asarray(x, imager.sensor_distance.dtype) for x in (image, imager.field_radius))
    return np.asarray(_sum_lenses(image, dataclasses.replace(imager, field_radius=1.0), grid, radius))


@jax.jit
def _sum_lenses(image: Array, imager: Imager, grid: Grid, field_radius: Array) -> Array:
    def plane(depth):
        # Views are separable in x and y: one line of points along each is enough.
        across = jnp.stack([grid.x, 0 * grid.x, jnp.full_like(grid.x, depth)], -1)
        along = jnp.stack([0 * grid.y, grid.y, jnp.full_like(grid.y, depth)], -1)

        def add_lens(lens, plane):
            by_x, by_y = imager.views(across, lens[None]), imager.views(along, lens[None])
            rows = _interpolate(image, imager.sensor.to_pixels(by_y.spot)[:, 0])
            seen = _interpolate(rows.T, imager.sensor.to_pixels(by_x.spot)[:, 1]).T
            squared = by_y.offset[:, 1:] ** 2 + by_x.offset[None, :, 0] ** 2
            return plane + envelope(squared, by_x.reduced_depth[None], field_radius) * seen

        return jax.lax.fori_loop(0, len(imager.array.centers), add_lens, jnp.zeros(grid.shape, image.dtype))

    return jax.lax.map(plane, grid.depths)


def _interpolate(image: Array, position: Array | np.ndarray) -> Array:
    """Rows of an image at fractional positions, zero outside."""
    low = jnp.clip(jnp.floor(position), 0, len(image) - 2).astype(int)
    share, inside = position - low.astype(position.dtype), (position >= 0) & (position <= len(image) - 1)
    part = lambda weight: jnp.where(inside, weight, 0)[:, None]
    return part(1 - share) * image[low] + part(share) * image[low + 1]


def _bin(spot: np.ndarray, coarse: int) -> np.ndarray:
    """A spot on pixels `coarse` times as large, an odd number of them, its middle in the middle pixel."""
    reach = max(-(-(SIZE - coarse) // (2 * coarse)), 0)
    side = (2 * reach + 1) * coarse
    before = (side - SIZE) // 2
    padded = np.pad(spot, (before, side - SIZE - before))
    return padded.reshape(2 * reach + 1, coarse, 2 * reach + 1, coarse).sum((1, 3))


def _dots(imager: Imager, points: np.ndarray, lenses: tuple[int, ...]) -> np.ndarray:
    """Chief-ray images of points by some lenses, each shared by the four nearest pixels."""
    host = to_numpy(imager)
    views = host.views(points[None], np.array(lenses)[:, None])
    spots, light = host.sensor.to_pixels(views.spot), np.asarray(host.brightness(views))
    corner, image = np.floor(spots).astype(int), np.zeros(imager.sensor.shape)
    for step in np.ndindex(2, 2):
        pixel, part = corner + step, light * np.prod(1 - np.abs(corner + step - spots), -1)
        on = ((pixel >= 0) & (pixel < image.shape)).all(-1)
        np.add.at(image, tuple(pixel[on].T), part[on])
    return image


def _contrast(volume: np.ndarray, points: np.ndarray, grid: Grid) -> float:
    rows = np.clip(np.rint((points[:, 1] - float(grid.y[0])) / grid.pitch).astype(int), 1, grid.shape[0] - 2)
    columns = np.clip(np.rint((points[:, 0] - float(grid.x[0])) / grid.pitch).astype(int), 1, grid.shape[1] - 2)
    planes = np.abs(np.asarray(grid.depths, float)[:, None] - points[None, :, 2]).argmin(0)
    around = lambda k, r, c: volume[k, r - 1 : r + 2, c - 1 : c + 2].max()
    bright = np.mean([around(k, r, c) for k, r, c in zip(planes, rows, columns, strict=True)])
    deviation = volume.std()
    return float((bright - np.median(volume)) / deviation) if deviation > 0 else 0.0
