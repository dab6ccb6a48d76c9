"""Zarr stores: local folders, and those at s3:// and https:// addresses, which fsspec reads."""

import os
import re
from importlib import import_module
from typing import Any

from ..base.errors import needs_extra

# Not from `gs_jax.base.typing`, which imports JAX: the help of commands does without.
PathLike = str | os.PathLike[str]
# Of an address a `Path` keeps one slash.
_ADDRESS = re.compile(r"(s3|https?):/+(.+)", re.DOTALL)


def remote_url(path: PathLike) -> str | None:
    """The address that a path stands for; None if it is that of a local file."""
    match = _ADDRESS.fullmatch(os.fspath(path))
    return f"{match[1]}://{match[2]}" if match else None


def without_queries(text: str) -> str:
    """A text whose addresses end before their queries, which may hold a signature."""
    return re.sub(r"""((?:s3|https?):/+[^\s?'"]*)\?[^\s'"]*""", r"\1", text)


def import_zarr() -> Any:
    """The package zarr, which TIFF does not need; `InputError` if it is not installed."""
    with needs_extra("zarr"):
        import zarr  # 0.15 s
    return zarr


def open_store(path: PathLike, *, group: bool = False) -> Any:
    """Open the array or group of a store, or a group alone, for reading.

    Raises `InputError` if a package for it is not installed, and what zarr raises if there is none.
    """
    zarr, url = import_zarr(), remote_url(path)
    opener = zarr.open_group if group else zarr.open
    if url is None:
        return opener(path, mode="r")
    with needs_extra("zarr"):
        for package in ("fsspec", "s3fs" if url.startswith("s3") else "aiohttp"):
            import_module(package)
    return opener(url, mode="r")


def has_key(array: Any, key: str) -> bool:
    """Whether the store of an array has a chunk of this key."""
    from zarr.core.sync import sync

    return sync(array.store.exists(f"{array.path}/{key}".lstrip("/")))
