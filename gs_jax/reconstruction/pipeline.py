"""Reconstruction of a volume from a capture, by any method."""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float

from ..base.arrays import check_finite, host_code, jit, native
from ..base.errors import InputError, short_repr
from ..base.machine import available_memory
from ..base.progress import Progress
from ..geometry import Imager, check_beyond
from ..grid import Grid
from ..optics.lens_types import warn_if_blurred
from ..projection.backprojection import backproject
from ..projection.forward_model import FIDELITIES, Optics
from ..solvers.base import Solver
from ..solvers.richardson_lucy import RichardsonLucy
from ..solvers.surface import Surface
from ..solvers.unrolled import Unrolled
from ..typing import Image, Volume
from .inverse_problem import (
    InverseProblem,
    LensTypeGeometry,
    lens_type_geometries,
    num_detrend_modes,
    prepare_data,
    prepare_model,
)
from .methods import BackProjection, Method, PinholeRichardsonLucy, check_stop
from .residual import discrepancy_target

# Planes that each device back-projects between two updates of the progress bar.
_PLANES = 16
# Default voxel of an iterative method, in pixels seen at the middle depth.
PIXELS_PER_VOXEL = 4
# The noise's share of the cost is known to a few percent.
DISCREPANCY_FACTOR = 1.1


