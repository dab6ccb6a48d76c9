"""FISTA: non-negative least squares with an L1 penalty, for any operator.

It minimises `|A x - image|^2 / 2 + l1 sum(x)` over `x >= 0` (Beck and Teboulle, SIAM J. Imaging Sci. 2, 183, 2009).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Num

from ..base.arrays import divide
from ..base.typing import Real
from .base import Operator, Refinement, as_image, check_options, lambda_max, norm, stages

# Steps of Lanczos' method find the largest eigenvalue to about a percent; the margin covers the rest.
_LANCZOS_STEPS, _MARGIN = 6, 1.05
# Squarings of the small matrix that they leave: the power method with 2 to the power of this many steps.
_SQUARINGS = 12


class State(NamedTuple):
    """State of `FISTA`: estimate, extrapolated point, momentum `t`, step length and L1 weight."""

    x: Array
    point: Array
    t: Array
    rate: Array
    weight: Array


class FISTA(eqx.Module):
    """FISTA: non-negative least squares with an L1 penalty, for any operator.

    *Differentiable.*

    It restarts when the momentum points uphill (O'Donoghue and Candes, Found. Comput. Math. 15, 715, 2015). A dark
    image gives zeros.

    Parameters
    ----------
    steps, tolerance
        As for `Solver`; the residual is the relative change of `x`.
    sparsity
        L1 weight, relative to `max(A' image)`, the smallest weight for which `x = 0` is optimal.

    Raises
    ------
    InputError
        If an option is negative or `steps` is 0.

    Examples
    --------
    >>> scene = np.zeros(grid.volume_shape)
    >>> scene[1, 19, 22] = 1.0
    >>> image = gs.forward(scene, scope, grid)
    >>> solution = gs.solve(gs.ImagingOperator(scope, grid), image, gs.FISTA(steps=30, sparsity=0.01))
    >>> print(bool(solution.stats["costs"][-1] < solution.stats["costs"][0]), bool(solution.value.min() >= 0))
    True True
    """

    steps: int = eqx.field(static=True, default=20)
    tolerance: float = eqx.field(static=True, default=0.0)
    sparsity: Real | Float[Array, ""] = 0.01

    def __check_init__(self):
        check_options(self)

    def init(self, A: Operator, image: Num[Array | np.ndarray, "..."]) -> State:
        image = as_image(A, image)
        back = A.T.mv(image)
        weight = jnp.asarray(self.sparsity, image.dtype) * lambda_max(back)
        one, zeros = jnp.ones((), back.dtype), jnp.zeros_like(back)
        return State(zeros, zeros, one, divide(one, _MARGIN * largest_eigenvalue(A)), weight)

    def step(
        self, A: Operator, image: Num[Array | np.ndarray, "..."], state: State
    ) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        x, point, t, rate, weight = state
        residual = A.mv(point) - as_image(A, image)
        cost = jnp.vdot(residual, residual) / 2 + weight * jnp.sum(jnp.abs(point))
        new = jnp.maximum(point - rate * (A.T.mv(residual) + weight), 0)
        uphill = jnp.vdot(point - new, new - x) > 0
        t_old = jnp.where(uphill, 1.0, t).astype(t.dtype)
        t_new = (1 + jnp.sqrt(1 + 4 * t_old**2)) / 2
        momentum = jnp.where(uphill, 0, (t_old - 1) / t_new)
        state = State(new, new + momentum * (new - x), t_new, rate, weight)
        return state, cost, divide(norm(new - x), norm(new))

    def estimate(self, state: State) -> Float[Array, "..."]:
        return state.x

    def stages(self, count: int) -> "list[FISTA]":
        return stages(self, count)

    def refined(self, A: Operator, image: Float[Array, "..."], state: State, refinement: Refinement) -> State:
        """The state on narrower voxels; the eigenvalue, whose vector is smooth, is that on wide ones."""
        weight = jnp.asarray(self.sparsity, image.dtype) * lambda_max(A.T.mv(image))
        x, point = refinement.light(state.x), refinement.light(state.point)
        return State(x, point, state.t, state.rate, weight)


def largest_eigenvalue(A: Operator) -> Float[Array, ""]:
    """Largest eigenvalue of `A' A`, approached from below by the method of Lanczos."""
    structure = A.in_structure()
    # Positive, as is the eigenvector if no entry is negative; random, in case an entry is and the vector is asymmetric.
    start = 1 + jax.random.uniform(jax.random.key(0), structure.shape, structure.dtype)

    def step(state, _):
        last, vector, beta = state
        new = A.T.mv(A.mv(vector)) - beta * last
        alpha = jnp.vdot(vector, new)
        new = new - alpha * vector
        length = norm(new)
        return (vector, divide(new, jnp.broadcast_to(length, new.shape)), length), (alpha, length)

    start = divide(start, jnp.broadcast_to(norm(start), start.shape))
    state = jnp.zeros_like(start), start, jnp.zeros((), start.dtype)
    alpha, beta = lax.scan(step, state, length=_LANCZOS_STEPS)[1]
    # Not `eigvalsh`, whose derivative is NaN where eigenvalues are equal.
    matrix = jnp.diag(alpha) + jnp.diag(beta[:-1], 1) + jnp.diag(beta[:-1], -1)
    unit_trace = lambda a: divide(a, jnp.broadcast_to(jnp.trace(a), a.shape))
    projector = unit_trace(matrix)
    for _ in range(_SQUARINGS):
        projector = unit_trace(projector @ projector)
    return jnp.vdot(projector, matrix)
