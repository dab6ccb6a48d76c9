"""The noise of a capture, and solvers that end at it."""

import jax.numpy as jnp
import numpy as np
import pytest

from gs_jax import Grid, forward, reconstruct
from gs_jax.reconstruction.residual import discrepancy_target, noise_variance
from gs_jax.solvers.fista import FISTA
from gs_jax.solvers.richardson_lucy import RichardsonLucy, kl_divergence

from .helpers import scene
from .test_reconstruction import Log

RNG = np.random.default_rng(0)
SLOPE = np.add.outer(np.linspace(200, 400, 200), np.linspace(0, 300, 150))


def test_variance_of_noise_on_a_slope_with_sharp_spots():
    image = SLOPE + RNG.normal(0, 7, SLOPE.shape)
    image[::20, ::20] += 5000
    found = noise_variance(image)
    assert found.shape == (7, 5)
    assert np.sqrt(np.median(found)) == pytest.approx(7, rel=0.06)


def test_an_image_without_noise_or_pixels_has_none():
    assert noise_variance(SLOPE).max() < 1e-18 and noise_variance(np.ones((2, 5))).max() == 0
    assert discrepancy_target(np.zeros((40, 40)), np.zeros((10, 10)), counts=True) == 0


@pytest.mark.parametrize("side", [1, 2])
def test_it_is_what_the_truth_has_left(side):
    summed = lambda image: image.reshape(200 // side, side, 150 // side, side).sum((1, 3))
    image, truth = RNG.poisson(SLOPE).astype(float), summed(SLOPE)
    light = summed(image)
    left = float(kl_divergence(jnp.asarray(light), jnp.asarray(truth)))
    assert discrepancy_target(image, light, counts=True) == pytest.approx(left, rel=0.05)
    squares = float(np.sum((light - truth) ** 2) / 2)
    assert discrepancy_target(image, light, counts=False) == pytest.approx(squares, rel=0.05)


@pytest.mark.integration
@pytest.mark.parametrize("solver", [RichardsonLucy(steps=100), FISTA(steps=100)])
def test_solvers_end_where_noise_is_left(solver):
    imager, _ = scene()
    grid = Grid([18.0, 20.0], (9, 8), 0.1)
    image = np.asarray(forward(jnp.zeros(grid.volume_shape).at[1, 4, 3].set(1.0), imager, grid))
    noisy = image + np.random.default_rng(3).normal(0, 0.05 * image.max(), image.shape)
    steps = {}
    for name, capture in (("clean", image), ("noisy", noisy)):
        log = Log()
        reconstruct(capture, imager, grid, solver, optics=None, stop_at_discrepancy=True, progress=log)
        steps[name] = len(log.parts)
    assert steps["noisy"] < 60 < steps["clean"] == 100
