"""Unrolled inversion: the networks between the steps, their training, and the check by imaging again."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.ndimage import convolve1d
from scipy.sparse.linalg import LinearOperator, cg

from gs_jax import Grid, Imager, InputError, MicrolensArray, Sensor, Unrolled, forward, psf_model, reconstruct, solve
from gs_jax.apps.training import (
    UNROLLED,
    UnrolledExample,
    init,
    simulate_unrolled_examples,
    train,
    unrolled_loss,
    unrolled_recipe,
    with_fixed_steps,
)
from gs_jax.apps.training_data import SCENES, CaptureSpec, random_microscope, simulate_example
from gs_jax.projection.point_sources import full_image_of_points
from gs_jax.reconstruction.inverse_problem import InverseProblem, LensTypeGeometry
from gs_jax.reconstruction.networks import read_unrolled, write_unrolled
from gs_jax.reconstruction.residual import forward_residual
from gs_jax.solvers import unrolled
from gs_jax.solvers.richardson_lucy import bilinear_background
from gs_jax.solvers.unrolled import initialize_unrolled

KEY = jax.random.key(0)
TINY = CaptureSpec(64, 0.06, 0.25, 3, binning=4)


def imager(pixels=(160, 160), pitch=0.03) -> Imager:
    side = (np.argwhere(np.ones((3, 3))) - 1) * 1.3
    centers = side + np.random.default_rng(0).uniform(-0.2, 0.2, side.shape)
    return Imager(MicrolensArray(centers), Sensor(pixels, pitch), 5.75, 1.5)


def voxels_and_image() -> tuple[InverseProblem, np.ndarray, np.ndarray]:
    """Chief rays through nine lenses, and the exact image of random voxels."""
    scope, grid = imager((40, 40), 0.12), Grid([18.0, 20.0], (9, 8), 0.3)
    system = InverseProblem(scope, grid, None, (LensTypeGeometry(scope),))
    truth = np.random.default_rng(0).random(grid.volume_shape)
    return system, truth, np.asarray(system.mv(jnp.asarray(truth)))


def small(networks: Unrolled) -> tuple[Unrolled, UnrolledExample]:
    system, truth, light = voxels_and_image()
    start = networks.step(system, light, networks.init(system, light))[0]
    return networks, UnrolledExample(light, system, truth, start)


def shapes(*sizes: int) -> Unrolled:
    return eqx.filter_eval_shape(partial(initialize_unrolled, *sizes), key=KEY)


def filled(networks: Unrolled) -> Unrolled:
    """Random weights everywhere. NumPy's: they need not be compiled."""
    rng = np.random.default_rng(0)
    fill = lambda leaf: rng.normal(0, (2 / max(np.prod(leaf.shape[1:4]), 20)) ** 0.5, leaf.shape).astype(leaf.dtype)
    return jax.tree.map(lambda leaf: jnp.asarray(fill(leaf)), networks)


@pytest.mark.integration
def test_a_bright_voxel_is_the_brightest():
    scope, voxels = imager(), Grid([18.0, 20.0, 22.0], (21, 21), 0.12)
    place = voxels.to_mm(np.array([[1, 8, 13]]))
    image = full_image_of_points(np.column_stack([place, [1e6]]), scope)
    found = reconstruct(image, scope, voxels, initialize_unrolled(key=KEY))
    assert np.unravel_index(found.argmax(), found.shape) == (1, 8, 13)
    assert np.isfinite(found).all() and found.min() >= 0


@pytest.fixture(scope="module")
def differentiable():
    """Networks of float64, a case of theirs, and what training lowers, by the networks and another image and truth."""
    networks, case = small(initialize_unrolled(1, 1, 2, 4, key=KEY))
    networks = jax.tree.map(lambda leaf: leaf.astype(float), networks)
    of = lambda networks, light, truth: unrolled_loss(networks, case._replace(light=light, truth=truth))
    return networks, case, jax.jit(of)


