"""Solvers of a search, step by step, and the changes of variables that keep bounds.

Optimistix has the algorithms, jaxopt the one that handles bounds itself. They run one step at a time from the host, so
that progress can be shown and the state saved. A run that is interrupted and resumed takes the same steps, bit for bit.

`Bounds` maps a value between bounds to an unbounded number of order one, and back; `Box` maps it to its fraction of the
range, for the solver that handles bounds itself. A checkpoint has the log of a search as one line of JSON, then the
solver's state as arrays.
"""

import hashlib
import io
import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..base.arrays import as_float
from ..base.errors import InputError, InputWarning
from ..design.design import Design
from ..io.files import atomic_write, check_input, decoding
from ..typing import PathLike
from .study import StageTable, Study
from .terms import TERMS

# Residuals of free parameters, of arguments that do not change within a run, and of a key that is new in every step.
Residual = Callable[[PyTree, PyTree, Key[Array, ""]], Float[Array, " entry"]]


class LBFGSB(eqx.Module):
    """L-BFGS-B (Byrd, Lu, Nocedal and Zhu, SIAM J. Sci. Comput. 16, 1190, 1995), which keeps bounds by itself."""

    def of(self, objective: Callable[..., Float[Array, ""]]) -> Any:
        """A smooth objective step by step: `init_state(x, bounds)`, `update(x, state, bounds)`.

        Scale the variables to about one before: the first step is as long as the gradient.
        """
        # Here, so that the other solvers do without a package that is no longer maintained.
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
            import jaxopt
        return jaxopt.LBFGSB(objective, maxiter=1, tol=0.0, implicit_diff=False)


Solver = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser | optax.GradientTransformation | LBFGSB

CONVERGED = "converged: the cost does not change any more"
MET = "all targets are met"
LIMIT = "stopped at the limit of {} steps"
NOT_FINITE = "stopped: the cost or a parameter is not finite"

# Steps over which a converged cost stays the same. A solver that rejects twenty steps in a row has shrunk them to less
# than a millionth.
_FLAT_STEPS = 20


class State(NamedTuple):
    """State of a solver: all that its next step depends on, arrays only. `recent`: the last costs, oldest first."""

    free: PyTree[Array]
    solver: PyTree
    cost: Float[Array, ""]
    recent: Float[Array, " recent"]
    step: Int[Array, ""]
    converged: Bool[Array, ""]

    @classmethod
    def at_start(cls, free: PyTree[Array], solver: PyTree, cost: Float[Array, ""]) -> "State":
        recent = jnp.broadcast_to(cost, _FLAT_STEPS + 1)
        return cls(free, solver, cost, recent, jnp.array(0), jnp.array(False))

    def moved(
        self,
        free: PyTree[Array],
        solver: PyTree,
        cost: Float[Array, ""],
        done: Bool[Array, ""] | bool,
        tolerance: float,
    ) -> "State":
        """The state one step later. It has converged if the solver is done, or the recent costs are flat."""
        recent = jnp.append(self.recent[1:], cost)
        flat = jnp.ptp(recent) <= tolerance * jnp.max(jnp.abs(recent))
        return State(free, solver, cost, recent, self.step + 1, done | (flat & (self.step + 1 >= _FLAT_STEPS)))


def _as_solver(solver: Solver) -> Solver:
    if isinstance(solver, optax.GradientTransformation):
        return optx.OptaxMinimiser(solver, least_change(), least_change())
    return solver


