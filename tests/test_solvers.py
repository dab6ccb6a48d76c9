"""Richardson-Lucy, FISTA and ADMM, on every kind of operator."""

from functools import cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.optimize import nnls
from skimage.restoration import denoise_tv_chambolle, richardson_lucy as of_skimage

from gs_jax import Imager, ImagingOperator, MicrolensArray, forward
from gs_jax.base.errors import InputError
from gs_jax.linear.measured_psf import ConvolutionOperator
from gs_jax.reconstruction.pipeline import PinholeRichardsonLucy
from gs_jax.solvers.admm import ADMM, ConvolutionADMM
from gs_jax.solvers.base import RESULTS, differences, differences_adjoint, lambda_max, shrink, solve, total_variation
from gs_jax.solvers.fista import FISTA, largest_eigenvalue
from gs_jax.solvers.richardson_lucy import RichardsonLucy, background_step, bilinear_background
from gs_jax.solvers.surface import Surface

from .helpers import compilations, scene

RNG = np.random.default_rng(0)
# A dense operator, whose entries are positive, and its matrix by NumPy: what need not be compiled is not.
MATRIX = RNG.random((30, 12))
DENSE = lx.MatrixLinearOperator(jax.device_put(MATRIX))
# Nothing but the squares, where there is a choice.
SOLVERS = {"R-L": RichardsonLucy, "FISTA": partial(FISTA, sparsity=0.0), "ADMM": partial(ADMM, sparsity=0.0)}


def small():
    return scene(voxels=(8, 7), pitch=0.1, depths=(18.0, 20.0))


def blurred(imager, grid):
    """The forward model with a PSF, which is not the adjoint of back-projection."""
    psf = np.broadcast_to(np.outer(w := np.array([0.25, 0.5, 0.25]), w), (grid.depths.size, 3, 3))
    structure = jax.ShapeDtypeStruct(grid.volume_shape, float)
    return lx.FunctionLinearOperator(lambda volume: forward(volume, imager, grid, psf), structure)


OPERATORS = {
    "dense": lambda: DENSE,
    "convolution": lambda: ConvolutionOperator(RNG.random((2, 5, 4)), (12, 10)),
    "ray": lambda: ImagingOperator(*small()),
    "blurred": lambda: blurred(*small()),
}
# To compile an operator of rays for each solver takes seconds.
EVERY = [pytest.param(name, marks=[pytest.mark.slow] * (name in ("ray", "blurred"))) for name in OPERATORS]


