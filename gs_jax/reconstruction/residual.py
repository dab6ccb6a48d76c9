"""Residual between a capture and the image of its reconstruction: forward residual, and level that noise explains."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Shaped

from ..base.arrays import check_finite, host_code
from ..base.progress import Progress
from ..geometry import Imager
from ..grid import Grid
from ..projection.forward_model import Optics, forward
from ..typing import Image
from .inverse_problem import prepare_data, prepare_model

# Regions along a side of the sensor, unless it has fewer pixels.
_REGIONS = 16
# Side of the squares in which noise is estimated, pixels.
_SQUARE = 32
# Median absolute value of a standard normal variable.
_NORMAL_MEDIAN = 0.6745


class ForwardResidual(NamedTuple):
    """Difference between the image of a volume, scaled to fit best, and the capture.

    Parameters
    ----------
    error
        RMS of the difference relative to that of the capture above its offset: 0 if all is explained, 1 if nothing is.
    correlation
        Pearson's correlation of the pixels.
    regions
        The error in squares of the sensor, relative to the whole capture's RMS: do not trust what is reconstructed from
        squares where it is large.
    """

    error: float
    correlation: float
    regions: Float[np.ndarray, "row column"]


@host_code("use `forward`")
def forward_residual(
    volume: Float[Array | np.ndarray, "depth y x"],
    image: Image,
    imager: Imager,
    grid: Grid,
    *,
    optics: Optics | str = "full",
    progress: Progress | None = None,
) -> ForwardResidual:
    """Image a volume again, and compare the image with the capture.

    *Host.*

    The images are compared as iterative methods see them: above the camera's offset, with pixels as wide as voxels, and
    without the background that the optics lack.

    Parameters
    ----------
    volume
        Volume of `grid.volume_shape`, by any method.
    image, imager, grid, optics, progress
        As for `reconstruct`.

    Raises
    ------
    InputError
        If a voxel or a pixel is not finite, or the optics do not exist.

    Examples
    --------
    >>> volume = gs.reconstruct(image, scope, grid, gs.RichardsonLucy(steps=10), optics="near")
    >>> check = gs.forward_residual(volume, image, scope, grid, optics="near")
    >>> print(check.error < 0.5, check.correlation > 0.9, check.regions.shape)
    True True (16, 16)
    """
    check_finite("volume", volume, "voxels")
    model = prepare_model(imager, grid, optics, progress or Progress())
    light, background = prepare_data(image, model)
    again = forward(jnp.asarray(volume, light.dtype), model.imager, grid, model.optics)
    return _compare(np.asarray(again, np.float64), np.asarray(light - background, np.float64))


def _compare(model, light):
    energy, rms = np.vdot(model, model), np.sqrt(np.mean(light**2))
    residual = light - (np.vdot(model, light) / energy if energy > 0 else 0) * model
    spread = model.std() * light.std()
    correlation = np.mean((model - model.mean()) * (light - light.mean())) / spread if spread > 0 else 0.0
    # Any volume explains a dark capture.
    regions = rms_of_regions(residual) / (rms if rms > 0 else 1)
    error = np.sqrt(np.mean(residual**2)) / rms if rms > 0 else 0.0
    return ForwardResidual(float(error), float(correlation), regions)


def rms_of_regions(image: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "region_row region_column"]:
    """RMS in each of 16 x 16 regions of the sensor."""
    first = [np.unique(np.linspace(0, n, _REGIONS, endpoint=False).astype(int)) for n in image.shape]
    sums = lambda part: np.add.reduceat(np.add.reduceat(part, first[0], 0), first[1], 1)
    return np.sqrt(sums(image**2) / sums(np.ones_like(image)))


def noise_variance(image: Shaped[np.ndarray, "row column"]) -> Float64[np.ndarray, "square_row square_column"]:
    """Variance of a capture's noise in each square of 32 pixels (the last may be smaller); 0 below 3 pixels a side.

    From second differences along rows and columns, in which smooth light cancels (Immerkaer, Comput. Vis. Image
    Underst. 64, 300, 1996), and their median, which sharp spots hardly change.
    """
    image = np.asarray(image, np.float64)
    if min(image.shape) < 3:
        return np.zeros((1, 1))
    # Each second difference multiplies the variance of independent noise by 6.
    difference = np.abs(np.diff(np.diff(image, 2, axis=0), 2, axis=1)) / 6
    starts = [range(0, n, _SQUARE) for n in difference.shape]
    median = [[np.median(difference[r : r + _SQUARE, c : c + _SQUARE]) for c in starts[1]] for r in starts[0]]
    return (np.array(median) / _NORMAL_MEDIAN) ** 2


def binned_variance(
    image: Shaped[np.ndarray, "row column"], shape: tuple[int, ...]
) -> Float64[np.ndarray, "binned_row binned_column"]:
    """Variance of the noise in each pixel of the capture that is binned to this shape."""
    side, variance = image.shape[0] // shape[0], noise_variance(image)
    squares = (np.arange(n) * side // _SQUARE for n in shape)
    return side**2 * variance[np.ix_(*(np.minimum(s, n - 1) for s, n in zip(squares, variance.shape, strict=True)))]


def discrepancy_target(
    image: Shaped[np.ndarray, "row column"], light: Float[np.ndarray, "binned_row binned_column"], *, counts: bool
) -> float:
    """Cost that noise alone leaves a solver, by the discrepancy principle (Morozov, 1966).

    Parameters
    ----------
    image
        The capture.
    light
        Data to explain: the capture in binned pixels, above the offset.
    counts
        Whether the cost is the Kullback-Leibler divergence, `sum(variance / (2 mean))`, or half the squares.
    """
    from scipy.ndimage import uniform_filter  # imported here: back-projection does without SciPy

    side, variance = image.shape[0] // light.shape[0], binned_variance(image, light.shape)
    if counts:
        # In the dark, where negative pixels count as 0, the divergence is of the order of the noise.
        mean = np.maximum(uniform_filter(np.asarray(light, np.float64), max(_SQUARE // side, 1)), np.sqrt(variance))
        variance = np.divide(variance, mean, out=np.zeros_like(variance), where=mean > 0)
    return float(variance.sum() / 2)
