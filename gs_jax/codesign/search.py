"""Searches of studies: stages of solvers that run one after the other, each on some of the free parameters.

A study (`gs_jax.codesign.study`) has free parameters, terms with targets, and stages. The first stage may start from
several points; the best goes on to the next stage. `run_study` runs them once, `gs_jax.codesign.pareto` once for each
combination of limits. A checkpoint has the log of all steps as one line of JSON, then the solver's state as arrays.
"""

import contextlib
import hashlib
import io
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from ..base.arrays import as_float
from ..base.errors import InputError, check_kind, errors_name_file
from ..base.progress import Progress
from ..base.typing import PathLike
from ..base.workers import Workers
from ..design.design import Design, read_design
from ..io.files import atomic_write, check_input, decoding
from ..microscope.geometry import Imager
from ..objectives.conditions import Conditions
from .limits import Limit, Residuals, limits_of
from .parameters import Values, candidate, evaluated, new_design, start_values
from .solve import (
    NOT_FINITE,
    Affine,
    Sigmoid,
    State,
    Stepper,
    Transforms,
    inverse,
    run,
    solver_of,
    warn_if_moved,
)
from .study import Row, StageTable, Study, TermTable, check_design, initial_design, labels, read_study
from .terms import TERMS, Objective, Term, evaluate, with_terms

# Seconds between two checkpoints.
_EVERY = 10.0
_FORMAT = "gs-jax checkpoint 6"
# A start ends when its least cost has fallen by no more than this part of itself in so many steps; Adam's oscillates.
_FLAT, _FLAT_STEPS = 1e-4, (20, 100)


class Problem(NamedTuple):
    """The imager of a design, the conditions of its evaluation, and the study."""

    imager: Imager
    at: Conditions
    study: Study

    def rows(self, terms: Sequence[TermTable], values: Values) -> list[Row]:
        """Assess terms at parameters; random terms have one draw."""
        functions = tuple(TERMS[term.name] for term in terms)
        entries = _entries(self.imager, self.at, functions, values, jax.random.key(0))
        return [term.assess(x) for term, x in zip(terms, entries, strict=True)]

    def start(self, values: Values, number: int) -> Values:
        """Random parameters within their bounds for each start, the given ones for 0; lens centres stay."""
        if number == 0:
            return values
        rng = np.random.default_rng([self.study.seed, number])
        free = {name: limits for name, limits in self.study.free.items() if name != "centers_mm"}
        drawn = {name: rng.uniform(*limits, values[name].shape) for name, limits in free.items()}
        return values | {name: jnp.asarray(x, values[name].dtype) for name, x in drawn.items()}


def problem_of(design: Design, study: Study) -> Problem:
    """The problem that a study poses for a design; raises `InputError` as `check_design`."""
    check_design(design, study)
    where = {"depths_mm": study.depths_mm, "depth_count": study.depth_count}
    return Problem(*evaluated(design, **where, **study.scene, free=study.free), study)


@eqx.filter_jit
def _entries(
    imager: Imager, at: Conditions, terms: tuple[Term, ...], values: Values, key: Key[Array, ""]
) -> list[Float[Array, " entry"]]:
    """Entries of terms at parameters."""
    new = candidate(imager, at, values)
    return [evaluate(term, *new, key) for term in terms]


# Called with the state of a search, None after a start that a worker ran, and with parameters that meet the stage's
# targets, or None.
Each = Callable[[State | None, Values | None], None]


