"""Solvers step by step, and the changes of variables that keep bounds."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from jaxtyping import Array
from scipy.optimize import least_squares, minimize

from gs_jax.codesign.solve import (
    CONVERGED,
    FLAT,
    LIMIT,
    MET,
    NOT_FINITE,
    Affine,
    Residual,
    Sigmoid,
    State,
    Stepper,
    run,
    solver_of,
)
from gs_jax.codesign.study import StageTable

KEY = jax.random.key(0)
SOLVERS = ("levenberg-marquardt", "bfgs", "lbfgs")


class Rosenbrock(eqx.Module):
    """Rosenbrock's valley as least squares; `floor` is where it is lowest."""

    floor: Array = eqx.field(converter=jnp.asarray, default=1.0)

    def __call__(self, free, key):
        return jnp.stack([10 * (free["y"] - free["x"] ** 2), self.floor - free["x"]])


START = {"x": jnp.array(-1.2), "y": jnp.array(1.0)}
INSIDE = {"x": jnp.array(0.9), "y": jnp.array(0.1)}


def stepper(solver, residual: Residual = Rosenbrock(), **options):
    return Stepper(residual, solver_of(StageTable(solver=solver, **options)), KEY)


def start_of(solver):
    return INSIDE if solver == "lbfgsb" else START


@pytest.mark.parametrize("solver", (*SOLVERS, pytest.param("lbfgsb", marks=pytest.mark.integration)))
def test_rosenbrocks_valley(solver):
    """SciPy comes to the same place, on a bound of the unit square by L-BFGS-B; then no solver takes another step."""
    floor, bounded = (2.0, True) if solver == "lbfgsb" else (1.0, False)
    steps = stepper(solver, Rosenbrock(floor))
    state, reason = run(steps, steps.begin(start_of(solver)), limit=1000)
    if bounded:
        cost = lambda x: (100 * (x[1] - x[0] ** 2) ** 2 + (2 - x[0]) ** 2) / 2
        expected = minimize(cost, [0.9, 0.1], method="L-BFGS-B", bounds=[(0, 1), (0, 1)], tol=1e-14).x
        assert state.free["x"] == 1
    else:
        expected = least_squares(lambda x: np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]), [-1.2, 1.0]).x
    # Stops are where steps are below 1e-9.
    np.testing.assert_allclose([state.free["x"], state.free["y"]], expected, atol=1e-5)
    again, same = run(steps, state, limit=1000)
    assert reason == same == CONVERGED
    jax.tree.map(np.testing.assert_array_equal, state, again)


@pytest.mark.integration
@pytest.mark.parametrize("solver", (*SOLVERS, "lbfgsb", "adam"))
def test_going_on_from_any_step_is_the_same(solver):
    """Bit for bit: the state is all that the next step depends on, and it survives a copy through bytes."""
    steps = stepper(solver)
    whole, _ = run(steps, steps.begin(start_of(solver)), limit=9)
    part, _ = run(steps, steps.begin(start_of(solver)), limit=4)
    copy = jax.tree.map(lambda x: jnp.array(np.asarray(x).copy()), part)
    rest, _ = run(stepper(solver), State(*copy), limit=9)
    jax.tree.map(np.testing.assert_array_equal, whole, rest)


def test_reasons():
    steps = stepper("levenberg-marquardt")
    assert run(steps, steps.begin(START), limit=1000, enough=1e-3)[1] == MET
    steps, seen = stepper("bfgs"), []
    _, reason = run(steps, steps.begin(START), limit=3, each=lambda s: seen.append(int(s.step)))
    assert reason == LIMIT.format(3) == "stopped at the limit of 3 steps" and seen == [1, 2, 3]
    lost = steps.begin({"x": jnp.array(jnp.nan), "y": jnp.array(0.0)})
    assert run(steps, lost, limit=3)[1] == NOT_FINITE


def falling(free, key):
    """Least at infinity, where nothing is gained: parameters move on after the cost is flat."""
    return jnp.stack([1.0, jnp.exp(-free["x"])])


def flat_below(free, key):
    """Without a slope below 1."""
    return jnp.stack([1.0, jax.nn.relu(free["x"] - 1)])


