import dataclasses
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.ndimage import gaussian_filter
from scipy.sparse.linalg import lsmr

from gs_jax import (
    BackprojectionOperator,
    Grid,
    Imager,
    ImagingOperator,
    MicrolensArray,
    Sensor,
    backproject,
    backproject_adjoint,
)
from gs_jax.base.errors import InputError
from gs_jax.interop import as_deepinv, as_scico, as_scipy
from gs_jax.optics.field_varying import field_varying_psf

from . import test_full
from .helpers import scene


def random_pair(A):
    """A random input and a random output."""
    rng = np.random.default_rng(0)
    return (jnp.asarray(rng.normal(size=s.shape).astype(s.dtype)) for s in (A.in_structure(), A.out_structure()))


def test_transpose_is_backprojection():
    imager, grid = scene()
    A = ImagingOperator(imager, grid)
    volume, image = random_pair(A)
    np.testing.assert_array_equal(A.mv(volume), backproject_adjoint(volume, imager, grid))
    # Another program, which may round differently.
    expected = np.asarray(backproject(image, imager, grid))
    np.testing.assert_allclose(A.T.mv(image), expected, rtol=1e-12, atol=1e-14 * np.abs(expected).max())
    np.testing.assert_array_equal(A.T.T.mv(volume), A.mv(volume))
    # Integers and half precision are numbers of the operator's type; what is imaginary would be lost.
    counts = np.asarray(np.abs(10 * image), np.uint8)
    for numbers in (counts, counts.astype(np.float16)):
        np.testing.assert_array_equal(A.T.mv(numbers), A.T.mv(counts.astype(float)))
    half = backproject(counts.astype(np.float16), imager, grid)
    assert half.dtype == image.dtype
    np.testing.assert_allclose(half, backproject(counts.astype(float), imager, grid), rtol=1e-12, atol=1e-12)
    for call in (A.T.mv, lambda wrong: backproject(wrong, imager, grid)):
        with pytest.raises(InputError, match="must be real, got complex128"):
            call(np.asarray(image) * 1j)


@pytest.mark.integration
def test_it_composes_and_solves():
    """Regularised least squares by conjugate gradients, as ADMM will do, against the dense solution."""
    imager, grid = scene(voxels=(5, 4), pitch=0.2, depths=(20.0,))
    image = jnp.asarray(np.random.default_rng(0).normal(size=imager.sensor.shape))

    @jax.jit
    def solve(image, imager):
        operator = ImagingOperator(imager, grid)
        damping = lx.IdentityLinearOperator(operator.in_structure())
        normal = lx.TaggedLinearOperator(operator.T @ operator + 0.1 * damping, lx.positive_semidefinite_tag)
        return lx.linear_solve(normal, operator.T.mv(image), lx.CG(rtol=1e-12, atol=1e-12)).value

    columns = jax.vmap(lambda e: ImagingOperator(imager, grid).mv(e.reshape(1, 5, 4)).ravel())(jnp.eye(20))
    expected = np.linalg.solve(columns @ columns.T + 0.1 * np.eye(20), columns @ image.ravel())
    np.testing.assert_allclose(solve(image, imager).ravel(), expected, rtol=1e-8)

    # and it has a gradient by the geometry, through the solver
    at = lambda v: eqx.tree_at(lambda moved: moved.sensor_distance, imager, v)
    total = lambda v: jnp.sum(solve(image, at(v)) ** 2)
    v, step = imager.sensor_distance, 1e-6
    numeric = (total(v + step) - total(v - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(total)(v), numeric, rtol=1e-4)


def of_two_types() -> Imager:
    radii = np.array([2.0, 2.2, 2.0, 2.2, 2.0, 2.2, 2.0, 2.2, 2.0])
    level = test_full.imager()
    return dataclasses.replace(level, array=dataclasses.replace(level.array, radius_of_curvature=radii))


def of_sharp_lenses(tilt=None) -> ImagingOperator:
    """Cores with harmonics: two lenses with the curved side in front, on a region of the sensor."""
    lens = test_full.alone("geomscope-asphere", Sensor((40, 60), 0.02, (-0.3, -0.2)))
    array = dataclasses.replace(lens.array, centers=jnp.array([[0.0, 0.0], [0.9, 0.4]]))
    imager, grid = dataclasses.replace(lens, array=array, tilt=tilt), Grid([19.0, 21.0], (4, 5), 0.5, (2.6, 1.4))
    optics = field_varying_psf(imager, grid.depths)
    assert optics.harmonics.size + optics.wide_harmonics.size > 0
    return ImagingOperator(imager, grid, optics)


def of_full_model(inner: int, **sensor) -> ImagingOperator:
    """Six rings, of which some are on the sensor's pixels."""
    imager, grid = test_full.imager(**sensor), test_full.grid(shape=(6, 5))
    optics = field_varying_psf(imager, grid.depths)
    assert (optics.kernels.shape[1], optics.wide_kernels.shape[1]) == (inner, 6 - inner)
    return ImagingOperator(imager, grid, optics)


def of_kernels() -> ImagingOperator:
    imager, grid = scene()
    kernels = np.random.default_rng(1).uniform(0.1, 1, (3, 5, 5))
    return ImagingOperator(imager, grid, jnp.asarray(kernels / kernels.sum((1, 2), keepdims=True)))


OPERATORS = {
    "pinholes": lambda: ImagingOperator(*scene()),
    "tilted": lambda: ImagingOperator(dataclasses.replace(scene()[0], tilt=(0.015, -0.02)), scene()[1]),
    "kernels": of_kernels,
    "near": lambda: ImagingOperator(*scene(), "near"),
    "full": lambda: ImagingOperator(*scene(), "full"),
    "full, large pixels": lambda: of_full_model(5),
    "full, small pixels": lambda: of_full_model(1, pixels=(80, 80), pitch=0.0045),
    "full, sharp": of_sharp_lenses,
    "full, sharp, tilted": lambda: of_sharp_lenses((0.01, -0.006)),
    "two types, near": lambda: ImagingOperator(of_two_types(), test_full.grid(shape=(7, 6)), "near"),
    "two types, full": lambda: ImagingOperator(of_two_types(), test_full.grid(shape=(7, 6)), "full"),
    "back-projection": lambda: BackprojectionOperator(*scene()),
    "normalized": lambda: BackprojectionOperator(*scene(), normalize=True),
}
FAST = "pinholes", "kernels"
CASES = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in FAST else pytest.mark.integration) for name in OPERATORS]
)
operator = cache(lambda name: OPERATORS[name]())


