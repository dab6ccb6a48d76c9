"""Stages of a search: solvers that run one after the other, each on some of the free parameters.

`gs_jax.codesign.search` runs them once, `gs_jax.codesign.pareto` once for each combination of limits.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.errors import InputError
from ..base.machine import Workers
from ..base.progress import Progress
from ..design.conversion import object_begins
from ..design.design import Design
from ..geometry import Imager
from ..objectives.conditions import Conditions
from .parameters import Values, candidate, evaluated, start_values
from .solve import (
    NOT_FINITE,
    Bounds,
    Box,
    Log,
    State,
    Stepper,
    restore_state,
    run,
    solver_of,
    stepper,
    warn_if_moved,
)
from .study import StageTable, Study, TermTable, labels
from .targets import Row, assess, evaluate, residual, worst_entry
from .terms import with_terms

# Most lens types of the term that images scenes by each in turn.
_SCENE_TYPES = 8


class Problem(NamedTuple):
    """The imager of a design, the conditions of its evaluation, and the study."""

    imager: Imager
    at: Conditions
    study: Study


class Stage(NamedTuple):
    """A stage that is ready to run, compiled once for all starts, targets and values of fixed parameters.

    `labels`: of its terms, for the log. `free`: from parameters to the solver's variables. `values`: from these and the
    fixed parameters to parameters. `watch`: the worst entry of each term. `enough`: a cost at which all targets hold.
    """

    number: int
    table: StageTable
    labels: list[str]
    steps: Stepper
    free: Callable[[Values], Values]
    values: Callable[[Values, Values], Values]
    watch: Callable[[Values, Values], list[Array]]
    enough: float


def problem_of(design: Design, study: Study) -> Problem:
    """The problem that a study poses for a design.

    Raises `InputError` if a free parameter does not exist in the design, or depths may come to lie behind the plate.
    """
    _check_free(design, study)
    circle_of_confusion = None if study.confusion_um is None else study.confusion_um / 1000
    where = {"depths_mm": study.depths_mm, "depth_count": study.depth_count, "circle_of_confusion": circle_of_confusion}
    return Problem(*evaluated(design, **where, exposure=study.exposure, free=study.free), study)


def _check_free(design: Design, study: Study) -> None:
    count = design.imager().array.type_count
    if count > _SCENE_TYPES and any(term.name == "scene_error" for term in study.terms):
        raise InputError(f"`terms`: scene_error takes up to {_SCENE_TYPES} lens types, got {count}.")
    if "pitch_mm" in study.free and len(design.array.centers_mm) == 1:
        raise InputError("`free.pitch_mm` needs a design of two lenses or more, got one lens.")
    _check_room(design, study)
    of_lens = {"radius_of_curvature_mm", "refractive_index", "conic_constant", "aspheric_terms"} & set(study.free)
    if design.lens.focal_length_mm is not None and of_lens:
        raise InputError(f"`free.{min(of_lens)}` needs a design without `lens.focal_length_mm`.")


def _check_room(design: Design, study: Study) -> None:
    """Raise `InputError` if depths may come to lie before the object's medium, or the sensor within its windows."""
    begins, (near, far) = object_begins(design), study.depths_mm or design.imaging.working_distance_mm
    if near < begins:
        raise InputError(
            f"`depths_mm` must be {begins:g} mm or more, where the object's medium begins, got {near:g} mm."
        )
    twice = near + far - 2 * begins
    if "depth_span_mm" in study.free and study.free["depth_span_mm"][1] >= twice:
        bounds, from_there = list(study.free["depth_span_mm"]), f" from {begins:g} mm on" if begins else ""
        allowed = f"below {twice:g}, twice the middle of the depths{from_there}"
        raise InputError(f"`free.depth_span_mm` must be {allowed}, got {bounds}.")
    windows = sum(layer.thickness_mm for layer in design.layers.sensor)
    if "sensor_distance_mm" in study.free and study.free["sensor_distance_mm"][0] < windows:
        bounds = list(study.free["sensor_distance_mm"])
        raise InputError(
            f"`free.sensor_distance_mm` must be {windows:g} or more, as thick as the windows, got {bounds}."
        )


