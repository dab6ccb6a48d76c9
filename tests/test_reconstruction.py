"""From an image to a volume, by every method."""

import dataclasses
import inspect
from contextlib import contextmanager
from functools import cache
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

import gs_jax as gs
from gs_jax.apps.benchmark import skip_reason
from gs_jax.optics.psf import psf_of_depth
from gs_jax.reconstruction.inverse_problem import discrepancy_target, noise_variance, prepare_data, prepare_model
from gs_jax.reconstruction.pipeline import METHODS, voxel_grid
from gs_jax.reconstruction.radius_fit import _bounds, _middle, fit_radius, with_radii
from gs_jax.reconstruction.residual import SHARE, folds_of_lenses, jackknife_deviation, kept_pixels_of_folds
from gs_jax.simulation import simulate_volume
from gs_jax.solvers.richardson_lucy import background_step, kl_divergence

from .helpers import compilations, scene


@cache
def small():
    """An imager, a grid, a PSF, and the image of one bright voxel."""
    imager, grid = scene(voxels=(9, 8), pitch=0.1, depths=(18.0, 20.0))
    psf, truth = np.zeros((2, 3, 3)), np.zeros(grid.volume_shape)
    psf[:, 1, 1] = truth[1, 4, 3] = 1.0
    psf, truth = map(jax.device_put, (psf, truth))
    return imager, grid, psf, truth, gs.ImagingOperator(imager, grid, psf).mv(truth)


@cache
def in_one_loop():
    imager, grid, psf, *_ = small()
    return jax.jit(lambda b: gs.solve(gs.ImagingOperator(imager, grid, psf), b, gs.FISTA(steps=7)).value)


class Log(gs.Progress):
    """What is shown, as a list; the work is interrupted after so many parts."""

    def __init__(self, most=1000):
        self.parts, self.most = [], most

    @contextmanager
    def counter(self, description, total, *, quarter="", rate="", words=None):
        def advance():
            self.parts.append((description, total))
            if len(self.parts) == self.most:
                raise KeyboardInterrupt

        yield advance


@pytest.mark.integration
@pytest.mark.parametrize("name", METHODS)
def test_every_method_shows_the_voxel_and_compiles_once(name, caplog):
    """The second call compiles nothing, with another image and for another number of steps, too."""
    imager, grid, psf, truth, image = small()
    image = np.asarray(image)
    first = gs.reconstruct(image, imager, grid, METHODS[name](10), optics=psf)
    assert first.dtype == np.float32 and first.shape == grid.volume_shape
    assert int(first.argmax()) == int(truth.argmax())
    with jax.log_compiles(), caplog.at_level("WARNING"):
        jax.jit(lambda x: x + 1)(image)
        assert [r for r in caplog.records if "Compiling" in r.getMessage()]  # as JAX words it
        caplog.clear()
        second = gs.reconstruct(2 * image, imager, grid, METHODS[name](11), optics=psf)
    assert not [r.getMessage() for r in caplog.records if "Compiling" in r.getMessage()]
    assert not np.array_equal(first, second)


@pytest.mark.integration
def test_it_is_what_the_solver_finds_in_one_loop():
    imager, grid, psf, _, image = small()
    found = gs.reconstruct(image, imager, grid, gs.FISTA(steps=7), optics=psf)
    np.testing.assert_allclose(found, in_one_loop()(image), rtol=1e-6, atol=1e-9)


@pytest.mark.integration
def test_each_step_is_shown_and_can_be_the_last():
    imager, grid, psf, _, image = small()
    log = Log()
    gs.reconstruct(image, imager, grid, gs.RichardsonLucy(steps=10), optics=psf, progress=log)
    assert log.parts == 10 * [("Iterating", 10)]
    early = Log()
    gs.reconstruct(image, imager, grid, gs.RichardsonLucy(steps=10, tolerance=0.3), optics=psf, progress=early)
    assert 1 <= len(early.parts) < 9
    interrupted = Log(most=3)
    with pytest.raises(KeyboardInterrupt):
        gs.reconstruct(image, imager, grid, gs.RichardsonLucy(steps=10), optics=psf, progress=interrupted)
    assert len(interrupted.parts) == 3


