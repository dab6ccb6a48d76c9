"""Generated pages of the site: public names by group, modules, and figures."""

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import gs_jax
from gs_jax.solvers.base import Solver

PACKAGE = Path(gs_jax.__file__).parent
_GROUP = re.compile(r"^(\w[^\n]+):\n\n((?:    .+\n)+)", re.MULTILINE)


class Group(NamedTuple):
    """A group of public names, as listed by `help(gs_jax)`."""

    title: str
    names: list[str]

    @property
    def page(self) -> str:
        """Path of the page."""
        return f"docs/api/{re.sub(r'[^a-z]+', '-', self.title.lower())}.md"

    @property
    def text(self) -> str:
        """Markdown of the page, for mkdocstrings."""
        names = "\n\n".join(f"::: gs_jax.{name}" for name in self.names)
        return f"# {self.title}\n\n{set_up()}\n\n{names}\n"


def groups() -> list[Group]:
    """Groups of public names, in the order of the package's docstring."""
    matches = _GROUP.findall(gs_jax.__doc__ or "")
    return [Group(title, [line.split()[0] for line in lines.splitlines()]) for title, lines in matches]


def set_up() -> str:
    """The end of the package's docstring: what the examples of all names start from, as Markdown."""
    text, code = (gs_jax.__doc__ or "").rstrip().split("\n\n")[-2:]
    return f"{text}\n\n```python\n{code}\n```"


def public() -> Iterator[tuple[str, object]]:
    """Public names and public members of classes; members that solvers share with `Solver` are left out."""
    for group in groups():
        for name in group.names:
            value = getattr(gs_jax, name)
            yield name, value
            members = vars(value) if inspect.isclass(value) else {}
            for member, what in members.items():
                is_public = not member.startswith("_") and not hasattr(Solver, member)
                if is_public and (isinstance(what, property | classmethod) or inspect.isfunction(what)):
                    yield f"{name}.{member}", getattr(value, member)


def missing() -> Iterator[str]:
    """Complaints about public names without a docstring, an example, or a description of a parameter."""
    for name, value in public():
        text = inspect.getdoc(value) or ""
        if not text:
            yield f"{name} has no docstring."
        if "." in name:
            continue
        if ">>> " not in text:
            yield f"{name} has no example."
        if "Parameters\n---" in text:
            entries = re.findall(r"^([\w, ]+)$\n    ", text.split("Parameters\n")[1], re.MULTILINE)
            described = {each.strip() for line in entries for each in line.split(",")}
            for parameter in inspect.signature(value).parameters:  # type: ignore[arg-type]
                if parameter not in described:
                    yield f"{name} does not say what its parameter {parameter} is."


def modules() -> str:
    """Table of the package's folders and modules with the first line of each docstring."""
    rows = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        private = any(part.startswith("_") and part != "__init__" for part in parts)
        text = re.match(r'"""(.+?)(?:\n\n|""")', path.read_text(encoding="utf-8"), re.DOTALL)
        if parts != ("__init__",) and not private and text:
            name = ".".join(part for part in ("gs_jax", *parts) if part != "__init__")
            bold = "**" if parts[-1] == "__init__" else ""
            rows.append(f"| {bold}`{name}`{bold} | {' '.join(text[1].split())} |")
    return "\n\n| module | |\n|---|---|\n" + "\n".join(rows) + "\n"


def gallery(folder: Path) -> str:
    """Every figure of the pages of results, in the order of the index, with a link to its section."""
    figures = []
    index = (folder / "README.md").read_text(encoding="utf-8")
    for name in dict.fromkeys(re.findall(r"results/(\w+)\.md", index)):
        heading = ""
        for line in (folder / "results" / f"{name}.md").read_text(encoding="utf-8").splitlines():
            if match := re.match(r"##? (.+)", line):
                heading = match[1]
            if match := re.match(r"!\[(.+)\]\(\.\./(.+)\)", line):
                anchor = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
                link = f"[{heading}](../{folder.name}/results/{name}.md#{anchor})"
                figures.append(f"![{match[1]}](../{folder.name}/{match[2]})\n\n{match[1]}: {link}.")
    return "\n\n".join(figures)
