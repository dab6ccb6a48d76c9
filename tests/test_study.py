import sys
import tomllib
from pathlib import Path
from typing import get_args

import pytest

import gs_jax as gs
from gs_jax.base.errors import InputError
from gs_jax.codesign import terms
from gs_jax.codesign.parameters import NAMES
from gs_jax.codesign.study import Solver, Study, TermTable, parent_path, read_study
from gs_jax.codesign.terms import KINDS, TERMS, Term, add_terms

ROOT = Path(__file__).parents[1]
STUDIES = sorted(p for folder in ("design", "experiments/designs") for p in (ROOT / folder / "studies").glob("*.toml"))

STUDY = """
depths_mm = [18.0, 23.0]
[free]
sensor_distance_mm = [2.0, 6.0]
[[terms]]
name = "occupancy"
at_most = 0.5
[[stages]]
solver = "bfgs"
"""


@pytest.fixture
def read(tmp_path):
    def read(text):
        (tmp_path / "study.toml").write_text(text)
        return read_study(tmp_path / "study.toml")

    return read


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_the_studies_of_the_repository_start_from_designs(path):
    study = read_study(path)
    assert parent_path(path, study).exists()


def test_what_a_study_says(read):
    study = read(STUDY)
    assert study.free == {"sensor_distance_mm": (2.0, 6.0)}
    (term,), (stage,) = study.terms, study.stages
    assert (term.kind, term.target, term.weight, term.is_goal) == ("at_most", 0.5, 1.0, False)
    assert (stage.solver, stage.free, stage.terms) == ("bfgs", None, None)
    assert study.scene == {"circle_of_confusion": None, "exposure": 1e4, "detail": 0.04}


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("sensor_distance_mm = [2.0", "sensor_distance = [2.0", "`free`: keys must be among .*, got 'sensor_distance'"),
        ("[2.0, 6.0]", "[6.0, 2.0]", r"must be \[lowest, highest\], .*, got \[6, 2\]"),
        ("[2.0, 6.0]", "[-2.0, 6.0]", "must be above 0"),
        ("[2.0, 6.0]", "[0.0, inf]", "free.sensor_distance_mm"),
        ("[18.0, 23.0]", "[23.0, 18.0]", "near below far"),
        ("[18.0, 23.0]", "[0.0, 23.0]", r"`depths_mm\[0\]` must be .*, got 0.0"),
        ("[18.0, 23.0]", "[18.0]", "`depths_mm"),
        ('"occupancy"', '"ocupancy"', r"`terms\[0\]`: name must be occupancy or one of 27 others, got 'ocupancy'"),
        ('"occupancy"', '"scene_error"', "scene_error is no longer a term; volume_error judges layouts and rec"),
        ("at_most = 0.5", "", "one of at_most, .* must be given, got none"),
        ("at_most = 0.5", "at_most = 0.5\nat_least = 0.1", "got at_most and at_least"),
        ("at_most = 0.5", "at_most = -0.5", "must be a positive number, got -0.5"),
        ("at_most = 0.5", "at_most = 0.5\nunit = 'mm'", r"`terms\[0\].unit`: no such key; the keys are"),
        ('"bfgs"', '"sgd"', r"`stages\[0\].solver` must be one of levenberg.*, got 'sgd'"),
        ('"bfgs"', '"bfgs"\nterms = ["strehl"]', "`stages.terms` must be one or more of occupancy.*, got 'strehl'"),
        ('"bfgs"', '"bfgs"\nfree = ["pitch_mm"]', "`stages.free` must be .*, got 'pitch_mm'"),
        (
            '"bfgs"',
            '"bfgs"\n[[pareto]]\nname = "occupancy"\nat_most = [0.3]',
            "exactly one must .*, got 0",
        ),
        (
            '"bfgs"',
            '"bfgs"\n[[pareto]]\nname = "occupancy"',
            "one of at_most and at_least must be given",
        ),
        ("[[stages]]", "[[terms]]\nname = 'occupancy'\nat_most = 0.4\n[[stages]]", "occupancy must be given once"),
        ("depths_mm", "starts = 0\ndepths_mm", "`starts` must be a whole number from 1.*, got 0"),
        ("depths_mm", "depths_mm = ", "valid TOML"),
    ],
)
def test_a_wrong_study_is_explained_in_one_line(read, old, new, found):
    assert old in STUDY
    with pytest.raises(InputError, match=found) as error:
        read(STUDY.replace(old, new))
    assert "study.toml" in str(error.value) and "\n" not in str(error.value)


