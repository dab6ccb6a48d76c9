"""From a capture to a volume, whatever the method."""

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float

from ..base.arrays import check_finite
from ..base.errors import InputError, short_repr
from ..base.machine import available_memory
from ..base.progress import Progress
from ..geometry import Imager
from ..grid import Grid
from ..optics.lens_types import warn_if_blurred
from ..projection.backprojection import backproject
from ..projection.forward_model import Optics
from ..projection.levels import LEVELS
from ..solvers.base import Solver
from ..solvers.richardson_lucy import RichardsonLucy
from ..solvers.unrolled import Unrolled
from ..typing import Image, Volume
from .inverse_problem import Sight, System, explainable, model_of, sights_of, slow_waves
from .methods import BackProjection, ListRichardsonLucy, Method
from .residual import misfit_of_noise

# Planes of a device between two steps of the progress bar; a plane more or less changes neither speed nor memory.
_PLANES = 16
# Of the default voxel of an iterative method, which is as wide as so many pixels.
COARSE = 4
# In units of the misfit of noise, which is known to a few percent.
_ENOUGH = 1.1


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
    image: Image,
    imager: Imager,
    grid: Grid,
    method: Method = BackProjection(),
    *,
    optics: Optics | str = "full",
    stop_at_noise: bool = False,
    progress: Progress | None = None,
) -> Volume:
    """The volume that an image shows.

    *Host.*

    Back-projection takes the image as it is, some planes at a time, on all devices there are. The other methods explain
    the light above the camera's offset: the image's darkest percent, or nothing if that is negative, as it was taken
    off already. They run step by step, and can be interrupted after each; the second call with the same shapes compiles
    nothing.

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
        If `method` is no method, the image is not `sensor.shape` or not finite, there is no such optics, a depth of the
        grid is blurred over more than 128 pixels ("near"), or JAX traces a value: `solve` is what can be differentiated
        and compiled.

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> import numpy as np
    >>> point = np.array([[0.2, -0.1, 20.0, 1.0]])  # x, y, z in mm, and its light
    >>> image = gs.simulate(point, scope, optics="near", psf="geometric")
    >>> volume = gs.reconstruct(image, scope, grid)
    >>> better = gs.reconstruct(image, scope, grid, gs.RichardsonLucy(steps=5), optics="near")
    >>> volume.shape
    (3, 41, 41)
    >>> peak = np.array(np.unravel_index(better.argmax(), better.shape))
    >>> print(grid.to_mm(peak).round(6))  # the point's place, mm
    [ 0.2 -0.1 20. ]
    """
    if image.shape != imager.sensor.shape:
        raise InputError(f"image: found the shape {image.shape}, allowed: the sensor's shape {imager.sensor.shape}.")
    _check(method, optics, imager, grid, image)
    progress = progress or Progress()
    volume_of = reconstructor(imager, grid, method, optics=optics, stop_at_noise=stop_at_noise, progress=progress)
    return volume_of(image, progress)


def reconstructor(
    imager: Imager,
    grid: Grid,
    method: Method = BackProjection(),
    *,
    optics: Optics | str = "full",
    stop_at_noise: bool = False,
    progress: Progress | None = None,
) -> Callable[[Image, Progress], Volume]:
    """`reconstruct` for many images: what is the same for all is computed here, once.

    Parameters
    ----------
    imager, grid, method, optics, stop_at_noise, progress
        As for `reconstruct`.

    Returns
    -------
    Callable
        From an image of `sensor.shape`, and what shows how far it is, to the volume. Images of one type: of another
        it compiles again.

    Raises
    ------
    InputError
        If `method` is no method, there is no such optics, or a depth is blurred over more than 128 pixels ("near").

    Warns
    -----
    InputWarning
        If `ListRichardsonLucy` or `Unrolled` is asked for where the microscope is out of focus.
    """
    by_name = isinstance(optics, str)
    _check(method, optics, imager, grid)
    on_cores = by_name and optics != "pinhole"
    # Of these, back-projection stands for the adjoint.
    unmatched = isinstance(method, ListRichardsonLucy | Unrolled)
    if isinstance(method, BackProjection):
        return _back_projector(sights_of(imager, grid) if on_cores else (Sight(imager, grid),), method)
    model = model_of(imager, grid, optics, progress or Progress())
    if unmatched and by_name:
        what = "the pixels that back-projection reads"
        warn_if_blurred(imager, grid, what, "expect little or nothing, RichardsonLucy() explains blurred spots")
    least_squares = not isinstance(method, ListRichardsonLucy | RichardsonLucy)
    slow = slow_waves(model.imager, model.optics) if by_name and least_squares else 0
    seen = None
    if unmatched:
        seen = sights_of(imager, grid) if on_cores else (Sight(imager, grid),)
    system = System(model.imager, grid, model.optics, seen, slow)
    return lambda image, progress: _explained(image, model, system, method, stop_at_noise, progress)


