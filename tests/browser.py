"""A browser without a window, for the tests of pages."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

# Debian's, and those of others that speak the same; Playwright's own otherwise.
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@pytest.fixture(scope="module")
def browser():
    """Chromium by Playwright, or skip and say what is missing."""
    api = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install playwright")
    with api.sync_playwright() as playwright:
        own = playwright.chromium.executable_path
        found = next(filter(None, map(shutil.which, NAMES)), own if Path(own).exists() else None)
        if not found:
            pytest.skip("no Chromium: apt-get install chromium, or playwright install chromium")
        opened = playwright.chromium.launch(executable_path=found)
        yield opened
        opened.close()


@contextmanager
def watched(browser, url: str, width: int = 1200, **context) -> Iterator:
    """The page, with no error of its script, none on its console, and no request but for itself."""
    page = browser.new_page(viewport={"width": width, "height": 900}, **context)
    said, base = [], url.split("?")[0].rsplit("/", 1)[0]
    page.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: said.append(request.url) if not _own(request.url, base) else None)
    page.goto(url)
    yield page
    assert said == []
    page.close()


def _own(url: str, base: str) -> bool:
    return url.startswith((base, "data:", "blob:"))
