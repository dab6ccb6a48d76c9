"""Interfaces of operators and solvers, the loops that run a solver, and what solvers share.

A solver is an `eqx.Module` that holds its options and has three methods: `init`, `step` and `estimate`. Its state keeps
what does not change from step to step, so that it is computed once. `solve` runs all steps in one compiled loop;
`run_solver` runs them one by one, with progress and a way out after each.
"""

import dataclasses
import math
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float, Num, PyTree

from ..base.arrays import check_real, divide, native, safe_sqrt
from ..base.errors import InputError, short_repr
from ..base.progress import Progress

# Steps on voxels four times and twice as wide, and on a solver's own, of those that it has.
_SHARES = 1.5, 0.4, 0.1
# Weights with a standard deviation of one voxel.
_BINOMIAL = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)


@runtime_checkable
class Operator(Protocol):
    """Interface of a linear operator: those of `lineax` have it.

    An operator may have more attributes. `kept` is 1 for pixels that count and 0 for others, where its images are 0;
    None keeps all. Where `T` is a back-projection that is not the adjoint, `project(volume, exact)` and
    `project_back(image, exact)` are, with a traced `exact`, the operator for least squares and its adjoint.
    """

    @property
    def T(self) -> Any:
        """The adjoint, or the back-projection that replaces it."""
        ...

    def mv(self, vector: Any, /) -> Array:
        """The image of a volume."""
        ...

    def in_structure(self) -> Any:
        """Shape and type of volumes."""
        ...

    def out_structure(self) -> Any:
        """Shape and type of images."""
        ...


def kept_pixels(A: Operator) -> Float[Array, "..."] | None:
    """1 for pixels that an operator keeps and 0 for others; None if it keeps all."""
    return getattr(A, "kept", None)


def project(A: Any, volume: Array, *, exact: Any) -> Array:
    """`A.mv`, or the image by the operator for least squares where `exact`, which may be traced, is true."""
    return A.project(volume, exact) if hasattr(A, "project") else A.mv(volume)


def project_back(A: Any, image: Array, *, exact: Any) -> Array:
    """`A.T.mv`, or the adjoint of the operator for least squares where `exact` is true."""
    return A.project_back(image, exact) if hasattr(A, "project_back") else A.T.mv(image)


@runtime_checkable
class Solver(Protocol):
    """Interface of a solver, which is also an `eqx.Module`."""

    @property
    def steps(self) -> int:
        """Maximum number of steps."""
        ...

    @property
    def tolerance(self) -> float:
        """Stop when the residual is below this; 0 runs all steps, and allows reverse-mode derivatives."""
        ...

    def init(self, A: Any, image: Any, /) -> Any:
        """State before the first step, a pytree of arrays."""
        ...

    def step(self, A: Any, image: Any, state: Any, /) -> tuple[Any, Array, Array]:
        """Next state, cost at the point where the step starts, and a dimensionless residual."""
        ...

    def estimate(self, state: Any) -> Array:
        """Volume of a state."""
        ...


class Refinement(eqx.Module):
    """Linear interpolation from wide voxels to narrow ones, for solvers that go on from a state on wide voxels.

    Such a solver has two more methods. `stages(count)` are the solvers for so many grids of wider voxels, from the
    widest on, and for its own grid; `refined(A, image, state, refinement)` is the state on narrower voxels.

    Parameters
    ----------
    rows, columns
        Weights of the wide voxels in each narrow one, along each axis.
    factor
        Width of a wide voxel in narrow ones. Pixels are wider by the same factor.
    """

    rows: Float[Array | np.ndarray, "row tall"]
    columns: Float[Array | np.ndarray, "column wide"]
    factor: Float[Array | np.ndarray, ""]

    @classmethod
    def of(cls, shape: tuple[int, int], wide: tuple[int, int], factor: int, dtype: Any) -> "Refinement":
        """Between planes with the same middle; beyond the outer wide voxels values are those of these."""

        def weights(count, wide_count):
            place = (np.arange(count) - (count - 1) / 2) / factor + (wide_count - 1) / 2
            place = np.clip(place, 0, wide_count - 1)[:, None]
            return np.maximum(1 - np.abs(place - np.arange(wide_count)), 0).astype(dtype)

        rows, columns = map(weights, shape, wide)
        return cls(rows, columns, np.asarray(factor, dtype))

    def values(
        self, volume: Float[Array | np.ndarray, "depth wide_row wide_column"]
    ) -> Float[Array, "depth row column"]:
        """Values of a volume at the narrow voxels."""
        return jnp.einsum("ya,dab,xb->dyx", self.rows, volume, self.columns)

    def light(
        self, volume: Float[Array | np.ndarray, "depth wide_row wide_column"]
    ) -> Float[Array, "depth row column"]:
        """A volume's light, shared by the narrow voxels."""
        return self.values(volume) / self.factor**2


