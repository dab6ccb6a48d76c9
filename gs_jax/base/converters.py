"""Converters of the fields of modules, and what their numbers must be."""

import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

# In words, and of an array which of its numbers are so.
Rule = tuple[str, Callable[[np.ndarray], Any]]
FINITE: Rule = ("finite", np.isfinite)
POSITIVE: Rule = ("positive and finite", lambda x: (x > 0) & (x < np.inf))
NOT_NEGATIVE: Rule = ("finite and not negative", lambda x: (x >= 0) & (x < np.inf))


def as_float(x) -> Array:
    # A float array keeps its precision, so that `dataclasses.replace` changes nothing else.
    if isinstance(x, Array) and jnp.issubdtype(x.dtype, jnp.floating):
        return x
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


def check_fields(part: eqx.Module, **rules: Rule) -> None:
    """`ValueError` unless the numbers of these fields are as they must be; what JAX traces is not looked at."""
    for name, (allowed, holds) in rules.items():
        value = getattr(part, name)
        if not isinstance(value, Array) or isinstance(value, Tracer):
            continue
        # On the host: JAX would compile a comparison for each shape.
        numbers = np.asarray(value)
        wrong = ~holds(numbers)
        if wrong.any():
            raise ValueError(f"`{name}` must be {allowed}, got {numbers[wrong][0]}.")
