"""Solver interface and result, the loop that runs a solver, and the differences of total variation.

A solver is an `eqx.Module` that holds its options and has three methods: `init`, `step` and `estimate`. Its state keeps
what does not change from step to step, so that it is computed once. `solve` runs all steps in one compiled loop;
callers that show or interrupt the iteration call `step` themselves.
"""

import dataclasses
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Num, PyTree

from ..base.arrays import divide, native, safe_sqrt
from ..base.errors import InputError

# Weights with a standard deviation of one voxel.
_BINOMIAL = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)


class UnmatchedAdjointOperator(eqx.Module):
    """Operator with a back-projection that is not its adjoint: `A.mv` is `forward.mv`, `A.T.mv` is `back.mv`.

    Richardson-Lucy converges in fewer steps with a back-projection that is sharper than the adjoint (Zeng and Gullberg,
    IEEE Trans. Med. Imaging 19, 548, 2000).

    Parameters
    ----------
    forward, back
        From volumes to images, and from images to volumes.
    least_squares
        Operator for least squares, which use its exact adjoint; by default `forward`.
    kept
        1 for pixels that count, and 0 for those that are left out; `forward` is zero there, and `back` does not read
        them. None keeps all.
    """

    forward: lx.AbstractLinearOperator
    back: lx.AbstractLinearOperator
    least_squares: lx.AbstractLinearOperator | None = None
    kept: Float[Array, "..."] | None = None

    @property
    def T(self) -> "UnmatchedAdjointOperator":
        return UnmatchedAdjointOperator(self.back, self.forward)

    def mv(self, vector):
        return self.forward.mv(vector)

    def in_structure(self):
        return self.forward.in_structure()

    def out_structure(self):
        return self.forward.out_structure()


Operator = lx.AbstractLinearOperator | UnmatchedAdjointOperator


def kept_pixels(A: Operator) -> Float[Array, "..."] | None:
    """The pixels that an operator does not leave out; None if it keeps all."""
    return getattr(A, "kept", None)


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


class Solution(eqx.Module):
    """Result of a solver.

    Parameters
    ----------
    x
        The estimate.
    costs
        Cost at the start of each step; NaN after the last step taken.
    steps
        Number of steps taken.
    converged
        Whether the residual fell below the tolerance.
    """

    x: Float[Array, "*shape"]
    costs: Float[Array, " step"]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def solve(A: eqx.Module, image: Num[Array | np.ndarray, "..."], solver: Solver) -> Solution:
    """Run a solver on an image, for all its steps or until its tolerance is met.

    *Differentiable.*

    Gradients are with respect to the image, the leaves of `A` and the solver's weights. Reverse mode needs
    `tolerance=0`. The loop is compiled once: other numbers in the image, the leaves of the operator, the weights that
    are leaves, or the tolerance run the same program. An operator around a new Python function, such as a
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

    Raises
    ------
    InputError
        If the image does not have the operator's output shape.

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> import numpy as np
    >>> image = gs.forward(np.ones(grid.volume_shape), scope, grid)
    >>> solution = gs.solve(gs.ImagingOperator(scope, grid), image, gs.RichardsonLucy(steps=5))
    >>> solution.x.shape, solution.costs.shape
    ((3, 41, 41), (5,))
    """
    tolerance = jnp.asarray(solver.tolerance) if solver.tolerance else None
    module: Any = solver  # the protocol does not say that it is one
    # Python's numbers become arguments of the program.
    is_number = lambda leaf: isinstance(leaf, int | float) and not isinstance(leaf, bool)
    module = dataclasses.replace(module, tolerance=0.0)
    module = jax.tree.map(lambda leaf: jnp.asarray(leaf) if is_number(leaf) else leaf, module)
    return _solve(native(A), native(image), module, tolerance)


