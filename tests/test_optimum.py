"""Searches with a loss of one's own: an imager in, an imager out; and a network trained with the geometry."""

import dataclasses
import inspect
import math
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest

import gs_jax as gs
from gs_jax import InputError, objectives
from gs_jax.base.errors import InputWarning
from gs_jax.codesign.solve import LBFGSB
from gs_jax.objectives.conditions import Conditions, of_lenses, per_type

from .helpers import compilations, quantities

DEPTHS = np.array([18.0, 20.0, 22.0])


def small(**lens) -> gs.Imager:
    array = gs.MicrolensArray([[-1.0, -0.4], [0.3, 1.1], [1.2, -0.9]], aperture_diameter=1.5, size=(4.0, 4.0), **lens)
    return gs.Imager(array, gs.Sensor((170, 170), 0.02), sensor_distance=5.0, field_radius=1.5)


def in_focus(scope: gs.Imager):
    """The sensor where a thin lens images 20 mm, in residuals."""
    off = 1 / scope.array.focal_length - 1 / scope.reduced_sensor_distance - 1 / scope.reduced_depth(20.0)
    return jnp.stack([10 * off, scope.array.radius_of_curvature - 2.1])


FREE = gs.free("sensor_distance", "radius_of_curvature")
BOUNDS = {"sensor_distance": (4.0, 9.0), "radius_of_curvature": (1.5, 3.0)}


@pytest.mark.parametrize(
    ("loss", "solver", "bounds"),
    [
        (in_focus, optx.LevenbergMarquardt(1e-10, 1e-10), {}),
        (in_focus, optx.BFGS(1e-10, 1e-10), BOUNDS),
        (lambda scope: jnp.sum(in_focus(scope) ** 2), LBFGSB(), BOUNDS),
        (lambda scope: jnp.sum(in_focus(scope) ** 2), optax.adam(0.05), BOUNDS),
        (in_focus, None, {"radius_of_curvature": (1.5, 3.0)}),
    ],
    ids=["least-squares", "bfgs", "bounded", "optax", "default"],
)
def test_all_solvers_come_to_the_same_imager(loss, solver, bounds):
    seen = []
    callback = lambda step, value, scope: seen.append((step, value, float(scope.sensor_distance)))
    found = gs.optimize(loss, small(), free=FREE, solver=solver, bounds=bounds, steps=400, callback=callback)
    exact = 1 / (0.43 / 2.1 - 1 / (20 + 1 / 1.43))
    adam = isinstance(solver, optax.GradientTransformation)
    assert float(found.imager.sensor_distance) == pytest.approx(exact, rel=1e-2 if adam else 1e-5)
    assert float(found.imager.array.radius_of_curvature) == pytest.approx(2.1, rel=1e-2 if adam else 1e-5)
    assert (found.result == optx.RESULTS.successful) != adam and found.value < (1e-2 if adam else 1e-12)
    assert found.stats["num_steps"] == len(seen) == len(found.stats["values"]) and seen[-1][1] == float(found.value)
    np.testing.assert_array_equal(found.imager.array.centers, small().array.centers)


class Off(eqx.Module):
    """Residuals whose numbers are leaves."""

    target: Any
    weight: float
    low: float

    def __call__(self, scope):
        off = jax.nn.relu(scope.magnification(jnp.asarray([20.0])) - self.target) + 0.3 * scope.wavelength
        return jnp.append(self.weight * off, scope.sensor_distance - 5.1 * self.low)


@pytest.mark.parametrize("solver", [None, optx.LevenbergMarquardt(1e-10, 1e-10)], ids=["default", "least-squares"])
def test_other_numbers_of_the_same_shapes_find_the_programs(solver):
    """Another start, other bounds, targets and weights, of Python or of NumPy: no compilation."""

    def search(start, target, weight, low):
        scope, limits = dataclasses.replace(small(), sensor_distance=start), {"sensor_distance": (low, 9.0)}
        loss = Off(np.array(target), weight, low)
        return gs.optimize(loss, scope, free=gs.free("sensor_distance"), bounds=limits, solver=solver, steps=4)

    search(5.0, 0.25, 10.0, 4.0)
    before, found = compilations(), search(5.5, 0.3, 12.0, 3.0)
    assert compilations() == before
    distance = float(found.imager.sensor_distance)
    off = max(float(found.imager.magnification(20.0)) - 0.3, 0) + 0.3 * 520e-6
    assert float(found.value) == pytest.approx(((12 * off) ** 2 + (distance - 15.3) ** 2) / 2, rel=1e-12)


