from functools import cache

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from jax.test_util import check_grads
from skimage.restoration import denoise_tv_chambolle

from gs_jax.solvers.admm import ADMM
from gs_jax.solvers.base import differences, differences_adjoint, shrink, solve, total_variation
from gs_jax.solvers.convolution import Convolution, ConvolutionADMM
from gs_jax.solvers.fista import FISTA


def system(depths=1):
    psf = jax.random.uniform(jax.random.key(0), (depths, 5, 4))
    convolution = Convolution.of(psf, (12, 10))
    scene = jnp.zeros(convolution.scene_shape).at[0, 5:8, 4:7].set(1.0).at[-1, 9, 9].set(2.0)
    noise = 0.2 * jax.random.normal(jax.random.key(1), convolution.image_shape)
    return convolution, convolution(scene) + noise


def weights(convolution, image, **absolute):
    """Of a solver, whose unit is the largest voxel of the adjoint's scene."""
    unit = convolution.operator.T.mv(image).max()
    return {name: weight / unit for name, weight in absolute.items()}


def objective(convolution, image, x, *, tv, l1, isotropic=False):
    residual = convolution(x) - image
    variation = total_variation(differences(x, wrap=True), isotropic=isotropic)
    return jnp.vdot(residual, residual) / 2 + tv * variation + l1 * jnp.sum(x)


