"""From a capture to a volume, whatever the method."""

import dataclasses
import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float, Float32, Num

from ..base.errors import InputError, short_repr
from ..base.info import available_memory
from ..base.progress import Progress
from ..geometry import Grid, Imager, Sensor
from ..optics.cores import apparent_depths
from ..optics.full import FullOptics
from ..projection.backprojection import backproject
from ..projection.forward_model import Optics
from ..projection.levels import LEVELS, optics_of
from ..projection.operators import forward_operator
from ..solvers.iteration import Solver
from ..solvers.richardson_lucy import RichardsonLucy
from ..solvers.unmatched import Unmatched
from ..solvers.unrolled import Unrolled
from ..suppression.background import local_levels
from .discrepancy import misfit_of_noise
from .methods import BackProjection, ListRichardsonLucy, Method

# Planes between two steps of the progress bar; a plane more or less changes neither speed nor memory.
_PLANES = 16
# Percentile of the pixels that is taken for the camera's offset: few captures are lit all over.
_DARKEST = 1
# Half a wave of background is this many of the halo's pixels at least: as wide as the halo of a spot.
_SLOW = 6.5
# Of the default voxel of an iterative method, which is as wide as so many pixels.
COARSE = 4
# In units of the misfit of noise, which is known to a few percent.
_ENOUGH = 1.1
_ROUNDING = 0.02


def voxel_grid(imager: Imager, depths: list[float], pitch: float | None = None, *, pixels: int = 1) -> Grid:
    """The voxels to reconstruct: the field of view, as large as the sensor.

    Parameters
    ----------
    imager
        What took the capture.
    depths
        In mm.
    pitch
        Of the voxels laterally, mm. By default `pixels` as seen at the middle depth, rounded to 0.1 um, and no less.
    pixels
        Of the default.

    Raises
    ------
    InputError
        If the volume would not fit into the memory.
    """
    if pitch is None:
        middle = float(imager.magnification(np.median(depths)))
        pitch = max(round(pixels * imager.sensor.pixel_pitch / middle, 4), 1e-4)
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
    optics: Optics | str = "full",
    stop_at_noise: bool = False,
    progress: Progress | None = None,
) -> Float32[np.ndarray, "depth y x"]:
    """The volume that an image shows.

    Back-projection takes the image as it is, some planes at a time. The other methods explain the light above the
    camera's offset: the image's darkest percent, or nothing if that is negative, as it was taken off already. They run
    step by step, and can be interrupted after each; the second call with the same shapes compiles nothing.

    With optics by name, iterative methods sum as many pixels as the voxels are wide. Light that the optics does not
    hold is background, and is fitted by no voxel. With "full" that varies slowly: FISTA and ADMM leave the image's
    longest waves out of account. With "near" and "pinhole" it is most of the light: what is everywhere within squares
    of 32 pixels.

    Parameters
    ----------
    image, imager, grid
        As for `backproject`.
    method
        `BackProjection()`, `ListRichardsonLucy()`, or a solver: `RichardsonLucy()`, `FISTA()`, `ADMM()`,
        `Unrolled.pretrained()`.
    optics
        As for `forward`, or its name for `optics_of`. By name, "full" or "near", back-projection reads the bright cores
        of the spots; otherwise it follows the chief rays, as the paper does.
    stop_at_noise
        End before the last step where no more is left to explain than the image's own noise, by the discrepancy
        principle; `BackProjection` and `Unrolled` do not.
    progress
        Shows how far it is; by default nothing does.

    Raises
    ------
    InputError
        If `method` is no method, the image is not `sensor.shape`, there is no such optics, or a depth of the grid is
        blurred over more than 128 pixels ("near").

    Examples
    --------
    >>> volume = reconstruct(image, imager, grid, RichardsonLucy(steps=20))
    """
    progress, by_name = progress or Progress(), isinstance(optics, str)
    if not isinstance(method, BackProjection | ListRichardsonLucy | Solver):
        raise InputError(f"method: found {short_repr(method)}, allowed: an object such as BackProjection() or FISTA().")
    if by_name and optics not in LEVELS:
        raise InputError(f"optics: found {short_repr(optics)}, allowed: {', '.join(LEVELS)}.")
    if image.shape != imager.sensor.shape:
        raise InputError(f"image: found the shape {image.shape}, allowed: the sensor's shape {imager.sensor.shape}.")
    on_cores = by_name and optics != "pinhole"
    seen = grid.at(apparent_depths(imager, grid.depths)) if on_cores else grid
    if isinstance(method, BackProjection):
        return _back_projected(image, imager, seen, method, progress)
    light, imager, background, optics = explainable(image, imager, grid, optics, progress)
    counts = isinstance(method, ListRichardsonLucy | RichardsonLucy)
    enough = _ENOUGH * misfit_of_noise(np.asarray(image), light, counts=counts) if stop_at_noise else 0.0
    if isinstance(method, ListRichardsonLucy):
        return iterated(method.solver(background), progress, light, System(imager, grid, optics, seen), enough)
    if isinstance(method, RichardsonLucy):
        method = dataclasses.replace(method, background=method.background + jnp.asarray(background))
        return iterated(method, progress, light, System(imager, grid, optics), enough)
    light = light - background
    if isinstance(method, Unrolled):
        # Its steps were trained together.
        return iterated(method, progress, light, System(imager, grid, optics, seen))
    system = System(imager, grid, optics, slow=_slow_waves(imager, optics) if by_name else 0)
    return iterated(method, progress, np.asarray(system.fast(light), light.dtype), system, enough)


