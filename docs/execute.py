"""Execute tutorials: scripts in the percent format become pages with their output and pictures."""

import hashlib
import json
from pathlib import Path
from tempfile import TemporaryDirectory

import jupytext
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbconvert import MarkdownExporter

ROOT = Path(__file__).parents[1]
# Cache of outputs, valid until the script or the package changes.
CACHE = ROOT / "out" / "docs" / "tutorials"
_SECONDS = 900


class TutorialError(RuntimeError):
    """A tutorial's script failed."""


def scripts() -> list[Path]:
    """Scripts of all tutorials."""
    return sorted((ROOT / "docs" / "tutorials").glob("*.py"))


def page_and_pictures(script: Path) -> dict[str, bytes | str]:
    """Return the page and the pictures of a tutorial, by name."""
    cached = CACHE / f"{script.stem}-{_state(script)}"
    if not cached.exists():
        _run(script, cached)
    return {path.name: path.read_bytes() for path in cached.iterdir()}


def _run(script: Path, cached: Path) -> None:
    notebook = jupytext.read(script)
    # Suppresses a warning about connections to the kernel by other processes.
    options = {"timeout": _SECONDS, "extra_arguments": ["--IPKernelApp.log_level=ERROR"], "coalesce_streams": True}
    with TemporaryDirectory() as folder:
        try:
            NotebookClient(notebook, resources={"metadata": {"path": folder}}, **options).execute()
        except CellExecutionError as error:
            raise TutorialError(str(error)) from error
    resources = {"unique_key": script.stem, "output_files_dir": "."}
    page, resources = MarkdownExporter().from_notebook_node(notebook, resources)
    files = {name.removeprefix("./"): data for name, data in resources["outputs"].items()}
    end = f"\n\nThis page is the script [`{script.name}`]({script.name}), with its output.\n"
    files[f"{script.stem}.md"] = (page.replace("](./", "](") + end).encode()
    temporary = cached.with_name(f"{cached.name}.temporary")
    temporary.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (temporary / name).write_bytes(data)
    temporary.rename(cached)


def _state(script: Path) -> str:
    """Hash of the script and of the package."""
    files = [script, *sorted((ROOT / "gs_jax").rglob("*.py")), Path(__file__)]
    texts = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in files}
    return hashlib.sha256(json.dumps(texts).encode()).hexdigest()[:12]
