"""Pages for people: of all keys, and for the lab."""

import importlib.util
import re
import shlex
from pathlib import Path

import click
import pytest

from experiments.calibration_errors import run
from gs_jax.__main__ import COMMANDS, commands
from gs_jax.design.keys import design_keys

ROOT = Path(__file__).parents[1]
DESIGN = ROOT / "design"


def script():
    spec = importlib.util.spec_from_file_location("keys_page", DESIGN / "keys.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_of_keys_is_what_the_fields_say():
    """`python design/keys.py` writes it anew."""
    text = (DESIGN / "KEYS.md").read_text(encoding="utf-8")
    assert text == script().page()
    for key in design_keys().values():
        assert f"`{key.name}`" in text or f"[{key.name}]" in text, key.path


def test_the_drawing_is_drawn_and_small(tmp_path, monkeypatch):
    module = script()
    monkeypatch.setattr(module, "DRAWING", tmp_path / "geometry.svg")
    monkeypatch.setattr(module, "PAGE", tmp_path / "KEYS.md")
    module.main()
    for path in (tmp_path / "geometry.svg", DESIGN / "geometry.svg"):
        assert 10_000 < path.stat().st_size < 200_000


@pytest.mark.parametrize(
    "path", [ROOT / "README.md", *(DESIGN / f"{n}.md" for n in ("README", "KEYS", "LAB", "CLUSTER"))]
)
def test_links_lead_somewhere(path):
    for link in re.findall(r"\]\(([^)#:]+)[^):]*\)", path.read_text(encoding="utf-8")):
        assert (path.parent / link).exists(), link


def test_the_start_page_leads_to_all():
    text = (ROOT / "docs" / "index.md").read_text()
    assert all(f"design/{name}.md" in text for name in ("KEYS", "LAB", "CLUSTER"))


@pytest.mark.parametrize(
    "page, named",
    [
        ("LAB.md", {"new-design", "calibrate", "reconstruct", "metrics", "simulate", "info"}),
        ("CLUSTER.md", {"reconstruct", "optimize", "pareto", "train"}),
    ],
)
def test_the_commands_of_a_page_exist(page, named):
    """Each with options that it has."""
    text = (DESIGN / page).read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line for block in re.findall(r"```\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]
    said = [shlex.split(line, comments=True) for line in lines if line.startswith("gs-jax ")]
    assert {words[1] for words in said} >= named
    for _, name, *rest in said:
        assert name in COMMANDS
        command = commands.get_command(click.Context(commands), name)
        assert command is not None
        known = {option for param in command.params for option in param.opts}
        assert {word for word in rest if word.startswith("-")} <= known, (name, rest)


def test_what_mistakes_of_calibration_leave():
    """As the page for the lab has it, in pixels RMS."""
    left = {name: rms for name, rms, _ in run()}
    said = {"nothing": 0.0, "each centre, 3 um": 1.2, "tilt, 0.5 degrees": 1.2, "all centres, 0.2 %": 0.8}
    said |= {"one place, 20 um sideways": 0.5, "one depth, 50 um": 0.3, "all depths, 200 um": 0.2}
    assert {name: round(left[name], 1) for name in said} == said and left["two captures swapped"] > 40


def test_contributing_names_what_exists():
    """Files, and words of the code."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    files = [path for folder in ("gs_jax", "tests", "experiments") for path in (ROOT / folder).rglob("*.py")]
    known = {path.name for path in files} | {path.parent.name for path in files} | {path.stem for path in files}
    code = "\n".join(path.read_text(encoding="utf-8") for path in files)
    words, paths = re.findall(r"`(\w+)`", text), re.findall(r"`([\w/-]+\.(?:py|yml|html|md))`", text)
    assert len(words) > 20 and len(paths) > 10
    assert not [path for path in paths if not (ROOT / path).exists() and path not in known]
    assert not [word for word in words if word not in known and not re.search(rf"\b{word}\b", code)]
