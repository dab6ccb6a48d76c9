"""Pictures: what `show` draws and puts into a notebook, and one style for methods, images and scale bars."""

import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from skimage.color import deltaE_ciede2000, rgb2lab

from gs_jax import Grid, show
from gs_jax.apps.pictures import PALETTE, downsample, draw_image, label_of, line_of, make_slices

from .browser import watched

GRID = Grid([18.0, 18.5, 20.0, 22.0], (31, 41), 0.05, (1.0, -2.0))


def html(*arguments, **options) -> str:
    figure: Any = show(*arguments, **options)
    return figure._repr_html_()


@pytest.mark.parametrize("depths", [[20.0], [18.0, 19.0, 22.0]])
def test_a_bright_voxel_is_where_its_millimetres_are(depths):
    grid = Grid(depths, (5, 7), 0.1, origin=(1.0, -2.0))
    volume = np.zeros(grid.volume_shape)
    volume[-1, 3, 5] = 1
    (x, y, z) = grid.to_mm(np.array([len(depths) - 1, 3, 5]))
    figure = show(volume, grid, points=np.array([[x, y, z, 1.0]]))
    views = {(0, 1): figure.axes[0], (2, 1): figure.axes[1], (0, 2): figure.axes[2]}
    for (across, along), axes in views.items():
        drawn: Any = axes.collections  # a mesh and circles
        mesh, circles = drawn
        corners = mesh.get_coordinates()
        row, column = np.argwhere(mesh.get_array() == 1)[0]
        low, high = np.sort(corners[[row, row + 1], [column, column + 1]], axis=0)
        position = np.array([x, y, z])[[across, along]]
        np.testing.assert_allclose(circles.get_offsets()[0], position)
        # Between the edges of what is drawn; of uneven planes the depth is not in the middle.
        assert np.all((low < position) & (position < high))
    assert figure.axes[0].get_ylim()[0] > figure.axes[0].get_ylim()[1]  # row 0 at the top


def drawn_value(figure, view, across, along):
    """The brightness, 0 to 1, of the cell of a view at a position, mm."""
    mesh: Any = figure.axes[view].collections[0]
    corners = mesh.get_coordinates()
    columns, rows = np.searchsorted(corners[0, :, 0], across) - 1, np.searchsorted(corners[:, 0, 1], along) - 1
    return float(mesh.norm(mesh.get_array()[rows, columns]))


def test_points_are_seen_in_all_views_and_ghosts_are_as_dim_as_they_are():
    """Single voxels of a wide volume: a picture has fewer pixels than it has voxels. Ghosts have 2 % of the light."""
    grid, rng = Grid([19.0, 20.0, 21.0], (1153, 1153), 0.02), np.random.default_rng(0)
    volume = np.full(grid.volume_shape, 0.01, np.float32)
    volume[rng.integers(0, 3, 200), rng.integers(0, 1153, 200), rng.integers(0, 1153, 200)] = 0.03
    points = {(0, 576, 576): 1.0, (1, 400, 651): 0.9, (2, 626, 477): 0.7}
    for voxel, light in points.items():
        volume[voxel] = light
    figure = show(volume, grid)
    meshes: list[Any] = [axes.collections[0] for axes in figure.axes[:3]]
    assert max(max(mesh.get_array().shape) for mesh in meshes) <= 400
    for voxel, light in points.items():
        x, y, z = grid.to_mm(np.array(voxel))
        for view, position in enumerate(((x, y), (z, y), (x, z))):
            assert drawn_value(figure, view, *position) == pytest.approx(np.sqrt((light - 0.01) / 0.99), abs=1e-3)
    assert max(float(np.sort(np.ravel(mesh.norm(mesh.get_array())))[-4]) for mesh in meshes) < 0.2
    bar = figure.axes[-1]
    assert bar.get_ylabel() == "% from median to maximum"
    assert [text.get_text() for text in bar.get_yticklabels()][-1] == "100"


def test_slices_begin_at_the_brightest_and_have_a_scale_bar():
    grid = Grid([18.0, 19.0, 20.0, 21.0], (50, 60), 0.05, origin=(1.0, 0.0))
    volume = np.zeros(grid.volume_shape)
    volume[3, 20, 30] = 1.0
    text = html(volume, grid)
    assert 'value="3"' in text and ">1 mm</div>" not in text and ">500 um</div>" in text
    assert "x from -0.5 to 2.5 mm to the right, y from -1.25 to 1.25 mm down" in text
    pictures = make_slices(volume, grid, 10**6).pictures
    assert len(set(pictures[:3])) == 1 and pictures[3] != pictures[0]


def test_a_volume_of_another_grid_is_refused():
    with pytest.raises(ValueError, match=r"the grid's shape \(1, 5, 7\), got \(1, 7, 5\)"):
        show(np.zeros((1, 7, 5)), Grid([20.0], (5, 7), 0.1))


def test_a_dark_plane_and_no_points():
    grid = Grid([20.0], (5, 7), 0.1)
    show(np.zeros((1, 5, 7)), grid, points=np.zeros((0, 4))).canvas.draw()
    text = html(np.zeros((1, 5, 7)), grid)
    assert 'max="0"' in text and text.count("20 mm") > 1 and "<svg" not in text


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


