"""The pages of the site: their menu, their links, and what they say is to be typed."""

import importlib.util
import re
import shlex
import tomllib
from pathlib import Path

import click
import pytest

from gs_jax.__main__ import COMMANDS, commands
from gs_jax.codesign.study import Study

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))


def module(name: str):
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec and spec.loader
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


def blocks(path: Path, language: str = "") -> list[str]:
    return re.findall(rf"^ *```{language}\n(.*?)^ *```", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def named(path: Path) -> str:
    return path.relative_to(DOCS).as_posix()


def test_every_page_is_in_the_menu():
    menu = (DOCS / "mkdocs.yml").read_text(encoding="utf-8")
    made = [path.with_suffix(".md") for path in (DOCS / "tutorials").glob("*.py")]
    assert not [name for name in map(named, [*PAGES, *made]) if f"docs/{name}" not in menu]


@pytest.mark.parametrize("path", PAGES, ids=named)
def test_links_lead_somewhere(path):
    """In the repository; on the site a strict build looks."""
    for link in re.findall(r"\]\(([^)#:]+)[^):]*\)", path.read_text(encoding="utf-8")):
        assert (path.parent / link).exists(), link


@pytest.mark.parametrize("path", PAGES, ids=named)
def test_commands_exist_with_their_options(path):
    lines = [line.strip() for block in blocks(path) for line in block.replace("\\\n", " ").splitlines()]
    for line in lines:
        if not line.startswith("gs-jax "):
            continue
        _, name, *rest = shlex.split(line, comments=True)
        assert name in COMMANDS, line
        command = commands.get_command(click.Context(commands), name)
        assert command is not None
        known = {option for param in command.params for option in param.opts} | {"--help"}
        assert {word for word in rest if word.startswith("-")} <= known, line


@pytest.mark.integration
@pytest.mark.parametrize("name", ["frameworks", "gradients", "solver"])
def test_the_python_of_a_page_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": name}
    for block in blocks(DOCS / "howto" / f"{name}.md", "python"):
        exec(compile(block, name, "exec"), names)


def test_the_study_of_the_first_ten_minutes_is_one():
    (study,) = blocks(DOCS / "start.md", "toml")
    assert Study.model_validate(tomllib.loads(study)).name == "focused"


@pytest.mark.parametrize("name", ["chief-ray", "field", "core-halo", "imports"])
def test_the_drawings_are_those_that_are_drawn(name):
    """`python docs/drawings.py` draws them anew; that of imports is what the modules say."""
    assert (DOCS / "drawings" / f"{name}.svg").read_text(encoding="utf-8") == module("drawings").DRAWINGS[name]()


def test_the_version_is_said_once():
    from gs_jax import __version__

    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_workflows_call_targets_that_there_are():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    called = {
        path.stem: set(re.findall(r"run: make (\S+)", path.read_text(encoding="utf-8")))
        for path in (ROOT / ".github" / "workflows").glob("*.yml")
    }
    assert set(called) == {"tests", "docs", "wheels"} and all(called.values())
    assert set().union(*called.values()) <= targets
