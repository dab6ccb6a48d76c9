"""Co-design: from a design and a study to a better design.

The study says what is free, what is wanted and which solvers run, stage by stage (`gs_jax.codesign.study`). The first
stage may start from several points; the best goes on to the next. What is done so far is in a log, and the log and the
solver's state make a checkpoint.
"""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.errors import InputError
from ..base.progress import Progress
from ..designs.design import Design
from .checkpoint import Log, read_checkpoint, restored, write_checkpoint
from .parameters import Bounds, Box, Parent, Values, candidate, new_design, parent_of, start_values
from .solve import NOT_FINITE, State, Stepper, run, stepper
from .study import Study, TermTable, labels
from .targets import Row, assess, evaluate, residual, worst_of

# Seconds between two checkpoints.
_EVERY = 10.0


class Outcome(NamedTuple):
    """What a search found.

    `design`: new, with the study's name. `before`, `after`: one row for each of the study's terms. `log`: of every
    start and step. `seconds`: of the search, compilation included.
    """

    design: Design
    before: list[Row]
    after: list[Row]
    log: Log
    seconds: float


class Problem(NamedTuple):
    """A design and a study as a solver sees them."""

    parent: Parent
    study: Study


class Stage(NamedTuple):
    """A stage that is ready to run, compiled once for all its starts.

    `labels`: of the terms, for the log. `free`: from parameters to what the solver moves. `values`: back, with the
    parameters that it does not move. `watch`: the worst entry of each term. `enough`: a cost at which all targets are
    met.
    """

    number: int
    limit: int
    terms: list[TermTable]
    labels: list[str]
    targets: Float[Array, " term"]
    steps: Stepper
    free: Callable[[Values], Values]
    values: Callable[[Values], Values]
    watch: Callable[[Values], list[Array]]
    enough: float


def problem_of(design: Design, study: Study) -> Problem:
    """The problem that a study poses for a design.

    Raises
    ------
    InputError
        If what is free does not exist in the design, or depths may come to lie behind the plate.
    """
    _check_free(design, study)
    confusion = None if study.confusion_um is None else study.confusion_um / 1000
    parent = parent_of(
        design,
        depths_mm=study.depths_mm,
        confusion=confusion,
        depth_count=study.depth_count,
        free=study.free,
    )
    return Problem(parent, study)


def _check_free(design: Design, study: Study) -> None:
    if "pitch_mm" in study.free and len(design.array.centers_mm) == 1:
        raise InputError("`free.pitch_mm`: found it free for a design of one lens, allowed: for two or more.")
    twice = sum(study.depths_mm or design.imaging.working_distance_mm)
    if "depth_span_mm" in study.free and study.free["depth_span_mm"][1] >= twice:
        found = f"`free.depth_span_mm`: found {list(study.free['depth_span_mm'])}"
        raise InputError(f"{found}, allowed: below {twice:g}, twice the middle of the depths.")
    of_lens = {"radius_of_curvature_mm", "refractive_index"} & set(study.free)
    if design.lens.focal_length_mm is not None and of_lens:
        raise InputError(
            f"`free.{min(of_lens)}`: found it free for a design with `lens.focal_length_mm`, allowed: one without it."
        )


def make_stage(problem: Problem, index: int, values: Values) -> Stage:
    """The solver of a stage, with the parameters that it does not free at these values."""
    parent, study = problem
    table = study.stages[index]
    between = Box if table.solver == "lbfgsb" else Bounds
    bounds = {name: between(*study.free[name]) for name in (study.free if table.free is None else table.free)}
    terms = [term for term in study.terms if table.terms is None or term.name in table.terms]
    to_free = lambda values: {name: bound.free(values[name]) for name, bound in bounds.items()}
    to_values = lambda free: values | {name: bound.value(free[name]) for name, bound in bounds.items()}

    def residuals(free, targets, key):
        found = candidate(parent, to_values(free))
        pairs = zip(terms, targets, strict=True)
        return jnp.concatenate([residual(term, x, found, key, margin=study.margin) for term, x in pairs])

    def watch(free):
        found = candidate(parent, to_values(free))
        return [worst_of(term, evaluate(term.name, found, key)) for term in terms]

    key = jax.random.fold_in(jax.random.key(study.seed), index)
    targets = targets_of(terms)
    steps = stepper(residuals, to_free(values), targets, table, key)
    return Stage(
        number=index,
        limit=table.steps,
        terms=terms,
        labels=labels(terms, study),
        targets=targets,
        steps=steps,
        free=to_free,
        values=to_values,
        watch=jax.jit(watch),
        enough=_enough(problem, values, terms),
    )


def targets_of(terms: Sequence[TermTable]) -> Float[Array, " term"]:
    """The targets of the terms, in order."""
    return jnp.array([term.target for term in terms], float)


def _enough(problem: Problem, values: Values, terms: Sequence[TermTable]) -> float:
    """A cost at which all targets are met: half the margin is missing of one entry. Zero if there is a goal."""
    if any(term.is_goal for term in terms):
        return 0.0
    sizes = jax.eval_shape(entries_of(problem.parent, terms), values)
    least = min(term.weight / math.sqrt(size.size) for term, size in zip(terms, sizes, strict=True))
    return (least * problem.study.margin / 2) ** 2 / 2


