"""The weight of smoothness that `deconvolve` chooses, on captures with truth and on real ones; the Wiener filter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tifffile
from scipy.signal import fftconvolve

from gs_jax import FISTA, ConvolutionADMM, ConvolutionOperator, InputError, solve
from gs_jax.reconstruction.deconvolution import (
    choose_smoothness,
    cut_sides,
    deconvolve,
    filter_image,
    normalise_spots,
    run_deconvolution,
)
from gs_jax.reconstruction.inverse_problem import held_out_squares, subtract_offset

from .helpers import needs

SIZE = 96


def patches() -> np.ndarray:
    """A scene of areas with edges, and bars of two pixels."""
    scene = np.zeros((SIZE, SIZE))
    scene[30:60, 30:50], scene[40:70, 44:60], scene[24:28, 30:66] = 1.0, 2.0, 0.7
    scene[36:56, 62:74:4] = scene[36:56, 63:75:4] = 1.5
    return scene


def spots() -> np.ndarray:
    rng = np.random.default_rng(0)
    psf = np.zeros((41, 41))
    psf[tuple(rng.integers(6, 35, (2, 12)))] = 1
    psf = fftconvolve(psf, np.outer(np.hanning(5), np.hanning(5)), mode="same").clip(0)
    return psf / psf.sum()


def capture(noise: float) -> np.ndarray:
    image = fftconvolve(patches(), spots(), mode="same")
    return image + noise * np.random.default_rng(1).standard_normal(image.shape)


def error(scene) -> float:
    return float(np.linalg.norm(scene - patches()) / np.linalg.norm(patches()))


@pytest.mark.parametrize(("noise", "bounds"), [(0.002, (1e-6, 1e-4)), (0.1, (1e-3, 1e-2))])
def test_the_chosen_weight_follows_the_noise_and_is_near_the_best(noise, bounds):
    result = run_deconvolution(capture(noise), spots(), choose=True)
    assert result.smoothness and bounds[0] <= result.smoothness.tv <= bounds[1]
    weights = result.smoothness.tried
    assert list(weights) == sorted(weights) and len(result.smoothness.errors) == len(weights)
    others = (deconvolve(capture(noise), spots(), ConvolutionADMM(100, sparsity=0.0, tv=w)) for w in (1e-5, 1e-3, 1e-2))
    assert error(result.scene) < 1.05 * min(map(error, others))


def test_squares_are_held_out_all_over_the_sensor():
    kept = held_out_squares((300, 400))
    assert kept.mean() == pytest.approx(15 / 16, abs=0.01)
    # A square of 8 pixels in each cell of 32, also in the last ones unless they are cut.
    assert all((kept[r : r + 32, c : c + 32] == 0).sum() == 64 for r in range(0, 256, 32) for c in range(0, 384, 32))


def test_pixels_that_are_left_out_do_not_matter():
    """FFTs and FISTA have the same minimum where some pixels are unknown."""
    kept = held_out_squares((12, 10))
    A = ConvolutionOperator(jax.random.uniform(jax.random.key(0), (1, 5, 4)), (12, 10), kept)
    scene = jnp.zeros(A.scene_shape).at[0, 5:8, 4:7].set(1.0)
    image = A.mv(scene) + 0.2 * jnp.asarray(kept, float) * jax.random.normal(jax.random.key(1), (12, 10))
    assert not A.mv(scene)[kept == 0].any()
    solvers = ConvolutionADMM(2000, sparsity=0.05), FISTA(1000, sparsity=0.05)
    costs = [solve(A, image, s).stats["costs"][-1] for s in solvers]
    np.testing.assert_allclose(costs[0], costs[1], rtol=1e-6)


@pytest.mark.integration
def test_a_state_continues_with_another_weight():
    A = ConvolutionOperator(spots()[None, 8:33, 8:33], (24, 24))
    image, solver = jnp.asarray(capture(0.01)[36:60, 36:60]), ConvolutionADMM(60, tolerance=0.0, sparsity=0.0, tv=1e-3)

    @jax.jit
    def run(state, solver):
        return jax.lax.scan(lambda s, _: solver.step(A, image, s)[:2], state, length=600)[0]

    state = run(solver.smoother(run(solver.init(A, image), solver), 10.0), solver)
    stronger = ConvolutionADMM(60, tolerance=0.0, sparsity=0.0, tv=1e-2)
    np.testing.assert_allclose(state.cost, run(stronger.init(A, image), stronger).cost, rtol=1e-3)


def test_convergence_is_told():
    few, many = (run_deconvolution(capture(0.01), spots(), FISTA(steps, sparsity=0.0)) for steps in (5, 400))
    assert not few.converged and few.steps == 5 and few.change > 1e-3
    assert many.converged and many.residual < few.residual < 1
    noise = run_deconvolution(capture(0.1), spots(), FISTA(400, sparsity=0.0), stop_at_discrepancy=True)
    assert noise.reached_noise and noise.converged and noise.steps < 400


def test_the_wiener_filter_is_a_preview():
    scene = filter_image(50 + 200 * capture(0.01), spots()) / 200
    assert scene.shape == (SIZE, SIZE) and scene.dtype == np.float32 and scene.min() >= 0
    assert error(scene) < 0.4
    with pytest.raises(InputError, match="wiener must be used with one PSF, for one plane, got 2"):
        filter_image(capture(0.01), np.stack([spots(), spots()]))


def test_a_psf_that_is_cut_is_noticed():
    assert cut_sides(spots()) == []
    assert cut_sides(spots()[:, 12:30]) == ["left", "right"]
    assert cut_sides(np.zeros((9, 9))) == []


def real(folder: str, psf: str, image: str, side: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """A capture of the order of 1 and its PSF."""
    images = (tifffile.imread(needs(f"{folder}/{name}")).astype(np.float32) for name in (image, psf))
    rows = lambda a: a[: a.shape[0] // side * side, : a.shape[1] // side * side]
    small = lambda a: rows(a).reshape(a.shape[0] // side, side, -1, side).mean((1, 3))
    light, spot = (subtract_offset(small(a)) for a in images)
    return light / light.max(), normalise_spots(spot, light.shape)


FLATSCOPE = ("flatscope", "c_PSF_USAF.tif", "c_USAF_capture.tif")


@pytest.mark.integration
@pytest.mark.parametrize(
    ("files", "bounds"),
    [
        # Fine bars that a constant of 1e-3 erased.
        ((*FLATSCOPE, 2), (0, 1e-5)),
        # A hand, whose fingers are smooth.
        (("diffusercam", "psf_sample.tif", "rawdata_hand_sample.tif", 4), (3e-5, 1e-3)),
    ],
)
def test_the_weights_of_real_captures(files, bounds):
    light, spot = real(*files)
    assert bounds[0] <= choose_smoothness(light, spot, ConvolutionADMM(1, sparsity=0.0)).tv <= bounds[1]


def modulation(profile: np.ndarray) -> float:
    """Michelson contrast of the best three neighbouring maxima against the minima between."""
    peaks = [i for i in range(1, len(profile) - 1) if profile[i - 1] <= profile[i] > profile[i + 1]]
    high = [profile[list(three)].mean() for three in zip(peaks, peaks[1:], peaks[2:], strict=False)]
    low = [(profile[a:b].min() + profile[b:c].min()) / 2 for a, b, c in zip(peaks, peaks[1:], peaks[2:], strict=False)]
    return max(((h - l) / (h + l) for h, l in zip(high, low, strict=True)), default=0.0)


@pytest.mark.integration
@pytest.mark.slow
def test_the_bars_of_flatscope_are_resolved():
    """As by the authors' Wiener filter at least; they had no modulation with a constant weight of 1e-3."""
    light, spot = real(*FLATSCOPE)
    crop = deconvolve(light, spot[0])[427:582, 658:848]
    bars = {"4-6": ((128, 143), (150, 160), 0.37), "5-1": ((37, 51), (60, 69), 0.26)}
    for name, ((top, bottom), (left, right), least) in bars.items():
        assert modulation(crop[top:bottom, left:right].mean(1)) >= least, name
