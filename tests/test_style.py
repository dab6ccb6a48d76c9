"""Pictures in one style."""

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from skimage.color import deltaE_ciede2000, rgb2lab

from gs_jax.apps.pictures import PALETTE, draw_image, label_of, line_of

METHODS = ["backproject", "backproject + cluster", "backproject + unet", "unrolled", "list-rl", "fista", "admm"]


def test_a_method_looks_the_same_under_all_of_its_names():
    assert line_of("back-projection") == line_of("backproject")
    assert line_of("our network") == line_of("backproject + our U-Net") == line_of("backproject + unet")
    assert label_of("another") == "another" and label_of("admm, dense") == "ADMM, dense"
    assert line_of("admm, dense")["color"] == line_of("admm")["color"] and line_of("admm, dense")["ls"] == "--"


def test_no_label_says_more_than_what_runs():
    """Neither has total variation in the pictures."""
    assert [label_of(method) for method in ("fista", "admm")] == ["FISTA", "ADMM"]


def test_methods_differ_in_colour_and_in_marker():
    lines = [line_of(method) for method in METHODS]
    assert len({line["marker"] for line in lines}) == len({line["color"] for line in lines}) == len(METHODS)


@pytest.mark.parametrize(
    "seen",
    [
        np.eye(3),
        # Without one kind of cones, of linear RGB (Machado, Oliveira and Fernandes, 2009).
        np.array([[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]]),
        np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]]),
        np.array([[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]]),
    ],
    ids=["all cones", "protanopia", "deuteranopia", "tritanopia"],
)
def test_the_first_colours_are_told_apart_with_any_vision(seen):
    rgb = np.array([to_rgb(colour) for colour in PALETTE[:5]])
    linear = np.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92) @ seen.T
    shown = np.clip(linear, 0, 1)
    shown = np.where(shown > 0.0031308, 1.055 * shown ** (1 / 2.4) - 0.055, 12.92 * shown)
    lab = rgb2lab(shown[None])[0]
    apart = [deltaE_ciede2000(lab[i], lab[j]) for i in range(len(lab)) for j in range(i)]
    assert min(apart) > 10


@pytest.mark.parametrize("width, said", [(20.0, "5 mm"), (0.9, "200 um"), (3.4, "1 mm"), (0.02, "5 um")])
def test_the_bar_is_as_long_as_it_says(width, said):
    axes = Figure().subplots()
    draw_image(axes, np.zeros((4, 4)), (-width / 2, width / 2, 1.0, -1.0))
    (bar,) = axes.lines
    (text,) = axes.texts
    length = np.ptp(bar.get_xdata()) * width
    number, unit = said.split()
    assert text.get_text() == said and length == pytest.approx(float(number) * {"mm": 1, "um": 1e-3}[unit])


def test_rows_go_down_unless_a_scene_was_drawn_otherwise():
    down, up = Figure().subplots(1, 2)
    draw_image(down, np.eye(2), (0.0, 1.0, 1.0, 0.0))
    draw_image(up, np.eye(2), (0.0, 1.0, 1.0, 0.0), upward=True)
    assert down.get_ylim() == (1, 0) and up.get_ylim() == (0, 1)
