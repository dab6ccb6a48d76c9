"""Convolution with a measured PSF, its ADMM, and the deconvolution of images that SciPy convolved."""

import inspect
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner
from jax.test_util import check_grads
from scipy.signal import convolve2d, fftconvolve

from gs_jax import ADMM, FISTA, InputError, RichardsonLucy
from gs_jax.__main__ import commands
from gs_jax.io.captures import read_capture, write_capture
from gs_jax.io.provenance import read_provenance
from gs_jax.linear.measured_psf import ConvolutionOperator, middle, scene_size
from gs_jax.reconstruction.deconvolution import deconvolve
from gs_jax.solvers.admm import ConvolutionADMM
from gs_jax.solvers.base import RESULTS, solve, total_variation

# PSF and image, odd and even, larger and smaller than each other, one depth and several.
SIZES = [((3, 4, 7), (11, 16)), ((2, 12, 15), (9, 10))]


def random_system(psf_shape, image_shape, dtype=np.float64):
    """A PSF, a scene and an image."""
    rng = np.random.default_rng(0)
    shapes = psf_shape, (psf_shape[0], *scene_size(image_shape, psf_shape[1:])), image_shape
    psf, scene, image = (rng.normal(size=shape).astype(dtype) for shape in shapes)
    return abs(psf), scene, image


@jax.jit
def image_and_scene(psf, scene, image):
    """A scene's image, and an image's scene by the adjoint."""
    convolution = ConvolutionOperator(psf, image.shape)
    assert convolution.scene_shape == scene.shape
    return convolution.mv(scene), convolution.T.mv(image)


@pytest.mark.parametrize("sizes", SIZES)
def test_it_is_the_middle_of_scipys_linear_convolution(sizes):
    psf, scene, image = random_system(*sizes)
    expected, window = 0, middle(image.shape, scene.shape[1:])
    for kernel, plane in zip(psf, scene, strict=True):
        inner = [slice(k // 2, k // 2 + n) for k, n in zip(kernel.shape, plane.shape, strict=True)]
        expected = expected + convolve2d(plane, kernel)[*inner][window]
    ours, light = image_and_scene(psf, scene, np.ones(image.shape))
    np.testing.assert_allclose(ours, expected, atol=1e-12)
    # The scene is large enough: in front of the image's corners the whole PSF fits.
    np.testing.assert_allclose(light.sum(), psf.sum() * image.size, rtol=1e-12)


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-12), (np.float32, 2e-6)])
def test_adjoint(sizes, dtype, tolerance):
    psf, scene, image = random_system(*sizes, dtype=dtype)
    forth, back = map(np.asarray, image_and_scene(psf, scene, image))
    # Relative to the norms: the product itself may be near zero.
    size = float(np.linalg.norm(forth) * np.linalg.norm(image))
    np.testing.assert_allclose(np.vdot(forth, image), np.vdot(scene, back), atol=tolerance * size)


def test_gradients_of_the_image():
    psf, scene, image = random_system((2, 4, 5), (6, 7))
    forward = jax.jit(lambda psf, x: ConvolutionOperator(psf, image.shape).mv(x))
    # Bilinear: central differences of first order are exact but for rounding.
    check_grads(forward, (psf, scene), order=1, eps=1e-2, atol=1e-8, rtol=1e-8)
    with pytest.raises(InputError, match=r"\(depth, row, column\) and not empty, got the shape \(0, 3, 3\)"):
        ConvolutionOperator(np.zeros((0, 3, 3)), (5, 5))


_operator = jax.jit(ConvolutionOperator, static_argnums=1)
_image_of = jax.jit(ConvolutionOperator.mv)
_scene_of = jax.jit(lambda convolution, image: convolution.T.mv(image))


def noisy_psf(depths=1):
    return np.random.default_rng(0).random((depths, 5, 4))


def noisy_system(depths=1):
    convolution = _operator(noisy_psf(depths), (12, 10))
    scene = np.zeros(convolution.scene_shape)
    scene[0, 5:8, 4:7], scene[-1, 9, 9] = 1.0, 2.0
    noise = np.random.default_rng(1).normal(size=convolution.image_shape)
    return convolution, np.asarray(_image_of(convolution, scene)) + 0.2 * noise


