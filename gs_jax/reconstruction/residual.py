"""What of a capture a volume explains: the check on any reconstruction, and on a learned one above all."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Shaped

from ..base.arrays import check_finite
from ..base.progress import Progress
from ..geometry import Imager
from ..grid import Grid
from ..projection.forward_model import Optics, forward
from ..typing import Image
from .inverse_problem import explainable, model_of

# Squares along a side of the sensor, unless it has fewer pixels.
REGIONS = 16


class Reprojection(NamedTuple):
    """How far the image of a volume is from the capture, after the one gain that fits it best.

    Parameters
    ----------
    error
        RMS of the difference over that of the capture above its offset: 0 if all is explained, 1 if nothing is.
    correlation
        Pearson's, of the pixels.
    regions
        The error in squares of the sensor, relative to the whole capture's RMS: where it is large, do not trust what
        is reconstructed from there.
    """

    error: float
    correlation: float
    regions: Float[np.ndarray, "row column"]


def reproject(
    volume: Float[Array | np.ndarray, "depth y x"],
    image: Image,
    imager: Imager,
    grid: Grid,
    *,
    optics: Optics | str = "full",
    progress: Progress | None = None,
) -> Reprojection:
    """Image a volume again, and compare with the capture that it was reconstructed from.

    *Host.*

    It is compared as `reconstruct` sees it: above the camera's offset, pixels as wide as voxels, and without what the
    optics takes for background.

    Parameters
    ----------
    volume
        `grid.volume_shape`, of any method.
    image, imager, grid, optics, progress
        As for `reconstruct`.

    Raises
    ------
    InputError
        If a voxel or a pixel is not finite, or there is no such optics.

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> import numpy as np
    >>> point = np.array([[0.2, -0.1, 20.0, 1.0]])  # x, y, z in mm, and its light
    >>> image = gs.simulate(point, scope, optics="near", psf="geometric")
    >>> volume = gs.reconstruct(image, scope, grid, gs.RichardsonLucy(steps=10), optics="near")
    >>> found = gs.reproject(volume, image, scope, grid, optics="near")
    >>> print(found.error < 0.5, found.correlation > 0.9, found.regions.shape)
    True True (16, 16)
    """
    check_finite("volume", volume, "voxels")
    model = model_of(imager, grid, optics, progress or Progress())
    light, background = explainable(image, model)
    again = forward(jnp.asarray(volume, light.dtype), model.imager, grid, model.optics)
    return _compared(np.asarray(again, np.float64), np.asarray(light - background, np.float64))


def _compared(model, light):
    energy, whole = np.vdot(model, model), np.sqrt(np.mean(light**2))
    left = light - (np.vdot(model, light) / energy if energy > 0 else 0) * model
    spread = model.std() * light.std()
    correlation = np.mean((model - model.mean()) * (light - light.mean())) / spread if spread > 0 else 0.0
    # A dark capture is explained by anything.
    regions = _rms_of_regions(left) / (whole if whole > 0 else 1)
    error = np.sqrt(np.mean(left**2)) / whole if whole > 0 else 0.0
    return Reprojection(float(error), float(correlation), regions)


def _rms_of_regions(image):
    first = [np.unique(np.linspace(0, n, REGIONS, endpoint=False).astype(int)) for n in image.shape]
    sums = lambda part: np.add.reduceat(np.add.reduceat(part, first[0], 0), first[1], 1)
    return np.sqrt(sums(image**2) / sums(np.ones_like(image)))


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
