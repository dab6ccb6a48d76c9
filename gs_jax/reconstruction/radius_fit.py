"""The radius of the lenses by captures of unknown scenes: with it lenses predict each other's light best.

A calibration by the places of spots does not see a wrong radius, which blurs them where they are. This fit sees little
else, and takes any other cause of a wrong focus for the radius: calibrate first.
"""

import dataclasses
import math
import warnings
from collections.abc import Callable, Sequence
from itertools import cycle
from typing import NamedTuple

import equinox as eqx
import numpy as np

from ..base.errors import InputError, InputWarning
from ..base.progress import Progress
from ..base.typing import Image
from ..io.camera import Readout
from ..microscope.geometry import Imager, field_limit
from ..microscope.grid import Grid
from .inverse_problem import prepare_model, sum_pixels
from .pipeline import Method, Reconstructor
from .residual import check_scored, kept_pixels_of_folds, light_of, relative, residual_of

# Groups of lenses, one of which is predicted.
_FOLDS = 4
# Largest change, its tolerance, and most trials.
_RANGE, _TOLERANCE, _TRIALS = 0.06, 3e-3, 7
# Width of the voxels over that of those that are wanted, and least number of voxels that a pixel is wide. Points that
# stand for a volume leave gaps in a sharp image, which a wrong radius would blur.
_FINER, _VOXELS_PER_PIXEL = 1 / 3, 2
# Most captures, and most voxels along a side of the middle that is judged: one number needs no more.
_CAPTURES, _SIDE = 3, 160
# An error smaller by less is no reason to change a design: that of a device as designed is a little smaller with radii
# that it does not have (`own_captures.py`).
_BETTER = 0.05


class RadiusFit(NamedTuple):
    """The microscope with the radii that predict best, and the trials.

    Parameters
    ----------
    imager
        With all radii changed by `factor`.
    factor
        1 unless another lowers the error by 5 % or more.
    trials
        `(factor, error)` in ascending order: RMS error of the pixels predicted, relative to their light, geometric mean
        of the captures.
    """

    imager: Imager
    factor: float
    trials: list[tuple[float, float]]


def fit_radius(
    images: Sequence[Image],
    imager: Imager,
    grid: Grid,
    method: Method,
    *,
    optics: str = "full",
    progress: Progress | None = None,
) -> RadiusFit:
    """Fit one factor of all radii to captures of any scenes, within 6 %.

    *Host.*

    Takes about eight reconstructions of the middle of each of three captures.

    Each capture is reconstructed without some lenses, whose light is predicted, as `cross_validated` does. The grid has
    these depths and voxels a third as wide, over the sensor. Of a large sensor only the middle is compared; around it
    all sources that it sees are reconstructed, too. Without light there the radii are kept.

    Parameters
    ----------
    images
        Captures of the microscope, of different scenes; of more than three, two or three are used.
    imager, grid, method, optics, progress
        As for `cross_validated`; optics by name.

    Raises
    ------
    InputError
        As for `cross_validated`, or without a capture.
    """
    from scipy.optimize import minimize_scalar  # imported here: back-projection does without SciPy

    if len(images) == 0:
        raise InputError("there must be a capture or more to fit the radius to, got none.")
    for image in images:
        check_scored(image, imager, method, optics)
    progress, images = progress or Progress(), images[:: math.ceil(len(images) / _CAPTURES)]
    part, fine, cut, judged = _middle(imager, grid.depths, _FINER * grid.pitch)
    folds = kept_pixels_of_folds(part, min(_FOLDS, len(part.centers)))
    captures = [(cut(np.asarray(image, np.float32)), kept) for image, kept in zip(images, cycle(folds))]
    trials: dict[float, float] = {}
    with progress.counter("Fitting the radius", _TRIALS + 1) as advance, warnings.catch_warnings():
        # Trials may be out of focus.
        warnings.simplefilter("ignore", InputWarning)

        def error(factor) -> float:
            made = with_radii(part, float(factor))
            trials[float(factor)] = value = _prediction_error(captures, judged, made, fine, method, optics, progress)
            advance()
            return value

        as_known = error(1.0)
        options = {"xatol": _TOLERANCE, "maxiter": _TRIALS}
        minimize_scalar(error, bounds=_bounds(imager), method="bounded", options=options)
    best = min(trials, key=lambda factor: trials[factor])
    factor = best if trials[best] < (1 - _BETTER) * as_known else 1.0
    return RadiusFit(with_radii(imager, factor), factor, sorted(trials.items()))