class Stepper(eqx.Module):
    """A solver as compiled steps, the same programs for all numbers of one structure.

    Parameters
    ----------
    residual
        Residuals, whose cost is `|residual|^2 / 2`; or the cost itself, a scalar. A function, or a pytree whose numbers
        are leaves. Free parameters are of order one without bounds; for `LBFGSB` they lie between 0 and 1.
    solver
        A run ends when the solver converges, or when the cost has not changed over 20 steps: by more than a millionth
        of it (1e-5 in single precision), or by more than `least_change()` with a solver of optax, whose schedule may
        begin with steps of nearly no length. Random residuals, which get a new key in each step, do not converge.
    key
        From which the keys of the steps follow.
    """

    residual: Residual
    solver: Any = eqx.field(converter=_as_solver)
    key: Key[Array, ""]

    @eqx.filter_jit
    def begin(self, free: PyTree[Array], given: PyTree) -> State:
        """The state at free parameters, with the arguments of a run."""
        args = given, self.key
        residual, cost = self._traced(free, args)
        if isinstance(self.solver, LBFGSB):
            inner = self.solver.of(cost).init_state(free, _box(free), args)
        else:
            init, _ = self._init(residual, cost, free, args)
            inner = eqx.filter(init(), eqx.is_array)
        return State.at_start(free, inner, cost(free, args))

    @eqx.filter_jit
    def advance(self, state: State, given: PyTree) -> State:
        """The state one step later."""
        args = given, jax.random.fold_in(self.key, state.step)
        residual, cost = self._traced(state.free, args)
        if isinstance(self.solver, LBFGSB):
            return _advance_within_box(self.solver.of(cost), cost, state, args)
        steps, is_optax = self.solver, isinstance(self.solver, optx.OptaxMinimiser)
        init, function = self._init(residual, cost, state.free, args)
        # What of the solver's state is no array is the same in every step.
        static = eqx.filter(eqx.filter_eval_shape(init), lambda x: not isinstance(x, jax.ShapeDtypeStruct))
        inner = eqx.combine(state.solver, static)
        with jax.numpy_dtype_promotion("standard"):  # Optax multiplies floats with the integer that counts its steps
            new, inner, _ = steps.step(function, state.free, args, {}, inner, frozenset())
        done, result = steps.terminate(function, new, args, {}, inner, frozenset())
        done = (done | (result != optx.RESULTS.successful)) & (not is_optax)
        tolerance = least_change() if is_optax else _flat_change()
        return state.moved(new, eqx.filter(inner, eqx.is_array), cost(new, args), done, tolerance)

    def _traced(self, free, args):
        """The residuals and their cost; what a solver does with them does not run the user's code again."""
        residual = eqx.filter_closure_convert(lambda free, args: self.residual(free, *args), free, args)

        def cost(free, args):
            value = residual(free, args)
            return value if jnp.ndim(value) == 0 else jnp.sum(value**2) / 2

        return residual, cost

    def _init(self, residual, cost, free, args):
        """The function that makes the solver's first state, and the function that the solver takes."""
        least_squares = isinstance(self.solver, optx.AbstractLeastSquaresSolver)
        if least_squares and jnp.ndim(eqx.filter_eval_shape(residual, free, args)) == 0:
            name = type(self.solver).__name__
            raise InputError(f"{name} needs residuals, an array, got a scalar loss; optimistix.BFGS takes a scalar.")

        def function(free, args):
            return (residual if least_squares else cost)(free, args), None

        out, _ = eqx.filter_eval_shape(function, free, args)
        return partial(self.solver.init, function, free, args, {}, out, None, frozenset()), function


def _box(free):
    return jax.tree.map(jnp.zeros_like, free), jax.tree.map(jnp.ones_like, free)


def _advance_within_box(solver, cost, state: State, args: PyTree) -> State:
    new, inner = solver.update(state.free, state.solver, _box(state.free), args)
    value, tolerance = cost(new, args), least_change()

    def still(old, new):
        return jnp.max(jnp.abs(new - old) / (1 + jnp.abs(old))) < tolerance

    same = jax.tree.leaves(jax.tree.map(still, (state.free, state.cost), (new, value)))
    return state.moved(new, inner, value, jnp.all(jnp.stack(same)), _flat_change())


def run(
    steps: Stepper,
    state: State,
    given: PyTree,
    *,
    limit: int,
    enough: float = 0.0,
    each: Callable[[State], None] = lambda state: None,
) -> tuple[State, str]:
    """Run steps until a stopping rule holds; return the state and the reason.

    Parameters
    ----------
    state
        From `steps.begin`, or a saved one.
    limit
        Largest number of steps, counted from the start.
    enough
        Cost below which the run stops.
    each
        Called after every step.
    """
    while True:
        if not all(np.isfinite(x).all() for x in jax.tree.leaves((state.cost, state.free))):
            return state, NOT_FINITE
        if float(state.cost) < enough:
            return state, MET
        if state.converged:
            return state, CONVERGED
        if int(state.step) >= limit:
            return state, LIMIT.format(limit)
        state = steps.advance(state, given)
        each(state)


