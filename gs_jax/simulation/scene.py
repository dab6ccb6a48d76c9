"""From a scene to the image on the sensor."""

import math
import os
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.arrays import check_finite
from ..base.errors import InputError, short_repr
from ..base.machine import available_memory
from ..base.progress import Progress
from ..geometry import Imager, Sensor
from ..grid import Grid
from ..io.point_tables import read_points
from ..io.volumes import read_volume
from ..optics.full import full_optics, halo_nodes
from ..optics.kinds import lenses_by_kind, of_kinds, relative_areas
from ..optics.window import PSFS, psf_of_depth
from ..projection.forward_model import forward
from ..projection.levels import LEVELS
from ..projection.point_sources import STEPS, forward_points, full_image_of_points, stamps

# Chief rays alone make no image of a point.
OPTICS = tuple(level for level in LEVELS if level != "pinhole")
# Distance of the depths at which the PSF of points is computed, mm: it changes by less than a pixel's width between.
_STEP = 0.1
# As many of these depths at a time, which bounds the memory.
_SLAB = 48


def read_scene(path: str | os.PathLike[str]) -> tuple[np.ndarray, Grid | None]:
    """A scene from a file: points `(point, 4)` if it is a CSV, else a volume with its grid.

    Raises
    ------
    InputError
        As `read_points` and `read_volume`.
    """
    if Path(path).suffix.lower() == ".csv":
        return read_points(path), None
    return read_volume(path)


def simulate(
    scene: Float[Array | np.ndarray, "..."],
    imager: Imager,
    grid: Grid | None = None,
    *,
    optics: str = "full",
    psf: str | None = None,
    progress: Progress | None = None,
) -> Float[np.ndarray, "row column"]:
    """The image of points, or of a volume on a grid, on the sensor; a camera's noise is `expose`'s.

    *Host.*

    Parameters
    ----------
    scene
        Points `(point, 4)`, `(x, y, z, intensity)` in mm; or, with a grid, a volume of `grid.volume_shape`. Neither is
        negative.
    imager
        What sees it.
    grid
        Of a volume.
    optics
        "full": all light of every lens, where it lands, by exact rays; intensities are what is sent out in all
        directions. "near": Eq. (2), one PSF for all lenses (of a kind) within the field radius; intensities are what
        the mean lens on the axis gets.
    psf
        Of a lens, for "near": "diffraction" (the default), "geometric" (rays alone) or "gaussian"; the quicker ones
        last.
    progress
        Shows how far it is.

    Raises
    ------
    InputError
        If there is no such optics or PSF, a voxel is negative, a number is not finite, a point's depth is not positive,
        the work would not fit into the memory, or a depth is blurred over more than 128 pixels each way ("near").

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> import numpy as np
    >>> point = np.array([[0.2, -0.1, 20.0, 1.0]])  # x, y, z in mm, and its light
    >>> image = gs.simulate(point, scope, optics="near", psf="geometric")
    >>> image.shape
    (200, 200)
    """
    if optics not in OPTICS:
        raise InputError(f"`optics`: found {short_repr(optics)}, allowed: {', '.join(OPTICS)}.")
    if psf and optics == "full":
        raise InputError(f'`psf`: found {short_repr(psf)} with optics "full", allowed: with "near", which has one PSF.')
    if psf not in (None, *PSFS):
        raise InputError(f"`psf`: found {short_repr(psf)}, allowed: {', '.join(PSFS)}.")
    kind = "full" if optics == "full" else psf or "diffraction"

    def image_of(imager):
        if grid is None:
            return simulate_points(np.asarray(scene, np.float64), imager, kind=kind, progress=progress)
        return simulate_volume(scene, imager, grid, kind=kind, progress=progress)

    if imager.array.alike:
        return image_of(imager)
    each = of_kinds(imager, lenses_by_kind(imager))
    light = np.ones(len(each)) if optics == "full" else relative_areas(each)
    images = [image_of(one) * np.float32(share) for one, share in zip(each, light, strict=True)]
    return np.sum(images, 0)


