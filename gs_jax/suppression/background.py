"""Background and noise of an image, square by square. Host code."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32, Shaped

# Side of the squares that have one background and one noise, pixels: wider than a spot, narrower than haze.
_SQUARE = 32


def local_levels(
    image: Shaped[Array | np.ndarray, "row column"],
) -> tuple[Float32[np.ndarray, "row column"], Float32[np.ndarray, "row column"]]:
    """Background and noise: of each square of 32 pixels, then linear between the squares' middles.

    The background is the median; the noise is the root mean square of what is darker, which no spot adds to.
    """
    image = np.asarray(image, np.float32)
    rows, columns = image.shape
    padded = np.pad(image, ((0, -rows % _SQUARE), (0, -columns % _SQUARE)), mode="edge")
    squares = padded.reshape(padded.shape[0] // _SQUARE, _SQUARE, -1, _SQUARE).swapaxes(1, 2)
    # A third of the pixels says the same.
    squares = squares.reshape(*squares.shape[:2], -1)[..., ::3]
    median = np.median(squares, axis=-1)
    darker = np.minimum(squares - median[..., None], 0)
    noise = np.sqrt(2 * np.mean(darker**2, axis=-1))
    wide = lambda part: np.asarray(jax.image.resize(jnp.asarray(part), padded.shape, "linear"))[:rows, :columns]
    return wide(median), wide(noise)
