"""How well a volume explains a capture: the forward residual, and cross-validation by lenses that were not used.

Cross-validation also gives the standard deviation of each voxel, by the jackknife.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..base.arrays import check_finite, host_code
from ..base.errors import InputError, short_repr
from ..base.progress import Progress
from ..base.typing import Image, Volume
from ..microscope.geometry import Imager
from ..microscope.grid import Grid
from ..projection.forward_model import Optics, forward
from ..solvers.surface import Surface
from .inverse_problem import InverseProblem, binned_variance, prepare_data, prepare_model
from .pipeline import BackProjection, Method, Reconstructor, check_call, check_stop

# Regions along a side of the sensor, unless it has fewer pixels.
_REGIONS = 16
# Voxels brighter than this share of the largest are those over which deviations are calibrated.
BRIGHT = 0.1
# Error that folds have in common, over the brightness: fitted to ray-traced letters, bars and a tilted sheet, by
# list-RL and Richardson-Lucy.
SHARE = 1 / 3


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
    energy = np.vdot(model, model)
    residual = light - (np.vdot(model, light) / energy if energy > 0 else 0) * model
    spread = model.std() * light.std()
    correlation = np.mean((model - model.mean()) * (light - light.mean())) / spread if spread > 0 else 0.0
    return ForwardResidual(relative(residual, light), float(correlation), relative_regions(residual, light))


def relative(residual: Float[np.ndarray, "..."], light: Float[np.ndarray, "..."]) -> float:
    """RMS of a residual, relative to that of the light; 0 without light, which any volume explains."""
    energy = float(np.sum(light**2))
    return float(np.sqrt(np.sum(residual**2) / energy)) if energy > 0 else 0.0


def relative_regions(
    residual: Float[np.ndarray, "row column"], light: Float[np.ndarray, "row column"]
) -> Float[np.ndarray, "region_row region_column"]:
    """RMS of a residual in each of 16 x 16 regions of the sensor, relative to that of the light, unless it is dark."""
    first = [np.unique(np.linspace(0, n, _REGIONS, endpoint=False).astype(int)) for n in light.shape]
    sums = lambda part: np.add.reduceat(np.add.reduceat(part, first[0], 0), first[1], 1)
    return np.sqrt(sums(residual**2) / sums(np.ones_like(light))) / (np.sqrt(np.mean(light**2)) or 1)


class CrossValidation(NamedTuple):
    """How well a method predicts pixels that it did not use; no ground truth is needed.

    Parameters
    ----------
    error
        RMS of the difference between prediction and capture, relative to that of the capture above its background: 0 if
        all is predicted, 1 for an empty volume.
    noise
        The same of the capture's noise alone, as far as its pixels tell: no prediction has less.
    folds
        The error of each fold, relative to the RMS of its own pixels.
    regions
        The error in squares of the sensor, relative to the whole capture's RMS.
    deviation
        Standard deviation of each voxel of the volume from all lenses, in its unit (see `jackknife_deviation`).
    """

    error: float
    noise: float
    folds: Float[np.ndarray, " fold"]
    regions: Float[np.ndarray, "row column"]
    deviation: Volume

    @property
    def score_db(self) -> float:
        """How much smaller the error is than that of an empty volume, `20 log10(1 / error)`, dB."""
        return 20 * math.log10(1 / max(self.error, 1e-12))

    @property
    def best_db(self) -> float:
        """The score of a perfect volume: noise cannot be predicted."""
        return 20 * math.log10(1 / max(self.noise, 1e-12))


@host_code()
def cross_validated(
    image: Image,
    imager: Imager,
    grid: Grid,
    method: Method = BackProjection(),
    *,
    optics: Optics | str = "full",
    stop_at_discrepancy: bool = False,
    folds: int = 4,
    progress: Progress | None = None,
) -> CrossValidation:
    """Score a method on a capture: reconstruct without some lenses, predict their light, and compare.

    *Host.*

    Takes as long as `folds` reconstructions.

    Sub-images overlap, so that light cannot be divided by lenses. Pixels can: each belongs to the nearest lens, whose
    light is most of its light, and each lens to one of the folds, those of neighbours differing. A fold is
    reconstructed from the pixels of all others; its own count nowhere, not as dark. A voxel is seen through a dozen
    lenses, so the others know it. The image of that volume predicts the pixels of the fold, with a gain that fits it
    best to the pixels that were used. A pixel was so either used or predicted, and its noise is independent of the
    prediction: a method that fits noise, or what the model lacks, to some lenses is wrong about the others.
    `forward_residual` sees pixels that were fitted, and improves with every step.

    Images are compared as iterative methods see them: above the camera's offset, with pixels as wide as voxels, without
    background that is smooth or that the optics lack. That background is the whole capture's, a few numbers that are
    the same for all methods. Squares count equally, so bright pixels count most, as they do in the PSNR of volumes.

    Compare methods, options and calibrations on one capture by `score_db`; scores of different scenes differ. It does
    not see a volume's unit, nor where lenses see nothing.

    Parameters
    ----------
    image, imager, grid, method, optics, stop_at_discrepancy, progress
        As for `reconstruct`; not `Surface`.
    folds
        2 or more, at most as many as lenses.

    Raises
    ------
    InputError
        As for `reconstruct`; if there are not so many folds, or the method is `Surface`.

    Examples
    --------
    >>> found = gs.cross_validated(image, scope, grid, gs.RichardsonLucy(steps=5), optics="near", folds=3)
    >>> print(found.error < 1, found.folds.shape)
    True (3,)
    """
    check_stop(method, stop_at_discrepancy)
    check_scored(image, imager, method, optics)
    progress = progress or Progress()
    options = {"stop_at_discrepancy": stop_at_discrepancy, "progress": progress}
    problem = prepare_model(imager, grid, optics, progress)
    reconstructor = Reconstructor(imager, grid, method, optics, **options)
    light = light_of(image, problem)
    residual, parts, volumes = np.zeros_like(light), [], []
    for kept in progress.track(kept_pixels_of_folds(problem.imager, folds), "Cross-validating"):
        volumes.append(reconstructor.keeping(kept)(image, progress))
        rest = residual_of(volumes[-1], light, problem, kept)
        left_out = kept == 0
        residual[left_out] = rest[left_out]
        parts.append(relative(rest[left_out], light[left_out]))
    noise, rms = math.sqrt(binned_variance(np.asarray(image), light.shape).mean()), float(np.sqrt(np.mean(light**2)))
    noise = min(noise / rms, 1.0) if rms > 0 else 0.0
    parts, regions = np.array(parts), relative_regions(residual, light)
    return CrossValidation(relative(residual, light), noise, parts, regions, jackknife_deviation(volumes))


def jackknife_deviation(volumes: Sequence[Volume]) -> Volume:
    """Standard deviation of the voxels of a volume from all lenses, by volumes that each lack one fold of lenses.

    The delete-a-group jackknife, `sqrt((m - 1) / m sum((x_i - mean)^2))` of `m` volumes `x_i`, is the deviation of a
    mean over folds whose errors are independent. Its variance, of `m - 1` degrees of freedom, is averaged over
    neighbours. Folds do not show the bias that they have in common: a third of the brightness, in RMS over neighbours
    along z. It is that of a scene blurred along z until lenses tell its planes apart; of single voxels it is larger.
    """
    from scipy.ndimage import gaussian_filter  # imported here: back-projection does without SciPy

    count = len(volumes)
    mean: Any = sum(volumes) / count
    variance = (count - 1) / count * sum((volume - mean) ** 2 for volume in volumes)
    return np.sqrt(gaussian_filter(variance, (0, 0.7, 0.7)) + SHARE**2 * gaussian_filter(mean**2, (0.5, 0, 0)))


def format_deviation(volume: Volume, deviation: Volume) -> str:
    """The median deviation of bright voxels, relative to their brightness, as text."""
    bright = volume > max(BRIGHT * float(volume.max()), 0)
    share = f"{np.median(deviation[bright] / volume[bright]):.0%}" if bright.any() else "unknown"
    where = f"at the median of voxels brighter than {BRIGHT:.0%} of the largest"
    return f"standard deviations are {share} of the brightness {where}"


def check_scored(image, imager, method, optics):
    """Raise the errors of `cross_validated` that need no computation."""
    check_call(image, imager, method, optics)
    if isinstance(method, Surface):
        raise InputError("method must be one of free voxels to be scored by other lenses, got Surface().")


def light_of(image: Image, problem: InverseProblem) -> Float[np.ndarray, "y x"]:
    """The light of a capture without background."""
    light, background = prepare_data(image, problem)
    return np.asarray(problem.detrend(light - background), np.float64)


def residual_of(volume: Volume, light: np.ndarray, problem: InverseProblem, kept: np.ndarray) -> np.ndarray:
    """What a volume leaves of the light, with a gain that fits the pixels that are kept (1, and 0 for others)."""
    imager = problem.imager
    image = forward(jnp.asarray(volume, imager.sensor_distance.dtype), imager, problem.grid, problem.optics)
    shown = np.asarray(problem.detrend(image), np.float64)
    energy = np.vdot(kept * shown, shown)
    return light - (max(np.vdot(kept * shown, light) / energy, 0) if energy > 0 else 0) * shown


def kept_pixels_of_folds(imager: Imager, count: int) -> list[Float[np.ndarray, "row column"]]:
    """For each fold, 1 for pixels of other folds, and 0 for its own.

    Raises
    ------
    InputError
        Unless there are 2 or more folds, and at least as many lenses.
    """
    from scipy.spatial import KDTree  # imported here: back-projection does without SciPy

    centers = np.asarray(imager.centers)
    if len(centers) < 2:
        raise InputError("a capture must be seen by 2 or more lenses to be predicted by others, got 1 lens.")
    if not (isinstance(count, int) and 2 <= count <= len(centers)):
        raise InputError(f"folds must be 2 to {len(centers)}, the number of lenses, got {short_repr(count)}.")
    pixels = np.moveaxis(np.indices(imager.sensor.shape), 0, -1)
    own = folds_of_lenses(centers, count)[KDTree(np.asarray(imager.sensor.to_pixels(centers))).query(pixels)[1]]
    return [np.asarray(own != fold, imager.sensor_distance.dtype) for fold in range(count)]


def folds_of_lenses(centers: Float[np.ndarray, "lens 2"], count: int) -> Int[np.ndarray, " lens"]:
    """Fold of each lens: from the middle outwards, the one whose nearest lens is farthest."""
    folds = np.full(len(centers), -1)
    for lens in np.argsort(np.hypot(*(centers - centers.mean(0)).T), kind="stable"):
        apart = np.hypot(*(centers - centers[lens]).T)
        folds[lens] = np.argmax([apart[folds == fold].min(initial=np.inf) for fold in range(count)])
    return folds
