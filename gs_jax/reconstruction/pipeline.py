"""Reconstruction of a volume from a capture by any method, and the table of methods."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from ..base.arrays import array_namespace, check_finite, check_real, divide, host_code, is_traced, native
from ..base.errors import InputError, short_repr
from ..base.machine import available_memory
from ..base.progress import Progress
from ..base.typing import Image, Volume
from ..microscope.geometry import Imager, check_beyond
from ..microscope.grid import Grid
from ..optics.psf_core import warn_if_blurred
from ..projection.backprojection import backproject, backproject_on_all_devices
from ..projection.forward_model import FIDELITIES, Optics, check_optics
from ..solvers.admm import ADMM
from ..solvers.base import (
    Operator,
    Solver,
    check_solver,
    estimate_of,
    refine_state,
    run_solver,
    start_solver,
    take_step,
)
from ..solvers.fista import FISTA
from ..solvers.richardson_lucy import BACKGROUND_KNOTS, RichardsonLucy, State as LucyState
from ..solvers.surface import Surface
from ..solvers.unrolled import Unrolled
from .inverse_problem import (
    InverseProblem,
    LensTypeGeometry,
    discrepancy_target,
    held_out_squares,
    lens_type_geometries,
    prepare_data,
    prepare_model,
    refinement,
    sum_pixels,
    wider_problems,
)

# Planes that each device back-projects between two updates of the progress bar.
_PLANES = 16
# Default voxel of an iterative method, in pixels seen at the middle depth.
PIXELS_PER_VOXEL = 4
# The noise's share of the cost is known to a few percent.
DISCREPANCY_FACTOR = 1.1


class BackProjection(eqx.Module):
    """Back-projection, the paper's reconstruction: one pass, no PSF.

    *Host.*

    Parameters
    ----------
    interpolation
        Between pixels, `"linear"` or `"nearest"` (the paper's).
    normalize
        Divide by the summed weights, so that a uniform image gives a uniform volume.

    Raises
    ------
    InputError
        If `interpolation` is neither.

    Examples
    --------
    >>> volume = gs.reconstruct(np.ones((200, 200)), scope, grid, gs.BackProjection(normalize=True))
    >>> print(round(float(volume[1, 20, 20]), 3))
    1.0
    """

    interpolation: str = eqx.field(static=True, default="linear")
    normalize: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if self.interpolation not in ("linear", "nearest"):
            raise InputError(f"interpolation must be 'linear' or 'nearest', got {self.interpolation!r}.")


class PinholeRichardsonLucy(RichardsonLucy):
    """Richardson-Lucy with the pinhole back-projection in place of the adjoint.

    *Host.*

    Each voxel is multiplied by the mean ratio of the measured to the expected image over the pixels that
    back-projection reads: `backproject(ratio, ..., normalize=True)`. The expected image is the forward model's. Without
    a PSF this is `RichardsonLucy` with the ray operator; with one, the back-projection is sharper than the adjoint, and
    fewer steps suffice. Parameters and errors are those of `RichardsonLucy`.

    Examples
    --------
    >>> volume = gs.reconstruct(image, scope, grid, gs.PinholeRichardsonLucy(steps=3), optics="near")
    >>> print(volume.argmax() == np.ravel_multi_index((1, 19, 22), volume.shape))
    True
    """

    refined = RichardsonLucy.refined

    def init(self, A: Operator, image: Num[Array | np.ndarray, "..."]) -> LucyState:
        if not getattr(A, "back_projections", None):
            raise InputError(f"PinholeRichardsonLucy() must be used with reconstruct, got a {type(A).__name__}.")
        return super().init(A, image)


# Near the edge of the field one lens sees a voxel, in its middle a dozen.
_LUCY = {"accelerate": True, "background_knots": BACKGROUND_KNOTS, "min_sensitivity": 0.3, "sieve": (0.0, 1.4)}
# Steps between two looks at pixels that are held out, the share of the misfit by which they must gain, and by which
# that of a wider sieve may be larger, above the noise: volumes show the noise that it takes away before images do.
# Ray-traced dense volumes, texture and sheets had 0 to 5 %, words 14 %, points 50 %, and 11 % in the dark.
_ROUND, _GAIN, _SLACK = 10, 1e-3, 0.08

Method = BackProjection | Solver

# Methods by the names of the command line and the benchmark, as functions of the number of steps. Those that are not in
# `STEPPED` take none: the unrolled solver has as many as were trained, and sheets as many as they need.
STEPPED = ("list-rl", "richardson-lucy", "fista", "admm")
METHODS: dict[str, Callable[[int], Method]] = {
    "backproject": lambda steps: BackProjection(),
    "list-rl": lambda steps: PinholeRichardsonLucy(steps, **_LUCY),
    "richardson-lucy": lambda steps: RichardsonLucy(steps, **_LUCY),
    "fista": FISTA,
    "admm": ADMM,
    "unrolled": lambda steps: Unrolled.pretrained(),
    "surface": lambda steps: Surface(),
}


def method_by_name(
    methods: dict[str, Callable[[int], Any]], name: str, steps: int, options: dict[str, float | None]
) -> Any:
    """The method of a name with the options that are not None; `InputError` if it lacks one."""
    method, given = methods[name](steps), {option: value for option, value in options.items() if value is not None}
    for option in given:
        if not hasattr(method, option):
            allowed = ", ".join(other for other, make in methods.items() if hasattr(make(1), option))
            raise InputError(f"--{option.replace('_', '-')} must be used with {allowed}, got --method {name}.")
    return dataclasses.replace(method, **given)


def check_stop(method: Method, stop_at_discrepancy: bool) -> None:
    """Raise `InputError` if a method cannot stop at the noise: it has no steps, or steps that belong together."""
    if stop_at_discrepancy and isinstance(method, BackProjection | Unrolled | Surface):
        allowed = "RichardsonLucy(), PinholeRichardsonLucy(), FISTA() or ADMM()"
        raise InputError(f"stop_at_discrepancy must be used with {allowed}, got {type(method).__name__}().")


def voxel_grid(
    imager: Imager, depths: list[float], pitch: float | None = None, *, pixels: int = 1, in_tiles: bool = False
) -> Grid:
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
    in_tiles
        Whether the volume is computed in tiles, so that its size does not matter.

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
    if not in_tiles and 2.5 * size > (memory := available_memory()):
        shape = " x ".join(map(str, (len(depths), *grid.shape)))
        raise InputError(
            f"--voxel-um, --depths: the volume must take at most {memory / 2.5 / 2**30:.3g} GiB of the free memory, "
            f"got {shape} voxels of {pitch * 1000:g} um, {size / 2**30:.3g} GiB; --tiles auto takes any volume."
        )
    return grid


@host_code("use `Reconstructor`, `solve` or `backproject`")
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
    step by step and can be interrupted after each; a second call with the same shapes compiles nothing. Solvers that
    can (`gs_jax.solvers.base.Refinement`) begin with wider voxels and pixels, if the grid has 96 voxels a side.

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
    >>> volume = gs.reconstruct(image, scope, grid)
    >>> better = gs.reconstruct(image, scope, grid, gs.RichardsonLucy(steps=5), optics="near")
    >>> volume.shape
    (3, 41, 41)
    >>> peak = np.array(np.unravel_index(better.argmax(), better.shape))
    >>> print(grid.to_mm(peak).round(6))  # the point's position, mm
    [ 0.2 -0.1 20. ]
    """
    check_call(image, imager, method, optics)
    options = {"stop_at_discrepancy": stop_at_discrepancy, "progress": progress}
    return Reconstructor(imager, grid, method, optics, **options)(image, progress)


class State(NamedTuple):
    """State of a `Reconstructor`: light to explain, of which `background` comes from no voxel, and of the solver.

    `sieve` is that of Richardson-Lucy. No step is taken after one that starts below the `target` cost. `cost` and
    `residual` are of the last step.
    """

    light: Num[Array | np.ndarray, "row column"]
    background: Any = 0.0
    target: Any = 0.0
    sieve: Any = None
    solver: Any = None
    cost: Any = np.inf
    residual: Any = np.inf


class Reconstructor(eqx.Module):
    """What all images of a microscope share for `reconstruct`: the optics and the method.

    *Differentiable.*

    `reconstructor(image, progress)` is the volume, as `reconstruct` returns it. Its parts work under `jit`, `vmap` and,
    as far as the method is differentiable, `grad`: `finish(step(init(image)))` is the volume after one step.
    `equinox.filter_jit(reconstructor.step)` takes the tables as arguments; `jax.jit` would make constants of them.

    Parameters
    ----------
    imager, grid, method, optics, stop_at_discrepancy, progress
        As for `reconstruct`.
    wide
        Whether `solve` may begin on wide voxels; False spares their tables.

    Raises
    ------
    InputError
        As for `reconstruct`. An `InputWarning` says if back-projections are used where the microscope is out of focus.

    Examples
    --------
    >>> import jax
    >>> lucy = gs.Reconstructor(scope, grid, gs.RichardsonLucy(), optics="near")
    >>> volumes = jax.vmap(lambda image: lucy.finish(lucy.step(lucy.init(image))))(np.stack([image, 2 * image]))
    >>> volumes.shape
    (2, 3, 41, 41)
    """

    method: Method
    problem: InverseProblem
    image_shape: tuple[int, int] = eqx.field(static=True)
    stop_at_discrepancy: bool = eqx.field(static=True)
    wider: tuple[InverseProblem, ...] = ()

    def __init__(
        self,
        imager: Imager,
        grid: Grid,
        method: Method = BackProjection(),
        optics: Optics | str = "full",
        *,
        stop_at_discrepancy: bool = False,
        wide: bool = True,
        progress: Progress | None = None,
    ):
        _check(method, optics)
        check_stop(method, stop_at_discrepancy)
        depths, by_name = np.asarray(grid.depths), isinstance(optics, str)
        if not by_name:
            check_optics(optics, imager, grid)
        check_beyond(imager, depths, "grid: depths")
        if isinstance(method, Surface) and not (np.diff(depths) > 0).all():
            raise InputError(f"grid: depths must ascend with Surface(), got {short_repr(depths.tolist())}.")
        self.method, self.image_shape, self.stop_at_discrepancy = method, imager.sensor.shape, stop_at_discrepancy
        views = None
        if isinstance(method, BackProjection | PinholeRichardsonLucy | Unrolled):
            views = _views(imager, grid, optics)
        if isinstance(method, BackProjection):
            self.problem = InverseProblem(imager, grid, None, views)
            return
        problem = prepare_model(imager, grid, optics, progress or Progress())
        if views and by_name:
            what = "the pixels that back-projection reads"
            warn_if_blurred(imager, grid, what, "expect little or nothing, RichardsonLucy() explains blurred spots")
        modes = 0 if isinstance(method, RichardsonLucy | Surface) else problem.detrend_modes
        self.problem = dataclasses.replace(problem, back_projections=views, detrend_modes=modes)
        if wide and isinstance(optics, str) and _begins_wide(method):
            self.wider = tuple(wider_problems(self.problem, imager, optics, progress or Progress()))

    def init(self, image: Image, start: Any = None) -> State:
        """State before the first step; or that of the solver, if given, which `run` overwrites."""
        state = self._state_of_image(image)._replace(solver=start)
        if start is not None or isinstance(self.method, BackProjection):
            return state
        return state._replace(solver=start_solver(self._solver(state), state.light, self.problem))

    def _state_of_image(self, image: Image, side: int = 1) -> State:
        """State without that of the solver; pixels are `side` times as wide as those that show the background."""
        _check_image(image, self.image_shape)
        if isinstance(self.method, BackProjection):
            check_finite("image", image)
            return State(image)
        light, background = prepare_data(image, self.problem, side)
        target, counts = 0.0, isinstance(self.method, RichardsonLucy)
        if self.stop_at_discrepancy:
            if is_traced(image):
                raise InputError("stop_at_discrepancy must not be used with an image that JAX traces.")
            target = DISCREPANCY_FACTOR * discrepancy_target(np.asarray(image), light, counts=counts)
        if isinstance(self.method, RichardsonLucy):
            background = self.method.background + jnp.asarray(background, light.dtype)
        else:
            light, background = light - background, 0.0
            if not isinstance(self.method, Unrolled | Surface):
                light = self.problem.detrend(light)
        if (kept := self.problem.kept) is not None:
            light, target = kept * light, target * kept.mean()
        sieve = getattr(self.method, "sieve", None)
        sieve = jnp.asarray(sieve[0], light.dtype) if isinstance(sieve, tuple) else sieve
        return State(jnp.asarray(light), background, target, sieve)

    def step(self, state: State) -> State:
        """Take one step; back-projection has none."""
        if isinstance(self.method, BackProjection):
            return state
        solver, cost, residual = take_step(state.solver, self._solver(state), state.light, self.problem)
        return state._replace(solver=solver, cost=cost, residual=residual)

    def finish(self, state: State, progress: Progress | None = None) -> Any:
        """The volume of a state."""
        if isinstance(self.method, BackProjection):
            return self._backproject(self.method, state.light, progress or Progress())
        return estimate_of(self._solver(state), state.solver)

    def run(self, state: State, progress: Progress) -> State:
        """Take all steps, or until the method converges or meets the target; overwrites the state of the solver."""
        if isinstance(self.method, BackProjection):
            return state
        options = {"target": float(state.target), "state": state.solver, "quarter": _wider_voxels(self.problem.grid)}
        run = run_solver(self._solver(state), state.light, self.problem, progress, **options)
        return state._replace(solver=run.state, cost=run.cost, residual=run.residual)

    def solve(self, image: Image, progress: Progress) -> State:
        """State after all steps, on wide voxels, which find depth fast, if the grid has enough, and on its own."""
        method: Any = self.method
        stages = method.stages(len(self.wider)) if self.wider else []
        if not stages:
            return self.run(self.init(image), progress)
        before: tuple[Any, Any] = (None, None)
        state: Any = None
        for problem, solver in zip((*self.wider, self.problem), stages, strict=True):
            side = problem.binning // self.problem.binning
            if isinstance(solver, RichardsonLucy):
                solver = dataclasses.replace(solver, background=_of_wide_pixels(solver.background, side))
            level = eqx.tree_at(lambda r: (r.problem, r.method, r.wider), self, (problem, solver, ()))
            start = level._state_of_image(image, side)
            if isinstance(method, RichardsonLucy) and problem is self.wider[-1]:
                state = level._by_held_out(image, start, before, progress)
            else:
                if problem is self.problem:
                    # The one that was chosen, in narrow voxels.
                    start = start._replace(sieve=jax.tree.map(lambda sieve: 2 * sieve, state.sieve))
                state = level.run(level._begun(start, before), progress)
            before = state, problem
        return state

    def _begun(self, start: State, before: tuple[Any, Any]) -> State:
        """State before the first step, from that on wider voxels and their problem, if there is one."""
        (state, wide), shared = before, (self._solver(start), start.light, self.problem)
        if state is None:
            return start._replace(solver=start_solver(*shared))
        return start._replace(solver=refine_state(state.solver, *shared, refinement(wide, self.problem)))

    def _by_held_out(self, image: Image, start: State, before: tuple[Any, Any], progress: Progress) -> State:
        """State after steps, which end where they predict squares of pixels no better that are held out.

        Of several sieves, the last is taken that predicts them about as well as any after the first steps: but for what
        noise alone leaves, which is nearly all in dim captures.
        """
        method: Any = self.method
        kept, steps = self.problem.kept, method.steps
        squares = held_out_squares(start.light.shape).astype(start.light.dtype)
        used, left_out = (part if kept is None else kept * part for part in (squares, 1 - squares))
        unseen = dataclasses.replace(self.problem, kept=left_out)
        level = eqx.tree_at(lambda r: r.problem.kept, self, used, is_leaf=lambda leaf: leaf is None)
        seen = start._replace(light=used * start.light, target=start.target * squares.mean())

        def advanced(state, count):
            state = level.by(dataclasses.replace(method, steps=count)).run(state, progress)
            return float(_misfit(level._solver(state), unseen, start.light, state.solver)), state

        sieves = [seen.sieve]
        if isinstance(method.sieve, tuple):
            sieves = [jnp.asarray(sieve, start.light.dtype) for sieve in method.sieve]
        if not left_out.any():
            sieves = sieves[:1]
        ways = [advanced(level._begun(seen._replace(sieve=s), before), min(_ROUND, steps)) for s in sieves]
        error, state = ways[0]
        if len(ways) > 1:
            best = min(error for error, _ in ways)
            noise = left_out.mean() * discrepancy_target(np.asarray(image), np.asarray(start.light), counts=True)
            allowed = best + _SLACK * max(best - noise, 0)
            error, state = ([way for way in ways if way[0] <= allowed] or ways[:1])[-1]
        for taken in range(_ROUND, steps, _ROUND):
            if state.cost < state.target or state.residual < method.tolerance:
                break
            last, (error, state) = error, advanced(state, min(_ROUND, steps - taken))
            if left_out.any() and error >= (1 - _GAIN) * last:
                break
        return state

    def __call__(self, image: Image, progress: Progress | None = None) -> Volume:
        progress = progress or Progress()
        return np.asarray(self.finish(self.solve(image, progress), progress), np.float32)

    def keeping(self, kept: Float[Array | np.ndarray, "row column"]) -> "Reconstructor":
        """The same for some pixels of the model: 1 for those that are explained, and 0 for those that are left out.

        Wide pixels are explained where all of theirs are.
        """
        masks = [kept]
        for problem in self.wider:
            side = problem.binning // self.problem.binning
            masks.append((sum_pixels(kept, side) == side**2).astype(kept.dtype))
        # Equinox takes an empty tuple for a leaf.
        where = lambda r: tuple(problem.kept for problem in (r.problem, *(r.wider if self.wider else ())))
        return eqx.tree_at(where, self, tuple(masks), is_leaf=lambda leaf: leaf is None)

    def by(self, method: Method) -> "Reconstructor":
        """The same by a method of the same class, with other options."""
        return eqx.tree_at(lambda r: r.method, self, method)

    def _solver(self, state: State) -> Any:
        method = self.method
        if isinstance(method, RichardsonLucy):
            return dataclasses.replace(method, background=state.background, sieve=state.sieve)
        return method

    def _backproject(self, method: BackProjection, image, progress):
        """Sum the back-projections of all types of lenses, weighted; of kept pixels, in place of all."""
        views, kept = self.problem.back_projections or (), self.problem.kept

        def total(image, normalize) -> Any:
            options = self.problem.grid, method.interpolation, normalize and len(views) == 1, progress
            volume: Any = 0
            for view in views:
                part = _backproject(image, view, *options)
                volume = part if view.weight is None else volume + view.weight.astype(part.dtype) * part
            if normalize and len(views) > 1:
                volume = _quotient(volume, total(np.ones(image.shape, volume.dtype), False))
            return volume

        if kept is None:
            return total(image, method.normalize)
        # Squares of pixels, and those that fill none.
        xp, side = array_namespace(kept), image.shape[0] // kept.shape[0]
        kept = xp.repeat(xp.repeat(kept, side, 0), side, 1)
        kept = xp.pad(kept, [(0, n - m) for n, m in zip(image.shape, kept.shape, strict=True)], mode="edge")
        return _quotient(total(kept * image, method.normalize), total(kept, True))


def _begins_wide(method: Any) -> bool:
    """Whether a solver can begin on wide voxels: not if it has `init` or `step` of its own and inherits the rest."""
    classes = type(method).__mro__
    place = {name: [name in vars(one) for one in classes].index(True) for name in ("init", "step")}
    return next((n for n, one in enumerate(classes) if "refined" in vars(one)), len(classes)) <= min(place.values())


def _of_wide_pixels(background, side: int):
    """Light of pixels that are `side` times as wide, a number or an image."""
    return sum_pixels(background, side) if np.ndim(background) == 2 else side**2 * background


def _views(imager, grid, optics) -> tuple[LensTypeGeometry, ...]:
    """Geometries for back-projection: along the cores of spots with optics by name that have them, or chief rays."""
    on_cores = isinstance(optics, str) and optics != "pinhole"
    return lens_type_geometries(imager, grid) if on_cores else (LensTypeGeometry(imager),)


def check_call(image: Image, imager: Imager, method: Method, optics: Optics | str) -> None:
    """Raise the errors of `reconstruct` that need no computation."""
    _check_image(image, imager.sensor.shape)
    _check(method, optics)


def _check_image(image, shape):
    if image.shape != shape:
        raise InputError(f"image must have the sensor's shape {shape}, got {image.shape}.")
    check_real("image", image)


def _check(method, optics):
    if not isinstance(method, BackProjection):
        check_solver("method", method)
    if isinstance(optics, str) and optics not in FIDELITIES:
        raise InputError(f"optics must be one of {', '.join(FIDELITIES)}, got {short_repr(optics)}.")


_quotient = jax.jit(divide)


@jax.jit
def _misfit(solver, A, image, state):
    return solver.misfit(A, image, state)


def _backproject(image, view, grid, interpolation, normalize, progress):
    options = {"method": interpolation, "normalize": normalize}
    distortion = np.ones(grid.depths.size) if view.distortion is None else view.distortion
    if is_traced((image, view, grid)):
        return backproject(image, view.imager, grid, distortion=distortion, **options)
    planes = _PLANES * (devices := jax.local_device_count())
    project = backproject if devices == 1 else backproject_on_all_devices
    if grid.depths.size <= planes:
        return np.asarray(project(image, view.imager, grid, distortion=distortion, **options), np.float32)
    image, depths = jnp.asarray(native(image)), np.asarray(grid.depths)
    volume = np.empty(grid.volume_shape, np.float32)
    for first in progress.track(range(0, depths.size, planes), "Back-projecting", quarter=_wider_voxels(grid)):
        part = slice(first, first + planes)
        volume[part] = project(image, view.imager, grid.at(depths[part]), distortion=distortion[part], **options)
    return volume


def _wider_voxels(grid):
    """The option that takes a quarter of the time: a fourth of the voxels, and of the pixels of iterative methods."""
    return f"--voxel-um {2000 * grid.pitch:.4g}"
