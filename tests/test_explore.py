"""The page whose sliders move a design: its numbers are the datasheet's, it is quick, nobody else is let in."""

import http.client
import json
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gs_jax import Grid, backproject, read_design
from gs_jax.apps.explore import evaluation as judging, preview as scenes
from gs_jax.apps.explore.evaluation import bench_of, checked_values, design_of, judge, violations
from gs_jax.apps.explore.preview import ghosts_of, small_reconstruction
from gs_jax.apps.explore.server import Server
from gs_jax.apps.explore.session import Session
from gs_jax.base.errors import InputError
from gs_jax.codesign.study import Study
from gs_jax.design.design import Design
from gs_jax.design.sheet import datasheet

from .browser import browser, watched
from .test_cli import DESIGN, run
from .test_manners import HEARD

__all__ = ["browser"]

STUDY = Study.model_validate(
    {
        "free": {"pitch_mm": (0.1, 1.0)},
        "terms": [
            {"name": "thickness_mm", "at_most": 7.0},
            {"name": "lenses_per_point", "at_least": 3.0},
            {"name": "ghosts", "at_most": 1.0},
        ],
        "stages": [{"solver": "bfgs"}],
    }
)


@pytest.fixture(scope="module")
def design(tmp_path_factory) -> Design:
    path = tmp_path_factory.mktemp("design") / "design.toml"
    path.write_text(DESIGN.replace('"small"', '"small <i>"'))
    return read_design(path)


@pytest.fixture(scope="module")
def bench(design):
    return bench_of(design, STUDY)


@pytest.fixture(scope="module")
def server(design, tmp_path_factory):
    """The page of a session, and the folder that it saves to."""
    folder = tmp_path_factory.mktemp("saved")
    session = Session(design, STUDY, folder / "new.toml", {"command": "gs-jax explore design.toml"})
    with Server(session) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server, folder
        server.shutdown()
        thread.join()


def moved(design: Design, values: dict[str, float]) -> Design:
    """The design as a person would write it."""
    data = design.model_dump()
    data["imaging"] |= {key: values[key] for key in ("sensor_distance_mm", "field_radius_mm")}
    data["imaging"]["working_distance_mm"] = (values["near_mm"], values["far_mm"])
    data["lens"] |= {key: values[key] for key in ("radius_of_curvature_mm", "aperture_diameter_mm")}
    return Design.model_validate(data)


MOVES = {
    "sensor_distance_mm": 6.1,
    "radius_of_curvature_mm": 2.2,
    "aperture_diameter_mm": 0.3,
    "near_mm": 17.0,
    "far_mm": 26.0,
    "field_radius_mm": 0.4,
}


@pytest.mark.integration
def test_the_numbers_are_the_datasheets(design, bench):
    values = checked_values(design, MOVES)
    found, sheet = judge(bench, values), datasheet(moved(design, values))
    np.testing.assert_allclose(found.depths, sheet["depth_mm"], rtol=1e-6)
    for name, column in found.numbers.items():
        np.testing.assert_allclose(column, sheet[name], rtol=2e-5, err_msg=name)
    assert found.scalars["lenses_per_point"] == pytest.approx(sheet["lenses_per_point"][0], rel=1e-5)
    assert found.scalars["coverage"] == pytest.approx(sheet["coverage"], rel=1e-5)


@pytest.mark.integration
def test_what_is_saved_is_what_was_seen(design, bench):
    """With the pitch too: the pattern and its plate are scaled."""
    values = checked_values(design, MOVES | {"pitch_mm": 1.2 * float(bench.parent.pitch)})
    saved = design_of(bench, values, {"command": "x"})
    assert saved.provenance == {"command": "x"} and saved.imaging.working_distance_mm == (17.0, 26.0)
    np.testing.assert_allclose(saved.array.centers_mm, 1.2 * np.array(design.array.centers_mm), atol=1e-4)
    found, sheet = judge(bench, values), datasheet(saved)
    for name in ("occupancy", "spot_width_um", "blur_um"):
        np.testing.assert_allclose(found.numbers[name], sheet[name], rtol=1e-3, err_msg=name)