def make_stage(problem: Problem, index: int) -> Stage:
    """The solver of a stage."""
    imager, at, study = problem
    table, bounds = study.stages[index], _bounds_of(study, index)
    terms = terms_of(table, study.terms)
    to_free = lambda values: {name: bound.free(values[name]) for name, bound in bounds.items()}
    to_values = lambda free, values: values | {name: bound.value(free[name]) for name, bound in bounds.items()}

    def residuals(free, given, key):
        targets, values = given
        found = candidate(imager, at, to_values(free, values))
        pairs = zip(terms, targets, strict=True)
        return jnp.concatenate([residual(term, x, *found, key, margin=study.margin) for term, x in pairs])

    def watch(free, values):
        found = candidate(imager, at, to_values(free, values))
        return [worst_entry(term, evaluate(term.name, *found, key)) for term in terms]

    key = jax.random.fold_in(jax.random.key(study.seed), index)
    values = start_values(imager, at)
    return Stage(
        number=index,
        table=table,
        labels=labels(terms, study),
        steps=stepper(residuals, to_free(values), (targets_of(terms), values), solver_of(table), key),
        free=to_free,
        values=to_values,
        watch=jax.jit(watch),
        enough=_enough(problem, terms),
    )


def _bounds_of(study: Study, index: int) -> dict[str, Bounds | Box]:
    table = study.stages[index]
    between = Box if table.solver == "lbfgsb" else Bounds
    return {name: between(*study.free[name]) for name in (study.free if table.free is None else table.free)}


def warn_of_start(problem: Problem, values: Values) -> None:
    """Warn of each parameter of a design that the first stage moves inside its bounds; `InputWarning`."""
    bounds = _bounds_of(problem.study, 0)
    inside = {name: bound.value(bound.free(values[name])) for name, bound in bounds.items()}
    warn_if_moved({name: values[name] for name in bounds}, inside)


def terms_of(stage: StageTable, terms: Sequence[TermTable]) -> list[TermTable]:
    """Those of the terms that a stage looks at."""
    return [term for term in terms if stage.terms is None or term.name in stage.terms]


def targets_of(terms: Sequence[TermTable]) -> Float[Array, " term"]:
    """The targets of the terms, in order."""
    return jnp.array([term.target for term in terms], float)


def _enough(problem: Problem, terms: Sequence[TermTable]) -> float:
    """A cost at which all targets are met: one entry misses by half the margin. Zero if there is a goal."""
    if any(term.is_goal for term in terms):
        return 0.0
    sizes = jax.eval_shape(entries_of(problem, terms), start_values(problem.imager, problem.at))
    least = min(term.weight / math.sqrt(size.size) for term, size in zip(terms, sizes, strict=True))
    return (least * problem.study.margin / 2) ** 2 / 2


def entries_of(problem: Problem, terms: Sequence[TermTable]) -> Callable[[Values], list[Float[Array, " entry"]]]:
    """Compile the function from parameters to the entries of each term; random terms have one draw."""

    @jax.jit
    def entries(values: Values):
        found = candidate(problem.imager, problem.at, values)
        return [evaluate(term.name, *found, jax.random.key(0)) for term in terms]

    return entries


def rows_of(
    terms: Sequence[TermTable], entries: Callable[[Values], list[Float[Array, " entry"]]], values: Values
) -> list[Row]:
    """Assess terms at parameters; `entries` is of `entries_of`, for terms of the same names."""
    return [assess(term, np.asarray(x)) for term, x in zip(terms, entries(values), strict=True)]


def random_start(problem: Problem, values: Values, start: int) -> Values:
    """Random parameters within their bounds for each `start`, the design's for 0; lens centres stay."""
    if start == 0:
        return values
    rng = np.random.default_rng([problem.study.seed, start])
    free = {name: limits for name, limits in problem.study.free.items() if name != "centers_mm"}
    drawn = {name: rng.uniform(*limits, values[name].shape) for name, limits in free.items()}
    return values | {name: jnp.asarray(x, values[name].dtype) for name, x in drawn.items()}


