"""What a camera does to light, undone: dark frame, flat field, bad pixels; and what is said of it."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import tifffile

from gs_jax import Grid, Sensor, backproject, read_capture, read_design
from gs_jax.base.errors import InputError
from gs_jax.io.camera import (
    Correction,
    Readout,
    correct,
    count_saturated,
    fill_bad_pixels,
    find_hot_in_capture,
    find_hot_in_dark,
    flat_field_gain,
    read_corrected,
)

from .helpers import CAPTURES, scene

SHAPE = (60, 70)
ROW, COLUMN = np.indices(SHAPE)
GAIN = 1.2 - 0.9 * ((ROW - 30) ** 2 + (COLUMN - 35) ** 2) / (30**2 + 35**2)
DARK = 16 + 3 * (COLUMN % 2)


def saved(path, pixels, dtype: Any = np.float32):
    tifffile.imwrite(path, np.asarray(pixels, dtype), photometric="minisblack")
    return path


def test_a_camera_is_undone_exactly(tmp_path):
    light = np.random.default_rng(0).random(SHAPE) * 1000
    capture = saved(tmp_path / "a.tif", GAIN * light + DARK)
    known = Correction(saved(tmp_path / "d.tif", [DARK] * 3), saved(tmp_path / "f.tif", [GAIN * 500 + DARK] * 2))
    image, done, warnings = read_corrected(capture, Sensor(SHAPE, 0.01), correction=known)
    # The flat field's mean is 1. In float32 of counts up to 1200.
    np.testing.assert_allclose(image, light * GAIN.mean(), rtol=1e-5, atol=1e-3)
    assert image.dtype == np.float32 and not warnings
    low, high = GAIN.min() / GAIN.mean(), GAIN.max() / GAIN.mean()
    assert done == [
        "dark frame d.tif taken off, median 17.5",
        f"flat field f.tif divided out, {low:.3g} to {high:.3g}",
    ]
    image, done, _ = read_corrected(capture, correction=Correction(offset=16.0))
    np.testing.assert_allclose(image, GAIN * light + DARK - 16, rtol=1e-6, atol=1e-4)
    assert done == ["offset 16 taken off"]


def test_nothing_to_do_leaves_the_file_as_it_is(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 900, SHAPE)
    found = read_corrected(saved(tmp_path / "a.tif", pixels, np.uint16), Sensor(SHAPE, 0.01))
    assert found.image.dtype == np.uint16 and not found.done and not found.warnings
    np.testing.assert_array_equal(found.image, pixels)


def test_vignetting_is_taken_out_of_a_volume():
    imager, grid = scene()
    light = np.random.default_rng(1).random(imager.sensor.shape)
    row, column = np.indices(light.shape)
    gain = np.cos(np.hypot(row - 47.5, column - 39.5) / 60) ** 4
    flat, _ = flat_field_gain(gain * 2e4 + 16, 16.0)
    whole = np.asarray(backproject(light, imager, grid))
    off = lambda image: np.abs(np.asarray(backproject(image, imager, grid)) / gain.mean() - whole).max() / whole.max()
    capture = gain * light + 16
    assert off(correct(capture, 16.0, flat)) < 1e-5
    assert off(capture - 16) > 0.3


def test_a_hot_pixel_is_not_the_brightest_voxel():
    """Of a ray-traced point, seen by 7 lenses, as brightly as a pixel may be."""
    imager = read_design(CAPTURES / "crop.toml").imager()
    image, hot = read_capture(CAPTURES / "point.tif"), (700, 300)
    grid = Grid.over(imager.sensor, depths=[20.0], pitch=0.03)
    brightest = lambda image: int(jnp.argmax(backproject(image.astype(np.float32), imager, grid)))
    broken = image.copy()
    broken[hot] = 65535
    assert brightest(broken) != brightest(image)
    found = find_hot_in_capture(broken)
    assert np.argwhere(found).tolist() == [list(hot)]
    assert brightest(fill_bad_pixels(broken, found)) == brightest(image)


@pytest.mark.parametrize("side", [1, 2, 4])
@pytest.mark.parametrize("name", ["point", "points"])
def test_sharp_spots_stay(name, side):
    """Whose middles are a pixel wide at half their height; binned, less."""
    image = read_capture(CAPTURES / f"{name}.tif").astype(np.uint16)
    rows, columns = (n // side for n in image.shape)
    image = image.reshape(rows, side, columns, side).sum((1, 3))
    assert not find_hot_in_capture(image.astype(np.float32)).any()
    broken = np.zeros_like(image, bool)
    broken[7::50, 9::60] = True
    assert (find_hot_in_capture(np.where(broken, 60_000, image).astype(np.uint16)) == broken).mean() > 0.999


def test_hot_pixels_of_a_dark_frame():
    """Beside a glow that is far brighter than the noise."""
    rng = np.random.default_rng(2)
    dark = 100 + rng.normal(0, 2, (200, 300)) + 300 * np.exp(-np.indices((200, 300))[1] / 40)
    hot = np.zeros(dark.shape, bool)
    hot[rng.integers(0, 200, 30), rng.integers(0, 300, 30)] = True
    np.testing.assert_array_equal(find_hot_in_dark(np.where(hot, dark + 500, dark).round().astype(np.uint16)), hot)


def test_bad_pixels_are_filled_from_good_ones():
    ramp = ROW + 2.0 * COLUMN
    bad = np.zeros(SHAPE, bool)
    bad[[0, 10, 59], [0, 10, 69]] = True
    bad[20:26, 30:37] = bad[:, 50] = True
    filled = fill_bad_pixels(np.where(bad, 1e6, ramp), bad)
    np.testing.assert_array_equal(filled[~bad], ramp[~bad])
    # Single ones by symmetry, but at the edge; a hole by its edge.
    assert filled[10, 10] == ramp[10, 10]
    assert np.abs(filled - ramp)[bad].max() < 10
    with pytest.raises(ValueError, match="must leave a good pixel"):
        fill_bad_pixels(ramp, np.ones(SHAPE, bool))


@pytest.mark.parametrize(
    ("top", "count", "dtype", "is_cut"),
    [
        (255, 5, np.uint8, True),
        (4095, 5, np.uint16, True),
        (65535, 5, np.uint16, True),
        (65520, 5, np.uint16, True),
        (3000, 50, np.uint16, True),
        (3000, 3, np.uint16, False),
        (3000, 50, np.float32, False),
        (65535, 1, np.uint16, False),
        (18, 50, np.uint16, False),
        (0, 0, np.uint8, False),
    ],
)
def test_what_is_cut_off(top, count, dtype, is_cut):
    image = np.random.default_rng(3).integers(0, max(top * 0.9, 1), SHAPE).astype(dtype)
    image.flat[:count] = top
    assert count_saturated(image) == ((count, top) if is_cut else None)


@pytest.mark.parametrize("light", [3e38, -3e38])
def test_light_whose_squares_float32_cannot_hold_is_refused(tmp_path, light):
    """Volumes of it would have infinities."""
    path = saved(tmp_path / "a.tif", np.full((1, 8, 8), light), np.float32)
    with pytest.raises(InputError, match=r"pixels must be at most 1e\+15 in size, got 3e\+38 \(.*a.tif\)"):
        read_corrected(path)


def test_what_was_done_is_said(tmp_path):
    """A mosaic's region, pages averaged, cut off in places, with a mask."""
    rng = np.random.default_rng(4)
    pages = rng.integers(0, 200, (4, 40, 50))
    pages[:, :5, :4] = 255
    mask = np.zeros((40, 50), bool)
    mask[8, 11] = mask[11, 8] = True
    np.save(tmp_path / "mask.npy", mask)
    readout = Readout(roi=(2, 4, 40, 50), bayer="RGGB", channel="green")
    image, done, warnings = read_corrected(
        saved(tmp_path / "a.tif", pages, np.uint8),
        Sensor(SHAPE, 0.01),
        page="mean",
        readout=readout,
        correction=Correction(bad_pixels=tmp_path / "mask.npy"),
    )
    assert image.shape == readout.sensor(Sensor(SHAPE, 0.01)).shape
    assert done == [
        "mean of 4 pages",
        "green of the mosaic RGGB, an image of its cells of 2 x 2 pixels",
        "rows 2 to 41, columns 4 to 53 of the sensor",
        "2 bad pixels filled from neighbours: 2 in mask.npy",
    ]
    assert len(warnings) == 1 and "a.tif: 80 pixels (0.01 of all) are saturated at 255" in warnings[0]


