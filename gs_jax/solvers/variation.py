"""Total variation: differences of neighbours, its value, and what shrinks it."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..base.arrays import divide, safe_sqrt


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
