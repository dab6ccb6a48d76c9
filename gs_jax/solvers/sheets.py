"""Sheets through a volume: their voxels, and the squares of their derivatives."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..base.arrays import divide, safe_sqrt
from .richardson_lucy import hat_functions

# Voxels from one knot of the depth to the next.
_SPACING = 5
# Steps of Lloyd's algorithm, and the light, relative to the mean column's, up to which depths stay with all columns'.
_LLOYD, _ALIKE = 8, 3.0
# Least brightness of a column at the start, relative to the mean: by its root, none has no gradient.
_FAINT = 1e-3


class Sheets(NamedTuple):
    """Unknowns: roots of brightness, depths at knots, in planes from the first, and the background at its knots."""

    root: Array
    depth: Array
    background: Array


def volume_of(sheets, planes):
    """Linear shares of each sheet on the two planes about its depth: `(plane, y, x)`."""
    depth = jnp.clip(interpolated(sheets.depth, sheets.root.shape[1:]), 0, planes - 1)
    k = jnp.arange(planes, dtype=depth.dtype)[None, :, None, None]
    return (sheets.root[:, None] ** 2 * jnp.maximum(1 - jnp.abs(k - depth[:, None]), 0)).sum(0)


def hats(shape, knots, dtype):
    """Linear interpolation from knots, a matrix for each axis."""
    return tuple(hat_functions(n, count, dtype) for n, count in zip(shape, knots, strict=True))


def interpolated(depth, shape):
    """Depths at all columns from those at knots."""
    rows, columns = hats(shape, depth.shape[1:], depth.dtype)
    return jnp.einsum("yk,zkl,xl->zyx", rows, depth, columns)


def first_sheets(x, background, count):
    """Start of a fit, from free voxels `x`: depths about which the light is, and the light of a column."""
    planes, *shape = x.shape
    knots = [max(-(-n // _SPACING), 2) for n in shape]
    rows, columns = hats(shape, knots, x.dtype)
    unit = divide(x, jnp.broadcast_to(x.max(), x.shape))
    # Squared, because the background is in all planes.
    local = jnp.einsum("yk,zyx,xl->zkl", rows, unit**2, columns)
    local = widened(widened(local, 1), 2)
    local = local - (local.min(0) if planes > 2 else jnp.zeros_like(local[0]))[None]
    k = jnp.arange(planes, dtype=x.dtype)[:, None, None]
    # Where it is dark, the mean of all.
    faint = 0.05 * local.sum(0).mean() + jnp.finfo(x.dtype).tiny
    overall = divide((k * local).sum(), local.sum())
    if count == 1:
        depth = (((k * local).sum(0) + faint * overall) / (local.sum(0) + faint))[None]
    else:
        # Several sheets divide the planes among them (Lloyd's algorithm), first those of all columns together: where
        # there is one sheet only, the others must not share its light.
        spread = safe_sqrt(divide((local * (k - overall) ** 2).sum(), local.sum()))
        depth = overall + spread * jnp.asarray(np.linspace(-1, 1, count), x.dtype)[:, None, None]
        depth = _divided(local.sum((1, 2), keepdims=True), depth, 0.0)
        depth = _divided(local, jnp.broadcast_to(depth, (count, *local.shape[1:])), _ALIKE * local.sum(0).mean())
    bright = (nearest(k, interpolated(depth, tuple(shape))) * x[None]).sum(1)
    return Sheets(safe_sqrt(bright + _FAINT * bright.mean()), depth, background)


def _divided(light, depth, faint):
    """Mean depths of the light `(plane, y, x)` that is nearest to each sheet; those of faint columns hardly change."""
    k = jnp.arange(len(light), dtype=light.dtype)[:, None, None]
    for _ in range(_LLOYD):
        mine = nearest(k, depth) * light[None]
        depth = ((mine * k[None]).sum(1) + faint * depth) / (mine.sum(1) + faint + jnp.finfo(light.dtype).tiny)
    return depth


def widened(x, axis):
    """Binomial mean of three neighbours along an axis."""
    padded = jnp.pad(x, [(int(a == axis), int(a == axis)) for a in range(x.ndim)], mode="edge")
    first, middle, last = (lax.slice_in_dim(padded, i, i + x.shape[axis], axis=axis) for i in range(3))
    return (first + 2 * middle + last) / 4


def nearest(k, depth):
    """1 where a sheet is the nearest of a plane, else 0; ties are shared: `(sheet, plane, y, x)`."""
    away = jnp.abs(k[None] - depth[:, None])
    mine = (away <= away.min(0)[None]).astype(depth.dtype)
    return mine / mine.sum(0)[None]


def squared_derivatives(sheets):
    """Squares of the derivatives of the volume's voxels in each unknown."""
    rows, columns = hats(sheets.root.shape[1:], sheets.depth.shape[1:], sheets.root.dtype)
    depth = jnp.einsum("yk,zyx,xl->zkl", rows**2, sheets.root**4, columns**2)
    return Sheets(4 * sheets.root**2, depth, jnp.ones_like(sheets.background))