def stages(
    solver: Any, count: int, last: Any = None, shares: tuple[float, ...] = _SHARES, least: tuple[int, ...] = (1, 1, 1)
) -> list[Any]:
    """Stages of a solver on so many grids of wider voxels and on its own, by default a few of its steps.

    Each stage has a share of the steps, and takes at least so many.
    """
    every = [
        dataclasses.replace(solver, steps=max(math.ceil(share * solver.steps), fewest))
        for share, fewest in zip(shares, least, strict=True)
    ]
    return [*every[:count], every[-1] if last is None else last]


class RESULTS(eqx.Enumeration):
    """How a solver ended, the `result` of a `Solution`; `RESULTS[result]` is the text.

    `converged`: the residual is below the tolerance. `steps_taken`: all steps were taken, as asked. `not_finite`: it
    failed, the estimate or its cost is NaN or infinite.

    Examples
    --------
    >>> import jax.numpy as jnp, lineax as lx
    >>> from gs_jax.solvers.base import RESULTS
    >>> A = lx.MatrixLinearOperator(jnp.ones((3, 2)))
    >>> solution = gs.solve(A, jnp.array([1.0, 1.0, jnp.nan]), gs.FISTA(), throw=False)
    >>> print(RESULTS[solution.result])
    The estimate is not finite: ...
    """

    converged = "The residual is below the tolerance."
    steps_taken = "All steps were taken."
    not_finite = "The estimate is not finite: the image or the operator has NaN or infinite values, or steps diverge."


class Solution(eqx.Module):
    """Result of a solver.

    Parameters
    ----------
    value
        The estimate.
    result
        How it ended, one of `gs_jax.solvers.base.RESULTS`.
    stats
        `num_steps`, the number of steps taken, and `costs`, the cost at the start of each step; NaN after the last one.
    state
        The solver's state after the last step, from which `solve` goes on.
    """

    value: Float[Array, "*shape"]
    result: RESULTS
    stats: dict[str, Array]
    state: Any


def solve(
    A: eqx.Module,
    image: Num[Array | np.ndarray, "..."],
    solver: Solver,
    *,
    max_steps: int | None = None,
    state: Any = None,
    throw: bool = True,
) -> Solution:
    """Run a solver on an image, for all its steps or until its tolerance is met.

    *Differentiable.*

    Gradients are with respect to the image, the leaves of `A` and the solver's weights. Reverse mode needs
    `tolerance=0`. The loop is compiled once: other numbers in the image, the leaves of the operator, the weights of the
    solver or its tolerance run the same program. An operator around a new Python function, such as a
    `lineax.FunctionLinearOperator`, is compiled anew. It may be called inside `jit`, with `gs_jax.ImagingOperator` as
    an argument. `gs_jax.reconstruct` is the host's function from a capture to a volume.

    Parameters
    ----------
    A
        Operator from a volume to an image; a `ConvolutionOperator` for `ConvolutionADMM`.
    image
        Image to explain.
    solver
        `RichardsonLucy(...)`, `FISTA(...)`, `ADMM(...)`, or another `Solver`.
    max_steps
        Most steps, by default `solver.steps`.
    state
        State to go on from, that of an earlier solution; by default `solver.init(A, image)`.
    throw
        Whether an estimate that is not finite raises an error. Inside `jit` that is `equinox.error_if`, which JAX does
        not keep in its compilation cache. If False, `result` says it.

    Raises
    ------
    InputError
        If the image does not have the operator's output shape or is complex, `solver` is no solver or does not fit the
        operator, or the estimate is not finite.

    Examples
    --------
    >>> image = gs.forward(np.ones(grid.volume_shape), scope, grid)
    >>> solution = gs.solve(gs.ImagingOperator(scope, grid), image, gs.RichardsonLucy(steps=5))
    >>> solution.value.shape, solution.stats["costs"].shape
    ((3, 41, 41), (5,))
    """
    check_solver("solver", solver)
    module: Any = solver  # the protocol does not say that it is one
    if max_steps is not None:
        # Solvers check the number.
        module = dataclasses.replace(module, steps=max_steps)
    steps, tolerance = module.steps, jnp.asarray(module.tolerance) if module.tolerance else None
    # Python's numbers become arguments of the program.
    is_number = lambda leaf: isinstance(leaf, int | float) and not isinstance(leaf, bool)
    module = dataclasses.replace(module, steps=1, tolerance=0.0)
    module = jax.tree.map(lambda leaf: jnp.asarray(leaf) if is_number(leaf) else leaf, module)
    solution = _solve(native(A), native(image), module, state, steps, tolerance)
    if not throw:
        return solution
    failed = solution.result == RESULTS.not_finite
    if not isinstance(failed, Tracer):
        if failed:
            raise InputError(RESULTS[RESULTS.not_finite])
        return solution
    return eqx.tree_at(lambda s: s.value, solution, RESULTS.not_finite.error_if(solution.value, failed))