@pytest.mark.integration
def test_darkness_stays_dark_and_has_finite_gradients(differentiable):
    networks, case, loss = differentiable
    dark = (np.zeros_like(case.light), np.zeros_like(case.truth))
    assert not solve(case.system, dark[0], networks).value.any()
    _, back = jax.vjp(lambda networks: loss(networks, *dark), networks)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(back(jnp.ones(()))))


@pytest.mark.integration
def test_gradients_by_the_weights(differentiable):
    networks, case, loss = differentiable
    of_networks = lambda networks: loss(networks, case.light, case.truth)
    check_grads(of_networks, (networks,), 1, modes=["rev"], rtol=2e-3)


@pytest.mark.integration
def test_gradients_by_the_image(differentiable):
    networks, case, _ = differentiable
    volume = jax.jit(lambda light: solve(case.system, light, networks).value)
    check_grads(volume, (jnp.asarray(case.light),), 1, modes=["rev"], rtol=2e-3)


@pytest.mark.integration
def test_the_last_steps_are_conjugate_gradients():
    """SciPy's, with the same preconditioner and as many, where slow waves are left out of account."""
    networks, case = small(initialize_unrolled(1, 1, 4, 4, key=KEY))
    scope, grid = case.system.imager, case.system.grid
    A = InverseProblem(scope, grid, None, case.system.back_projections, detrend_modes=2)
    state = networks.init(A, case.light)
    for _ in range(networks.steps):
        state = networks.step(A, case.light, state)[0]
    exact, shape, size = InverseProblem(scope, grid, None, detrend_modes=2), case.truth.shape, case.truth.size
    back = lambda image: np.asarray(exact.T.mv(jnp.asarray(image))).ravel()
    x = np.asarray(state.lucy.x)
    variance = blurred(x).ravel() * (x**2).sum() / x.sum()
    light = jnp.asarray(case.light)
    left = np.asarray(light - A.mv(state.lucy.x) - bilinear_background(state.lucy.knots, light))
    normal = lambda x: back(exact.mv(jnp.asarray(x, float).reshape(shape))) + np.mean(left**2) * x / variance
    square, prior = (LinearOperator((size, size), product) for product in (normal, lambda x: variance * x))
    found, _ = cg(square, back(case.light), maxiter=4, rtol=0, M=prior)
    np.testing.assert_allclose(networks.estimate(state).ravel(), np.maximum(found, 0), rtol=1e-6, atol=1e-9)


def blurred(volume: np.ndarray) -> np.ndarray:
    """Binomial weights along rows and columns, darkness beyond."""
    for axis in (1, 2):
        volume = convolve1d(volume, np.array([1, 4, 6, 4, 1]) / 16, axis, mode="constant")
    return volume


def test_bands_leave_no_seams(monkeypatch):
    layers = jax.tree.map(lambda part: np.asarray(part)[0], filled(shapes()).layers)
    seen = np.random.default_rng(1).normal(size=(3, 23, 17, 7))
    whole = jax.jit(unrolled._apply_network)(layers, seen)
    monkeypatch.setattr(unrolled, "_ROWS", 5)
    in_bands = jax.jit(lambda *arguments: unrolled._apply_network(*arguments))(layers, seen)
    assert np.abs(whole).max() > 0.1
    np.testing.assert_allclose(in_bands, whole, rtol=1e-5, atol=1e-6)


def test_no_more_steps_than_networks():
    networks = filled(shapes(1, 3, 2))
    assert networks.steps == 6
    with pytest.raises(InputError, match="steps must be 1 to 6, .* got 7"):
        Unrolled(networks.layers, networks.power, 1, 2, 7)
    with pytest.raises(InputError, match="steps must be 1 or more, got 0"):
        Unrolled(networks.layers, networks.power, 1, 2, 0)