def numpy_admm(psf, image, steps, tv, l1, penalties=(1.0, 1.0, 1.0)):
    """DiffuserCam's ADMM for one depth, written out: complex FFTs, three splits, multipliers and penalties."""
    r, s, t = penalties
    shape = [n + k - 1 for n, k in zip(image.shape, psf.shape, strict=True)]
    corner = [(n - m) // 2 for n, m in zip(shape, image.shape, strict=True)]
    place = slice(corner[0], corner[0] + image.shape[0]), slice(corner[1], corner[1] + image.shape[1])
    kernel = np.zeros(shape)
    kernel[: psf.shape[0], : psf.shape[1]] = psf
    kernel = np.fft.fft2(np.roll(kernel, [-(k // 2) for k in psf.shape], (0, 1)))
    forward = lambda x: np.fft.ifft2(kernel * np.fft.fft2(x)).real
    adjoint = lambda x: np.fft.ifft2(kernel.conj() * np.fft.fft2(x)).real
    step = lambda x: np.stack([np.roll(x, -1, 0) - x, np.roll(x, -1, 1) - x])
    step_adjoint = lambda u: np.roll(u[0], 1, 0) - u[0] + np.roll(u[1], 1, 1) - u[1]
    point = np.zeros(shape)
    point[0, 0] = 1
    inverse = 1 / (r * np.abs(kernel) ** 2 + s * np.fft.fft2(step_adjoint(step(point))).real + t)
    seen, data = np.zeros(shape), np.zeros(shape)
    seen[place], data[place] = 1, image
    x = v = w = a = c = np.zeros(shape)
    u = b = np.zeros((2, *shape))
    for _ in range(steps):
        v = (data + r * (forward(x) + a)) / (seen + r)
        u = np.sign(d := step(x) + b) * np.maximum(np.abs(d) - tv / s, 0)
        w = np.maximum(x + c - l1 / t, 0)
        a, b, c = a + forward(x) - v, b + step(x) - u, c + x - w
        target = r * adjoint(v - a) + s * step_adjoint(u - b) + t * (w - c)
        x = np.fft.ifft2(inverse * np.fft.fft2(target)).real
    w = np.maximum(x, 0)
    residual = forward(w)[place] - image
    return w, (residual**2).sum() / 2 + tv * np.abs(step(w)).sum() + l1 * w.sum()


@pytest.mark.parametrize("wrap", [False, True])
def test_differences_and_their_adjoint(wrap):
    x = jax.random.normal(jax.random.key(0), (3, 1, 5))
    d = differences(x, wrap=wrap)
    end = x[:1] if wrap else x[-1:]
    np.testing.assert_array_equal(d[0], np.diff(x, axis=0, append=end))
    assert d.shape == (2, 3, 1, 5)  # nothing along an axis of 1
    u = jax.random.normal(jax.random.key(1), d.shape)
    np.testing.assert_allclose(jnp.vdot(d, u), jnp.vdot(x, differences_adjoint(u, wrap=wrap)), rtol=1e-12)
    assert differences(jnp.ones((1, 1, 1)), wrap=wrap).shape == (0, 1, 1, 1)


@pytest.mark.parametrize("isotropic", [False, True])
def test_shrinking_is_the_proximal_map(isotropic):
    """Moreau: what is taken away lies in the dual ball, and touches it where something is left."""
    u = jax.random.normal(jax.random.key(0), (2, 4, 5, 6))
    left = shrink(u, 0.7, isotropic=isotropic)
    taken, size = u - left, lambda v: jnp.sqrt(jnp.sum(v**2, axis=0)) if isotropic else jnp.abs(v)
    assert size(taken).max() <= 0.7 + 1e-12
    np.testing.assert_allclose(size(taken)[size(left) > 0], 0.7, rtol=1e-12)
    np.testing.assert_allclose(jnp.vdot(taken, left), 0.7 * total_variation(left, isotropic=isotropic), rtol=1e-12)
    gradient = jax.grad(lambda u: shrink(u, 0.7, isotropic=isotropic).sum())(jnp.zeros_like(u))
    assert not np.any(gradient)


@pytest.mark.integration
def test_the_cost_is_that_of_a_plain_numpy_version():
    convolution, image = system()
    psf = jax.random.uniform(jax.random.key(0), (1, 5, 4))
    x, expected = numpy_admm(np.asarray(psf[0]), np.asarray(image), 4000, 0.05, 0.1)
    solver = ConvolutionADMM(4000, **weights(convolution, image, tv=0.05, sparsity=0.1))
    found = jax.jit(lambda b: solve(convolution, b, solver))(image)
    np.testing.assert_allclose(objective(convolution, image, found.x, tv=0.05, l1=0.1), expected, rtol=1e-8)
    np.testing.assert_allclose(found.costs[-1], expected, rtol=1e-8)
    # The scenes differ in size by a margin that reaches no pixel and stays dark.
    np.testing.assert_allclose(found.x.sum(), x.sum(), rtol=1e-6)


@pytest.mark.integration
@pytest.mark.parametrize("depths", [1, 2])
def test_ffts_conjugate_gradients_and_fista_meet(depths):
    """Sparsity alone, which all three can."""
    convolution, image = system(depths)
    sparse = weights(convolution, image, sparsity=0.2)
    run = lambda A, solver: jax.jit(lambda b: solve(A, b, solver))(image).x
    by_fft = run(convolution, ConvolutionADMM(3000, **sparse))
    by_cg = run(convolution.operator, ADMM(500, **sparse))
    by_fista = run(convolution.operator, FISTA(1000, **sparse))
    costs = [objective(convolution, image, x, tv=0.0, l1=0.2) for x in (by_fft, by_cg, by_fista)]
    np.testing.assert_allclose(costs, costs[-1], rtol=1e-8)


@pytest.mark.integration
@pytest.mark.parametrize("tv", [0.0, 0.01])
def test_few_applications_of_the_operator_reach_the_minimum(tv):
    """Fewer equations than unknowns, as of a volume. FISTA's power method is not counted."""
    A = lx.MatrixLinearOperator(jax.random.uniform(jax.random.key(0), (60, 120)))
    scene = jnp.zeros(120).at[jnp.array([3, 20, 21, 50])].set(1.0)
    image = A.mv(scene) + 0.05 * jax.random.normal(jax.random.key(1), (60,))
    unit = A.T.mv(image).max()

    def final(solver):
        x = jax.jit(lambda b: solve(A, b, solver).x)(image)
        residual = A.mv(x) - image
        variation = total_variation(differences(x, wrap=False), isotropic=False)
        return float(jnp.vdot(residual, residual) / 2 + unit * (tv * variation + 0.01 * jnp.sum(x)))

    found, least = (final(ADMM(steps, sparsity=0.01, tv=tv)) for steps in (20, 2000))
    assert found < 1.03 * least
    if not tv:
        assert found < 0.8 * final(FISTA(60, sparsity=0.01))
        np.testing.assert_allclose(least, final(FISTA(2000, sparsity=0.01)), rtol=1e-6)


@cache
def minimum(depths, isotropic):
    convolution, image = system(depths)
    solver = ConvolutionADMM(4000, isotropic=isotropic, **weights(convolution, image, tv=0.05, sparsity=0.02))
    return jax.jit(lambda b: solve(convolution, b, solver))(image)


@pytest.mark.integration
@pytest.mark.parametrize("isotropic", [False, True])
@pytest.mark.parametrize("depths", [1, 2])
def test_total_variation_is_at_its_minimum(isotropic, depths):
    """No direction leads down: random ones, toward the dark, and toward the solution of the other kind."""
    convolution, image = system(depths)
    found = minimum(depths, isotropic)
    cost = lambda x: float(objective(convolution, image, x, tv=0.05, l1=0.02, isotropic=isotropic))
    best = cost(found.x)
    noise = jax.random.normal(jax.random.key(3), (10, *found.x.shape))
    others = [found.x * 0.99, minimum(depths, not isotropic).x, *(jnp.maximum(found.x + 1e-3 * n, 0) for n in noise)]
    assert min(map(cost, others)) > best
    np.testing.assert_allclose(found.costs[-1], best, rtol=1e-6)


def test_isotropic_total_variation_denoises_as_scikit_image_does():
    """The identity as operator; Chambolle's dual method, without wrapping, is what scikit-image has."""
    image = 3 + jnp.zeros((16, 14)).at[4:9, 5:11].set(2.0) + 0.3 * jax.random.normal(jax.random.key(2), (16, 14))
    A = lx.IdentityLinearOperator(jax.ShapeDtypeStruct(image.shape, image.dtype))
    solver = ADMM(600, sparsity=0.0, tv=0.4 / image.max(), isotropic=True)
    found = jax.jit(lambda b: solve(A, b, solver))(image)
    expected = denoise_tv_chambolle(np.asarray(image), weight=0.4, eps=1e-12, max_num_iter=20000)
    # Both converge sublinearly; Chambolle's is at about 1e-4 after so many.
    np.testing.assert_allclose(found.x, expected, atol=2e-3)


@pytest.mark.integration
def test_the_penalty_finds_its_way_and_the_residuals_stop_it():
    convolution, image = system()
    solver = ConvolutionADMM(3000, tolerance=1e-5, **weights(convolution, image, tv=0.05, sparsity=0.1))
    run = jax.jit(lambda b, s: solve(convolution, s * b, solver))
    for scale in (1e-3, 1e3):
        found = run(image, scale)
        assert found.converged and found.steps < 2000
        cost = objective(convolution, scale * image, found.x, tv=0.05 * scale, l1=0.1 * scale) / scale**2
        np.testing.assert_allclose(cost, found.costs[found.steps - 1] / scale**2, rtol=1e-3)


@pytest.mark.integration
def test_gradients():
    convolution, image = system()
    psf = jax.random.uniform(jax.random.key(0), (1, 5, 4))
    weight = jax.random.normal(jax.random.key(7), convolution.scene_shape)

    def moment(psf, image, tv):
        system = Convolution.of(psf, image.shape)
        return jnp.vdot(weight, solve(system, image, ConvolutionADMM(4, tv=tv, isotropic=True)).x)

    # Away from the kinks of soft thresholding at this generic point.
    tv = jnp.asarray(weights(convolution, image, tv=0.05)["tv"])
    check_grads(jax.jit(moment), (psf, image, tv), order=1, eps=1e-6, atol=1e-5, rtol=1e-5)


@pytest.mark.integration
@pytest.mark.parametrize("isotropic", [False, True])
def test_a_dark_image_gives_zeros(isotropic):
    convolution, image = system(2)
    run = lambda b: solve(convolution, b, ConvolutionADMM(5, tv=0.1, isotropic=isotropic))
    found = jax.jit(run)(0 * image)
    assert not np.any(found.x) and not np.any(found.costs)
    gradient = jax.jit(jax.grad(lambda b: run(b).x.sum()))(0 * image)
    assert np.all(np.isfinite(gradient))


def test_low_frequencies_do_not_outweigh_what_is_known_of_the_scene():
    """A diffuser's lowest are many times as strong as the rest: one penalty for all brings in the scene slowly.

    LenslessPiCam's constant penalties, too, are beaten by far after so few steps.
    """
    psf = jax.random.uniform(jax.random.key(0), (1, 32, 30))
    psf = psf / jnp.linalg.norm(psf)
    convolution = Convolution.of(psf, (32, 30))
    image = convolution(jnp.zeros(convolution.scene_shape).at[0, 20:40, 18:40].set(1.0))
    image = image / jnp.linalg.norm(image)
    solver = ConvolutionADMM(20, **weights(convolution, image, tv=1e-4, sparsity=0.0))
    x = jax.jit(lambda b: solve(convolution, b, solver))(image).x
    cost = objective(convolution, image, x, tv=1e-4, l1=0.0)
    for penalties in ((1.0, 1.0, 1.0), (1e-6, 1e-5, 4e-5)):
        assert 4 * cost < numpy_admm(np.asarray(psf[0]), np.asarray(image), 20, 1e-4, 0.0, penalties)[1]
