"""The example of each public name runs as it is printed."""

import doctest
import importlib.util
import inspect
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
