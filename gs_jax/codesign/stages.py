"""Stages of a search: solvers that run one after the other, each on some of the free parameters.

`gs_jax.codesign.search` runs them once, `gs_jax.codesign.pareto` once for each combination of limits.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from ..base.arrays import as_float
from ..base.errors import InputError
from ..base.progress import Progress
from ..base.workers import Workers
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
    warn_if_moved,
)
from .study import StageTable, Study, TermTable, labels
from .targets import Objective, Row, assess, evaluate, worst_entry
from .terms import TERMS, Term, with_terms


class Problem(NamedTuple):
    """The imager of a design, the conditions of its evaluation, and the study."""

    imager: Imager
    at: Conditions
    study: Study


class Residuals(eqx.Module):
    """Residuals of a study's terms, as functions of free variables; every number of the study is a leaf.

    `bounds`: the maps between free parameters and the solver's variables.
    """

    imager: Imager
    at: Conditions
    bounds: dict[str, Bounds | Box]
    objectives: tuple[Objective, ...]
    margin: Float[Array, ""] = eqx.field(converter=as_float)

    @eqx.filter_jit
    def free(self, values: Values) -> Values:
        """The solver's variables of parameters."""
        return {name: bound.free(values[name]) for name, bound in self.bounds.items()}

    @eqx.filter_jit
    def values(self, free: Values, values: Values) -> Values:
        """The parameters of the solver's variables, and of the fixed ones among `values`."""
        return values | {name: bound.value(free[name]) for name, bound in self.bounds.items()}

    def __call__(self, free: Values, given: tuple[Float[Array, " term"], Values], key: Key[Array, ""]):
        targets, values = given
        new = candidate(self.imager, self.at, self.values(free, values))
        pairs = zip(self.objectives, targets, strict=True)
        return jnp.concatenate([own.residual(target, *new, key, margin=self.margin) for own, target in pairs])


class Stage(NamedTuple):
    """A stage that is ready to run, the same programs for all starts, targets and values of fixed parameters.

    `terms`: those that it looks at. `labels`: of these, for the log. `enough`: a cost at which all targets hold.
    """

    number: int
    table: StageTable
    terms: list[TermTable]
    labels: list[str]
    residuals: Residuals
    steps: Stepper
    enough: float

    def watch(self, free: Values, values: Values) -> list[Float[Array, ""]]:
        """The worst entry of each term."""
        own, terms = self.residuals, tuple(TERMS[term.name] for term in self.terms)
        entries = _entries(own.imager, own.at, terms, own.values(free, values), self.steps.key)
        return [worst_entry(term, x) for term, x in zip(self.terms, entries, strict=True)]


def problem_of(design: Design, study: Study) -> Problem:
    """The problem that a study poses for a design.

    Raises `InputError` if a free parameter does not exist in the design, or depths may come to lie behind the plate.
    """
    _check_free(design, study)
    circle_of_confusion = None if study.confusion_um is None else study.confusion_um / 1000
    where = {"depths_mm": study.depths_mm, "depth_count": study.depth_count, "circle_of_confusion": circle_of_confusion}
    return Problem(*evaluated(design, **where, exposure=study.exposure, free=study.free), study)


def _check_free(design: Design, study: Study) -> None:
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
    table = study.stages[index]
    terms = terms_of(table, study.terms)
    objectives = tuple(map(Objective.of_table, terms))
    residuals = Residuals(imager, at, _bounds_of(study, index), objectives, study.margin)
    key = jax.random.fold_in(jax.random.key(study.seed), index)
    steps = Stepper(residuals, solver_of(table), key)
    return Stage(index, table, terms, labels(terms, study), residuals, steps, _enough(problem, terms))


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
    functions = tuple(TERMS[term.name] for term in terms)
    imager, at = problem.imager, problem.at
    sizes = eqx.filter_eval_shape(_entries, imager, at, functions, start_values(imager, at), jax.random.key(0))
    least = min(term.weight / math.sqrt(size.size) for term, size in zip(terms, sizes, strict=True))
    return (least * problem.study.margin / 2) ** 2 / 2


@eqx.filter_jit
def _entries(
    imager: Imager, at: Conditions, terms: tuple[Term, ...], values: Values, key: Key[Array, ""]
) -> list[Float[Array, " entry"]]:
    """Entries of terms at parameters."""
    new = candidate(imager, at, values)
    return [evaluate(term, *new, key) for term in terms]


def rows_of(problem: Problem, terms: Sequence[TermTable], values: Values) -> list[Row]:
    """Assess terms at parameters; random terms have one draw."""
    functions = tuple(TERMS[term.name] for term in terms)
    entries = _entries(problem.imager, problem.at, functions, values, jax.random.key(0))
    return [assess(term, np.asarray(x)) for term, x in zip(terms, entries, strict=True)]


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
    return stage.steps.begin(stage.residuals.free(random_start(problem, values, start)), given)


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
    reached = stage.residuals.values(state.free, values)
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
