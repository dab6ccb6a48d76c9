"""Refinement of measured PSFs that do not quite fit: scale and blur, fitted together with the volume.

Two sets of squares of the capture are held out of the volume's fit. The volume from the remaining pixels predicts the
first set, and the numbers that predict it best are found by Levenberg-Marquardt steps with the total derivative: a
change of the PSF also changes the volume, through all steps of its solver (bilevel optimization). The second set
decides whether the result is kept, so numbers that fit noise are not.

Shifts are not fitted: no capture tells a shift of a plane's PSF from a shift of that plane of the volume.
Nor has each plane numbers of its own: with these, planes would move in depth.
"""

import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Float32, Num

from ..base.progress import Progress
from ..base.typing import Image
from ..linear.measured_psf import ConvolutionOperator, warp_psf
from ..solvers.admm import ConvolutionADMM
from ..solvers.base import solve
from .deconvolution import (
    Deconvolver,
    bin_capture,
    capture_binning,
    choose_smoothness,
    light_and_unit,
    normalise_spots,
)
from .inverse_problem import cell_side, held_out_squares, sum_pixels

# Largest change of scale. Freer ones turn planes into planes at other depths, which explain a capture better, too.
_FARTHEST = 0.05
# Steps of the volume from nothing, and Levenberg-Marquardt steps.
_STEPS, _FIT_STEPS = 60, 8
# Voxels of the scene beyond which pixels are binned.
_VOXELS = 2**17
# Initial standard deviation of the blur, pixels: at 0 it has no derivative.
_FIRST_BLUR = 0.3
_TINY = 1e-30


class PsfFit(NamedTuple):
    """Refined PSFs, and what was found.

    Parameters
    ----------
    psf
        The refined stack, or the given one if the numbers do not predict held-out pixels better.
    scale
        Magnification of the PSFs about their middles.
    blur
        Standard deviation of the Gaussian blur, pixels.
    before, after
        RMS error of the second set of held-out pixels by the given PSFs and by the fitted numbers, relative to the RMS
        of these pixels.
    """

    psf: Float32[np.ndarray, "depth high wide"]
    scale: float
    blur: float
    before: float
    after: float

    @property
    def is_better(self) -> bool:
        """Whether the numbers predict held-out pixels better than the given PSFs do, by a scale that is within 5 %."""
        return self.after < self.before and abs(self.scale - 1) < _FARTHEST


def fit_psf(
    image: Image,
    psf: Num[Array | np.ndarray, "*depth high wide"],
    solver: Deconvolver | None = None,
    *,
    choose: bool = False,
    progress: Progress | None = None,
) -> PsfFit:
    """Fit scale and blur of a measured stack together with the volume.

    *Host.*

    Large captures are binned. All planes have the same scale and blur.

    Parameters
    ----------
    image, psf, progress
        As for `deconvolve`.
    solver
        Its weights are those of the volume's fit if it is `ConvolutionADMM`; by default, and for other solvers, the
        weight of total variation is chosen from the capture.
    choose
        Choose the weight also if the solver has one.

    Raises
    ------
    InputError
        As by `deconvolve`.
    """
    light, psf = light_and_unit(image)[0], normalise_spots(psf, np.shape(image))
    if choose or not isinstance(solver, ConvolutionADMM):
        solver = solver if isinstance(solver, ConvolutionADMM) else ConvolutionADMM(_STEPS, sparsity=0.0)
        solver = dataclasses.replace(solver, tv=choose_smoothness(light, psf, solver, progress).tv)
    side = capture_binning(light.shape, psf.shape, _VOXELS)
    light, spots = bin_capture(light, side), np.stack([sum_pixels(spot, side) for spot in psf])
    kept = held_out_squares(light.shape)
    cells = np.add.outer(*(np.arange(n) // cell_side(light.shape) for n in light.shape)) % 2
    first, second = ((1 - kept) * (cells == parity) for parity in (0, 1))
    # An edge has 1 / side as many binned pixels, an area 1 / side^2.
    inner = dataclasses.replace(solver, steps=_STEPS, tolerance=0.0, tv=solver.tv / side)
    # Weights, too, are arguments of the program.
    data = jax.tree.map(jnp.asarray, _Data(light, spots, kept, first, inner))
    given = jnp.zeros(2)
    start = given.at[1].set(_FIRST_BLUR)
    lm = optx.LevenbergMarquardt(rtol=1e-2, atol=1e-2)
    with (progress or Progress()).step("Refining the PSFs"):
        error = np.asarray(_error(given, data))
        # Residuals of the order of 1, for which the first damping of the steps is small.
        data = eqx.tree_at(lambda d: d.weight, data, data.weight / max(_rms(error, first), _TINY))
        found = optx.least_squares(
            _residuals, lm, start, data, max_steps=_FIT_STEPS, throw=False, options={"jac": "fwd"}
        )
        errors = error, np.asarray(_error(found.value, data))
    before, after = (_rms(error, second) / max(_rms(light, second), _TINY) for error in errors)
    scale, blur = map(float, _numbers(found.value, spots.shape))
    blur = side * abs(blur)
    fit = PsfFit(psf, scale, blur, before, after)
    return fit._replace(psf=np.asarray(_warp(psf, jnp.float32(scale), jnp.float32(blur)))) if fit.is_better else fit


def _rms(image, mask):
    return math.sqrt(float(np.sum(mask * image.astype(np.float64) ** 2)) / max(float(mask.sum()), 1))


class _Data(eqx.Module):
    light: Float[Array | np.ndarray, "row column"]
    spots: Float[Array | np.ndarray, "depth high wide"]
    kept: Float[Array | np.ndarray, "row column"]
    weight: Float[Array | np.ndarray, "row column"]
    solver: ConvolutionADMM


def _numbers(parameters, shape):
    """Scale and blur; parameters are in pixels, that of the scale at the PSF's nearer edges."""
    return 1 + parameters[0] / (min(shape[1:]) / 2), parameters[1]


@jax.jit
def _warp(spots, scale, blur):
    return jax.lax.map(lambda spot: warp_psf(spot, scale, blur), jnp.asarray(spots))


@eqx.filter_jit
def _error(parameters, data):
    """Error of all pixels by the volume from those that are kept."""
    spots = _warp(data.spots, *_numbers(parameters.astype(data.light.dtype), data.spots.shape))
    A = ConvolutionOperator(spots, data.light.shape, data.kept)
    scene = solve(A, data.kept * data.light, data.solver, throw=False).value
    return eqx.tree_at(lambda a: a.kept, A, None).mv(scene) - data.light


def _residuals(parameters, data):
    return (data.weight * _error(parameters, data)).astype(parameters.dtype)
