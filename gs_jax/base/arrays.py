"""Helpers for arrays of JAX and NumPy: byte order, converters and checks of fields, safe arithmetic, precision."""

import functools
import operator
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Shaped

from .errors import InputError, input_error
from .typing import Real

Tree = TypeVar("Tree")
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
# A condition in words, and the function that says which numbers of an array meet it.
Rule = tuple[str, Callable[[np.ndarray], Any]]
FINITE: Rule = ("finite", np.isfinite)
POSITIVE: Rule = ("positive and finite", lambda x: (x > 0) & (x < np.inf))
NOT_NEGATIVE: Rule = ("finite and not negative", lambda x: (x >= 0) & (x < np.inf))


def native(tree: Tree) -> Tree:
    """Convert the NumPy arrays of a pytree whose byte order is not the machine's, which JAX does not take."""
    return jax.tree.map(lambda leaf: leaf.astype(leaf.dtype.newbyteorder("=")) if _is_foreign(leaf) else leaf, tree)


def _is_foreign(leaf: Any) -> bool:
    return isinstance(leaf, np.ndarray) and not leaf.dtype.isnative


def jit(function: Callable, **options: Any) -> Any:
    """`jax.jit` for arrays of any byte order, which refuses modules with a NaN.

    JAX refuses arrays of the other byte order, but a compiled function that has seen the native type takes their bytes
    as they are, so that 1 is read as 256. Modules check their numbers when they are made, and not in `eqx.tree_at`.
    """
    compiled = jax.jit(function, **options)

    @functools.wraps(function)
    def call(*args, **kwargs):
        if any(map(_is_foreign, jax.tree.leaves((args, kwargs)))):
            args, kwargs = native((args, kwargs))
        for value in (*args, *kwargs.values()):
            if hasattr(type(value), "__check_init__"):
                _check_no_nan(value)
        return compiled(*args, **kwargs)

    for name in ("lower", "_cache_size"):
        setattr(call, name, getattr(compiled, name))
    return call


def _check_no_nan(module: Any) -> None:
    for path, leaf in jax.tree_util.tree_leaves_with_path(module):
        if eqx.is_inexact_array(leaf) and not isinstance(leaf, Tracer) and np.isnan(np.asarray(leaf)).any():
            name = f"{type(module).__name__}{jax.tree_util.keystr(path)}"
            raise InputError(f"{name} must be numbers, got {np.count_nonzero(np.isnan(np.asarray(leaf)))} NaN.")


def one_program(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Compile a method of a module, unless JAX traces it or its numbers are NumPy's.

    Operation by operation JAX would compile a program for each of them, and again for each shape.
    """
    compiled: Any = jax.jit(function)

    @functools.wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        numbers = jax.tree.leaves(args[0])
        on_host = bool(numbers) and all(isinstance(number, np.ndarray | np.generic) for number in numbers)
        if on_host or is_traced((args, kwargs)):
            return function(*args, **kwargs)
        args, kwargs = native((args, kwargs))
        return compiled(*args, **kwargs)

    return call


def array_namespace(x: Any) -> Any:
    """Return `numpy` for a NumPy array, otherwise `jax.numpy`."""
    return np if isinstance(x, np.ndarray) else jnp


def is_traced(tree: Any) -> bool:
    """Whether JAX traces a leaf of a pytree."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def host_code(
    instead: str = "it is host code",
) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Make a function raise `InputError` if JAX traces an argument; `instead` ends the message."""

    def decorate(function):
        @functools.wraps(function)
        def checked(*args, **kwargs):
            if is_traced((args, kwargs)):
                raise InputError(f"{function.__name__} cannot be traced by jit, grad or vmap; {instead}.")
            return function(*args, **kwargs)

        return checked

    return decorate


def check_finite(name: str, values: Shaped[Array | np.ndarray, "..."], parts: str = "pixels") -> None:
    """Raise `InputError` if an array has a NaN or an infinity; `parts` is what its elements are called.

    Traced values are not checked.
    """
    if np.issubdtype(values.dtype, np.integer) or is_traced(values):
        return
    if wrong := np.count_nonzero(~np.isfinite(np.asarray(values))):
        raise input_error(name, "finite", f"{wrong} of {values.size} {parts} NaN or infinite")


def flat_warning(volume: Float[np.ndarray, "..."]) -> str | None:
    """A warning of a result that shows nothing, because all of its voxels are equal; None otherwise.

    Raises `InputError` for one that is not finite.
    """
    check_finite("the result", volume, "voxels")
    low, high = volume.min(), volume.max()
    if low < high or volume.size == 1:
        return None
    value = "zero: nothing in the capture is light that the model explains" if low == 0 else f"{low:.3g}"
    return f"the result shows nothing, all of its voxels are {value}"


def check_real(name: str, values: Shaped[Array | np.ndarray, "..."]) -> None:
    """Raise `InputError` if an array is complex: JAX would drop the imaginary part."""
    if jnp.issubdtype(values.dtype, jnp.complexfloating):
        raise input_error(name, "real", values.dtype)


def as_float(x) -> Array:
    """Convert to an array of the default precision; a floating-point array of JAX keeps its own."""
    if isinstance(x, Array) and jnp.issubdtype(x.dtype, jnp.floating):
        return x
    # JAX would compile a conversion for each shape. A copy, since JAX may share the memory of what it is given.
    return jnp.asarray(x, dtype=float) if isinstance(x, Array) else jax.device_put(np.array(x, float))


def as_pair(x) -> tuple[float, float]:
    first, second = map(float, x)
    return first, second


def as_shape(x) -> tuple[int, int]:
    rows, columns = map(operator.index, x)
    return rows, columns


def as_float_or_none(x) -> Array | None:
    return None if x is None else as_float(x)


def check_fields(part: eqx.Module, **rules: Rule) -> None:
    """Raise `ValueError` unless the named fields meet their rules; traced values and other types are not checked."""
    for name, (allowed, holds) in rules.items():
        value = getattr(part, name)
        if not isinstance(value, Array) or isinstance(value, Tracer):
            continue
        # On the host: JAX would compile a comparison for each shape.
        numbers = np.asarray(value)
        wrong = ~holds(numbers)
        if wrong.any():
            raise ValueError(f"`{name}` must be {allowed}, got {numbers[wrong][0]}.")


def to_float32(tree: Tree) -> Tree:
    """Convert every floating-point array of a pytree to float32."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf, tree)


def safe_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root, with the derivative 0 at 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def safe_quotient(a: Real, b: Real) -> Float[Array, "..."]:
    """`a / b`, or infinity with the derivative 0 where `b` is not positive."""
    positive = jnp.asarray(b) > 0
    return jnp.where(positive, a / jnp.where(positive, b, 1), jnp.inf)


def divide(
    a: Float[Array, "*shape"], b: Float[Array, "*shape"], least: Real | Float[Array, ""] = 0
) -> Float[Array, "*shape"]:
    """`a / b` where `b` is above `least`, else 0, with finite gradients."""
    ok = b > least
    return jnp.where(ok, a / jnp.where(ok, b, 1), 0)
