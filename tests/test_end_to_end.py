from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from experiments import end_to_end
from experiments.end_to_end import reconstruction_loss
from gs_jax import Grid, Imager, MicrolensArray, Sensor, forward
from gs_jax.metrics import quality

from .helpers import scene

# One program each instead of one for each of their operations.
footprints, misfit_db = map(jax.jit, (end_to_end.footprints, end_to_end.misfit_db))
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


@jax.jit
def loss(imager, key, grid, psf):
    """Scenes that were constants would be computed by the compiler, slowly."""
    return reconstruction_loss(imager, key, grid=grid, psf=psf, **OPTIONS)


@pytest.mark.integration
def test_gradients():
    """Interpolation has kinks every pixel: steps must be small, and what they leave is rounding."""
    imager, grid = scene(voxels=(15, 13))
    at_depths = lambda imager, depths: loss(imager, KEY, Grid(depths, grid.shape, grid.pitch), psfs())
    check_grads(jax.jit(at_depths), (imager, grid.depths), order=1, modes=["rev"], eps=1e-7, atol=1e-4, rtol=1e-3)