class Stage(NamedTuple):
    """A stage that is ready to run, the same programs for all starts, targets and values of fixed parameters.

    `terms`: those that it looks at. `labels`: of these, for the log. `enough`: a cost at which all targets hold.
    """

    number: int
    table: StageTable
    terms: list[TermTable]
    labels: list[str]
    residuals: Residuals
    stepper: Stepper
    enough: float

    @classmethod
    def of(cls, problem: Problem, number: int, terms: Sequence[TermTable], values: Values) -> "Stage":
        """A stage of a study, with the targets of its terms and the parameters that do not move."""
        imager, at, study = problem
        table = study.stages[number]
        terms = table.of(terms)
        objectives = tuple(Objective(TERMS[term.name], term.kind, term.target, term.weight) for term in terms)
        residuals = Residuals(imager, at, values, _transforms_of(study, number), objectives, study.margin)
        key = jax.random.fold_in(jax.random.key(study.seed), number)
        # Costs of random terms differ from step to step, flat or not.
        flat = None if any(objective.term.random for objective in objectives) else as_float(_FLAT)
        stepper = Stepper(residuals, solver_of(table), key, flat, _FLAT_STEPS[table.solver == "adam"])
        return cls(number, table, terms, labels(terms, study), residuals, stepper, _enough(problem, terms, values))

    def worst(self, free: Values) -> list[float]:
        """The worst entry of each term."""
        own = self.residuals
        functions = tuple(objective.term for objective in own.objectives)
        entries = _entries(own.imager, own.at, functions, own.parameters(free), self.stepper.key)
        return [term.worst(x) for term, x in zip(self.terms, entries, strict=True)]

    def begin(self, values: Values) -> State:
        """The state at parameters."""
        return self.stepper.begin(inverse(self.residuals.transforms, values))

    def run(self, start: int, state: State, steps: list[dict[str, Any]], each: "Each"):
        """Run a start from its state, add a record for each step, and return that of its end."""

        def meets(worst: list[float]) -> bool:
            return all(term.assess([x]).met is not False for term, x in zip(self.terms, worst, strict=True))

        def after_step(state):
            record = {"stage": self.number, "start": start, "step": int(state.step), "cost": float(state.cost)}
            worst = self.worst(state.free)
            steps.append(record | dict(zip(self.labels, worst, strict=True)))
            each(state, self.residuals.parameters(state.free) if meets(worst) else None)

        state, reason = run(self.stepper, state, limit=self.table.steps, enough=self.enough, each=after_step)
        reached = self.residuals.parameters(state.free)
        return {
            "stage": self.number,
            "start": start,
            "steps": int(state.step),
            "cost": float(state.cost),
            "met": meets(self.worst(state.free)),
            "reason": reason,
            "free": {name: np.asarray(reached[name]).tolist() for name in state.free},
        }


def _transforms_of(study: Study, number: int) -> Transforms:
    table = study.stages[number]
    between = Affine if table.solver == "lbfgsb" else Sigmoid
    return {name: between(*study.free[name]) for name in (study.free if table.free is None else table.free)}


def warn_of_start(problem: Problem, values: Values) -> None:
    """Warn of each parameter of a design that the first stage moves inside its bounds; `InputWarning`."""
    warn_if_moved(_transforms_of(problem.study, 0), values)


def _enough(problem: Problem, terms: Sequence[TermTable], values: Values) -> float:
    """A cost at which all targets are met: one entry misses by half the margin. Zero if there is a goal."""
    if any(term.is_goal for term in terms):
        return 0.0
    functions = tuple(TERMS[term.name] for term in terms)
    sizes = eqx.filter_eval_shape(_entries, problem.imager, problem.at, functions, values, jax.random.key(0))
    least = min(term.weight / math.sqrt(size.size) for term, size in zip(terms, sizes, strict=True))
    return (least * problem.study.margin / 2) ** 2 / 2


@dataclass
class Log:
    """Record of a search.

    `steps`: one record a step, with the worst entry of each term. `ends`: one record for each finished start of a
    stage, with the reason for stopping, whether all targets are met, and the values of the free parameters, in the
    units that their names end in.
    """

    steps: list[dict[str, Any]] = field(default_factory=list)
    ends: list[dict[str, Any]] = field(default_factory=list)

    def best_end(self, stage: int) -> dict[str, Any]:
        """The record of the start with the least cost; one that misses a target only if all do.

        Costs of Adam are random, but it has a single start unless it is the first stage.

        Raises `InputError` if none reached a finite cost.
        """
        ends = [end for end in self.ends if end["stage"] == stage and end["reason"] != NOT_FINITE]
        if not ends:
            raise InputError(f"stage {stage + 1}: no start reached a finite cost; other bounds or terms are needed.")
        return min(ends, key=lambda end: (not end["met"], end["cost"]))


