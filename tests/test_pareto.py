import json

import numpy as np
import pytest

from gs_jax.base.progress import Progress
from gs_jax.codesign import pareto as module
from gs_jax.codesign.pareto import as_json, non_dominated, picture, sweep
from gs_jax.codesign.study import Study
from gs_jax.designs.builtin import geomscope

STUDY = {
    "depths_mm": (18.0, 23.0),
    "depth_count": 2,
    # Wider discs are cut by their neighbours: their area, and so the light, hardly grows any more.
    "free": {"aperture_diameter_mm": [0.1, 1.5]},
    "terms": [{"name": "light_percent", "maximise": 0.001}],
    "stages": [{"solver": "levenberg-marquardt"}],
    "pareto": [{"name": "depth_of_field_mm", "at_least": [3.0, 6.0, 12.0]}],
}


def test_non_dominated_against_the_definition():
    losses = np.random.default_rng(0).integers(0, 5, (60, 3)).astype(float)
    beats = lambda a, b: (a <= b).all() and (a < b).any()
    expected = [not any(beats(a, b) for a in losses) for b in losses]
    np.testing.assert_array_equal(non_dominated(losses), expected)


def test_equal_points_do_not_beat_each_other():
    np.testing.assert_array_equal(non_dominated(np.array([[1.0, 2.0], [1.0, 2.0], [2.0, 2.0]])), [True, True, False])
    assert non_dominated(np.zeros((0, 2))).shape == (0,)


@pytest.fixture(scope="module")
def front():
    with Progress() as progress:
        return sweep(geomscope(), Study.model_validate(STUDY), progress=progress)


def test_light_against_depth_of_field(front):
    """Eq. 8 alone: the widest lens with that depth of field, found by a scan.

    A limit is tightened by 0.5 %, and the light goes with the square of the diameter: 2 % is what may be missing.
    """
    imager = geomscope().imager()
    f, z = float(imager.array.focal_length), float(imager.reduced_depth(20.5))
    diameters = np.linspace(0.1, 1.5, 20_000)
    spread = 0.009 * f / diameters * (z - f)
    span = z * f**2 * (1 / np.maximum(f**2 - spread, 1e-12) - 1 / (f**2 + spread))
    for (light, reached), wanted in zip(front.values, (3.0, 6.0, 12.0), strict=True):
        assert reached >= wanted
        widest = diameters[span >= wanted].max()
        far = float(imager.reduced_depth(23.0))
        np.testing.assert_allclose(light, 100 * 200 * np.pi * 9 / 400 * (widest / 4 / far) ** 2, rtol=0.02)
    assert front.best.all()


def test_a_search_that_ends_in_no_number_spoils_no_other(monkeypatch):
    calls, run = [0], module.run

    def first_lost(steps, state, *arguments, **options):
        calls[0] += 1
        if calls[0] == 1:
            state = state._replace(cost=state.cost * np.nan)
        return run(steps, state, *arguments, **options)

    monkeypatch.setattr(module, "run", first_lost)
    with Progress() as progress:
        found = sweep(geomscope(), Study.model_validate(STUDY), progress=progress)
    assert np.isfinite(found.values).all() and found.best[1:].all()


def test_numbers_and_picture(front, tmp_path):
    numbers = as_json(front)
    assert json.loads(json.dumps(numbers, allow_nan=False)) == numbers
    assert [entry["term"] for entry in numbers["objectives"]] == ["light_percent", "depth_of_field_mm"]
    assert all(point["on_front"] and point["feasible"] for point in numbers["points"])
    picture(front).savefig(tmp_path / "a.png")