def test_bounds_are_kept_and_steps_are_counted():
    away = lambda scope: (scope.sensor_distance - 10) ** 2
    found = gs.optimize(away, small(), free=gs.free("sensor_distance"), bounds={"sensor_distance": (4.0, 6.0)}, steps=3)
    assert 5.5 < float(found.imager.sensor_distance) < 6 and found.stats["num_steps"] == 3
    assert found.result == optx.RESULTS.nonlinear_max_steps_reached
    lost = gs.optimize(lambda scope: jnp.log(-scope.sensor_distance), small(), free=gs.free("sensor_distance"))
    assert lost.result == optx.RESULTS.nonlinear_divergence


def test_kinds_of_lenses_stay_kinds():
    scope = small(radius_of_curvature=[2.0, 2.2, 2.0])
    free = gs.free("radius_of_curvature", "centers")
    assert free.values(scope)["radius_of_curvature"].shape == (2,)
    loss = lambda scope: jnp.sum((scope.array.of_lenses("radius_of_curvature") - jnp.array([2.4, 2.6, 2.4])) ** 2)
    found = gs.optimize(loss, scope, free=free, solver=optx.BFGS(1e-10, 1e-10)).imager
    np.testing.assert_allclose(found.array.radius_of_curvature, [2.4, 2.6], atol=1e-6)


def test_gradients_by_the_numbers_of_each_lens():
    """Compiled, where every lens is a type of its own, and by finite differences, where equal lenses are one."""
    radii, conics = jnp.array([2.0, 2.2, 2.0]), jnp.array([-0.5, -0.5, -0.2])

    def mean_f_number(radii, conics):
        scope = small(radius_of_curvature=radii, conic_constant=conics)
        return jnp.mean(of_lenses(scope, gs.objectives.f_number(scope)))

    slopes = jax.jit(jax.grad(mean_f_number, (0, 1)))(radii, conics)
    for lens, step in enumerate(1e-5 * np.eye(3)):
        by_radius = mean_f_number(radii + step, conics) - mean_f_number(radii - step, conics)
        by_conic = mean_f_number(radii, conics + step) - mean_f_number(radii, conics - step)
        np.testing.assert_allclose([slopes[0][lens], slopes[1][lens]], [by_radius / 2e-5, by_conic / 2e-5], rtol=1e-4)


@pytest.mark.integration
def test_objectives_of_lens_types_under_trace():
    """The best type at each depth, by a search: numbers that JAX traces are still of two types."""
    scope = small(radius_of_curvature=[2.0, 2.4, 2.0])
    width = lambda scope: gs.objectives.spot_width(scope, [18.0, 24.0])
    np.testing.assert_allclose(jax.jit(width)(scope), width(scope), rtol=1e-9)
    loss = lambda scope: jnp.sum(width(scope) ** 2)
    found = gs.optimize(loss, scope, free=gs.free("radius_of_curvature"), steps=20)
    radii = np.asarray(found.imager.array.radius_of_curvature)
    assert float(found.value) < float(loss(scope)) and radii.shape == (2,)


def test_a_pitch_scales_centers_and_plate():
    scope, free = small(), gs.free("pitch")
    wider = free.replaced(scope, {"pitch": 1.5 * free.values(scope)["pitch"]})
    np.testing.assert_allclose(wider.array.centers, 1.5 * scope.array.centers)
    np.testing.assert_allclose(wider.array.plate, 1.5 * np.array(scope.array.plate))
    crowded = lambda scope: (gs.objectives.lenses_per_point(scope) - 2.0) ** 2
    found = gs.optimize(crowded, scope, free=free, bounds={"pitch": (0.2, 5.0)})
    assert float(gs.objectives.lenses_per_point(found.imager)) == pytest.approx(2.0, abs=1e-3)


