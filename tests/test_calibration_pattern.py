"""Calibration by wide spots: a white surface's images, which are discs that we draw, and a real printed array."""

import dataclasses

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.io import loadmat
from scipy.spatial import KDTree

from experiments.printed_array import FAR as FAR_MM, SHAPE, recipe
from gs_jax import (
    Design,
    Imager,
    InputError,
    MicrolensArray,
    Sensor,
    calibrate,
    random_layout,
    read_design,
    write_capture,
    write_design,
)
from gs_jax.__main__ import commands
from gs_jax.calibration.fit import PATTERN_FITTED
from gs_jax.calibration.initial_guess import match_pattern
from gs_jax.calibration.spots import find_blurred_spots, half_light_radii
from gs_jax.io.camera import Readout
from gs_jax.io.captures import read_capture
from gs_jax.microscope.layouts import hexagonal_layout, square_layout

from .helpers import needs
from .test_calibration import captures, render_spots, traced_spots

FAR = np.array([[0.0, 0.0, FAR_MM]])


def discs(shape, middles, radius: float, seed=0) -> np.ndarray:
    """Evenly lit discs at `(row, column)`, darker toward their edges, on an offset, with shot noise."""
    rows, columns = np.arange(shape[0])[:, None], np.arange(shape[1])[None]
    light = np.zeros(shape)
    for row, column in middles:
        distance = np.hypot(rows - row, columns - column)
        light += np.clip(radius - distance + 0.5, 0, 1) * (1 - 0.3 * np.minimum(distance / radius, 1) ** 2)
    return 100 + np.random.default_rng(seed).poisson(3000 * light + 20).astype(float)


def device() -> tuple[Imager, Imager]:
    """A device with its array mirrored, turned, moved and shrunk, and its design."""
    centers = np.asarray(random_layout(24, (5.5, 5.5), pitch=0.9, seed=3))
    design = Imager(MicrolensArray(centers), Sensor((480, 500), 0.015), 5.8, 2.5)
    built = dataclasses.replace(design.array, centers=0.98 * centers * (1, -1))
    return dataclasses.replace(design, array=built, rotation=2.0, shift=(0.3, -0.2)), design


def white(actual: Imager, place=FAR, radius=20.0) -> np.ndarray:
    middles = np.asarray(actual.project(place))[:, 0]
    return discs(actual.sensor.shape, np.asarray(actual.sensor.to_pixels(middles)), radius)


def test_middles_and_widths_of_discs():
    rng = np.random.default_rng(0)
    places = np.stack(np.meshgrid([60, 110, 160], [60, 110, 160, 210]), -1).reshape(-1, 2) + rng.uniform(-2, 2, (12, 2))
    image = discs((220, 270), places, 15.0)
    middles, radii = find_blurred_spots(image, 50.0, 20)
    away = np.linalg.norm(middles[:, None] - places, axis=-1)
    assert len(middles) == 12 and away.min(0).max() < 0.05
    # Half of an even disc's light is within 0.71 of its radius; these are darker toward the edge.
    assert np.all((radii > 9.9) & (radii < 10.6))
    assert half_light_radii(np.zeros((50, 50)), np.array([[25.0, 25.0]]), np.array([30.0])) == 0
    assert len(find_blurred_spots(np.zeros((80, 80)), 30.0, 5)[0]) == 0


def test_chance_is_no_pattern_of_wide_spots():
    centers = np.asarray(random_layout(40, (8.0, 8.0), pitch=1.0, seed=1))
    chance = np.random.default_rng(0).uniform(-4, 4, (20, 2))
    assert not match_pattern(chance, centers, 1.0, 0.5, blurred=True).is_clear


@pytest.mark.parametrize("layout", [hexagonal_layout, square_layout])
@pytest.mark.parametrize(("turned", "moved"), [(0.0, 0j), (2.0, 0.7 + 0.9j)])
def test_of_a_regular_array_the_pose_next_to_the_design_is_found(layout, turned, moved):
    """The design is turned and moved already in the second: every other lens of the array fits as well."""
    centers = np.asarray(layout((9.0, 9.0), pitch=1.0))
    factor, shift = 1.05 * np.exp(1j * (turned + 0.1)), moved + 0.2 - 0.3j
    spots = (centers @ (1, 1j) * factor + shift)[np.argsort(np.hypot(*centers.T))][:20]
    design = np.exp(1j * turned)
    found = match_pattern(np.stack([spots.real, spots.imag], -1), centers, design, 0.5, blurred=True, shift=moved)
    assert not found.mirrored and found.on_lenses == 20
    assert abs(found.factor - factor) < 1e-6 and abs(found.shift - shift) < 1e-6


