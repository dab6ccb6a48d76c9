"""Results that take seconds: kept in memory for calls with the same values, or on disk for the next process."""

import contextlib
import functools
import hashlib
import os
import uuid
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np

from .machine import cache_folder

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# Of all files together; those that were not read for the longest time are removed.
_MOST_BYTES = 2**29
_NO_CACHE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


def cached_on_disk(key: Iterable[bytes], compute: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Read arrays of an earlier process from the cache, or compute and keep them.

    A folder that cannot be written, a full disk and a damaged file mean that the arrays are computed. Another version
    of the package's source computes them anew.

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
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        os.utime(path)
        return arrays
    except _NO_CACHE:
        arrays = compute()
    with contextlib.suppress(*_NO_CACHE):
        _write(path, arrays)
    return arrays


def key_of(tree: Any) -> list[bytes]:
    """The structure and the numbers of a pytree, for a key."""
    leaves, structure = jax.tree.flatten(tree)
    return [repr(structure).encode(), *(np.asarray(leaf).tobytes() for leaf in leaves)]


def digest_of(key: Iterable[bytes]) -> str:
    """A name for what depends on a key and on the package's source."""
    digest = hashlib.sha256(_source())
    for part in key:
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()


@functools.cache
def _source() -> bytes:
    """A hash of the package's source: any change of it may change the arrays."""
    package = Path(__file__).parents[1]
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(package.rglob("*.py")))).digest()


def _write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # Whole or not at all: another process may read it.
    temporary = path.with_name(f"{uuid.uuid4().hex}.npz")
    try:
        np.savez(temporary, allow_pickle=False, **arrays)
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
        arrays = map(np.asarray, leaves)
        self.key = structure, tuple((x.dtype, x.shape, x.tobytes()) for x in arrays)

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
