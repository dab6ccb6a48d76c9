"""From a capture to a volume, whatever the method."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Num

from ..base.errors import InputError, short_repr
from ..base.info import available_memory
from ..base.progress import Progress
from ..geometry import Grid, Imager
from ..optics.window import psf_of_depth
from ..projection.backprojection import backproject
from ..projection.operators import forward_operator
from ..solvers.iteration import Solver
from .methods import BackProjection, ListRichardsonLucy, Method

# Planes between two steps of the progress bar; a plane more or less changes neither speed nor memory.
_PLANES = 16
# Percentile of the pixels that is taken for the camera's offset: few captures are lit all over.
_DARKEST = 1


def voxel_grid(imager: Imager, depths: list[float], pitch: float | None = None) -> Grid:
    """The voxels to reconstruct: the field of view, as large as the sensor.

    Parameters
    ----------
    imager
        What took the capture.
    depths
        In mm.
    pitch
        Of the voxels laterally, mm. By default a pixel as seen at the middle depth, rounded to 0.1 um, and no less.

    Raises
    ------
    InputError
        If the volume would not fit into the memory.
    """
    if pitch is None:
        middle = float(imager.magnification(np.median(depths)))
        pitch = max(round(imager.sensor.pixel_pitch / middle, 4), 1e-4)
    grid = Grid.over(imager.sensor, depths=jnp.array(depths), pitch=pitch)
    size = 4 * len(depths) * grid.shape[0] * grid.shape[1]
    # The volume, the copy that is being computed, and room for the image.
    if 2.5 * size > (memory := available_memory()):
        shape = " x ".join(map(str, (len(depths), *grid.shape)))
        raise InputError(
            f"--voxel-um, --depths: found {pitch * 1000:g} um and {len(depths)} depths, a volume of {shape} voxels or "
            f"{size / 2**30:.3g} GiB, allowed: {memory / 2.5 / 2**30:.3g} GiB of the memory that is free."
        )
    return grid


def reconstruct(
    image: Num[Array | np.ndarray, "row column"],
    imager: Imager,
    grid: Grid,
    method: Method = BackProjection(),
    *,
    psf: Float[Array | np.ndarray, "plane tall wide"] | None = None,
    progress: Progress | None = None,
) -> Float32[np.ndarray, "depth y x"]:
    """The volume that an image shows.

    Back-projection takes the image as it is, some planes at a time. The other methods explain the light above the
    camera's offset: the image's darkest percent, or nothing if that is negative, as it was taken off already. They run
    step by step, and can be interrupted after each; the second call with the same shapes compiles nothing.

    Parameters
    ----------
    image, imager, grid
        As for `backproject`.
    method
        `BackProjection()`, `ListRichardsonLucy()`, or a solver: `RichardsonLucy()`, `FISTA()`, `ADMM()`.
    psf
        Of the solvers, as for `forward`; by default that of the rays, without diffraction.
    progress
        Shows how far it is; by default nothing does.

    Raises
    ------
    InputError
        If `method` is no method, the image is not `sensor.shape`, or a depth of the grid is blurred over more than 128
        pixels.

    Examples
    --------
    >>> volume = reconstruct(image, imager, grid, RichardsonLucy(steps=20))
    """
    progress = progress or Progress()
    if not isinstance(method, BackProjection | ListRichardsonLucy | Solver):
        raise InputError(f"method: found {short_repr(method)}, allowed: an object such as BackProjection() or FISTA().")
    if image.shape != imager.sensor.shape:
        raise InputError(f"image: found the shape {image.shape}, allowed: the sensor's shape {imager.sensor.shape}.")
    if isinstance(method, BackProjection):
        return _back_projected(image, imager, grid, method, progress)
    light = np.asarray(image, imager.sensor_distance.dtype)
    light = light - max(float(np.percentile(light, _DARKEST)), 0.0)
    if isinstance(method, ListRichardsonLucy):
        return _iterated(method.solver, progress, light, imager, grid, None)
    if psf is None:
        kernel = psf_of_depth(imager, np.asarray(grid.depths), "geometric")
        psf = jnp.stack([kernel(z) for z in progress.track(np.asarray(grid.depths), "Point spread functions")])
    return _iterated(method, progress, light, imager, grid, jnp.asarray(psf))


def _back_projected(image, imager, grid, method, progress):
    options = {"method": method.interpolation, "normalize": method.normalize}
    if grid.depths.size <= _PLANES:
        return np.asarray(backproject(image, imager, grid, **options), np.float32)
    image, depths = jnp.asarray(image), np.asarray(grid.depths)
    volume = np.empty(grid.volume_shape, np.float32)
    for first in progress.track(range(0, depths.size, _PLANES), "Back-projecting"):
        some = slice(first, first + _PLANES)
        volume[some] = backproject(image, imager, grid.at(depths[some]), **options)
    return volume


def _iterated(solver, progress, light, *system):
    # How many steps and until when is decided here: other numbers need no other code.
    compiled = dataclasses.replace(solver, steps=1, tolerance=0.0)
    state = _start(compiled, light, *system)
    with progress.counter("Iterating", solver.steps) as advance:
        for _ in range(solver.steps):
            state, residual = _step(state, compiled, light, *system)
            # To read the number waits for the step: what is shown has been done, and Ctrl-C ends it here.
            if float(residual) < solver.tolerance:
                break
            advance()
    return np.asarray(solver.estimate(state), np.float32)


@jax.jit
def _start(solver, light, *system):
    return solver.init(forward_operator(*system), light)


@partial(jax.jit, donate_argnums=0)
def _step(state, solver, light, *system):
    state, _, residual = solver.step(forward_operator(*system), light, state)
    return state, residual
