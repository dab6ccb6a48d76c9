import dataclasses
import json

import pytest

from experiments.ray_traced_captures import run
from experiments.through_layers import on_points, scope_of
from gs_jax.base.progress import Progress

from .helpers import needs

pytestmark = pytest.mark.integration


def test_every_one_of_120_ray_traced_points_is_a_peak():
    """Coarser than the experiment, which finds all: 0.03 mm voxels, 0.2 mm steps."""
    needs("geomscope/centers.csv")
    data = needs("oracle/dev/P1_d.tif").parent
    result, projection = run(data, singles=["a"], voxel_mm=0.03, step_mm=0.2, progress=Progress())
    assert projection.ndim == 2 and projection.max() > 0
    (single,) = result["single_points"]
    assert single["lateral_error_um"] <= 20 and abs(single["axial_error_um"]) <= 100
    many = result["many_points"]
    assert many["points_that_are_peaks"] >= 0.95 * many["points"]
    assert many["points_among_as_many_brightest_peaks"] >= 0.9 * many["points"]
    assert many["lateral_rmse_um"] <= 20  # half a voxel's diagonal is 21


def test_points_in_a_gel_are_where_they_are():
    """By another group's tracer, through a filter, a window and a cover slip; without them nothing is right."""
    needs("geomscope/centers.csv")
    data = needs("oracle/layers/L_points.tif").parent
    scope = scope_of(data, json.loads((data / "L_points.json").read_text()))
    distance = scope.reduced_sensor_distance - scope.array.reduced_thickness_back
    in_air = dataclasses.replace(scope, sensor_distance=distance, filters=None, windows=None, sample=None)
    result = on_points(data, {"with layers": scope, "layers ignored": in_air}, Progress())
    found = result["with layers"]
    assert found["f1"] >= 0.99 and found["lateral_rmse_um"] <= 4 and found["axial_rmse_um"] <= 30
    assert result["model"]["bin_4"]["correlation"] >= 0.97 and abs(result["model"]["light"] - 1) <= 0.05
    assert result["layers ignored"]["axial_rmse_um"] > 1000
