"""Terms compared with their targets: residuals for solvers, rows for people."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gs_jax.base.errors import InputError
from gs_jax.codesign.study import Row, TermTable
from gs_jax.codesign.terms import Objective, Term, evaluate

KEY = jax.random.key(0)
# What stands for an imager here is an array, which the checked signatures would refuse.
RESIDUAL, EVALUATE = inspect.unwrap(Objective.residual), inspect.unwrap(evaluate)
ITSELF = Term("itself", lambda x, at: x)
EXPONENTIAL = Term("its exponential", lambda x, at: jnp.log(x), log=True)
X = np.array([1.0, 2.0, 4.0])


@eqx.filter_jit
def judged(objective, x, margin):
    """Residuals and their derivatives: a program for each kind of target."""
    residual = lambda x: RESIDUAL(objective, x, None, KEY, margin=margin)
    return residual(x), jax.jacrev(residual)(x)


def residuals(kind, x, margin=0.0, *, term=ITSELF, weight=1.0):
    return np.asarray(judged(Objective(term, kind, 2.0, weight), x, np.array(margin))[0])


@pytest.mark.parametrize(
    ("kind", "margin", "expected"),
    [
        ("at_most", 0.0, [0, 0, np.log(2)]),
        ("at_most", 0.1, [0, np.log(1.1), np.log(2.1)]),
        ("at_least", 0.0, [0.5, 0, 0]),
        ("at_least", 0.1, [0.6, 0.1, 0]),
        ("equal", 0.1, [-0.5, 0, 1]),
    ],
)
def test_residuals(kind, margin, expected):
    """By hand; three entries share the weight."""
    np.testing.assert_allclose(residuals(kind, X, margin, weight=3.0), 3 * np.array(expected) / np.sqrt(3), atol=1e-12)


@pytest.mark.parametrize(("kind", "sign"), [("minimise", 1), ("maximise", -1)])
def test_goals_count_their_worst(kind, sign):
    """Also those of a logarithm, far below its size, where it is negative: less stays better."""
    power = np.mean((X / 2) ** (8 * sign)) ** (1 / 8)
    np.testing.assert_allclose(residuals(kind, X), [power], rtol=1e-12)
    small = residuals(kind, 1e-3 * X, term=EXPONENTIAL)
    np.testing.assert_allclose(small, [power * 1e-3**sign], rtol=1e-12)


def test_logarithms():
    found = residuals("at_least", X, 0.1, term=EXPONENTIAL)
    np.testing.assert_allclose(found * np.sqrt(3), np.maximum(0.1 - np.log(X / 2), 0), atol=1e-12)


@pytest.mark.parametrize("kind", ["at_most", "at_least", "equal", "minimise", "maximise"])
def test_gradients(kind):
    """Of finite differences, and finite at zero."""
    numeric = [(residuals(kind, X + step, 0.1) - residuals(kind, X - step, 0.1)) / 2e-6 for step in 1e-6 * np.eye(3)]
    slopes = judged(Objective(ITSELF, kind, 2.0, 1.0), X, np.array(0.1))[1]
    np.testing.assert_allclose(slopes, np.transpose(numeric), rtol=1e-6, atol=1e-8)
    assert np.isfinite(judged(Objective(ITSELF, kind, 2.0, 1.0), np.zeros(3), np.array(0.0))[1]).all()


def test_an_infinite_depth_of_field_is_enough():
    value, slope = judged(Objective(ITSELF, "at_least", 2.0, 1.0), np.full(3, np.inf), np.array(0.0))
    assert not np.any(value) and not np.any(slope)


@pytest.mark.parametrize(
    ("kind", "met", "worst"),
    [("at_most", False, 4.0), ("at_least", False, 1.0), ("equal", False, 4.0), ("minimise", None, 4.0)],
)
def test_assessment(kind, met, worst):
    table = TermTable.model_validate({"name": "occupancy", kind: 2.0})
    assert table.assess(X) == Row(1.0, 4.0, met) and table.worst(X) == worst
    if met is not None:
        assert table.assess([2.0]).met


def test_random_terms_take_the_key():
    noise = Term("noise", lambda x, at, key: x + jax.random.normal(key), random=True)
    draw = jax.jit(lambda key: EVALUATE(noise, X, None, key))
    assert (draw(KEY) == draw(KEY)).all() and (draw(KEY) != draw(jax.random.key(1))).all()


def test_whole_numbers_have_no_slope():
    with pytest.raises(InputError, match=r"a term \(itself\) must be of floating point, got int"):
        EVALUATE(ITSELF, jnp.arange(3), None, KEY)
