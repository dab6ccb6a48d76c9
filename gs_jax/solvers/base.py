"""What every iterative solver shares: how it is called, its result, its stopping rule and its history.

A solver is an object that holds its options and knows three things: where to start, a step, and what to take for the
estimate. What stays the same from step to step is computed once, in the state. `solve` runs all steps, in one compiled
loop; whoever wants to see or end each step calls them one by one.
"""

from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Num, PyTree

from ..base.arrays import divide, safe_sqrt
from ..base.errors import InputError


@runtime_checkable
class Solver(Protocol):
    """What a solver must have, besides being an `eqx.Module`."""

    @property
    def steps(self) -> int:
        """The most to take."""
        ...

    @property
    def tolerance(self) -> float:
        """The residual below which it ends; 0 runs all steps, and can be differentiated in reverse."""
        ...

    def init(self, A: Any, image: Any, /) -> Any:
        """The state before the first step: a pytree of arrays."""
        ...

    def step(self, A: Any, image: Any, state: Any, /) -> tuple[Any, Array, Array]:
        """The next state, the cost of the point that the step started from, and a residual without unit."""
        ...

    def estimate(self, state: Any) -> Array:
        """The volume that a state stands for."""
        ...


class Solution(eqx.Module):
    """What a solver found.

    Parameters
    ----------
    x
        The estimate.
    costs
        One a step, of the point that the step started from; NaN after the last step.
    steps
        How many were taken.
    converged
        Whether the residual fell below the tolerance; if not, the steps ran out.
    """

    x: Float[Array, "*shape"]
    costs: Float[Array, " step"]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def solve(A: eqx.Module, image: Num[Array | np.ndarray, "..."], solver: Solver) -> Solution:
    """Explain an image: all steps of a solver, or as many as its tolerance asks for.

    *Differentiable*: without a tolerance, by the image, what `A` holds and the solver's weights. It may be called
    inside `jit`, to which `gs_jax.ImagingOperator` comes as an argument; `gs_jax.reconstruct` is the host's function,
    from a capture to a volume.

    Parameters
    ----------
    A
        From a volume to an image; for `ConvolutionADMM`, a `Convolution`.
    image
        To be explained.
    solver
        `RichardsonLucy(...)`, `FISTA(...)`, `ADMM(...)`, or another `Solver`.

    Raises
    ------
    InputError
        If the image is not of the operator's output shape.

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> import numpy as np
    >>> image = gs.forward(np.ones(grid.volume_shape), scope, grid)
    >>> found = gs.solve(gs.ImagingOperator(scope, grid), image, gs.RichardsonLucy(steps=5))
    >>> found.x.shape, found.costs.shape
    ((3, 41, 41), (5,))
    """
    state = solver.init(A, image)
    if not solver.tolerance:
        state, costs = lax.scan(lambda s, _: solver.step(A, image, s)[:2], state, length=solver.steps)
        return Solution(solver.estimate(state), costs, jnp.array(solver.steps), jnp.array(False))

    def going(carry):
        _, _, number, residual = carry
        return (number < solver.steps) & (residual >= solver.tolerance)

    def advance(carry):
        state, costs, number, _ = carry
        state, cost, residual = solver.step(A, image, state)
        return state, costs.at[number].set(cost), number + 1, residual

    _, cost, residual = jax.eval_shape(lambda s: solver.step(A, image, s), state)
    start = state, jnp.full(solver.steps, jnp.nan, cost.dtype), jnp.array(0), jnp.array(jnp.inf, residual.dtype)
    state, costs, number, residual = lax.while_loop(going, advance, start)
    return Solution(solver.estimate(state), costs, number, residual < solver.tolerance)


def check_options(solver: Any) -> None:
    """Raises an `InputError` if an option that the solver has is below the least that it may be."""
    for name, least in {"steps": 1, "cg_steps": 1, "tolerance": 0, "sparsity": 0, "tv": 0, "least_seen": 0}.items():
        found = getattr(solver, name, least)
        if isinstance(found, int | float) and not found >= least:
            raise InputError(f"{name}: found {found}, allowed: {least} or more.")