@pytest.mark.integration
def test_a_white_surface_shows_rotation_shift_and_scale():
    actual, design = device()
    found = calibrate([white(actual)], FAR, design, fit=PATTERN_FITTED, blurred=[0])
    assert found.mirrored and len(found.residuals) == 24 and found.rms < 0.1
    np.testing.assert_allclose(found.imager.centers, actual.centers, atol=0.02 * actual.sensor.pixel_pitch)
    assert found.values["scale"] == pytest.approx(0.98, abs=1e-4)
    # Discs that touch draw each other's middles a little.
    touching = calibrate([white(actual, radius=27.0)], FAR, design, fit=PATTERN_FITTED, blurred=[0])
    np.testing.assert_allclose(touching.imager.centers, actual.centers, atol=0.1 * actual.sensor.pixel_pitch)
    # Images that overlap show no lenses, nor does the dark.
    for image in (white(actual, radius=45.0), np.random.default_rng(0).normal(100, 2, actual.sensor.shape)):
        with pytest.raises(InputError, match="captures: a pattern must show an image of each lens .*, got"):
            calibrate([image], FAR, design, fit=PATTERN_FITTED, blurred=[0])
    with pytest.raises(InputError, match="capture 1 must have one source, .*, got 2"):
        calibrate(
            [white(actual)], np.repeat(FAR, 2, 0), design, fit=PATTERN_FITTED, captures=np.zeros(2, int), blurred=[0]
        )


@pytest.mark.parametrize("layout", [square_layout, pytest.param(hexagonal_layout, marks=pytest.mark.integration)])
def test_discs_that_touch_in_uneven_light_leave_errors_that_hold(layout):
    """Four fifths of the picture are lit: its median is the discs' own light, a third darker at one side."""
    size, pixel = 0.125, 0.0074
    centers = np.asarray(layout((1.6, 1.6), pitch=size))
    design = Imager(MicrolensArray(centers), Sensor((250, 250), pixel), 2.4, 0.5)
    built = dataclasses.replace(design.array, centers=1.01 * centers)
    actual = dataclasses.replace(design, array=built, rotation=0.01)
    y, x = np.mgrid[-0.5:0.5:250j, -0.5:0.5:250j]
    image = white(actual, radius=1.01 * size / 2 / pixel + 0.3) * (1 + 0.3 * x - 0.6 * (x**2 + y**2))
    found = calibrate([image], FAR, design, fit=PATTERN_FITTED, blurred=[0])
    assert len(found.residuals) == len(centers) and found.rms < 0.18
    for name, true in (("scale", 1.01), ("rotation_deg", np.degrees(0.01))):
        assert abs(found.values[name] - true) < 3 * found.deviations[name]
    assert found.deviations["scale"] < 5e-4


@pytest.mark.integration
@pytest.mark.parametrize(
    ("design", "image", "pitch", "by_phase", "rms"),
    [
        # By the phase of the lattice and by masks of the discs.
        ("ur.toml", "ur_w.tif", 0.125, 17.209, 0.18),
        # By the phase, whose mean over both directions changes by 0.001 with the window.
        ("guv.toml", "Radiometry_GUVExperim1.tif", 0.1, 15.4007, 0.14),
    ],
)
def test_real_white_images(design, image, pitch, by_phase, rms):
    data = needs("whiteimages/ur_w.tif").parent
    imager = read_design(data / design).imager()
    found = calibrate([read_capture(data / image, imager.sensor.shape)], FAR, imager, fit=PATTERN_FITTED, blurred=[0])
    pixels = pitch * float(imager.scale(FAR_MM)) / imager.sensor.pixel_pitch
    assert found.rms < rms and abs(found.values["scale"] * pixels - by_phase) < 3 * found.deviations["scale"] * pixels
    assert found.deviations["scale"] < 5e-4


@pytest.mark.integration
def test_an_overexposed_white_image_is_said_to_be(tmp_path):
    data = needs("whiteimages/ur_over.tif").parent
    names = [str(data / "ur.toml"), "--pattern", str(data / "ur_over.tif"), "-o", str(tmp_path / "found.toml")]
    result = CliRunner().invoke(commands, ["calibrate", *names])
    assert "ur_over.tif: 310649 pixels (0.63 of all) are saturated at 255" in result.stderr