@pytest.mark.integration
def test_the_cameras_offset_is_taken_off_once():
    imager, grid, psf, _, image = small()
    counts = np.round(1000 * np.asarray(image) / float(image.max()))
    plain = gs.reconstruct(counts, imager, grid, gs.FISTA(steps=7), optics=psf)
    offset = gs.reconstruct((counts + 100).astype(np.uint16), imager, grid, gs.FISTA(steps=7), optics=psf)
    np.testing.assert_allclose(offset, plain, rtol=1e-6)
    # Read noise about zero is no offset: its darkest percent is negative.
    noisy = counts + np.random.default_rng(0).normal(0, 3, counts.shape)
    found = gs.reconstruct(noisy, imager, grid, gs.FISTA(steps=7), optics=psf)
    np.testing.assert_allclose(found, in_one_loop()(noisy), rtol=1e-6, atol=1e-6)


@pytest.mark.integration
def test_list_richardson_lucy_multiplies_by_mean_ratios():
    imager, grid = scene(voxels=(8, 7), pitch=0.1, depths=(18.0, 20.0))
    # Its darkest percent is no light, so nothing is taken off.
    image = 1 + jax.random.uniform(jax.random.key(0), imager.sensor.shape)
    image = image.at[:3].set(0.0)
    A = gs.ImagingOperator(imager, grid)
    x = jnp.where(A.T.mv(jnp.ones_like(image)) > 0, 1.0, 0)
    for _ in range(3):
        expected = A.mv(x)
        ratio = jnp.where(expected > 0, image / jnp.where(expected > 0, expected, 1), 0)
        x = x * gs.backproject(ratio, imager, grid, normalize=True)
    found = gs.reconstruct(image, imager, grid, gs.PinholeRichardsonLucy(steps=3), optics=None)
    # From another uniform start, whose scale does not matter; the volume is float32.
    np.testing.assert_allclose(found, x, rtol=1e-6)


@pytest.mark.integration
def test_back_projection_has_its_options_and_all_its_planes():
    imager, grid, *_, image = small()
    many = grid.at(np.linspace(17, 22, 19))  # more than are done at a time
    for interpolation, normalize in (("linear", False), ("nearest", True)):
        expected = gs.backproject(image, imager, many, method=interpolation, normalize=normalize)
        found = gs.reconstruct(image, imager, many, gs.BackProjection(interpolation, normalize), optics=None)
        np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.integration
def test_the_near_psf_is_that_of_the_rays():
    imager, grid, _, _, image = small()
    kernel = psf_of_depth(imager, np.asarray(grid.depths), "geometric")
    of_rays = jnp.stack([kernel(z) for z in grid.depths])
    np.testing.assert_array_equal(gs.psf_model(imager, grid, "near").parts[0], of_rays)
    # By name, what is in all of a square is background; this image is darker than that only where it is dark.
    found = gs.reconstruct(image, imager, grid, gs.FISTA(steps=7), optics="near")
    assert int(found.argmax()) == int(gs.reconstruct(image, imager, grid, gs.FISTA(steps=7), optics=of_rays).argmax())


def test_wrong_arguments_are_named():
    imager, grid, *_, image = small()
    with pytest.raises(gs.InputError, match="method must be an object such as .*, got 'fista'"):
        inspect.unwrap(gs.reconstruct)(image, imager, grid, "fista")  # past the tests' check of annotations
    with pytest.raises(gs.InputError, match="method must be an object such as .*, got <class .*FISTA'>"):
        inspect.unwrap(gs.reconstruct)(image, imager, grid, gs.FISTA)
    with pytest.raises(gs.InputError, match=r"image must have the sensor's shape \(96, 80\), got \(5, 5\)"):
        gs.reconstruct(np.ones((5, 5)), imager, grid)
    with pytest.raises(gs.InputError, match="interpolation must be 'linear' or 'nearest', got 'cubic'"):
        gs.BackProjection(interpolation="cubic")
    with pytest.raises(gs.InputError, match="steps must be 1 or more, got 0"):
        gs.PinholeRichardsonLucy(steps=0)


