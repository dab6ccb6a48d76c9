"""FISTA: least squares with sparsity, not negative, for any operator.

It minimises `|A x - image|^2 / 2 + l1 sum(x)` over `x >= 0` (Beck and Teboulle, SIAM J. Imaging Sci. 2, 183, 2009).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Num

from ..base.arrays import divide
from ..typing import Real
from .base import as_image, check_options, least_weight_of_darkness, norm

# Steps of the power method, and what it may fall short by: for operators without negative entries the largest
# eigenvalue stands alone, and this many steps find it to about a percent.
_POWER_STEPS, _MARGIN = 20, 1.05


class State(NamedTuple):
    """Of `FISTA`: the estimate, the point ahead of it, the momentum's `t`; the step length and the weight `l1`."""

    x: Array
    point: Array
    t: Array
    rate: Array
    weight: Array


class FISTA(eqx.Module):
    """FISTA: least squares with sparsity, not negative, for any operator.

    *Differentiable.*

    It restarts whenever the momentum points uphill (O'Donoghue and Candes, Found. Comput. Math. 15, 715, 2015). A dark
    image gives zeros.

    Parameters
    ----------
    steps, tolerance
        As for `Solver`; the residual is the relative change of `x`.
    sparsity
        Weight of the sum of `x`, in parts of `max(A' image)`: the least that leaves nothing but darkness.

    Raises
    ------
    InputError
        If an option is negative, or a number of steps 0.

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> import numpy as np
    >>> scene = np.zeros(grid.volume_shape)
    >>> scene[1, 19, 22] = 1.0
    >>> image = gs.forward(scene, scope, grid)
    >>> found = gs.solve(gs.ImagingOperator(scope, grid), image, gs.FISTA(steps=30, sparsity=0.01))
    >>> print(bool(found.costs[-1] < found.costs[0]), bool(found.x.min() >= 0))
    True True
    """

    steps: int = eqx.field(static=True, default=20)
    tolerance: float = eqx.field(static=True, default=0.0)
    sparsity: Real | Float[Array, ""] = 0.01

    def __check_init__(self):
        check_options(self)

    def init(self, A: lx.AbstractLinearOperator, image: Num[Array | np.ndarray, "..."]) -> State:
        image = as_image(A, image)
        back = A.T.mv(image)
        weight = jnp.asarray(self.sparsity, image.dtype) * least_weight_of_darkness(back)
        one, zeros = jnp.ones((), back.dtype), jnp.zeros_like(back)
        return State(zeros, zeros, one, divide(one, _MARGIN * largest_eigenvalue(A)), weight)

    def step(
        self, A: lx.AbstractLinearOperator, image: Num[Array | np.ndarray, "..."], state: State
    ) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        x, point, t, rate, weight = state
        residual = A.mv(point) - as_image(A, image)
        cost = jnp.vdot(residual, residual) / 2 + weight * jnp.sum(jnp.abs(point))
        new = jnp.maximum(point - rate * (A.T.mv(residual) + weight), 0)
        uphill = jnp.vdot(point - new, new - x) > 0
        t_old = jnp.where(uphill, 1.0, t).astype(t.dtype)
        t_new = (1 + jnp.sqrt(1 + 4 * t_old**2)) / 2
        momentum = jnp.where(uphill, 0, (t_old - 1) / t_new)
        return (
            State(new, new + momentum * (new - x), t_new, rate, weight),
            cost,
            divide(norm(new - x), norm(new)),
        )

    def estimate(self, state: State) -> Float[Array, "..."]:
        return state.x


def largest_eigenvalue(A: lx.AbstractLinearOperator, steps: int = _POWER_STEPS) -> Float[Array, ""]:
    """Of `A' A`, by the power method from a positive start: from below."""

    def power(x, _):
        y = A.T.mv(A.mv(divide(x, jnp.broadcast_to(norm(x), x.shape))))
        return y, None

    structure = A.in_structure()
    # Positive, as the eigenvector is where no entry is negative, and not symmetric in case some are.
    start = 1 + jax.random.uniform(jax.random.key(0), structure.shape, structure.dtype)
    return norm(lax.scan(power, start, length=steps)[0])
