import json

import jax.numpy as jnp
import numpy as np
import pytest

from gs_jax.base.errors import InputError
from gs_jax.codesign import search
from gs_jax.codesign.limits import limits_of
from gs_jax.codesign.parameters import start_values
from gs_jax.codesign.search import Log, Stage, problem_of, read_checkpoint, run_study
from gs_jax.codesign.search_report import before_and_after, picture, write_outcome
from gs_jax.codesign.solve import NOT_FINITE
from gs_jax.codesign.study import Study, read_study
from gs_jax.design.design import read_design, write_design
from gs_jax.design.start import geomscope

from .helpers import compilations

TERMS = [
    {"name": "lateral_resolution_um", "at_most": 40.0},
    {"name": "focus_offset", "at_most": 0.5},
    {"name": "occupancy", "at_most": 0.5},
    {"name": "lenses_per_point", "at_least": 12.0},
]
FREE = {"sensor_distance_mm": [2.0, 6.0], "radius_of_curvature_mm": [1.0, 3.0], "pitch_mm": [1.0, 1.5]}
LM = {"solver": "levenberg-marquardt"}


def study(**changes):
    base = {"depths_mm": (18.0, 23.0), "depth_count": 3, "free": FREE, "terms": TERMS, "stages": [LM]}
    return Study.model_validate(base | changes)


@pytest.fixture(scope="module")
def table1():
    return geomscope(sensor_distance_mm=4.0)


@pytest.fixture(scope="module")
def outcome(table1):
    return run_study(table1, study(starts=2))


@pytest.mark.integration
def test_from_table_1_to_the_targets(table1, outcome):
    assert [row.met for row in outcome.before] == [True, False, False, True]
    assert all(row.met for row in outcome.after)
    assert {end["reason"] for end in outcome.log.ends} == {"all targets are met"}
    assert outcome.design.imaging.working_distance_mm == (18.0, 23.0)
    # What is judged is what is written: f and v in focus within the range, by the thin lens's formula.
    imager = outcome.design.imager()
    in_focus = 1 / (1 / imager.array.focal_length - 1 / imager.sensor_distance) - imager.reduced_depth(0.0)
    assert 18 < in_focus < 23


def test_other_numbers_find_the_programs(table1, outcome):
    """Another design and other bounds, targets, weights and depths: no compilation."""
    terms = [term | {"weight": 2.0} | {k: 1.1 * v for k, v in term.items() if k != "name"} for term in TERMS]
    free = FREE | {"sensor_distance_mm": [2.5, 5.5]}
    before = compilations()
    found = run_study(
        table1.replace(sensor_distance_mm=4.2),
        study(starts=2, terms=terms, free=free, depths_mm=(18.5, 22.5), margin=0.01),
    )
    assert compilations() == before and all(row.met for row in found.after)


@pytest.mark.integration
def test_only_what_is_free_changes(table1, outcome):
    old, new = table1.model_dump(), outcome.design.model_dump()
    assert old["sensor"] == new["sensor"]
    assert old["lens"]["aperture_diameter_mm"] == new["lens"]["aperture_diameter_mm"]
    scale = np.array(new["array"]["size_mm"]) / old["array"]["size_mm"]
    # Written to 1e-4 mm.
    np.testing.assert_allclose(new["array"]["centers_mm"], scale * old["array"]["centers_mm"], atol=2e-4)


def test_files(table1, outcome, tmp_path):
    path = tmp_path / "new.toml"
    paths = write_outcome(path, outcome, parent="a/table1.toml", source="b/study.toml")
    assert [p.name for p in paths] == ["new.toml", "new.toml.json", "new.toml.png"] and all(p.exists() for p in paths)
    written = read_design(path)
    assert written.provenance["parent"] == "table1.toml" and written.provenance["study"] == "study.toml"
    assert written.provenance["objectives"]["occupancy"][1] <= 0.5
    numbers = json.loads(paths[1].read_text())
    assert [term["met_after"] for term in numbers["terms"]] == [True] * 4
    assert len(numbers["starts"]) == 2 and numbers["steps"][0]["step"] == 1
    # Parameters in the units of their keys; those of the best start are the design's.
    best = numbers["starts"][outcome.log.best_end(0)["start"]]["free"]
    assert best["sensor_distance_mm"] == pytest.approx(written.imaging.sensor_distance_mm, abs=1e-4)
    assert all(FREE[name][0] <= end["free"][name] <= FREE[name][1] for end in numbers["starts"] for name in FREE)
    assert before_and_after(outcome).row_count == 4