# Past the tests' check of annotations.
UNCHECKED, RUN_STUDY = map(inspect.unwrap, cast(Any, (gs.optimize, gs.run_study)))
BLUR = cast(Any, objectives.blur)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"imager": gs.geomscope()}, "imager must be an Imager, as .*, got "),
        ({"imager": gs.Imager}, "imager must be an Imager, as .*, got "),
        ({"free": "shift"}, "free must be a Free, as `gs_jax.free` makes it, got 'shift'"),
        ({"free": gs.free("tilt")}, "tilt must be a number of the imager"),
        ({"solver": "bfgs"}, "solver must be a solver of .*, got 'bfgs'"),
        ({"solver": optx.BFGS}, "solver must be a solver of .*BFGS"),
        ({"solver": LBFGSB()}, "got none of sensor_distance"),
        ({"steps": 0}, "steps must be 1 or more, got 0"),
        ({"steps": np.nan}, "steps must be a whole number, got nan"),
        ({"loss": None}, "loss must be a function of an imager, got None"),
        ({"loss": lambda s: s.sensor_distance > 5}, "must return one number or array of floating point, got bool"),
        (
            {"loss": lambda s: s.wavelength, "solver": optx.LevenbergMarquardt(1e-3, 1e-3)},
            "LevenbergMarquardt needs residuals, an array, got a scalar",
        ),
        ({"bounds": {"shift": (0, 1)}}, "among the free .*, got shift"),
        (
            {"bounds": {"sensor_distance": (6.0, 5.0)}},
            "bounds of sensor_distance must be finite, .*, got 6.0 to 5",
        ),
    ],
)
def test_what_cannot_be_searched_is_refused(changes, words):
    with pytest.raises(InputError, match=words):
        UNCHECKED(**({"loss": in_focus, "imager": small(), "free": FREE} | changes))


@pytest.mark.parametrize(
    ("function", "arguments", "words"),
    [
        (BLUR, (gs.Imager, DEPTHS), "imager must be an Imager, as .*, got <class"),
        (BLUR, (small(), 1j * DEPTHS), "depths must be real lengths, mm, or Conditions, got array"),
        (BLUR, (small(), Conditions), "depths must be real lengths, mm, or Conditions, got <class"),
        (RUN_STUDY, (gs.Design, "s.toml"), "design must be a Design or its file, got <class"),
        (gs.free, ("spacing",), "names must be among sensor_distance, rotation.*, got 'spacing'"),
        (gs.free, (), "at least one name must be given"),
    ],
)
def test_wrong_arguments_are_named(function, arguments, words):
    with pytest.raises(InputError, match=words):
        function(*arguments)


OBJECTIVES = tuple(
    "spot_width encircled_radius half_light_radius width_per_light strehl lateral_resolution axial_resolution "
    "depth_of_field blur occupancy light lenses_per_point coverage".split()
)


def with_numbers(numbers) -> gs.Imager:
    where = lambda i: (i.sensor_distance, i.array.radius_of_curvature, i.array.aperture_diameter, i.array.centers)
    return eqx.tree_at(where, small(), numbers)


@jax.jit
def everything(numbers):
    """All objectives at once: compiled once."""
    imager = with_numbers(numbers)
    return {"spacing": objectives.spacing(imager)} | quantities(imager, DEPTHS, OBJECTIVES)


def test_objectives_have_the_gradients_of_finite_differences():
    """Of each entry, by aperture, centres and all else that it depends on."""
    # The sensor where nothing is in focus: there a blur has a kink.
    numbers = (np.array(5.3), np.array(2.0), np.array(1.5), np.array(small().array.centers))
    rng, step = np.random.default_rng(0), 1e-6
    along = [rng.normal(size=number.shape) for number in numbers]
    ahead, behind = (
        everything(tuple(a + sign * step * b for a, b in zip(numbers, along, strict=True))) for sign in (1, -1)
    )
    for name, slopes in jax.jit(jax.jacrev(everything))(numbers).items():
        product = sum(np.tensordot(slope, b, b.ndim) for slope, b in zip(slopes, along, strict=True))
        numeric = (np.asarray(ahead[name]) - np.asarray(behind[name])) / (2 * step)
        assert np.isfinite(ahead[name]).all(), name
        np.testing.assert_allclose(product, numeric, rtol=1e-3, atol=1e-6, err_msg=name)


def test_an_objective_is_one_program():
    """After the clear diameter and the lens that stands for all; other numbers and depths find it."""
    scope, other = small(), small(radius_of_curvature=2.1, conic_constant=-0.5)
    for quantity in (objectives.blur, objectives.light):
        quantity(scope, DEPTHS)
    before = compilations()
    for quantity in (objectives.blur, objectives.light):
        quantity(other, (DEPTHS + 0.5).tolist())
    assert compilations() == before
    for quantity in (objectives.sensor_blur, objectives.focus_distance):
        quantity(scope, DEPTHS)
    assert compilations() == before + 2


