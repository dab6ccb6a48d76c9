"""Search for a better microscope: by a study, or by a loss of your own.

A study (`gs_jax.codesign.study`) has free parameters, terms with targets, and stages of solvers. The first stage may
start from several points; the best goes on to the next stage. A log of all steps and the solver's state make a
checkpoint. `optimize` takes any loss; studies are this with terms by name.
"""

import contextlib
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from ..base.arrays import host_code
from ..base.errors import InputError, check_kind, errors_name_file, input_error, short_repr
from ..base.progress import Progress
from ..base.workers import Workers
from ..design.conversion import reduced_depth, reduced_sensor_distance, sample_table
from ..design.design import Design, read_design
from ..geometry import Imager
from ..layers import check_room
from ..optics.lens_types import interleave
from ..typing import PathLike
from .parameters import Free, new_design, start_values
from .solve import (
    CONVERGED,
    LBFGSB,
    NOT_FINITE,
    Bounds,
    Box,
    Log,
    Solver,
    State,
    Stepper,
    least_change,
    read_checkpoint,
    run,
    warn_if_moved,
    write_checkpoint,
)
from .stages import make_stage, problem_of, rows_of, run_stages, warn_of_start
from .study import Study, read_study
from .targets import Row
from .traced import Traced

# Seconds between two checkpoints.
_EVERY = 10.0


class Outcome(NamedTuple):
    """Result of a search.

    `parent`, `study`: its inputs. `design`: the new one, with the study's name. `before`, `after`: one row for each
    of the study's terms. `log`: of every start and step. `seconds`: of the search, compilation included.
    """

    parent: Design
    study: Study
    design: Design
    before: list[Row]
    after: list[Row]
    log: Log
    seconds: float


@contextlib.contextmanager
def load(design: Design | PathLike, study: Study | PathLike) -> Iterator[tuple[Design, Study]]:
    """The initial design of a study and the study, read if they are files.

    An `InputError` within names the study's file.
    """
    check_kind("design", design, Design | str | os.PathLike, "a Design or its file")
    check_kind("study", study, Study | str | os.PathLike, "a Study or its file")
    found = design if isinstance(design, Design) else read_design(design)
    if isinstance(study, Study):
        yield initial_design(found, study), study
        return
    question = read_study(study)
    with errors_name_file(study):
        yield initial_design(found, question), question


def run_study(
    design: Design | PathLike,
    study: Study | PathLike,
    *,
    progress: Progress | None = None,
    checkpoint: PathLike | None = None,
    resume: bool = False,
    every: float = _EVERY,
    workers: Workers | None = None,
) -> Outcome:
    """Search for a design that does what a study wants.

    *Host.*

    A search has converged when its solver has, or when the cost has changed by less than a millionth of itself over 20
    steps, in double precision (`jax_enable_x64`). In single precision it stops far from the minimum.

    Parameters
    ----------
    design
        The initial design, or its file.
    study
        The study, or its file. Its own `design` is ignored.
    progress
        Shows progress; silent by default.
    checkpoint
        File for the state; none by default.
    resume
        Continue from that file, with the same result as without the interruption.
    every
        Seconds between two checkpoints.
    workers
        Processes that run the first stage's starts; this one by default. The result is the same.

    Raises
    ------
    InputError
        If a file cannot be read, the study does not fit the design, the checkpoint is missing or another study's, or
        nothing was found; or if there are workers for a study of one start.

    Warns
    -----
    InputWarning
        If a parameter starts at a bound or beyond it, and is moved inside by 1 % of the range.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gs_jax as gs
    >>> _ = Path("study.toml").write_text('''
    ... depths_mm = [18.0, 22.0]
    ... [free]
    ... sensor_distance_mm = [4.0, 8.0]
    ... [[terms]]
    ... name = "focus_offset"
    ... minimise = 1.0
    ... [[stages]]
    ... solver = "levenberg-marquardt"
    ... steps = 20
    ... ''')
    >>> outcome = gs.run_study(gs.geomscope(), "study.toml")
    >>> print(round(outcome.design.imaging.sensor_distance_mm, 1))  # where a thin lens images the middle
    6.0
    """
    with load(design, study) as (parent, question):
        path = None if checkpoint is None else Path(checkpoint)
        return _run_study(parent, question, progress, path, resume, every, workers)