@pytest.mark.parametrize("method", [gs.BackProjection(), gs.RichardsonLucy(steps=7)])
def test_what_is_not_finite_is_named(method):
    imager, grid, psf, truth, image = small()
    spoilt = image.at[0, :2].set([np.nan, np.inf])
    with pytest.raises(gs.InputError, match="image must be finite, got 2 of 7680 pixels NaN"):
        gs.reconstruct(spoilt, imager, grid, method, optics=psf)
    with pytest.raises(gs.InputError, match="volume must be finite, got 1 of 144 voxels NaN"):
        gs.forward_residual(truth.at[0, 0, 0].set(np.nan), image, imager, grid, optics=psf)


def test_the_memory_that_is_free_counts_not_the_machines(monkeypatch):
    """Of a large machine whose memory others have taken, little is left for a volume or a divided plane."""
    taken = SimpleNamespace(total=2**50, available=2**20)
    monkeypatch.setattr("psutil.virtual_memory", lambda: taken)
    imager, grid, *_ = small()
    with pytest.raises(gs.InputError, match="GiB of the free memory"):
        voxel_grid(imager, [18.0, 20.0], 0.001)
    with pytest.raises(gs.InputError, match="GiB that are free"):
        simulate_volume(np.ones((1, 900, 900), np.float32), imager, gs.Grid([20.0], (900, 900), 0.001))
    assert skip_reason("admm, dense", 30, None, 1e9) is not None


@pytest.mark.parametrize("pixels, binning", [(0.5, 1), (1.4, 1), (1.6, 2), (1.99, 2), (2.9, 2), (3.0, 3), (4.2, 4)])
def test_pixels_are_about_as_wide_as_voxels(pixels, binning):
    imager = scene(shape=(60, 80))[0]
    grid = gs.Grid([20.0], (11, 13), pixels * imager.sensor.pixel_pitch / float(imager.magnification(20.0)))
    assert prepare_model(imager, grid, "pinhole", gs.Progress()).binning == binning


def test_pixels_of_any_number_are_summed():
    """61 and 83 have no common divisor: squares of four pixels, and what is left at the end is left out."""
    imager = scene(shape=(61, 83))[0]
    grid = gs.Grid([20.0], (11, 13), 4.2 * imager.sensor.pixel_pitch / float(imager.magnification(20.0)))
    model = prepare_model(imager, grid, "pinhole", gs.Progress())
    assert model.binning == 4 and model.imager.sensor.shape == (15, 20)
    image = np.random.default_rng(0).random((61, 83)) + 1
    light = prepare_data(image, dataclasses.replace(model, is_partial=False))[0]
    offset = np.percentile(image, 1)
    assert light[14, 19] == pytest.approx((image[56:60, 76:80] - offset).sum())
    own = imager.sensor.to_mm(np.mgrid[56:60, 76:80].reshape(2, -1).T.astype(float))
    np.testing.assert_allclose(model.imager.sensor.to_mm(np.array([14.0, 19.0])), own.mean(0), atol=1e-12)


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
    left = float(jax.jit(kl_divergence)(light, truth))
    assert discrepancy_target(image, light, counts=True) == pytest.approx(left, rel=0.05)
    squares = float(np.sum((light - truth) ** 2) / 2)
    assert discrepancy_target(image, light, counts=False) == pytest.approx(squares, rel=0.05)


