"""MkDocs hooks: collect files of the repository, API pages from docstrings, and executed tutorials."""

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
    *("CONTRIBUTING.md", "CHANGELOG.md", "LICENSE", "CITATION.cff"),
    *("design/*.md", "design/*.toml", "design/*.svg", "design/studies/*.toml"),
    *("experiments/README.md", "experiments/results/*.md", "experiments/figures/*.png", "gs_jax/weights/*.md"),
    *("docs/**/*.md", "docs/**/*.svg", "docs/howto/*.png", "docs/tutorials/*.py"),
)
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
_SCRIPT = re.compile(r"(\]\((?:[^)\s]*tutorials/)?\w+)\.py\)")
_log = get_plugin_logger("gs-jax")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fail a strict build if a public name has no docstring, and add each group of names to the menu."""
    for problem in reference.missing():
        _log.warning(problem)
    menu = next(part["API"] for part in config.nav or [] if "API" in part)
    menu.extend({group.title: group.page} for group in reference.groups())
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Publish files of the repository under their own paths, and generated pages beside them."""
    paths = [path for pattern in PUBLISHED for path in sorted(ROOT.glob(pattern))]
    contents: dict[str, bytes | str] = {path.relative_to(ROOT).as_posix(): path.read_bytes() for path in paths}
    contents |= {group.page: group.text for group in reference.groups()}
    for script in execute.scripts():
        try:
            pages = execute.page_and_pictures(script)
        except execute.TutorialError as error:
            raise PluginError(f"{script.name}: {error}") from error
        contents |= {f"docs/tutorials/{name}": content for name, content in pages.items()}
    for path, content in contents.items():
        file = File.generated(config, path, content=content)
        file.dest_uri = file.dest_uri.removeprefix("docs/")
        files.append(file)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Fill in the gallery and the table of modules; redirect links to the script of another tutorial to its page."""
    if page.file.src_uri == "docs/gallery.md":
        before, after = re.split("<!-- figures.*-->", markdown)
        markdown = before + reference.gallery(ROOT / "experiments") + after
    if page.file.src_uri == "docs/api/README.md":
        markdown += reference.modules()
    own = f"]({Path(page.file.src_uri).stem}"
    return _SCRIPT.sub(lambda link: link[0] if link[1] == own else f"{link[1]}.md)", markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Convert formulas to MathML, which browsers render without a script."""

    def mathml(match: re.Match[str]) -> str:
        return convert(entities.unescape(match[2]).strip(), display="block" if match[1] == "div" else "inline")

    return _FORMULA.sub(mathml, html)