def as_image(A: Any, image: Num[Array | np.ndarray, "..."]) -> Float[Array, "..."]:
    """`image` in the operator's type; raises an `InputError` that names the shapes if it is not of its output's."""
    expected = A.out_structure()
    if image.shape != expected.shape:
        raise InputError(f"image: found {image.shape}, allowed: the operator's output shape, {expected.shape}.")
    return jnp.asarray(image, expected.dtype)


def least_weight_of_darkness(back: Float[Array, "*shape"]) -> Float[Array, ""]:
    """The unit of weights, `max(A' image)` of `back = A' image`, or 0 if that is negative.

    With this weight of the sum of `x`, or a larger one, the least cost is that of `x = 0`: the slope of
    `|A x - image|^2 / 2 + weight sum(x)` there is `weight - A' image`, which is nowhere negative.
    """
    return jnp.maximum(jnp.max(back), 0)


def norm(x: PyTree) -> Float[Array, ""]:
    """Euclidean norm of all leaves together; its gradient is 0 at 0."""
    square = sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(x))
    return safe_sqrt(jnp.asarray(square))


class Unmatched(eqx.Module):
    """An operator with another one in the place of its transpose: `A.mv` is `forward`'s, `A.T.mv` is `back`'s.

    Enough of an operator for Richardson-Lucy, which comes to its end in fewer steps if what goes back is sharper than
    the adjoint (Zeng and Gullberg, IEEE Trans. Med. Imaging 19, 548, 2000).

    Parameters
    ----------
    forward, back
        From volumes to images, and the other way.
    squares
        What least squares invert, with its own transpose, in the place of both; by default `forward`.
    """

    forward: lx.AbstractLinearOperator
    back: lx.AbstractLinearOperator
    squares: lx.AbstractLinearOperator | None = None

    @property
    def T(self) -> "Unmatched":
        return Unmatched(self.back, self.forward)

    def mv(self, vector):
        return self.forward.mv(vector)

    def in_structure(self):
        return self.forward.in_structure()

    def out_structure(self):
        return self.forward.out_structure()


def differences(x: Float[Array, "*shape"], *, wrap: bool) -> Float[Array, " axis *shape"]:
    """Forward differences along each axis that is longer than 1; the last one is 0, or to the first if they wrap."""

    def along(axis):
        difference = jnp.roll(x, -1, axis) - x
        return difference if wrap else difference.at[(slice(None),) * axis + (-1,)].set(0)

    axes = long_axes(x.shape)
    return jnp.stack([along(axis) for axis in axes]) if axes else jnp.zeros((0, *x.shape), x.dtype)


def differences_adjoint(u: Float[Array, " axis *shape"], *, wrap: bool) -> Float[Array, "*shape"]:
    """The exact adjoint of `differences`: minus the divergence."""
    x = jax.ShapeDtypeStruct(u.shape[1:], u.dtype)
    return jax.linear_transpose(lambda x: differences(x, wrap=wrap), x)(u)[0]


def long_axes(shape: tuple[int, ...]) -> list[int]:
    """Axes along which there are neighbours."""
    return [axis for axis, size in enumerate(shape) if size > 1]


def magnitude(u: Float[Array, " axis *shape"]) -> Float[Array, "*shape"]:
    """Length of the vector of differences at each voxel; its gradient is 0 where they are."""
    return safe_sqrt(jnp.sum(u**2, axis=0))


def total_variation(u: Float[Array, " axis *shape"], *, isotropic: bool) -> Float[Array, ""]:
    """Of the differences `u`: the sum of their lengths (isotropic) or of their absolute values."""
    return jnp.sum(magnitude(u) if isotropic else jnp.abs(u))


def shrink(u: Float[Array, " axis *shape"], threshold, *, isotropic: bool) -> Float[Array, " axis *shape"]:
    """The proximal map of `threshold` times `total_variation`: soft thresholding, of vectors or of numbers."""
    if not isotropic:
        return u - jnp.clip(u, -threshold, threshold)
    length = magnitude(u)
    return u * divide(jnp.maximum(length - threshold, 0), length)[None]
