"""Searches with any loss, `optimize`; solvers step by step, and changes of variables that keep bounds.

Optimistix and optax have the algorithms, jaxopt the one that handles bounds itself; all have the interface of
optimistix. They run one step at a time from the host, so that progress can be shown and the state saved. A run that is
interrupted and resumed takes the same steps, bit for bit.
"""

import math
import warnings
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..base.arrays import as_float, host_code
from ..base.errors import InputError, InputWarning, check_kind, input_error, short_repr
from ..microscope.geometry import Imager
from ..microscope.media import check_room
from .parameters import Free, Values
from .study import StageTable

# From free variables and a key, which is new in every step, to residuals, or to the cost itself, a scalar.
Residual = Callable[[PyTree, Key[Array, ""]], Float[Array, "..."]]

CONVERGED = "converged: the cost does not change any more"
MET = "all targets are met"
FLAT = "stopped: the least cost has fallen by less than {:g} % in {} steps"
LIMIT = "stopped at the limit of {} steps"
NOT_FINITE = "stopped: the cost or a parameter is not finite"

# Steps over which a converged cost stays the same. A solver that rejects twenty steps in a row has shrunk them to less
# than a millionth.
_FLAT_STEPS = 20
# Distance of a start from a bound at least, as a fraction of the range: at the bound `Sigmoid` has no slope.
_NEAREST = 0.01
# Share of the predicted decrease that makes a step a good one (Nocedal and Wright, Numerical Optimization, 4.1).
_GOOD_STEP = 0.75


