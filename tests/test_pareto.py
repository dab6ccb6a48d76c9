import itertools
import json
import shlex

import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w
from click.testing import CliRunner

from gs_jax.__main__ import commands
from gs_jax.base.errors import InputError, InputWarning
from gs_jax.codesign import pareto, search
from gs_jax.codesign.pareto import as_json, non_dominated, picture, trade_off
from gs_jax.codesign.search import run_study
from gs_jax.codesign.study import Study, read_study
from gs_jax.design.design import write_design
from gs_jax.design.start import geomscope
from gs_jax.io.provenance import read_provenance

from .helpers import compilations

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
    with pytest.warns(InputWarning, match="aperture_diameter_mm starts at 1.486 instead of 2, to begin within"):
        return trade_off(geomscope(), Study.model_validate(STUDY))


@pytest.mark.integration
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


@pytest.mark.integration
def test_a_search_that_ends_in_no_number_spoils_no_other(monkeypatch):
    calls, run = [0], search.run

    def first_lost(steps, state, *arguments, **options):
        calls[0] += 1
        if calls[0] == 1:
            state = state._replace(cost=state.cost * np.nan)
        return run(steps, state, *arguments, **options)

    monkeypatch.setattr(search, "run", first_lost)
    found = trade_off(geomscope().replace(aperture_diameter_mm=1.4), Study.model_validate(STUDY))
    assert np.isfinite(found.values).all() and found.best[1:].all()


def test_a_looser_limit_has_no_worse_design(monkeypatch):
    """A search that finds a narrow lens in both rounds gets the design of the tighter limit; the others stay."""

    def stuck(problem, terms, values, **options):
        limit = terms[-1].at_least
        found = {3.0: 0.15, 6.0: 0.2, 12.0: 0.1}[limit]
        starts.append((limit, float(values["aperture_diameter_mm"])))
        return values | {"aperture_diameter_mm": jnp.asarray(found)}

    starts = []
    monkeypatch.setattr(pareto, "run_stages", stuck)
    with pytest.warns(InputWarning, match="aperture_diameter_mm starts at 1.486 instead of 2"):
        found = trade_off(geomscope(), Study.model_validate(STUDY))
    light, depth = found.values.T
    assert [float(point.values["aperture_diameter_mm"]) for point in found.points] == [0.2, 0.2, 0.1]
    assert light[0] == light[1] > light[2] > 0 and depth[0] == depth[1] < depth[2]
    assert [point.limits for point in found.points] == [(3.0,), (6.0,), (12.0,)] and found.best.all()
    # All start from the design; then each from the one before it, and on the way back from the one after it.
    assert {start for _, start in starts[:3]} == {2.0} and [limit for limit, _ in starts[:3]] == [3.0, 6.0, 12.0]
    assert starts[3:] == [(6.0, 0.15), (12.0, 0.2), (6.0, 0.1), (3.0, 0.2)]


def test_neighbours_differ_by_one_step_of_one_limit():
    """Whatever their order in the file."""
    combinations = list(itertools.product((2.0, 8.0, 5.0), (0.1, 0.2)))
    neighbours, ranks = pareto._neighbours(combinations)
    near = [{combinations[other] for other in others} for others in neighbours]
    assert ranks.tolist() == [0, 1, 2, 3, 1, 2]
    assert near[0] == {(2.0, 0.2), (5.0, 0.1)} and near[-1] == {(5.0, 0.1), (2.0, 0.2), (8.0, 0.2)}
    assert pareto._neighbours([(1.0,)])[0] == [[]]


# Focus by the distance of the sensor; then the widest lens with that depth of field.
SPLIT = STUDY | {
    "free": {"sensor_distance_mm": [2.0, 6.5], "aperture_diameter_mm": [0.1, 1.5]},
    "terms": [
        {"name": "focus_offset", "at_most": 0.2},
        {"name": "light_percent", "maximise": 0.001},
        {"name": "depth_of_field_mm", "at_least": 3.0, "weight": 30.0},
    ],
    "stages": [
        {"solver": "levenberg-marquardt", "free": ["sensor_distance_mm"], "terms": ["focus_offset"]},
        {
            "solver": "levenberg-marquardt",
            "free": ["aperture_diameter_mm"],
            "terms": ["light_percent", "depth_of_field_mm"],
        },
    ],
}


