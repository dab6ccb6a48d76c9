"""A linear map with given derivatives, under all that JAX does to it: the registration is JAX's to change."""

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from jax.test_util import check_grads

from gs_jax.linear.linear_map import LinearMap

SCALE, MATRIX = 3, np.random.default_rng(0).normal(size=(4, 3))
X, Y = np.array([1.0, -2.0, 0.5]), np.array([0.3, 1.0, -1.0, 2.0])

_product = LinearMap(
    lambda scale, matrix, x: scale * matrix @ x,
    lambda scale, matrix, y: scale * matrix.T @ y,
    lambda scale, matrix, x, y: scale * jnp.outer(y, x),
)


def product(matrix, x):
    return _product(SCALE, matrix, x)


def plain(matrix, x):
    return SCALE * matrix @ x


def same(derive, compiled=jax.jit, rtol=1e-12, atol=0.0):
    """Whether `derive` gives the same for both."""
    results = compiled(lambda: derive(product))(), jax.jit(lambda: derive(plain))()
    for a, b in zip(*map(jax.tree.leaves, results), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=atol)


@pytest.mark.parametrize("compiled", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_values_derivatives_and_transpose_are_those_of_a_plain_function(compiled):
    tangents = (np.cos(MATRIX), np.sin(X))
    transpose = lambda f, m=MATRIX: jax.linear_transpose(lambda x: f(m, x), X)

    def derivatives(f):
        yield f(MATRIX, X)
        yield jax.jvp(f, (MATRIX, X), tangents)
        yield jax.jacrev(f, (0, 1))(MATRIX, X)
        yield jax.jacfwd(f, (0, 1))(MATRIX, X)
        yield transpose(f)(Y)
        yield jax.linear_transpose(transpose(f), Y)((X,))
        yield jax.grad(lambda m: (transpose(f, m)(Y)[0] ** 2).sum())(MATRIX)

    same(lambda f: list(derivatives(f)), compiled)
    check_grads(compiled(product), (MATRIX, X), order=1)


def test_types_are_those_of_the_precision_that_is_enabled():
    widest = LinearMap(lambda _, none, x: x.astype(float), lambda _, none, y: y.astype(np.float32))
    shape = jax.ShapeDtypeStruct((3,), np.float32)
    for double in (False, True, False):
        with jax.enable_x64(double):
            assert jax.eval_shape(lambda x: widest(None, (), x), shape).dtype == (np.float64 if double else np.float32)


def test_vmap_over_any_argument():
    def derivatives(f):
        for axes in ((None, 0), (0, None), (0, 0), (2, 1)):
            batch = [
                a if axis is None else np.stack([a * (i + 1) for i in range(5)], axis)
                for a, axis in zip((MATRIX, X), axes, strict=True)
            ]
            yield jax.vmap(f, axes)(*batch)
            yield jax.grad(lambda *both, axes=axes: (jax.vmap(f, axes)(*both) ** 2).sum(), (0, 1))(*batch)

    same(lambda f: list(derivatives(f)))


def test_it_is_an_operator_that_is_solved_with():
    operator = lx.FunctionLinearOperator(lambda x: product(MATRIX, x), jax.ShapeDtypeStruct(X.shape, X.dtype))
    np.testing.assert_allclose(operator.as_matrix(), SCALE * MATRIX, rtol=1e-12)
    np.testing.assert_allclose(operator.T.mv(Y), SCALE * MATRIX.T @ Y, rtol=1e-12)
    normal = lx.TaggedLinearOperator(operator.T @ operator, lx.positive_semidefinite_tag)
    solution = lx.linear_solve(normal, operator.T.mv(Y), lx.CG(rtol=1e-12, atol=1e-12)).value
    np.testing.assert_allclose(solution, np.linalg.lstsq(SCALE * MATRIX, Y)[0], rtol=1e-9)


def test_second_derivatives_are_those_of_a_plain_function():
    loss = lambda f: lambda m, x: jnp.sum(f(jnp.sin(m), x) ** 3)
    both = (MATRIX, X)

    def derivatives(f):
        yield jax.hessian(loss(f), (0, 1))(*both)
        yield jax.jacrev(jax.grad(loss(f), (0, 1)), (0, 1))(*both)
        yield jax.jvp(jax.grad(loss(f), (0, 1)), both, both)[1]
        yield jax.jit(jax.grad(lambda m: jnp.sum(jax.grad(loss(f))(m, X) ** 2)))(MATRIX)

    same(lambda f: list(derivatives(f)), rtol=1e-10, atol=1e-12)
