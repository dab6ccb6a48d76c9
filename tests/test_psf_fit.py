"""Refinement of measured PSFs: the warp and its derivatives, stacks made wrong on purpose, and the command."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner
from jax.test_util import check_grads

from gs_jax import ConvolutionADMM, ConvolutionOperator, write_capture
from gs_jax.__main__ import commands
from gs_jax.io.provenance import read_provenance
from gs_jax.linear.measured_psf import warp_psf
from gs_jax.reconstruction.psf_fit import fit_psf

from .test_smoothness import capture, spots

WARP = jax.jit(warp_psf)
SOLVER = ConvolutionADMM(1, sparsity=0.0, tv=1e-4)


def moments(image: np.ndarray) -> np.ndarray:
    """Mean row and column, and variance along each."""
    weight = image / image.sum()
    places = np.indices(image.shape) - np.array([n // 2 for n in image.shape])[:, None, None]
    mean = (weight * places).sum((1, 2))
    return np.append(mean, (weight * (places - mean[:, None, None]) ** 2).sum((1, 2)))


def warped(scale=1.0, blur=0.0) -> np.ndarray:
    return np.asarray(WARP(spots(), jnp.asarray(scale), jnp.asarray(blur)))


def test_a_warp_scales_and_blurs_a_psf_and_keeps_its_light():
    np.testing.assert_allclose(warped(), spots(), atol=1e-12)
    before, after = moments(spots()), moments(warped(0.95, 0.8))
    # Sinc interpolation of spots three pixels wide is exact to about a percent.
    np.testing.assert_allclose(after[:2], 0.95 * before[:2], atol=0.02)
    np.testing.assert_allclose(after[2:], 0.95**2 * before[2:] + 0.8**2, rtol=0.01)
    assert warped(0.95, 0.8).sum() == pytest.approx(1)


def test_derivatives_of_the_warp():
    rng = np.random.default_rng(0)
    psf, weights = rng.random((7, 8)), rng.random((7, 8))

    @jax.jit
    def value(psf, scale, blur):
        return jnp.vdot(weights, warp_psf(psf, scale, blur))

    arguments = jnp.asarray(psf), jnp.array(1.037), jnp.array(0.5)
    check_grads(value, arguments, order=1, modes=["fwd", "rev"], eps=1e-6, rtol=1e-5)


@pytest.mark.integration
def test_a_wrong_scale_is_found():
    """Four fifths of what held-out pixels lose come back; a PSF that fits hardly changes."""
    image = capture(0.002)
    right = fit_psf(image, spots(), SOLVER)
    fit = fit_psf(image, warped(scale=1.04), SOLVER)
    assert fit.is_better and fit.before - fit.after > 0.8 * (fit.before - right.before)
    np.testing.assert_allclose(fit.scale, 1 / 1.04, atol=0.004)
    np.testing.assert_allclose(right.psf[0], spots(), atol=0.1 * spots().max())


def test_a_shift_of_a_plane_moves_the_plane_alone():
    """The reason why shifts are not fitted: a scene that is moved the other way has the same image."""
    stack = np.zeros((2, 12, 12))
    stack[0, 3:5, 6], stack[1, 8, 2:9:3] = 1, 1
    scene = np.zeros(ConvolutionOperator(stack).scene_shape)
    scene[0, 9:13, 10], scene[1, 8:14, 12] = 1, 2
    moved = [np.stack([np.roll(a[0], by, (0, 1)), a[1]]) for a, by in ((stack, (2, -1)), (scene, (-2, 1)))]
    images = [ConvolutionOperator(psf).mv(light) for psf, light in ((stack, scene), moved)]
    np.testing.assert_allclose(images[0], images[1], atol=1e-12)


def test_the_command_says_what_it_found(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_capture("c.npy", capture(0.002).astype(np.float32))
    write_capture("psf.npy", warped(scale=1.04).astype(np.float32))
    arguments = "deconvolve c.npy psf.npy --refine-psf --tv 1e-4 --steps 2 -o v.tif"
    result = CliRunner().invoke(commands, arguments.split())
    assert not result.exception and "refined PSF: scale 0.96" in result.stdout
    assert read_provenance("v.tif")["refined PSF"].startswith("scale 0.96")
