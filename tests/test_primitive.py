"""A linear function with given derivatives, under all that JAX does to it: the registration is JAX's to change."""

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from jax.test_util import check_grads

from gs_jax.projection.linear_map import linear_call

SCALE, MATRIX = 3, jax.random.normal(jax.random.key(0), (4, 3))
X, Y = jnp.array([1.0, -2.0, 0.5]), jnp.array([0.3, 1.0, -1.0, 2.0])


def times(scale, matrix, x):
    return scale * matrix @ x


def times_transpose(scale, matrix, y):
    return scale * matrix.T @ y


def matrix_bar(scale, matrix, x, y):
    return scale * jnp.outer(y, x)


def product(matrix, x):
    return linear_call(times, times_transpose, matrix_bar, SCALE, matrix, x)


def plain(matrix, x):
    return SCALE * matrix @ x


@pytest.mark.parametrize("compiled", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_values_derivatives_and_transpose_are_those_of_a_plain_function(compiled):
    tangents = (jnp.cos(MATRIX), jnp.sin(X))
    for transformed in (
        lambda f: compiled(f)(MATRIX, X),
        lambda f: compiled(lambda *both: jax.jvp(f, both, tangents))(MATRIX, X),
        lambda f: compiled(jax.jacrev(f, (0, 1)))(MATRIX, X),
        lambda f: compiled(jax.jacfwd(f, (0, 1)))(MATRIX, X),
        lambda f: compiled(jax.linear_transpose(lambda x: f(MATRIX, x), X))(Y),
        lambda f: compiled(jax.linear_transpose(jax.linear_transpose(lambda x: f(MATRIX, x), X), Y))((X,)),
        lambda f: compiled(jax.grad(lambda m: (jax.linear_transpose(lambda x: f(m, x), X)(Y)[0] ** 2).sum()))(MATRIX),
    ):
        given, derived = jax.tree.leaves(transformed(product)), jax.tree.leaves(transformed(plain))
        for a, b in zip(given, derived, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12)
    check_grads(product, (MATRIX, X), order=1)


@pytest.mark.parametrize("axes", [(None, 0), (0, None), (0, 0), (2, 1)])
def test_vmap_over_any_argument(axes):
    count = 5
    each = [
        a if axis is None else jnp.stack([a * (i + 1) for i in range(count)], axis)
        for a, axis in zip((MATRIX, X), axes, strict=True)
    ]
    np.testing.assert_allclose(jax.vmap(product, axes)(*each), jax.vmap(plain, axes)(*each), rtol=1e-12)
    loss = lambda f: lambda *both: (jax.vmap(f, axes)(*both) ** 2).sum()
    for a, b in zip(jax.grad(loss(product), (0, 1))(*each), jax.grad(loss(plain), (0, 1))(*each), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


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
    for derive in (
        lambda f: jax.hessian(f, (0, 1))(*both),
        lambda f: jax.jacrev(jax.grad(f, (0, 1)), (0, 1))(*both),
        lambda f: jax.jvp(jax.grad(f, (0, 1)), both, both)[1],
        lambda f: jax.jit(jax.grad(lambda m: jnp.sum(jax.grad(f)(m, X) ** 2)))(MATRIX),
    ):
        ours, theirs = jax.tree.leaves(derive(loss(product))), jax.tree.leaves(derive(loss(plain)))
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)
