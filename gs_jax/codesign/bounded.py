"""Minimisation within bounds, and proximal gradient, by `jaxopt`.

The only module that imports `jaxopt`, which is no longer maintained.
"""

import warnings
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
    import jaxopt

Objective = Callable[[PyTree], Float[Array, ""]]
# The point, its objective, the steps taken, and whether the tolerance was met.
Minimum = tuple[PyTree, Float[Array, ""], Int[Array, ""], Bool[Array, ""]]


def minimise_within(
    objective: Objective, start: PyTree, lower: PyTree, upper: PyTree, *, steps: int, tolerance: float = 1e-5
) -> Minimum:
    """L-BFGS-B: a smooth objective within bounds (Byrd, Lu, Nocedal and Zhu, SIAM J. Sci. Comput. 16, 1190, 1995).

    Scale the variables to about one before: the first step is as long as the gradient.

    Parameters
    ----------
    objective
        A function of one pytree of arrays to a number, differentiable.
    start, lower, upper
        Pytrees of one structure; infinite bounds are none. The start is moved within the bounds.
    steps, tolerance
        The most to take, and the norm of the projected gradient at which to stop.

    Returns
    -------
    tuple
        The minimum, its objective, the steps taken, and whether the tolerance was met.
    """
    bounds = lower, upper
    solver = lbfgsb(objective, steps=steps, tolerance=tolerance)
    start = jax.tree.map(jnp.clip, start, lower, upper)
    return _minimum(objective, *solver.run(start, bounds=bounds), tolerance)


def lbfgsb(objective: Callable[..., Float[Array, ""]], *, steps: int = 1, tolerance: float = 0.0) -> jaxopt.LBFGSB:
    """The solver of `minimise_within`, to be run step by step: `init_state(x, bounds)`, `update(x, state, bounds)`."""
    return jaxopt.LBFGSB(objective, maxiter=steps, tol=tolerance, implicit_diff=False)


def proximal_gradient(
    objective: Objective,
    prox: Callable[[PyTree, Float[Array, ""]], PyTree],
    start: PyTree,
    *,
    steps: int,
    tolerance: float = 1e-5,
) -> Minimum:
    """Accelerated proximal gradient with a line search: a smooth objective plus one with a proximal map.

    For least squares with sparsity there is `fista`, which knows its step and needs no line search.

    Parameters
    ----------
    objective
        The smooth part, as for `minimise_within`.
    prox
        `prox(x, t)` minimises `|y - x|^2 / 2 + t g(y)` over `y`, for the other part `g`.
    start
        A pytree.
    steps, tolerance
        The most to take, and the norm of the change over the step length at which to stop.

    Returns
    -------
    tuple
        The minimum, the smooth part there, the steps taken, and whether the tolerance was met.
    """
    solver = jaxopt.ProximalGradient(
        objective, lambda x, _, scaling: prox(x, scaling), maxiter=steps, tol=tolerance, implicit_diff=False
    )
    return _minimum(objective, *solver.run(start, None), tolerance)


def _minimum(objective, x, state, tolerance):
    return x, objective(x), state.iter_num, state.error <= tolerance