@CASES
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_transpose_is_the_adjoint_and_maps_over_batches(name, dtype):
    A = jax.tree.map(lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf, operator(name))
    x, y = random_pair(A)
    assert A.T.in_structure() == A.out_structure() and A.T.T.out_structure() == A.out_structure()

    @eqx.filter_jit
    def both_ways(A, x, y):
        there = A.mv(x)
        return there, A.T.mv(y), jax.vmap(A.mv)(jnp.stack([x, 2 * x]))

    there, back, batch = map(np.asarray, both_ways(A, x, y))
    rounding = 1e-5 if dtype == np.float32 else 1e-12
    assert there.dtype == back.dtype == dtype and there.any()
    tolerance = 0.1 * rounding * float(np.linalg.norm(there) * np.linalg.norm(y))
    np.testing.assert_allclose(np.vdot(there, y), np.vdot(x, back), rtol=0, atol=tolerance)
    np.testing.assert_allclose(batch, np.stack([there, 2 * there]), atol=rounding * float(np.abs(batch).max()))


@CASES
def test_gradients_by_the_input_and_the_microscope(name):
    """Against differences; in the dark they are finite."""
    A, rng = operator(name), np.random.default_rng(0)
    weights = gaussian_filter(rng.normal(size=A.out_structure().shape), 2)
    x = gaussian_filter(rng.normal(size=A.in_structure().shape), 1)
    numbers, rest = eqx.partition(A.imager, eqx.is_inexact_array)

    @jax.jit
    def value(x, numbers):
        return jnp.vdot(weights, dataclasses.replace(A, imager=eqx.combine(numbers, rest)).mv(x))

    # Interpolations have kinks: steps that are small beside a pixel.
    check_grads(value, (x, numbers), 1, modes=["rev"], eps=1e-7, rtol=1e-3)
    dark, back = jax.vjp(value, jnp.zeros(x.shape), numbers)
    assert dark == 0 and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(back(jnp.ones(()))))


TWICE = [name for name in OPERATORS if name in ("pinholes", "near", "full", "back-projection", "normalized")]


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in FAST else pytest.mark.integration) for n in TWICE])
def test_hessian_vector_products_are_differences_of_gradients(name):
    A, rng = operator(name), np.random.default_rng(0)
    truth, weights = (gaussian_filter(rng.normal(size=A.out_structure().shape), 2) for _ in range(2))
    x = gaussian_filter(rng.normal(size=A.in_structure().shape), 1)

    def loss(centers, v):
        at = lambda A: (A.imager.array.centers, A.imager.sensor_distance)
        return jnp.sum(weights * (eqx.tree_at(at, A, (centers, v)).mv(x) - truth) ** 2)

    at = A.imager.array.centers, A.imager.sensor_distance
    along = 0.1 * rng.normal(size=at[0].shape), np.array(0.05)
    gradient = jax.jit(jax.grad(loss, (0, 1)))
    product = jax.jvp(gradient, at, along)[1]
    ends = [gradient(*(np.asarray(a) + step * b for a, b in zip(at, along, strict=True))) for step in (1e-7, -1e-7)]
    for ours, ahead, behind in zip(product, *ends, strict=True):
        numeric = (np.asarray(ahead) - np.asarray(behind)) / 2e-7
        np.testing.assert_allclose(ours, numeric, rtol=1e-4, atol=1e-5 * np.abs(numeric).max())


