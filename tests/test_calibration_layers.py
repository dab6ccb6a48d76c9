"""Calibration through layers: in air with filter and window in place, then of what is not known about a sample."""

import dataclasses

import numpy as np
import pytest
from click.testing import CliRunner

import gs_jax as gs
from experiments.calibration import device
from gs_jax.__main__ import commands
from gs_jax.calibration.fit import calibrate, self_calibrate
from gs_jax.optics.raytrace import to_numpy

from .test_calibration import MANY, captures, check

FILTER, WINDOW = gs.Layers([2.0], [1.52]), gs.Layers([0.6, 0.55], [1.0, 1.51])
GEL = gs.Sample(1.43, surface=17.0, layers=gs.Layers([0.17], [1.523]))


def layered(kind: str) -> tuple[gs.Imager, gs.Imager]:
    """A tilted device with filter and window, and its design, whose sensor distance is off."""
    actual, design, _ = device(0)
    numbers = {"types": {"radius_of_curvature": np.resize([2.0, 2.05], 60)}, "curved": {"orientation": "curved"}}
    array = dataclasses.replace(actual.array, **numbers.get(kind, {}))
    filters = gs.Layers([0.3, 2.0], [1.0, 1.52]) if kind == "curved" else FILTER
    actual = dataclasses.replace(actual, array=array, filters=filters, windows=WINDOW)
    # In focus, as without layers.
    actual = dataclasses.replace(actual, sensor_distance=to_numpy(actual).sensor_distance_of(5.8))
    array = dataclasses.replace(array, centers=design.array.centers)
    moved = {
        "sensor_distance": 1.03 * float(actual.sensor_distance),
        "rotation": 0.0,
        "shift": (0.0, 0.0),
        "tilt": None,
    }
    return actual, dataclasses.replace(actual, array=array, **moved)


@pytest.mark.parametrize("kind", ["curved", pytest.param("types", marks=pytest.mark.integration)])
def test_a_stack_is_calibrated_in_air(kind):
    actual, design = layered(kind)
    points = MANY[[0, 7]]
    found = calibrate(captures(actual, points), points, design)
    assert found.rms < 0.1
    check(found, actual)


SCENE = np.zeros(9, int)


@pytest.mark.parametrize("kind", ["plano", pytest.param("types", marks=pytest.mark.integration)])
def test_points_of_known_depths_give_surface_and_index(kind):
    actual, _ = layered(kind)
    # In the second, the layers of the design end where the sample begins.
    layers = gs.Layers([2.0, 14.83, 0.17], [1.52, 1.0, 1.523])
    guess = dataclasses.replace(actual, sample=gs.Sample(1.38, 16.5, GEL.layers))
    if kind == "types":
        guess = dataclasses.replace(actual, filters=layers, sample=gs.Sample(1.38))
    actual = dataclasses.replace(actual, sample=GEL)
    found = calibrate(captures(actual, MANY, SCENE), MANY, guess, captures=SCENE, fit=("sample_at", "sample_index"))
    for name, true in (("sample_at_mm", 17.0), ("sample_index", 1.43)):
        assert abs(found.values[name] - true) < 4 * found.deviations[name] < 0.2
    sample = found.imager.sample
    assert sample is not None and sample.surface is not None
    assert float(sample.surface) == found.values["sample_at_mm"]
    # What is not fitted is the imager's.
    assert float(found.imager.sensor_distance) == float(actual.sensor_distance) and not found.mirrored


@pytest.mark.integration
def test_points_that_nobody_knows_do_not_give_an_index():
    wet = dataclasses.replace(layered("plano")[0], sample=GEL)
    image, grid = captures(wet, MANY, SCENE)[0], gs.Grid([17.2, 23.0], (121, 121), 0.05)
    with pytest.raises(gs.InputError, match="do not determine sample_index.*; give the depths of points in the sample"):
        self_calibrate(image, wet, grid, fit=("sample_index",))


@pytest.mark.parametrize(
    ("sample", "fit", "depth", "words"),
    [
        (None, "sample_index", 20.0, "fit: sample_index needs a microscope with a sample, got one in air"),
        (gs.Sample(1.33), "sample_at", 20.0, "fit: sample_at needs a sample behind a gap of air, got one in contact"),
        (GEL, "tilt", 16.0, "positions: depths must be 17 mm, where the sample begins, or more, got 16 mm"),
        (None, "tilt", 1.5, "positions: depths must be 2 mm, where the filters end, or more, got 1.5 mm"),
    ],
)
def test_what_cannot_be_fitted_of_a_sample_is_refused_in_words(sample, fit, depth, words):
    scope = dataclasses.replace(layered("plano")[0], sample=sample)
    with pytest.raises(gs.InputError, match=words):
        calibrate([np.zeros(scope.sensor.shape)], np.array([[0.0, 0.0, depth]]), scope, fit=[fit])


@pytest.mark.integration
def test_the_command_takes_sources_in_air_and_then_a_gel(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    actual, listed = (dataclasses.replace(one, sensor=gs.Sensor((2400, 2400), 0.006)) for one in layered("plano"))
    listed = dataclasses.replace(listed, array=dataclasses.replace(listed.array, size=(14.0, 14.0)))
    gel = {"refractive_index": 1.38, "surface_mm": 16.5, "layers": [{"thickness_mm": 0.17, "refractive_index": 1.523}]}
    design = gs.Design.from_imager(listed, name="small", working_distance_mm=(18.0, 30.0))
    gs.write_design("small.toml", design.replace(samples={"gel": gel}))
    scenes = {"air.tif": actual, "gel.tif": dataclasses.replace(actual, sample=GEL)}
    for name, scope in scenes.items():
        gs.write_capture(name, captures(scope, MANY, SCENE)[0].astype(np.float32))
    lines = [f"1,{x},{y},{z}" for x, y, z in MANY]
    (tmp_path / "p.csv").write_text("\n".join(["capture,x_mm,y_mm,z_mm", *lines]) + "\n")
    run = lambda *options: CliRunner().invoke(commands, ["calibrate", *options, "--positions", "p.csv"])
    told = run("small.toml", "air.tif", "-o", "found.toml")
    assert "sources in air, behind 2 mm of n = 1.52; if they were in a sample: --sample gel" in told.stdout
    found = gs.read_design("found.toml")
    assert found.samples == gs.read_design("small.toml").samples
    assert found.imaging.sensor_distance_mm == pytest.approx(float(actual.sensor_distance), abs=5e-3)
    held = ("--hold", "sensor_distance,rotation,shift,tilt", "--fit", "sample_at,sample_index")
    told = run("found.toml", "gel.tif", "--sample", "gel", *held, "-o", "gel.toml")
    assert "sources in n = 1.4" in told.stdout and "sample_index" in told.stdout
    new = gs.read_design("gel.toml")
    # It moves by eight times the error of the sensor's distance.
    assert new.samples["gel"].surface_mm == pytest.approx(17.0, abs=0.05)
    assert new.samples["gel"].refractive_index == pytest.approx(1.43, abs=0.01)
    assert new.imaging == found.imaging and new.sample == found.sample