WRONG = {
    "dark": (Correction(dark=Path("other.tif")), ["other.tif", "40 x 50", "60 x 70"]),
    "flat": (Correction(flat=Path("other.tif")), ["other.tif", "40 x 50", "60 x 70"]),
    "mask": (Correction(bad_pixels=Path("other.tif")), ["other.tif", "40 x 50", "60 x 70"]),
    "missing": (Correction(dark=Path("none.tif")), ["none.tif", "No such file"]),
    "good": (Correction(bad_pixels=Path("good.npy")), ["good.npy", "100%", "0 for good"]),
    "unlit": (Correction(Path("dark.tif"), Path("dark.tif")), ["dark.tif", "median of 0", "even light"]),
    "both": (Correction(dark=Path("dark.tif"), offset=3.0), ["--offset", "dark.tif"]),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_file_is_named(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    for file, pixels in (("other.tif", np.ones((40, 50))), ("dark.tif", DARK), ("a.tif", np.ones(SHAPE))):
        saved(file, pixels)
    np.save("good.npy", np.ones(SHAPE, bool))
    for sensor in (Sensor(SHAPE, 0.01), None):
        with pytest.raises(InputError) as caught:
            read_corrected("a.tif", sensor, correction=WRONG[name][0])
        message = str(caught.value)
        assert message.isprintable() and len(message) < 400 and all(word in message for word in WRONG[name][1])
