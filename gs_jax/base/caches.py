"""Results that take seconds: kept in memory for calls with the same values, or on disk for the next process."""

import contextlib
import functools
import hashlib
import os
import uuid
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np

from .machine import cache_folder

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# Of all files together; those that were not read for the longest time are removed.
_MOST_BYTES = 2**29
# Libraries that compute the arrays.
_LIBRARIES = "numpy", "scipy", "jax", "jaxlib"
# NumPy's name of an array without one: here, of the names of the others.
_NAMES = "arr_0"


def cached_on_disk(key: Iterable[bytes], compute: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Read arrays of an earlier process from the cache, or compute and keep them.

    A folder that cannot be written, a full disk and a damaged file mean that the arrays are computed. Another version
    of the package's source, or of NumPy, SciPy or JAX, computes them anew.

    Parameters
    ----------
    key
        All that the arrays depend on.
    compute
        Returns the arrays by name.
    """
    try:
        path = cache_folder() / f"{digest_of(key)}.npz"
    except RuntimeError:  # no home folder
        return compute()
    if (arrays := _read(path)) is None:
        arrays = compute()
        with contextlib.suppress(OSError):
            _write(path, arrays)
    return arrays


def _read(path: Path) -> dict[str, np.ndarray] | None:
    """The arrays of a file, or None if there is none, or if it is damaged."""
    # A damaged archive raises errors of any kind.
    with contextlib.suppress(Exception):
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            # A damaged header may end an array early, before its checksum is compared.
            if archive.zip.testzip():
                return None
            arrays = {name: archive[name] for name in archive[_NAMES].tolist()}
        with contextlib.suppress(OSError):  # a folder that is read only
            os.utime(path)
        return arrays


def key_of(tree: Any) -> list[bytes]:
    """The structure of a pytree, and the types, shapes and numbers of its leaves, for a key."""
    leaves, structure = jax.tree.flatten(tree)
    return [repr(structure).encode(), *map(_bytes_of, leaves)]


def _bytes_of(leaf: Any) -> bytes:
    array = np.asarray(leaf)
    if array.dtype.hasobject:
        raise TypeError(f"a leaf of a key must be an array or a number, got {leaf!r}.")
    return repr((array.dtype, array.shape)).encode() + array.tobytes()


def digest_of(key: Iterable[bytes]) -> str:
    """A name for what depends on a key, on the package's source and on the libraries."""
    digest = hashlib.sha256(_source())
    for part in key:
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()


@functools.cache
def _source() -> bytes:
    """A hash of the package's source and the libraries' versions: any change of them may change the arrays."""
    files = sorted(Path(__file__).parents[1].rglob("*.py"))
    versions = repr([(name, version(name)) for name in _LIBRARIES]).encode()
    return hashlib.sha256(b"".join([versions, *(path.read_bytes() for path in files)])).digest()


def _write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # Whole or not at all: another process may read it.
    temporary = path.with_name(f"{uuid.uuid4().hex}.npz")
    try:
        np.savez(temporary, list(arrays), allow_pickle=False, **arrays)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    used = 0
    for file in sorted(path.parent.glob("*.npz"), key=lambda file: -file.stat().st_mtime):
        used += file.stat().st_size
        if used > _MOST_BYTES:
            file.unlink(missing_ok=True)


class _Call:
    """Arguments of a call; equal if their structures, types and values are, whatever shows its `progress`."""

    def __init__(self, args, kwargs):
        self.args, self.kwargs = args, kwargs
        counted = {name: value for name, value in kwargs.items() if name != "progress"}
        leaves, structure = jax.tree.flatten((args, counted))
        self.key = structure, tuple(map(_bytes_of, leaves))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Call) and self.key == other.key


def cache_by_value(maxsize: int) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Keep the results of the last `maxsize` calls, which are shared.

    Arguments are pytrees of arrays and numbers; a keyword argument `progress` does not count.
    """

    def decorate(function):
        cached = functools.lru_cache(maxsize)(lambda call: function(*call.args, **call.kwargs))

        @functools.wraps(function)
        def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            return cached(_Call(args, kwargs))

        setattr(call, "cache_clear", cached.cache_clear)  # noqa: B010 (a function has no such attribute)
        return call

    return decorate