def entries_of(parent: Parent, terms: Sequence[TermTable]) -> Callable[[Values], list[Float[Array, " entry"]]]:
    """The function from parameters to the entries of each term, compiled. Of what is random it is one draw."""

    @jax.jit
    def entries(values: Values):
        found = candidate(parent, values)
        return [evaluate(term.name, found, jax.random.key(0)) for term in terms]

    return entries


def _rows(parent: Parent, terms: Sequence[TermTable]) -> list[Row]:
    entries = entries_of(parent, terms)(start_values(parent))
    return [assess(term, np.asarray(x)) for term, x in zip(terms, entries, strict=True)]


def random_start(problem: Problem, values: Values, start: int) -> Values:
    """Parameters drawn evenly between their bounds, others for each `start`; lens centres stay. 0 is the design."""
    if start == 0:
        return values
    rng = np.random.default_rng([problem.study.seed, start])
    drawn = {name: rng.uniform(*limits) for name, limits in problem.study.free.items() if name != "centers_mm"}
    return values | {name: jnp.asarray(x, values[name].dtype) for name, x in drawn.items()}


def optimise(
    design: Design,
    study: Study,
    *,
    progress: Progress,
    checkpoint: Path | None = None,
    resume: bool = False,
    every: float = _EVERY,
) -> Outcome:
    """Search for a design that does what a study wants.

    Parameters
    ----------
    design
        To start from.
    checkpoint
        A file to keep the state in; none by default.
    resume
        Go on from that file, with the same result as without the interruption.
    every
        Seconds between two checkpoints.

    Raises
    ------
    InputError
        If the study does not fit the design, the checkpoint is missing or another study's, or nothing was found.
    """
    began = time.monotonic()
    log, saved = Log(), None
    if resume and checkpoint:
        log, state = read_checkpoint(checkpoint, study, design)
        saved = checkpoint, state
    problem, saver = problem_of(design, study), _Saver(checkpoint, every, log, study, design)
    values = start_values(problem.parent)
    before = _rows(problem.parent, study.terms)
    for index in range(len(study.stages)):
        stage = make_stage(problem, index, values)
        done = sum(end["stage"] == index for end in log.ends)
        starts = range(done, study.starts if index == 0 else 1)
        for start in progress.track(starts, f"Stage {index + 1}, {study.stages[index].solver}"):
            begin = stage.steps.begin(stage.free(random_start(problem, values, start)), stage.targets)
            state = begin if saved is None else restored(*saved, begin)
            saved = None
            log.ends.append(_search(stage, start, state, log, saver))
        values = _best(stage, values, log)
    found = new_design(design, problem.parent, values).model_copy(update={"name": study.name})
    written = problem_of(found, study.model_copy(update={"depths_mm": None})).parent
    after = _rows(written, study.terms)
    return Outcome(found, before, after, log, time.monotonic() - began)


class _Saver:
    """Writes a checkpoint now and then."""

    def __init__(self, path: Path | None, every: float, log: Log, study: Study, design: Design):
        self.path, self.every, self.last = path, every, time.monotonic()
        self.log, self.study, self.design = log, study, design

    def __call__(self, state: State) -> None:
        if self.path is not None and time.monotonic() - self.last >= self.every:
            write_checkpoint(self.path, self.log, self.study, self.design, state)
            self.last = time.monotonic()


def _search(stage: Stage, start: int, state: State, log: Log, saver: _Saver) -> dict:
    """One start of a stage to its end: a record for `log.ends`."""

    def each(state: State) -> None:
        worst = dict(zip(stage.labels, map(float, stage.watch(state.free)), strict=True))
        record = {"stage": stage.number, "start": start, "step": int(state.step), "cost": float(state.cost)}
        log.steps.append(record | worst)
        saver(state)

    state, reason = run(stage.steps, state, stage.targets, limit=stage.limit, enough=stage.enough, each=each)
    record = {"stage": stage.number, "start": start, "steps": int(state.step), "cost": float(state.cost)}
    return record | {"reason": reason, "free": {name: np.asarray(x).tolist() for name, x in state.free.items()}}


def best_end(log: Log, stage: int) -> dict[str, Any]:
    """The record of the start of a stage that came to the least cost.

    Raises
    ------
    InputError
        If none came to a finite one.
    """
    ends = [end for end in log.ends if end["stage"] == stage and end["reason"] != NOT_FINITE]
    if not ends:
        raise InputError(f"stage {stage + 1}: no start came to a finite cost, allowed: other bounds or terms.")
    return min(ends, key=lambda end: end["cost"])


def _best(stage: Stage, values: Values, log: Log) -> Values:
    """The parameters that the best start of a stage came to.

    Of Adam's costs, which are random, there is only one: it runs from one start unless it is the first stage.
    """
    best = best_end(log, stage.number)
    return stage.values({name: jnp.asarray(x, values[name].dtype) for name, x in best["free"].items()})
