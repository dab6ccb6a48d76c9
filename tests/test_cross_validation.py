"""Lenses predicted from the others: what is left out is not read, and the score ranks volumes as the truth does."""

from typing import Any

import jax
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

import gs_jax as gs
from gs_jax.reconstruction.pipeline import METHODS
from gs_jax.reconstruction.residual import folds_of_lenses, kept_pixels_of_folds
from gs_jax.solvers.richardson_lucy import RichardsonLucy, background_step

GRID = gs.Grid(np.array([19.0, 20.0, 21.0]), (31, 31), 0.08)


def scope() -> gs.Imager:
    array = gs.MicrolensArray(gs.random_layout(25, (5.0, 5.0), seed=0), 2.0, 1.43, 1.0, 1.0)
    return gs.Imager(array, gs.Sensor((125, 125), 0.04), 5.8, 2.0)


@pytest.fixture(scope="module")
def scene():
    """Blobs, and their image without noise by one PSF for each depth."""
    truth = np.where(np.random.default_rng(1).random(GRID.volume_shape) < 0.01, 1.0, 0.0)
    truth = gaussian_filter(truth, (0, 2.5, 2.5))
    psf = gs.psf_model(scope(), GRID, "near")
    return truth, psf, np.asarray(gs.forward(truth, scope(), GRID, psf), np.float64)


def exposed(clean: np.ndarray, electrons: float) -> np.ndarray:
    rng = np.random.default_rng(2)
    return rng.poisson(np.maximum(clean, 0) * electrons / clean.max()) + rng.normal(0, 2, clean.shape)


def test_neighbours_are_left_out_in_turn():
    centers = np.asarray(gs.random_layout(60, (8.0, 8.0), seed=3))
    folds = folds_of_lenses(centers, 4)
    assert np.bincount(folds, minlength=4).min() >= 10
    nearest = np.asarray(KDTree(centers).query(centers, 2)[1])[:, 1]
    assert np.mean(folds == folds[nearest]) < 0.1
    kept = kept_pixels_of_folds(scope(), 4)
    np.testing.assert_array_equal(sum(1 - each for each in kept), 1)


@pytest.mark.parametrize("normalize", [False, True])
def test_a_back_projection_is_scored_as_it_is(scene, normalize):
    """With all pixels it is the volume that is asked for, divided by the weights or not; the scores differ."""
    _, psf, clean = scene
    volume_of = gs.Reconstructor(scope(), GRID, gs.BackProjection(normalize=normalize), psf)
    whole = volume_of(clean)
    np.testing.assert_allclose(volume_of.keeping(np.ones_like(clean))(clean), whole, rtol=1e-6, atol=1e-7)
    weights = gs.backproject(np.ones_like(clean), scope(), GRID)
    other = gs.Reconstructor(scope(), GRID, gs.BackProjection(normalize=not normalize), psf)(clean)
    factor = 1 / np.maximum(weights, 1e-6) if normalize else np.asarray(weights)
    np.testing.assert_allclose(whole, other * factor, rtol=1e-4, atol=1e-5)


SLOW = [pytest.param(name, marks=pytest.mark.integration) for name in ("list-rl", "fista", "admm", "unrolled")]


@pytest.mark.parametrize("name", ["backproject", "richardson-lucy", *SLOW])
def test_what_is_left_out_is_not_read(scene, name):
    _, psf, clean = scene
    image, kept = exposed(clean, 2000), kept_pixels_of_folds(scope(), 3)[0]
    prepared = gs.Reconstructor(scope(), GRID, METHODS[name](4), psf)
    # With all pixels kept, the program is that of some.
    volume_of, all_of = prepared.keeping(kept), prepared.keeping(np.ones_like(kept))
    # More light, so that the percentile that counts as dark is the same.
    lit = image + np.where(kept == 0, 500.0, 0.0)
    volume, other, whole = volume_of(image), volume_of(lit), all_of(lit)
    np.testing.assert_array_equal(volume, other)
    assert np.abs(volume - whole).max() > 0.1 * volume.max() > 0


@pytest.mark.integration
def test_the_score_ranks_as_the_truth_does(scene):
    """Steps of Richardson-Lucy on a noisy capture: too few, some, and so many that they fit the noise."""
    truth, psf, clean = scene
    image = exposed(clean, 200)
    methods = [RichardsonLucy(steps, background=3.0, accelerate=True) for steps in (1, 12, 60)]
    scores = [gs.cross_validated(image, scope(), GRID, each, optics=psf, folds=3) for each in methods]
    volumes = [gs.reconstruct(image, scope(), GRID, each, optics=psf) for each in methods]
    by_truth = [gs.quality(volume, truth).psnr_db for volume in volumes]
    assert np.argmax(by_truth) == np.argmax([score.score_db for score in scores]) == 1
    # What was fitted only gets better.
    seen = [gs.forward_residual(volume, image, scope(), GRID, optics=psf).error for volume in volumes]
    assert seen[2] < seen[1] < seen[0]
    # A perfect volume leaves the noise.
    assert all(score.error > score.noise > 0 for score in scores)


def test_a_background_is_the_mean_over_kept_pixels():
    kept = np.ones((40, 30))
    kept[:, ::3] = 0
    step = jax.jit(background_step)
    np.testing.assert_allclose(np.asarray(step(np.ones((2, 2)), 2 * kept, kept)), 2, rtol=1e-12)


def test_darkness_and_what_is_refused(scene):
    _, psf, _ = scene
    dark = np.zeros((125, 125))
    found = gs.cross_validated(dark, scope(), GRID, optics=psf)
    assert found.error == found.noise == 0 and np.isfinite(found.regions).all()
    one = gs.Imager(gs.MicrolensArray([[0.0, 0.0]]), gs.Sensor((125, 125), 0.04), 5.8, 2.0)
    wrong: Any = 2.5
    for imager, method, folds, words in (
        (one, gs.BackProjection(), 2, "2 or more lenses"),
        (scope(), gs.BackProjection(), 26, "folds must be 2 to 25"),
        (scope(), gs.BackProjection(), wrong, "folds must be 2 to 25"),
        (scope(), gs.Surface(), 4, "got Surface"),
    ):
        with pytest.raises(gs.InputError, match=words):
            gs.cross_validated(dark, imager, GRID, method, optics=psf, folds=folds)