@pytest.mark.integration
def test_nothing_is_compiled_twice(design, bench):
    """Whatever moves: what takes the time is compiled once."""
    judge(bench, checked_values(design, {}))
    small_reconstruction(bench, checked_values(design, {}), 0.4)
    compiled: list[Any] = [judging._diffracted, judging._landing, scenes._summed]
    before = [each._cache_size() for each in compiled]
    for name, knob in judging.knobs_of(design).items():
        values = checked_values(design, {name: knob.start * 1.01})
        judge(bench, values)
        if name in ("pitch_mm", "field_radius_mm"):
            small_reconstruction(bench, values, 0.4)
    assert [each._cache_size() for each in compiled] == before


def test_targets_and_assumptions_in_words(design, bench):
    values = checked_values(design, {"sensor_distance_mm": 7.0, "pitch_mm": 1.3 * float(bench.parent.pitch)})
    said = violations(bench, values, judge(bench, values))
    assert "Target missed: thickness, plate and sensor distance (thickness_mm) is 8, wanted <= 7." in said
    assert any("lenses_per_point" in each for each in said) and any("out of focus" in each for each in said)
    assert any("mask" in each for each in said) and not any("ghosts" in each for each in said)


@pytest.mark.parametrize(
    "values, message",
    [
        ({"pich_mm": 1.0}, "found 'pich_mm', allowed: sensor_distance_mm"),
        ({"sensor_distance_mm": 60.0}, "sensor distance v: found 60 mm, allowed: 3.48 to 8.7 mm"),
        ({"sensor_distance_mm": float("nan")}, "found nan mm"),
        ({"near_mm": 28.8, "far_mm": 20.0}, "nearest depth: found 28.8 mm, allowed: below 20 mm"),
    ],
)
def test_what_is_no_design_is_refused(design, values, message):
    with pytest.raises(InputError, match=message):
        checked_values(design, values)


def test_wide_spots_are_counted_by_rays(design, bench):
    """Both ways agree where both hold; beyond, diffraction would be folded back."""
    unit = judging.unit_of(bench, checked_values(design, {}))
    near, wide = (judging.spot_of(bench, unit, depth, 0.0, 0.2) for depth in (20.0, 2.0))
    assert near.sum() == pytest.approx(1, abs=0.05)
    assert 0.1 < wide.sum() <= 1 and np.count_nonzero(wide) > 50


def test_a_point_is_where_its_own_images_meet(design):
    """Of lenses that all see it, the brightest cell of the map has the point."""
    ghosts = ghosts_of(design.imager(), 19.0, 21.0)
    row, column = np.unravel_index(ghosts.crossings.argmax(), ghosts.crossings.shape)
    left, top, right, bottom = ghosts.box
    size = ghosts.crossings.shape[0]
    assert abs(left + (column + 0.5) * (right - left) / size) < 0.03
    assert abs(top + (row + 0.5) * (bottom - top) / size) < 0.03
    assert ghosts.lenses == 4 and ghosts.crossings.sum() >= 4 * 9


def test_the_small_back_projection_is_the_librarys(design):
    imager, rng = design.imager(), np.random.default_rng(0)
    grid, image = Grid([18.0, 20.0], (41, 37), 0.05, (0.1, 0.0)), rng.random(imager.sensor.shape)
    np.testing.assert_allclose(scenes._backprojected(image, imager, grid), backproject(image, imager, grid), atol=1e-9)


@pytest.mark.slow
def test_a_small_reconstruction_shows_its_points():
    """Of a piece of the paper's design: points are far above the rest."""
    path = Path(__file__).parents[1] / "design" / "geomscope.toml"
    bench = bench_of(read_design(path))
    made = small_reconstruction(bench, checked_values(bench.design, {"near_mm": 18.5, "far_mm": 21.5}), 1.6)
    assert made.contrast > 10 and made.maxima.shape == (181, 181)


