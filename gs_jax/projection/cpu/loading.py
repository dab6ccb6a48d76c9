"""Kernels by name, compiled when they are first asked for. Importing this module does not import numba."""

import warnings
from collections.abc import Callable
from functools import cache, partial
from importlib.util import find_spec
from threading import Lock

_lock = Lock()


def kernels(*names: str | None) -> tuple[Callable[[], Callable | None] | None, ...]:
    """`LinearMap.kernels` by their names in `dispatch`."""
    return tuple(None if name is None else partial(cpu_kernel, name) for name in names)


def cpu_kernel(name: str) -> Callable | None:
    """The function of this name in `dispatch`; None without numba, or, with a warning, if its kernel fails."""
    with _lock:
        return _load(name)


@cache
def _load(name):
    if find_spec("numba") is None:
        return None
    try:
        from . import dispatch

        return dispatch.load(name)
    # Versions of numba, llvmlite or XLA that are too new, or no writable folder for numba's cache.
    except Exception as error:
        _warn(f"{type(error).__name__}: {str(error).strip().partition(chr(10))[0]}")
        return None


@cache
def _warn(reason):
    text = f"numba's kernels do not work, XLA is used instead, which is slower: {reason}"
    warnings.warn(text, RuntimeWarning, stacklevel=2)
