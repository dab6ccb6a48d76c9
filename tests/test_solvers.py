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
from gs_jax.projection.measured_psf import ConvolutionOperator
from gs_jax.reconstruction.pipeline import PinholeRichardsonLucy
from gs_jax.solvers.admm import ADMM, ConvolutionADMM, shrink, total_variation
from gs_jax.solvers.base import RESULTS, differences, differences_adjoint, lambda_max, solve
from gs_jax.solvers.fista import FISTA, largest_eigenvalue
from gs_jax.solvers.richardson_lucy import RichardsonLucy, background_step, bilinear_background
from gs_jax.solvers.surface import Surface

from .helpers import compilations, scene

# Nothing but the squares, where there is a choice.
SOLVERS = {"R-L": RichardsonLucy, "FISTA": partial(FISTA, sparsity=0.0), "ADMM": partial(ADMM, sparsity=0.0)}


def small():
    return scene(voxels=(8, 7), pitch=0.1, depths=(18.0, 20.0))


def dense():
    matrix = jax.random.uniform(jax.random.key(0), (30, 12))
    return lx.MatrixLinearOperator(matrix)


def blurred(imager, grid, dtype=jnp.float64):
    """The forward model with a PSF, which is not the adjoint of back-projection."""
    psf = jnp.broadcast_to(jnp.outer(w := jnp.array([0.25, 0.5, 0.25], dtype), w), (grid.depths.size, 3, 3))
    structure = jax.ShapeDtypeStruct(grid.volume_shape, dtype)
    return lx.FunctionLinearOperator(lambda volume: forward(volume, imager, grid, psf), structure)


def convolution():
    psf = jax.random.uniform(jax.random.key(3), (2, 5, 4))
    return ConvolutionOperator(psf, (12, 10))


OPERATORS = {
    "ray": lambda: ImagingOperator(*small()),
    "blurred": lambda: blurred(*small()),
    "dense": dense,
    "convolution": convolution,
}


# To compile an operator of rays for each solver takes seconds.
EVERY = [pytest.param(name, marks=[pytest.mark.slow] * (name in ("ray", "blurred"))) for name in OPERATORS]