def test_depths_behind_the_array_are_refused():
    with pytest.raises(ValueError, match="`depths` must be positive and finite, got -3.0"):
        objectives.spot_width(small(), np.array([20.0, -3.0]))


def test_objectives_of_lenses_that_differ_are_of_the_plate_of_each_type_or_of_the_best():
    scope = small(radius_of_curvature=[2.0, 2.2, 2.0])
    shape = lambda function, *others: eqx.filter_eval_shape(function, scope, *others).shape
    assert shape(objectives.occupancy, DEPTHS) == (3,)
    assert shape(objectives.lateral_resolution, DEPTHS) == (2, 3)
    assert shape(objectives.f_number) == shape(objectives.sag) == (2,)
    without_depths: Any = objectives.lateral_resolution
    with pytest.raises(TypeError, match="depths"):
        without_depths(scope)

    @jax.jit
    def widths(scope):
        return [objectives.spot_width(*part) for part in ((scope, DEPTHS), *per_type(scope, DEPTHS))]

    best, *each = widths(scope)
    np.testing.assert_allclose(best, np.min(each, 0), rtol=1e-12)


def test_an_objective_of_ones_own_to_a_file(tmp_path):
    scope, depths = gs.geomscope(sensor_distance_mm=4.5).replace(centers_mm=small().array.centers).imager(), DEPTHS
    my_cost = lambda scope: (scope.sensor_distance - 5.0) ** 2
    loss = lambda scope: gs.objectives.spot_width(scope, depths).max() + 0.001 * my_cost(scope)
    limits = {"sensor_distance": (4.0, 7.0), "radius_of_curvature": (1.5, 3.0), "aperture_diameter": (0.6, 2.0)}
    options = {"free": gs.free(*limits), "bounds": limits, "solver": optx.BFGS(1e-6, 1e-6), "steps": 12}
    with pytest.warns(InputWarning, match="aperture_diameter starts at 1.986 instead of 2, to begin within its bounds"):
        found = gs.optimize(loss, scope, **options)
    assert found.value < 0.5 * jax.jit(loss)(scope)
    gs.write_design(tmp_path / "mine.toml", gs.Design.from_imager(found.imager, name="mine"))
    assert gs.read_design(tmp_path / "mine.toml").imager().sensor_distance == found.imager.sensor_distance


def test_a_layout_of_ones_own_to_a_mold(tmp_path):
    my_points = 1.4 * np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), -1).reshape(-1, 2)
    report = gs.make_mold(gs.geomscope().replace(centers_mm=my_points, size_mm=(6.0, 6.0)), tmp_path / "mine.stl")
    assert report["verification"]["lenses"] == 9


def test_geometry_and_a_network_are_trained_together():
    """One compiled step, for all steps."""
    scope, grid = small(), gs.Grid(DEPTHS, (15, 15), 0.12)
    rng = np.random.default_rng(0)
    truth = jnp.asarray(rng.random((4, *grid.volume_shape)))
    images = jax.vmap(gs.ImagingOperator(scope, grid).mv)(truth)
    net = eqx.nn.Conv2d(3, 3, 3, padding=1, key=jax.random.key(0))
    traced = []

    def loss(params, images):
        traced.append(None)
        scope, net = params
        A = gs.ImagingOperator(scope, grid)
        return jnp.mean((jax.vmap(net)(jax.vmap(A.T.mv)(images)) - truth) ** 2)

    optimiser = optax.adam(1e-2)
    start = dataclasses.replace(scope, sensor_distance=5.3)
    params, static = eqx.partition((start, net), eqx.is_inexact_array)
    state = optimiser.init(params)

    @jax.jit
    def step(params, state, images):
        value, slope = jax.value_and_grad(lambda params: loss(eqx.combine(params, static), images))(params)
        with jax.numpy_dtype_promotion("standard"):  # optax multiplies floats and whole numbers
            updates, state = optimiser.update(slope, state)
        return optax.apply_updates(params, updates), state, value

    values = []
    for _ in range(30):
        params, state, value = step(params, state, images)
        values.append(float(value))
    assert len(traced) == 1 and values[-1] < 0.5 * values[0] and math.isfinite(values[-1])
    moved = eqx.combine(params, static)[0]
    assert moved.sensor_distance != 5.3 and not np.allclose(moved.array.centers, scope.array.centers)
