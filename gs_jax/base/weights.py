"""Weights of networks as .npz: float16 arrays, and the network's arguments as JSON. Reading never executes code."""

import inspect
import json
import zipfile
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from .errors import short_repr

_MAX_BYTES = 2**27


def save_weights(
    path: Path, network: PyTree, arguments: dict[str, Any], provenance: Mapping[str, str] | None = None
) -> None:
    """Write the arrays of a network in float16, with the arguments of its skeleton, to a file that is not checked."""
    texts = {"about": arguments} | ({"provenance": dict(provenance)} if provenance else {})
    arrays = {f"array_{i}": np.asarray(leaf, np.float16) for i, leaf in enumerate(jax.tree.leaves(network))}
    arrays |= {name: np.array(json.dumps(text)) for name, text in texts.items()}
    np.savez_compressed(path, allow_pickle=False, **arrays)


def load_weights(path: Path, skeleton: Callable[..., PyTree]) -> PyTree:
    """Read a network that `save_weights` wrote, in float32.

    Parameters
    ----------
    path
        File of weights.
    skeleton
        Returns the shapes of the network's arrays (`eqx.filter_eval_shape`) for the arguments in the file; raises
        `ValueError` or `TypeError` if there is no such network.

    Raises
    ------
    ValueError
        If the file is of another network, or has other arrays than its network, or not finite ones. Other exceptions,
        too, if it is damaged.
    """
    with zipfile.ZipFile(path) as archive:
        size = sum(member.file_size for member in archive.infolist())
    if size > _MAX_BYTES:
        raise ValueError(f"must be at most {_MAX_BYTES} bytes, got {size}")
    with np.load(path, allow_pickle=False) as archive:
        arguments, signature = json.loads(str(archive["about"])), inspect.signature(skeleton)
        try:
            signature.bind(**arguments)
        except TypeError:
            allowed = f"a network with {', '.join(signature.parameters)}"
            raise ValueError(f"must be {allowed}, got another kind, {short_repr(arguments)}") from None
        leaves, structure = jax.tree.flatten(skeleton(**arguments))
        arrays = [archive[f"array_{i}"] for i in range(len(leaves))]
    for leaf, array in zip(leaves, arrays, strict=True):
        if array.shape != leaf.shape or array.dtype != np.float16 or not np.isfinite(array).all():
            raise ValueError(f"must have finite float16 arrays {leaf.shape}, got {array.dtype} {array.shape}")
    return jax.tree.unflatten(structure, [jax.device_put(array.astype(np.float32)) for array in arrays])


def shipped_weights(name: str, skeleton: Callable[..., PyTree]) -> PyTree:
    """Read a network that comes with the package."""
    with resources.as_file(resources.files("gs_jax") / "weights" / f"{name}.npz") as path:
        return load_weights(path, skeleton)
