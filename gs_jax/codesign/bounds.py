"""Bounds of what is free, as maps: solvers do not see units.

`Bounds` maps a value to a number of order one without any bound, and back; `Box`, for the one solver that keeps bounds
by itself, to its share of the way between them.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..base.arrays import as_float

# How near to a bound a start may be, as a fraction of the range: on the bound the map has no slope, and no way back.
_NEAREST = 0.01


class Bounds(eqx.Module):
    """The values between two bounds as a smooth, invertible image of all numbers `x`: `(1 + x / sqrt(1 + x^2)) / 2` of
    the way from the lowest to the highest.

    A logistic curve would do as well but for its ends, so flat that a search that comes there does not come back.
    Bounds may be arrays that broadcast against the value, in its unit.
    """

    low: Float[Array, "..."] = eqx.field(converter=as_float)
    high: Float[Array, "..."] = eqx.field(converter=as_float)

    def value(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The value of a number of order one."""
        return self.low + (self.high - self.low) * (1 + free / jnp.sqrt(1 + free**2)) / 2

    def free(self, value: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The inverse of `value`. Values at a bound or beyond it are first taken within, by 1 % of the range."""
        share = jnp.clip((value - self.low) / (self.high - self.low), _NEAREST, 1 - _NEAREST)
        return (2 * share - 1) / (2 * jnp.sqrt(share * (1 - share)))


class Box(eqx.Module):
    """The values between two bounds by their share of the way from the lowest to the highest, 0 to 1."""

    low: Float[Array, "..."] = eqx.field(converter=as_float)
    high: Float[Array, "..."] = eqx.field(converter=as_float)

    def value(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The value of a share."""
        return self.low + (self.high - self.low) * free

    def free(self, value: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The inverse of `value`. Values beyond a bound are first taken to it."""
        return jnp.clip((value - self.low) / (self.high - self.low), 0, 1)