def with_radii(imager: Imager, factor: float) -> Imager:
    """Return the microscope with all radii larger by a factor, and the focal length, where that overrides them."""
    array = imager.array
    larger = {"radius_of_curvature": factor * array.radius_of_curvature}
    if array.thin_lens_focal_length is not None:
        larger["thin_lens_focal_length"] = factor * array.thin_lens_focal_length
    return dataclasses.replace(imager, array=dataclasses.replace(array, **larger))


def _prediction_error(captures, judged, imager, grid, method, optics, progress) -> float:
    """RMS error of the judged pixels that are predicted, relative to their light: geometric mean of the captures.

    By this mean, captures whose error depends on the radius decide, however large the errors of others are. Captures
    without light do not count.
    """
    reconstructor = Reconstructor(imager, grid, method, optics, progress=progress)
    problem, errors = prepare_model(imager, grid, optics, progress), []
    for image, kept in captures:
        light, left_out = light_of(image, problem), (kept == 0) & judged
        rest = residual_of(reconstructor.keeping(kept)(image, progress), light, problem, kept)
        if light[left_out].any():
            errors.append(relative(rest[left_out], light[left_out]))
    return float(np.exp(np.mean(np.log(errors)))) if errors else 0.0


def _bounds(imager: Imager) -> tuple[float, float]:
    """The factors with which surfaces fall outward to the edges of their apertures, 1 alone if there are none."""
    squared = (np.asarray(imager.array.aperture_diameter) / 2) ** 2
    falls = lambda array: np.all(array.reaches(squared) & (array.sag_slope_over_r(squared) > 0))
    factors = np.linspace(1 - _RANGE, 1 + _RANGE, 25)
    possible = [factor for factor in factors if falls(with_radii(imager, factor).array)] or [1.0]
    return min(possible), max(possible)


def _middle(
    imager: Imager, depths, pitch: float
) -> tuple[Imager, Grid, Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """Return the microscope and the grid at the middle of the sensor, a function that cuts images, and what is judged.

    Pixels are wider than voxels. Around those that are judged are as many as see the same sources.
    """
    sensor, magnification = imager.sensor, np.asarray(imager.magnification(depths))
    # A pixel sees a source through a lens between them: so far away at most.
    away = (1 + magnification.max()) * field_limit(imager.field_radius)
    most = round((_SIDE * pitch + 2 * away) / sensor.pixel_pitch)
    high, wide = (min(n, most) for n in sensor.shape)
    row, column = ((n - side) // 2 for n, side in zip(sensor.shape, (high, wide), strict=True))
    binning = min(
        math.ceil(_VOXELS_PER_PIXEL * magnification.mean() * pitch / sensor.pixel_pitch), min(high, wide) // 2
    )
    part = eqx.tree_at(lambda i: i.sensor, imager, Readout((row, column, high, wide), binning).sensor(sensor))
    judged = np.ones(part.sensor.shape, bool)
    margin = round(away / part.sensor.pixel_pitch)
    if high < sensor.shape[0]:
        judged[:margin] = judged[-margin:] = False
    if wide < sensor.shape[1]:
        judged[:, :margin] = judged[:, -margin:] = False
    cut = lambda image: sum_pixels(image[row : row + high, column : column + wide], binning)
    return part, Grid.over(part.sensor, depths=depths, pitch=pitch), cut, judged
