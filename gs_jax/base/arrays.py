"""Code for JAX's arrays and NumPy's alike."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Shaped

from .errors import InputError


def library_of(x: Any) -> Any:
    """NumPy or JAX's, whose array this is."""
    return np if isinstance(x, np.ndarray) else jnp


def check_finite(name: str, values: Shaped[Array | np.ndarray, "..."], parts: str = "pixels") -> None:
    """`InputError` if an image, or a volume of `parts="voxels"`, has a NaN or an infinity. Host code."""
    if np.issubdtype(values.dtype, np.integer):
        return
    finite = library_of(values).isfinite(values)
    if not finite.all():
        found = f"{int((~finite).sum())} of {values.size} {parts} NaN or infinite"
        raise InputError(f"{name}: found {found}, allowed: finite numbers.")