@pytest.mark.integration
def test_centres_agree_with_those_of_another_program():
    """In a quarter of a foreign ray-traced white image."""
    data = needs("plenoptic/white.tif").parent
    theirs = loadmat(data / "sf_cal.mat")["cal"][0, 0]
    theirs = np.stack([theirs[name].ravel() - 1 for name in ("exactY", "exactX")], -1)
    imager = read_design(data / "plen.toml").imager()
    image = read_capture(data / "white.tif", imager.sensor.shape)[:1000, :1000]
    imager = dataclasses.replace(imager, sensor=Readout(roi=(0, 0, 1000, 1000)).sensor(imager.sensor))
    near = np.abs(np.asarray(imager.array.centers) + 3.1).max(1) < 2.9
    imager = dataclasses.replace(imager, array=dataclasses.replace(imager.array, centers=imager.array.centers[near]))
    found = calibrate([image], FAR, imager, fit=PATTERN_FITTED, blurred=[0])
    away, which = KDTree(theirs).query(spots := np.asarray(imager.sensor.to_pixels(found.spots.positions)))
    off = (spots - theirs[which])[away < 5]
    assert len(off) > 2000 and np.abs(off.mean(0)).max() < 0.01 and np.sqrt((off**2).sum(1).mean()) < 0.1


@pytest.mark.integration
def test_the_command_takes_a_white_surface_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    actual, listed = device()
    listed = dataclasses.replace(listed, array=dataclasses.replace(listed.array, size=(5.6, 5.6)))
    write_design("listed.toml", Design.from_imager(listed, name="small", working_distance_mm=(18.0, 23.0)))
    write_capture("white.tif", white(actual).astype(np.float32))
    arguments = ["calibrate", "listed.toml", "--pattern", "white.tif", "-o", "found.toml"]
    told = CliRunner().invoke(commands, arguments, catch_exceptions=False).stdout
    assert "found.toml: 24 spots" in told and "the array mirrored (y to -y) and rotated" in told
    found = read_design("found.toml")
    np.testing.assert_allclose(found.imager().centers, actual.centers, atol=0.02 * actual.sensor.pixel_pitch)
    assert found.imaging == read_design("listed.toml").imaging and (tmp_path / "found.toml.png").exists()
    assert set(found.provenance["calibrated_values"]) == {"rotation_deg", "shift_x_mm", "shift_y_mm", "scale"}
    wrong = CliRunner().invoke(commands, [*arguments, "--force", "--hold", "scale"])
    assert "apart from its neighbours, at the design's scale unless that is fitted, got" in str(wrong.exception)


@pytest.mark.integration
def test_a_white_surface_tells_scale_from_sensor_distance():
    """Which a bead alone does not. The surface's light comes from far to one side, as nobody said."""
    actual, design = device()
    surface, bead = white(actual, np.array([[300.0, -200.0, FAR_MM]])), np.array([[0.3, -0.2, 18.0]])
    start, places = dataclasses.replace(design, sensor_distance=5.6), np.append(bead, [[np.nan, np.nan, FAR_MM]], 0)
    fit = ("sensor_distance", *PATTERN_FITTED)
    # Four lenses are no pattern of their own.
    few = render_spots(traced_spots(actual, bead[0])[:4], actual.sensor.shape)
    for image in (*captures(actual, bead), few):
        found = calibrate([image, surface], places, start, fit=fit, blurred=[1])
        assert found.values["sensor_distance_mm"] == pytest.approx(5.8, abs=0.005)
        assert found.values["scale"] == pytest.approx(0.98, abs=3e-4)


@pytest.mark.integration
def test_a_printed_array_of_37_radii():
    """Mirrored, turned, out of focus and of unknown scale: what `experiments/printed_array.py` measures in full."""
    data = needs("randoscope/psf.tif").parent
    found = calibrate([read_capture(data / "psf.tif", SHAPE)], FAR, recipe(data), fit=PATTERN_FITTED, blurred=[0])
    assert found.mirrored and len(found.residuals) == 37 and found.rms < 2
    assert found.values["rotation_deg"] == pytest.approx(150.4, abs=0.5)
    assert found.values["scale"] == pytest.approx(1.36, abs=0.01)
