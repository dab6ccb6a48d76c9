"""The page of `gs-jax explore`: its numbers are the datasheet's, moves compile nothing, nobody else is let in."""

import http.client
import json
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gs_jax import Grid, backproject, read_design
from gs_jax.apps import explore_design
from gs_jax.apps.explore import Server, Session
from gs_jax.apps.explore_design import complete_values, evaluate_design, make_sliders, start_of
from gs_jax.base.errors import InputError
from gs_jax.codesign.study import Study
from gs_jax.codesign.terms import TERMS
from gs_jax.design.datasheets import datasheet
from gs_jax.design.design import Design
from gs_jax.optics import psf
from gs_jax.optics.psf import spot_image

from .browser import watched
from .helpers import DESIGN
from .test_manners import HEARD

STUDY = Study.model_validate(
    {
        "free": {"pitch_mm": (0.1, 1.0)},
        "terms": [
            {"name": "thickness_mm", "at_most": 7.0},
            {"name": "lenses_per_point", "at_least": 3.0},
            {"name": "light_percent", "at_most": 1.0},
        ],
        "stages": [{"solver": "bfgs"}],
        "exposure": 3000.0,
        "detail_um": 16.0,
    }
)
MOVES = {"sensor_distance_mm": 6.1, "radius_of_curvature_mm": 2.2, "aperture_diameter_mm": 0.3}
MOVES |= {"near_mm": 17.0, "far_mm": 26.0, "field_radius_mm": 0.4}


@pytest.fixture(scope="module")
def design(tmp_path_factory) -> Design:
    path = tmp_path_factory.mktemp("design") / "design.toml"
    path.write_text(DESIGN.replace('"small"', '"small <i>"'))
    return read_design(path)


@pytest.fixture(scope="module", params=["alike", "types"])
def either(request, design) -> Design:
    """Also of two lens types, of which one is sharp at near and one at far depths."""
    return design if request.param == "alike" else design.replace(radius_of_curvature_mm=[2.0, 1.8, 1.8, 2.0])


def moved(design: Design, values: dict[str, float]) -> Design:
    """The design as a person would write it."""
    own = {name: value for name, value in values.items() if name not in ("pitch_mm", "near_mm", "far_mm")}
    ratio = np.array(design.lens.radius_of_curvature_mm) / np.ravel(design.lens.radius_of_curvature_mm)[0]
    own["radius_of_curvature_mm"] = values["radius_of_curvature_mm"] * ratio
    return design.replace(**own, working_distance_mm=(values["near_mm"], values["far_mm"]))


@pytest.mark.integration
def test_numbers_are_those_of_the_datasheet(either):
    values = complete_values(make_sliders(either), MOVES)
    result, sheet = evaluate_design(start_of(either, STUDY), values), datasheet(moved(either, values))
    np.testing.assert_allclose(result.depths, sheet["depth_mm"], rtol=1e-6)
    for name, column in result.numbers.items():
        np.testing.assert_allclose(column, sheet[name], rtol=2e-5, err_msg=name)
    assert result.scalars["lenses_per_point"] == pytest.approx(sheet["lenses_per_point"][0], rel=1e-5)
    for name in ("coverage", "focal_length_mm", "f_number", "numerical_aperture"):
        assert result.scalars[name] == pytest.approx(sheet[name], rel=1e-5)


@pytest.mark.integration
def test_the_saved_design_is_the_one_shown(either):
    """With the pitch too: the pattern and its plate are scaled."""
    start = start_of(either)
    sliders = make_sliders(either)
    values = complete_values(sliders, MOVES | {"pitch_mm": 1.2 * sliders["pitch_mm"].start})
    saved = explore_design.moved_design(either, start, values, {"command": "x"})
    assert saved.provenance == {"command": "x"} and saved.imaging.working_distance_mm == (17.0, 26.0)
    np.testing.assert_allclose(saved.array.centers_mm, 1.2 * np.array(either.array.centers_mm), atol=1e-4)
    imager, expected = explore_design.moved_imager(start, values), saved.imager()
    np.testing.assert_allclose(imager.array.radius_of_curvature, expected.array.radius_of_curvature, atol=1e-4)
    np.testing.assert_allclose(imager.array.plate, expected.array.plate, atol=1e-4)
    numbers, sheet = evaluate_design(start, values).numbers, datasheet(saved)
    for name in ("occupancy", "spot_width_um", "blur_um"):
        np.testing.assert_allclose(numbers[name], sheet[name], rtol=1e-3, err_msg=name)