def run_stages(
    problem: Problem,
    stages: Iterable[Stage],
    terms: Sequence[TermTable],
    values: Values,
    *,
    log: Log,
    progress: Progress | None = None,
    each: Callable[[State | None], None] = lambda state: None,
    saved: tuple[Path, bytes] | None = None,
    workers: Workers | None = None,
) -> Values:
    """Run stages one after the other and return the parameters; each starts from the result of the one before.

    Parameters
    ----------
    terms
        The study's, with the targets that count.
    values
        Initial parameters.
    log
        Steps and ends are added to it. A start that it has the end of is not run again.
    each
        Called after every step with the state; with None after every start that a worker ran.
    saved
        Saved state of the first start that has not ended.
    workers
        Processes that run the starts of the first stage, if there are several; this one by default.

    Raises
    ------
    InputError
        If no start of a stage reaches a finite cost.
    """
    progress = progress or Progress()
    for stage in stages:
        ended = {end["start"] for end in log.ends if end["stage"] == stage.number}
        starts = [start for start in range(problem.study.starts if stage.number == 0 else 1) if start not in ended]
        with progress.counter(f"Stage {stage.number + 1}, {stage.table.solver}", len(starts)) as advance:
            if workers and workers.remote and len(starts) > 1:
                # A worker runs a start from its beginning, whatever was saved of it.
                saved = None
                log.steps[:] = [step for step in log.steps if step["start"] in ended]
                build = with_terms(partial(_starts_of_worker, problem, terms, values), [term.name for term in terms])
                stream = workers.mapper(build)
                for _, result in stream(starts):
                    steps, end = result()
                    log.steps.extend(steps)
                    log.ends.append(end)
                    each(None)
                    advance()
            else:
                for start in starts:
                    state = _initial_state(problem, stage, terms, values, start)
                    if saved is not None:
                        state, saved = restore_state(*saved, state), None
                    log.ends.append(_run_start(stage, terms, values, start, state, log.steps, each))
                    advance()
        # Workers finish in any order.
        for records in (log.steps, log.ends):
            records.sort(key=lambda record: (record["stage"], record["start"]))
        found = best_end(log, stage.number)["free"]
        values = values | {name: jnp.asarray(x, values[name].dtype) for name, x in found.items()}
    return values


def _starts_of_worker(problem, terms, values):
    """Build the function from a start of the first stage to the records of its steps and of its end."""
    stage = make_stage(problem, 0)

    def run_alone(start):
        steps, state = [], _initial_state(problem, stage, terms, values, start)
        end = _run_start(stage, terms, values, start, state, steps, lambda state: None)
        return steps, end

    return run_alone


def _initial_state(problem, stage, terms, values, start) -> State:
    given = targets_of(terms_of(stage.table, terms)), values
    return stage.steps.begin(stage.free(random_start(problem, values, start)), given)


def _run_start(stage, terms, values, start, state, steps, each) -> dict[str, Any]:
    """Run a start from its state, add a record for each step, and return that of its end."""
    wanted = terms_of(stage.table, terms)

    def after_step(state):
        worst = dict(zip(stage.labels, map(float, stage.watch(state.free, values)), strict=True))
        record = {"stage": stage.number, "start": start, "step": int(state.step), "cost": float(state.cost)}
        steps.append(record | worst)
        each(state)

    limit, given = stage.table.steps, (targets_of(wanted), values)
    state, reason = run(stage.steps, state, given, limit=limit, enough=stage.enough, each=after_step)
    worst = zip(wanted, stage.watch(state.free, values), strict=True)
    reached = stage.values(state.free, values)
    return {
        "stage": stage.number,
        "start": start,
        "steps": int(state.step),
        "cost": float(state.cost),
        "met": all(assess(term, np.asarray(x)[None]).met is not False for term, x in worst),
        "reason": reason,
        "free": {name: np.asarray(reached[name]).tolist() for name in state.free},
    }


def best_end(log: Log, stage: int) -> dict[str, Any]:
    """The record of the start with the least cost; one that misses a target only if all do.

    Costs of Adam are random, but it has a single start unless it is the first stage.

    Raises `InputError` if none reached a finite cost.
    """
    ends = [end for end in log.ends if end["stage"] == stage and end["reason"] != NOT_FINITE]
    if not ends:
        raise InputError(f"stage {stage + 1}: no start reached a finite cost; other bounds or terms are needed.")
    return min(ends, key=lambda end: (not end["met"], end["cost"]))