@pytest.mark.integration
def test_second_derivatives_are_those_of_reverse_passes_too():
    imager, grid = scene(voxels=(5, 4), pitch=0.2, depths=(20.0,))
    image = jnp.asarray(gaussian_filter(np.random.default_rng(0).random(imager.sensor.shape), 3))

    def loss(v):
        return jnp.sum(backproject(image, eqx.tree_at(lambda i: i.sensor_distance, imager, v), grid) ** 2)

    check_grads(loss, (imager.sensor_distance,), order=2, modes=["fwd", "rev"], eps=1e-5, rtol=1e-4)


def test_nothing_is_seen():
    """By lenses that are far away: no light, and gradients that are finite."""
    imager, grid = scene()
    far = dataclasses.replace(imager, array=MicrolensArray([[50.0, 0.0], [50.0, 0.0]]))
    total = lambda i: jnp.sum(backproject(np.ones(i.sensor.shape), i, grid, normalize=True) ** 2)
    value, gradient = jax.jit(jax.value_and_grad(total))(far)
    assert value == 0 and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_materialised_it_still_takes_volumes():
    A = ImagingOperator(*scene(voxels=(5, 4), pitch=0.2, depths=(20.0,)))
    x, y = random_pair(A)
    dense = lx.materialise(A)
    np.testing.assert_allclose(dense.mv(x), A.mv(x), atol=1e-12)
    np.testing.assert_allclose(dense.T.mv(y), A.T.mv(y), atol=1e-12)
    assert A.as_matrix().shape == (y.size, x.size) and A.T.as_matrix().shape == (x.size, y.size)


def test_it_is_an_argument_that_compiles_once():
    imager, grid = scene()
    image, traced = np.ones(imager.sensor.shape), []

    @eqx.filter_jit
    def loss(A, image):
        traced.append(A)
        return jnp.sum(A.T.mv(image) ** 2)

    step = eqx.filter_jit(eqx.filter_value_and_grad(loss))
    for v in (5.8, 5.9, 6.0):
        moved = eqx.tree_at(lambda i: i.sensor_distance, imager, jnp.asarray(v))
        _, slope = step(ImagingOperator(moved, grid), image)
        found = np.asarray(slope.imager.array.centers)
        assert np.isfinite(found).all() and found.any()
    assert len(traced) == 1


def test_scipy_solves_with_it():
    A = ImagingOperator(*scene(voxels=(5, 4), pitch=0.2, depths=(20.0,)))
    B, (x, y) = as_scipy(A), (np.ravel(a) for a in random_pair(A))
    assert np.vdot(B @ x, y) == pytest.approx(np.vdot(x, B.T @ y), rel=1e-12)
    # Some voxels are seen by no lens.
    seen = np.asarray(A.T.mv(jnp.asarray(np.ones(A.out_structure().shape)))).ravel() > 0
    np.testing.assert_allclose(lsmr(B, B @ x, atol=1e-13, btol=1e-13)[0][seen], x[seen], rtol=1e-8)


@pytest.mark.integration
def test_pylops_takes_it():
    pylops = pytest.importorskip("pylops", reason="no pylops: pip install pylops")
    assert pylops.utils.dottest(pylops.aslinearoperator(as_scipy(ImagingOperator(*scene()))))


@pytest.mark.integration
def test_scico_takes_it():
    pytest.importorskip("scico", reason="no scico: pip install scico")
    A = ImagingOperator(*scene(jnp.float32))
    (x, y), A = random_pair(A), as_scico(A)
    np.testing.assert_allclose(jnp.vdot(A(x), y), jnp.vdot(x, A.adj(y)), rtol=1e-4)


@pytest.mark.integration
def test_deepinv_takes_it():
    torch = pytest.importorskip("torch", reason="no PyTorch: pip install deepinv")
    pytest.importorskip("deepinv", reason="no deepinv: pip install deepinv")
    A = ImagingOperator(*scene(jnp.float32))
    physics, volume = as_deepinv(A), torch.rand(2, 1, *A.in_structure().shape, requires_grad=True)
    image = torch.rand(2, 1, *A.out_structure().shape)
    there, back = torch.vdot(physics.A(volume).ravel(), image.ravel()), physics.A_adjoint(image)
    torch.testing.assert_close(there, torch.vdot(volume.ravel(), back.ravel()))
    (slope,) = torch.autograd.grad(there, volume)
    torch.testing.assert_close(slope, back)