@pytest.mark.parametrize("residual, solver", [*((falling, solver) for solver in SOLVERS), (flat_below, "adam")])
def test_a_cost_that_is_flat_has_converged(residual, solver):
    """Within a millionth of the least, 1/2, over twenty steps; before that no solver says so."""
    steps, costs = stepper(solver, residual), []
    note = lambda state: costs.append(float(state.cost))
    state, reason = run(steps, steps.begin({"x": jnp.array(1.5)}), limit=200, each=note)
    assert reason == CONVERGED and int(state.step) == len(costs) < 100
    assert costs[-1] == pytest.approx(0.5, rel=1e-6) and np.ptp(costs[-21:]) <= 1e-6 * 0.5 < np.ptp(costs[-22:])


@pytest.mark.parametrize("solver", ["lbfgs", "adam"])
def test_the_least_cost_is_flat(solver):
    """By a stated part in a stated number of steps, whether the solver has converged or not."""
    steps = Stepper(falling, solver_of(StageTable(solver=solver)), KEY, jnp.asarray(0.01), 20)
    least = []
    note = lambda state: least.append(min([float(state.cost), *least]))
    _, reason = run(steps, steps.begin({"x": jnp.array(3.0)}), limit=200, each=note)
    assert reason == FLAT.format(1, 20) == "stopped: the least cost has fallen by less than 1 % in 20 steps"
    assert len(least) == 20 and least[0] - least[-1] <= 0.01 * least[0]


def test_damping_falls_until_it_suits_the_curvature():
    """Gauss-Newton does not see the curvature of `1 + 0.01 x^2`; with a damping of 1 a step goes 2 % of the way."""
    bowl = lambda free, key: (1 + 0.01 * free["x"] ** 2)[None]
    steps = stepper("levenberg-marquardt", bowl)
    state, reason = run(steps, steps.begin({"x": jnp.array(1.0)}), limit=200)
    assert reason == CONVERGED and int(state.step) < 60 and abs(float(state.free["x"])) < 1e-3


def test_adam_draws_anew_in_each_step():
    """The mean of what is drawn, within its standard error of 0.06 after 300 steps of 0.03."""
    noisy = lambda free, key: (free - 1 - 0.3 * jax.random.normal(key))[None]
    steps, costs = stepper("adam", noisy, learning_rate=0.03), []
    state, reason = run(steps, steps.begin(jnp.array(0.0)), limit=300, each=lambda s: costs.append(float(s.cost)))
    np.testing.assert_allclose(state.free, 1, atol=0.2)
    assert len(set(costs)) == 300 and reason == LIMIT.format(300)


@jax.jit
def through(transform, free, value):
    """Free variables through their values, values through their variables, and the slope at the latter."""
    slope = jax.vmap(lambda x: jax.grad(transform.forward)(transform.inverse(x)))(value)
    return transform.inverse(transform.forward(free)), transform.forward(transform.inverse(value)), slope


def test_bounds_are_invertible():
    """To 4.9 the value stays 1 % of the range from its bounds; the curve is flat there, and rounding grows by its
    inverse slope, 2 (1 + x^2)^(3/2) = 250."""
    for transform, free in ((Sigmoid(2.0, 6.0), np.linspace(-4.9, 4.9, 99)), (Affine(2.0, 6.0), np.linspace(0, 1, 99))):
        value = np.linspace(2.04, 5.96, 99)
        again, same, _ = through(transform, free, value)
        np.testing.assert_allclose(again, free, atol=1e-12)
        np.testing.assert_allclose(same, value, atol=1e-12)


def test_a_start_at_a_bound_can_still_move():
    value = np.resize([2.0, 6.0, 1.0, 9.0], 99)
    _, inside, slope = through(Sigmoid(2.0, 6.0), np.zeros(99), value)
    # The slope at a share s is 4 (s (1 - s))^(3/2) of the half range: 0.008 for 1 %.
    assert np.all((2 < np.asarray(inside)) & (np.asarray(inside) < 6)) and np.all(np.asarray(slope) > 0.005)
    np.testing.assert_array_equal(through(Affine(2.0, 6.0), np.zeros(99), value)[1], np.clip(value, 2, 6))
    both = lambda free, value: (Sigmoid(2.0, 6.0).forward(free), Sigmoid(2.0, 6.0).inverse(value))
    check_grads(jax.jit(both), (jnp.array([0.3, -4.0]), jnp.array([2.5, 5.9])), order=1)
