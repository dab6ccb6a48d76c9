"""What follows from plane layers: derived quantities, terms of studies, searches, and the grid of `find_points`."""

import dataclasses
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gs_jax as gs
from gs_jax import InputError, objectives
from gs_jax.apps.drawings import draw_section
from gs_jax.apps.explore_design import make_sliders
from gs_jax.apps.tolerances import tolerance
from gs_jax.base.errors import InputWarning
from gs_jax.codesign.linear_error import lost_power, spots_of_types
from gs_jax.codesign.study import Study
from gs_jax.design.datasheets import datasheet, overview
from gs_jax.detection.view_samples import COARSE, search_grid
from gs_jax.objectives.conditions import Conditions
from gs_jax.optics.pupil import solid_angle, transmittance
from gs_jax.optics.raytrace import refract, to_numpy, trace_lenslet

from .helpers import quantities

DEPTHS, INDEX = np.array([20.0, 21.5, 23.0]), 1.43
QUANTITIES = tuple(
    "axial_resolution depth_of_field approximate_depth_of_field clear_diameter near_limit far_limit focus_distance "
    "focus_offset lateral_resolution lenses_per_point light occupancy sensor_blur spot_width wavefront_error".split()
)


def with_layers(**layers) -> gs.Imager:
    return dataclasses.replace(gs.geomscope().imager(), **layers)


def in_gel() -> gs.Imager:
    sample = gs.Sample(INDEX, surface=19.67, layers=gs.Layers([0.17], [1.523]))
    windows = gs.Layers([0.6, 0.55], [1.0, 1.51])
    return with_layers(filters=gs.Layers([2.0], [1.52]), windows=windows, sample=sample)


def test_layers_of_air_change_nothing():
    # As many layers as `in_gel` has.
    air = with_layers(
        filters=gs.Layers([2.0], [1.0]),
        windows=gs.Layers([0.6, 0.55], [1.0, 1.0]),
        sample=gs.Sample(1.0, 19.0, gs.Layers([0.2], [1.0])),
    )
    values = quantities(air, DEPTHS, QUANTITIES)
    for name, value in quantities(gs.geomscope().imager(), DEPTHS, QUANTITIES).items():
        np.testing.assert_allclose(values[name], value, rtol=1e-12, err_msg=name)


def test_lengths_along_z_are_real_ones():
    """A spot moves by `M` lateral resolutions when its point moves by the axial one, by exact rays."""
    scope, step = in_gel(), 1e-4
    rays = lambda z: trace_lenslet(scope, z, np.zeros((1, 2)), (scope.field_radius, 0.0)).landing[0, 0]
    values = quantities(scope, DEPTHS, QUANTITIES)
    moves = np.array([float(rays(z + step) - rays(z - step)) / (2 * step) for z in DEPTHS])
    magnification = to_numpy(scope).magnification(DEPTHS)
    np.testing.assert_allclose(
        values["axial_resolution"] * moves, values["lateral_resolution"] * magnification, rtol=0.03
    )
    near, far = (np.asarray(values[name]) for name in ("near_limit", "far_limit"))
    np.testing.assert_allclose(values["depth_of_field"], far - near, rtol=1e-9)
    # By the rim of the lens: at the limits a sensor that is focused on the middle has the circle of confusion.
    focused = dataclasses.replace(scope, sensor_distance=values["focus_distance"][1])
    blurs = quantities(focused, np.array([near[1], far[1], 23.0]), QUANTITIES)["sensor_blur"][:2]
    np.testing.assert_allclose(blurs, 2 * scope.sensor.pixel_pitch, rtol=1e-6)


def test_a_medium_takes_light():
    """As much as exact rays near the axis say; the exposure is that of an emitter in air."""
    scope, host = in_gel(), to_numpy(in_gel())
    ray = refract(host, DEPTHS, np.full((2, 1), 1e-4), np.zeros((2, 1)))
    values = quantities(scope, DEPTHS, QUANTITIES)
    share = solid_angle(host, ray) * np.pi * float(values["clear_diameter"]) ** 2 / 4 / (4 * np.pi)
    each = values["light"] / values["lenses_per_point"]
    np.testing.assert_allclose(each, share, rtol=1e-6)
    narrow = spots_of_types(scope, Conditions(DEPTHS, clear_diameter=1e-3), jnp.zeros(1), jnp.zeros(1)).electrons[:, 0]
    passed = solid_angle(host, ray) * transmittance(host, ray) * np.pi / 4 * 1e-3**2
    np.testing.assert_allclose(narrow / passed, 1e4 * 20.0**2, rtol=1e-6)