def light(A):
    """Two bright voxels that much of the image sees."""
    x = jnp.zeros(A.in_structure().shape)
    seen = A.T.mv(jnp.ones(A.out_structure().shape)).ravel()
    well = np.flatnonzero(seen > 0.7 * seen.max())
    return x.reshape(-1).at[well[[len(well) // 4, -len(well) // 4]]].set(jnp.array([1.0, 2.0])).reshape(x.shape)


@cache
def made(operator):
    return OPERATORS[operator]()


@cache
def compiled(solver, operator):
    return lambda image: solve(made(operator), image, SOLVERS[solver](steps=150))


@pytest.mark.parametrize("operator", EVERY)
@pytest.mark.parametrize("solver", SOLVERS)
def test_it_finds_two_bright_voxels(solver, operator):
    A = made(operator)
    x = light(A)
    found = compiled(solver, operator)(A.mv(x))
    assert found.stats["num_steps"] == 150 and found.result == RESULTS.steps_taken
    # Noiseless, but slow along the least eigenvalues: what matters is that the light is where it was.
    bright = np.argsort(np.asarray(found.value).ravel())[-2:]
    assert set(bright.tolist()) == set(np.flatnonzero(np.asarray(x)).tolist())
    assert np.all(np.isfinite(found.stats["costs"])) and found.stats["costs"][-1] < 0.05 * found.stats["costs"][0]


@pytest.mark.parametrize("operator", EVERY)
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_dark_image_gives_zeros(solver, operator):
    found = compiled(solver, operator)(jnp.zeros(made(operator).out_structure().shape))
    assert not np.any(found.value) and not np.any(found.stats["costs"])


@pytest.mark.parametrize("solver", SOLVERS)
def test_zero_operators_integers_and_float32(solver):
    A, make = dense(), SOLVERS[solver]
    zero = lx.MatrixLinearOperator(jnp.zeros((30, 12)))
    assert not np.any(solve(zero, jnp.ones(30), make(steps=5)).value)
    image = jnp.arange(30, dtype=jnp.uint16)
    run = lambda image: solve(A, image, make(steps=5)).value
    np.testing.assert_array_equal(run(image), run(image.astype(float)))
    single = lx.MatrixLinearOperator(A.matrix.astype(jnp.float32))
    dark = solve(single, jnp.zeros(30, jnp.float32), make(steps=20, tolerance=1e-3))
    assert dark.result == RESULTS.converged and dark.value.dtype == jnp.float32 and not np.any(dark.value)
    assert np.array_equal(np.isnan(dark.stats["costs"]), np.arange(20) >= dark.stats["num_steps"])


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
    A = convolution() if make in (ConvolutionADMM, Surface) else dense()
    image = np.asarray(A.mv(jnp.arange(float(A.in_size())).reshape(A.in_structure().shape)))
    results = []
    for factor in (1.0, 2.0):
        scaled = jax.tree.map(partial(jnp.multiply, factor), A)
        before = compilations()
        numbers = {name: factor * value for name, value in options.items()}
        results.append(solve(scaled, factor * image, make(steps=12, **numbers)))
        compiled = compilations() - before
    assert compiled == 0 and results[0].value.shape == A.in_structure().shape
    one: Any = make(**numbers)
    step, state = eqx.filter_jit(one.step), eqx.filter_jit(one.init)(scaled, 2.0 * image)
    for _ in range(int(results[1].stats["num_steps"])):
        state, _, _ = step(scaled, 2.0 * image, state)
    np.testing.assert_allclose(results[1].value, one.estimate(state), rtol=1e-9)


def test_solve_goes_on_and_says_how_it_ended():
    A, image, few = dense(), jnp.arange(30.0), FISTA(steps=5)
    half = solve(A, image, few)
    whole = solve(A, image, few, max_steps=10)
    np.testing.assert_array_equal(solve(A, image, few, state=half.state).value, whole.value)
    assert whole.stats["costs"].shape == (10,) and RESULTS[whole.result] == "All steps were taken."
    wrong = image.at[3].set(jnp.nan)
    assert solve(A, wrong, few, throw=False).result == RESULTS.not_finite
    with pytest.raises(InputError, match="The estimate is not finite: .*NaN"):
        solve(A, wrong, few)
    with pytest.raises(RuntimeError, match="The estimate is not finite"):
        eqx.filter_jit(lambda image: solve(A, image, few).value)(wrong)


def by_geometry():
    """The ray operator as a function of its parameters."""
    imager, grid = scene(voxels=(4, 3), pitch=0.2, depths=(18.0, 20.0))

    def operator(centers, v):
        return ImagingOperator(Imager(MicrolensArray(centers), imager.sensor, v, imager.field_radius), grid)

    return operator, (imager.array.centers, imager.sensor_distance)


# What makes an operator, and from what.
PARAMETRIC = {"dense": lambda: (lx.MatrixLinearOperator, (dense().matrix,)), "ray": by_geometry}
KINDS = ["dense", pytest.param("ray", marks=pytest.mark.slow)]


@pytest.mark.integration
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("solver", SOLVERS)
def test_gradients_by_image_and_operator(solver, kind):
    """Through a fixed number of steps, once (the ray operator has no second derivative)."""
    operator, parameters = PARAMETRIC[kind]()
    A = operator(*parameters)
    row, column = jnp.meshgrid(*(jnp.arange(n, dtype=float) for n in (*A.out_structure().shape, 1)[:2]), indexing="ij")
    image = (2 + jnp.sin(row / 10) + jnp.cos(column / 12 + row / 15)).reshape(A.out_structure().shape)
    options = SOLVERS[solver](steps=3, **({"cg_steps": 3} if solver == "ADMM" else {}))
    weight = jax.random.normal(jax.random.key(5), A.in_structure().shape)

    @jax.jit
    def moment(image, *parameters):
        return jnp.vdot(weight, solve(operator(*parameters), image, options).value)

    # Steps of 1e-6 mm stay within a pixel at this generic point; rounding of 1e-13 then costs 1e-6.
    check_grads(moment, (image, *parameters), order=1, modes=["fwd", "rev"], eps=1e-6, atol=1e-4, rtol=1e-4)


@pytest.mark.integration
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("solver", SOLVERS)
def test_gradients_stay_finite_in_the_dark(solver, kind):
    operator, parameters = PARAMETRIC[kind]()

    def total(image, parameters):
        return jnp.sum(solve(operator(*parameters), image, SOLVERS[solver](steps=2)).value)

    dark = jnp.zeros(operator(*parameters).out_structure().shape)
    value, gradient = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))(dark, parameters)
    assert value == 0 and all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


@pytest.mark.integration
@pytest.mark.parametrize("solver", SOLVERS)
def test_an_early_end_and_the_same_step_by_step(solver):
    A = dense()
    image, options = A.mv(light(A)), SOLVERS[solver](steps=400, tolerance=0.02)
    found = solve(A, image, options)
    assert found.result == RESULTS.converged and 1 < found.stats["num_steps"] < 400
    step = jax.jit(lambda state: options.step(A, image, state))
    state, costs, residuals = options.init(A, image), [], []
    for _ in range(int(found.stats["num_steps"])):
        state, cost, residual = step(state)
        costs.append(cost)
        residuals.append(residual)
    assert min(residuals[:-1]) >= 0.02 > residuals[-1]
    # Compiled apart, the same sums are rounded otherwise.
    np.testing.assert_allclose(costs, found.stats["costs"][: found.stats["num_steps"]], rtol=1e-9)
    np.testing.assert_allclose(options.estimate(state), found.value, atol=1e-9)


@pytest.mark.parametrize("solver", ["FISTA", "ADMM"])
def test_least_squares_without_negative_values_is_scipys(solver):
    """More equations than unknowns and noise: one solution, on the boundary."""
    A = dense()
    image = jax.random.normal(jax.random.key(2), (30,)) + 1
    expected = nnls(np.asarray(A.as_matrix()), np.asarray(image))[0]
    assert 0 < np.count_nonzero(expected) < 12
    found = solve(A, image, SOLVERS[solver](steps=3000))
    np.testing.assert_allclose(found.value, expected, atol=1e-8)  # they converge linearly, to the last digits


def test_the_convex_solvers_meet_with_sparsity():
    A = dense()
    # Perron's eigenvalue is far above the next here.
    largest = np.linalg.svd(np.asarray(A.as_matrix()), compute_uv=False)[0] ** 2
    np.testing.assert_allclose(largest_eigenvalue(A), largest, rtol=1e-10)
    image = A.mv(light(A)) + 0.1 * jax.random.normal(jax.random.key(4), A.out_structure().shape)
    weight = 0.02 * A.T.mv(image).max()

    def final(solver):
        x = solve(A, image, solver).value
        residual = A.mv(x) - image
        return float(jnp.vdot(residual, residual) / 2 + weight * jnp.sum(x))

    costs = [final(solver(steps=1000, sparsity=0.02)) for solver in (FISTA, ADMM)]
    np.testing.assert_allclose(costs, costs[0], rtol=1e-10)


@pytest.mark.parametrize("solver", [FISTA, ADMM])
def test_zero_is_optimal_from_a_sparsity_of_1(solver):
    A = dense()
    image = A.mv(light(A))
    run = lambda b, sparsity: solve(A, b, solver(steps=2000, sparsity=sparsity)).value
    np.testing.assert_allclose(run(image, 1.01), 0, atol=1e-9)
    assert run(image, 0.99).max() > 1e-3
    assert lambda_max(-image) == 0 and not np.any(run(-image, 0.5))


def test_a_weight_that_changes_compiles_nothing(caplog):
    """Weights are leaves of a solver, not part of its code."""
    run = jax.jit(lambda image, solver: solve(dense(), image, solver).value)
    image = jnp.ones(30)
    with jax.log_compiles(), caplog.at_level("WARNING"):
        first = run(image, FISTA(steps=3, sparsity=0.5))
        assert [r for r in caplog.records if "Compiling" in r.getMessage()]
        caplog.clear()
        second = run(image, FISTA(steps=3, sparsity=0.01))
        assert not [r for r in caplog.records if "Compiling" in r.getMessage()]
    assert np.any(np.asarray(first) != np.asarray(second))


def test_richardson_lucy_is_scikit_images():
    """Light in the middle: scikit-image assumes a sensitivity of 1, which holds a PSF's width from the edge."""
    rng = np.random.default_rng(0)
    psf = rng.random((5, 7))
    psf /= psf.sum()
    truth = np.zeros((40, 42))
    truth[12:28, 14:28] = rng.random((16, 14))
    system = ConvolutionOperator(psf[None], truth.shape)
    embedded = jnp.zeros(system.scene_shape).at[(0, *system.window)].set(truth)
    image = np.maximum(np.asarray(system.mv(embedded)), 0)
    image[image < 1e-12] = 0  # an FFT's rounding
    expected = of_skimage(image, psf, num_iter=25, clip=False)
    found = solve(system, jnp.asarray(image), RichardsonLucy(steps=25))
    # The same iteration in exact arithmetic; 25 divisions amplify the rounding of the FFTs.
    np.testing.assert_allclose(found.value[0][system.window], expected, atol=1e-8)


@pytest.mark.integration
def test_richardson_lucy_with_background_acceleration_and_total_variation():
    A = ImagingOperator(*small())
    truth = light(A)
    run = lambda image, **options: solve(A, image, RichardsonLucy(steps=40, **options))
    image = A.mv(truth) + 0.5
    plain, known = run(image), run(image, background=0.5)
    assert jnp.abs(known.value - truth).max() < 0.05 < jnp.abs(plain.value - truth).max()
    fast = run(A.mv(truth), accelerate=True)
    assert fast.stats["costs"][-1] < 1e-3 * run(A.mv(truth)).stats["costs"][-1]
    rough = run(image + 0.3 * jax.random.uniform(jax.random.key(1), image.shape))
    smooth = run(image + 0.3 * jax.random.uniform(jax.random.key(1), image.shape), tv=0.05)
    variation = lambda s: sum(float(jnp.abs(jnp.diff(s.value, axis=axis)).sum()) for axis in range(3))
    assert variation(smooth) < 0.97 * variation(rough)


@pytest.mark.integration
def test_richardson_lucy_fits_a_slow_background():
    A = ImagingOperator(*small())
    truth = light(A)
    shape = A.out_structure().shape
    slope = 0.5 + jnp.outer(jnp.linspace(0, 1, shape[0]), jnp.linspace(1, 0, shape[1]))
    run = lambda image, knots: solve(A, image, RichardsonLucy(steps=200, background_knots=knots)).value
    error = lambda image, knots: float(jnp.linalg.norm(run(image, knots) - truth) / jnp.linalg.norm(truth))
    assert error(A.mv(truth) + slope, 3) < 0.25 * error(A.mv(truth) + slope, 0)
    assert error(A.mv(truth), 3) < 0.1
    assert not run(jnp.zeros(shape), 3).any()


def test_unexplained_light_does_not_go_to_voxels_that_few_pixels_see():
    """A column of 16 pixels on a voxel of each, but for the last, which half a percent of a pixel sees."""
    A = lx.MatrixLinearOperator(jnp.diag(jnp.append(jnp.ones(15), 0.005)))
    image = jnp.ones(16)
    run = lambda **options: solve(A, image, RichardsonLucy(steps=10, **options)).value
    assert run()[-1] == pytest.approx(200)
    held = run(min_sensitivity=0.3)
    np.testing.assert_allclose(held[:-1], 1)
    assert held[-1] < 4


def test_the_background_may_have_more_knots_than_there_are_pixels():
    image, knots = jnp.ones((3, 40)), jnp.ones((8, 8))
    np.testing.assert_allclose(bilinear_background(knots, image), 1, rtol=1e-12)
    assert set(np.round(np.unique(np.asarray(background_step(knots, 2 * image))), 9)) == {0.0, 2.0}


def test_richardson_lucy_climbs_and_keeps_the_light():
    A = dense()
    image = A.mv(light(A)) * jax.random.uniform(jax.random.key(6), (30,), minval=0.8, maxval=1.2)
    found = solve(A, image, RichardsonLucy(steps=50))
    assert np.all(np.diff(found.stats["costs"]) <= 1e-12)
    # After each step the expected image holds as much light as the image (Lucy 1974).
    np.testing.assert_allclose(A.mv(found.value).sum(), image.sum(), rtol=1e-12)


@pytest.mark.parametrize("solver", SOLVERS)
def test_wrong_arguments_are_named(solver):
    with pytest.raises(InputError, match=r"image must have the operator's output shape \(30,\), got \(4,\)"):
        solve(dense(), jnp.zeros(4), SOLVERS[solver](steps=1))
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
        solve(dense(), jnp.zeros(30), wrong)
    with pytest.raises(InputError, match="image must be real, got complex"):
        solve(dense(), jnp.zeros(30, complex), SOLVERS[solver](steps=1))
    for other in (ConvolutionADMM(), PinholeRichardsonLucy()):
        with pytest.raises(InputError, match="must be used with"):
            solve(dense(), jnp.zeros(30), other)
    with pytest.raises(InputError, match="image must be 2-D .*, got 1-D"):
        solve(dense(), jnp.zeros(30), RichardsonLucy(background_knots=2))


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
    A = lx.MatrixLinearOperator(jax.random.uniform(jax.random.key(0), (60, 120)))
    scene = jnp.zeros(120).at[jnp.array([3, 20, 21, 50])].set(1.0)
    image = A.mv(scene) + 0.05 * jax.random.normal(jax.random.key(1), (60,))
    unit = A.T.mv(image).max()

    def final(solver):
        x = solve(A, image, solver).value
        residual = A.mv(x) - image
        variation = total_variation(differences(x), isotropic=False)
        return float(jnp.vdot(residual, residual) / 2 + unit * (tv * variation + 0.01 * jnp.sum(x)))

    found, least = (final(ADMM(steps, sparsity=0.01, tv=tv)) for steps in (20, 2000))
    assert found < 1.03 * least
    if not tv:
        assert found < 0.8 * final(FISTA(60, sparsity=0.01))
        np.testing.assert_allclose(least, final(FISTA(2000, sparsity=0.01)), rtol=1e-6)


def test_isotropic_total_variation_denoises_as_scikit_image_does():
    """The identity as operator; Chambolle's dual method, without wrapping, is what scikit-image has."""
    image = 3 + jnp.zeros((16, 14)).at[4:9, 5:11].set(2.0) + 0.3 * jax.random.normal(jax.random.key(2), (16, 14))
    A = lx.IdentityLinearOperator(jax.ShapeDtypeStruct(image.shape, image.dtype))
    solver = ADMM(600, sparsity=0.0, tv=0.4 / image.max(), isotropic=True)
    found = solve(A, image, solver)
    expected = denoise_tv_chambolle(np.asarray(image), weight=0.4, eps=1e-12, max_num_iter=20000)
    # Both converge sublinearly; Chambolle's is at about 1e-4 after so many.
    np.testing.assert_allclose(found.value, expected, atol=2e-3)
