"""Deconvolution of a capture with measured PSFs, of a diffuser or any other mask in front of a camera."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Num

from ..base.arrays import check_finite, host_code
from ..base.errors import InputError, input_error, short_repr
from ..base.machine import available_memory
from ..base.progress import Progress
from ..base.typing import Image
from ..linear.measured_psf import ConvolutionOperator, FieldConvolutionOperator, middle, scene_size
from ..solvers.admm import ADMM, ConvolutionADMM
from ..solvers.base import estimate_of, run_solver
from ..solvers.fista import FISTA
from ..solvers.richardson_lucy import RichardsonLucy
from .inverse_problem import (
    binned_variance,
    cell_side,
    discrepancy_target,
    held_out_squares,
    subtract_offset,
    sum_pixels,
)
from .pipeline import DISCREPANCY_FACTOR

# Relative change of the last step below which a solver has converged.
CONVERGED = 1e-3
# Light at the edge of a PSF, relative to its brightest pixels, above which it is cut there, and how wide the edge is.
_CUT, _EDGE = 0.1, 2
# Arrays of the scene's size that a solver allocates, and for each component of the field. The peaks of 16 to 30 planes
# of 960 x 960 voxels were 13.7 arrays with ConvolutionADMM, 8.2 with FISTA and 8.6 with Richardson-Lucy; with one
# component and three, 22.0 and 22.3 with ADMM, 6.9 and 9.4 with FISTA, 7.2 and 13.8 with Richardson-Lucy.
ARRAYS, _EACH_COMPONENT = {ConvolutionADMM: 16, ADMM: 18, FISTA: 9, RichardsonLucy: 9}, 4

# Share of an edge within which images fade out.
_TAPER = 0.05
# Ratios of noise to signal that are tried, relative to the largest power of the PSF.
_RATIOS = np.geomspace(1e-7, 1e-1, 25)

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
# Least error of a square that counts, relative to the mean; and against a division by zero.
_FLOOR, _TINY = 0.01, 1e-30

Deconvolver = ConvolutionADMM | ADMM | FISTA | RichardsonLucy
# Solvers by the names of the command line, as functions of the number of steps.
SOLVERS: dict[str, Callable[[int], Deconvolver]] = {
    "admm": lambda steps: ConvolutionADMM(steps, sparsity=0.0),
    "fista": FISTA,
    "richardson-lucy": lambda steps: RichardsonLucy(steps, accelerate=True),
}
_DEFAULT = SOLVERS["admm"](100)


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


class Deconvolution(NamedTuple):
    """A scene, and how well it explains the capture.

    Parameters
    ----------
    scene
        As `deconvolve` returns it.
    smoothness
        The choice of the weight of total variation; None if it was not chosen.
    residual
        RMS of what the scene does not explain, relative to that of the capture above its offset.
    steps
        Number of steps taken.
    change
        Relative change of the last step, as the solver defines it.
    reached_noise
        Whether the steps ended because all but noise is explained.
    """

    scene: Float32[np.ndarray, "*depth row column"]
    smoothness: Smoothness | None
    residual: float
    steps: int
    change: float
    reached_noise: bool

    @property
    def converged(self) -> bool:
        """Whether the last step changed little, or the steps ended at the noise."""
        return self.reached_noise or self.change < CONVERGED


@host_code("use `solve` with a `ConvolutionOperator`")
def deconvolve(
    image: Image,
    psf: Num[Array | np.ndarray, "*depth high wide"] | FieldConvolutionOperator,
    solver: Deconvolver | None = None,
    *,
    stop_at_discrepancy: bool = False,
    progress: Progress | None = None,
) -> Float32[np.ndarray, "*depth row column"]:
    """Reconstruct a plane, or a volume, from its image through measured PSFs.

    *Host.*

    Each plane has one PSF, wherever in it a point is, unless PSFs were measured over the field. Points beside the
    sensor whose light reaches it are reconstructed, too, and then cropped (Antipa et al., Optica 5, 1, 2018). The
    camera's offset, the first percentile, is subtracted from the image and from each PSF.

    Parameters
    ----------
    image
        Linear, in any unit.
    psf
        Image of a point on the axis, which is at the middle; any unit. Or a stack of them, one for each depth. Or the
        operator of PSFs that were measured over the field, by `gs_jax.reconstruction.field_fit.fit_field`.
    solver
        Solver that inverts the convolutions. For PSFs over the field `ADMM`, which takes the weights of
        `ConvolutionADMM` if that is given. None: 100 steps of `ConvolutionADMM`, with the weight of total variation
        that predicts parts of the image best which are held out (`choose_smoothness`).
    stop_at_discrepancy
        Stop early where the cost is no larger than the image's noise leaves (Morozov's discrepancy principle).
    progress
        Shows progress.

    Returns
    -------
    ndarray
        The scene, a plane of `image.shape` for each PSF, in the image's unit: its sum is about that of the light that
        reaches the sensor.

    Raises
    ------
    InputError
        If `solver` is no such solver, a pixel is not finite, the PSF is no image or stack, is larger than the image, or
        has a dark plane, or the solver would not fit into memory.

    Examples
    --------
    >>> psf = np.zeros((33, 33))
    >>> psf[16, [8, 16, 26]] = 1.0  # three spots for each point
    >>> image = np.zeros((64, 64))
    >>> image[30, [22, 30, 40]] = 1.0  # of a point at row 30, column 30
    >>> scene = gs.deconvolve(image, psf, gs.FISTA(steps=50))
    >>> print(*divmod(int(scene.argmax()), 64))
    30 30
    >>> nearer = np.zeros((33, 33))
    >>> nearer[16, [4, 16, 31]] = 1.0  # the spots are farther apart
    >>> volume = gs.deconvolve(image, np.stack([nearer, psf]))
    >>> print(volume.shape, volume.sum((1, 2)).argmax())
    (2, 64, 64) 1
    """
    return run_deconvolution(
        image, psf, solver, choose=solver is None, stop_at_discrepancy=stop_at_discrepancy, progress=progress
    ).scene


def run_deconvolution(
    image: Image,
    psf: Num[Array | np.ndarray, "*depth high wide"] | FieldConvolutionOperator,
    solver: Deconvolver | None = None,
    *,
    choose: bool = False,
    stop_at_discrepancy: bool = False,
    progress: Progress | None = None,
) -> Deconvolution:
    """As `deconvolve`, with how well the scene explains it; `choose` chooses the weight of total variation."""
    solver, progress = _DEFAULT if solver is None else solver, progress or Progress()
    if not isinstance(solver, Deconvolver):
        raise InputError(f"solver must be an object such as ConvolutionADMM() or FISTA(), got {short_repr(solver)}.")
    light, unit = light_and_unit(image)
    spots = psf if isinstance(psf, FieldConvolutionOperator) else normalise_spots(psf, light.shape)
    system = spots if isinstance(spots, FieldConvolutionOperator) else ConvolutionOperator(spots, light.shape)
    if isinstance(system, FieldConvolutionOperator):
        solver = _of_any_operator(solver)
    elif isinstance(solver, ADMM):
        raise InputError("solver must be ConvolutionADMM() for PSFs that do not vary over the field, got ADMM.")
    check_memory(solver, system)
    smoothness = None
    if choose:
        if not isinstance(solver, ConvolutionADMM | ADMM):
            raise InputError("solver must be ConvolutionADMM() or ADMM(), whose smoothness can be chosen.")
        smoothness = choose_smoothness(light, spots, solver, progress)
        solver = dataclasses.replace(solver, tv=smoothness.tv)
    target = 0.0
    if stop_at_discrepancy:
        counts = isinstance(solver, RichardsonLucy)
        target = DISCREPANCY_FACTOR * discrepancy_target(np.asarray(image) / unit, light, counts=counts)
    run = run_solver(solver, light, system, progress, target=target, quarter="twice the --binning")
    scene = np.asarray(estimate_of(solver, run.state), np.float32)
    difference = np.asarray(image_of(system, scene)) - light
    residual = float(np.linalg.norm(difference) / (np.linalg.norm(light) or 1))
    scene = unit * scene[:, *system.window]
    scene = scene[0] if isinstance(psf, Array | np.ndarray) and psf.ndim == 2 else scene
    return Deconvolution(scene, smoothness, residual, run.steps, run.residual, run.cost < target)


def filter_image(image: Image, psf: Num[Array | np.ndarray, "*depth high wide"]) -> Float32[np.ndarray, "row column"]:
    """Deconvolve an image by the Wiener filter: one plane in about a second, as a preview.

    Offsets are subtracted, and values are in the image's unit, as by `deconvolve`. `InputError` as there, and for a
    stack of PSFs.
    """
    light, unit = light_and_unit(image)
    spots = normalise_spots(psf, light.shape)
    if len(spots) > 1:
        raise InputError(
            f"--method wiener must be used with one PSF, for one plane, got {len(spots)}; admm takes a stack."
        )
    return unit * filter_by_wiener(light, spots[0])[0]


def filter_by_wiener(
    light: Float32[np.ndarray, "row column"], psf: Float[np.ndarray, "high wide"]
) -> tuple[Float32[np.ndarray, "row column"], float]:
    """Deconvolve a capture by one PSF with a Wiener filter; return the scene, and the ratio of noise to signal.

    The ratio, which is the same at all frequencies, is chosen by generalised cross-validation (Golub, Heath and Wahba,
    Technometrics 21, 215, 1979). Negative values are set to 0. Light from beyond the sensor's edges is not modelled.
    """
    from scipy import fft

    size = scene_size(light.shape, psf.shape)
    light, psf = (_tapered(a) for a in (light, psf))
    image, spot = np.zeros(size, np.float32), np.zeros(size, np.float32)
    image[middle(light.shape, size)] = light
    spot[: psf.shape[0], : psf.shape[1]] = psf
    spot = np.roll(spot, [-(k // 2) for k in psf.shape], (0, 1))
    seen, transfer = (np.asarray(fft.rfft2(a, workers=-1)) for a in (image, spot))
    power = np.abs(transfer) ** 2
    energy, peak = np.abs(seen) ** 2, power.max()

    def score(ratio):
        """Sum of squared residuals over the squared number of degrees of freedom that are left."""
        left = ratio / (power / peak + ratio)
        return float(np.mean(left**2 * energy) / np.mean(left) ** 2)

    ratio = min(_RATIOS, key=score)
    scene = np.asarray(fft.irfft2(seen * transfer.conj() / (power + ratio * peak), size, workers=-1))
    return np.maximum(scene[middle(light.shape, size)], 0).astype(np.float32), float(ratio)


def _tapered(image):
    """An image that fades out at its edges: a cut would be taken for detail, and leave bright lines."""
    rows, columns = (np.minimum(1, (np.arange(n) + 0.5) / (_TAPER * n)).astype(np.float32) for n in image.shape)
    return image * np.minimum(rows, rows[::-1])[:, None] * np.minimum(columns, columns[::-1])


def light_and_unit(image):
    """An image above its offset, of the order of 1, which suits the weights of priors; and its unit."""
    check_finite("image", image)
    light = subtract_offset(np.asarray(image, np.float32))
    unit = np.float32(np.abs(light).max() or 1.0)
    return light / unit, unit


def bin_pixels(image: Num[np.ndarray, "row column"], side: int) -> Num[np.ndarray, "y x"]:
    """Sum squares of pixels; `InputError` if fewer than 2 x 2 are left."""
    if side == 1:
        return image
    rows, columns = (n // side for n in image.shape)
    if min(rows, columns) < 2:
        raise input_error("--binning", "such that 2 x 2 pixels or more are left", f"{rows} x {columns}")
    return sum_pixels(np.asarray(image, np.float32), side)


def pad_to_largest(spots: list[Num[np.ndarray, "_ _"]]) -> Num[np.ndarray, "plane tall wide"]:
    """Stack images of points that may differ in size; smaller ones are in the middle, in their own offset."""
    size = np.max([spot.shape for spot in spots], axis=0)

    def padded(spot):
        if spot.shape == tuple(size):
            return spot
        # The point is at n // 2 of n pixels.
        before = [n // 2 - k // 2 for n, k in zip(size, spot.shape, strict=True)]
        margins = [(b, n - k - b) for b, n, k in zip(before, size, spot.shape, strict=True)]
        spot = np.asarray(spot, np.float32)
        return np.pad(spot, margins, constant_values=float((spot - subtract_offset(spot)).max()))

    return np.stack([padded(spot) for spot in spots])


def cut_sides(spot: Num[np.ndarray, "high wide"]) -> list[str]:
    """The sides at which a PSF is cut by the edge of its image, where it leaves bright lines in the scene."""
    light = subtract_offset(np.asarray(spot, np.float32))
    edges = {"top": light[:_EDGE], "bottom": light[-_EDGE:], "left": light[:, :_EDGE], "right": light[:, -_EDGE:]}
    bright = _CUT * np.percentile(light, 99.9)
    return [side for side, edge in edges.items() if np.percentile(edge, 99) > bright > 0]


def normalise_spots(psf, image_shape) -> Float32[np.ndarray, "depth high wide"]:
    """PSFs above their offsets, each with the sum 1."""
    if psf.ndim not in (2, 3) or min(psf.shape) < 1:
        raise input_error("psf", "an image or a stack of images", f"the shape {psf.shape}")
    check_finite("psf", psf)
    spots = np.array(psf, np.float32).reshape(-1, *psf.shape[-2:])
    if any(k > n for k, n in zip(spots.shape[1:], image_shape, strict=True)):
        raise input_error("psf", f"at most the image's {_size(image_shape)} pixels", _size(spots.shape[1:]))
    for plane in range(len(spots)):
        spot = subtract_offset(spots[plane])
        if not (total := spot.sum()) > 0:
            where = f" in plane {plane + 1}" if len(spots) > 1 else ""
            raise InputError(f"psf must be the image of a point, got no light above the darkest percent{where}.")
        spots[plane] = spot / total
    return spots


def _of_any_operator(solver: Deconvolver) -> Deconvolver:
    if not isinstance(solver, ConvolutionADMM):
        return solver
    if solver.tv_z != 1 or not solver.nonnegative:
        given = f"tv_z={solver.tv_z:g}, nonnegative={solver.nonnegative}"
        raise input_error("solver", "with tv_z=1 and nonnegative=True for PSFs that vary over the field", given)
    return ADMM(solver.steps, solver.tolerance, solver.sparsity, solver.tv, solver.isotropic)


def check_memory(solver, system):
    """Raise `InputError` if a solver of a scene would not fit into memory."""
    arrays = ARRAYS[type(solver)]
    if isinstance(system, FieldConvolutionOperator):
        arrays += _EACH_COMPONENT * system.weights.shape[1]
    size = 4 * arrays * math.prod(system.scene_shape)
    if size > (memory := available_memory()):
        raise InputError(
            f"psf, image: the solver must take at most {memory / 2**30:.3g} GiB, the free memory, got "
            f"{_size(system.scene_shape)} voxels, for which it takes about {size / 2**30:.3g} GiB; --binning 2 takes a "
            "quarter, --tiles less."
        )


def _size(shape):
    return " x ".join(map(str, shape))


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
        side = capture_binning(light.shape, psf.shape)
        light, spots = bin_capture(light, side), np.stack([sum_pixels(spot, side) for spot in psf])
        whole = ConvolutionOperator(spots, light.shape)
    kept = held_out_squares(light.shape)
    system = eqx.tree_at(lambda a: a.kept, whole, jnp.asarray(kept), is_leaf=lambda leaf: leaf is None)
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


def _squares(error):
    """Sum of the squares of an error in each cell."""
    cell = cell_side(error.shape)
    rows, columns = (range(0, n, cell) for n in error.shape)
    return np.add.reduceat(np.add.reduceat(error.astype(np.float64) ** 2, rows, 0), columns, 1).ravel()


def _mean_logs(errors):
    """Mean logarithm of the cells' errors with each weight; cells without light have no tiny ones."""
    errors = np.asarray(errors)
    floor = _FLOOR * errors.mean(axis=1).min()
    return np.log(errors + max(floor, _TINY)).mean(axis=1)


def capture_binning(image_shape: tuple[int, ...], psf_shape: tuple[int, ...], voxels: int = _VOXELS) -> int:
    """The least side of squares of pixels with which the scene has few enough voxels."""
    count = psf_shape[0] * math.prod(n + k for n, k in zip(image_shape, psf_shape[1:], strict=True))
    side = math.ceil(math.sqrt(count / voxels))
    return max(min(side, min(*image_shape, *psf_shape[1:]) // 2), 1)


def bin_capture(light: Float32[np.ndarray, "row column"], side: int) -> Float32[np.ndarray, "y x"]:
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