def test_the_error_of_volumes_in_a_medium():
    """That of air at the same reduced depths with as much light, beside the layers' aberrations."""
    scope, depths = with_layers(sample=gs.Sample(INDEX, surface=17.0)), np.array([20.0, 22.0])
    without, reduced = with_layers(sample=gs.Sample(1.0, surface=17.0)), 17.0 + (depths - 17.0) / INDEX
    error = eqx.filter_jit(lost_power)
    wet, dry = (
        np.asarray(error(device, Conditions(jnp.asarray(z), exposure=exposure), jnp.array([[0.3, -0.2]])))
        for device, z, exposure in ((scope, depths, 1e4), (without, reduced, 1e4 / INDEX**2))
    )
    np.testing.assert_allclose(wet, dry, rtol=0.02)


def test_planes_of_the_search_for_points():
    """A point at the field radius moves from plane to plane as from voxel to voxel."""
    scope = in_gel()
    planes = np.asarray(search_grid(scope, gs.Grid([20.0, 23.0], (9, 9), 0.1)).depths)
    middle = len(planes) // 2
    x, y = to_numpy(scope).centers[0] + (scope.field_radius, 0.0)
    points = np.array([[x, y, z] for z in planes[middle : middle + 2]])
    moved = np.diff(to_numpy(scope).project(points)[0, :, 0])
    np.testing.assert_allclose(abs(moved), COARSE * scope.sensor.pixel_pitch, rtol=0.03)


def test_searches_of_layers():
    scope = in_gel()
    bounds = {
        "filters.thickness": (0.5, 4.0),
        "windows.refractive_index": (np.array([1.0, 1.4]), np.array([1.1, 1.6])),
        "sample.surface": (15.0, 20.0),
        "sample.refractive_index": (1.3, 1.6),
    }
    start, loss = float(scope.magnification(21.0)), lambda scope: (scope.magnification(21.0) - 0.275) ** 2
    with pytest.warns(InputWarning, match="windows.refractive_index starts at 1.001 instead of 1"):
        found = gs.optimize(loss, scope, free=gs.free(*bounds), bounds=bounds, steps=20).imager
    assert found.filters is not None and found.sample is not None
    assert abs(float(found.magnification(21.0)) - 0.275) < 1e-3 < abs(start - 0.275)
    changed = (found.filters.thickness, found.sample.surface, found.sample.refractive_index)
    assert all(np.any(a != b) for a, b in zip(changed, (2.0, 19.67, INDEX), strict=True))
    with pytest.raises(InputError, match="sample.surface must be a number of the imager .* got None"):
        gs.optimize(loss, gs.geomscope().imager(), free=gs.free("sample.surface"))


def wet_design() -> gs.Design:
    """A device with a filter and a window, used in air or in water behind a cover slip."""
    slip = {"name": "cover slip", "thickness_mm": 0.17, "refractive_index": "BK7"}
    return gs.geomscope().replace(
        layers={
            "object": [{"name": "filter", "thickness_mm": 2.0, "refractive_index": "fused silica"}],
            "sensor": [{"thickness_mm": 0.6}, {"name": "window", "thickness_mm": 0.55, "refractive_index": 1.51}],
        },
        samples={"water": {"refractive_index": "water", "surface_mm": 17.0, "layers": [slip]}},
        refractive_index="PDMS",
    )


def focus_study(**tables) -> Study:
    return Study.model_validate(
        {
            "depths_mm": (18.0, 22.0),
            "free": {"sensor_distance_mm": (4.0, 8.0)},
            "terms": ({"name": "focus_offset", "minimise": 1.0},),
            "stages": ({"solver": "levenberg-marquardt", "steps": 20},),
        }
        | tables
    )


