"""The page of a design and what it showed: what it says, how large it is, and that a browser shows it."""

import base64
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from matplotlib.figure import Figure

from gs_jax import Grid, Imager, MicrolensArray, Sensor
from gs_jax.__main__ import main
from gs_jax.apps import drawings
from gs_jax.apps.drawings import line_chart
from gs_jax.apps.pictures import make_slices
from gs_jax.apps.report import SLICE_BYTES, strip_folders, tolerance_section, voxel_view, write_report
from gs_jax.base.errors import InputError
from gs_jax.codesign import search_report
from gs_jax.design.datasheets import datasheet
from gs_jax.design.design import read_design
from gs_jax.design.start import geomscope
from gs_jax.io.point_tables import write_points
from gs_jax.io.provenance import DEVIATION
from gs_jax.io.volumes import write_surface, write_volume
from gs_jax.microscope.layouts import plate_corners
from gs_jax.optics.raytrace import trace_lenslet

from .browser import watched
from .helpers import DESIGN

CALIBRATED = """
[provenance]
parent = "/home/somebody/designs/first.toml"
calibrated_rms_pixels = 0.031
calibrated_spots = 12
calibrated_captures = 3
mirrored = false
[provenance.calibrated_values]
sensor_distance_mm = 5.8123
[provenance.standard_deviations]
sensor_distance_mm = 0.0021
"""
# As `gs-jax tolerance -o` writes it; `test_tolerances` holds that it does.
TOLERANCE = {
    "depth_mm": [18.0, 30.0],
    "yield": 0.5,
    "over_depths": {"position": {"a": 1.0, "b": None, "c": 2.0, "d": 0.0}},
    "yield_without": {"position": 0.75},
    "drawn": {"devices": 8, "spot_width_um": {"p5": [1.0, 2.0], "p50": [2.0, 3.0], "p95": [3.0, 4.0]}},
    "nominal": {"spot_width_um": [2.0, 3.0]},
    "targets": {"max_width_um": [2.4, 3.6]},
}
GRID = Grid(np.array([18.0, 18.5, 19.0, 20.0, 21.0]), (33, 29), 0.05)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a page of all that a page can have, made by the command with absolute paths."""
    folder = tmp_path_factory.mktemp("private-folder")
    rng = np.random.default_rng(0)
    name = DESIGN.replace('"small"', '"small </script><b>&"')
    (folder / "design.toml").write_text(name + CALIBRATED)
    volume = rng.uniform(0, 1, GRID.volume_shape).astype(np.float32)
    volume[3, 10:14, 10:14] = 9
    write_volume(folder / "volume.ome.tif", volume, GRID, {"command": f"gs-jax reconstruct {folder}/capture.tif"})
    write_volume(folder / "sd.ome.tif", 0.1 * volume, GRID, {DEVIATION: "of the voxels of volume.ome.tif"})
    write_points(folder / "points.csv", np.column_stack([rng.uniform(-0.5, 0.5, (7, 2)), rng.uniform(18, 21, (7, 2))]))
    tifffile.imwrite(folder / "capture.tif", rng.integers(0, 900, (96, 80), np.uint16))
    (folder / "tolerance.json").write_text(json.dumps(TOLERANCE))
    words = [folder / "design.toml", folder / "volume.ome.tif", "--points", folder / "points.csv"]
    maps = np.where(volume[:1] > 0.1, [[[1.0]], [[19.0]], [[0.1]]], np.nan).astype(np.float32)[:, None]
    write_surface(folder / "sheet.ome.tif", np.nan_to_num(maps[0]), maps[1], maps[2], GRID)
    words += ["--surface", folder / "sheet.ome.tif", "--deviation", folder / "sd.ome.tif"]
    words += ["--capture", folder / "capture.tif", "--tolerance", folder / "tolerance.json", "--bad-pixels", "none"]
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as stop:
        patch.setattr(sys, "argv", ["gs-jax", "report", *map(str, words), "-q", "-o", str(folder / "report.html")])
        main()
    assert stop.value.code == 0
    return folder


@pytest.mark.integration
def test_the_page_has_all_parts_and_no_path(made):
    text = (made / "report.html").read_text()
    parts = re.findall(r'<section id="(\w+)">', text)
    first = ["device", "datasheet", "psf", "mtf", "layout", "capture", "volume", "surface", "points"]
    assert parts == [*first, "mold", "calibration", "tolerance", "origin", "cite"]
    assert set(re.findall(r'href="#(\w+)"', text)) == {*parts, "main"}
    assert str(made) not in text and "private-folder" not in text and "/home/" not in text
    assert "input volume.ome.tif" in text and "gs-jax reconstruct capture.tif" in text and "first.toml" in text
    assert "small &lt;/script&gt;&lt;b&gt;&amp;" in text and "<b>" not in text
    assert "10.1002/lpor.202100072" in text and "5.8123" in text and "50 % of 8 devices" in text
    assert "standard deviations are 10% of the brightness" in text
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text) and "@import" not in text


@pytest.mark.integration
def test_a_page_of_a_design_alone(tmp_path):
    """Nothing was imaged; an ideal lens has no surface, so no mold."""
    out_of_focus = DESIGN.replace("[array]", "focal_length_mm = 4.6\n[array]").replace("= 5.8", "= 5.0")
    (tmp_path / "design.toml").write_text(out_of_focus)
    write_report(tmp_path / "r.html", design := read_design(tmp_path / "design.toml"))
    text = (tmp_path / "r.html").read_text()
    parts = re.findall(r'<section id="(\w+)">', text)
    assert parts == ["device", "datasheet", "psf", "mtf", "layout", "mold", "origin", "cite"]
    assert "None is shown: an ideal lens" in text and "<canvas" not in text
    sheet = datasheet(design)
    wide = np.array(sheet["spot_width_um"]) > 2 * np.array(sheet["lateral_resolution_um"])
    blurred = np.array(sheet["blur_um"]) > 2 * design.sensor.pixel_pitch_um
    assert text.count('<td class="fault" title="2.355 times') == wide.sum() > 0
    assert text.count('<td class="fault" title="more than the circle of confusion, 40 um') == blurred.sum() > 0


@pytest.mark.parametrize("width", [1200, 400])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_browser_shows_it_as_it_is(made, browser, width, scheme):
    """From the file, without an error or a request, no wider than the screen, in the colours that are asked for."""
    with watched(browser, (made / "report.html").as_uri(), width, color_scheme=scheme, offline=True) as page:
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        paper = re.findall(r"\d+", page.evaluate("getComputedStyle(document.body).backgroundColor"))
        assert (int(paper[0]) > 200) == (scheme == "light")
        broken = "[...document.images].filter(i => !i.complete || !i.naturalWidth).length"
        assert page.evaluate(broken) == 0 and page.locator("img").count() > 15


def test_keys_move_the_slider_and_the_slice(made, browser):
    with watched(browser, (made / "report.html").as_uri()) as page:
        slider, image, said = (page.locator(f"#volume .slices {name}") for name in ("input", "img:visible", "output"))
        assert said.inner_text() == "20 mm"  # the brightest
        before = image.get_attribute("src")
        slider.focus()
        page.keyboard.press("ArrowLeft")
        assert said.inner_text() == "19 mm" and image.get_attribute("src") != before
        assert slider.get_attribute("aria-valuetext") == "19 mm"
        page.keyboard.press("Home")
        assert said.inner_text() == "18 mm"


@pytest.mark.parametrize("name, fewest", [("volume", 60), ("surface", 5), ("points", 20), ("mold", 20)])
def test_views_in_space_are_drawn_and_turn(made, browser, name, fewest):
    """Of many colours, others when a key, then the mouse turns them, and as at first after 0."""
    colours = """c => { const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
        return new Set(new Uint32Array(d.buffer)).size; }"""
    with watched(browser, (made / "report.html").as_uri()) as page:
        canvas = page.locator(f"#view-{name}")
        canvas.focus()
        look = lambda: canvas.evaluate("c => new Promise(r => requestAnimationFrame(() => r(c.toDataURL())))")
        assert canvas.evaluate(colours) >= fewest
        first = look()
        page.keyboard.press("ArrowLeft")
        turned = look()
        canvas.hover(position={"x": 300, "y": 200})
        box = canvas.bounding_box()
        assert box
        page.mouse.down()
        page.mouse.move(box["x"] + 340, box["y"] + 210)
        page.mouse.up()
        dragged = look()
        page.keyboard.press("0")
        assert first != turned and dragged not in (first, turned) and look() == first


def test_the_floor_takes_voxels_away(made, browser):
    # Dim voxels are violet.
    lit = """c => { const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
        let n = 0; for (let i = 0; i < d.length; i += 4) n += d[i + 2] > d[i] + 4; return n; }"""
    with watched(browser, (made / "report.html").as_uri()) as page:
        canvas, floor = page.locator("#view-volume"), page.locator("#floor")
        floor.fill("1")
        many = canvas.evaluate(lit)
        floor.fill("250")
        assert canvas.evaluate(lit) < many / 2 > 100


def test_it_prints(made, browser):
    """On white paper from a dark screen, without what only a screen has."""
    with watched(browser, (made / "report.html").as_uri(), color_scheme="dark") as page:
        page.emulate_media(media="print")
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
        assert not page.locator("nav").is_visible() and page.locator(".slices img:visible").count() == 1
        corner = "c => [...c.getContext('2d').getImageData(c.width - 3, 3, 1, 1).data]"
        assert min(page.locator("#view-mold").evaluate(corner)) > 200
        assert page.pdf()[:4] == b"%PDF"


def test_the_first_key_skips_to_the_content(made, browser):
    with watched(browser, (made / "report.html").as_uri()) as page:
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.getAttribute('href')") == "#main"


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("design.toml", "-o", "r.txt"), ".html"),
        (("design.toml", "points.csv", "-o", "r.html"), "--points"),
        (("design.toml", "-o", "r.html", "--tolerance", "capture.tif"), "capture.tif: "),
        (("design.toml", "-o", "r.html", "--tolerance", "other.json"), "got no 'depth_mm'"),
        (("design.toml", "-o", "r.html", "--capture", "small.tif"), "(small.tif)"),
        (("none.toml", "-o", "r.html"), "none.toml: "),
    ],
)
def test_wrong_input_is_one_line(made, tmp_path, run, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    for name in ("design.toml", "capture.tif", "points.csv"):
        (tmp_path / name).write_bytes((made / name).read_bytes())
    (tmp_path / "other.json").write_text("{}")
    tifffile.imwrite(tmp_path / "small.tif", np.zeros((5, 5), np.uint16))
    status, out, err = run("report", *arguments)
    assert (status, out, err.count("\n")) == (2, "", 1) and message in err
    assert not (tmp_path / "r.html").exists()


def test_tolerances_of_another_kind_are_refused():
    with pytest.raises(InputError, match="gs-jax tolerance"):
        tolerance_section(TOLERANCE | {"drawn": {}})


@pytest.mark.parametrize(
    "text, kept",
    [
        ("gs-jax report '/home/me/my files/d.toml' -o /tmp/r.html", "gs-jax report d.toml -o r.html"),
        ("gs-jax simulate a.csv b.toml --psf=/x/y.tif", "gs-jax simulate a.csv b.toml --psf=y.tif"),
        (r"made of C:\Users\me\d.toml", "made of d.toml"),
        ('source = "/srv/lab/d.toml"', 'source = "d.toml"'),
        ("1/z' and 4.5 um / pixel of https://example.org/a/b", "1/z' and 4.5 um / pixel of https://example.org/a/b"),
    ],
)
def test_folders_are_left_out(text, kept):
    assert strip_folders(text) == kept


def test_the_largest_volumes_stay_small():
    """Noise, which nothing compresses, with as many bytes as slices may have; and a view in space."""
    side = int(np.sqrt(SLICE_BYTES / 100))
    for shape in ((100, side, side), (3, 1500, 1400)):
        volume = np.random.default_rng(0).random(shape, np.float32)
        grid = Grid(np.linspace(18, 22, shape[0]), shape[1:], 0.01)
        shown = make_slices(volume, grid, SLICE_BYTES)
        cloud = voxel_view(volume, grid)
        assert cloud["count"] <= 60_000 and len(shown.pictures) == shape[0]
        assert sum(map(len, [*shown.pictures, cloud["voxels"]])) < 11e6


def test_the_cloud_is_where_the_voxels_are():
    """The brightest voxel, binned, is within a bin of its place."""
    grid = Grid(np.linspace(18, 22, 7), (501, 401), 0.02, (1.0, -2.0))
    volume = np.zeros(grid.volume_shape, np.float32)
    volume[4, 300, 123] = 1
    cloud = voxel_view(volume, grid)
    x, y, z, value = np.frombuffer(base64.b64decode(cloud["voxels"]), np.uint8)
    assert cloud["count"] == 1 and value == 255
    place = [cloud["first"][0] + x * cloud["pitch"][0], cloud["first"][1] + y * cloud["pitch"][1], cloud["depths"][z]]
    np.testing.assert_allclose(place, grid.to_mm(np.array([4, 300, 123])), atol=0.03)


def test_the_plate_is_drawn_turned_and_shifted_as_its_lenses():
    """Lenses at its corners are at the corners of its outline, in the report and in the picture of a search."""
    corners = [(-2.0, -1.5), (2.0, -1.5), (2.0, 1.5), (-2.0, 1.5)]
    array = MicrolensArray(corners, aperture_diameter=1.0, size=(4.0, 3.0))
    imager = Imager(array, Sensor((100, 100), 0.05), 5.0, 1.0, rotation=0.1, shift=(0.2, -0.1))
    left, top, right, bottom = drawings.plate_and_sensor(imager)
    np.testing.assert_allclose([left, top], np.minimum(imager.centers.min(0), -2.5))
    np.testing.assert_allclose([right, bottom], np.maximum(imager.centers.max(0), 2.5))
    drawn = drawings.draw_layout(imager, "data:,", (left, top, right, bottom), "nothing")
    assert " ".join(f"{x:.4f},{y:.4f}" for x, y in np.asarray(imager.centers)) in drawn
    turned = geomscope().replace(rotation_deg=1.0, shift_mm=(0.05, -0.1))
    search_report._draw_layout(axes := Figure().subplots(), turned)
    outline: Any = axes.patches[0]
    plate = outline.get_xy()[:4]
    np.testing.assert_allclose(plate, plate_corners(turned.imager()))
    assert abs(plate[0, 1] - plate[1, 1]) == pytest.approx(20 * np.sin(np.radians(1)), rel=1e-5)


def test_lenses_that_see_a_point():
    """Counted one by one, at some points."""
    imager = geomscope().imager()
    seen = drawings.count_lenses(imager, 20.0)
    left, top, right, bottom = seen.box
    rows, columns = seen.lenses.shape
    for row, column in ((0, 0), (60, 60), (100, 17)):
        x, y = left + (column + 0.5) * (right - left) / columns, top + (row + 0.5) * (bottom - top) / rows
        landing = np.asarray(imager.project(np.array([[x, y, 20.0]])))[:, 0]
        near = np.hypot(*(np.asarray(imager.centers) - (x, y)).T) <= imager.field_radius
        assert seen.lenses[row, column] == (near & (np.abs(landing) <= 5120 * 0.0045 / 2).all(1)).sum()


def test_the_contrast_of_a_perfect_lens():
    """A lens without errors in focus has the closed form, where pixels are fine enough for all that it resolves."""
    design = geomscope()
    data = design.model_dump()
    data["lens"] |= {"focal_length_mm": 4.6, "aperture_diameter_mm": 0.3}
    imager = type(design).model_validate(data).imager()
    depth = 1 / (1 / 4.6 - 1 / 5.8) - 1 / 1.43
    light = drawings.simulate_psfs(imager, np.array([depth]), 0.3, 0.05).light[0, 0]
    frequency, curve = drawings.mtf(light, 0.0045, float(imager.magnification(depth)))
    # Light beside the window, and a pupil of squares.
    np.testing.assert_allclose(curve, drawings.ideal_mtf(frequency, imager, depth, 0.3), atol=0.02)


def test_a_wide_spot_has_the_light_that_rays_bring():
    """The spot of an f/1.5 sphere is far wider than its window, into which diffraction folded light from beside it."""
    imager = read_design(Path(__file__).parents[1] / "experiments" / "designs" / "geomscope-targets.toml").imager()
    light = drawings.simulate_psfs(imager, np.array([20.0]), 1.76, 0.64).light[0, 0]
    aperture = 0.88 * np.sqrt(np.random.default_rng(0).random((4000, 1)))
    angle = 2 * np.pi * np.random.default_rng(1).random((4000, 1))
    rays = trace_lenslet(imager, 20.0, aperture * np.hstack([np.cos(angle), np.sin(angle)]))
    window = light.shape[-1] * imager.sensor.pixel_pitch / 2
    share = np.mean(np.abs(rays.landing[rays.valid]).max(1) <= window)
    assert float(light.sum()) == pytest.approx(share, abs=0.03)


@pytest.mark.integration
def test_charts_draw_what_is_finite():
    chart = lambda *line, **options: line_chart({"a <b>": line}, x="x", y="y", title="t", **options)
    drawn = chart([1.0, 2.0, 3.0], [1.0, None, 3.0])
    assert drawn.count("<polyline") == 1 and "a &lt;b&gt;" in drawn and "no finite number" in chart([1.0], [None])
    assert not any("nan" in each for each in (drawn, chart([1.0], [2.0]), chart([1.0], [2.0], log=True)))
