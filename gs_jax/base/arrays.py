"""Code for JAX's arrays and NumPy's alike."""

from typing import Any

import jax.numpy as jnp
import numpy as np


def library_of(x: Any) -> Any:
    """NumPy or JAX's, whose array this is."""
    return np if isinstance(x, np.ndarray) else jnp