def simulate_volume(
    volume: Float[Array | np.ndarray, "depth y x"],
    imager: Imager,
    grid: Grid,
    *,
    kind: str = "diffraction",
    progress: Progress | None = None,
) -> Float[np.ndarray, "row column"]:
    """The image of a volume whose voxels are evenly lit boxes, one plane after the other.

    Voxels are divided until they are half a pixel on the sensor or less: the image has no dots, and what is left of
    their raster is a ripple of 3 % at most.

    Parameters
    ----------
    volume
        `grid.volume_shape`, not negative.
    imager, grid
        As for `forward`.
    kind
        Of the PSF: a key of `gs_jax.optics.window.PSFS`; or "full", all of the light.

    Raises
    ------
    InputError
        If a voxel is negative or not finite, a divided plane would not fit into the memory, or the blur is too wide.
    """
    check_finite("scene", volume, "voxels")
    volume = np.asarray(volume, np.float32)
    finest = float(imager.magnification(grid.depths).max()) * grid.pitch / imager.sensor.pixel_pitch
    parts = math.ceil(2 * finest)
    rows, columns = (n * parts for n in grid.shape)
    if 16 * rows * columns > (memory := available_memory()):
        raise InputError(
            f"found planes of {grid.shape} voxels of {grid.pitch * 1000:g} um, which divided to half a pixel take "
            f"{16 * rows * columns / 2**30:.3g} GiB, allowed: the {memory / 2**30:.3g} GiB that are free."
        )
    if np.min(volume) < 0:
        raise InputError(f"found a voxel of {np.min(volume):g}, allowed: 0 or more.")
    of_depth = _optics_of_depth(imager, grid, kind)
    image, progress = jnp.zeros(imager.sensor.shape, jnp.float32), progress or Progress()
    for depth, plane in zip(progress.track(np.asarray(grid.depths), "Imaging depths"), volume, strict=True):
        if not plane.any():
            continue
        fine = np.kron(plane, np.full((parts, parts), 1 / parts**2, np.float32))
        one = Grid(depth[None], (rows, columns), grid.pitch / parts, grid.origin)
        image += forward(fine[None], imager, one, of_depth(depth))
    return np.maximum(np.asarray(image), 0)  # an FFT's rounding may be below zero


def _optics_of_depth(imager, grid, kind):
    depths = np.asarray(grid.depths, np.float64)
    if kind == "full":
        extent = max(grid.shape) * grid.pitch + 2 * float(jnp.abs(grid.origin).max())
        nodes = halo_nodes(imager, depths, extent=extent)
        return lambda depth: full_optics(imager, np.array([depth], np.float64), nodes=nodes)
    kernel = psf_of_depth(imager, depths, kind)
    return lambda depth: kernel(depth)[None]


def simulate_points(
    points: Float[np.ndarray, "point 4"],
    imager: Imager,
    *,
    kind: str = "diffraction",
    progress: Progress | None = None,
) -> Float[np.ndarray, "row column"]:
    """The image of points `(x, y, z, intensity)`, mm; parameters and errors as for `simulate`."""
    check_finite("scene", points, "numbers")
    if (behind := ~(points[:, 2] > 0)).any():
        raise InputError(f"scene: found a point at the depth {points[behind][0, 2]:g} mm, allowed: above 0.")
    if not len(points):
        return np.zeros(imager.sensor.shape, np.float32)
    if kind == "full":
        return full_image_of_points(points, imager, progress)
    near, far = points[:, 2].min(), points[:, 2].max()
    depths = np.unique(points[:, 2])
    if depths.size > (count := math.ceil((far - near) / _STEP) + 1):
        depths = np.linspace(near, far, count)
    sensor = Sensor(imager.sensor.shape, imager.sensor.pixel_pitch / STEPS, imager.sensor.origin)
    kernel = psf_of_depth(eqx.tree_at(lambda i: i.sensor, imager, sensor), depths, kind, STEPS)
    # Each point between two depths of its slab, the last of which is the first of the next slab.
    between = np.clip(np.searchsorted(depths, points[:, 2], "right") - 1, 0, max(depths.size - 2, 0))
    slabs, image, progress = between // _SLAB, 0, progress or Progress()
    for slab in np.unique(slabs):
        some = depths[slab * _SLAB :][: _SLAB + 1]
        fine = np.stack([kernel(depth) for depth in progress.track(some, "Point spread functions")])
        image = image + forward_points(points[slabs == slab], imager, stamps(some, fine), progress)
    return np.asarray(image)
