"""Pareto fronts of two or three objectives.

By the epsilon-constraint method (Haimes, Lasdon and Wismer, IEEE Trans. Syst. Man Cybern. 1, 296, 1971) one term is
minimised or maximised under limits on one or two others, which move from value to value. Each search is that of
`gs_jax.codesign.search`. Each limit is searched from the study's start, then from the best design of the limits before
it, and on the way back from that of the limits after it; the better result stays. Searches that do not wait for each
other may run in parallel. A point is the best of all designs found that keep its limits, so none is dominated by a
neighbour's. The true front may be better.
"""

import contextlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

from ..base.errors import InputError
from ..base.progress import Progress
from ..base.typing import PathLike
from ..base.workers import Workers
from ..design.design import Design
from .parameters import NAMES, Values, significant, start_values
from .search import Log, Problem, load, problem_of, run_stages, warn_of_start
from .study import Row, Study, TermTable
from .terms import SIGNS, unit_of, with_terms

# Relative gain of the goal below which two searches count as having the same result.
_LEAST_GAIN = 1e-6


class Point(NamedTuple):
    """Parameters of a design, its terms (those with moving limits last), and these limits."""

    values: Values
    rows: list[Row]
    limits: tuple[float, ...]

    @property
    def feasible(self) -> bool:
        """Whether it meets every target."""
        return all(row.met is not False for row in self.rows)


class Front(NamedTuple):
    """Result of a sweep.

    `terms`: those whose limits move last. `objectives`: the goal and these. `values`: of the objectives, in the terms'
    units. `best`: which points no other one dominates.
    """

    terms: list[TermTable]
    objectives: list[TermTable]
    points: list[Point]
    values: Float[np.ndarray, "point objective"]
    best: Bool[np.ndarray, " point"]


def non_dominated(losses: Float[np.ndarray, "point objective"]) -> Bool[np.ndarray, " point"]:
    """Mask of points that no other point dominates (no worse in any objective, better in one). Less is better."""
    no_worse = (losses[:, None] <= losses[None]).all(2)
    better = (losses[:, None] < losses[None]).any(2)
    return np.logical_not((no_worse & better).any(0))


class Sweep(NamedTuple):
    """The problem of a study whose limits move: its terms are those that stay and those that move, in this order."""

    problem: Problem
    kept: list[TermTable]
    moving: list[TermTable]

    def terms(self, limits: Sequence[float]) -> list[TermTable]:
        """All terms, with these limits."""
        moved = [t.model_copy(update={t.kind: limit}) for t, limit in zip(self.moving, limits, strict=True)]
        return [*self.kept, *moved]

    def search(self, limits: Sequence[float], values: Values, starts: int) -> Point:
        """The point of a search under limits, or that of its start if it comes to no number."""
        terms = self.terms(limits)
        problem = self.problem._replace(study=self.problem.study.model_copy(update={"starts": starts}))
        with contextlib.suppress(InputError):
            values = run_stages(problem, terms, values, log=Log())
        return Point(values, self.problem.rows(terms, values), tuple(limits))

    def under(self, point: Point, limits: tuple[float, ...]) -> Point:
        """The design of a point, assessed under other limits."""
        rows = [term.assess(row[:2]) for term, row in zip(self.terms(limits), point.rows, strict=True)]
        return point._replace(rows=rows, limits=limits)

    def losses(self, point: Point) -> list[float]:
        """The goal and the terms whose limits move; less is better."""
        pairs = zip((*self.kept, *self.moving), point.rows, strict=True)
        worst = {term: _sign(term) * term.worst(row[:2]) for term, row in pairs}
        return [worst[term] for term in self.objectives]

    @property
    def objectives(self) -> list[TermTable]:
        return [next(term for term in self.kept if term.is_goal), *self.moving]

    def rank(self, point: Point) -> tuple[bool, float]:
        """Less is better: first whether a target is missed, then the goal."""
        goal = self.losses(point)[0]
        return not point.feasible or not np.isfinite(goal), goal

    def is_better(self, new: Point, old: Point) -> bool:
        """Whether a design meets targets that the other misses, or meets them and has a better goal by a millionth."""
        (misses, goal), (missed, before) = self.rank(new), self.rank(old)
        return not misses and (missed or goal < before - _LEAST_GAIN * abs(before))

    def front(self, points: list[Point]) -> Front:
        """Points, and which of them are on the front."""
        losses = np.array([self.losses(point) for point in points])
        feasible, best = np.array([point.feasible for point in points]), np.zeros(len(points), bool)
        best[feasible] = non_dominated(losses[feasible])
        values = losses * [_sign(term) for term in self.objectives]
        return Front([*self.kept, *self.moving], self.objectives, points, values, best)