@pytest.mark.integration
def test_moves_compile_nothing(either):
    start, sliders = start_of(either, STUDY), make_sliders(either)
    compiled: list[Any] = [psf._pixel_energy, psf._even_rays, explore_design._sum_lenses]
    counts = []
    for moves in ({}, *({name: slider.start * 1.01} for name, slider in sliders.items())):
        values = complete_values(sliders, moves)
        result = evaluate_design(start, values)
        if not moves or {"pitch_mm", "field_radius_mm"} & {*moves}:
            explore_design.reconstruct_points(start, values, result.clear_diameters)
        counts.append([each._cache_size() for each in compiled])
    assert counts == counts[:1] * len(counts)


def test_targets_and_assumptions_in_words(design, monkeypatch):
    monkeypatch.setitem(TERMS, "light_percent", TERMS["light_percent"]._replace(random=True))
    start = start_of(design, STUDY)
    assert (float(start.at.exposure), float(start.at.detail)) == pytest.approx((STUDY.exposure, STUDY.detail_um / 1000))
    moves = {"sensor_distance_mm": 7.0, "pitch_mm": 1.3 * make_sliders(design)["pitch_mm"].start}
    values = complete_values(make_sliders(design), moves)
    result = evaluate_design(start, values, explore_design.live_terms(STUDY))
    sentences = explore_design.find_violations(design, STUDY, start, values, result)
    assert "Target missed: thickness: filters, plate and sensor distance (thickness_mm) is 8, not <= 7." in sentences
    for word in ("lenses_per_point", "out of focus", "mask"):
        assert any(word in each for each in sentences)
    assert not any("light_percent" in each for each in sentences)
    wide = design.replace(radius_of_curvature_mm=0.35)
    values = complete_values(make_sliders(wide), {"radius_of_curvature_mm": 0.18})
    result = evaluate_design(start_of(wide, STUDY), values, explore_design.live_terms(STUDY))
    sentences = explore_design.find_violations(wide, None, start_of(wide, STUDY), values, result)
    assert "The aperture of 0.4 mm is wider than its sphere, which has 0.36 mm." in sentences


@pytest.mark.parametrize(
    "values, message",
    [
        ({"pich_mm": 1.0}, "the sliders are sensor_distance_mm, .*, got 'pich_mm'"),
        ({"sensor_distance_mm": 60.0}, "sensor distance v must be 3.48 to 8.7 mm, got 60 mm"),
        ({"sensor_distance_mm": float("nan")}, "got nan mm"),
        ({"near_mm": 28.8, "far_mm": 20.0}, "nearest depth must be below the farthest, 20 mm, got 28.8 mm"),
    ],
)
def test_wrong_values_are_refused(design, values, message):
    with pytest.raises(InputError, match=message):
        complete_values(make_sliders(design), values)


def test_wide_spots_are_counted_by_rays(design):
    """Both ways agree where both hold; beyond, diffraction would be folded back."""
    start, samples = start_of(design), explore_design.pupil_samples(start_of(design))
    unit = explore_design.lens_unit(start, complete_values(make_sliders(design), {}))
    near, wide = (spot_image(unit, depth, 0.0, size=49, radius=0.2, samples=samples) for depth in (20.0, 2.0))
    assert near.sum() == pytest.approx(1, abs=0.05)
    assert 0.1 < wide.sum() <= 1 and np.count_nonzero(wide) > 50


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.1, -0.15)])
def test_a_point_is_where_its_own_images_meet(design, tilt):
    """Of lenses that all see it, the brightest cell of the map has the point."""
    tilted = design.model_copy(update={"calibration": design.calibration.model_copy(update={"tilt_deg": tilt})})
    ghosts = explore_design.map_ghosts(tilted.imager(), 19.0, 21.0)
    row, column = np.unravel_index(ghosts.crossings.argmax(), ghosts.crossings.shape)
    left, top, right, bottom = ghosts.box
    size = ghosts.crossings.shape[0]
    assert abs(left + (column + 0.5) * (right - left) / size) < 0.03
    assert abs(top + (row + 0.5) * (bottom - top) / size) < 0.03
    assert ghosts.lenses == 4 and ghosts.crossings.sum() >= 4 * 9


def test_the_small_back_projection_is_the_librarys(design):
    imager, rng = design.imager(), np.random.default_rng(0)
    grid, image = Grid([18.0, 20.0], (41, 37), 0.05, (0.1, 0.0)), rng.random(imager.sensor.shape)
    np.testing.assert_allclose(
        explore_design._backproject(image, imager, grid), backproject(image, imager, grid), atol=1e-9
    )