def _check(method, optics, *given):
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((method, optics, given))):
        allowed = "numbers; `solve` and `backproject` can be compiled and differentiated"
        raise InputError(f"reconstruct: found a value that JAX traces (jit, grad or vmap), allowed: {allowed}.")
    # A class has what the protocol asks for, too.
    if isinstance(method, type) or not isinstance(method, BackProjection | ListRichardsonLucy | Solver):
        raise InputError(f"method: found {short_repr(method)}, allowed: an object such as BackProjection() or FISTA().")
    if isinstance(optics, str) and optics not in LEVELS:
        raise InputError(f"optics: found {short_repr(optics)}, allowed: {', '.join(LEVELS)}.")


def _explained(image, model, system, method, stop_at_noise, progress):
    light, background = explainable(image, model)
    counts = isinstance(method, ListRichardsonLucy | RichardsonLucy)
    enough = _ENOUGH * misfit_of_noise(np.asarray(image), light, counts=counts) if stop_at_noise else 0.0
    if isinstance(method, ListRichardsonLucy):
        return iterated(method.solver(background), progress, light, system, enough)
    if isinstance(method, RichardsonLucy):
        method = dataclasses.replace(method, background=method.background + jnp.asarray(background))
        return iterated(method, progress, light, system, enough)
    light = light - background
    if isinstance(method, Unrolled):
        # Its steps were trained together.
        return iterated(method, progress, light, system)
    return iterated(method, progress, np.asarray(system.fast(light), light.dtype), system, enough)


def _back_projector(seen, method):
    """Each type of lens is read where its own cores land."""
    if len(seen) == 1:
        return lambda image, progress: _back_projected(image, seen[0].imager, seen[0].grid, method, progress)
    plain = dataclasses.replace(method, normalize=False)

    def volume_of(image, progress):
        each = lambda image, one: one.weight * _back_projected(image, one.imager, one.grid, plain, progress)
        total = lambda image: sum(each(image, one) for one in seen)
        volume = np.asarray(total(image), np.float32)
        if not method.normalize:
            return volume
        light = total(np.ones_like(image, np.float32))
        return np.divide(volume, light, out=np.zeros_like(volume), where=light > 0)

    return volume_of


def _back_projected(image, imager, grid, method, progress):
    check_finite("image", image)
    options = {"method": method.interpolation, "normalize": method.normalize}
    planes = _PLANES * (devices := jax.local_device_count())
    project = backproject if devices == 1 else backproject_by_all
    if grid.depths.size <= planes:
        return np.asarray(project(image, imager, grid, **options), np.float32)
    image, depths = jnp.asarray(image), np.asarray(grid.depths)
    volume = np.empty(grid.volume_shape, np.float32)
    for first in progress.track(range(0, depths.size, planes), "Back-projecting", quarter=_wider(grid)):
        some = slice(first, first + planes)
        volume[some] = project(image, imager, grid.at(depths[some]), **options)
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


def backproject_by_all(image: Image, imager: Imager, grid: Grid, **options) -> Float[Array, "depth y x"]:
    """As `backproject`, whose arguments it takes; no device does more than one depth more than another."""
    count = grid.depths.size
    last = jnp.full(-count % jax.local_device_count(), grid.depths[-1])
    return _shared(image, imager, grid, jnp.concatenate([grid.depths, last]), **options)[:count]


@partial(jax.jit, static_argnames=("method", "normalize"))
def _shared(image, imager, grid, depths, **options):
    mesh, alike = Mesh(np.array(jax.local_devices()), ("depth",)), PartitionSpec()
    some = PartitionSpec("depth")
    part = lambda image, imager, grid, depths: backproject(image, imager, grid.at(depths), **options)
    # The kernels do not say which of their results differ from device to device.
    shared = jax.shard_map(part, mesh=mesh, in_specs=(alike, alike, alike, some), out_specs=some, check_vma=False)
    return shared(image, imager, grid, depths)
