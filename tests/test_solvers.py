"""The solvers, on every kind of operator."""

from functools import cache

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.optimize import nnls
from skimage.restoration import richardson_lucy as of_skimage

from gs_jax import Imager, MicrolensArray, backproject, forward, ray_operator
from gs_jax.solvers.admm import admm
from gs_jax.solvers.convolution import Convolution
from gs_jax.solvers.fista import fista, gradient_descent, largest_eigenvalue
from gs_jax.solvers.richardson_lucy import list_richardson_lucy, richardson_lucy

from .helpers import scene

SOLVERS = {"R-L": richardson_lucy, "FISTA": fista, "gradient descent": gradient_descent, "ADMM": admm}


def small():
    return scene(voxels=(8, 7), pitch=0.1, depths=(18.0, 20.0))


def dense():
    matrix = jax.random.uniform(jax.random.key(0), (30, 12))
    return lx.MatrixLinearOperator(matrix)


def blurred(imager, grid, dtype=jnp.float64):
    """The forward model with a PSF, which is not the adjoint of back-projection."""
    psf = jnp.broadcast_to(jnp.outer(w := jnp.array([0.25, 0.5, 0.25], dtype), w), (grid.depths.size, 3, 3))
    structure = jax.ShapeDtypeStruct((grid.depths.size, *grid.shape), dtype)
    return lx.FunctionLinearOperator(lambda volume: forward(volume, imager, grid, psf), structure)


def convolution():
    psf = jax.random.uniform(jax.random.key(3), (2, 5, 4))
    return Convolution.of(psf, (12, 10)).operator