def voxel_grid(imager: Imager, depths: list[float], pitch: float | None = None, *, pixels: int = 1) -> Grid:
    """Grid of the field of view, as large as the sensor.

    Parameters
    ----------
    imager
        Microscope that took the capture.
    depths
        In mm.
    pitch
        Lateral voxel pitch, mm; by default `pixels` as seen at the middle depth, rounded to 0.1 um, at least 0.1 um.
    pixels
        Pixels per voxel of the default pitch.

    Raises
    ------
    InputError
        If the volume would not fit into memory.
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
            f"--voxel-um, --depths: the volume must take at most {memory / 2.5 / 2**30:.3g} GiB of the free memory, "
            f"got {shape} voxels of {pitch * 1000:g} um, {size / 2**30:.3g} GiB."
        )
    return grid


@host_code("use `solve` or `backproject`")
def reconstruct(
    image: Image,
    imager: Imager,
    grid: Grid,
    method: Method = BackProjection(),
    *,
    optics: Optics | str = "full",
    stop_at_discrepancy: bool = False,
    progress: Progress | None = None,
) -> Volume:
    """Reconstruct the volume that an image shows.

    *Host.*

    Back-projection uses the image as it is, some planes at a time, on all devices. The other methods subtract the
    camera's offset, the image's first percentile (unless it is negative, because it was subtracted before). They run
    step by step and can be interrupted after each; a second call with the same shapes compiles nothing.

    With optics by name, iterative methods bin pixels to about the width of voxels, and light that the optics lack is
    fitted as background, not by voxels. With "full" that is smooth: FISTA and ADMM leave out the image's lowest cosine
    modes. With "near" and "pinhole" it is most of the light: the level of squares of 32 pixels.

    Parameters
    ----------
    image, imager, grid
        As for `backproject`.
    method
        `BackProjection()`, `PinholeRichardsonLucy()`, or a solver: `RichardsonLucy()`, `FISTA()`, `ADMM()`,
        `Unrolled.pretrained()`, `Surface()`.
    optics
        As for `forward`, or a `fidelity` of `psf_model`. With "full" and "near", back-projection reads the bright
        cores of the spots; otherwise it follows the chief rays, as the paper does.
    stop_at_discrepancy
        Stop early where the residual is no larger than the image's noise (Morozov's discrepancy principle). Not with
        `BackProjection`, which has no steps, nor `Unrolled` and `Surface`, whose steps belong together.
    progress
        Shows progress; by default nothing is shown.

    Raises
    ------
    InputError
        If `method` is no method or cannot stop at the discrepancy, the image is not `sensor.shape` or not finite, the
        optics do not exist, a depth of the grid is blurred over more than 128 pixels ("near"), or JAX traces a value:
        `solve` can be differentiated and compiled.

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
    >>> print(grid.to_mm(peak).round(6))  # the point's position, mm
    [ 0.2 -0.1 20. ]
    """
    check_call(image, imager, grid, method, optics)
    progress = progress or Progress()
    options = {"optics": optics, "stop_at_discrepancy": stop_at_discrepancy, "progress": progress}
    return reconstructor(imager, grid, method, **options)(image, progress)


def reconstructor(
    imager: Imager,
    grid: Grid,
    method: Method = BackProjection(),
    *,
    optics: Optics | str = "full",
    stop_at_discrepancy: bool = False,
    progress: Progress | None = None,
    read: Callable[[Any, Any, float], Any] | None = None,
) -> Callable[..., Any]:
    """Prepare `reconstruct` for many images of one type; parameters and errors as there.

    `read` takes a solver, its last state and the cost before the last step, and returns what is returned instead of the
    volume.

    Returns
    -------
    Callable
        Maps an image of `sensor.shape`, a progress display and, if wanted, other options of the method, its state to
        start from, pixels to keep (`kept`: 1, and 0 for those that are left out, in the pixels of `prepare_model`), and
        the cost at which the steps may end (`enough`), to the volume.

    Warns
    -----
    InputWarning
        If `PinholeRichardsonLucy` or `Unrolled` is used where the microscope is out of focus.
    """
    by_name = isinstance(optics, str)
    _check(method, optics)
    check_stop(method, stop_at_discrepancy)
    check_beyond(imager, np.asarray(grid.depths), "grid: depths")
    on_cores = by_name and optics != "pinhole"
    views = lambda: lens_type_geometries(imager, grid) if on_cores else (LensTypeGeometry(imager),)
    if isinstance(method, BackProjection):
        return partial(_backproject_views, views(), grid, method)
    if isinstance(method, Surface) and not (np.diff(np.asarray(grid.depths)) > 0).all():
        raise InputError(
            f"grid: depths must ascend with Surface(), got {short_repr(np.asarray(grid.depths).tolist())}."
        )
    model = prepare_model(imager, grid, optics, progress or Progress())
    replaces_adjoint = isinstance(method, PinholeRichardsonLucy | Unrolled)
    if replaces_adjoint and by_name:
        what = "the pixels that back-projection reads"
        warn_if_blurred(imager, grid, what, "expect little or nothing, RichardsonLucy() explains blurred spots")
    is_poisson = isinstance(method, PinholeRichardsonLucy | RichardsonLucy)
    fits_background = is_poisson or isinstance(method, Surface)
    modes = num_detrend_modes(model.imager, model.optics) if by_name and not fits_background else 0
    problem = InverseProblem(model.imager, grid, model.optics, views() if replaces_adjoint else None, modes)

    def volume_of(image, progress, method=method, start=None, kept=None, enough=0.0):
        light, background = prepare_data(image, model)
        target = enough
        if stop_at_discrepancy:
            noise = discrepancy_target(np.asarray(image), light, counts=is_poisson)
            target = max(enough, DISCREPANCY_FACTOR * noise)
        solver = method
        if isinstance(method, PinholeRichardsonLucy):
            solver = method.solver(background)
        elif isinstance(method, RichardsonLucy):
            solver = dataclasses.replace(method, background=method.background + jnp.asarray(background))
        else:
            light = light - background
            if not isinstance(method, Unrolled | Surface):
                light = np.asarray(problem.detrend(light), light.dtype)
        if kept is None:
            return run_solver(solver, light, problem, progress, target, read, start)
        some = dataclasses.replace(problem, kept=kept)
        return run_solver(solver, kept * light, some, progress, target * kept.mean(), read)

    return volume_of


def check_call(image, imager, grid, method, optics):
    """Raise the errors of `reconstruct` that need no computation."""
    if image.shape != imager.sensor.shape:
        raise InputError(f"image must have the sensor's shape {imager.sensor.shape}, got {image.shape}.")
    _check(method, optics)


def _check(method, optics):
    # A class has the attributes of the protocol, too.
    if isinstance(method, type) or not isinstance(method, BackProjection | PinholeRichardsonLucy | Solver):
        raise InputError(f"method must be an object such as BackProjection() or FISTA(), got {short_repr(method)}.")
    if isinstance(optics, str) and optics not in FIDELITIES:
        raise InputError(f"optics must be one of {', '.join(FIDELITIES)}, got {short_repr(optics)}.")


def _backproject_views(views, grid, method, image, progress, kept=None):
    """Sum the back-projections of all types of lenses, weighted; of kept pixels, in place of all."""
    if kept is not None:
        # Squares of pixels, and those that fill none.
        side = image.shape[0] // kept.shape[0]
        missing = [(0, n - side * m) for n, m in zip(image.shape, kept.shape, strict=True)]
        kept = np.pad(np.repeat(np.repeat(kept, side, 0), side, 1), missing, mode="edge")
        share = _backproject_views(views, grid, dataclasses.replace(method, normalize=True), kept, progress)
        volume = _backproject_views(views, grid, method, kept * image, progress)
        return np.divide(volume, share, out=np.zeros_like(volume), where=share > 0)
    if len(views) == 1:
        return _backproject(image, views[0], grid, method, progress)
    plain = dataclasses.replace(method, normalize=False)
    weighted = lambda image, view: view.weight * _backproject(image, view, grid, plain, progress)
    total = lambda image: sum(weighted(image, view) for view in views)
    volume = np.asarray(total(image), np.float32)
    if not method.normalize:
        return volume
    weights = total(np.ones_like(image, np.float32))
    return np.divide(volume, weights, out=np.zeros_like(volume), where=weights > 0)


def _backproject(image, view, grid, method, progress):
    check_finite("image", image)
    options = {"method": method.interpolation, "normalize": method.normalize}
    planes = _PLANES * (devices := jax.local_device_count())
    project = backproject if devices == 1 else backproject_on_all_devices
    distortion = np.ones(grid.depths.size) if view.distortion is None else view.distortion
    if grid.depths.size <= planes:
        return np.asarray(project(image, view.imager, grid, distortion=distortion, **options), np.float32)
    image, depths = jnp.asarray(native(image)), np.asarray(grid.depths)
    volume = np.empty(grid.volume_shape, np.float32)
    for first in progress.track(range(0, depths.size, planes), "Back-projecting", quarter=_wider_voxels(grid)):
        part = slice(first, first + planes)
        volume[part] = project(image, view.imager, grid.at(depths[part]), distortion=distortion[part], **options)
    return volume


def backproject_on_all_devices(
    image: Image, imager: Imager, grid: Grid, *, distortion: Float[np.ndarray, " depth"] | None = None, **options
) -> Float[Array, "depth y x"]:
    """`backproject` with the depths divided evenly among the devices of this process."""
    distortion = np.ones(grid.depths.size) if distortion is None else distortion
    missing = -grid.depths.size % jax.local_device_count()
    planes = (np.pad(part, (0, missing), mode="edge") for part in (grid.depths, distortion))
    return _backproject_sharded(image, imager, grid, *planes, **options)[: grid.depths.size]


@partial(jit, static_argnames=("method", "normalize"))
def _backproject_sharded(image, imager, grid, depths, distortion, **options):
    mesh, replicated, sharded = Mesh(np.array(jax.local_devices()), ("depth",)), PartitionSpec(), PartitionSpec("depth")

    def project(image, imager, grid, depths, distortion):
        return backproject(image, imager, grid.at(depths), distortion=distortion, **options)

    # The kernels do not declare which results vary between devices.
    specs = {"in_specs": (replicated, replicated, replicated, sharded, sharded), "out_specs": sharded}
    return jax.shard_map(project, mesh=mesh, **specs, check_vma=False)(image, imager, grid, depths, distortion)


def _wider_voxels(grid):
    """The option that takes a quarter of the time: a fourth of the voxels, and of the pixels of iterative methods."""
    return f"--voxel-um {2000 * grid.pitch:.4g}"


def run_solver(solver, light, problem, progress, target_cost=0.0, read=None, start=None, residuals=None):
    """Run a solver on an `InverseProblem` or an operator, step by step, until it converges or meets the target.

    Starts from the state `start`, which it overwrites, if given. Returns the estimate, or what `read` returns. Appends
    the residual of each step to the list `residuals`, if given.
    """
    # Decided here and not in compiled code: another number of steps compiles nothing.
    compiled = dataclasses.replace(solver, steps=1, tolerance=0.0)
    state = _start(compiled, light, problem) if start is None else start
    quarter = _wider_voxels(problem.grid) if isinstance(problem, InverseProblem) else "twice the --binning"
    cost = math.nan
    with progress.counter("Iterating", solver.steps, quarter=quarter) as advance:
        for _ in range(solver.steps):
            state, cost, residual = _step(state, compiled, light, problem)
            if residuals is not None:
                residuals.append(float(residual))
            # Reading the numbers waits for the step: progress is true, and Ctrl-C ends it here.
            if float(residual) < solver.tolerance or float(cost) < target_cost:
                break
            advance()
    if read:
        return read(solver, state, float(cost))
    return np.asarray(solver.estimate(state), np.float32)


@jax.jit
def _start(solver, light, problem):
    return solver.init(_operator(problem), light)


@partial(jax.jit, donate_argnums=0)
def _step(state, solver, light, problem):
    return solver.step(_operator(problem), light, state)


def _operator(problem):
    return problem.operator if isinstance(problem, InverseProblem) else problem
