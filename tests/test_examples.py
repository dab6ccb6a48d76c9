"""The example of each public name runs as it is printed."""

import doctest
import importlib.util
import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import gs_jax as gs

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[1]
NAMES = [name for name in gs.__all__ if not name.startswith("_")]
SLOW = {"calibrate", "Unrolled"}


def reference():
    """What the site's pages of the API are made by."""
    spec = importlib.util.spec_from_file_location("reference", ROOT / "docs" / "reference.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def set_up():
    """Names that all examples start from, made by the examples in the package's docstring."""
    test = doctest.DocTestParser().get_doctest(gs.__doc__ or "", {}, "gs_jax", None, 0)
    assert not doctest.DocTestRunner().run(test, clear_globs=False).failed
    return test.globs


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in NAMES])
def test_the_example_of_a_name_runs(name, set_up, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = inspect.getdoc(getattr(gs, name)) or ""
    test = doctest.DocTestParser().get_doctest(text, dict(set_up), name, None, 0)
    runner = doctest.DocTestRunner(verbose=False, optionflags=doctest.ELLIPSIS)
    # NumPy prints alike in each test, whatever another one set.
    with np.printoptions():
        failed, tried = runner.run(test)
    assert tried and not failed, capsys.readouterr().out


def test_every_public_name_has_words_and_an_example_and_a_page():
    """A strict build of the site fails for the same reasons."""
    module = reference()
    assert not list(module.missing())
    assert sorted(name for group in module.groups() for name in group.names) == sorted(NAMES)


def test_a_name_without_words_is_told(monkeypatch):
    monkeypatch.setattr(gs.quality, "__doc__", None)
    assert list(reference().missing()) == ["quality has no docstring.", "quality has no example."]
    monkeypatch.setattr(gs.quality, "__doc__", "Parameters\n----------\nestimate\n    Of it.\n\n>>> 1")
    assert list(reference().missing()) == ["quality does not say what its parameter truth is."]


# The tutorials of the site run to their ends, at toy size: what they show, the site's build runs at full size.


FOLDER = Path(__file__).parents[1] / "docs" / "tutorials"
# Constants at the top of each, and what they are here.
TOY = {
    "reconstruct": {"PIXELS": "320"},
    "compare": {"HALF": "2.5", "POINTS": "6"},
    "objective": {"STEPS": "3"},
    "device": {"PIXELS": "700", "POINTS": "4"},
    "mold": {"LENSES": "6", "CHORD": "0.005"},
    "recording": {"PIXELS": "400", "FRAMES": "2", "BEADS": "3"},
    "workers": {"PIXELS": "(200,)", "FRAMES": "2"},
}
TUTORIALS_SLOW = {"reconstruct", "compare", "device", "recording", "workers"}


def test_every_tutorial_is_tried():
    assert {path.stem for path in FOLDER.glob("*.py")} == set(TOY)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in TUTORIALS_SLOW else n for n in TOY])
def test_a_tutorial_runs(name, tmp_path):
    text = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
    for constant, value in TOY[name].items():
        text, count = re.subn(rf"^{constant} = [^#\n]+", f"{constant} = {value}  ", text, flags=re.MULTILINE)
        assert count == 1, constant
    script = tmp_path / f"{name}.py"
    script.write_text(f'import matplotlib\nmatplotlib.use("agg")\n{text}', encoding="utf-8")
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True)
    assert not done.returncode, done.stderr
