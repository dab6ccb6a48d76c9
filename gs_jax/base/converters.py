"""Converters of the fields of modules."""

import operator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


def as_float(x) -> Array:
    # What is no array yet becomes one on the host: JAX would compile a conversion for each shape.
    return jnp.asarray(x if isinstance(x, Array) else np.asarray(x, float), dtype=float)


def as_pair(x) -> tuple[float, float]:
    first, second = map(float, x)
    return first, second


def as_shape(x) -> tuple[int, int]:
    rows, columns = map(operator.index, x)
    return rows, columns


def as_float_or_none(x) -> Array | None:
    return None if x is None else as_float(x)
