"""What `show` puts into a notebook: HTML by itself, whose slider moves through the depths, and is not large."""

import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

from gs_jax import Grid, show

from .browser import browser, watched

__all__ = ["browser"]

GRID = Grid([18.0, 18.5, 20.0, 22.0], (31, 41), 0.05, (1.0, -2.0))


def html(*arguments, **options) -> str:
    figure: Any = show(*arguments, **options)
    return figure._repr_html_()


class Balanced(HTMLParser):
    """Tags that are open, and all that were."""

    def __init__(self, text: str):
        super().__init__()
        self.open, self.seen = [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        if tag not in ("img", "input"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.seen.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_it_is_html_that_needs_nothing_else():
    """No script beside it and no id: a page may have it twice, and none that is saved asks for anything."""
    points = np.array([[1.0, -2.0, 19.9, 1.0], [0.5, -1.7, 22.0, 2.0]])
    text = html(np.random.default_rng(0).random(GRID.volume_shape), GRID, points=points)
    found = Balanced(text)
    assert not found.open and found.seen.count("img") == len(GRID.depths) + 1 and found.seen.count("circle") == 2
    assert not {"script", "style", "link", "iframe"} & {*found.seen} and " id=" not in text and "\n\n" not in text
    assert not re.findall(r'(?:src|href)="(?!data:image/png;base64,)', text)


def test_the_slider_moves_the_slice(browser, tmp_path):
    """Of two on one page, the one that is moved; circles are in the slices of their points, where these are."""
    volume = np.zeros(GRID.volume_shape, np.float32)
    volume[3, 20, 10] = 1
    (place,) = GRID.to_mm(np.array([[3, 20, 10]]))
    text = html(volume, GRID, points=np.array([[*place, 1.0]]))
    (tmp_path / "page.html").write_text(f'<body style="margin:0">{text}{text}')
    with watched(browser, (tmp_path / "page.html").as_uri(), offline=True) as page:
        first, second = page.locator("figure").all()
        image, said = first.locator("img:visible"), first.locator("output")
        # The brightest slice is shown first.
        assert image.count() == 1 and said.inner_text() == "22 mm" and first.locator("circle:visible").count() == 1
        before = image.get_attribute("src")
        first.locator("input").focus()
        page.keyboard.press("ArrowLeft")
        assert said.inner_text() == "20 mm" and image.get_attribute("src") != before
        assert first.locator("input").get_attribute("aria-valuetext") == "20 mm"
        assert second.locator("output").inner_text() == "22 mm" and first.locator("circle:visible").count() == 0
        page.keyboard.press("ArrowRight")
        box, ring = image.bounding_box(), first.locator("circle:visible").bounding_box()
        assert box and ring
        voxel = box["width"] / 41
        # A circle's box has its line, too.
        np.testing.assert_allclose(
            [ring["x"] + ring["width"] / 2 - box["x"], ring["y"] + ring["height"] / 2 - box["y"]],
            [10.5 * voxel, 20.5 * voxel],
            atol=1.0,
        )
        page.keyboard.press("Home")
        assert said.inner_text() == "18 mm" and page.locator("img").last.is_visible()


@pytest.mark.parametrize("shape", [(100, 400, 400), (3, 1500, 1400)])
def test_the_largest_is_small(shape):
    """Noise, which nothing compresses, and points."""
    rng = np.random.default_rng(0)
    grid = Grid(np.linspace(18, 22, shape[0]), shape[1:], 0.01)
    points = np.column_stack([rng.uniform(-2, 2, (9000, 2)), rng.uniform(18, 22, (9000, 2))])
    assert len(html(rng.random(shape, np.float32), grid, points=points)) < 5e6


def test_a_single_dark_plane():
    text = html(np.zeros((1, 5, 7)), Grid([20.0], (5, 7), 0.1))
    assert 'max="0"' in text and text.count("20 mm") > 1 and "<svg" not in text
