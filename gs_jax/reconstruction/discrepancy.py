"""How far from a capture a volume's image may stay: no closer than the noise, or the noise is reconstructed, too."""

import numpy as np
from jaxtyping import Float, Float64, Shaped

# Side of the squares that have one noise each, pixels.
_SQUARE = 32
# Median of the absolute value of normal noise, in standard deviations.
_MEDIAN = 0.6745


def noise_variance(image: Shaped[np.ndarray, "row column"]) -> Float64[np.ndarray, "square_row square_column"]:
    """Variance of a capture's noise in each square of 32 pixels (the last may be smaller), in the square of its unit.

    From second differences along rows and columns, in which smooth light cancels (Immerkaer, Comput. Vis. Image
    Underst. 64, 300, 1996), and their median, which sharp spots hardly move. Images of fewer than three pixels a side
    have none.
    """
    image = np.asarray(image, np.float64)
    if min(image.shape) < 3:
        return np.zeros((1, 1))
    # The variance of independent noise grows by 6 with each.
    difference = np.abs(np.diff(np.diff(image, 2, axis=0), 2, axis=1)) / 6
    ends = [range(0, n, _SQUARE) for n in difference.shape]
    median = [[np.median(difference[r : r + _SQUARE, c : c + _SQUARE]) for c in ends[1]] for r in ends[0]]
    return (np.array(median) / _MEDIAN) ** 2


def misfit_of_noise(
    image: Shaped[np.ndarray, "row column"], light: Float[np.ndarray, "binned_row binned_column"], *, counts: bool
) -> float:
    """The cost that a solver has left where nothing but noise is (the discrepancy principle of Morozov, 1966).

    Parameters
    ----------
    image
        The capture.
    light
        What is to be explained: pixels of the capture summed to larger ones, above the offset.
    counts
        If true, of the Kullback-Leibler divergence, `sum(variance / (2 mean))`; else of half the squares.
    """
    from scipy.ndimage import uniform_filter  # here, so that back-projection, which asks no noise, does without SciPy

    side = image.shape[0] // light.shape[0]
    variance = noise_variance(image)
    squares = (np.arange(n) * side // _SQUARE for n in light.shape)
    variance = side**2 * variance[np.ix_(*(np.minimum(s, n - 1) for s, n in zip(squares, variance.shape, strict=True)))]
    if counts:
        # In the dark, where negative pixels count as 0, a divergence is of the order of the noise.
        mean = np.maximum(uniform_filter(np.asarray(light, np.float64), max(_SQUARE // side, 1)), np.sqrt(variance))
        variance = np.divide(variance, mean, out=np.zeros_like(variance), where=mean > 0)
    return float(variance.sum() / 2)
