"""What MkDocs builds the site of: files of the repository, pages made of docstrings, and tutorials as they ran."""

import html as entities
import re
from pathlib import Path

import execute
import reference
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.plugins import get_plugin_logger
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
PUBLISHED = (
    *("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "LICENSE", "CITATION.cff"),
    *("design/*.md", "design/*.toml", "design/*.svg", "design/studies/*.toml"),
    *("experiments/README.md", "experiments/figures/*.png", "gs_jax/weights/*.md"),
    *("docs/**/*.md", "docs/**/*.svg", "docs/howto/*.png", "docs/tutorials/*.py"),
)
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
_SCRIPT = re.compile(r"(\]\((?:[^)\s]*tutorials/)?\w+)\.py\)")
_log = get_plugin_logger("gs-jax")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """A public name without words fails a strict build; each group of names is a page in the menu."""
    for problem in reference.missing():
        _log.warning(problem)
    menu = next(part["API"] for part in config.nav or [] if "API" in part)
    menu.extend({group.title: group.page} for group in reference.groups())
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The repository's files under their own paths, and pages that are made here beside them."""
    paths = [path for pattern in PUBLISHED for path in sorted(ROOT.glob(pattern))]
    found: dict[str, bytes | str] = {path.relative_to(ROOT).as_posix(): path.read_bytes() for path in paths}
    found |= {group.page: group.text for group in reference.groups()}
    for script in execute.scripts():
        try:
            found |= {f"docs/tutorials/{name}": content for name, content in execute.executed(script).items()}
        except execute.Failed as error:
            raise PluginError(f"{script.name}: {error}") from error
    for path, content in found.items():
        file = File.generated(config, path, content=content)
        # `README.md` is the index of its folder; at the top this is the site's own.
        address = file.dest_uri.removeprefix("docs/")
        file.dest_uri = "readme/index.html" if path == "README.md" else address
        files.append(file)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Pictures and modules are listed where they are; a link to a tutorial's script leads to what it printed."""
    if page.file.src_uri == "docs/gallery.md":
        markdown += reference.gallery(ROOT / "experiments" / "README.md")
    if page.file.src_uri == "docs/api/README.md":
        markdown += reference.modules()
    is_tutorial = page.file.src_uri.startswith("docs/tutorials/") and not page.file.src_uri.endswith("README.md")
    return markdown if is_tutorial else _SCRIPT.sub(r"\1.md)", markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Formulas become MathML, which browsers draw without a script."""

    def mathml(match: re.Match[str]) -> str:
        return convert(entities.unescape(match[2]).strip(), display="block" if match[1] == "div" else "inline")

    return _FORMULA.sub(mathml, html)
