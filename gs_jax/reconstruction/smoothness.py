"""The weight of smoothness of a deconvolution, chosen by how well the scene predicts pixels that were held out."""

import dataclasses
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32

from ..base.progress import Progress
from ..projection.measured_psf import ConvolutionOperator, FieldConvolutionOperator
from ..solvers.admm import ADMM, ConvolutionADMM
from ..solvers.base import run_solver
from .inverse_problem import binned_variance, sum_pixels

# Weights that are tried: from the first on, weaker and weaker ones, and then stronger and stronger ones, each from the
# solution of the one before. From nothing, a scene builds up too slowly with a strong weight, and a weak one fits noise
# before detail.
_FIRST, _WEAKER, _STRONGER = 1e-3, (3e-4, 1e-4, 3e-5, 1e-5, 3e-6, 1e-6), (3e-3, 1e-2)
# Steps with the first weight and with each other.
_FIRST_STEPS, _STEPS = 60, 15
# Mean log error above the least at which no weight further on is tried.
_WORSE = 0.25
# Voxels of the scene beyond which pixels are binned for the trials.
_VOXELS = 2**20
# Side of the squares that are held out, pixels, and their distance, in sides. Single pixels are told by their
# neighbours, also where the PSF is wrong: they choose weights that are too weak. In small images squares are smaller.
_SIDE, _DISTANCE, _LEAST_SQUARES = 8, 4, 16
# Least error of a square that counts, relative to the mean; and against a division by zero.
_FLOOR, _TINY = 0.01, 1e-30


class Smoothness(NamedTuple):
    """A choice of the weight of total variation.

    Parameters
    ----------
    tv
        The weight.
    tried
        The weights that were tried.
    errors
        RMS error of the pixels that were held out for each weight, relative to the RMS of all.
    """

    tv: float
    tried: tuple[float, ...]
    errors: tuple[float, ...]


def choose_smoothness(
    light: Float32[np.ndarray, "row column"],
    psf: Float32[np.ndarray, "depth high wide"] | FieldConvolutionOperator,
    solver: ConvolutionADMM | ADMM,
    progress: Progress | None = None,
) -> Smoothness:
    """Choose the weight of total variation that predicts held-out squares of a capture best.

    *Host.*

    A square of 8 x 8 pixels of every 32 x 32 is left out of the fit. Each point casts light all over its PSF, so the
    rest of the capture tells what is in the squares. A weight that is too weak fits noise, and errors of the PSF, which
    the squares do not share; one that is too strong predicts too little detail. So the choice needs to know neither the
    noise nor the errors of the PSF (cross-validation: Stone, J. R. Stat. Soc. B 36, 111, 1974). The squares' mean log
    error decides, so that a few bright ones do not outvote the others.

    The weights are tried in a few steps each, from the solution of a weight nearby. Large captures are binned; noise is
    then added again, so that it is that of single pixels.

    Parameters
    ----------
    light
        The capture above its offset, at most of the order of 1.
    psf
        PSFs of the sum 1, or the operator of PSFs that vary over the field, which is not binned.
    solver
        Solver with all options but the weight.
    progress
        Shows progress.
    """
    if isinstance(psf, FieldConvolutionOperator):
        side, whole = 1, psf
    else:
        side = _binning(light.shape, psf.shape)
        light, spots = _binned(light, side), np.stack([sum_pixels(spot, side) for spot in psf])
        whole = ConvolutionOperator(spots, light.shape)
    kept = held_out_squares(light.shape)
    components = lambda a: (a.components if isinstance(a, FieldConvolutionOperator) else a).kept
    system = eqx.tree_at(components, whole, jnp.asarray(kept), is_leaf=lambda leaf: leaf is None)
    trial = dataclasses.replace(solver, steps=_FIRST_STEPS, tolerance=0.0, tv=_FIRST)
    errors = {}

    def error_of(weight, last=None, before=_FIRST):
        """Take the steps of a weight from the last state, of another weight; keep the error and return the state."""
        some = trial if last is None else dataclasses.replace(trial, steps=_STEPS)
        start = None if last is None else trial.smoother(last, weight / before)
        state: Any = run_solver(some, kept * light, system, Progress(), state=start).state
        errors[weight] = _squares((1 - kept) * (np.asarray(image_of(whole, trial.estimate(state))) - light))
        return state

    with (progress or Progress()).counter("Choosing the smoothness", 1 + len(_WEAKER) + len(_STRONGER)) as advance:
        first = error_of(_FIRST)
        advance()
        for weights in (_WEAKER, _STRONGER):
            # A copy, as steps overwrite their state.
            state, before = jax.tree.map(jnp.copy, first), _FIRST
            for weight in weights:
                state, before = error_of(weight, state, before), weight
                advance()
                means = _mean_logs(list(errors.values()))
                if means[-1] > means.min() + _WORSE:
                    break
    tried = sorted(errors)
    errors = np.array([errors[weight] for weight in tried])
    rms = np.sqrt(errors.mean(axis=1) / max(float(np.mean(_squares((1 - kept) * light))), _TINY))
    # An edge has 1 / side as many binned pixels, an area 1 / side^2.
    scaled = tuple(side * weight for weight in tried)
    best = int(_mean_logs(errors).argmin())
    return Smoothness(scaled[best], scaled, tuple(rms.tolist()))


def held_out_squares(shape: tuple[int, ...]) -> Float32[np.ndarray, "row column"]:
    """0 in squares that are held out, a square in each cell at a pseudo-random place, and 1 elsewhere."""
    side, rng, kept = _square_side(shape), np.random.default_rng(0), np.ones(shape, np.float32)
    cell = _DISTANCE * side
    for corner in np.ndindex(*(-(-n // cell) for n in shape)):
        row, column = cell * np.array(corner) + rng.integers(0, cell - side, 2, endpoint=True)
        kept[row : row + side, column : column + side] = 0
    return kept


def _square_side(shape):
    return max(min(_SIDE, min(shape) // _LEAST_SQUARES), 1)


def _squares(error):
    """Sum of the squares of an error in each cell."""
    cell = _DISTANCE * _square_side(error.shape)
    rows, columns = (range(0, n, cell) for n in error.shape)
    return np.add.reduceat(np.add.reduceat(error.astype(np.float64) ** 2, rows, 0), columns, 1).ravel()


def _mean_logs(errors):
    """Mean logarithm of the cells' errors with each weight; cells without light have no tiny ones."""
    errors = np.asarray(errors)
    floor = _FLOOR * errors.mean(axis=1).min()
    return np.log(errors + max(floor, _TINY)).mean(axis=1)


def _binning(image_shape, psf_shape):
    """The least side of squares of pixels with which the scene has few enough voxels."""
    voxels = psf_shape[0] * math.prod(n + k for n, k in zip(image_shape, psf_shape[1:], strict=True))
    side = math.ceil(math.sqrt(voxels / _VOXELS))
    return max(min(side, min(*image_shape, *psf_shape[1:]) // 2), 1)


def _binned(light, side):
    """The mean of squares of pixels, with noise added so that it is as large as that of a single pixel."""
    if side == 1:
        return light
    mean = sum_pixels(light, side) / np.float32(side**2)
    missing = binned_variance(light, mean.shape) / side**2 * (1 - 1 / side**2)
    noise = np.random.default_rng(0).standard_normal(mean.shape, np.float32)
    return mean + noise * np.sqrt(missing).astype(np.float32)


@jax.jit
def image_of(system, scene):
    """The image of a scene."""
    return system.mv(scene)
