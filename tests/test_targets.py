import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from gs_jax.base.errors import InputError
from gs_jax.codesign.study import TermTable
from gs_jax.codesign.targets import Objective, Row, assess, evaluate, worst_entry
from gs_jax.codesign.terms import TERMS, Term

KEY = jax.random.key(0)


@pytest.fixture
def entries(monkeypatch):
    """A term that is whatever it is asked of, and one that is its logarithm."""
    monkeypatch.setitem(TERMS, "occupancy", Term("itself", lambda x, at: x))
    monkeypatch.setitem(TERMS, "strehl", Term("its exponential", lambda x, at: jnp.log(x), log=True))
    monkeypatch.setitem(TERMS, "blur_um", Term("noise", lambda x, at, key: x + jax.random.normal(key), random=True))
    # What stands for an imager here is an array, which the checked signature would refuse.
    residual = inspect.unwrap(Objective.residual)
    of_table = Objective.of_table
    return lambda table, x, margin=0.0: residual(of_table(table), jnp.array(2.0), x, None, KEY, margin=margin)


def table(kind, *, name="occupancy", **more):
    return TermTable.model_validate({"name": name, **kind, **more})


X = jnp.array([1.0, 2.0, 4.0])


@pytest.mark.parametrize(
    ("kind", "margin", "expected"),
    [
        ({"at_most": 2.0}, 0.0, [0, 0, np.log(2)]),
        ({"at_most": 2.0}, 0.1, [0, np.log(1.1), np.log(2.1)]),
        ({"at_least": 2.0}, 0.0, [0.5, 0, 0]),
        ({"at_least": 2.0}, 0.1, [0.6, 0.1, 0]),
        ({"equal": 2.0}, 0.1, [-0.5, 0, 1]),
    ],
)
def test_residuals(entries, kind, margin, expected):
    """By hand; three entries share the weight."""
    found = entries(table(kind, weight=3.0), X, margin)
    np.testing.assert_allclose(found, 3 * np.array(expected) / np.sqrt(3), atol=1e-12)


def test_goals_count_their_worst(entries):
    power = lambda x: np.mean(x**8) ** (1 / 8)
    x = np.asarray(X)
    np.testing.assert_allclose(entries(table({"minimise": 2.0}), X), [power(x / 2)], rtol=1e-12)
    np.testing.assert_allclose(entries(table({"maximise": 2.0}), X), [power(2 / x)], rtol=1e-12)


def test_a_goal_of_a_logarithm_is_that_of_its_value(entries):
    """Far below its size too, where a logarithm is negative: less stays better."""
    small = X * 1e-3
    for kind in ({"minimise": 2.0}, {"maximise": 2.0}):
        np.testing.assert_allclose(entries(table(kind, name="strehl"), small), entries(table(kind), small), rtol=1e-12)


def test_logarithms(entries):
    found = entries(table({"at_least": 2.0}, name="strehl"), X, 0.1)
    np.testing.assert_allclose(found * np.sqrt(3), np.maximum(0.1 - np.log(np.asarray(X) / 2), 0), atol=1e-12)


@pytest.mark.parametrize("kind", ["at_most", "at_least", "equal", "minimise", "maximise"])
def test_gradients(entries, kind):
    check_grads(lambda x: entries(table({kind: 2.0}), jnp.asarray(x), 0.1), (X,), order=1)
    zero = jax.grad(lambda x: jnp.sum(entries(table({kind: 2.0}), x)))(jnp.zeros(3))
    assert np.isfinite(zero).all()


def test_an_infinite_depth_of_field_is_enough(entries):
    endless = lambda x: jnp.sum(entries(table({"at_least": 2.0}), jnp.where(x > 0, jnp.inf, x)))
    value, slope = jax.value_and_grad(endless)(X)
    assert value == 0 and (np.asarray(slope) == 0).all()


@pytest.mark.parametrize(
    ("kind", "met", "worst"),
    [("at_most", False, 4.0), ("at_least", False, 1.0), ("equal", False, 4.0), ("minimise", None, 4.0)],
)
def test_assessment(kind, met, worst):
    row = assess(table({kind: 2.0}), np.asarray(X))
    assert row == Row(1.0, 4.0, met)
    assert worst_entry(table({kind: 2.0}), X) == worst
    if met is not None:
        assert assess(table({kind: 2.0}), np.array([2.0])).met


def test_random_terms_take_the_key(entries):
    name = "blur_um"
    draw = lambda seed: inspect.unwrap(evaluate)(TERMS[name], X, None, jax.random.key(seed))
    assert (draw(0) == draw(0)).all() and (draw(0) != draw(1)).all()


def test_whole_numbers_have_no_slope(entries):
    with pytest.raises(InputError, match=r"a term \(itself\) must be of floating point, got int"):
        entries(table({"at_most": 2.0}), jnp.arange(3))