def solver_of(stage: StageTable) -> Solver:
    """The solver that a stage names. Adam's learning rate falls to zero by a cosine over the steps."""
    match stage.solver:
        case "levenberg-marquardt":
            # The damping falls after a good step. By default a step is good if the cost falls by 99 % of what its
            # model predicts, which it does only where the problem is almost linear; elsewhere a search crawls.
            search = optx.ClassicalTrustRegion(high_cutoff=_GOOD_STEP)
            return eqx.tree_at(lambda s: s.search, optx.LevenbergMarquardt(least_change(), least_change()), search)
        case "bfgs":
            return optx.BFGS(least_change(), least_change())
        case "lbfgs":
            return optx.LBFGS(least_change(), least_change())
        case "lbfgsb":
            return LBFGSB()
        case "adam":
            # The precision of a stochastic search is that of its last steps.
            return optax.adam(optax.cosine_decay_schedule(stage.learning_rate, stage.steps))


# Share of the predicted decrease that makes a step a good one (Nocedal and Wright, Numerical Optimization, 4.1).
_GOOD_STEP = 0.75


def least_change() -> float:
    """Relative change of costs and parameters in one step at which a search ends, by precision."""
    return 1e-9 if jnp.zeros(()).dtype == jnp.float64 else 1e-6


def _flat_change() -> float:
    """Relative change of the cost over `_FLAT_STEPS` at which a search ends, by precision."""
    return 1e-6 if jnp.zeros(()).dtype == jnp.float64 else 1e-5


# Distance of a start from a bound at least, as a fraction of the range: at the bound the map has no slope.
_NEAREST = 0.01


class Bounds(eqx.Module):
    """Map between values within bounds and all numbers `x`: the fraction `(1 + x / sqrt(1 + x^2)) / 2` of the range.

    The ends of a logistic curve are so flat that a search that reaches them does not return. Bounds may be arrays that
    broadcast against the value.
    """

    low: Float[Array, "..."] = eqx.field(converter=as_float)
    high: Float[Array, "..."] = eqx.field(converter=as_float)

    def value(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The value of a free number."""
        return self.low + (self.high - self.low) * (1 + free / jnp.sqrt(1 + free**2)) / 2

    def free(self, value: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The inverse of `value`. Values at a bound or beyond it are first moved inside by 1 % of the range."""
        share = jnp.clip((value - self.low) / (self.high - self.low), _NEAREST, 1 - _NEAREST)
        return (2 * share - 1) / (2 * jnp.sqrt(share * (1 - share)))


class Box(eqx.Module):
    """Map between values within bounds and their fraction of the range, 0 to 1."""

    low: Float[Array, "..."] = eqx.field(converter=as_float)
    high: Float[Array, "..."] = eqx.field(converter=as_float)

    def value(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The value of a fraction."""
        return self.low + (self.high - self.low) * free

    def free(self, value: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The inverse of `value`. Values beyond a bound are first clipped."""
        return jnp.clip((value - self.low) / (self.high - self.low), 0, 1)


def warn_if_moved(given: Mapping[str, Any], inside: Mapping[str, Any]) -> None:
    """Warn of each parameter that does not start where it was given, because it was at a bound, near it or beyond."""
    for name, value in given.items():
        old, new = np.broadcast_arrays(np.asarray(value, float), np.asarray(inside[name], float))
        moved = ~np.isclose(old, new, rtol=1e-4, atol=1e-6)
        if moved.any():
            text = f"{name} starts at {new[moved][0]:.6g} instead of {old[moved][0]:.6g}, to begin within its bounds."
            warnings.warn(text, InputWarning, stacklevel=2)


_FORMAT = "gs-jax checkpoint 4"


@dataclass
class Log:
    """Record of a search.

    `steps`: one record a step, with the worst entry of each term. `ends`: one record for each finished start of a
    stage, with the reason for stopping, whether all targets are met, and the values of the free parameters, in the
    units that their names end in.
    """

    steps: list[dict[str, Any]] = field(default_factory=list)
    ends: list[dict[str, Any]] = field(default_factory=list)


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
        found = json.loads(head)
        if found["format"] != _FORMAT:
            if str(found["format"]).startswith("gs-jax checkpoint"):
                raise InputError(f"{path}: a checkpoint of another version, which cannot be resumed.")
            raise ValueError
        log, owner = Log(**found["log"]), found["of"]
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
