"""Pages of the repository and the site: links, menu, commands, Python, generated pages and drawings."""

import importlib.util
import pkgutil
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import click
import jax
import pytest

import gs_jax as gs
from experiments.calibration import mistakes
from gs_jax.__main__ import COMMANDS, commands
from gs_jax.codesign.study import Study
from gs_jax.design.start import design_keys

from .helpers import design_and_capture

ROOT = Path(__file__).parents[1]
DOCS, DESIGN = ROOT / "docs", ROOT / "design"
TOP = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "gs_jax/weights/MODEL_CARD.md")]
PAGES = [*TOP, *(path for folder in (DOCS, DESIGN, ROOT / "experiments") for path in sorted(folder.rglob("*.md")))]


def module(path: Path):
    spec = importlib.util.spec_from_file_location(f"page_{path.stem}", path)
    assert spec and spec.loader
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def blocks(path: Path, language: str = "") -> list[str]:
    found = re.findall(r"^ *```(\w*)\n(.*?)^ *```", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    return [text for name, text in found if name == language]


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_every_page_is_in_the_menu():
    menu = (DOCS / "mkdocs.yml").read_text(encoding="utf-8")
    tutorials = [path.with_suffix(".md") for path in (DOCS / "tutorials").glob("*.py")]
    assert not [name for name in map(relative, [*PAGES[1:], *tutorials]) if f": {name}" not in menu]


def test_start_page_leads_to_all_parts():
    text = (DOCS / "index.md").read_text(encoding="utf-8")
    for name in ("design/KEYS", "design/LAB", "design/CLUSTER", "design/README", "CONTRIBUTING", "python", "gallery"):
        assert f"{name}.md" in text, name


@pytest.mark.parametrize("path", PAGES, ids=relative)
def test_links_exist(path):
    """In the repository; a strict build checks those of the site, with anchors."""
    for link in re.findall(r"\]\(([^)#:]+)[^):]*\)", path.read_text(encoding="utf-8")):
        assert (path.parent / link).exists(), link


# Commands that a page must show, among others.
SHOWN = {
    "design/LAB.md": set("new-design calibrate reconstruct metrics simulate info".split()),
    "docs/howto/own_numbers.md": set("new-design metrics optimize simulate report tolerance mold mask".split()),
    "design/CLUSTER.md": set("reconstruct optimize pareto train".split()),
}


@pytest.mark.parametrize("path", PAGES, ids=relative)
def test_commands_exist_with_their_options(path):
    shown = set()
    lines = [line.strip() for block in blocks(path) for line in block.replace("\\\n", " ").splitlines()]
    for line in lines:
        if not line.startswith("gs-jax "):
            continue
        _, name, *rest = shlex.split(line, comments=True)
        assert name in COMMANDS, line
        shown.add(name)
        command = commands.get_command(click.Context(commands), name)
        assert command is not None
        options = {option for param in command.params for option in param.opts} | {"--help"}
        assert {word for word in rest if word.startswith("-")} <= options, line
    assert shown >= SHOWN.get(relative(path), set())


@pytest.mark.parametrize("path", PAGES, ids=relative)
def test_names_of_the_package_exist(path):
    """Dotted names such as `gs_jax.optics.psf`, of modules or what is in them."""
    for name in set(re.findall(r"`(gs_jax(?:\.\w+)+)", path.read_text(encoding="utf-8"))):
        assert pkgutil.resolve_name(name) is not None, name


@pytest.mark.integration
@pytest.mark.parametrize("name", ["frameworks", "gradients", "solver"])
def test_python_of_a_page_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": name}
    with jax.numpy_dtype_promotion("standard"):  # as users have it
        for block in blocks(DOCS / "howto" / f"{name}.md", "python"):
            exec(compile(block, name, "exec"), names)


@pytest.mark.integration
def test_readme_is_short_and_its_python_runs(tmp_path):
    """With a small microscope in place of the built-in one."""
    (block,) = blocks(ROOT / "README.md", "python")
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 500
    design_and_capture(tmp_path)
    small = block.replace("gs.geomscope()", 'gs.read_design("design/geomscope.toml")')
    assert small != block
    check = "assert volume.shape == grid.volume_shape"
    subprocess.run([sys.executable, "-c", f"{small}\n{check}"], cwd=tmp_path, check=True)
    assert (tmp_path / "volume.png").exists()


@pytest.mark.integration
def test_python_of_the_python_page_runs(tmp_path):
    """In a folder with a design and a capture, here of a small microscope."""
    printed = blocks(DOCS / "howto" / "python.md", "python")
    assert len(printed) == 4
    design_and_capture(tmp_path)
    checks = (
        "assert volume.shape == clean.shape == grid.volume_shape and estimate.shape == (3, *grid.shape)",
        "assert len(points) == 5 and jnp.isfinite(estimate).all()",
        "assert wet.depth_of(wet.reduced_depth(21.0)) > 20.99",
        "assert jnp.abs(gradient.array.centers).max() > 0 and gradient.sensor_distance != 0",
    )
    subprocess.run([sys.executable, "-c", "\n".join([*printed, *checks])], cwd=tmp_path, check=True)
    assert (tmp_path / "volume.png").exists()


@pytest.mark.parametrize("page, name", [("start", "focused"), ("howto/own_numbers", "mine")])
def test_study_of_a_page_is_valid(page, name):
    (study,) = blocks(DOCS / f"{page}.md", "toml")
    assert Study.model_validate(tomllib.loads(study)).name == name


def test_layers_of_the_page_of_samples_are_valid():
    (layers,) = blocks(DOCS / "howto" / "samples.md", "toml")
    design = gs.geomscope().replace(**tomllib.loads(layers))
    assert float(design.imager("gel").sample_surface) == pytest.approx(19.67)


def test_page_of_keys_is_up_to_date():
    """`python design/keys.py` writes it."""
    text = (DESIGN / "KEYS.md").read_text(encoding="utf-8")
    assert text == module(DESIGN / "keys.py").page()
    for key in design_keys().values():
        assert f"`{key.name}`" in text or f"[{key.name}]" in text, key.name


def test_drawing_of_keys_is_small(tmp_path, monkeypatch):
    keys = module(DESIGN / "keys.py")
    monkeypatch.setattr(keys, "DRAWING", tmp_path / "geometry.svg")
    monkeypatch.setattr(keys, "PAGE", tmp_path / "KEYS.md")
    keys.main()
    for path in (tmp_path / "geometry.svg", DESIGN / "geometry.svg"):
        assert 10_000 < path.stat().st_size < 200_000


@pytest.mark.parametrize("name", ["chief-ray", "light-path", "field", "stray-light", "imports"])
def test_drawings_are_up_to_date(name):
    """`python docs/drawings.py` draws them; that of imports depends on the modules."""
    drawing = (DOCS / "drawings" / f"{name}.svg").read_text(encoding="utf-8")
    assert drawing == module(DOCS / "drawings.py").DRAWINGS[name]()


def test_residuals_of_calibration_mistakes():
    """As the laboratory guide lists them, in pixels RMS."""
    residuals = {name: rms for name, rms, _ in mistakes()}
    listed = {"nothing": 0.0, "each centre, 3 um": 1.2, "tilt, 0.5 degrees": 1.2, "all centres, 0.2 %": 0.8}
    listed |= {"one place, 20 um sideways": 0.5, "one depth, 50 um": 0.3, "all depths, 200 um": 0.2}
    assert {name: round(residuals[name], 1) for name in listed} == listed and residuals["two captures swapped"] > 40


def test_contributing_names_what_exists():
    """Files, folders, and words of the code."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    files = [path for folder in ("gs_jax", "tests", "experiments") for path in (ROOT / folder).rglob("*.py")]
    known = {path.name for path in files} | {path.parent.name for path in files} | {path.stem for path in files}
    code = "\n".join(path.read_text(encoding="utf-8") for path in files)
    words, paths = re.findall(r"`(\w+)`", text), re.findall(r"`([\w/-]+(?:/|\.(?:py|yml|html|md)))`", text)
    assert len(words) > 20 and len(paths) > 10
    assert not [
        path
        for path in paths
        if not any((root / path).exists() for root in (ROOT, ROOT / "gs_jax", ROOT / "gs_jax/solvers"))
    ]
    assert not [word for word in words if word not in known and not re.search(rf"\b{word}\b", code)]


def test_version_is_the_same_everywhere():
    from gs_jax import __version__

    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_workflows_call_existing_targets():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    calls = {
        path.stem: set(re.findall(r"run: make (\S+)", path.read_text(encoding="utf-8")))
        for path in (ROOT / ".github" / "workflows").glob("*.yml")
    }
    assert set(calls) == {"tests", "docs", "nightly", "wheels"} and all(calls.values())
    assert set().union(*calls.values()) <= targets


def test_the_short_suite_names_existing_tests():
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    (listed,) = re.findall(r"addprefix tests/test_,(.*?)\)", text.replace("\\\n", " "), re.DOTALL)
    for name in listed.split():
        path, _, test = name.partition("::")
        assert f"def {test}" in (ROOT / "tests" / f"test_{path}").read_text(encoding="utf-8"), name
