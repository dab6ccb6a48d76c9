"""The projections on NVIDIA's GPUs: by kernels of Warp where that is installed, otherwise by XLA.

Importing this module does not import Warp.
"""

import warnings
from functools import cache
from importlib.util import find_spec
from types import ModuleType

import jax
import jax.numpy as jnp

from . import tiles

# JAX 0.10.2 to 0.11.0 adds floats on GPUs by loops that wait for each other (jax-ml/jax#38806).
SCATTERS = jax.__version_info__ >= (0, 11, 1)


def gather(shapes, rays, image):
    """`bilinear.image_to_volume`."""
    return (_kernels(rays.parameters.dtype) or tiles).gather(shapes, rays, image)


def scatter(shapes, rays, volume):
    """`bilinear.volume_to_image`."""
    if kernels := _kernels(rays.parameters.dtype):
        return kernels.scatter(shapes, rays, volume)
    return (tiles.add_to_pixels if SCATTERS else tiles.scatter)(shapes, rays, volume)


def _kernels(dtype) -> ModuleType | None:
    """The kernels, which compute in float32: float64 is for comparisons."""
    return _load() if dtype == jnp.float32 else None


@cache
def _load() -> ModuleType | None:
    """The module with the kernels; None without Warp, or, with a warning, if it cannot be imported."""
    if find_spec("warp") is None:
        return None
    try:
        from . import warp_kernels

        return warp_kernels
    # Versions of Warp and JAX that do not fit, or another package of this name.
    except Exception as error:
        reason = f"{type(error).__name__}: {str(error).strip().partition(chr(10))[0]}"
        text = f"Warp's kernels do not work, XLA is used instead, which is slower: {reason}"
        warnings.warn(text, RuntimeWarning, stacklevel=2)
        return None
