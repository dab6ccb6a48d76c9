import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

from gs_jax import backproject, backproject_adjoint, forward_operator

from .helpers import scene


def test_transpose_is_backprojection():
    imager, grid = scene()
    image = jax.random.normal(jax.random.key(0), imager.sensor.shape)
    volume = jax.random.normal(jax.random.key(1), (3, *grid.shape))
    operator = forward_operator(imager, grid)
    np.testing.assert_array_equal(operator.mv(volume), backproject_adjoint(volume, imager, grid))
    np.testing.assert_array_equal(operator.T.mv(image), backproject(image, imager, grid))
    np.testing.assert_array_equal(operator.T.T.mv(volume), operator.mv(volume))


@pytest.mark.integration
def test_it_composes_and_solves():
    """Regularised least squares by conjugate gradients, as ADMM will do, against the dense solution."""
    imager, grid = scene(voxels=(5, 4), pitch=0.2, depths=(20.0,))
    image = jax.random.normal(jax.random.key(0), imager.sensor.shape)

    @jax.jit
    def solve(image, imager):
        operator = forward_operator(imager, grid)
        damping = lx.IdentityLinearOperator(operator.in_structure())
        normal = lx.TaggedLinearOperator(operator.T @ operator + 0.1 * damping, lx.positive_semidefinite_tag)
        return lx.linear_solve(normal, operator.T.mv(image), lx.CG(rtol=1e-12, atol=1e-12)).value

    columns = jax.vmap(lambda e: forward_operator(imager, grid).mv(e.reshape(1, 5, 4)).ravel())(jnp.eye(20))
    expected = np.linalg.solve(columns @ columns.T + 0.1 * np.eye(20), columns @ image.ravel())
    np.testing.assert_allclose(solve(image, imager).ravel(), expected, rtol=1e-8)

    # and it has a gradient by the geometry, through the solver
    at = lambda v: eqx.tree_at(lambda moved: moved.sensor_distance, imager, v)
    total = lambda v: jnp.sum(solve(image, at(v)) ** 2)
    v, step = imager.sensor_distance, 1e-6
    numeric = (total(v + step) - total(v - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(total)(v), numeric, rtol=1e-4)