@cache
def made(operator):
    """An operator, a scene of two bright voxels that much of the image sees, and its image."""
    A = OPERATORS[operator]()
    seen = np.asarray(jax.jit(lambda y: A.T.mv(y))(np.ones(A.out_structure().shape)))
    well, x = np.flatnonzero(seen > 0.7 * seen.max()), np.zeros(seen.shape)
    x.flat[well[[len(well) // 4, -len(well) // 4]]] = 1.0, 2.0
    return A, x, np.asarray(jax.jit(lambda x: A.mv(x))(x))


@pytest.mark.parametrize("operator", EVERY)
@pytest.mark.parametrize("solver", SOLVERS)
def test_it_finds_two_bright_voxels_and_nothing_in_the_dark(solver, operator):
    A, x, image = made(operator)
    found, dark = (solve(A, light, SOLVERS[solver](steps=150)) for light in (image, 0 * image))
    assert found.stats["num_steps"] == 150 and found.result == RESULTS.steps_taken
    # Noiseless, but slow along the least eigenvalues: what matters is that the light is where it was.
    bright = np.argsort(np.asarray(found.value).ravel())[-2:]
    assert set(bright.tolist()) == set(np.flatnonzero(x).tolist())
    costs = np.asarray(found.stats["costs"])
    assert np.isfinite(costs).all() and costs[-1] < 0.05 * costs[0]
    assert not np.asarray(dark.value).any() and not np.asarray(dark.stats["costs"]).any()


@pytest.mark.parametrize("solver", SOLVERS)
def test_zero_operators_integers_and_float32(solver):
    zero, make = lx.MatrixLinearOperator(jax.device_put(0 * MATRIX)), SOLVERS[solver]
    assert not np.asarray(solve(zero, np.ones(30), make(steps=5)).value).any()
    image = np.arange(30, dtype=np.uint16)
    of_counts, of_floats = (solve(DENSE, light, make(steps=5)).value for light in (image, image.astype(float)))
    np.testing.assert_array_equal(of_counts, of_floats)
    single = lx.MatrixLinearOperator(jax.device_put(MATRIX.astype(np.float32)))
    dark = solve(single, np.zeros(30, np.float32), make(steps=20, tolerance=1e-3))
    assert dark.result == RESULTS.converged and dark.value.dtype == jnp.float32 and not np.asarray(dark.value).any()
    assert np.array_equal(np.isnan(dark.stats["costs"]), np.arange(20) >= int(dark.stats["num_steps"]))


@pytest.mark.parametrize(
    "make, options",
    [
        (RichardsonLucy, {"tv": 0.01, "min_sensitivity": 0.1}),
        (RichardsonLucy, {"tolerance": 1e-2}),
        (FISTA, {"sparsity": 0.01}),
        (FISTA, {"sparsity": 0.01, "tolerance": 1e-2}),
        (ADMM, {"sparsity": 0.01, "tolerance": 1e-2}),
        (ConvolutionADMM, {"sparsity": 0.01, "tv": 0.01, "tv_z": 0.5}),
        (Surface, {"smooth_depth": 2.0, "smooth_brightness": 0.1}),
    ],
)
def test_other_numbers_run_the_same_program(make, options):
    """Of the image, the operator, a weight or the tolerance; the result is that of the steps one by one."""
    A, x, _ = made("convolution" if make in (ConvolutionADMM, Surface) else "dense")
    image = np.asarray(A.mv(np.arange(float(x.size)).reshape(x.shape)))
    results = []
    for factor in (1.0, 2.0):
        scaled = jax.tree.map(partial(jnp.multiply, factor), A)
        before = compilations()
        numbers = {name: factor * value for name, value in options.items()}
        results.append(solve(scaled, factor * image, make(steps=12, **numbers)))
        compiled = compilations() - before
    assert compiled == 0 and results[0].value.shape == x.shape
    one: Any = make(**numbers)
    step, state = eqx.filter_jit(one.step), eqx.filter_jit(one.init)(scaled, 2.0 * image)
    steps = int(results[1].stats["num_steps"])
    costs, residuals = np.zeros((2, steps))
    for number in range(steps):
        state, costs[number], residuals[number] = step(scaled, 2.0 * image, state)
    # Compiled apart, the same sums are rounded otherwise.
    np.testing.assert_allclose(results[1].value, one.estimate(state), rtol=1e-9)
    np.testing.assert_allclose(costs, results[1].stats["costs"][:steps], rtol=1e-9)
    converged = results[1].result == RESULTS.converged
    assert (residuals[:-1] >= one.tolerance).all() and (residuals[-1] < one.tolerance) == converged


def test_solve_goes_on_and_says_how_it_ended():
    image, few = np.arange(30.0), FISTA(steps=5)
    half = solve(DENSE, image, few)
    whole = solve(DENSE, image, few, max_steps=10)
    np.testing.assert_array_equal(solve(DENSE, image, few, state=half.state).value, whole.value)
    assert whole.stats["costs"].shape == (10,) and RESULTS[whole.result] == "All steps were taken."
    wrong = np.where(np.arange(30) == 3, np.nan, image)
    assert solve(DENSE, wrong, few, throw=False).result == RESULTS.not_finite
    with pytest.raises(InputError, match="The estimate is not finite: .*NaN"):
        solve(DENSE, wrong, few)
    with pytest.raises(RuntimeError, match="The estimate is not finite"):
        eqx.filter_jit(lambda image: solve(DENSE, image, few).value)(wrong)


def by_geometry():
    """The ray operator as a function of its parameters."""
    imager, grid = scene(voxels=(4, 3), pitch=0.2, depths=(18.0, 20.0))

    def operator(centers, v):
        return ImagingOperator(Imager(MicrolensArray(centers), imager.sensor, v, imager.field_radius), grid)

    return operator, (imager.array.centers, imager.sensor_distance)


# What makes an operator, and from what.
PARAMETRIC = {"dense": lambda: (lx.MatrixLinearOperator, (DENSE.matrix,)), "ray": by_geometry}
KINDS = ["dense", pytest.param("ray", marks=pytest.mark.slow)]


@pytest.mark.integration
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("solver", SOLVERS)
def test_gradients_by_image_and_operator(solver, kind):
    """Through a fixed number of steps, once (the ray operator has no second derivative); finite in the dark."""
    operator, parameters = PARAMETRIC[kind]()
    A = operator(*parameters)
    row, column = np.meshgrid(*(np.arange(n, dtype=float) for n in (*A.out_structure().shape, 1)[:2]), indexing="ij")
    image = (2 + np.sin(row / 10) + np.cos(column / 12 + row / 15)).reshape(A.out_structure().shape)
    options = SOLVERS[solver](steps=3, **({"cg_steps": 3} if solver == "ADMM" else {}))
    weight = np.random.default_rng(5).normal(size=A.in_structure().shape)

    @jax.jit
    def moment(image, *parameters):
        return jnp.vdot(weight, solve(operator(*parameters), image, options).value)

    # Steps of 1e-6 mm stay within a pixel at this generic point; rounding of 1e-13 then costs 1e-6.
    check_grads(moment, (image, *parameters), order=1, modes=["fwd", "rev"], eps=1e-6, atol=1e-4, rtol=1e-4)
    value, gradient = jax.jit(jax.value_and_grad(moment, argnums=(0, 1)))(0 * image, *parameters)
    assert value == 0 and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("solver", ["FISTA", "ADMM"])
def test_least_squares_without_negative_values_is_scipys(solver):
    """More equations than unknowns and noise: one solution, on the boundary."""
    image = np.random.default_rng(2).normal(size=30) + 1
    expected = nnls(MATRIX, image)[0]
    assert 0 < np.count_nonzero(expected) < 12
    found = solve(DENSE, image, SOLVERS[solver](steps=3000))
    np.testing.assert_allclose(found.value, expected, atol=1e-8)  # they converge linearly, to the last digits


def test_the_convex_solvers_meet_with_sparsity():
    # Perron's eigenvalue is far above the next here.
    largest = np.linalg.svd(MATRIX, compute_uv=False)[0] ** 2
    np.testing.assert_allclose(jax.jit(largest_eigenvalue)(DENSE), largest, rtol=1e-10)
    image = made("dense")[2] + 0.1 * np.random.default_rng(4).normal(size=30)
    weight = 0.02 * (MATRIX.T @ image).max()

    def final(solver):
        x = np.asarray(solve(DENSE, image, solver).value)
        return ((MATRIX @ x - image) ** 2).sum() / 2 + weight * x.sum()

    costs = [final(solver(steps=1000, sparsity=0.02)) for solver in (FISTA, ADMM)]
    np.testing.assert_allclose(costs, costs[0], rtol=1e-10)


@pytest.mark.parametrize("solver", [FISTA, ADMM])
def test_zero_is_optimal_from_a_sparsity_of_1(solver):
    image = made("dense")[2]
    run = lambda b, sparsity: np.asarray(solve(DENSE, b, solver(steps=2000, sparsity=sparsity)).value)
    np.testing.assert_allclose(run(image, 1.01), 0, atol=1e-9)
    assert run(image, 0.99).max() > 1e-3
    assert lambda_max(jax.device_put(-image)) == 0 and not run(-image, 0.5).any()


def test_richardson_lucy_is_scikit_images():
    """Light in the middle: scikit-image assumes a sensitivity of 1, which holds a PSF's width from the edge."""
    rng = np.random.default_rng(0)
    psf = rng.random((5, 7))
    psf /= psf.sum()
    truth = np.zeros((40, 42))
    truth[12:28, 14:28] = rng.random((16, 14))
    system = ConvolutionOperator(psf[None], truth.shape)
    embedded = np.zeros(system.scene_shape)
    embedded[0][system.window] = truth
    image = np.maximum(np.asarray(system.mv(embedded)), 0)
    image[image < 1e-12] = 0  # an FFT's rounding
    expected = of_skimage(image, psf, num_iter=25, clip=False)
    found = np.asarray(solve(system, image, RichardsonLucy(steps=25)).value)
    # The same iteration in exact arithmetic; 25 divisions amplify the rounding of the FFTs.
    np.testing.assert_allclose(found[0][system.window], expected, atol=1e-8)


@pytest.mark.integration
def test_richardson_lucy_with_background_acceleration_and_total_variation():
    A, truth, clean = made("ray")
    run = lambda image, **options: solve(A, image, RichardsonLucy(steps=40, **options))
    off = lambda solution: np.abs(np.asarray(solution.value) - truth).max()
    assert off(run(clean + 0.5, background=0.5)) < 0.05 < off(run(clean + 0.5))
    assert run(clean, accelerate=True).stats["costs"][-1] < 1e-3 * run(clean).stats["costs"][-1]
    noisy = clean + 0.5 + 0.3 * np.random.default_rng(1).random(clean.shape)
    variation = lambda s: sum(np.abs(np.diff(s.value, axis=axis)).sum() for axis in range(3))
    assert variation(run(noisy, tv=0.05)) < 0.97 * variation(run(noisy))


@pytest.mark.integration
def test_richardson_lucy_fits_a_slow_background():
    A, truth, clean = made("ray")
    slope = 0.5 + np.outer(np.linspace(0, 1, clean.shape[0]), np.linspace(1, 0, clean.shape[1]))
    run = lambda image, knots: np.asarray(solve(A, image, RichardsonLucy(steps=200, background_knots=knots)).value)
    error = lambda image, knots: np.linalg.norm(run(image, knots) - truth) / np.linalg.norm(truth)
    assert error(clean + slope, 3) < 0.25 * error(clean + slope, 0)
    assert error(clean, 3) < 0.1 and not run(0 * clean, 3).any()


def test_a_sieve_is_part_of_the_operator_and_of_the_estimate():
    """By a matrix of a Gaussian's weights; a sieve of width 0 lights no voxel that no pixel sees."""
    distance = np.subtract.outer(np.arange(12), np.arange(12))
    blur = np.where(np.abs(distance) <= 6, np.exp(-(distance**2) / 2 / 1.4**2), 0)
    blur /= np.exp(-(np.arange(-6, 7) ** 2) / 2 / 1.4**2).sum()
    image = MATRIX @ RNG.random(12)
    solver = RichardsonLucy(12, accelerate=True)
    by_hand = solve(lx.MatrixLinearOperator(jax.device_put(MATRIX @ blur)), image, solver)
    found = solve(DENSE, image, RichardsonLucy(12, accelerate=True, sieve=1.4))
    np.testing.assert_allclose(found.value, blur @ np.asarray(by_hand.value), rtol=1e-9)
    np.testing.assert_allclose(found.stats["costs"], by_hand.stats["costs"], rtol=1e-6)
    unseen = lx.MatrixLinearOperator(jax.device_put(MATRIX * (np.arange(12) != 5)))
    without = solve(unseen, image, solver).value
    none = solve(unseen, image, RichardsonLucy(12, accelerate=True, sieve=jnp.array(0.0))).value
    np.testing.assert_allclose(none, without, rtol=1e-9)
    assert without[5] == 0


@pytest.mark.parametrize("sieve", [-0.1, 2.1, (), [0.0, np.nan], np.float32(5), "a"])
def test_a_sieve_has_its_range(sieve):
    with pytest.raises(InputError, match="sieve must be 0 to 2 voxels"):
        RichardsonLucy(sieve=sieve)


def test_solve_takes_one_sieve():
    with pytest.raises(InputError, match="sieve must be one number"):
        solve(DENSE, np.ones(30), RichardsonLucy(1, sieve=(0.0, 1.0)))


def test_unexplained_light_does_not_go_to_voxels_that_few_pixels_see():
    """A column of 16 pixels on a voxel of each, but for the last, which half a percent of a pixel sees."""
    A = lx.MatrixLinearOperator(jax.device_put(np.diag([*np.ones(15), 0.005])))
    run = lambda **options: np.asarray(solve(A, np.ones(16), RichardsonLucy(steps=10, **options)).value)
    assert run()[-1] == pytest.approx(200)
    held = run(min_sensitivity=0.3)
    np.testing.assert_allclose(held[:-1], 1)
    assert held[-1] < 4


def test_the_background_may_have_more_knots_than_there_are_pixels():
    image, knots = np.ones((3, 40)), np.ones((8, 8))
    both = jax.jit(lambda knots, image: (bilinear_background(knots, image), background_step(knots, 2 * image)))
    background, step = map(np.asarray, both(knots, image))
    np.testing.assert_allclose(background, 1, rtol=1e-12)
    assert set(np.round(np.unique(step), 9)) == {0.0, 2.0}


def test_richardson_lucy_climbs_and_keeps_the_light():
    image = made("dense")[2] * np.random.default_rng(6).uniform(0.8, 1.2, 30)
    found = solve(DENSE, image, RichardsonLucy(steps=50))
    assert np.all(np.diff(found.stats["costs"]) <= 1e-12)
    # After each step the expected image holds as much light as the image (Lucy 1974).
    np.testing.assert_allclose((MATRIX @ np.asarray(found.value)).sum(), image.sum(), rtol=1e-12)


@pytest.mark.parametrize("solver", SOLVERS)
def test_wrong_arguments_are_named(solver):
    with pytest.raises(InputError, match=r"image must have the operator's output shape \(30,\), got \(4,\)"):
        solve(DENSE, np.zeros(4), SOLVERS[solver](steps=1))
    with pytest.raises(InputError, match="steps must be 1 or more, got 0"):
        SOLVERS[solver](steps=0)
    with pytest.raises(InputError, match="tolerance must be 0 or more, got -1.0"):
        SOLVERS[solver](tolerance=-1.0)
    with pytest.raises(InputError, match="sparsity must be 0 or more, got nan"):
        ADMM(sparsity=float("nan"))
    with pytest.raises(InputError, match="background_knots must be 0, or 2 or more, got 1"):
        RichardsonLucy(background_knots=1)
    wrong: Any = FISTA
    with pytest.raises(InputError, match="solver must be an object such as FISTA"):
        solve(DENSE, np.zeros(30), wrong)
    with pytest.raises(InputError, match="image must be real, got complex"):
        solve(DENSE, np.zeros(30, complex), SOLVERS[solver](steps=1))
    for other in (ConvolutionADMM(), PinholeRichardsonLucy()):
        with pytest.raises(InputError, match="must be used with"):
            solve(DENSE, np.zeros(30), other)
    with pytest.raises(InputError, match="image must be 2-D .*, got 1-D"):
        solve(DENSE, np.zeros(30), RichardsonLucy(background_knots=2))


def test_differences_and_their_adjoint():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(3, 1, 5))
    d = np.asarray(jax.jit(differences)(x))
    np.testing.assert_array_equal(d[0], np.diff(x, axis=0, append=x[-1:]))
    assert d.shape == (2, 3, 1, 5)  # nothing along an axis of 1
    u = rng.normal(size=d.shape)
    adjoint = jax.jit(differences_adjoint)(u)
    np.testing.assert_allclose(np.vdot(d, u), np.vdot(x, adjoint), rtol=1e-12)
    assert jax.eval_shape(differences, jnp.ones((1, 1, 1))).shape == (0, 1, 1, 1)


@pytest.mark.parametrize("isotropic", [False, True])
def test_shrinking_is_the_proximal_map(isotropic):
    """Moreau: what is taken away lies in the dual ball, and touches it where something is left."""
    u = np.random.default_rng(0).normal(size=(2, 4, 5, 6))

    @jax.jit
    def shrunk(u):
        left = shrink(u, 0.7, isotropic=isotropic)
        gradient = jax.grad(lambda u: shrink(u, 0.7, isotropic=isotropic).sum())(jnp.zeros_like(u))
        return left, total_variation(left, isotropic=isotropic), gradient

    left, variation, gradient = map(np.asarray, shrunk(u))
    taken, size = u - left, lambda v: np.sqrt(np.sum(v**2, axis=0)) if isotropic else np.abs(v)
    assert size(taken).max() <= 0.7 + 1e-12
    np.testing.assert_allclose(size(taken)[size(left) > 0], 0.7, rtol=1e-12)
    np.testing.assert_allclose(np.vdot(taken, left), 0.7 * variation, rtol=1e-12)
    assert not np.any(gradient)


@pytest.mark.integration
@pytest.mark.parametrize("tv", [0.0, 0.01])
def test_few_applications_of_the_operator_reach_the_minimum(tv):
    """Fewer equations than unknowns, as of a volume. FISTA's search of the largest eigenvalue is not counted."""
    matrix, rng = np.random.default_rng(0).random((60, 120)), np.random.default_rng(1)
    A = lx.MatrixLinearOperator(jax.device_put(matrix))
    image = matrix[:, [3, 20, 21, 50]].sum(1) + 0.05 * rng.normal(size=60)
    unit = (matrix.T @ image).max()

    def final(solver):
        x = np.asarray(solve(A, image, solver).value)
        return ((matrix @ x - image) ** 2).sum() / 2 + unit * (tv * np.abs(np.diff(x)).sum() + 0.01 * x.sum())

    found, least = (final(ADMM(steps, sparsity=0.01, tv=tv)) for steps in (20, 2000))
    assert found < 1.03 * least
    if not tv:
        assert found < 0.8 * final(FISTA(60, sparsity=0.01))
        np.testing.assert_allclose(least, final(FISTA(2000, sparsity=0.01)), rtol=1e-6)


def test_isotropic_total_variation_denoises_as_scikit_image_does():
    """The identity as operator; Chambolle's dual method, without wrapping, is what scikit-image has."""
    image = 3 + 0.3 * np.random.default_rng(2).normal(size=(16, 14))
    image[4:9, 5:11] += 2
    A = lx.IdentityLinearOperator(jax.ShapeDtypeStruct(image.shape, image.dtype))
    solver = ADMM(600, sparsity=0.0, tv=0.4 / image.max(), isotropic=True)
    found = solve(A, image, solver)
    expected = denoise_tv_chambolle(image, weight=0.4, eps=1e-12, max_num_iter=20000)
    # Both converge sublinearly; Chambolle's is at about 1e-4 after so many.
    np.testing.assert_allclose(found.value, expected, atol=2e-3)