def _sign(term: TermTable) -> float:
    return -1.0 if term.kind in ("at_least", "maximise") else 1.0


def sweep_of(design: Design, study: Study) -> Sweep:
    """The sweep of a study for a design; `InputError` if it does not fit the design or moves no limit."""
    if not study.pareto:
        raise InputError("`pareto` must be one or two tables, got none.")
    tables = [{"name": limit.name, limit.kind: limit.targets[0], "weight": 30.0} for limit in study.pareto]
    moving, moved = list(map(TermTable.model_validate, tables)), [(limit.name, limit.kind) for limit in study.pareto]
    kept = [term for term in study.terms if term.is_goal or (term.name, term.kind) not in moved]
    wider = study.model_copy(update={"terms": (*kept, *moving)})
    return Sweep(problem_of(design, wider), kept, moving)


def trade_off(
    design: Design | PathLike,
    study: Study | PathLike,
    *,
    each: Callable[[Front], object] = lambda front: None,
    progress: Progress | None = None,
    workers: Workers | None = None,
) -> Front:
    """The Pareto front of a study's goal and its one or two moving limits.

    Parameters
    ----------
    design
        The initial design, or its file.
    study
        With one term to minimise or maximise and one or two `[[pareto]]` tables, or its file. Its stages run one after
        the other for each combination of limits. Its own `design` is ignored.
    each
        Called with the front so far after each point.
    workers
        Processes that run the searches; this one by default. The result is the same.

    Raises
    ------
    InputError
        If a file cannot be read, the study does not fit the design or moves no limit.

    Warns
    -----
    InputWarning
        If a parameter starts at a bound or beyond it, and is moved inside by 1 % of the range.
    """
    with load(design, study) as (parent, question):
        return _trade_off(sweep_of(parent, question), each, progress or Progress(), workers or Workers())


def _trade_off(sweep: Sweep, each: Callable[[Front], object], progress: Progress, workers: Workers) -> Front:
    problem = sweep.problem
    combinations = list(itertools.product(*(limit.targets for limit in problem.study.pareto)))
    # Combinations of one rank have no neighbours among them.
    neighbours, ranks = _neighbours(combinations)
    names, points = [term.name for term in problem.study.terms], {}
    stream = workers.mapper(with_terms(partial(_searcher, sweep), names))

    def front() -> Front:
        return sweep.front([points[number] for number in sorted(points)])

    def keep_better(number: int, new: Point) -> None:
        if sweep.is_better(new, points[number]):
            points[number] = new
            each(front())

    def from_neighbours(rank: int, step: int) -> Iterator[tuple[int, tuple[float, ...], Values, int]]:
        """The searches of a rank, each from the best design of its neighbours one rank back."""
        for number in np.flatnonzero(ranks == rank).tolist():
            limits = combinations[number]
            near = [sweep.under(points[n], limits) for n in neighbours[number] if ranks[n] == rank - step]
            yield number, limits, min(near, key=sweep.rank).values, 1

    upwards = sorted(set(ranks.tolist()))
    passes = [(rank, 1) for rank in upwards[1:]] + [(rank, -1) for rank in upwards[-2::-1]]
    with progress.counter("Trade-off", 3 * len(combinations) - 2) as advance:
        values = start_values(problem.imager, problem.at)
        warn_of_start(problem, values)
        jobs = [(number, limits, values, problem.study.starts) for number, limits in enumerate(combinations)]
        for (number, *_), result in stream(jobs):
            points[number] = result()
            each(front())
            advance()
        for rank, step in passes:
            # What starts them depends on other ranks alone, so the order in which workers finish does not matter.
            for (number, *_), result in stream(list(from_neighbours(rank, step))):
                keep_better(number, result())
                advance()
    for number, limits in enumerate(combinations):
        keep_better(number, min((sweep.under(point, limits) for point in points.values()), key=sweep.rank))
    return front()


