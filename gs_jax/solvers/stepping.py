"""The loop of the host that runs a solver step by step, with progress and a way out after each step."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
from jax import lax

from ..base.progress import Progress


class Run(NamedTuple):
    """Last state of a solver, cost and residual of its last step, and the number of steps."""

    state: Any
    cost: float = math.nan
    residual: float = math.nan
    steps: int = 0


def run_solver(
    solver: Any,
    light: Any,
    problem: Any,
    progress: Progress,
    *,
    target: float = 0.0,
    state: Any = None,
    quarter: str = "",
) -> Run:
    """Run a solver step by step until it converges or the cost at the start of a step is below the target.

    `problem` is an operator, or a pytree that makes one, its `operator`, in the compiled step. Starts from `state`,
    which it overwrites, if given. `quarter`: as for `Progress.counter`.
    """
    run = Run(start_solver(solver, light, problem) if state is None else state)
    with progress.counter("Iterating", solver.steps, quarter=quarter) as advance:
        for number in range(1, solver.steps + 1):
            state, cost, residual = _step_in_place(run.state, _for_one_step(solver), light, problem)
            # Reading the numbers waits for the step: progress is true, and Ctrl-C ends it here.
            run = Run(state, float(cost), float(residual), number)
            if run.residual < solver.tolerance or run.cost < target:
                break
            advance()
    return run


def start_solver(solver: Any, light: Any, problem: Any) -> Any:
    """State before the first step, by one compiled program."""
    return _init(_for_one_step(solver), light, problem)


def take_step(state: Any, solver: Any, light: Any, problem: Any) -> tuple[Any, Any, Any]:
    """`solver.step`, by one compiled program."""
    return _step(state, _for_one_step(solver), light, problem)


def _for_one_step(solver):
    # Decided here and not in compiled code: another number of steps compiles nothing.
    return dataclasses.replace(solver, steps=1, tolerance=0.0)


@jax.jit
def estimate_of(solver: Any, state: Any) -> Any:
    """`solver.estimate`, by one compiled program."""
    return solver.estimate(state)


@jax.jit
def _init(solver, light, problem):
    return _strong(solver.init(getattr(problem, "operator", problem), light))


def _take_step(state, solver, light, problem):
    return _strong(solver.step(getattr(problem, "operator", problem), light, state))


def _strong(state):
    # A number of a weak type at first, and of a strong one after a step, would compile the step twice.
    return jax.tree.map(lambda leaf: lax.convert_element_type(leaf, leaf.dtype), state)


_step, _step_in_place = jax.jit(_take_step), jax.jit(_take_step, donate_argnums=0)