def test_names_of_earlier_versions_are_read(read):
    old = STUDY.replace("depths_mm", "kinds = 2\ndepths_mm").replace("occupancy", "web_mm")
    study = read(f'{old}terms = ["web_mm"]\n')
    assert study.types == 2 and study.terms[0].name == "min_wall_mm" and study.stages[0].terms == ("min_wall_mm",)
    with pytest.raises(InputError, match="`kinds`: no such key"):
        read(f"types = 2\n{old}")


def test_a_study_without_a_design(read, tmp_path):
    with pytest.raises(InputError, match="`design` must be the file"):
        parent_path(tmp_path / "study.toml", read(STUDY))


def test_the_readme_names_everything():
    """Terms, parameters and solvers; and its study is one."""
    text = (Path(__file__).parents[1] / "design" / "README.md").read_text().split("## Studies")[1]
    for name in (*TERMS, *NAMES, *get_args(Solver), *KINDS):
        assert f"`{name}`" in text or f"`{name} =" in text, name
    Study.model_validate(tomllib.loads(text.split("```toml")[1].split("```")[0]))


def test_terms_of_other_packages_are_found(monkeypatch):
    """By entry points, when a study names them."""
    mine = Term("twice the sensor's distance", lambda imager, at: 2 * imager.sensor_distance)

    class Point:
        name = "mine_mm"

        def load(self):
            return mine

    found = lambda group, name: [Point()] if (group, name) == ("gs_jax.terms", "mine_mm") else []
    monkeypatch.setattr(terms, "entry_points", found)
    monkeypatch.setattr(terms, "TERMS", dict(TERMS))
    assert TermTable(name="mine_mm", at_most=3.0).kind == "at_most" and terms.TERMS["mine_mm"] is mine
    with pytest.raises(ValueError, match="name must be .* or one of [0-9]+ others, got 'other_mm'"):
        TermTable(name="other_mm", at_most=3.0)


def test_a_study_imports_nothing(read, tmp_path, monkeypatch):
    """A study may come from anybody: reading it executes no code, whatever it names."""
    (tmp_path / "payload.py").write_text("raise SystemExit('executed')")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("payload:cost", "gs_jax.objectives:spot_width", "os:getcwd"):
        with pytest.raises(InputError, match=f"got '{name}'; a study imports no code, --terms FILE.py"):
            read(STUDY.replace('"occupancy"', f'"{name}"'))
        with pytest.raises(InputError, match="imports no code"):
            read(f'{STUDY}[[pareto]]\nname = "{name}"\nat_most = [1.0]')
    assert "payload" not in sys.modules


OWN = """
from gs_jax.codesign.terms import Term

TERMS = {"twice_mm": Term("twice the sensor's distance", lambda imager, at: 2 * imager.sensor_distance)}
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    monkeypatch.setattr(terms, "TERMS", dict(TERMS))
    (tmp_path / "own.py").write_text(OWN)
    return tmp_path / "own.py"


def test_terms_of_a_file_that_a_person_names(read, own):
    add_terms(own)
    assert read(STUDY.replace("occupancy", "twice_mm")).terms[0].name == "twice_mm"
    scope = gs.geomscope().imager()
    assert terms.TERMS["twice_mm"].function(scope, None) == 2 * scope.sensor_distance
    first = terms.TERMS["twice_mm"].source
    add_terms(own)  # again, as a search that is resumed does
    assert terms.TERMS["twice_mm"].source == first and len(first) == 64
    # Not a module that a worker, which has no such file, would import.
    assert terms.TERMS["twice_mm"].function.__module__ not in sys.modules


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 / 0", "own.py: cannot be run: ZeroDivisionError: division by zero"),
        ("def (", "own.py: cannot be run: SyntaxError: "),
        ("x = 1", r"TERMS must be a dictionary from names to .*Term`, got None \(.*own.py\)"),
        ("TERMS = {'a': len}", r"TERMS must be a dictionary .*got {'a': <built-in function len>}"),
        (OWN.replace("twice_mm", "occupancy"), "TERMS must be names that are no terms yet, got occupancy"),
    ],
)
def test_a_wrong_file_of_terms(own, text, message):
    own.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        add_terms(own)
    assert "\n" not in str(error.value) and terms.TERMS == TERMS
    with pytest.raises(InputError, match=r"suffix must be .py"):
        add_terms(own.with_suffix(".txt"))
