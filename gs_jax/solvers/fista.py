"""Projected gradient descent and FISTA: least squares with sparsity, not negative, for any operator.

Both minimise `|A x - image|^2 / 2 + l1 |x|_1` over `x >= 0`. FISTA: Beck and Teboulle, SIAM J. Imaging Sci. 2, 183
(2009).
"""

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Num

from ..base.safe import divide
from ..layouts.cells import Real
from .iteration import Callback, Solution, as_image, iterate, norm

# Steps of the power method, and what it may fall short by: for operators without negative entries the largest
# eigenvalue stands alone, and this many steps find it to about a percent.
_POWER_STEPS, _MARGIN = 20, 1.05


def fista(
    A: lx.AbstractLinearOperator,
    image: Num[Array | np.ndarray, "..."],
    *,
    steps: int,
    tolerance: float = 0.0,
    l1: Real | Float[Array, ""] = 0.0,
    callback: Callback | None = None,
) -> Solution:
    """FISTA, restarted whenever the momentum points uphill (O'Donoghue and Candes, Found. Comput. Math. 15, 715, 2015).

    Parameters
    ----------
    A
        From a volume to an image.
    image
        To be explained.
    steps, tolerance, callback
        As for `iterate`; the residual is the relative change of `x`.
    l1
        Weight of the sum of `x`.

    Returns
    -------
    Solution
        A dark image gives zeros. `tolerance=0` is differentiable with respect to the image and whatever `A` holds.

    Raises
    ------
    ValueError
        If the image is not of the operator's output shape, or a number is out of range.
    """
    return _descend(A, image, l1, True, steps=steps, tolerance=tolerance, callback=callback)


def gradient_descent(
    A: lx.AbstractLinearOperator,
    image: Num[Array | np.ndarray, "..."],
    *,
    steps: int,
    tolerance: float = 0.0,
    l1: Real | Float[Array, ""] = 0.0,
    callback: Callback | None = None,
) -> Solution:
    """Projected gradient descent with the constant step 1/L; parameters and errors as for `fista`."""
    return _descend(A, image, l1, False, steps=steps, tolerance=tolerance, callback=callback)


def _descend(A, image, l1, momentum, **options):
    image = as_image(A, image)
    l1 = jnp.asarray(l1, image.dtype)
    rate = divide(jnp.ones((), image.dtype), _MARGIN * largest_eigenvalue(A))

    def step(state):
        x, point, t = state
        residual = A.mv(point) - image
        cost = jnp.vdot(residual, residual) / 2 + l1 * jnp.sum(jnp.abs(point))
        new = jnp.maximum(point - rate * (A.T.mv(residual) + l1), 0)
        change = divide(norm(new - x), norm(new))
        if not momentum:
            return (new, new, t), cost, change
        uphill = jnp.vdot(point - new, new - x) > 0
        t_old = jnp.where(uphill, 1.0, t).astype(t.dtype)
        t_new = (1 + jnp.sqrt(1 + 4 * t_old**2)) / 2
        weight = jnp.where(uphill, 0, (t_old - 1) / t_new)
        return (new, new + weight * (new - x), t_new), cost, change

    structure = A.in_structure()
    zeros = jnp.zeros(structure.shape, structure.dtype)
    (x, *_), *history = iterate(step, (zeros, zeros, jnp.ones((), zeros.dtype)), **options)
    return Solution(x, *history)


def largest_eigenvalue(A: lx.AbstractLinearOperator, steps: int = _POWER_STEPS) -> Float[Array, ""]:
    """Of `A' A`, by the power method from a positive start: from below."""

    def power(x, _):
        y = A.T.mv(A.mv(divide(x, jnp.broadcast_to(norm(x), x.shape))))
        return y, None

    structure = A.in_structure()
    # Positive, as the eigenvector is where no entry is negative, and not symmetric in case some are.
    start = 1 + jax.random.uniform(jax.random.key(0), structure.shape, structure.dtype)
    return norm(lax.scan(power, start, length=steps)[0])