def relative(convolution, image, **weights):
    """Options of a solver, whose unit of weights is the largest voxel of the adjoint's scene."""
    unit = np.asarray(_scene_of(convolution, image)).max()
    return {name: weight / unit for name, weight in weights.items()}


@partial(jax.jit, static_argnames="isotropic")
def objective(convolution, image, x, *, tv, l1, isotropic=False):
    residual = convolution.mv(x) - image
    # Planes do not wrap.
    u = jnp.stack([jnp.diff(x, axis=0, append=x[-1:]), jnp.roll(x, -1, 1) - x, jnp.roll(x, -1, 2) - x])
    variation = total_variation(u, isotropic=isotropic)
    return jnp.vdot(residual, residual) / 2 + tv * variation + l1 * jnp.sum(x)


def numpy_admm(psf, image, steps, tv, l1, penalties=(1.0, 1.0, 1.0)):
    """DiffuserCam's ADMM for one depth, written out: complex FFTs, three splits, multipliers and penalties."""
    r, s, t = penalties
    shape = [n + k - 1 for n, k in zip(image.shape, psf.shape, strict=True)]
    corner = [(n - m) // 2 for n, m in zip(shape, image.shape, strict=True)]
    window = slice(corner[0], corner[0] + image.shape[0]), slice(corner[1], corner[1] + image.shape[1])
    kernel = np.zeros(shape)
    kernel[: psf.shape[0], : psf.shape[1]] = psf
    kernel = np.fft.fft2(np.roll(kernel, [-(k // 2) for k in psf.shape], (0, 1)))
    forward = lambda x: np.fft.ifft2(kernel * np.fft.fft2(x)).real
    adjoint = lambda x: np.fft.ifft2(kernel.conj() * np.fft.fft2(x)).real
    step = lambda x: np.stack([np.roll(x, -1, 0) - x, np.roll(x, -1, 1) - x])
    step_adjoint = lambda u: np.roll(u[0], 1, 0) - u[0] + np.roll(u[1], 1, 1) - u[1]
    point = np.zeros(shape)
    point[0, 0] = 1
    inverse = 1 / (r * np.abs(kernel) ** 2 + s * np.fft.fft2(step_adjoint(step(point))).real + t)
    seen, data = np.zeros(shape), np.zeros(shape)
    seen[window], data[window] = 1, image
    x = v = w = a = c = np.zeros(shape)
    u = b = np.zeros((2, *shape))
    for _ in range(steps):
        v = (data + r * (forward(x) + a)) / (seen + r)
        u = np.sign(d := step(x) + b) * np.maximum(np.abs(d) - tv / s, 0)
        w = np.maximum(x + c - l1 / t, 0)
        a, b, c = a + forward(x) - v, b + step(x) - u, c + x - w
        target = r * adjoint(v - a) + s * step_adjoint(u - b) + t * (w - c)
        x = np.fft.ifft2(inverse * np.fft.fft2(target)).real
    w = np.maximum(x, 0)
    residual = forward(w)[window] - image
    return w, (residual**2).sum() / 2 + tv * np.abs(step(w)).sum() + l1 * w.sum()


@pytest.mark.integration
def test_the_cost_is_that_of_a_plain_numpy_version():
    convolution, image = noisy_system()
    x, expected = numpy_admm(noisy_psf()[0], image, 4000, 0.05, 0.1)
    solution = solve(convolution, image, ConvolutionADMM(4000, **relative(convolution, image, tv=0.05, sparsity=0.1)))
    np.testing.assert_allclose(objective(convolution, image, solution.value, tv=0.05, l1=0.1), expected, rtol=1e-8)
    np.testing.assert_allclose(solution.stats["costs"][-1], expected, rtol=1e-8)
    # The scenes differ in size by a margin that reaches no pixel and stays dark.
    np.testing.assert_allclose(solution.value.sum(), x.sum(), rtol=1e-6)


@pytest.mark.integration
@pytest.mark.parametrize("depths", [1, 2])
def test_ffts_conjugate_gradients_and_fista_meet(depths):
    """Sparsity alone, which all three have."""
    convolution, image = noisy_system(depths)
    sparse = relative(convolution, image, sparsity=0.2)
    A, solvers = convolution, (ADMM(500, **sparse), FISTA(1000, **sparse))
    volumes = [
        solve(convolution, image, ConvolutionADMM(3000, **sparse)).value,
        *(solve(A, image, s).value for s in solvers),
    ]
    costs = [objective(convolution, image, x, tv=0.0, l1=0.2) for x in volumes]
    np.testing.assert_allclose(costs, costs[-1], rtol=1e-8)


@cache
def minimum(depths, isotropic):
    convolution, image = noisy_system(depths)
    weights = relative(convolution, image, tv=0.05, sparsity=0.02)
    return solve(convolution, image, ConvolutionADMM(4000, isotropic=isotropic, **weights))


@pytest.mark.integration
@pytest.mark.parametrize("isotropic", [False, True])
@pytest.mark.parametrize("depths", [1, 2])
def test_total_variation_is_at_its_minimum(isotropic, depths):
    """No direction leads down: random ones, toward the dark, and toward the solution of the other kind."""
    convolution, image = noisy_system(depths)
    solution = minimum(depths, isotropic)
    cost = lambda x: float(objective(convolution, image, x, tv=0.05, l1=0.02, isotropic=isotropic))
    noise = np.random.default_rng(3).normal(size=(10, *solution.value.shape))
    others = [solution.value * 0.99, minimum(depths, not isotropic).value]
    others += [jnp.maximum(solution.value + 1e-3 * n, 0) for n in noise]
    assert min(map(cost, others)) > cost(solution.value)
    np.testing.assert_allclose(solution.stats["costs"][-1], cost(solution.value), rtol=1e-6)


@pytest.mark.integration
def test_the_penalty_adapts_and_the_residuals_stop_it():
    convolution, image = noisy_system()
    solver = ConvolutionADMM(3000, tolerance=1e-5, **relative(convolution, image, tv=0.05, sparsity=0.1))
    scaled = lambda b, s: solve(convolution, s * b, solver)
    for scale in (1e-3, 1e3):
        solution = scaled(image, scale)
        assert solution.result == RESULTS.converged and solution.stats["num_steps"] < 2000
        cost = objective(convolution, scale * image, solution.value, tv=0.05 * scale, l1=0.1 * scale) / scale**2
        np.testing.assert_allclose(cost, solution.stats["costs"][solution.stats["num_steps"] - 1] / scale**2, rtol=1e-3)


@pytest.mark.integration
def test_gradients_of_the_solution():
    convolution, image = noisy_system()
    psf, weight = noisy_psf(), np.random.default_rng(7).normal(size=convolution.scene_shape)

    def moment(psf, image, tv):
        system = ConvolutionOperator(psf, image.shape)
        return jnp.vdot(weight, solve(system, image, ConvolutionADMM(4, tv=tv, isotropic=True)).value)

    # Away from the kinks of soft thresholding at this generic point.
    tv = relative(convolution, image, tv=0.05)["tv"]
    check_grads(jax.jit(moment), (psf, image, tv), order=1, eps=1e-7, atol=1e-5, rtol=1e-5)


@pytest.mark.integration
@pytest.mark.parametrize("isotropic", [False, True])
def test_a_dark_image_gives_zeros_and_finite_gradients(isotropic):
    convolution, image = noisy_system(2)
    solution = lambda b: solve(convolution, b, ConvolutionADMM(5, tv=0.1, isotropic=isotropic))
    dark = jax.jit(solution)(0 * image)
    assert not np.any(dark.value) and not np.any(dark.stats["costs"])
    assert np.all(np.isfinite(jax.jit(jax.grad(lambda b: solution(b).value.sum()))(0 * image)))


def test_low_frequencies_do_not_outweigh_the_regularizer():
    """A diffuser's lowest are many times as strong as the rest: one penalty for all brings in the scene slowly.

    LenslessPiCam's constant penalties, too, are beaten by far after so few steps.
    """
    psf = np.random.default_rng(0).random((1, 32, 30))
    psf = psf / np.linalg.norm(psf)
    convolution = _operator(psf, (32, 30))
    scene = np.zeros(convolution.scene_shape)
    scene[0, 20:40, 18:40] = 1.0
    image = np.asarray(_image_of(convolution, scene))
    image = image / np.linalg.norm(image)
    x = solve(convolution, image, ConvolutionADMM(20, **relative(convolution, image, tv=1e-4, sparsity=0.0))).value
    cost = objective(convolution, image, x, tv=1e-4, l1=0.0)
    for penalties in ((1.0, 1.0, 1.0), (1e-6, 1e-5, 4e-5)):
        assert 4 * cost < numpy_admm(psf[0], image, 20, 1e-4, 0.0, penalties)[1]


def bars() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A scene of three bars, the PSF of seven spots, and the image on an offset of 100."""
    rng = np.random.default_rng(0)
    scene, psf = np.zeros((60, 80)), np.zeros((41, 41))
    scene[20:40, 20:24], scene[20:40, 34:38], scene[10:14, 30:60] = 1, 2, 1.5
    psf[tuple(rng.integers(4, 37, (2, 7)))] = 1
    psf = fftconvolve(psf, np.outer(np.hanning(5), np.hanning(5)), mode="same").clip(0)
    image = 100 + 1000 * fftconvolve(scene, psf / psf.sum(), mode="same").clip(0)
    return scene, psf.astype(np.float32), image.astype(np.float32)


SOLVERS = [ConvolutionADMM(80, sparsity=0.0, tv=1e-4), FISTA(80, sparsity=0.0), RichardsonLucy(80, accelerate=True)]


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: type(solver).__name__)
def test_deconvolution_finds_a_scene_in_its_unit(solver):
    scene, psf, image = bars()
    found = deconvolve(image, 7 + 50 * psf, solver)
    assert found.shape == scene.shape and found.min() >= 0
    assert np.linalg.norm(found / 1000 - scene) < 0.35 * np.linalg.norm(scene)
    assert found.sum() / 1000 == pytest.approx(scene.sum(), rel=0.1)


def test_wrong_input_of_deconvolution_is_named():
    _, psf, image = bars()
    with pytest.raises(InputError, match="psf must be the image of a point, got no light"):
        deconvolve(image, np.ones((5, 5)))
    with pytest.raises(InputError, match="psf.* 1 of 9 pixels NaN"):
        deconvolve(image, np.diag([1.0, np.nan, 1.0]))
    with pytest.raises(InputError, match="solver must be an object such as .*, got <class .*FISTA'>"):
        inspect.unwrap(deconvolve)(image, psf, FISTA)  # past the tests' check of annotations
    with pytest.raises(InputError, match="tv_z must be 0 or more, got -1"):
        ConvolutionADMM(tv_z=-1.0)
    with pytest.raises(InputError, match="psf must be at most the image's 20 x 60 pixels, got 41 x 41"):
        deconvolve(image[:20, :60], psf)
    with pytest.raises(InputError, match=r"no light above the darkest percent in plane 2\."):
        deconvolve(image, np.stack([psf, 0 * psf]))
    assert not deconvolve(np.zeros_like(image), psf).any()


def test_the_command_says_how_well_the_scene_was_found(tmp_path):
    scene, psf, image = bars()
    write_capture(tmp_path / "c.tif", image)
    write_capture(tmp_path / "psf.tif", psf)

    def run(*options):
        paths = [str(tmp_path / name) for name in ("c.tif", "psf.tif", "s.tif")]
        return CliRunner().invoke(commands, ["deconvolve", *paths[:2], "-o", paths[2], *options])

    chosen = run("--steps", "5").stdout
    assert "smoothness: --tv " in chosen and "predicts held-out pixels best of" in chosen
    assert "chosen from the capture" in read_provenance(tmp_path / "s.tif")["tv"]
    assert "of the capture's RMS; not converged, the last step changed" in chosen and "more --steps" in chosen
    given = run("--steps", "5", "--tv", "1e-4").stdout
    assert "smoothness" not in given and "residual: " in given and "tv" not in read_provenance(tmp_path / "s.tif")
    assert "not converged" in run("--method", "fista", "--steps", "5").stdout
    assert "residual" not in (preview := run("--method", "wiener")).stdout and not preview.exception
    assert read_capture(tmp_path / "s.tif").shape == scene.shape
    assert {"input c.tif", "input psf.tif"} < set(read_provenance(tmp_path / "s.tif"))
    for method, words in (
        ("wiener", "--steps, --tv must not be given with --method wiener"),
        ("fista", "--tv must be used with admm, richardson-lucy, got"),
    ):
        wrong = run("--method", method, "--steps", "5", "--tv", "0.1").exception
        assert isinstance(wrong, InputError) and words in str(wrong)
