"""Single precision for a whole tree of arrays."""

from typing import TypeVar

import jax
import jax.numpy as jnp

Tree = TypeVar("Tree")


def in_float32(tree: Tree) -> Tree:
    """The same modules, tuples and dictionaries with every array as float32."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), tree)