def test_a_notebook_needs_nothing_else():
    """No script beside it and no id: a page may have it twice, and none that is saved asks for anything."""
    points = np.array([[1.0, -2.0, 19.9, 1.0], [0.5, -1.7, 22.0, 2.0]])
    text = html(np.random.default_rng(0).random(GRID.volume_shape), GRID, points=points)
    tags = Balanced(text)
    assert not tags.open and tags.seen.count("img") == len(GRID.depths) + 1 and tags.seen.count("circle") == 2
    assert not {"script", "style", "link", "iframe"} & {*tags.seen} and " id=" not in text and "\n\n" not in text
    assert not re.findall(r'(?:src|href)="(?!data:image/png;base64,)', text)


def test_the_slider_moves_the_slice(browser, tmp_path):
    """Of two on one page, the one that is moved; circles are in the slices of their points, where these are."""
    volume = np.zeros(GRID.volume_shape, np.float32)
    volume[3, 20, 10] = 1
    (point,) = GRID.to_mm(np.array([[3, 20, 10]]))
    text = html(volume, GRID, points=np.array([[*point, 1.0]]))
    (tmp_path / "page.html").write_text(f'<body style="margin:0">{text}{text}')
    with watched(browser, (tmp_path / "page.html").as_uri(), offline=True) as page:
        first, second = page.locator("figure").all()
        image, depth = first.locator("img:visible"), first.locator("output")
        # The brightest slice is shown first.
        assert image.count() == 1 and depth.inner_text() == "22 mm" and first.locator("circle:visible").count() == 1
        before = image.get_attribute("src")
        first.locator("input").focus()
        page.keyboard.press("ArrowLeft")
        assert depth.inner_text() == "20 mm" and image.get_attribute("src") != before
        assert first.locator("input").get_attribute("aria-valuetext") == "20 mm"
        assert second.locator("output").inner_text() == "22 mm" and first.locator("circle:visible").count() == 0
        page.keyboard.press("ArrowRight")
        box, ring = image.bounding_box(), first.locator("circle:visible").bounding_box()
        assert box and ring
        voxel = box["width"] / 41
        # A circle's box has its line, too.
        middle = [ring["x"] + ring["width"] / 2 - box["x"], ring["y"] + ring["height"] / 2 - box["y"]]
        np.testing.assert_allclose(middle, [10.5 * voxel, 20.5 * voxel], atol=1.0)
        page.keyboard.press("Home")
        assert depth.inner_text() == "18 mm" and page.locator("img").last.is_visible()


@pytest.mark.parametrize("shape", [(100, 400, 400), (3, 1500, 1400)])
def test_the_largest_is_small(shape):
    """Noise, which nothing compresses, and points."""
    rng = np.random.default_rng(0)
    grid = Grid(np.linspace(18, 22, shape[0]), shape[1:], 0.01)
    points = np.column_stack([rng.uniform(-2, 2, (9000, 2)), rng.uniform(18, 22, (9000, 2))])
    assert len(html(rng.random(shape, np.float32), grid, points=points)) < 5e6


def test_a_method_looks_the_same_under_all_of_its_names():
    assert line_of("back-projection") == line_of("backproject")
    assert line_of("our network") == line_of("backproject + our U-Net") == line_of("backproject + unet")
    assert line_of("admm, dense")["color"] == line_of("admm")["color"] and line_of("admm, dense")["ls"] == "--"
    # Neither of these has total variation in the pictures.
    labels = {"another": "another", "admm, dense": "ADMM, dense", "admm": "ADMM", "fista": "FISTA"}
    assert {method: label_of(method) for method in labels} == labels
    methods = ["backproject", "backproject + cluster", "backproject + unet", "unrolled", "list-rl", "fista", "admm"]
    lines = [line_of(method) for method in methods]
    assert len({line["marker"] for line in lines}) == len({line["color"] for line in lines}) == len(methods)


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


@pytest.mark.parametrize("width, label", [(20.0, "5 mm"), (0.9, "200 um"), (3.4, "1 mm"), (0.02, "5 um")])
def test_the_bar_is_as_long_as_its_label(width, label):
    axes = Figure().subplots()
    draw_image(axes, np.zeros((4, 4)), (-width / 2, width / 2, 1.0, -1.0))
    (bar,) = axes.lines
    (text,) = axes.texts
    number, unit = label.split()
    length = np.ptp(bar.get_xdata()) * width
    assert text.get_text() == label and length == pytest.approx(float(number) * {"mm": 1, "um": 1e-3}[unit])


def test_rows_go_down_unless_a_scene_was_drawn_otherwise():
    down, up = Figure().subplots(1, 2)
    draw_image(down, np.eye(2), (0.0, 1.0, 1.0, 0.0))
    draw_image(up, np.eye(2), (0.0, 1.0, 1.0, 0.0), upward=True)
    assert down.get_ylim() == (1, 0) and up.get_ylim() == (0, 1)


def test_downsampled_pixels_are_means_of_blocks():
    image = np.arange(36.0).reshape(6, 6)
    np.testing.assert_allclose(downsample(image, 3), image.reshape(3, 2, 3, 2).mean((1, 3)))
    assert downsample(np.ones((1, 9)), 3).shape == (1, 3)