def asked(server, path, body="{}", method="POST", **headers):
    """Status and text of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    connection.request(method, path, body, headers)
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


def test_nobody_else_is_let_in(server):
    server, _ = server
    assert server.server_address[0] == "127.0.0.1"
    ours = f"/{server.token}/"
    assert asked(server, ours, method="GET")[0] == 200
    assert asked(server, "/", method="GET")[0] == 404
    assert asked(server, f"{ours}history")[0] == 200
    assert asked(server, "/secret/history")[0] == 403
    assert asked(server, f"{ours}other")[0] == 404
    for headers in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}):
        assert asked(server, ours, method="GET", **headers)[0] == 403
        assert asked(server, f"{ours}save", **headers)[0] == 403


@pytest.mark.parametrize("body", ["[]", "{", '{"near_mm": "x"}', '{"near_mm": 1e9}', "x" * 5000])
def test_what_is_no_question_is_said(server, body):
    server, folder = server
    status, text = asked(server, f"/{server.token}/save", body)
    assert status == 200 and "allowed" in json.loads(text)["error"] and not list(folder.glob("*bad*"))


@pytest.mark.integration
def test_a_browser_moves_it(server, browser):
    """Each slider changes something; kept designs come back; what is saved is a new file each time."""
    from playwright.sync_api import expect

    server, folder = server
    with watched(browser, server.url) as page:
        page.wait_for_selector("#small svg")
        assert page.locator("h1").inner_text() == "small <i>"
        parts = lambda: [page.locator(f"#{name}").inner_html() for name in ("chart", "spots", "numbers", "layout")]
        start = parts()
        for slider in page.locator("#knobs input").all():
            before = parts()
            slider.focus()
            with page.expect_response(lambda answer: answer.url.endswith("/move")):
                page.keyboard.press("PageUp")
            page.wait_for_timeout(50)
            assert parts() != before, slider.get_attribute("name")
        page.click("#keep")
        page.wait_for_selector("[data-kept='1']")
        page.click("#save")
        expect(page.locator("#said")).to_have_text("Saved as new.toml.")
        page.click("#save")
        expect(page.locator("#said")).to_have_text("Saved as new-2.toml.")
        saved = read_design(folder / "new.toml")
        assert saved.imaging.sensor_distance_mm > 5.8 and saved.provenance["command"] == "gs-jax explore design.toml"
        with page.expect_response(lambda answer: answer.url.endswith("/move")):
            page.click("[data-kept='0']")
        page.wait_for_timeout(50)
        assert [part.split("kept")[0] for part in parts()][1:] == [part.split("kept")[0] for part in start][1:]


@pytest.mark.integration
@pytest.mark.parametrize("width", [1200, 400])
def test_it_is_no_wider_than_the_screen(server, browser, width):
    with watched(browser, server[0].url, width) as page:
        page.wait_for_selector("#small svg")
        assert page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.integration
def test_wrong_input_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "design.toml").write_text(DESIGN)
    for arguments, message in ((("none.toml",), "none.toml"), (("design.toml", "-o", "x.html"), "allowed: .toml")):
        status, out, err = run(monkeypatch, capsys, "explore", *arguments, "--no-browser")
        assert (status, out, err.count("\n")) == (2, "", 1) and message in err


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_the_command_says_where_it_is_and_ends(tmp_path):
    (tmp_path / "design.toml").write_text(DESIGN)
    code = f"{HEARD}; from gs_jax.__main__ import script; script()"
    words = [sys.executable, "-c", code, "explore", "design.toml", "--no-browser"]
    with subprocess.Popen(words, cwd=tmp_path, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout and process.stdout.readline().startswith("http://127.0.0.1:")
        process.send_signal(2)
        _, err = process.communicate(timeout=30)
    assert process.returncode == 130 and err.strip().endswith("gs-jax: interrupted")
    assert [path.name for path in tmp_path.iterdir()] == ["design.toml"]
