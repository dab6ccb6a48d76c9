import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.ndimage import gaussian_filter
from scipy.sparse.linalg import lsmr

from gs_jax import BackprojectionOperator, ImagingOperator, backproject, backproject_adjoint, psf_model
from gs_jax.base.errors import InputError
from gs_jax.interop import as_deepinv, as_scico, as_scipy

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


OPERATORS = {
    "pinholes": lambda *scene: ImagingOperator(*scene),
    "near": lambda imager, grid: ImagingOperator(imager, grid, psf_model(imager, grid, "near")),
    "full": lambda imager, grid: ImagingOperator(imager, grid, psf_model(imager, grid, "full")),
    "back-projection": lambda *scene: BackprojectionOperator(*scene),
    "normalized": lambda *scene: BackprojectionOperator(*scene, normalize=True),
}
SLOW = [pytest.param(name, marks=pytest.mark.integration) for name in OPERATORS if name != "pinholes"]


@pytest.mark.parametrize("name", ["pinholes", *SLOW])
def test_the_transpose_is_the_adjoint_and_maps_over_batches(name):
    A = OPERATORS[name](*scene())
    x, y = random_pair(A)
    assert A.T.in_structure() == A.out_structure() and A.T.T.out_structure() == A.out_structure()
    there = np.asarray(A.mv(x))
    np.testing.assert_allclose(np.vdot(there, y), np.vdot(x, A.T.mv(y)), rtol=1e-9)
    both = np.stack([x, 2 * np.asarray(x)])
    np.testing.assert_allclose(jax.vmap(A.mv)(both), np.stack([there, 2 * there]), atol=1e-9)


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


@pytest.mark.parametrize("name", ["pinholes", *SLOW])
def test_hessian_vector_products_are_differences_of_gradients(name):
    imager, grid = scene()
    A = OPERATORS[name](imager, grid)
    rng = np.random.default_rng(0)
    truth, volume = (gaussian_filter(rng.normal(size=A.out_structure().shape), 2) for _ in range(2))
    x = gaussian_filter(rng.normal(size=A.in_structure().shape), 1)

    def loss(centers, v):
        where = lambda A: (A.imager.array.centers, A.imager.sensor_distance)
        return jnp.sum(volume * (eqx.tree_at(where, A, (centers, v)).mv(x) - truth) ** 2)

    at = imager.array.centers, imager.sensor_distance
    along = 0.1 * rng.normal(size=at[0].shape), np.array(0.05)
    gradient = jax.jit(jax.grad(loss, (0, 1)))
    product = jax.jvp(gradient, at, along)[1]
    step = 1e-7
    ends = [gradient(*(np.asarray(a) + sign * step * b for a, b in zip(at, along, strict=True))) for sign in (1, -1)]
    for ours, ahead, behind in zip(product, *ends, strict=True):
        numeric = (np.asarray(ahead) - np.asarray(behind)) / (2 * step)
        np.testing.assert_allclose(ours, numeric, rtol=1e-4, atol=1e-5 * np.abs(numeric).max())


@pytest.mark.integration
def test_second_derivatives_are_those_of_reverse_passes_too():
    imager, grid = scene(voxels=(5, 4), pitch=0.2, depths=(20.0,))
    image = jnp.asarray(gaussian_filter(np.random.default_rng(0).random(imager.sensor.shape), 3))

    def loss(v):
        return jnp.sum(backproject(image, eqx.tree_at(lambda i: i.sensor_distance, imager, v), grid) ** 2)

    check_grads(loss, (imager.sensor_distance,), order=2, modes=["fwd", "rev"], eps=1e-5, rtol=1e-4)


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
