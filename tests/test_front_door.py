"""What `import gs_jax` offers: the names, their first lines, and the script that a newcomer writes first."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import gs_jax as gs
from gs_jax import InputError

from .helpers import design_and_capture

ROOT = Path(__file__).parents[1]


@pytest.mark.integration
def test_files_take_strings_and_paths(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    points = design_and_capture(tmp_path)
    assert gs.read_design(tmp_path / "design" / "geomscope.toml") == gs.read_design("design/geomscope.toml")
    for path in ("points.csv", tmp_path / "points.csv"):
        gs.write_points(path, points)
        np.testing.assert_array_equal(gs.read_points(path), points)


def test_help_lists_every_name_with_its_first_line():
    """The package's docstring is its table of contents; what it says of a name is what the name says of itself."""
    listed = dict(re.findall(r"^    (\w+) {2,}(.+)$", gs.__doc__ or "", re.MULTILINE))
    assert sorted(listed) == sorted(name for name in gs.__all__ if not name.startswith("_"))
    assert 30 <= len(listed) <= 59  # as lineax 0.1.1 has
    for name, line in listed.items():
        assert line == (inspect.getdoc(getattr(gs, name)) or "").split("\n")[0].rstrip("."), name


def test_every_public_function_documents_its_arguments_or_needs_no_words():
    for name in gs.__all__:
        value = getattr(gs, name)
        if inspect.isfunction(value) and len(inspect.signature(value).parameters) > 2:
            assert "Parameters\n" in (inspect.getdoc(value) or ""), name


def test_every_name_says_in_one_word_what_it_is():
    """By itself in the second paragraph, where the API pages have it in the same place for all."""
    for name in set(gs.__all__) - {"__version__"}:
        paragraphs = (inspect.getdoc(getattr(gs, name)) or "").split("\n\n")
        assert paragraphs[1] in ("*Differentiable.*", "*Compiled.*", "*Host.*", "*File.*"), name


ARRAY = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
SCOPE = gs.Imager(ARRAY, gs.Sensor((32, 32), 0.12), sensor_distance=5.8, field_radius=3.0)
GRID = gs.Grid.over(SCOPE.sensor, depths=[19.0, 21.0], pitch=0.5)
IMAGE, VOLUME, POINT = np.ones((32, 32)), np.ones(GRID.volume_shape), np.array([[0.0, 0.0, 20.0, 1.0]])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda a, s: gs.simulate(a * POINT, SCOPE),
            "simulate cannot be traced.*`forward` with a PSF that",
        ),
        (lambda a, s: gs.psf_model(s, GRID), "psf_model cannot be traced.*`gs_jax.optics.psf`"),
        (lambda a, s: gs.reconstruct(a * IMAGE, SCOPE, GRID), "reconstruct cannot be traced.*`solve` or `backproject`"),
        (lambda a, s: gs.reconstruct(IMAGE, s, GRID), "reconstruct cannot be traced"),
        (lambda a, s: gs.forward_residual(a * VOLUME, IMAGE, SCOPE, GRID), "traced.*`forward`"),
        (lambda a, s: gs.deconvolve(a * IMAGE, IMAGE), "traced.*`solve` with a `ConvolutionOperator`"),
        (lambda a, s: gs.fit_surface(a * IMAGE, SCOPE, GRID), "traced"),
        (lambda a, s: gs.find_points(a * IMAGE, SCOPE, GRID), "traced"),
        (lambda a, s: gs.cross_validated(a * IMAGE, SCOPE, GRID), "traced"),
        (lambda a, s: gs.suppress(a * VOLUME), "traced"),
        (lambda a, s: gs.quality(a * VOLUME, VOLUME), "traced"),
        (lambda a, s: gs.localization(a * POINT, POINT), "traced"),
        (lambda a, s: gs.show(a * VOLUME, GRID), "traced"),
        (lambda a, s: gs.optimize(lambda i: i.wavelength, s, free=gs.free("wavelength")), "traced"),
        (lambda a, s: gs.write_points("a.csv", a * POINT), "traced"),
        (lambda a, s: gs.write_volume("a.tif", a * VOLUME, GRID), "traced"),
        (lambda a, s: gs.write_capture("a.tif", a * IMAGE), "traced"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_host_code_within_a_gradient_says_so(call, words):
    """In one line, with what can be differentiated in its place, before it does anything."""
    with pytest.raises(InputError, match=words):
        jax.eval_shape(call, 1.0, SCOPE)


def test_importing_the_package_is_quick_work():
    """Names are loaded when they are asked for: the package alone imports neither JAX nor NumPy."""
    code = "import sys, gs_jax; print({'jax', 'numpy', 'matplotlib'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_a_design_says_what_it_is_in_a_few_lines():
    lines = repr(gs.read_design(ROOT / "design" / "geomscope.toml")).splitlines()
    assert len(lines) == 4 and "geomscope" in lines[0] and "200 lenses" in lines[1] and "520 nm" in lines[3]