@pytest.mark.integration
@pytest.mark.parametrize("solver", [gs.RichardsonLucy(steps=100), gs.FISTA(steps=100)])
def test_solvers_end_where_noise_is_left(solver):
    imager, _ = scene()
    grid = gs.Grid([18.0, 20.0], (9, 8), 0.1)
    image = np.asarray(gs.forward(jnp.zeros(grid.volume_shape).at[1, 4, 3].set(1.0), imager, grid))
    noisy = image + np.random.default_rng(3).normal(0, 0.05 * image.max(), image.shape)
    steps = {}
    for name, capture in (("clean", image), ("noisy", noisy)):
        log = Log()
        gs.reconstruct(capture, imager, grid, solver, optics=None, stop_at_discrepancy=True, progress=log)
        steps[name] = len(log.parts)
    assert steps["noisy"] < 60 < steps["clean"] == 100


@pytest.mark.parametrize("method", [gs.BackProjection(), gs.Surface(), gs.Unrolled.pretrained()])
def test_methods_that_cannot_stop_at_the_noise(method):
    imager, grid = scene()
    for function in (gs.reconstruct, gs.cross_validated):
        with pytest.raises(gs.InputError, match=rf"must be used with .*, got {type(method).__name__}\(\)"):
            function(np.ones(imager.sensor.shape), imager, grid, method, stop_at_discrepancy=True)


@cache
def tiny():
    """A reconstructor by few lenses, whose background is fitted or subtracted, and a bright image."""
    imager, grid = scene(shape=(40, 50), voxels=(5, 4), pitch=0.2, depths=(18.0, 20.0))
    rng = np.random.default_rng(0)
    # No two pixels are equal: percentiles have derivatives.
    image = 5 + rng.random(imager.sensor.shape) + gs.forward(rng.random(grid.volume_shape), imager, grid)
    return lambda method: gs.Reconstructor(imager, grid, method, "pinhole"), np.asarray(image)


METHODS_OF_JAX = [gs.BackProjection(normalize=True), gs.RichardsonLucy(), gs.PinholeRichardsonLucy(), gs.FISTA()]


@pytest.mark.parametrize("method", METHODS_OF_JAX, ids=lambda method: type(method).__name__)
def test_a_reconstructor_is_compiled_and_mapped(method):
    """One step by the host and by JAX, of an image and of two at once; other numbers compile nothing."""
    make, image = tiny()
    reconstructor = make(method)
    state = reconstructor.step(reconstructor.init(image))
    expected = np.asarray(reconstructor.finish(state))
    once = eqx.filter_jit(lambda r, image: r.finish(r.step(r.init(image))))
    np.testing.assert_allclose(once(reconstructor, jnp.asarray(image)), expected, rtol=1e-5, atol=1e-6)
    before = compilations()
    once(jax.tree.map(lambda leaf: leaf, reconstructor), jnp.asarray(2 * image))
    assert compilations() == before
    both = eqx.filter_jit(eqx.filter_vmap(once, in_axes=(None, 0)))(reconstructor, jnp.stack([image, image + 1]))
    np.testing.assert_allclose(both[0], expected, rtol=1e-5, atol=1e-6)
    # The camera's offset is subtracted, but for back-projection, which reads the image as it is.
    lifted = expected + (expected > 0) * isinstance(method, gs.BackProjection)
    np.testing.assert_allclose(both[1], lifted, rtol=1e-5, atol=1e-6)


@pytest.mark.integration
def test_a_step_of_a_reconstructor_is_differentiated():
    make, image = tiny()
    lucy = make(gs.RichardsonLucy())
    weight = jax.random.normal(jax.random.key(0), lucy.problem.in_structure().shape)
    moment = jax.jit(lambda image: jnp.vdot(weight, lucy.finish(lucy.step(lucy.init(image)))))
    check_grads(moment, (jnp.asarray(image),), order=1, modes=["fwd", "rev"], eps=1e-6, atol=1e-4, rtol=1e-4)


# Lenses predicted from the others: what is left out is not read, and the score ranks volumes as the truth does.


GRID = gs.Grid(np.array([19.0, 20.0, 21.0]), (31, 31), 0.08)


def scope() -> gs.Imager:
    array = gs.MicrolensArray(gs.random_layout(25, (5.0, 5.0), seed=0), 2.0, 1.43, 1.0, 1.0)
    return gs.Imager(array, gs.Sensor((125, 125), 0.04), 5.8, 2.0)