def _run_study(
    design: Design,
    study: Study,
    progress: Progress | None,
    checkpoint: Path | None,
    resume: bool,
    every: float,
    workers: Workers | None,
) -> Outcome:
    if workers and workers.remote and study.starts == 1:
        raise InputError("--workers and --scheduler must be used with a study of several `starts`, got 1.")
    began = time.monotonic()
    log, saved = Log(), None
    if resume and checkpoint:
        log, state = read_checkpoint(checkpoint, study, design)
        saved = (checkpoint, state) if state else None
    problem, each = problem_of(design, study), _Saver(checkpoint, every, log, study, design)
    values = start_values(problem.imager, problem.at)
    warn_of_start(problem, values)
    before = rows_of(problem, study.terms, values)
    # Built when they are needed, so that compilation shows in the progress.
    stages = (make_stage(problem, index) for index in range(len(study.stages)))
    how = {"log": log, "progress": progress, "each": each, "saved": saved, "workers": workers}
    values = run_stages(problem, stages, study.terms, values, **how)
    found = new_design(design, problem.imager, problem.at, values).model_copy(update={"name": study.name})
    written = problem_of(found, study.model_copy(update={"depths_mm": None}))
    after = rows_of(written, study.terms, start_values(written.imager, written.at))
    return Outcome(design, study, found, before, after, log, time.monotonic() - began)


class _Saver:
    """Write a checkpoint after the first step, then at intervals, and after each start that a worker ran."""

    def __init__(self, path: Path | None, every: float, log: Log, study: Study, design: Design):
        self.path, self.every, self.last = path, every, -math.inf
        self.log, self.study, self.design = log, study, design

    def __call__(self, state: State | None) -> None:
        if self.path is not None and (state is None or time.monotonic() - self.last >= self.every):
            write_checkpoint(self.path, self.log, self.study, self.design, state)
            self.last = time.monotonic()


def initial_design(design: Design, study: Study) -> Design:
    """Apply the sample, the orientation and the lens types of a study to a design.

    Raises `InputError` if it has no such sample, or several and none is chosen, its depths are in front of that, its
    lenses have another number of types, or are ideal thin lenses, which have no radii.
    """
    table = sample_table(design, study.sample)
    if study.sample is not None:
        depths = study.depths_mm or design.imaging.working_distance_mm
        design = design.replace(sample=table.model_dump(), working_distance_mm=depths)
    if study.orientation is not None:
        design = design.replace(orientation=study.orientation)
    if study.kinds is None:
        return design
    found = design.imager().array.type_count
    if found == study.kinds:
        return design
    if found > 1:
        raise InputError(f"`kinds` must be {found}, as the design's lens types, or be left out, got {study.kinds}.")
    if design.lens.focal_length_mm is not None:
        raise InputError("`kinds` needs a design without `lens.focal_length_mm`.")
    if study.kinds > (count := len(design.array.centers_mm)):
        raise InputError(f"`kinds` must be at most {count}, the number of lenses, got {study.kinds}.")
    radius = np.ravel(design.lens.radius_of_curvature_mm)[0] * _relative_focal_lengths(design, study, study.kinds)
    which = interleave(np.array(design.array.centers_mm), study.kinds)
    lens = design.lens.model_copy(update={"radius_of_curvature_mm": tuple(radius[which].tolist())})
    return design.model_copy(update={"lens": lens})


def _relative_focal_lengths(design: Design, study: Study, types: int) -> np.ndarray:
    """Focal lengths of thin lenses focused on equal parts of the depths, in vergence, relative to the middle's."""
    near, far = study.depths_mm or design.imaging.working_distance_mm
    ends = 1 / reduced_depth(design, near), 1 / reduced_depth(design, far)
    share = (np.arange(types) + 0.5) / types
    behind = 1 / reduced_sensor_distance(design, design.imaging.sensor_distance_mm)
    return (np.mean(ends) + behind) / (ends[0] + share * (ends[1] - ends[0]) + behind)


class Optimum(NamedTuple):
    """What `gs_jax.optimize` found.

    `imager`: the best. `value`: its loss, of residuals half the sum of their squares. `result`: of
    `optimistix.RESULTS`, whether the solver converged, ran out of steps, or came to what is not finite. `stats`:
    `"num_steps"`, and `"values"`, the loss after each.
    """

    imager: Imager
    value: Float[Array, ""]
    result: optx.RESULTS
    stats: dict[str, Any]