@pytest.mark.integration
def test_stages_keep_what_the_one_before_found():
    """Stages that free different parameters; each search ends where `run_study` does with the same limit."""
    start = geomscope(sensor_distance_mm=4.0).replace(aperture_diameter_mm=1.4)
    sizes = []
    found = trade_off(start, Study.model_validate(SPLIT), each=lambda front: sizes.append(len(front.points)))
    assert sizes == list(range(1, len(found.points) + 1))  # what is done is shown as it is found
    for point, wanted in zip(found.points, (3.0, 6.0, 12.0), strict=True):
        offset, light, depth = point.rows
        assert point.feasible and offset.high <= 0.2 and depth.low >= wanted
        limit = {"name": "depth_of_field_mm", "at_least": wanted, "weight": 30.0}
        alone = Study.model_validate(SPLIT | {"pareto": [], "terms": [*SPLIT["terms"][:2], limit]})
        np.testing.assert_allclose(light.low, run_study(start, alone).after[1].low, rtol=1e-2)


@pytest.mark.integration
def test_every_stage_compiles_once():
    """However many limits there are, and whatever the stage before it found."""

    def front(*limits):
        study = SPLIT | {"pareto": [{"name": "depth_of_field_mm", "at_least": limits}]}
        return trade_off(geomscope(sensor_distance_mm=4.0), Study.model_validate(study))

    front(3.0)
    before = compilations()
    front(3.0, 6.0, 12.0)
    assert compilations() == before


def test_a_study_without_limits_that_move():
    with pytest.raises(InputError, match="`pareto` must be one or two tables"):
        trade_off(geomscope(), Study.model_validate(STUDY | {"pareto": []}))


@pytest.mark.integration
def test_the_command_reads_its_study_once_and_signs_its_numbers(tmp_path, monkeypatch):
    """The command, the study and the design with their hashes, and the design's text; from the first point on."""
    read, counted = [], lambda path: read.append(path) or read_study(path)
    monkeypatch.setattr("gs_jax.codesign.study.read_study", counted)
    monkeypatch.setattr("gs_jax.codesign.search.read_study", counted)
    write_design(tmp_path / "start.toml", geomscope())
    limit = {"name": "depth_of_field_mm", "at_least": [3.0]}
    (tmp_path / "study.toml").write_text(tomli_w.dumps(STUDY | {"design": "start.toml", "pareto": [limit]}))
    arguments = ["pareto", str(tmp_path / "study.toml"), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(commands, arguments)
    assert done.exit_code == 0, done.output
    # The first line, or the one after a warning of the start, which a process prints once.
    lines = [line for line in done.output.splitlines() if not line.startswith("gs-jax: aperture_diameter_mm starts at")]
    assert len(read) == 1 and lines[0].startswith("depth_of_field_mm >=  light_percent")
    assert "1 of 1 points on the front" in done.output and (tmp_path / "out" / "pareto.png").exists()
    found = read_provenance(tmp_path / "out" / "pareto.json")
    assert found["command"] == shlex.join(["gs-jax", *arguments]) and "[lens]" in found["design"]
    assert all(found[f"input {name}"].startswith("sha256 ") for name in ("study.toml", "start.toml"))
    shown = CliRunner().invoke(commands, ["info", str(tmp_path / "out" / "pareto.json")])
    assert found["command"] in shown.output and found["software"] in shown.output


def test_numbers_and_picture(front, tmp_path):
    numbers = as_json(front)
    assert json.loads(json.dumps(numbers, allow_nan=False)) == numbers
    assert [entry["term"] for entry in numbers["objectives"]] == ["light_percent", "depth_of_field_mm"]
    assert all(point["on_front"] and point["feasible"] for point in numbers["points"])
    assert [point["limits"] for point in numbers["points"]] == [{"depth_of_field_mm": x} for x in (3.0, 6.0, 12.0)]
    picture(front).savefig(tmp_path / "a.png")