@pytest.fixture(scope="module")
def folds_scene():
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
def test_a_back_projection_is_scored_as_it_is(folds_scene, normalize):
    """With all pixels it is the volume that is asked for, divided by the weights or not; the scores differ."""
    _, psf, clean = folds_scene
    volume_of = gs.Reconstructor(scope(), GRID, gs.BackProjection(normalize=normalize), psf)
    whole = volume_of(clean)
    np.testing.assert_allclose(volume_of.keeping(np.ones_like(clean))(clean), whole, rtol=1e-6, atol=1e-7)
    weights = gs.backproject(np.ones_like(clean), scope(), GRID)
    other = gs.Reconstructor(scope(), GRID, gs.BackProjection(normalize=not normalize), psf)(clean)
    factor = 1 / np.maximum(weights, 1e-6) if normalize else np.asarray(weights)
    np.testing.assert_allclose(whole, other * factor, rtol=1e-4, atol=1e-5)


SLOW = [pytest.param(name, marks=pytest.mark.integration) for name in ("list-rl", "fista", "admm", "unrolled")]


@pytest.mark.parametrize("name", ["backproject", "richardson-lucy", *SLOW])
def test_what_is_left_out_is_not_read(folds_scene, name):
    _, psf, clean = folds_scene
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
def test_the_score_ranks_as_the_truth_does(folds_scene):
    """Steps of Richardson-Lucy on a noisy capture: too few, some, and so many that they fit the noise."""
    truth, psf, clean = folds_scene
    image = exposed(clean, 200)
    methods = [gs.RichardsonLucy(steps, background=3.0, accelerate=True) for steps in (1, 12, 60)]
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


def test_darkness_and_what_is_refused(folds_scene):
    _, psf, _ = folds_scene
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


# The radius that predicts lenses best is nearer to that of the device, and a device as designed is left alone.


RADIUS_GRID = gs.Grid([19.0, 20.0, 21.0], (41, 41), 0.1)


def radius_scope(radius: float = 2.0) -> gs.Imager:
    array = gs.MicrolensArray(gs.random_layout(16, (4.0, 4.0), seed=0), radius, 1.43, 1.4, 1.0)
    return gs.Imager(array, gs.Sensor((200, 200), 0.02), 5.8, 2.0)


def captures(imager: gs.Imager) -> list[np.ndarray]:
    """Of short lines, far finer than voxels, with noise."""
    images = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        ends = np.column_stack([rng.uniform(-1.2, 1.0, (8, 2)), rng.uniform(19, 21, 8)])
        along = np.linspace(0, 0.6, 80)[:, None] * np.array([1.0, 0.3, 0.0])
        lines = (ends[:, None] + along).reshape(-1, 3)
        clean = np.asarray(gs.simulate(np.column_stack([lines, np.ones(len(lines))]), imager), np.float64)
        images.append(rng.poisson(clean * 2000 / clean.max()) + rng.normal(0, 2, clean.shape))
    return images


# Nearer to the true factor than 1 is: the fit may be 1 to 2 % off.
@pytest.mark.integration
@pytest.mark.parametrize("true, least, most", [(1.03, 1.01, 1.04), (1.0, 1.0, 1.0)])
def test_the_radius_comes_nearer_to_the_device(true, least, most):
    found = fit_radius(captures(radius_scope(2 * true)), radius_scope(), RADIUS_GRID, METHODS["list-rl"](20))
    assert least <= found.factor <= most
    np.testing.assert_allclose(found.imager.array.radius_of_curvature, 2 * found.factor, rtol=1e-6)
    assert dict(found.trials)[found.factor] == min(dict(found.trials).values()) or found.factor == 1