def run_stages(
    problem: Problem,
    terms: Sequence[TermTable],
    values: Values,
    *,
    log: Log,
    progress: Progress | None = None,
    each: Each = lambda state, values: None,
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
        Called after every step, and after every start that a worker ran.
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
    for number, table in enumerate(problem.study.stages):
        ended = {end["start"] for end in log.ends if end["stage"] == number}
        starts = [start for start in range(problem.study.starts if number == 0 else 1) if start not in ended]
        with progress.counter(f"Stage {number + 1}, {table.solver}", len(starts)) as advance:
            if workers and workers.remote and len(starts) > 1:
                # A worker runs a start from its beginning, whatever was saved of it.
                saved = None
                log.steps[:] = [step for step in log.steps if step["start"] in ended]
                build = with_terms(partial(_runner, problem, terms, values), [term.name for term in terms])
                for _, result in workers.mapper(build)(starts):
                    steps, end = result()
                    log.steps.extend(steps)
                    log.ends.append(end)
                    each(None, _reached(end, values) if end["met"] else None)
                    advance()
            else:
                stage = Stage.of(problem, number, terms, values)
                for start in starts:
                    state = stage.begin(problem.start(values, start))
                    if saved is not None:
                        state, saved = restore_state(*saved, state), None
                    log.ends.append(stage.run(start, state, log.steps, each))
                    advance()
        # Workers finish in any order.
        for records in (log.steps, log.ends):
            records.sort(key=lambda record: (record["stage"], record["start"]))
        values = _reached(log.best_end(number), values)
    return values


def _reached(end: dict[str, Any], values: Values) -> Values:
    """The parameters of a start's end."""
    return values | {name: jnp.asarray(x, values[name].dtype) for name, x in end["free"].items()}


def _runner(problem, terms, values):
    """Build the function from a start of the first stage to the records of its steps and of its end."""
    stage = Stage.of(problem, 0, terms, values)

    def run_alone(start):
        steps = []
        end = stage.run(start, stage.begin(problem.start(values, start)), steps, lambda state, values: None)
        return steps, end

    return run_alone


class Outcome(NamedTuple):
    """Result of a search.

    `parent`, `study`: its inputs. `design`: the new one, with the study's name. `before`, `after`: one row for each
    of the study's terms. `limits`: what the optimum of the last stage changes by with each limit. `log`: of every start
    and step. `seconds`: of the search, compilation included.
    """

    parent: Design
    study: Study
    design: Design
    before: list[Row]
    after: list[Row]
    limits: list[Limit]
    log: Log
    seconds: float


@contextlib.contextmanager
def load(design: Design | PathLike, study: Study | PathLike) -> Iterator[tuple[Design, Study]]:
    """The initial design of a study and the study, read if they are files.

    An `InputError` within names the study's file.
    """
    check_kind("design", design, Design | str | os.PathLike, "a Design or its file")
    check_kind("study", study, Study | str | os.PathLike, "a Study or its file")
    parent = design if isinstance(design, Design) else read_design(design)
    if isinstance(study, Study):
        yield initial_design(parent, study), study
        return
    question = read_study(study)
    with errors_name_file(study):
        yield initial_design(parent, question), question


def run_study(
    design: Design | PathLike,
    study: Study | PathLike,
    *,
    progress: Progress | None = None,
    checkpoint: PathLike | None = None,
    resume: bool = False,
    every: float = _EVERY,
    workers: Workers | None = None,
    first: Callable[[Design], None] | None = None,
) -> Outcome:
    """Search for a design that does what a study wants.

    *Host.*

    A start ends when all targets are met (unless there is a goal), when its solver has converged, or when its least
    cost has fallen by less than 0.01 % in 20 steps, with Adam in 100; but with random terms at the limit of steps. Use
    double precision (`jax_enable_x64`): single stops far from the minimum.

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
    first
        Called once, with the first design that meets all targets, while the search goes on.

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
        if workers and workers.remote and question.starts == 1:
            raise InputError("--workers and --scheduler must be used with a study of several `starts`, got 1.")
        began, log, saved = time.monotonic(), Log(), None
        path = None if checkpoint is None else Path(checkpoint)
        if resume and path:
            log, state = read_checkpoint(path, question, parent)
            saved = (path, state) if state else None
        problem, save = problem_of(parent, question), _Saver(path, every, log, question, parent)
        values = start_values(problem.imager, problem.at)
        warn_of_start(problem, values)
        before = problem.rows(question.terms, values)
        written = partial(_written, parent, problem)
        # Goals are never met.
        waits = [first] if first and not all(term.is_goal for term in question.terms) else []

        def each(state: State | None, met: Values | None) -> None:
            save(state)
            if waits and met is not None:
                # A step may lead where no microscope is.
                try:
                    design, rows = written(met)
                except InputError:
                    return
                if all(row.met is not False for row in rows):
                    waits.pop()(design)

        options = {"log": log, "progress": progress, "each": each, "saved": saved, "workers": workers}
        values = run_stages(problem, question.terms, values, **options)
        design, after = written(values)
        last = Stage.of(problem, len(question.stages) - 1, question.terms, values)
        limits = limits_of(last.residuals, last.terms, question, values, last.stepper.key)
        return Outcome(parent, question, design, before, after, limits, log, time.monotonic() - began)


def _written(parent: Design, problem: Problem, values: Values) -> tuple[Design, list[Row]]:
    """The design of parameters as its file has it, with the study's name, and its terms."""
    study = problem.study
    new = new_design(parent, problem.imager, problem.at, values).model_copy(update={"name": study.name})
    rounded = problem_of(new, study.model_copy(update={"depths_mm": None}))
    return new, rounded.rows(study.terms, start_values(rounded.imager, rounded.at))


class _Saver:
    """Write a checkpoint after the first step, then at intervals, and after each start that a worker ran."""

    def __init__(self, path: Path | None, every: float, log: Log, study: Study, design: Design):
        self.path, self.every, self.last = path, every, -math.inf
        self.log, self.study, self.design = log, study, design

    def __call__(self, state: State | None) -> None:
        if self.path is not None and (state is None or time.monotonic() - self.last >= self.every):
            write_checkpoint(self.path, self.log, self.study, self.design, state)
            self.last = time.monotonic()


def write_checkpoint(path: PathLike, log: Log, study: Study, design: Design, state: State | None) -> None:
    """Write a checkpoint atomically; the state is None between two starts."""
    head = {"format": _FORMAT, "of": _digest(study, design), "log": asdict(log)}
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(json.dumps(head).encode() + b"\n")
        eqx.tree_serialise_leaves(file, state)


def read_checkpoint(path: PathLike, study: Study, design: Design) -> tuple[Log, bytes]:
    """Read the log, and the state for `restore_state`, empty between two starts.

    Raises `InputError` if the file cannot be read, is not a checkpoint, or belongs to another study or design.
    """
    head, _, state = check_input(path).read_bytes().partition(b"\n")
    try:
        content = json.loads(head)
        if content["format"] != _FORMAT:
            if str(content["format"]).startswith("gs-jax checkpoint"):
                raise InputError(f"{path}: a checkpoint of another version, which cannot be resumed.")
            raise ValueError
        log, owner = Log(**content["log"]), content["of"]
        if not isinstance(log.steps, list) or not isinstance(log.ends, list):
            raise TypeError
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a checkpoint of `gs-jax optimize`.") from error
    if owner != _digest(study, design):
        raise InputError(f"{path}: the checkpoint is of another study or design, or of other --terms.")
    return log, state


def restore_state(path: Path, state: bytes, like: State) -> State:
    """Restore the state of a checkpoint; `like` is a state of the same solver.

    Raises `InputError` if the file is truncated.
    """
    with decoding(path, "checkpoint"):
        return eqx.tree_deserialise_leaves(io.BytesIO(state), like)


def _digest(study: Study, design: Design) -> str:
    own = "".join(TERMS[term.name].source for term in study.terms)
    return hashlib.sha256((study.model_dump_json() + design.model_dump_json() + own).encode()).hexdigest()
