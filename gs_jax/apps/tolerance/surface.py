"""What a rough or stepped surface does to light.

A printer makes a slope `s` of terraces, `layer` high and `layer / s` wide, and smooths their edges over its `pixel`, to
ramps of that width. From the wanted slope this differs by up to `(layer - pixel s) / 2` to both sides, by a sawtooth:
the mean square is `(layer - pixel s)^2 / 12`, that of its slope `s (layer / pixel - s)`. Where terraces are narrower
than a pixel nothing is left of them: of a running mean over a pixel there would be a tail, but what prints is rounder.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...lenses import MicrolensArray
from ...typing import ScalarLike

# Of equal area, in a lens: terraces are wide in its middle alone.
_RINGS = 256


def step_squares(
    slope: Float[Array | np.ndarray, " place"], layer: ScalarLike, pixel: ScalarLike
) -> tuple[Float[Array, " place"], Float[Array, " place"]]:
    """Mean squares of a printed surface's height error, mm^2, and of its slope's, at places of the wanted slope."""
    slope = jnp.asarray(slope)
    left = jnp.maximum(layer - pixel * slope, 0)
    return left**2 / 12, slope * left / pixel


def lens_squares(
    array: MicrolensArray, radius: ScalarLike, layer: ScalarLike, pixel: ScalarLike, wavelength: ScalarLike
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean squares of a lens's height error, mm^2, and of the slope that bends rays, within a radius, mm.

    Steps of many waves bend rays by their slope. Thin ones diffract, a little light far away, and leave the core as
    narrow as it is. Between them slopes count by the share of the light that their height takes from the core.
    """
    squared = jnp.asarray((np.arange(_RINGS) + 0.5) / _RINGS) * radius**2
    height, slope = step_squares(array.sag_slope_over_r(squared) * jnp.sqrt(squared), layer, pixel)
    moved = -jnp.expm1(log_strehl_of_height(height, array.refractive_index, wavelength))
    return jnp.mean(height), jnp.mean(slope * moved)


def log_strehl_of_height(
    square: ScalarLike | Float[Array, " place"], refractive_index: ScalarLike, wavelength: ScalarLike
) -> Float[Array, "..."]:
    """Logarithm of `exp(-(2 pi (n - 1) sigma / lambda)^2)`, the light that stays in the spot's core.

    Exact for heights of a normal distribution; `square` is `sigma^2`, mm^2.
    """
    return -((2 * np.pi * (jnp.asarray(refractive_index) - 1) / wavelength) ** 2) * square