def test_all_lenses_change_by_one_factor():
    array = dataclasses.replace(radius_scope().array, radius_of_curvature=np.linspace(1.5, 2.5, 16))
    typed = dataclasses.replace(radius_scope(), array=array)
    np.testing.assert_allclose(with_radii(typed, 1.1).array.radius_of_curvature, np.linspace(1.65, 2.75, 16), 1e-6)
    thin = dataclasses.replace(
        radius_scope(), array=dataclasses.replace(radius_scope().array, thin_lens_focal_length=4.0)
    )
    np.testing.assert_allclose(with_radii(thin, 0.9).array.focal_length, 3.6, rtol=1e-6)


@pytest.mark.parametrize(
    "change, least, most",
    [
        ({"conic_constant": 3.0}, 0.94, 1.06),
        ({"aperture_diameter": 3.9}, 0.98, 1.06),
        ({"aspheric_terms": [-0.265]}, 0.94, 1.02),
        ({"aperture_diameter": 5.0}, 1.0, 1.0),
    ],
)
def test_surfaces_still_fall_outward_to_the_edges_of_their_apertures(change, least, most):
    one = dataclasses.replace(radius_scope(), array=dataclasses.replace(radius_scope().array, **change))
    np.testing.assert_allclose(_bounds(one), (least, most), atol=1e-9)


@pytest.mark.integration
def test_captures_without_light_are_not_counted():
    dark = np.zeros((200, 200))
    found = fit_radius([dark], radius_scope(), RADIUS_GRID, METHODS["list-rl"](1), optics="near")
    assert found.factor == 1 and {error for _, error in found.trials} == {0.0}


@pytest.mark.parametrize(
    "images, method, said",
    [
        ([], "list-rl", "a capture or more"),
        ([np.zeros((200, 201))], "list-rl", "the sensor's shape"),
        ([np.zeros((200, 200))], "surface", "free voxels"),
    ],
)
def test_wrong_input(images, method, said):
    with pytest.raises(gs.InputError, match=said):
        fit_radius(images, radius_scope(), RADIUS_GRID, METHODS[method](10))


@pytest.mark.parametrize("radius, pitch, binning, margin", [(2.0, 0.1, 3, 0), (0.5, 0.01, 1, 34)])
def test_the_middle_keeps_its_place(radius, pitch, binning, margin):
    """A marked pixel of an oblong sensor beside the axis is where the sensor of the middle says."""
    one = dataclasses.replace(radius_scope(), field_radius=radius, sensor=gs.Sensor((200, 230), 0.02, (0.3, -0.2)))
    part, grid, cut, judged = _middle(one, RADIUS_GRID.depths, pitch)
    rows, columns = part.sensor.shape
    assert round(part.sensor.pixel_pitch / 0.02) == binning and grid.origin.tolist() == list(part.sensor.origin)
    assert judged.sum() == (rows - 2 * margin) * (columns - 2 * margin)
    image = np.zeros(one.sensor.shape, np.float32)
    image[107, 101] = 1
    found = np.asarray(part.sensor.to_mm(np.argwhere(cut(image))[0]))
    # Within a pixel of the middle.
    half = 0.01 * (binning - 1)
    np.testing.assert_allclose(found, one.sensor.to_mm(np.array([107, 101])), atol=half + 1e-6)


def test_the_jackknife_is_the_deviation_of_a_mean():
    """Of volumes that are means of all folds but one, whose noise is independent; dark but for the noise."""
    folds = np.random.default_rng(0).normal(0, np.repeat([0.1, 0.3], 120), (4, 2, 120, 240))
    volumes = [np.delete(folds, fold, 0).mean(0).astype(np.float32) for fold in range(4)]
    deviation = np.sqrt(np.mean(jackknife_deviation(volumes).reshape(2, 120, 2, 120) ** 2, (0, 1, 3)))
    # What folds have in common is noise here, which is averaged over neighbours.
    np.testing.assert_allclose(deviation, np.hypot(1, SHARE) * np.array([0.1, 0.3]) / 2, rtol=0.03)
    np.testing.assert_allclose(jackknife_deviation([np.full((2, 9, 9), 3, np.float32)] * 4), 3 * SHARE, rtol=1e-6)