@host_code()
def optimize(
    loss: Callable[[Imager], Float[Array, "..."]],
    imager: Imager,
    *,
    free: Free,
    solver: Solver | None = None,
    bounds: Mapping[str, tuple[Any, Any]] = MappingProxyType({}),
    steps: int = 256,
    callback: Callable[[int, float, Imager], None] | None = None,
) -> Optimum:
    """Search for the imager of the least loss.

    *Host.*

    Parameters
    ----------
    loss
        From an imager to one number, or to an array of residuals, half the sum of whose squares is minimised.
        Traced and differentiated: `gs_jax.objectives` are made for it.
    imager
        To start from. Use double precision (`jax_enable_x64`): single stops far from the minimum.
    free
        What may change, of `gs_jax.free`.
    solver
        Of optimistix, a minimiser, or for residuals one of least squares; of optax; or
        `gs_jax.codesign.solve.LBFGSB()`, which wants bounds for all. By default `optimistix.BFGS`. A search also ends
        when the loss has changed by less than a millionth of itself over 20 steps; with a solver of optax, by less than
        a billionth (1e-5 and 1e-6 in single precision).
    bounds
        Lowest and highest value by name, numbers or arrays. A change of variables keeps them. A start at a bound or
        beyond it is moved inside, by 1 % of the range, with a warning.
    steps
        The most to take.
    callback
        Called after each step with its number, the loss and the imager.

    Raises
    ------
    InputError
        If an argument is of another kind, a bound is of what is not free or is not below the other, `LBFGSB` lacks a
        bound, `loss` is one number and the solver is one of least squares, or layers have no room in the imager found.

    Examples
    --------
    >>> import gs_jax as gs, jax.numpy as jnp
    >>> scope = gs.geomscope().imager()
    >>> loss = lambda scope: (scope.magnification(20.0) - 0.25) ** 2
    >>> found = gs.optimize(loss, scope, free=gs.free("sensor_distance"), bounds={"sensor_distance": (4.0, 8.0)})
    >>> print(round(float(found.imager.magnification(20.0)), 2))
    0.25
    """
    solver = optx.BFGS(least_change(), least_change()) if solver is None else solver
    _check(loss, imager, free, solver, steps)
    maps = {
        name: _map(name, free, bounds, isinstance(solver, LBFGSB)) for name in {**dict.fromkeys(free.names), **bounds}
    }
    values = free.values(imager)
    start = {name: maps[name].free(value) for name, value in values.items()}
    warn_if_moved(values, {name: maps[name].value(free) for name, free in start.items()})
    key = jax.random.key(0)

    def at(moved):
        return free.replaced(imager, {name: maps[name].value(moved[name]) for name in free.names})

    traced = Traced.of(lambda moved, given, key: loss(at(moved)), start, None, key)
    if len(traced.dtypes) != 1 or not jnp.issubdtype(traced.dtypes[0], jnp.floating):
        kinds = ", ".join(str(dtype) for dtype in traced.dtypes) or "nothing"
        raise InputError(f"optimize: loss must return one number or array of floating point, got {kinds}.")
    steps_of, losses = Stepper(traced, solver, key), []

    def after(state):
        losses.append(float(state.cost))
        if callback is not None:
            callback(int(state.step), losses[-1], at(state.free))

    state, reason = run(steps_of, steps_of.begin(start, None), None, limit=steps, enough=-math.inf, each=after)
    results = {CONVERGED: optx.RESULTS.successful, NOT_FINITE: optx.RESULTS.nonlinear_divergence}
    result = results.get(reason, optx.RESULTS.nonlinear_max_steps_reached)
    found = at(state.free)
    try:
        check_room(found.sensor_distance, found.filters, found.windows, found.sample, found.array.orientation)
    except ValueError as error:
        raise InputError(f"optimize: other bounds are needed: {error}") from error
    return Optimum(found, state.cost, result, {"num_steps": int(state.step), "values": np.array(losses)})


def _check(loss, imager, free, solver, steps):
    if not callable(loss):
        raise input_error("loss", "a function of an imager", short_repr(loss))
    check_kind("imager", imager, Imager, "an Imager, as `design.imager()` is")
    check_kind("free", free, Free, "a Free, as `gs_jax.free` makes it")
    check_kind("solver", solver, Solver, "a solver of optimistix or optax, or LBFGSB()")
    check_kind("steps", steps, int | np.integer, "a whole number")
    if steps < 1:
        raise InputError(f"steps must be 1 or more, got {steps}.")


class _Unbounded:
    """Values as they are."""

    value = free = staticmethod(lambda x: x)


def _map(name, free, bounds, box):
    if name not in free.names:
        raise InputError(f"bounds: names must be among the free ones, {', '.join(free.names)}, got {name}.")
    if name not in bounds:
        if box:
            raise InputError(f"bounds: LBFGSB needs bounds of all that is free, got none of {name}.")
        return _Unbounded
    low, high = (np.asarray(end, float) for end in bounds[name])
    if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
        raise InputError(f"bounds of {name} must be finite, the lower one first, got {low} to {high}.")
    return (Box if box else Bounds)(low, high)