def test_weights_come_back(tmp_path):
    made = filled(shapes(3, 2, 1, 4))
    write_unrolled(tmp_path / "w.npz", made)
    found = read_unrolled(tmp_path / "w.npz")
    assert (found.first, found.last, found.steps) == (3, 1, 6)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(made), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)
    np.savez(tmp_path / "other.npz", about=np.array('{"first": 1, "networks": 100000, "squares": 1, "width": 4}'))
    np.savez(tmp_path / "old.npz", about=np.array('{"first": 1, "networks": 1, "last": 2, "width": 4}'))
    with pytest.raises(InputError, match="must be conjugate gradients, got 2 of Richardson-Lucy"):
        read_unrolled(tmp_path / "old.npz")
    np.savez(tmp_path / "slices.npz", about=np.array('{"offsets": [0], "widths": [2], "standardized": true}'))
    with pytest.raises(InputError, match="with first, networks, width, squares.*another kind.*'widths'"):
        read_unrolled(tmp_path / "slices.npz")
    for name in ("other", "missing"):
        with pytest.raises(InputError, match=name):
            read_unrolled(tmp_path / f"{name}.npz")


@pytest.mark.integration
def test_an_example_is_its_seed_and_number():
    one, again, other = (simulate_example(0, number, TINY) for number in (0, 0, SCENES))
    np.testing.assert_array_equal(one.image, again.image)
    np.testing.assert_array_equal(one.truth, again.truth)
    assert one.image.shape == (64, 64) and one.truth.shape == one.grid.volume_shape
    assert not np.array_equal(one.imager.array.centers, other.imager.array.centers)
    # Wide apertures and narrow ones have tables of one shape, for which training is compiled once.
    apertures = [float(each.imager.array.aperture_diameter) for each in (one, other)]
    assert min(apertures) < 1 and max(apertures) == 2
    shapes = [jax.tree.map(jnp.shape, random_microscope(0, number, TINY)[-1]) for number in (0, 1)]
    assert shapes[0] == shapes[1]
    empty = simulate_example(0, 15, TINY)
    assert not empty.truth.any() and empty.image.std() > 0


@pytest.mark.slow
def test_training_makes_it_better():
    cases = simulate_unrolled_examples(4, 0, spec=TINY)
    recipe = unrolled_recipe(cases)
    state = train(recipe, init(recipe, steps=30, seed=0))
    mean = lambda networks: np.mean([unrolled_loss(networks, case) for case in cases])
    # The loss is a logarithm: errors fall by a tenth or more.
    assert mean(state.network) < mean(recipe.network(jax.random.key(0))) + np.log10(0.9)


def test_a_volume_imaged_again():
    system, truth, light = voxels_and_image()
    scope, grid = system.imager, system.grid
    same = forward_residual(3 * truth, light, scope, grid, optics=None)
    # The image's darkest percent counts as the camera's offset.
    assert same.error < 0.05 and same.correlation == pytest.approx(1, abs=1e-6)
    assert same.regions.shape == (16, 16) and (same.regions >= 0).all()
    nothing = forward_residual(0 * truth, light, scope, grid, optics=None)
    assert nothing.error == pytest.approx(1) and nothing.correlation == 0
    wrong = forward_residual(truth[::-1], light, scope, grid, optics=None)
    assert same.error < wrong.error < nothing.error


def test_the_networks_of_the_package():
    """They are what the recipe makes."""
    found, made = Unrolled.pretrained(), with_fixed_steps(shapes())
    assert jax.tree.structure(found) == jax.tree.structure(made) and found.steps == 33


@pytest.mark.slow
def test_little_is_invented_on_noise():
    """A capture that shows nothing: the volume, imaged again, is to be a tenth of the noise."""
    e = simulate_example(1, 15, UNROLLED)
    assert not e.truth.any()
    volume = reconstruct(e.image, e.imager, e.grid, Unrolled.pretrained())
    image = forward(volume, e.imager, e.grid, psf_model(e.imager, e.grid, "full"))
    assert np.std(image) < 0.1 * np.std(e.image)
