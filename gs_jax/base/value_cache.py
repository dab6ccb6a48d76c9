"""Results of host code that takes a second, kept for arguments of the same values."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax
import numpy as np

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class _Call:
    """Arguments of a call; equal if their structures, types and values are."""

    def __init__(self, args, kwargs):
        self.args, self.kwargs = args, kwargs
        leaves, structure = jax.tree.flatten((args, kwargs))
        arrays = map(np.asarray, leaves)
        self.key = structure, tuple((x.dtype, x.shape, x.tobytes()) for x in arrays)

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Call) and self.key == other.key


def cache_by_value(maxsize: int) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Keep the results of the last `maxsize` calls. Arguments are pytrees of arrays and numbers; results are shared."""

    def decorate(function):
        cached = functools.lru_cache(maxsize)(lambda call: function(*call.args, **call.kwargs))

        @functools.wraps(function)
        def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            return cached(_Call(args, kwargs))

        return call

    return decorate
