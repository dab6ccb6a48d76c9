import dataclasses
import json

import jax
import numpy as np
import pytest

import gs_jax as gs
from experiments.common import local_maxima, points_of
from experiments.design_judge import KINDS, Settings, image_of, make_scene
from experiments.through_layers import on_points, scope_of
from gs_jax import Grid, localization, read_capture, read_design, reconstruct
from gs_jax.base.progress import Progress
from gs_jax.reconstruction.pipeline import METHODS, PIXELS_PER_VOXEL, voxel_grid
from gs_jax.reconstruction.residual import jackknife_deviation, kept_pixels_of_folds

from .helpers import needs, shares_within
from .test_matrix import as_users_do, cropped

pytestmark = pytest.mark.integration


def test_plain_back_projection_shows_ray_traced_points():
    """Voxels of 0.03 mm and planes 0.2 mm apart; half of a voxel's diagonal is 21 um."""
    needs("geomscope/centers.csv")
    data = needs("oracle/dev/P1_d.tif").parent
    scope = read_design(data / "P1.toml").imager()
    grid = Grid.over(scope.sensor, depths=np.arange(17.6, 22.41, 0.2), pitch=0.03)
    volume, truth = reconstruct(read_capture(data / "P1_d.tif", scope.sensor.shape), scope, grid), points_of(data, "d")
    lowest = np.quantile(volume[::3, ::7, ::7], 1 - 1e-4)
    peaks = local_maxima(volume, grid, min_distance=2, threshold_abs=lowest)
    peaks = peaks[np.argsort(-peaks[:, 3])]
    # The paper's resolution, laterally and axially.
    every, brightest = (localization(some, truth, lateral=0.04, axial=0.3) for some in (peaks, peaks[: len(truth)]))
    assert every.recall >= 0.95 and brightest.precision >= 0.9 and every.lateral_rmse <= 0.02


def test_deviations_hold_for_ray_traced_scenes():
    """Of scenes to which nothing was fitted, near 68 % of bright voxels are right within one, and 90 % within two."""
    settings = Settings((18.0, 22.0), field=2.6, rays=600, scale=2.0)
    with as_users_do("float32"):
        imager = cropped("geomscope").imager()
        grid = voxel_grid(imager, list(np.arange(18.0, 22.1, 0.8)), pixels=PIXELS_PER_VOXEL)
        # One for all scenes, as is `cross_validated` for one.
        reconstructor = gs.Reconstructor(imager, grid, METHODS["list-rl"](20))
        folds = [reconstructor.keeping(kept) for kept in kept_pixels_of_folds(reconstructor.problem.imager, 4)]
        for kind in KINDS:
            scene = make_scene(kind, 0, settings)
            light = image_of(scene, imager, settings).astype(np.float32)
            image = np.asarray(gs.expose(light, gs.Camera(), jax.random.key(0), peak_electrons=2e4))
            volume, deviation = reconstructor(image), jackknife_deviation([fold(image) for fold in folds])
            truth = np.asarray(gs.rasterize(scene.emitters, grid))
            one, two = shares_within(volume, deviation, truth, imager, grid)
            assert 0.6 <= one <= 0.76 and two >= 0.9, (kind, one, two)


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
