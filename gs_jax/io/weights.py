"""Weights of networks as files: half-precision arrays, and what they are as JSON. Nothing in one is ever executed."""

import inspect
import json
import zipfile
from collections.abc import Callable
from importlib import resources
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from ..base.errors import short_repr
from ..typing import PathLike
from .files import atomic_write, check_input, check_output, decoding
from .provenance import KEY, Provenance

_MOST_BYTES = 2**27


def write_weights(path: PathLike, network: PyTree, about: dict[str, Any], provenance: Provenance | None = None) -> None:
    """Writes the arrays of a network as `.npz`, in float16, with what makes another of its kind; whole or not at all.

    Raises
    ------
    InputError
        As `check_output`.
    """
    arrays = {f"array_{i}": np.asarray(leaf, np.float16) for i, leaf in enumerate(jax.tree.leaves(network))}
    with atomic_write(check_output(path, [".npz"])) as temporary:
        if provenance:
            arrays[KEY] = np.array(json.dumps(dict(provenance)))
        np.savez_compressed(temporary, allow_pickle=False, about=np.array(json.dumps(about)), **arrays)


def read_weights(path: PathLike, skeleton: Callable[..., PyTree]) -> PyTree:
    """The network in a file of `write_weights`, in float32.

    Parameters
    ----------
    path
        Of the file.
    skeleton
        From what the file says the network is to the shapes of its arrays (`eqx.filter_eval_shape`); a `ValueError` or
        a `TypeError` says that there is no such network.

    Raises
    ------
    InputError
        If the file cannot be read, or holds no network, or not the arrays of its network, finite.
    """
    path = check_input(path)
    with decoding(path, "file of weights (.npz)"):
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > _MOST_BYTES:
            raise ValueError(f"found {size} bytes, allowed: at most {_MOST_BYTES}")
        with np.load(path, allow_pickle=False) as archive:
            about, allowed = json.loads(str(archive["about"])), inspect.signature(skeleton)
            try:
                allowed.bind(**about)
            except TypeError:
                kind = f"found a network of another kind, {short_repr(about)}, allowed: one with"
                raise ValueError(f"{kind} {', '.join(allowed.parameters)}") from None
            leaves, structure = jax.tree.flatten(skeleton(**about))
            arrays = [archive[f"array_{i}"] for i in range(len(leaves))]
        for leaf, array in zip(leaves, arrays, strict=True):
            if array.shape != leaf.shape or array.dtype != np.float16 or not np.isfinite(array).all():
                raise ValueError(f"found {array.dtype} {array.shape}, allowed: finite float16 {leaf.shape}")
    return jax.tree.unflatten(structure, [jnp.asarray(array, jnp.float32) for array in arrays])


def shipped(name: str, skeleton: Callable[..., PyTree]) -> PyTree:
    """A network that comes with the package."""
    with resources.as_file(resources.files("gs_jax") / "weights" / f"{name}.npz") as path:
        return read_weights(path, skeleton)