def interrupted(table1, question, path, monkeypatch, *, writes):
    """A search that is stopped after some checkpoints."""
    count, write = [0], search.write_checkpoint

    def counted(*arguments):
        write(*arguments)
        count[0] += 1
        if count[0] == writes:
            raise KeyboardInterrupt

    monkeypatch.setattr(search, "write_checkpoint", counted)
    with pytest.raises(KeyboardInterrupt):
        run_study(table1, question, checkpoint=path, every=0.0)
    monkeypatch.setattr(search, "write_checkpoint", write)


@pytest.mark.integration
@pytest.mark.parametrize("writes", [pytest.param(6, marks=pytest.mark.slow), 10], ids=["stage 1", "stage 2"])
def test_what_is_resumed_ends_the_same(table1, tmp_path, monkeypatch, writes):
    """Bit for bit, in the second start of the first stage or in the second stage."""
    stages = [LM | {"steps": 4}, {"solver": "adam", "steps": 5, "learning_rate": 0.01}]
    terms = [{"name": "thickness_mm", "minimise": 5.0}, TERMS[0]]
    free = {"sensor_distance_mm": [2.0, 6.0]}
    question = study(starts=2, stages=stages, terms=terms, free=free, depth_count=2)
    whole = run_study(table1, question)
    path = tmp_path / "a.checkpoint"
    interrupted(table1, question, path, monkeypatch, writes=writes)
    assert len(read_checkpoint(path, question, table1)[0].steps) == writes
    resumed = run_study(table1, question, checkpoint=path, resume=True)
    assert resumed.design == whole.design and resumed.log == whole.log


@pytest.mark.integration
def test_wrong_checkpoints(table1, tmp_path, monkeypatch):
    path = tmp_path / "a.checkpoint"
    with pytest.raises(InputError, match="cannot be read"):
        run_study(table1, study(), checkpoint=path, resume=True)
    path.write_bytes(b"{}\n")
    with pytest.raises(InputError, match="not a checkpoint of"):
        run_study(table1, study(), checkpoint=path, resume=True)
    path.write_bytes(b'{"format": "gs-jax checkpoint 6", "of": "", "log": {"steps": 1, "ends": 2}}\n')
    with pytest.raises(InputError, match="not a checkpoint of"):
        run_study(table1, study(), checkpoint=path, resume=True)
    interrupted(table1, study(), path, monkeypatch, writes=1)
    whole = path.read_bytes()
    path.write_bytes(whole[:-30])
    with pytest.raises(InputError, match="a.checkpoint: not a whole and valid checkpoint"):
        run_study(table1, study(), checkpoint=path, resume=True)
    path.write_bytes(whole)
    with pytest.raises(InputError, match="of another study or design"):
        run_study(table1, study(seed=1), checkpoint=path, resume=True)


@pytest.mark.parametrize("kind, bound, at", [("minimise", "at_least", 2.0), ("maximise", "at_most", 6.0)])
def test_a_bound_that_binds(table1, kind, bound, at):
    """The thickness goes with the sensor's distance; nothing binds within the range."""
    question = study(free={"sensor_distance_mm": [2.0, 6.0]}, terms=[{"name": "thickness_mm", kind: 5.0}])
    problem = problem_of(table1, question)
    values = start_values(problem.imager, problem.at)
    stage = Stage.of(problem, 0, question.terms, values)

    def limits(distance):
        moved = values | {"sensor_distance_mm": jnp.asarray(distance)}
        return limits_of(stage.residuals, stage.terms, question, moved, stage.stepper.key)

    assert limits(4.0) == []
    (limit,) = limits(at)
    assert limit[:3] == ("sensor_distance_mm", bound, at) and limit.slope == pytest.approx(1)


def test_random_starts(table1):
    problem = problem_of(table1, study())
    values = start_values(problem.imager, problem.at)
    assert problem.start(values, 0) == values
    first, second = (problem.start(values, number) for number in (1, 2))
    assert all(FREE[name][0] < first[name] < FREE[name][1] and first[name] != second[name] for name in FREE)
    assert first["centers_mm"] is values["centers_mm"]
    assert problem.start(values, 1) == first


