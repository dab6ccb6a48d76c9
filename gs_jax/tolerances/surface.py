"""What a rough or stepped surface does to light.

A printer makes a slope `s` of terraces, `layer` high and `layer / s` wide, and smooths their edges over its `pixel`, to
ramps of that width. From the wanted slope this differs by up to `(layer - pixel s) / 2` to both sides, by a sawtooth:
the mean square is `(layer - pixel s)^2 / 12`, that of its slope `s (layer / pixel - s)`. Where terraces are narrower
than a pixel nothing is left of them: of a running mean over a pixel there would be a tail, but what prints is rounder.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..lenses import MicrolensArray
from ..optics.unit import pupil_disc

Real = Float[Array | np.ndarray, ""] | float


def step_squares(
    slope: Float[Array | np.ndarray, " place"], layer: Real, pixel: Real
) -> tuple[Float[Array, " place"], Float[Array, " place"]]:
    """Mean squares of a printed surface's height error, mm^2, and of its slope's, at places of the wanted slope."""
    slope = jnp.asarray(slope)
    left = jnp.maximum(layer - pixel * slope, 0)
    return left**2 / 12, slope * left / pixel


def lens_squares(
    array: MicrolensArray, radius: Real, layer: Real, pixel: Real
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """`step_squares`, averaged over a lens within a radius, mm."""
    points, weights = pupil_disc(jnp.asarray(radius))
    squared = jnp.sum(points**2, -1)
    slope = array.steepness(squared) * jnp.sqrt(squared)
    height, tilt = step_squares(slope, layer, pixel)
    return jnp.sum(weights * height), jnp.sum(weights * tilt)


def log_strehl_of_height(square: Real, refractive_index: Real, wavelength: Real) -> Float[Array, ""]:
    """Logarithm of `exp(-(2 pi (n - 1) sigma / lambda)^2)`, the light that stays in the spot's core.

    Exact for heights of a normal distribution; `square` is `sigma^2`, mm^2.
    """
    return -((2 * np.pi * (jnp.asarray(refractive_index) - 1) / wavelength) ** 2) * square