class Transform(eqx.Module):
    """A change of variables, between what a solver moves and values. This one changes nothing."""

    def forward(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The value of a free variable."""
        return free

    def inverse(self, value: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The free variable of a value; a value that is beyond the bounds is first moved inside."""
        return value


class Affine(Transform):
    """Values between bounds, which may be arrays that broadcast, as their fraction of the range, 0 to 1."""

    low: Float[Array, "..."] = eqx.field(converter=as_float)
    high: Float[Array, "..."] = eqx.field(converter=as_float)

    def forward(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return self.low + (self.high - self.low) * free

    def inverse(self, value: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return jnp.clip((value - self.low) / (self.high - self.low), 0, 1)


class Sigmoid(Affine):
    """Values between bounds as all numbers `x`: the fraction `(1 + x / sqrt(1 + x^2)) / 2` of the range.

    The ends of a logistic curve are so flat that a search that reaches them does not return. A value at a bound is
    moved inside by 1 % of the range.
    """

    def forward(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return super().forward((1 + free / jnp.sqrt(1 + free**2)) / 2)

    def inverse(self, value: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        share = jnp.clip(super().inverse(value), _NEAREST, 1 - _NEAREST)
        return (2 * share - 1) / (2 * jnp.sqrt(share * (1 - share)))


Transforms = dict[str, Transform]


@eqx.filter_jit
def forward(transforms: Transforms, free: Values) -> Values:
    """The values of free variables, by name."""
    return {name: transform.forward(free[name]) for name, transform in transforms.items()}


@eqx.filter_jit
def inverse(transforms: Transforms, values: Values) -> Values:
    """The free variables of values, by name; other values are left out."""
    return {name: transform.inverse(values[name]) for name, transform in transforms.items()}


def warn_if_moved(transforms: Transforms, values: Values) -> None:
    """Warn of each value that a search does not start from, because it is at a bound, near it or beyond."""
    for name, value in forward(transforms, inverse(transforms, values)).items():
        old, new = np.broadcast_arrays(np.asarray(values[name], float), np.asarray(value, float))
        moved = ~np.isclose(old, new, rtol=1e-4, atol=1e-6)
        if moved.any():
            text = f"{name} starts at {new[moved][0]:.6g} instead of {old[moved][0]:.6g}, to begin within its bounds."
            warnings.warn(text, InputWarning, stacklevel=2)


class LBFGSB(optx.AbstractMinimiser):
    """L-BFGS-B (Byrd, Lu, Nocedal and Zhu, SIAM J. Sci. Comput. 16, 1190, 1995), which keeps variables in 0 to 1.

    Scale other variables to that range before, as `Affine` does: the first step is as long as the gradient. The state
    is jaxopt's, the cost, and whether a step has changed neither cost nor variables by more than `least_change()`.
    """

    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Any] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> PyTree:
        return self._solver(fn).init_state(y, self._box(y), args), fn(y, args)[0], jnp.array(False)

    def step(self, fn, y, args, options, state, tags) -> tuple[PyTree, PyTree, Any]:
        inner, cost, _ = state
        new, inner = self._solver(fn).update(y, inner, self._box(y), args)
        value, aux = fn(new, args)

        def change(old, new):
            return jnp.max(jnp.abs(new - old) / (1 + jnp.abs(old)))

        changes = jax.tree.leaves(jax.tree.map(change, (y, cost), (new, value)))
        return new, (inner, value, jnp.max(jnp.stack(changes)) < least_change()), aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        return state[2], optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result) -> tuple[PyTree, Any, dict[str, Any]]:
        return y, aux, {}

    def _box(self, y):
        return jax.tree.map(jnp.zeros_like, y), jax.tree.map(jnp.ones_like, y)

    def _solver(self, fn):
        # Here, so that the other solvers do without a package that is no longer maintained.
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
            import jaxopt
        return jaxopt.LBFGSB(lambda y, args: fn(y, args)[0], maxiter=1, tol=0.0, implicit_diff=False)


Solver = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser | optax.GradientTransformation


def solver_of(stage: StageTable) -> Solver:
    """The solver that a stage names. Adam's learning rate falls to zero by a cosine over the steps."""
    tolerances = least_change(), least_change()
    match stage.solver:
        case "levenberg-marquardt":
            # The damping falls after a good step. By default a step is good if the cost falls by 99 % of what its
            # model predicts, which it does only where the problem is almost linear; elsewhere a search crawls.
            search = optx.ClassicalTrustRegion(high_cutoff=_GOOD_STEP)
            return eqx.tree_at(lambda s: s.search, optx.LevenbergMarquardt(*tolerances), search)
        case "bfgs":
            return optx.BFGS(*tolerances)
        case "lbfgs":
            return optx.LBFGS(*tolerances)
        case "lbfgsb":
            return LBFGSB()
        case "adam":
            # The precision of a stochastic search is that of its last steps.
            return optax.adam(optax.cosine_decay_schedule(stage.learning_rate, stage.steps))


class State(NamedTuple):
    """State of a search: all that its next step depends on, arrays only.

    `recent`: the last costs, oldest first; if the `Stepper` has `flat`, the least until each of the last steps.
    """

    free: PyTree[Array]
    solver: PyTree
    cost: Float[Array, ""]
    recent: Float[Array, " recent"]
    step: Int[Array, ""]
    converged: Bool[Array, ""]


def _as_solver(solver: Solver) -> optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser:
    if isinstance(solver, optax.GradientTransformation):
        return optx.OptaxMinimiser(solver, least_change(), least_change())
    return solver


class Stepper(eqx.Module):
    """A solver as compiled steps, the same programs for all numbers of one structure.

    Parameters
    ----------
    residual
        Residuals, whose cost is `|residual|^2 / 2`, or the cost itself, a scalar: a function, or a pytree whose numbers
        are leaves. Free variables are of order one without bounds; for `LBFGSB` they lie between 0 and 1.
    solver
        A run ends when the solver converges, or when the cost has not changed over 20 steps: by more than a millionth
        of it (1e-5 in single precision), or by more than `least_change()` with a solver of optax, whose schedule may
        begin with steps of nearly no length. Random residuals, which get a new key in each step, do not converge.
    key
        From which the keys of the steps follow.
    flat
        The run ends instead when the least cost so far has fallen by no more than this part of itself over `window`
        steps, with any solver. Not for random residuals.
    """

    residual: Residual
    solver: Any = eqx.field(converter=_as_solver)
    key: Key[Array, ""]
    flat: Float[Array, ""] | None = None
    window: int = eqx.field(static=True, default=_FLAT_STEPS)

    @eqx.filter_jit
    def begin(self, free: PyTree[Array]) -> State:
        """The state at free variables."""
        function, cost = self._functions(free)
        value, inner = cost(free, self.key), eqx.filter(self._init(function, free, self.key), eqx.is_array)
        state = State(free, inner, value, jnp.broadcast_to(value, self.window + 1), jnp.array(0), jnp.array(False))
        # Without weak types, which a step would take from it: it would be compiled again.
        return jax.tree.map(lambda x: x.astype(x.dtype), state)

    @eqx.filter_jit
    def advance(self, state: State) -> State:
        """The state one step later. It has converged if the solver is done, or the recent costs are flat."""
        key = jax.random.fold_in(self.key, state.step)
        function, cost = self._functions(state.free)
        # What of the solver's state is no array is the same in every step.
        shapes = eqx.filter_eval_shape(self._init, function, state.free, key)
        inner = eqx.combine(state.solver, eqx.filter(shapes, lambda x: not isinstance(x, jax.ShapeDtypeStruct)))
        with jax.numpy_dtype_promotion("standard"):  # Optax multiplies floats with the integer that counts its steps
            free, inner, _ = self.solver.step(function, state.free, key, {}, inner, frozenset())
        done, result = self.solver.terminate(function, free, key, {}, inner, frozenset())
        is_optax = isinstance(self.solver, optx.OptaxMinimiser)
        value, step = cost(free, key), state.step + 1
        # With `flat`, the least so far.
        recent = jnp.append(state.recent[1:], value if self.flat is None else jnp.minimum(state.recent[-1], value))
        converged = self.is_flat(recent, step) | ((done | (result != optx.RESULTS.successful)) & (not is_optax))
        return State(free, eqx.filter(inner, eqx.is_array), value, recent, step, converged)

    def is_flat(self, recent: Float[Array, " recent"], step: Int[Array, ""]) -> Bool[Array, ""]:
        """Whether the recent costs of a state differ by no more than the tolerance."""
        is_optax = isinstance(self.solver, optx.OptaxMinimiser)
        tolerance = (least_change() if is_optax else _flat_change()) if self.flat is None else self.flat
        return (jnp.ptp(recent) <= tolerance * jnp.max(jnp.abs(recent))) & (step >= self.window)

    def _functions(self, free):
        """The function that the solver takes, which has nothing to return beside its value; and the cost."""
        # Traced once: what a solver does with it does not run the user's code again. A new function, as JAX would give
        # the same object for another trace of the same one, and optimistix compares them by identity.
        residual = eqx.filter_closure_convert(lambda free, key: self.residual(free, key), free, self.key)

        def cost(free, key):
            value = residual(free, key)
            return value if jnp.ndim(value) == 0 else jnp.sum(value**2) / 2

        least_squares = isinstance(self.solver, optx.AbstractLeastSquaresSolver)
        if least_squares and jnp.ndim(eqx.filter_eval_shape(residual, free, self.key)) == 0:
            name = type(self.solver).__name__
            raise InputError(f"{name} needs residuals, an array, got a scalar loss; optimistix.BFGS takes a scalar.")
        value = residual if least_squares else cost
        return (lambda free, key: (value(free, key), None)), cost

    def _init(self, function, free, key):
        shape, _ = eqx.filter_eval_shape(function, free, key)
        return self.solver.init(function, free, key, {}, shape, None, frozenset())


def run(
    stepper: Stepper,
    state: State,
    *,
    limit: int,
    enough: float = 0.0,
    each: Callable[[State], None] = lambda state: None,
) -> tuple[State, str]:
    """Run steps until a stopping rule holds; return the state and the reason.

    Parameters
    ----------
    state
        From `stepper.begin`, or a saved one.
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
            if stepper.flat is not None and stepper.is_flat(state.recent, state.step):
                return state, FLAT.format(100 * float(stepper.flat), stepper.window)
            return state, CONVERGED
        if int(state.step) >= limit:
            return state, LIMIT.format(limit)
        state = stepper.advance(state)
        each(state)


def least_change() -> float:
    """Relative change of costs and parameters in one step at which a search ends, by precision."""
    return 1e-9 if jnp.zeros(()).dtype == jnp.float64 else 1e-6


def _flat_change() -> float:
    """Relative change of the cost over `_FLAT_STEPS` at which a search ends, by precision."""
    return 1e-6 if jnp.zeros(()).dtype == jnp.float64 else 1e-5


class Optimum(NamedTuple):
    """Result of `gs_jax.optimize`.

    `imager`: the best. `value`: its loss, of residuals half the sum of their squares. `result`: of
    `optimistix.RESULTS`, whether the solver converged, ran out of steps, or came to what is not finite. `stats`:
    `"num_steps"`, and `"values"`, the loss after each.
    """

    imager: Imager
    value: Float[Array, ""]
    result: optx.RESULTS
    stats: dict[str, Any]


class _Loss(eqx.Module):
    """A loss of an imager as a function of free variables."""

    loss: Callable[[Imager], Float[Array, "..."]]
    imager: Imager
    free: Free
    transforms: Transforms

    def at(self, free: Values) -> Imager:
        """The imager of free variables."""
        return self.free.replaced(self.imager, forward(self.transforms, free))

    def __call__(self, free: Values, key: Key[Array, ""]) -> Float[Array, "..."]:
        return self.loss(self.at(free))


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
        Traced and differentiated: `gs_jax.objectives` are made for it. A function that is used again finds its compiled
        programs. So does an `equinox.Module` or `jax.tree_util.Partial` with other numbers, which are its leaves;
        numbers in a closure are constants, and each new function is compiled.
    imager
        To start from. Use double precision (`jax_enable_x64`): single stops far from the minimum.
    free
        What may change, of `gs_jax.free`.
    solver
        Of optimistix, a minimiser, or for residuals one of least squares; of optax; or
        `gs_jax.codesign.solve.LBFGSB()`, which needs bounds for all. By default `optimistix.BFGS`. A search also ends
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
    >>> loss = lambda scope: (scope.magnification(20.0) - 0.25) ** 2
    >>> found = gs.optimize(loss, scope, free=gs.free("sensor_distance"), bounds={"sensor_distance": (4.0, 8.0)})
    >>> print(round(float(found.imager.magnification(20.0)), 2))
    0.25
    """
    solver = optx.BFGS(least_change(), least_change()) if solver is None else solver
    _check(loss, imager, free, solver, steps)
    transforms = _transforms(free, bounds, Affine if isinstance(solver, LBFGSB) else Sigmoid)
    values = free.values(imager)
    warn_if_moved(transforms, values)
    numbers = jax.tree.map(lambda x: as_float(x) if isinstance(x, float | np.ndarray) else x, loss)
    problem, start, key = _Loss(numbers, imager, free, transforms), inverse(transforms, values), jax.random.key(0)
    dtypes = [out.dtype for out in jax.tree.leaves(eqx.filter_eval_shape(problem, start, key))]
    if len(dtypes) != 1 or not jnp.issubdtype(dtypes[0], jnp.floating):
        got = ", ".join(map(str, dtypes)) or "nothing"
        raise InputError(f"optimize: loss must return one number or array of floating point, got {got}.")
    losses = []

    def after(state):
        losses.append(float(state.cost))
        if callback is not None:
            callback(int(state.step), losses[-1], problem.at(state.free))

    stepper = Stepper(problem, solver, key)
    state, reason = run(stepper, stepper.begin(start), limit=steps, enough=-math.inf, each=after)
    results = {CONVERGED: optx.RESULTS.successful, NOT_FINITE: optx.RESULTS.nonlinear_divergence}
    result = results.get(reason, optx.RESULTS.nonlinear_max_steps_reached)
    best = problem.at(state.free)
    try:
        check_room(best.sensor_distance, best.filters, best.windows, best.sample, best.array.orientation)
    except ValueError as error:
        raise InputError(f"optimize: other bounds are needed: {error}") from error
    return Optimum(best, state.cost, result, {"num_steps": int(state.step), "values": np.array(losses)})


def _check(loss, imager, free, solver, steps):
    if not callable(loss):
        raise input_error("loss", "a function of an imager", short_repr(loss))
    check_kind("imager", imager, Imager, "an Imager, as `design.imager()` is")
    check_kind("free", free, Free, "a Free, as `gs_jax.free` makes it")
    check_kind("solver", solver, Solver, "a solver of optimistix or optax, or LBFGSB()")
    check_kind("steps", steps, int | np.integer, "a whole number")
    if steps < 1:
        raise InputError(f"steps must be 1 or more, got {steps}.")


def _transforms(free: Free, bounds: Mapping[str, tuple[Any, Any]], between: type[Affine]) -> Transforms:
    """The changes of variables by bounds, which `LBFGSB` needs for all that is free."""
    transforms: Transforms = dict.fromkeys(free.names, Transform())
    for name, (low, high) in bounds.items():
        if name not in free.names:
            raise InputError(f"bounds: names must be among the free ones, {', '.join(free.names)}, got {name}.")
        low, high = np.asarray(low, float), np.asarray(high, float)
        if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
            raise InputError(f"bounds of {name} must be finite, the lower one first, got {low} to {high}.")
        transforms[name] = between(low, high)
    if between is Affine and (missing := [name for name in free.names if name not in bounds]):
        raise InputError(f"bounds: LBFGSB needs bounds of all that is free, got none of {missing[0]}.")
    return transforms
