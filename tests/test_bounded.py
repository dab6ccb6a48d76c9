import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize, rosen

from gs_jax.codesign.bounded import minimise_within, proximal_gradient


def rosenbrock(x):
    return jnp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


def test_bounds_as_in_scipy():
    """Rosenbrock's valley, cut by the bounds before its minimum."""
    start, lower, upper = np.full(4, -0.5), np.array([-1.0, -1, 0.3, -1]), np.array([0.8, 0.6, 2, 0.2])
    expected = minimize(
        rosen, np.clip(start, lower, upper), method="L-BFGS-B", bounds=list(zip(lower, upper, strict=True)), tol=1e-14
    )
    x, value, steps, converged = minimise_within(
        rosenbrock, jnp.asarray(start), jnp.asarray(lower), jnp.asarray(upper), steps=200, tolerance=1e-8
    )
    assert converged and steps < 200
    np.testing.assert_allclose(value, expected.fun, rtol=1e-8)
    # A gradient of 1e-8 over a curvature of 1 and more; SciPy's ends at about 1e-6.
    np.testing.assert_allclose(x, expected.x, atol=1e-5)


def test_infinite_bounds_pytrees_and_running_out_of_steps():
    objective = lambda p: jnp.sum((p["a"] - 3) ** 2) + jnp.sum((p["b"] + 1) ** 4)
    start = {"a": jnp.zeros(2), "b": jnp.zeros(3)}
    everywhere = jax.tree.map(lambda x: jnp.full_like(x, jnp.inf), start)
    nowhere = jax.tree.map(jnp.negative, everywhere)
    x, value, _, converged = minimise_within(objective, start, nowhere, everywhere, steps=100, tolerance=1e-6)
    assert converged and value < 1e-6
    np.testing.assert_allclose(x["a"], 3, atol=1e-5)
    _, _, steps, converged = minimise_within(objective, start, nowhere, everywhere, steps=2, tolerance=1e-12)
    assert steps == 2 and not converged


@pytest.mark.parametrize("jit", [False, True])
def test_proximal_gradient_finds_the_lasso(jit):
    """For an orthogonal matrix the lasso has a closed form: soft thresholding."""
    Q = jnp.linalg.qr(jax.random.normal(jax.random.key(0), (6, 6)))[0]
    b = jax.random.normal(jax.random.key(1), (6,))
    shrink = lambda x, t: jnp.sign(x) * jnp.maximum(jnp.abs(x) - 0.3 * t, 0)
    run = lambda b: proximal_gradient(
        lambda x: jnp.sum((Q @ x - b) ** 2) / 2, shrink, jnp.zeros(6), steps=500, tolerance=1e-10
    )
    x, _, _, converged = (jax.jit(run) if jit else run)(b)
    assert converged
    np.testing.assert_allclose(x, shrink(Q.T @ b, 1.0), atol=1e-9)
