"""Code for JAX's arrays and NumPy's alike."""

import operator
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Shaped

from ..typing import Real
from .errors import InputError


def library_of(x: Any) -> Any:
    """NumPy or JAX's, whose array this is."""
    return np if isinstance(x, np.ndarray) else jnp


def check_finite(name: str, values: Shaped[Array | np.ndarray, "..."], parts: str = "pixels") -> None:
    """`InputError` if an image, or a volume of `parts="voxels"`, has a NaN or an infinity. Host code."""
    if np.issubdtype(values.dtype, np.integer):
        return
    finite = library_of(values).isfinite(values)
    if not finite.all():
        found = f"{int((~finite).sum())} of {values.size} {parts} NaN or infinite"
        raise InputError(f"{name}: found {found}, allowed: finite numbers.")


Tree = TypeVar("Tree")


def in_float32(tree: Tree) -> Tree:
    """The same modules, tuples and dictionaries with every array as float32."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), tree)


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