def test_lens_centres_can_be_free():
    """Two lenses of three are too near; the mean spacing has a target that moves them, within the plate."""
    design = geomscope()
    centers = ((-3.0, 1.0), (-2.1, 0.2), (0.1, 0.4))
    design = design.model_copy(update={"array": design.array.model_copy(update={"centers_mm": centers})})
    question = study(free={"centers_mm": [-4.0, 4.0]}, terms=[{"name": "spacing_mm", "at_least": 2.0}])
    found = run_study(design, question)
    assert not found.before[0].met and found.after[0].met
    assert np.abs(found.design.array.centers_mm).max() < 4


def test_what_cannot_be_free(table1):
    """The pitch of a single lens, the radius of a thin one, depths behind the plate; everything else can be."""
    array = table1.array.model_copy(update={"centers_mm": ((0.0, 0.0),), "size_mm": (2.0, 2.0)})
    single = table1.model_copy(update={"array": array})
    free = {"sensor_distance_mm": [2.0, 7.0]}
    found = run_study(single, study(free=free, terms=[TERMS[1]]))
    assert found.after[0].met and found.design.array == array
    thin = table1.model_copy(update={"lens": table1.lens.model_copy(update={"focal_length_mm": 4.65})})
    for design, free, words in (
        (single, FREE, "free.pitch_mm.*one lens"),
        (thin, FREE, "free.radius_of_curvature_mm"),
        (table1, {"depth_span_mm": [0.5, 60.0]}, r"depth_span_mm.*below 41"),
    ):
        with pytest.raises(InputError, match=words):
            run_study(design, study(free=free))


def test_the_record_is_that_of_the_start_that_won():
    ends = [
        {"stage": 0, "start": 0, "cost": float("nan"), "met": True, "reason": NOT_FINITE},
        {"stage": 0, "start": 1, "cost": 1.0, "met": True, "reason": "won"},
        {"stage": 0, "start": 2, "cost": 2.0, "met": True, "reason": "lost"},
        {"stage": 0, "start": 3, "cost": 0.5, "met": False, "reason": "missed"},
    ]
    assert Log(ends=ends).best_end(0)["reason"] == "won"


def test_both_limits_of_a_term_are_recorded(table1):
    terms = [{"name": "occupancy", "at_most": 0.5}, {"name": "occupancy", "at_least": 0.2}]
    question = study(terms=terms, free={"sensor_distance_mm": [2.0, 6.0]})
    found = run_study(table1, question)
    last = found.log.steps[-1]
    np.testing.assert_allclose(last["occupancy at_most"], found.after[0].high, rtol=1e-3)
    np.testing.assert_allclose(last["occupancy at_least"], found.after[0].low, rtol=1e-3)
    assert picture(found).axes


def test_no_start_that_ends_anywhere(table1, monkeypatch):
    monkeypatch.setattr(search.TermTable, "target", float("nan"))
    with pytest.raises(InputError, match="no start reached a finite cost"):
        run_study(table1, study())


def test_files_and_objects_are_the_same(table1, tmp_path):
    """A path is read; what is wrong with the study then names its file."""
    write_design(tmp_path / "a.toml", table1)
    text = "[free]\nsensor_distance_mm = [2.0, 6.0]\n[[terms]]\nname = 'occupancy'\nat_most = 0.5\n"
    (tmp_path / "b.toml").write_text(text + "[[stages]]\nsolver = 'levenberg-marquardt'\n")
    found = run_study(str(tmp_path / "a.toml"), tmp_path / "b.toml")
    assert found.parent == table1 and found.study == read_study(tmp_path / "b.toml")
    assert found.design == run_study(table1, found.study).design
    array = table1.array.model_copy(update={"centers_mm": ((0.0, 0.0),)})
    (tmp_path / "b.toml").write_text((tmp_path / "b.toml").read_text().replace("sensor_distance", "pitch"))
    with pytest.raises(InputError, match="`free.pitch_mm` .*b.toml"):
        run_study(table1.model_copy(update={"array": array}), tmp_path / "b.toml")