@eqx.filter_jit
def _solve(A, image, solver, state, steps, tolerance) -> Solution:
    state = solver.init(A, image) if state is None else state
    if tolerance is None:
        state, costs = lax.scan(lambda s, _: solver.step(A, image, s)[:2], state, length=steps)
        number, converged = jnp.array(steps), jnp.array(False)
    else:

        def unfinished(carry):
            _, _, number, residual = carry
            return (number < steps) & (residual >= tolerance)

        def advance(carry):
            state, costs, number, _ = carry
            state, cost, residual = solver.step(A, image, state)
            return state, costs.at[number].set(cost), number + 1, residual

        _, cost, residual = jax.eval_shape(lambda s: solver.step(A, image, s), state)
        start = state, jnp.full(steps, jnp.nan, cost.dtype), jnp.array(0), jnp.array(jnp.inf, residual.dtype)
        state, costs, number, residual = lax.while_loop(unfinished, advance, start)
        converged = residual < tolerance
    value = solver.estimate(state)
    finite = jnp.isfinite(value).all() & jnp.isfinite(costs[number - 1])
    result = RESULTS.where(converged, RESULTS.converged, RESULTS.steps_taken)
    result = RESULTS.where(finite, result, RESULTS.not_finite)
    return Solution(value, result, {"num_steps": number, "costs": costs}, state)


class Run(NamedTuple):
    """Last state of a solver, cost and residual of its last step, and the number of steps."""

    state: Any
    cost: float = math.nan
    residual: float = math.nan
    steps: int = 0


def run_solver(
    solver: Any,
    light: Any,
    A: Any,
    progress: Progress,
    *,
    target: float = 0.0,
    state: Any = None,
    quarter: str = "",
) -> Run:
    """Run a solver step by step until it converges or the cost at the start of a step is below the target.

    Starts from `state`, which it overwrites, if given. `quarter`: as for `Progress.counter`.
    """
    run = Run(start_solver(solver, light, A) if state is None else state)
    with progress.counter("Iterating", solver.steps, quarter=quarter) as advance:
        for number in range(1, solver.steps + 1):
            state, cost, residual = _step_in_place(run.state, _for_one_step(solver), light, A)
            # Reading the numbers waits for the step: progress is true, and Ctrl-C ends it here.
            run = Run(state, float(cost), float(residual), number)
            if run.residual < solver.tolerance or run.cost < target:
                break
            advance()
    return run


def start_solver(solver: Any, light: Any, A: Any) -> Any:
    """State before the first step, by one compiled program."""
    return _init(_for_one_step(solver), light, A)


def refine_state(state: Any, solver: Any, light: Any, A: Any, refinement: Refinement) -> Any:
    """`solver.refined`, by one compiled program."""
    return _refine(state, _for_one_step(solver), light, A, refinement)


def take_step(state: Any, solver: Any, light: Any, A: Any) -> tuple[Any, Any, Any]:
    """`solver.step`, by one compiled program."""
    return _step(state, _for_one_step(solver), light, A)


def _for_one_step(solver):
    # Decided here and not in compiled code: another number of steps compiles nothing.
    return dataclasses.replace(solver, steps=1, tolerance=0.0)


def estimate_of(solver: Any, state: Any) -> Any:
    """`solver.estimate`, by one compiled program."""
    return _estimate(_for_one_step(solver), state)


@jax.jit
def _estimate(solver, state):
    return solver.estimate(state)


@jax.jit
def _init(solver, light, A):
    return _strong(solver.init(A, light))


@jax.jit
def _refine(state, solver, light, A, refinement):
    return _strong(solver.refined(A, light, state, refinement))


def _take_step(state, solver, light, A):
    return _strong(solver.step(A, light, state))


def _strong(state):
    # A number of a weak type at first, and of a strong one after a step, would compile the step twice.
    return jax.tree.map(lambda leaf: lax.convert_element_type(leaf, leaf.dtype), state)


_step, _step_in_place = jax.jit(_take_step), jax.jit(_take_step, donate_argnums=0)


