"""From a scene to the image on the sensor, as the command line does it."""

import math
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.errors import InputError, errors_name_file
from ..base.info import memory_bytes
from ..base.progress import Progress
from ..designs.design import Design
from ..geometry import Grid, Imager, Sensor
from ..io.points import read_points
from ..io.volumes import read_volume
from ..optics.window import psf_of_depth
from ..projection.forward_model import forward
from ..projection.points import STEPS, forward_points, stamps

# Distance of the depths at which the PSF of points is computed, mm: it changes by less than a pixel's width between.
_STEP = 0.1


def simulate_scene(
    path: Path, design: Design, *, kind: str = "diffraction", progress: Progress
) -> Float[np.ndarray, "row column"]:
    """The image of a file: points if it is a CSV, else a volume.

    Raises
    ------
    InputError
        As `read_points`, `read_volume` and the two functions below; it names the file.
    """
    imager = design.imager()
    options: dict[str, Any] = dict(kind=kind, progress=progress)
    if path.suffix.lower() == ".csv":
        points = read_points(path)
        simulate = lambda: simulate_points(points, imager, **options)
    else:
        volume, grid = read_volume(path)
        simulate = lambda: simulate_volume(volume, imager, grid, **options)
    with errors_name_file(path):
        return simulate()


def simulate_volume(
    volume: Float[Array | np.ndarray, "depth y x"],
    imager: Imager,
    grid: Grid,
    *,
    kind: str = "diffraction",
    progress: Progress,
) -> Float[np.ndarray, "row column"]:
    """The image of a volume whose voxels are evenly lit boxes, one plane after the other.

    Voxels are divided until they are half a pixel on the sensor or less: the image has no dots, and what is left of
    their raster is a ripple of 3 % at most.

    Parameters
    ----------
    volume
        `(len(depths), *grid.shape)`, not negative.
    imager, grid
        As for `forward`.
    kind
        Of the PSF: a key of `gs_jax.optics.window.PSFS`.

    Raises
    ------
    InputError
        If a voxel is negative, a divided plane would not fit into the memory, or the blur is too wide.
    """
    volume = np.asarray(volume, np.float32)
    finest = float(imager.magnification(grid.depths).max()) * grid.pitch / imager.sensor.pixel_pitch
    parts = math.ceil(2 * finest)
    rows, columns = (n * parts for n in grid.shape)
    if 16 * rows * columns > (memory := memory_bytes()):
        raise InputError(
            f"found planes of {grid.shape} voxels of {grid.pitch * 1000:g} um, which divided to half a pixel take "
            f"{16 * rows * columns / 2**30:.3g} GiB, allowed: {memory / 2**30:.3g} GiB on this machine."
        )
    if np.min(volume) < 0:
        raise InputError(f"found a voxel of {np.min(volume):g}, allowed: 0 or more.")
    kernel = psf_of_depth(imager, np.asarray(grid.depths), kind)
    image = jnp.zeros(imager.sensor.shape, jnp.float32)
    for depth, plane in zip(progress.track(np.asarray(grid.depths), "Imaging depths"), volume, strict=True):
        if not plane.any():
            continue
        fine = np.kron(plane, np.full((parts, parts), 1 / parts**2, np.float32))
        one = Grid(depth[None], (rows, columns), grid.pitch / parts, grid.origin)
        image += forward(fine[None], imager, one, kernel(depth)[None])
    return np.maximum(np.asarray(image), 0)  # an FFT's rounding may be below zero


def simulate_points(
    points: Float[np.ndarray, "point 4"],
    imager: Imager,
    *,
    kind: str = "diffraction",
    progress: Progress,
) -> Float[np.ndarray, "row column"]:
    """The image of points `(x, y, z, intensity)`, mm; parameters and errors as for `simulate_volume`."""
    if not len(points):
        return np.zeros(imager.sensor.shape, np.float32)
    near, far = points[:, 2].min(), points[:, 2].max()
    depths = np.unique(points[:, 2])
    if depths.size > (count := math.ceil((far - near) / _STEP) + 1):
        depths = np.linspace(near, far, count)
    sensor = Sensor(imager.sensor.shape, imager.sensor.pixel_pitch / STEPS)
    kernel = psf_of_depth(eqx.tree_at(lambda i: i.sensor, imager, sensor), depths, kind, STEPS)
    fine = np.stack([kernel(depth) for depth in progress.track(depths, "Point spread functions")])
    return forward_points(points, imager, stamps(depths, fine), progress)
