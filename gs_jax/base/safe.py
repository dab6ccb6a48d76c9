"""Roots and quotients that stay finite, and differentiable, where plain ones have no value or no derivative."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Real = Float[Array | np.ndarray, "*#shape"] | float | int


def safe_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root, with a derivative of zero at zero, where it has none."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def safe_quotient(above: Real, below: Real) -> Float[Array, "..."]:
    """`above / below`, or infinity without a derivative where `below` is not positive."""
    positive = jnp.asarray(below) > 0
    return jnp.where(positive, above / jnp.where(positive, below, 1), jnp.inf)


def divide(
    a: Float[Array, "*shape"], b: Float[Array, "*shape"], least: Real | Float[Array, ""] = 0
) -> Float[Array, "*shape"]:
    """`a / b` where `b` is above `least`, else 0, with finite gradients."""
    ok = b > least
    return jnp.where(ok, a / jnp.where(ok, b, 1), 0)