def explainable(
    image: Num[Array | np.ndarray, "row column"], imager: Imager, grid: Grid, optics: Optics | str, progress: Progress
) -> tuple[Float[np.ndarray, "y x"], Imager, Float[np.ndarray, "y x"] | float, Optics]:
    """What iterative methods are to explain: light above the offset, its microscope, background in it, and the optics.

    With optics by name, pixels are as wide as voxels, and what optics other than "full" do not hold is background.
    """
    light = above_offset(np.asarray(image, imager.sensor_distance.dtype))
    if not isinstance(optics, str):
        return light, imager, 0.0, jnp.asarray(optics) if isinstance(optics, np.ndarray) else optics
    light, imager = _binned(light, imager, grid)
    background = 0.0 if optics == "full" else np.maximum(local_levels(light)[0], 0)
    return light, imager, background, optics_of(imager, grid.depths, optics, progress=progress)


def _slow_waves(imager, optics):
    if not isinstance(optics, FullOptics):
        return 0
    return round(max(imager.sensor.shape) * imager.sensor.pixel_pitch / (_SLOW * optics.halo.grid.pixel))


def above_offset(image: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "row column"]:
    """An image less its darkest percent, or as it is if that is negative."""
    return image - np.asarray(max(float(np.percentile(image, _DARKEST)), 0.0), image.dtype)


class System(eqx.Module):
    """What a solver inverts: the microscope, and how.

    Parameters
    ----------
    imager, grid, optics
        As for `forward`.
    seen
        If given, back-projection from these voxels stands for the adjoint.
    slow
        So many of the image's longest cosine waves each way are left out of account.
    """

    imager: Imager
    grid: Grid
    optics: Optics
    seen: Grid | None = None
    slow: int = eqx.field(static=True, default=0)

    @property
    def operator(self) -> lx.AbstractLinearOperator | Unmatched:
        A = forward_operator(self.imager, self.grid, self.optics)
        if self.seen is not None:
            return Unmatched(A, forward_operator(self.imager, self.seen).T)
        return lx.FunctionLinearOperator(lambda x: self.fast(A.mv(x)), A.in_structure()) if self.slow else A

    def fast(self, image: Float[Array | np.ndarray, "row column"]) -> Float[Array, "row column"]:
        """The image without its slow waves, an orthogonal projection: least squares then fit these waves, too."""
        image = jnp.asarray(image)
        if not self.slow:
            return image
        rows, columns = (_waves(n, self.slow, image.dtype) for n in image.shape)
        return image - rows @ (rows.T @ image @ columns) @ columns.T


def _waves(size, count, dtype):
    """The longest waves of the discrete cosine transform, orthonormal: `(size, count)`."""
    waves = np.cos(np.pi * (np.arange(size)[:, None] + 0.5) * np.arange(min(count, size)) / size)
    return jnp.asarray(waves / np.linalg.norm(waves, axis=0), dtype)


def _binned(light, imager, grid):
    """Pixels summed to squares that are at most as wide as a voxel's image, and divide the sensor."""
    sensor = imager.sensor
    wanted = float(imager.magnification(grid.depths).mean()) * grid.pitch / sensor.pixel_pitch
    common = math.gcd(*sensor.shape)
    # Two pixels each way must be left.
    fits = lambda n: common % n == 0 and n <= wanted + _ROUNDING and min(sensor.shape) >= 2 * n
    side = max((n for n in range(1, math.ceil(wanted) + 1) if fits(n)), default=1)
    rows, columns = (n // side for n in sensor.shape)
    light = light.reshape(rows, side, columns, side).sum((1, 3))
    coarse = Sensor((rows, columns), side * sensor.pixel_pitch, sensor.origin)
    return light, eqx.tree_at(lambda i: i.sensor, imager, coarse)


def _back_projected(image, imager, grid, method, progress):
    options = {"method": method.interpolation, "normalize": method.normalize}
    if grid.depths.size <= _PLANES:
        return np.asarray(backproject(image, imager, grid, **options), np.float32)
    image, depths = jnp.asarray(image), np.asarray(grid.depths)
    volume = np.empty(grid.volume_shape, np.float32)
    for first in progress.track(range(0, depths.size, _PLANES), "Back-projecting", quarter=_wider(grid)):
        some = slice(first, first + _PLANES)
        volume[some] = backproject(image, imager, grid.at(depths[some]), **options)
    return volume


def _wider(grid):
    """Voxels that there are a fourth of: so are the pixels that iterative methods look at, and the time."""
    return f"--voxel-um {2000 * grid.pitch:.4g}"


def iterated(solver, progress, light, system, enough=0.0):
    """What a solver makes of an image, step by step; `system` is a module whose `operator` it inverts."""
    # How many steps and until when is decided here: other numbers need no other code.
    compiled = dataclasses.replace(solver, steps=1, tolerance=0.0)
    state = _start(compiled, light, system)
    quarter = _wider(system.grid) if isinstance(system, System) else ""
    with progress.counter("Iterating", solver.steps, quarter=quarter) as advance:
        for _ in range(solver.steps):
            state, cost, residual = _step(state, compiled, light, system)
            # To read the numbers waits for the step: what is shown has been done, and Ctrl-C ends it here.
            if float(residual) < solver.tolerance or float(cost) < enough:
                break
            advance()
    return np.asarray(solver.estimate(state), np.float32)


@jax.jit
def _start(solver, light, system):
    return solver.init(system.operator, light)


@partial(jax.jit, donate_argnums=0)
def _step(state, solver, light, system):
    return solver.step(system.operator, light, state)