def check_solver(name: str, solver: Any) -> None:
    """Raise an `InputError` unless this is an object with the methods of a solver."""
    # A class has the attributes of the protocol, too.
    if isinstance(solver, type) or not isinstance(solver, Solver):
        raise InputError(f"{name} must be an object such as FISTA(), got {short_repr(solver)}.")


def none_if_zero(weight: Any) -> Any:
    """None for Python's 0, which leaves a term out of the program; other weights are arguments of it."""
    return None if isinstance(weight, int | float) and weight == 0 else weight


def check_options(solver: Any) -> None:
    """Raise an `InputError` if one of the solver's options is below its minimum."""
    weights = "tolerance", "sparsity", "tv", "tv_z", "min_sensitivity", "smooth_depth", "smooth_brightness"
    for name, minimum in {"steps": 1, "cg_steps": 1, **dict.fromkeys(weights, 0)}.items():
        value = getattr(solver, name, minimum)
        if isinstance(value, int | float) and not value >= minimum:
            raise InputError(f"{name} must be {minimum} or more, got {value}.")


def as_image(A: Any, image: Num[Array | np.ndarray, "..."]) -> Float[Array, "..."]:
    """Convert `image` to the operator's type; raise an `InputError` if it is not of its output shape, or complex."""
    expected = A.out_structure()
    check_real("image", image)
    if image.shape != expected.shape:
        raise InputError(f"image must have the operator's output shape {expected.shape}, got {image.shape}.")
    return jnp.asarray(image, expected.dtype)


def lambda_max(back: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Smallest L1 weight for which `x = 0` is optimal, `max(A' image, 0)`, from `back = A' image`.

    The slope of `|A x - image|^2 / 2 + weight sum(x)` at 0 is `weight - A' image`, nowhere negative from this weight
    on.
    """
    return jnp.maximum(jnp.max(back), 0)


def blurred(x: Float[Array, "*depth y x"], weights: Any = _BINOMIAL) -> Float[Array, "*depth y x"]:
    """A volume blurred laterally, by default with a standard deviation of one voxel; zeros are beyond it."""
    reach = len(weights) // 2
    for axis in range(max(x.ndim - 2, 0), x.ndim):
        padded = jnp.pad(x, [(reach, reach) if along == axis else (0, 0) for along in range(x.ndim)])
        shifted = [lax.slice_in_dim(padded, i, i + x.shape[axis], axis=axis) for i in range(len(weights))]
        x = sum((w * part for w, part in zip(weights, shifted, strict=True)), jnp.zeros_like(x))
    return x


def norm(x: PyTree) -> Float[Array, ""]:
    """Euclidean norm of all leaves together; its gradient is 0 at 0."""
    square = sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(x))
    return safe_sqrt(jnp.asarray(square))


def differences(x: Float[Array, "*shape"]) -> Float[Array, " axis *shape"]:
    """Forward differences along each axis longer than 1; the last one is 0."""

    def along(axis):
        return (jnp.roll(x, -1, axis) - x).at[(slice(None),) * axis + (-1,)].set(0)

    axes = [axis for axis, size in enumerate(x.shape) if size > 1]
    return jnp.stack([along(axis) for axis in axes]) if axes else jnp.zeros((0, *x.shape), x.dtype)


def differences_adjoint(u: Float[Array, " axis *shape"]) -> Float[Array, "*shape"]:
    """Exact adjoint of `differences`: minus the divergence."""
    return jax.linear_transpose(differences, jax.ShapeDtypeStruct(u.shape[1:], u.dtype))(u)[0]


def magnitude(u: Float[Array, " axis *shape"]) -> Float[Array, "*shape"]:
    """Length of the gradient vector at each voxel; its derivative is 0 where the length is 0."""
    # A sum over an axis of two or three is slower than two or three terms.
    return safe_sqrt(sum((part * part for part in u), jnp.zeros(u.shape[1:], u.dtype)))


def total_variation(u: Float[Array, " axis *shape"], *, isotropic: bool) -> Float[Array, ""]:
    """Sum of the gradient's lengths (isotropic) or of the absolute values of the differences `u`."""
    return jnp.sum(magnitude(u) if isotropic else jnp.abs(u))


def shrink(u: Float[Array, " axis *shape"], threshold, *, isotropic: bool) -> Float[Array, " axis *shape"]:
    """Proximal map of `threshold * total_variation`: soft thresholding of vectors (isotropic) or of components."""
    if not isotropic:
        return u - jnp.clip(u, -threshold, threshold)
    length = magnitude(u)
    return u * divide(jnp.maximum(length - threshold, 0), length)[None]
