"""Tutorials as they ran: scripts in the percent format, to pages with what they print and draw."""

import hashlib
import json
from pathlib import Path
from tempfile import TemporaryDirectory

import jupytext
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbconvert import MarkdownExporter

ROOT = Path(__file__).parents[1]
# What ran is kept until the script, or the package, is another one.
KEPT = ROOT / "out" / "docs" / "tutorials"
_SECONDS = 900


class Failed(RuntimeError):
    """A tutorial's script did not run to its end."""


def scripts() -> list[Path]:
    """Of all tutorials."""
    return sorted((ROOT / "docs" / "tutorials").glob("*.py"))


def executed(script: Path) -> dict[str, bytes | str]:
    """A tutorial's page and its pictures, by name."""
    kept = KEPT / f"{script.stem}-{_state(script)}"
    if not kept.exists():
        _run(script, kept)
    return {path.name: path.read_bytes() for path in kept.iterdir()}


def _run(script: Path, kept: Path) -> None:
    notebook = jupytext.read(script)
    # A kernel that only this process talks to need not warn of others.
    options = {"timeout": _SECONDS, "extra_arguments": ["--IPKernelApp.log_level=ERROR"], "coalesce_streams": True}
    with TemporaryDirectory() as folder:
        try:
            NotebookClient(notebook, resources={"metadata": {"path": folder}}, **options).execute()
        except CellExecutionError as error:
            raise Failed(str(error)) from error
    resources = {"unique_key": script.stem, "output_files_dir": "."}
    page, made = MarkdownExporter().from_notebook_node(notebook, resources)
    found = {name.removeprefix("./"): data for name, data in made["outputs"].items()}
    end = f"\n\nThis page is the script [`{script.name}`]({script.name}), as it ran.\n"
    found[f"{script.stem}.md"] = (page.replace("](./", "](") + end).encode()
    new = kept.with_name(f"{kept.name}.new")
    new.mkdir(parents=True, exist_ok=True)
    for name, data in found.items():
        (new / name).write_bytes(data)
    new.rename(kept)


def _state(script: Path) -> str:
    """A hash of the script and of the package."""
    files = [script, *sorted((ROOT / "gs_jax").rglob("*.py")), Path(__file__)]
    texts = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in files}
    return hashlib.sha256(json.dumps(texts).encode()).hexdigest()[:12]