@pytest.mark.slow
def test_a_small_reconstruction_shows_its_points():
    """Of a piece of the paper's design: points are far above the rest."""
    design = read_design(Path(__file__).parents[1] / "design" / "geomscope.toml")
    values = complete_values(make_sliders(design), {"near_mm": 18.5, "far_mm": 21.5})
    result = explore_design.reconstruct_points(start_of(design), values, np.array([1.6]))
    assert result.contrast > 10 and result.maxima.shape == (181, 181)


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


def request(server, path, body="{}", method="POST", **headers):
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
    assert request(server, ours, method="GET")[0] == 200
    assert request(server, "/", method="GET")[0] == 404
    assert request(server, f"{ours}history")[0] == 200
    assert request(server, "/secret/history")[0] == 403
    assert request(server, f"{ours}other")[0] == 404
    for headers in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}):
        assert request(server, ours, method="GET", **headers)[0] == 403
        assert request(server, f"{ours}save", **headers)[0] == 403


def test_a_page_that_is_closed_before_its_answer_prints_nothing(server, capfd):
    server, _ = server
    with server.lock:
        connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
        connection.request("POST", f"/{server.token}/history", "{}")
        time.sleep(0.1)
        connection.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.close()
    time.sleep(0.2)
    assert request(server, f"/{server.token}/history")[0] == 200 and capfd.readouterr().err == ""


@pytest.mark.parametrize("body", ["[]", "{", '{"near_mm": "x"}', '{"near_mm": 1e9}', "x" * 5000])
def test_wrong_requests_are_answered_in_words(server, body):
    server, folder = server
    status, text = request(server, f"/{server.token}/save", body)
    assert status == 200 and "must" in json.loads(text)["error"] and not list(folder.glob("*bad*"))


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
        for slider in page.locator("#sliders input").all():
            before = parts()
            slider.focus()
            with page.expect_response(lambda answer: answer.url.endswith("/move")):
                page.keyboard.press("PageUp")
            page.wait_for_timeout(50)
            assert parts() != before, slider.get_attribute("name")
        page.click("#keep")
        page.wait_for_selector("[data-kept='1']")
        for name in ("new.toml", "new-2.toml"):
            page.click("#save")
            expect(page.locator("#said")).to_have_text(f"Saved as {name}.")
        held = []
        page.route("**/move", lambda route: held.append(route))
        page.click("[data-kept='1']")
        page.click("#save")
        expect(page.locator("#said")).to_have_text("Saved as new-3.toml.")
        with page.expect_response("**/move"):
            held.pop().continue_()
        page.unroute("**/move")
        page.wait_for_timeout(50)
        expect(page.locator("#said")).to_have_text("Saved as new-3.toml.")  # an answer that comes later leaves it
        saved = read_design(folder / "new.toml")
        assert saved.imaging.sensor_distance_mm > 5.8 and saved.provenance["command"] == "gs-jax explore design.toml"
        with page.expect_response(lambda answer: answer.url.endswith("/move")):
            page.click("[data-kept='0']")
        page.wait_for_timeout(50)
        assert [part.split("kept")[0] for part in parts()][1:] == [part.split("kept")[0] for part in start][1:]
        for width in (1200, 400):
            page.set_viewport_size({"width": width, "height": 900})
            assert page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.integration
def test_wrong_input_is_one_line(tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "design.toml").write_text(DESIGN)
    for arguments, message in ((("none.toml",), "none.toml"), (("design.toml", "-o", "x.html"), "must be .toml")):
        status, out, err = run("explore", *arguments, "--no-browser")
        assert (status, out, err.count("\n")) == (2, "", 1) and message in err


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_the_command_prints_its_address_and_ends(tmp_path):
    (tmp_path / "design.toml").write_text(DESIGN)
    code = f"{HEARD}; from gs_jax.__main__ import script; script()"
    words = [sys.executable, "-c", code, "explore", "design.toml", "--no-browser"]
    with subprocess.Popen(words, cwd=tmp_path, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout and process.stdout.readline().startswith("http://127.0.0.1:")
        process.send_signal(2)
        _, err = process.communicate(timeout=30)
    assert process.returncode == 130 and err.strip().endswith("gs-jax: interrupted")
    assert [path.name for path in tmp_path.iterdir()] == ["design.toml"]