def _searcher(sweep: Sweep) -> Callable[[tuple[int, Sequence[float], Values, int]], Point]:
    """From the number of a point, its limits, where to start and the number of starts, to the point; for a worker."""
    return lambda job: sweep.search(*job[1:])


def _neighbours(combinations: list[tuple[float, ...]]) -> tuple[list[list[int]], np.ndarray]:
    """For each combination of limits, those next to it along one axis, and its rank: its steps from the lowest."""
    axes = [sorted(set(axis)) for axis in zip(*combinations, strict=True)]
    index = np.array([[axis.index(limit) for axis, limit in zip(axes, some, strict=True)] for some in combinations])
    return [np.flatnonzero(np.abs(index - own).sum(1) == 1).tolist() for own in index], index.sum(1)


def as_json(front: Front) -> dict[str, Any]:
    """The front's numbers: limits, objectives and free parameters of every point."""
    names = [name for name in NAMES if name != "centers_mm"]
    return {
        "objectives": [{"term": term.name, "kind": term.kind} for term in front.objectives],
        "points": [
            {term.name: float(f"{x:.6g}") for term, x in zip(front.objectives, row, strict=True)}
            | {"limits": {t.name: limit for t, limit in zip(front.objectives[1:], point.limits, strict=True)}}
            | {"parameters": {name: significant(point.values[name]).tolist() for name in names}}
            | {"terms": {t.name: list(r[:2]) for t, r in zip(front.terms, point.rows, strict=True)}}
            | {"feasible": point.feasible, "on_front": bool(best)}
            for point, row, best in zip(front.points, front.values, front.best, strict=True)
        ],
    }


def picture(front: Front) -> Figure:
    """The goal against the first limited term; each second limit is a line of its own colour."""
    figure = Figure(figsize=(6.4, 4.4), dpi=110, layout="constrained")
    axes = figure.subplots()
    goal, along, *third = front.objectives
    groups = np.array([point.limits[1] if third else 0.0 for point in front.points])
    for number, group in enumerate(limits := np.unique(groups)):
        some = (groups == group) & front.best
        order = np.argsort(front.values[some, 1])
        label = f"{_axis(third[0])} {SIGNS[third[0].kind]} {group:g}" if third else None
        # Limits may share designs: smaller dots lie on larger ones.
        style = {"color": f"C{number}", "label": label, "ms": 5 + 3 * (len(limits) - 1 - number)}
        axes.plot(front.values[some, 1][order], front.values[some, 0][order], "o-", **style)
    others = ~front.best
    if others.any():
        label = "dominated or misses a target"
        axes.plot(front.values[others, 1], front.values[others, 0], "x", color="0.6", label=label)
    axes.set(xlabel=_axis(along), ylabel=_axis(goal))
    axes.set_title("what one costs in the other")
    axes.grid(alpha=0.3)
    if third or others.any():
        axes.legend()
    return figure


def _axis(term: TermTable) -> str:
    """A term's name with its unit after a comma."""
    unit, words = unit_of(term.name), term.name.split("_")
    return f"{' '.join(words[:-1])}, {unit}" if unit else " ".join(words)
