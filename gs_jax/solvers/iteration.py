"""What every iterative solver shares: its result, its stopping rule, its history and its progress.

A solver is a function `step(state) -> (state, cost, residual)`. Without a tolerance all steps are run in a
`lax.scan`, through which `jax.grad` goes; with one, a `lax.while_loop` ends early.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Num, PyTree

from ..base.safe import safe_sqrt

# Called on the host after each step, with its number (from 1) and its cost.
Callback = Callable[[Any, Any], None]


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
        Whether the tolerance was met; if not, the steps ran out.
    """

    x: Float[Array, "*shape"]
    costs: Float[Array, " step"]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def iterate(
    step: Callable[[PyTree], tuple[PyTree, Array, Array]],
    state: PyTree,
    *,
    steps: int,
    tolerance: float = 0.0,
    callback: Callback | None = None,
) -> tuple[PyTree, Float[Array, " step"], Int[Array, ""], Bool[Array, ""]]:
    """Run a solver; it may be called inside `jit`.

    Parameters
    ----------
    step
        `step(state)` returns the next state, the cost, and a residual without unit.
    state
        A pytree of arrays.
    steps
        The most to take.
    tolerance
        The residual at which to stop. 0 runs all steps, and can be differentiated in reverse.
    callback
        Called on the host with the number of each step and its cost.

    Returns
    -------
    tuple
        The last state, and `costs`, `steps` and `converged` as in `Solution`.

    Raises
    ------
    ValueError
        If `steps` is less than 1, or `tolerance` is negative.
    """
    if steps < 1:
        raise ValueError(f"`steps` must be 1 or more, got {steps}.")
    if not tolerance >= 0:
        raise ValueError(f"`tolerance` must be 0 or more, got {tolerance}.")

    def counted(state, number):
        state, cost, residual = step(state)
        if callback is not None:
            jax.debug.callback(callback, number + 1, cost)
        return state, cost, residual

    if not tolerance:
        state, costs = lax.scan(lambda s, n: counted(s, n)[:2], state, jnp.arange(steps))
        return state, costs, jnp.array(steps), jnp.array(False)

    def going(carry):
        _, _, number, residual = carry
        return (number < steps) & (residual > tolerance)

    def advance(carry):
        state, costs, number, _ = carry
        state, cost, residual = counted(state, number)
        return state, costs.at[number].set(cost), number + 1, residual

    _, cost, residual = jax.eval_shape(step, state)
    start = state, jnp.full(steps, jnp.nan, cost.dtype), jnp.array(0), jnp.array(jnp.inf, residual.dtype)
    state, costs, number, residual = lax.while_loop(going, advance, start)
    return state, costs, number, residual <= tolerance


def as_image(A: lx.AbstractLinearOperator, image: Num[Array | np.ndarray, "..."]) -> Float[Array, "..."]:
    """`image` in the operator's type; raises a `ValueError` that names the shapes if it is not of its output's."""
    expected = A.out_structure()
    if image.shape != expected.shape:
        raise ValueError(f"`image` must be of the operator's output shape {expected.shape}, got {image.shape}.")
    return jnp.asarray(image, expected.dtype)


def norm(x: PyTree) -> Float[Array, ""]:
    """Euclidean norm of all leaves together; its gradient is 0 at 0."""
    square = sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(x))
    return safe_sqrt(jnp.asarray(square))
