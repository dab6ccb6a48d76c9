from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from experiments import end_to_end
from experiments.end_to_end import reconstruction_loss
from gs_jax import Grid, Imager, MicrolensArray, Sensor, backproject, forward
from gs_jax.metrics import quality
from gs_jax.optics.raytrace import to_numpy

from .helpers import scene

# One program each instead of one for each of their operations.
footprints, misfit_db = map(jax.jit, (end_to_end.footprints, end_to_end.misfit_db))
local_contrast = jax.jit(end_to_end.local_contrast, static_argnames="width")
KEY = jax.random.key(3)
OPTIONS: dict[str, Any] = dict(density=0.05, width=0.06, background_width=0.2, scenes=2)


def psfs(dtype=jnp.float64):
    kernel = np.exp(-((np.arange(5) - 2) ** 2) / 2)
    kernel = np.outer(kernel, kernel) / kernel.sum() ** 2
    return np.broadcast_to(kernel, (3, 5, 5)).astype(dtype)


def test_misfit_is_minus_psnr_up_to_the_scene():
    rng = np.random.default_rng(0)
    truth = rng.random((2, 9, 9))
    estimates = [truth + s * rng.random(truth.shape) for s in (0.3, 1.0)]
    psnr = [quality(e, truth).psnr_db for e in estimates]
    misfit = [float(misfit_db(e, truth)) for e in estimates]
    np.testing.assert_allclose(misfit[1] - misfit[0], psnr[0] - psnr[1], rtol=1e-9)
    assert misfit_db(3 * truth, truth) == pytest.approx(10 * np.log10(10 * np.finfo(float).eps))
    assert misfit_db(np.zeros_like(truth), truth) == 0


def test_reconstruct_is_back_projection_less_its_mean():
    imager, grid = scene()
    image = np.random.default_rng(0).random(imager.sensor.shape)

    @jax.jit
    def both(image, imager, grid):
        ours = end_to_end.reconstruct(image, imager, grid, background_width=0.2)
        weight = backproject(jnp.ones_like(image), imager, grid)
        return ours, backproject(image, imager, grid, normalize=True), weight

    ours, volume, weight = both(image, imager, grid)
    assert weight.min() > 0.5  # so nothing is dimmed
    np.testing.assert_allclose(ours, local_contrast(volume, grid, width=0.2), atol=1e-12)


@pytest.mark.integration
def test_voxels_leave_no_gaps_in_the_image():
    """An even volume, voxels 1.9 to 2.2 pixels apart: as points they are a grid of dots, as footprints even light."""
    imager = Imager(MicrolensArray(np.zeros((1, 2))), Sensor((96, 80), 0.02), 5.8, 2.0)
    grid = Grid([18.0], (61, 61), 0.13)
    inner = np.s_[38:58, 30:50]  # the envelope falls by a few per cent over it
    even = np.ones((1, 61, 61))
    ripple = lambda psf: (
        np.std(forward(even, imager, grid, psf)[inner]) / np.mean(forward(even, imager, grid, psf)[inner])
    )
    assert ripple(None) > 0.1 and ripple(footprints(imager, grid)) < 0.01


def test_footprints_keep_the_light_and_add_variance():
    imager, fine = scene()
    grid = Grid(fine.depths, (5, 5), 0.15)
    found = np.asarray(footprints(imager, grid, psfs()))
    np.testing.assert_allclose(found.sum((1, 2)), 1, rtol=1e-12)
    assert (found[:, 2, 2] < psfs()[:, 2, 2]).all()
    place = np.arange(17) - 8
    alone = np.asarray(footprints(imager, grid))
    magnification = to_numpy(imager).magnification(np.asarray(grid.depths))
    width = magnification * float(grid.pitch) / 2 / imager.sensor.pixel_pitch
    # Sampled Gaussians of a pixel and more have their variance, to 1e-6.
    np.testing.assert_allclose((alone * place**2).sum((1, 2)), width**2, rtol=1e-4)


@jax.jit
def loss(imager, key, grid, psf, electrons=1000.0):
    """Compiled once; scenes that were constants would be computed by the compiler, slowly."""
    return reconstruction_loss(imager, key, grid=grid, psf=psf, electrons=electrons, **OPTIONS)


@pytest.mark.integration
def test_light_lowers_the_loss():
    """In electrons of a voxel through a lens: shot noise is most of the error at 1, nothing at a million."""
    imager, grid = scene()
    dark, bright = (loss(imager, KEY, grid, psfs(), electrons) for electrons in (1.0, 1e6))
    assert bright < dark - 0.3


@pytest.mark.integration
def test_gradients():
    """Interpolation has kinks every pixel: steps must be small, and what they leave is rounding."""
    imager, grid = scene(voxels=(15, 13))
    at_depths = lambda imager, depths: loss(imager, KEY, Grid(depths, grid.shape, grid.pitch), psfs())
    check_grads(jax.jit(at_depths), (imager, grid.depths), order=1, modes=["rev"], eps=1e-7, atol=1e-4, rtol=1e-3)
