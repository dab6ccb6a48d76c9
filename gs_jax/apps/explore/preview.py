"""Ghosts of a point, and a small reconstruction, of a microscope whose numbers move."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.signal import fftconvolve

from ...geometry import Imager, Sensor, chief_ray, envelope
from ...grid import Grid
from ...simulation.phantoms import random_points
from .evaluation import SIZE, Bench, Values, imager_of, spot_of, unit_of

# Cells of a map of ghosts, across; pixels of a small sensor, across; planes and points of the scene, and voxels across.
# Depths of such a map.
_CELLS, _PIXELS, _PLANES, _POINTS, _VOXELS, _DEPTHS = 141, 640, 5, 20, 181, 9


class Ghosts(NamedTuple):
    """How many rays of back-projection cross each cell, `[row, column]`, over `(left, top, right, bottom)`, mm.

    `lenses` see the point, which all of their own rays meet.
    """

    crossings: Int[np.ndarray, "row column"]
    box: tuple[float, float, float, float]
    lenses: int


def ghosts_of(imager: Imager, near: float, far: float) -> Ghosts:
    """Where back-projection puts the light of a point on the axis, in the middle of the depths, mm, over all of them.

    Each lens throws each image back along its own chief ray: the point is where those of its own images meet at its
    depth; all else is its blur at other depths, and ghosts, which are other lenses' images. Lenses count within the
    field radius.
    """
    centers = np.asarray(imager.centers, float)
    x0, x1, y1, y0 = imager.sensor.extent
    half = np.array(imager.array.size) / 2
    box = (min(x0, -half[0]), min(y0, -half[1]), max(x1, half[0]), max(y1, half[1]))
    images = np.asarray(imager.project(np.array([[0.0, 0.0, (near + far) / 2]])), float)[:, 0]
    on = (images >= (x0, y0)).all(1) & (images <= (x1, y1)).all(1)
    images = images[on & (np.hypot(*centers.T) <= imager.field_radius)]
    edges = [np.linspace(box[1], box[3], _CELLS + 1), np.linspace(box[0], box[2], _CELLS + 1)]
    crossings = np.zeros((_CELLS, _CELLS), int)
    for magnification in np.asarray(imager.magnification(np.linspace(near, far, _DEPTHS)), float):
        # `p = c + m (c - q)` for q.
        offset = (centers[:, None] - images[None]) / magnification
        kept = np.hypot(*np.moveaxis(offset, -1, 0)) <= imager.field_radius
        places = (centers[:, None] + offset)[kept]
        crossings += np.histogram2d(places[:, 1], places[:, 0], edges)[0].astype(int)
    return Ghosts(crossings, box, len(images))


class Small(NamedTuple):
    """A small reconstruction: maxima along z, `[row, column]` over `(left, top, right, bottom)`, and the true points.

    `contrast` is the mean of the points' brightness over the background's standard deviation, above its median.
    """

    maxima: Float[np.ndarray, "row column"]
    points: Float[np.ndarray, "point 3"]
    box: tuple[float, float, float, float]
    contrast: float


def small_reconstruction(bench: Bench, values: Values, diameter: float) -> Small:
    """Points in five planes, imaged with spots by diffraction onto a coarse sensor, and back-projected.

    `diameter` is that of the clear aperture, mm. Light beside a spot's window is left out.
    """
    near, far, unit = values["near_mm"], values["far_mm"], unit_of(bench, values)
    imager = imager_of(bench, values)
    coarse = max(-(-max(imager.sensor.shape) // _PIXELS), 1)
    rows, columns = (max(n // coarse, 2) for n in imager.sensor.shape)
    sensor = Sensor((rows, columns), imager.sensor.pixel_pitch * coarse, imager.sensor.origin)
    small = dataclasses.replace(imager, sensor=sensor)
    depths = np.linspace(near, far, _PLANES)
    side = 0.7 * min(*imager.array.size, *(n * sensor.pixel_pitch for n in sensor.shape))
    points = random_points(_POINTS, (side, side), (near, far), seed=2)[:, :3]
    plane = np.arange(_POINTS) % _PLANES
    points[:, 2] = depths[plane]
    image = np.zeros(sensor.shape)
    for number, depth in enumerate(depths):
        spot = _binned(spot_of(bench, unit, float(depth), 0.0, diameter / 2), coarse)
        image += fftconvolve(_dots(small, points[plane == number]), spot, mode="same")
    pitch = max(sensor.shape) * sensor.pixel_pitch / _VOXELS
    grid = Grid.over(sensor, depths=depths, pitch=pitch)
    volume = _backprojected(np.maximum(image, 0), small, grid)
    left, right, bottom, top = grid.extent
    return Small(volume.max(0), points, (left, top, right, bottom), _contrast(volume, points, grid))


def _backprojected(image: np.ndarray, imager: Imager, grid: Grid) -> np.ndarray:
    """`backproject`, slower, but compiled once whatever the field radius, the plate and the planes are."""
    magnifications = np.broadcast_to(imager.magnifications(grid.depths), (len(imager.centers), grid.depths.size))
    sensor, kind = imager.sensor, imager.sensor_distance.dtype
    first = np.asarray(sensor.to_mm(np.zeros(2)))
    numbers = (image, imager.centers, magnifications, imager.reduced_depth(grid.depths), imager.field_radius)
    numbers = (*numbers, grid.x, grid.y, first, sensor.pixel_pitch)
    return np.asarray(_summed(*(jnp.asarray(x, kind) for x in numbers)))


@jax.jit
def _summed(image, centers, magnifications, reduced, field, x, y, first, pixel):
    """Over the lenses, of each plane; `first` is the place `(x, y)` of the first pixel."""

    def along(positions, count):
        low = jnp.clip(jnp.floor(positions), 0, count - 2)
        within = (positions >= 0) & (positions <= count - 1)
        share = positions - low
        return low.astype(int), jnp.where(within, 1 - share, 0), jnp.where(within, share, 0)

    def of_lens(plane, lens, magnification, depth):
        rows, top, bottom = along((chief_ray(centers[lens, 1], y, magnification) - first[1]) / pixel, image.shape[0])
        columns, left, right = along((chief_ray(centers[lens, 0], x, magnification) - first[0]) / pixel, image.shape[1])
        strip = top[:, None] * image[rows] + bottom[:, None] * image[rows + 1]
        seen = left[None] * strip[:, columns] + right[None] * strip[:, columns + 1]
        squared = ((y - centers[lens, 1]) ** 2)[:, None] + ((x - centers[lens, 0]) ** 2)[None]
        return plane + envelope(squared, depth, field) * seen

    def plane(each):
        magnification, depth = each
        nothing = jnp.zeros((y.size, x.size), image.dtype)
        add = lambda lens, sum_: of_lens(sum_, lens, magnification[lens], depth)
        return jax.lax.fori_loop(0, centers.shape[0], add, nothing)

    return jax.lax.map(plane, (magnifications.T, reduced))


def _binned(spot: np.ndarray, coarse: int) -> np.ndarray:
    """A spot on pixels that are so many of the sensor's across, an odd number of them, the middle in their middle."""
    reach = -(-(SIZE - coarse) // (2 * coarse)) if coarse < SIZE else 0
    wide = (2 * reach + 1) * coarse
    if wide < SIZE:
        reach, wide = reach + 1, wide + 2 * coarse
    before = (wide - SIZE) // 2
    padded = np.pad(spot, (before, wide - SIZE - before))
    return padded.reshape(2 * reach + 1, coarse, 2 * reach + 1, coarse).sum((1, 3))


def _dots(imager: Imager, points: np.ndarray) -> np.ndarray:
    """Images of points by chief rays, each shared by four pixels."""
    image = np.zeros(imager.sensor.shape)
    if not len(points):
        return image
    views = imager.views_of_all(points)
    places, light = np.asarray(imager.sensor.to_pixels(views.spot), float), np.asarray(imager.brightness(views), float)
    corner = np.floor(places)
    share = places - corner
    for down, right in np.ndindex(2, 2):
        row, column = (corner + (down, right)).astype(int).reshape(-1, 2).T
        part = light * np.abs(1 - down - share[..., 0]) * np.abs(1 - right - share[..., 1])
        on = (row >= 0) & (row < image.shape[0]) & (column >= 0) & (column < image.shape[1])
        np.add.at(image, (row[on], column[on]), part.ravel()[on])
    return image


def _contrast(volume: np.ndarray, points: np.ndarray, grid: Grid) -> float:
    rows = np.clip(np.rint((points[:, 1] - float(grid.y[0])) / grid.pitch).astype(int), 1, grid.shape[0] - 2)
    columns = np.clip(np.rint((points[:, 0] - float(grid.x[0])) / grid.pitch).astype(int), 1, grid.shape[1] - 2)
    planes = np.abs(np.asarray(grid.depths, float)[:, None] - points[None, :, 2]).argmin(0)
    near = lambda k, r, c: volume[k, r - 1 : r + 2, c - 1 : c + 2].max()
    bright = np.mean([near(k, r, c) for k, r, c in zip(planes, rows, columns, strict=True)])
    middle, spread = np.median(volume), volume.std()
    return float((bright - middle) / spread) if spread > 0 else 0.0