def test_a_study_in_a_sample():
    """The sensor is where the middle of the depths is in focus, in water; the new design is one in water."""
    design = wet_design()
    found = gs.run_study(design, focus_study(sample="water")).design
    assert found.sample == found.samples["water"] and found.layers == design.layers and found.lens == design.lens
    assert list(found.imaging.working_distance_mm) == [18.0, 22.0]
    assert float(objectives.focus_offset(found.imager(), [18.0, 22.0])) < 1e-3
    dry = gs.run_study(design, focus_study(sample="air")).design
    assert dry.imager().sample is None and abs(dry.imaging.sensor_distance_mm - found.imaging.sensor_distance_mm) > 0.05
    for tables, words in (
        ({"sample": "oil"}, "`sample` must be one of .samples. in the design, water, air, got 'oil'"),
        (
            {"sample": "water", "depths_mm": (16.0, 22.0)},
            "`depths_mm` must be 17 mm or more, where the object's medium",
        ),
        ({}, "`sample` must be given .* has no default .sample., but .samples.: water; none stands for air"),
        (
            {"sample": "air", "free": {"sensor_distance_mm": (1.0, 8.0)}},
            "must be 1.15 or more, as thick as the windows, got .1.0, 8.0",
        ),
        (
            {"sample": "water", "free": {"depth_span_mm": (1.0, 7.0)}},
            "`free.depth_span_mm` must be below 6, twice the middle of the depths from 17 mm on, got",
        ),
    ):
        with pytest.raises(InputError, match=words):
            gs.run_study(design, focus_study(**tables))


def test_sliders_leave_room_for_layers():
    sliders = make_sliders(wet_design().replace(sample={"refractive_index": 1.33, "surface_mm": 17.0}))
    assert (sliders["near_mm"].low, sliders["sensor_distance_mm"].low) == (17.0, 0.6 * 5.8)


def test_objects_are_in_their_medium():
    scope, grid = in_gel(), gs.Grid([19.0, 21.0], (9, 9), 0.1)
    image = np.zeros(scope.sensor.shape, np.float32)
    for call in (
        lambda: gs.simulate(np.array([[0.0, 0.0, 19.0, 1.0]]), scope),
        lambda: gs.simulate(np.zeros(grid.volume_shape), scope, grid),
        lambda: gs.reconstruct(image, scope, grid),
        lambda: gs.find_points(image, scope, grid),
    ):
        with pytest.raises(InputError, match="must be 19.67 mm or more, where layers end .* medium begins, got 19"):
            call()
    wet = wet_design()
    with pytest.raises(InputError, match="`depths` must be 17 mm or more, .* got 16"):
        tolerance(wet.replace(sample=wet.samples["water"].model_dump()), depths=[16.0, 20.0])


def test_layers_need_room():
    thin = in_gel().windows
    with pytest.raises(
        ValueError, match="`sensor_distance` must be 1.15 mm, as thick as the windows are, or more, got 1"
    ):
        dataclasses.replace(in_gel(), sensor_distance=1.0)
    with pytest.raises(ValueError, match="`surface` must be 2.17 mm, as thick as the layers in front .* got 2 mm"):
        dataclasses.replace(in_gel(), sample=gs.Sample(1.43, surface=2.0, layers=gs.Layers([0.17], [1.523])))
    with pytest.raises(ValueError, match="`sample` must begin beyond the lenses where their curved side is in front"):
        turned = dataclasses.replace(in_gel().array, orientation="curved")
        with_layers(array=turned, sample=gs.Sample(1.33))
    toward = lambda scope: (scope.sensor_distance - 1.0) ** 2
    with pytest.raises(InputError, match="other bounds are needed: `sensor_distance` must be 1.15 mm"):
        gs.optimize(toward, in_gel(), free=gs.free("sensor_distance"))
    # Numbers that JAX traces are let through.
    total = jax.jit(lambda scope: objectives.thickness(dataclasses.replace(scope, windows=thin)))(in_gel())
    assert float(total) == pytest.approx(5.8 + 1.0 + 2.0)


def test_the_report_shows_the_stack():
    wet = wet_design()
    wet = wet.replace(sample=wet.samples["water"].model_dump())
    assert "objects in n = 1.33" in " ".join(overview(wet, datasheet(wet)))
    svg = draw_section(wet)
    for label in (
        "filter, 2 mm, n = 1.461",
        "cover slip, 0.17 mm, n = 1.52",
        "sample, n = 1.33",
        "window, 0.55 mm, n = 1.51",
    ):
        assert label in svg
    # Four of the layers are not air; rays bend at each face.
    assert svg.count('class="layer"') == 4
    path = re.findall('class="ray" d="M([^M"]*)', svg)[0].split("L")
    assert len(path) == 1 + len((17.0, 16.83, 2.0, 0.0)) + len(("vertex", "window's front", "window's back", "sensor"))
    # A ray that leaves the filter goes on as it came.
    places = np.array([[float(x) for x in point.split()] for point in path])
    slopes = np.diff(places[:, 1]) / np.diff(places[:, 0])
    np.testing.assert_allclose(slopes[[2, 5, 7]], slopes[2], rtol=0.03)
    np.testing.assert_allclose(slopes[0], slopes[2] / 1.3355, rtol=0.03)