OPERATORS = {
    "ray": lambda: ray_operator(*small()),
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
    return jax.jit(lambda image: SOLVERS[solver](made(operator), image, steps=150))


@pytest.mark.parametrize("operator", EVERY)
@pytest.mark.parametrize("solver", SOLVERS)
def test_it_finds_two_bright_voxels(solver, operator):
    A = made(operator)
    x = light(A)
    found = compiled(solver, operator)(A.mv(x))
    assert found.steps == 150 and not found.converged
    # Noiseless, but slow along the least eigenvalues: what matters is that the light is where it was.
    bright = np.argsort(np.asarray(found.x).ravel())[-2:]
    assert set(bright.tolist()) == set(np.flatnonzero(np.asarray(x)).tolist())
    assert np.all(np.isfinite(found.costs)) and found.costs[-1] < 0.05 * found.costs[0]


@pytest.mark.parametrize("operator", EVERY)
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_dark_image_gives_zeros(solver, operator):
    found = compiled(solver, operator)(jnp.zeros(made(operator).out_structure().shape))
    assert not np.any(found.x) and not np.any(found.costs)


@pytest.mark.parametrize("solver", SOLVERS)
def test_what_no_pixel_sees_stays_dark(solver):
    """An operator of zeros: nothing is known, and nothing is NaN."""
    A = lx.MatrixLinearOperator(jnp.zeros((30, 12)))
    found = jax.jit(lambda image: SOLVERS[solver](A, image, steps=5))(jnp.ones(30))
    assert not np.any(found.x)


@pytest.mark.parametrize("solver", SOLVERS)
def test_images_may_be_integers(solver):
    image = jnp.arange(30, dtype=jnp.uint16)
    run = jax.jit(lambda image: SOLVERS[solver](dense(), image, steps=5).x)
    np.testing.assert_array_equal(run(image), run(image.astype(float)))


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_dark_image_ends_it_in_float32(solver):
    A = lx.MatrixLinearOperator(dense().matrix.astype(jnp.float32))
    found = jax.jit(lambda image: SOLVERS[solver](A, image, steps=20, tolerance=1e-3))(jnp.zeros(30, jnp.float32))
    assert found.converged and found.x.dtype == jnp.float32 and not np.any(found.x)
    assert np.isnan(found.costs[found.steps :]).all() and not np.isnan(found.costs[: found.steps]).any()


def by_geometry():
    """The ray operator by what it is made of."""
    imager, grid = scene(voxels=(4, 3), pitch=0.2, depths=(18.0, 20.0))

    def operator(centers, v):
        return ray_operator(Imager(MicrolensArray(centers), imager.sensor, v, imager.field_radius), grid)

    return operator, (imager.array.centers, imager.sensor_distance)


# What makes an operator, and from what.
PARAMETRIC = {"dense": lambda: (lx.MatrixLinearOperator, (dense().matrix,)), "ray": by_geometry}
KINDS = ["dense", pytest.param("ray", marks=pytest.mark.slow)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("solver", SOLVERS)
def test_gradients_by_image_and_operator(solver, kind):
    """Through a fixed number of steps, once (the ray operator has no second derivative)."""
    operator, parameters = PARAMETRIC[kind]()
    A = operator(*parameters)
    row, column = jnp.meshgrid(*(jnp.arange(n, dtype=float) for n in (*A.out_structure().shape, 1)[:2]), indexing="ij")
    image = (2 + jnp.sin(row / 10) + jnp.cos(column / 12 + row / 15)).reshape(A.out_structure().shape)
    options = {"cg_steps": 3} if solver == "ADMM" else {}
    weight = jax.random.normal(jax.random.key(5), A.in_structure().shape)

    @jax.jit
    def moment(image, *parameters):
        return jnp.vdot(weight, SOLVERS[solver](operator(*parameters), image, steps=3, **options).x)

    # Steps of 1e-6 mm stay within a pixel at this generic point; rounding of 1e-13 then costs 1e-6.
    check_grads(moment, (image, *parameters), order=1, modes=["fwd", "rev"], eps=1e-6, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("solver", SOLVERS)
def test_gradients_stay_finite_in_the_dark(solver, kind):
    operator, parameters = PARAMETRIC[kind]()

    def total(image, parameters):
        return jnp.sum(SOLVERS[solver](operator(*parameters), image, steps=2).x)

    dark = jnp.zeros(operator(*parameters).out_structure().shape)
    value, gradient = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))(dark, parameters)
    assert value == 0 and all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("solver", SOLVERS)
def test_progress_and_an_early_end(solver):
    A = dense()
    told = []
    run = lambda image: SOLVERS[solver](A, image, steps=400, tolerance=0.02, callback=lambda *now: told.append(now))
    found = jax.block_until_ready(jax.jit(run)(A.mv(light(A))))
    jax.effects_barrier()
    assert found.converged and 1 < found.steps < 400
    assert sorted(int(number) for number, _ in told) == list(range(1, int(found.steps) + 1))
    costs = [float(cost) for _, cost in sorted(told, key=lambda now: int(now[0]))]
    np.testing.assert_array_equal(costs, found.costs[: found.steps])


@pytest.mark.parametrize("solver", ["FISTA", "gradient descent", "ADMM"])
def test_least_squares_without_negative_values_is_scipys(solver):
    """More equations than unknowns and noise: one solution, on the boundary."""
    A = dense()
    image = jax.random.normal(jax.random.key(2), (30,)) + 1
    expected = nnls(np.asarray(A.as_matrix()), np.asarray(image))[0]
    assert 0 < np.count_nonzero(expected) < 12
    found = jax.jit(lambda b: SOLVERS[solver](A, b, steps=3000))(image)
    np.testing.assert_allclose(found.x, expected, atol=1e-8)  # they converge linearly, to the last digits


def test_the_convex_solvers_meet_with_sparsity():
    A = dense()
    image = A.mv(light(A)) + 0.1 * jax.random.normal(jax.random.key(4), A.out_structure().shape)

    def final(solver, steps):
        x = jax.jit(lambda b: solver(A, b, steps=steps, l1=0.3))(image).x
        residual = A.mv(x) - image
        return float(jnp.vdot(residual, residual) / 2 + 0.3 * jnp.sum(x))

    costs = [final(fista, 1000), final(gradient_descent, 6000), final(admm, 1000)]
    np.testing.assert_allclose(costs, costs[0], rtol=1e-10)


def test_richardson_lucy_is_scikit_images():
    """Light in the middle: scikit-image assumes a sensitivity of 1, which holds a PSF's width from the edge."""
    rng = np.random.default_rng(0)
    psf = rng.random((5, 7))
    psf /= psf.sum()
    truth = np.zeros((40, 42))
    truth[12:28, 14:28] = rng.random((16, 14))
    system = Convolution.of(psf[None], truth.shape)
    embedded = jnp.zeros(system.scene_shape).at[(0, *system.place)].set(truth)
    image = np.maximum(np.asarray(system(embedded)), 0)
    image[image < 1e-12] = 0  # an FFT's rounding
    expected = of_skimage(image, psf, num_iter=25, clip=False)
    found = jax.jit(lambda b: richardson_lucy(system.operator, b, steps=25))(jnp.asarray(image))
    # The same iteration in exact arithmetic; 25 divisions amplify the rounding of the FFTs.
    np.testing.assert_allclose(found.x[0][system.place], expected, atol=1e-8)


def test_list_richardson_lucy_multiplies_by_mean_ratios():
    imager, grid = small()
    image = 1 + jax.random.uniform(jax.random.key(0), imager.sensor.shape)
    A = ray_operator(imager, grid)
    x = jnp.where(A.T.mv(jnp.ones_like(image)) > 0, 1.0, 0)
    for _ in range(3):
        expected = A.mv(x)
        ratio = jnp.where(expected > 0, image / jnp.where(expected > 0, expected, 1), 0)
        x = x * backproject(ratio, imager, grid, normalize=True)
    found = jax.jit(lambda image: list_richardson_lucy(image, imager, grid, steps=3))(image)
    np.testing.assert_allclose(found.x, x, rtol=1e-10)  # from another uniform start: its scale does not matter


def test_richardson_lucy_with_background_acceleration_and_total_variation():
    A = ray_operator(*small())
    truth = light(A)
    jitted = cache(lambda **options: jax.jit(lambda b: richardson_lucy(A, b, steps=40, **options)))
    run = lambda image, **options: jitted(**options)(image)
    image = A.mv(truth) + 0.5
    plain, known = run(image), run(image, background=0.5)
    assert jnp.abs(known.x - truth).max() < 0.05 < jnp.abs(plain.x - truth).max()
    fast = run(A.mv(truth), accelerate=True)
    assert fast.costs[-1] < 1e-3 * run(A.mv(truth)).costs[-1]
    rough = run(image + 0.3 * jax.random.uniform(jax.random.key(1), image.shape))
    smooth = run(image + 0.3 * jax.random.uniform(jax.random.key(1), image.shape), tv=0.05)
    variation = lambda s: sum(float(jnp.abs(jnp.diff(s.x, axis=axis)).sum()) for axis in range(3))
    assert variation(smooth) < 0.97 * variation(rough)


def test_richardson_lucy_climbs_and_keeps_the_light():
    A = dense()
    image = A.mv(light(A)) * jax.random.uniform(jax.random.key(6), (30,), minval=0.8, maxval=1.2)
    found = jax.jit(lambda b: richardson_lucy(A, b, steps=50))(image)
    assert np.all(np.diff(found.costs) <= 1e-12)
    # After each step the expected image holds as much light as the image (Lucy 1974).
    np.testing.assert_allclose(A.mv(found.x).sum(), image.sum(), rtol=1e-12)


def test_largest_eigenvalue():
    A = dense()
    expected = np.linalg.svd(np.asarray(A.as_matrix()), compute_uv=False)[0] ** 2
    # From below; Perron's eigenvalue stands far from the next here.
    np.testing.assert_allclose(largest_eigenvalue(A), expected, rtol=1e-10)


@pytest.mark.parametrize("solver", SOLVERS)
def test_wrong_arguments_are_named(solver):
    A = dense()
    with pytest.raises(ValueError, match=r"output shape \(30,\), got \(4,\)"):
        SOLVERS[solver](A, jnp.zeros(4), steps=1)
    with pytest.raises(ValueError, match="`steps` must be 1 or more, got 0"):
        SOLVERS[solver](A, jnp.zeros(30), steps=0)
    with pytest.raises(ValueError, match="`tolerance` must be 0 or more, got -1"):
        SOLVERS[solver](A, jnp.zeros(30), steps=1, tolerance=-1.0)
