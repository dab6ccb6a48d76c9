import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares, minimize

from gs_jax.codesign.solve import CONVERGED, LIMIT, MET, NOT_FINITE, State, Stepper, run, solver_of
from gs_jax.codesign.study import StageTable

KEY = jax.random.key(0)
SOLVERS = ("levenberg-marquardt", "bfgs", "lbfgs")


def rosenbrock(free, given, key):
    """Rosenbrock's valley as least squares; `given` is where its floor is."""
    x, y = free["x"], free["y"]
    return jnp.stack([10 * (y - x**2), given - x])


START = {"x": jnp.array(-1.2), "y": jnp.array(1.0)}
INSIDE = {"x": jnp.array(0.9), "y": jnp.array(0.1)}
ONE = jnp.array(1.0)


def solved(solver, **options):
    steps = Stepper(rosenbrock, solver_of(StageTable(solver=solver)), KEY)
    return run(steps, steps.begin(START, ONE), ONE, limit=1000, **options)


@pytest.mark.parametrize("solver", SOLVERS)
def test_rosenbrocks_valley(solver):
    """SciPy's own least squares comes to the same place. Stops are where steps are below 1e-9."""
    state, reason = solved(solver)
    expected = least_squares(lambda x: np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]), [-1.2, 1.0]).x
    np.testing.assert_allclose([state.free["x"], state.free["y"]], expected, atol=1e-5)
    assert reason == CONVERGED


@pytest.mark.integration
def test_rosenbrocks_valley_within_bounds():
    """L-BFGS-B of SciPy comes to the same place, on a bound; the unit square, from 0 to 1."""
    start, two = INSIDE, jnp.array(2.0)
    steps = Stepper(rosenbrock, solver_of(StageTable(solver="lbfgsb")), KEY)
    state, reason = run(steps, steps.begin(start, two), two, limit=200)
    cost = lambda x: (100 * (x[1] - x[0] ** 2) ** 2 + (2 - x[0]) ** 2) / 2
    expected = minimize(cost, [0.9, 0.1], method="L-BFGS-B", bounds=[(0, 1), (0, 1)], tol=1e-14).x
    np.testing.assert_allclose([state.free["x"], state.free["y"]], expected, atol=1e-6)
    assert state.free["x"] == 1 and reason == CONVERGED


@pytest.mark.integration
@pytest.mark.parametrize("solver", (*SOLVERS, "lbfgsb", "adam"))
def test_going_on_from_any_step_is_the_same(solver):
    """Bit for bit: the state is all that the next step depends on, and it survives a copy through bytes."""
    start = INSIDE if solver == "lbfgsb" else START
    steps = Stepper(rosenbrock, solver_of(StageTable(solver=solver)), KEY)
    whole, _ = run(steps, steps.begin(start, ONE), ONE, limit=9)
    part, _ = run(steps, steps.begin(start, ONE), ONE, limit=4)
    again = Stepper(rosenbrock, solver_of(StageTable(solver=solver)), KEY)
    copy = jax.tree.map(lambda x: jnp.array(np.asarray(x).copy()), part)
    rest, _ = run(again, State(*copy), ONE, limit=9)
    jax.tree.map(np.testing.assert_array_equal, whole, rest)


@pytest.mark.parametrize("solver", (*SOLVERS, "lbfgsb"))
def test_going_on_from_the_last_step_takes_no_other(solver):
    start = INSIDE if solver == "lbfgsb" else START
    steps = Stepper(rosenbrock, solver_of(StageTable(solver=solver)), KEY)
    whole, reason = run(steps, steps.begin(start, ONE), ONE, limit=1000)
    again, same = run(steps, whole, ONE, limit=1000)
    assert reason == same == CONVERGED
    jax.tree.map(np.testing.assert_array_equal, whole, again)


def test_targets_are_given_later():
    """One compilation for all of them."""
    steps = Stepper(rosenbrock, solver_of(StageTable(solver="levenberg-marquardt")), KEY)
    two = jnp.array(2.0)
    state, _ = run(steps, steps.begin(START, two), two, limit=200)
    np.testing.assert_allclose([state.free["x"], state.free["y"]], [2, 4], atol=1e-5)


def test_reasons():
    assert solved("levenberg-marquardt", enough=1e-3)[1] == MET
    steps = Stepper(rosenbrock, solver_of(StageTable(solver="bfgs")), KEY)
    seen = []
    state, reason = run(steps, steps.begin(START, ONE), ONE, limit=3, each=lambda s: seen.append(int(s.step)))
    assert reason == LIMIT.format(3) == "stopped at the limit of 3 steps" and seen == [1, 2, 3]
    lost = steps.begin({"x": jnp.array(jnp.nan), "y": jnp.array(0.0)}, ONE)
    assert run(steps, lost, ONE, limit=3)[1] == NOT_FINITE


def falling(free, given, key):
    """Least at infinity, where nothing is gained: parameters move on after the cost is flat."""
    return jnp.stack([given, jnp.exp(-free["x"])])


def flat_below(free, given, key):
    """Without a slope below `given`."""
    return jnp.stack([given, jax.nn.relu(free["x"] - given)])


@pytest.mark.parametrize("residual, solver", [*((falling, solver) for solver in SOLVERS), (flat_below, "adam")])
def test_a_cost_that_is_flat_has_converged(residual, solver):
    """Within a millionth of the least, 1/2, over twenty steps; before that no solver says so."""
    start, costs = {"x": jnp.array(1.5)}, []
    steps = Stepper(residual, solver_of(StageTable(solver=solver)), KEY)
    note = lambda state: costs.append(float(state.cost))
    state, reason = run(steps, steps.begin(start, ONE), ONE, limit=200, each=note)
    assert reason == CONVERGED and int(state.step) == len(costs) < 100
    assert costs[-1] == pytest.approx(0.5, rel=1e-6) and np.ptp(costs[-21:]) <= 1e-6 * 0.5 < np.ptp(costs[-22:])


def test_damping_falls_until_it_suits_the_curvature():
    """Gauss-Newton does not see the curvature of `1 + 0.01 x^2`; with a damping of 1 a step goes 2 % of the way."""
    bowl = lambda free, given, key: (1 + 0.01 * free["x"] ** 2)[None]
    start = {"x": jnp.array(1.0)}
    steps = Stepper(bowl, solver_of(StageTable(solver="levenberg-marquardt")), KEY)
    state, reason = run(steps, steps.begin(start, ONE), ONE, limit=200)
    assert reason == CONVERGED and int(state.step) < 60 and abs(float(state.free["x"])) < 1e-3


def test_adam_draws_anew_in_each_step():
    """The mean of what is drawn, within its standard error of 0.06 after 300 steps of 0.03."""
    noisy = lambda free, given, key: (free - given - 0.3 * jax.random.normal(key))[None]
    start = jnp.array(0.0)
    steps = Stepper(noisy, solver_of(StageTable(solver="adam", learning_rate=0.03)), KEY)
    costs = []
    state, reason = run(steps, steps.begin(start, ONE), ONE, limit=300, each=lambda s: costs.append(float(s.cost)))
    np.testing.assert_allclose(state.free, 1, atol=0.2)
    assert len(set(costs)) == 300 and reason == LIMIT.format(300)