@eqx.filter_jit
def _solve(A, image, solver, tolerance) -> Solution:
    state = solver.init(A, image)
    if tolerance is None:
        state, costs = lax.scan(lambda s, _: solver.step(A, image, s)[:2], state, length=solver.steps)
        return Solution(solver.estimate(state), costs, jnp.array(solver.steps), jnp.array(False))

    def unfinished(carry):
        _, _, number, residual = carry
        return (number < solver.steps) & (residual >= tolerance)

    def advance(carry):
        state, costs, number, _ = carry
        state, cost, residual = solver.step(A, image, state)
        return state, costs.at[number].set(cost), number + 1, residual

    _, cost, residual = jax.eval_shape(lambda s: solver.step(A, image, s), state)
    start = state, jnp.full(solver.steps, jnp.nan, cost.dtype), jnp.array(0), jnp.array(jnp.inf, residual.dtype)
    state, costs, number, residual = lax.while_loop(unfinished, advance, start)
    return Solution(solver.estimate(state), costs, number, residual < tolerance)


def check_options(solver: Any) -> None:
    """Raise an `InputError` if one of the solver's options is below its minimum."""
    minima = {"steps": 1, "cg_steps": 1, "tolerance": 0, "sparsity": 0, "tv": 0, "tv_z": 0, "min_sensitivity": 0}
    for name, minimum in minima.items():
        value = getattr(solver, name, minimum)
        if isinstance(value, int | float) and not value >= minimum:
            raise InputError(f"{name} must be {minimum} or more, got {value}.")


def as_image(A: Any, image: Num[Array | np.ndarray, "..."]) -> Float[Array, "..."]:
    """Convert `image` to the operator's type; raise an `InputError` if it is not of its output shape."""
    expected = A.out_structure()
    if image.shape != expected.shape:
        raise InputError(f"image must have the operator's output shape {expected.shape}, got {image.shape}.")
    return jnp.asarray(image, expected.dtype)


def lambda_max(back: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Smallest L1 weight for which `x = 0` is optimal, `max(A' image, 0)`, from `back = A' image`.

    The slope of `|A x - image|^2 / 2 + weight sum(x)` at 0 is `weight - A' image`, nowhere negative from this weight
    on.
    """
    return jnp.maximum(jnp.max(back), 0)


def blurred(x: Float[Array, "depth y x"]) -> Float[Array, "depth y x"]:
    """A volume blurred laterally, with a standard deviation of one voxel; zeros are beyond it."""
    reach = len(_BINOMIAL) // 2
    for axis in (1, 2):
        padded = jnp.pad(x, [(reach, reach) if along == axis else (0, 0) for along in range(3)])
        shifted = [lax.slice_in_dim(padded, i, i + x.shape[axis], axis=axis) for i in range(len(_BINOMIAL))]
        x = sum((w * part for w, part in zip(_BINOMIAL, shifted, strict=True)), jnp.zeros_like(x))
    return x


def norm(x: PyTree) -> Float[Array, ""]:
    """Euclidean norm of all leaves together; its gradient is 0 at 0."""
    square = sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(x))
    return safe_sqrt(jnp.asarray(square))


def differences(x: Float[Array, "*shape"], *, wrap: bool) -> Float[Array, " axis *shape"]:
    """Forward differences along each axis longer than 1; the last one is 0, or periodic with `wrap`."""

    def along(axis):
        difference = jnp.roll(x, -1, axis) - x
        return difference if wrap else difference.at[(slice(None),) * axis + (-1,)].set(0)

    axes = [axis for axis, size in enumerate(x.shape) if size > 1]
    return jnp.stack([along(axis) for axis in axes]) if axes else jnp.zeros((0, *x.shape), x.dtype)


def differences_adjoint(u: Float[Array, " axis *shape"], *, wrap: bool) -> Float[Array, "*shape"]:
    """Exact adjoint of `differences`: minus the divergence."""
    x = jax.ShapeDtypeStruct(u.shape[1:], u.dtype)
    return jax.linear_transpose(lambda x: differences(x, wrap=wrap), x)(u)[0]


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
