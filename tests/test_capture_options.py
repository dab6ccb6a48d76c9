"""The command line on captures as cameras deliver them."""

import numpy as np
import pytest
import tifffile
from click.testing import CliRunner
from PIL import Image

from gs_jax.__main__ import commands
from gs_jax.design.design import read_design
from gs_jax.io.provenance import read_provenance
from gs_jax.io.volumes import read_volume

from .helpers import DESIGN

SHAPE = (96, 80)
LIGHT = np.random.default_rng(0).integers(100, 3000, SHAPE)
LIGHT[40, 30] = LIGHT[41, 30] = 4000
CUT = 4095


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "design.toml").write_text(DESIGN)
    save(tmp_path / "capture.tif", LIGHT)
    return tmp_path


def save(path, pixels):
    tifffile.imwrite(path, np.asarray(pixels, np.uint16), photometric="minisblack")


def reconstruct(name, *options):
    """The volume at 20 mm, its grid, and what was said."""
    arguments = ["reconstruct", name, "design.toml", "--depths", "20", "--voxel-um", "50", "-o", "v.ome.tif", *options]
    result = CliRunner().invoke(commands, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    return *read_volume("v.ome.tif"), result


def test_a_part_of_the_sensor_needs_no_other_design(folder):
    """The volume lies in the frame of the whole sensor."""
    whole, _, _ = reconstruct("capture.tif")
    save("part.tif", LIGHT[10:70, 4:64])
    part, grid, result = reconstruct("part.tif", "--roi", "10,4,60,60")
    np.testing.assert_allclose(grid.origin, [(4 + 30 - 40) * 0.02, (10 + 30 - 48) * 0.02], atol=1e-9)
    assert "part.tif: rows 10 to 69, columns 4 to 63 of the sensor" in result.stdout
    # A design that says the same makes the same volume.
    text = DESIGN.replace("shape = [96, 80]", "shape = [60, 60]\norigin_mm = [-0.12, -0.16]")
    (folder / "design.toml").write_text(text)
    np.testing.assert_allclose(reconstruct("part.tif")[0], part, rtol=1e-5)
    assert whole.shape != part.shape


def test_everything_at_once_is_said_and_recorded(folder):
    """Repeated frames of a binned part, with a dark frame, a flat field and a mask; some pixels at full scale."""
    pages = np.stack([LIGHT[:60, :60]] * 3)
    pages[:, 7, 5:8] = CUT
    save("pages.tif", pages)
    dark = np.full((60, 60), 16)
    dark[20, 20] = 900
    save("dark.tif", np.stack([dark] * 2))
    save("flat.tif", dark + 2000 - np.arange(60))
    mask = np.zeros((60, 60), np.uint8)
    mask[3, 4] = 255
    Image.fromarray(mask).save("mask.png")
    (folder / "design.toml").write_text(DESIGN.replace("[96, 80]", "[192, 160]").replace("= 20.0", "= 10.0"))
    options = ["--page", "mean", "--roi", "8,10,120,121", "--binning", "2"]
    options += ["--dark", "dark.tif", "--flat", "flat.tif", "--bad-pixels", "mask.png"]
    _, grid, result = reconstruct("pages.tif", *options)
    lines = [
        "mean of 3 pages",
        "rows 8 to 127, columns 10 to 130 of the sensor",
        "pixels binned 2 x 2",
        "dark frame dark.tif taken off, median 16",
        "flat field flat.tif divided out, 0.985 to 1.01",
        "2 bad pixels filled from neighbours: 1 hot in dark.tif, 1 in mask.png",
    ]
    assert result.stdout.splitlines()[:6] == [f"pages.tif: {line}" for line in lines]
    assert "warning: pages.tif: 9 pixels (0.00083 of all) are saturated at 4095" in result.stderr
    said = read_provenance("v.ome.tif")
    assert all(line in said["correction"] for line in lines)
    assert {"input dark.tif", "input flat.tif", "input mask.png"} < set(said)
    np.testing.assert_allclose(grid.origin, [(10 + 60 - 80) * 0.01, (8 + 60 - 96) * 0.01], atol=1e-9)


def test_a_colour_of_a_mosaic(folder):
    volume, grid, result = reconstruct("capture.tif", "--bayer", "GRBG", "--channel", "red")
    np.testing.assert_allclose(grid.origin, [0.01, -0.01], atol=1e-9)
    assert "capture.tif: red of the mosaic GRBG" in result.stdout and volume.max() > 0


def test_a_hot_pixel_is_repaired_unless_it_is_not_wanted(folder):
    pixels = np.full(SHAPE, 20)
    pixels[48, 40] = CUT
    save("hot.tif", pixels)
    volume, _, result = reconstruct("hot.tif")
    assert volume.max() < 100
    assert "hot.tif: 1 bad pixel filled from neighbours: 1 hot in the capture" in result.stdout
    volume, _, result = reconstruct("hot.tif", "--bad-pixels", "none")
    assert volume.max() > 1000 and "bad pixel" not in result.stdout


def test_a_cameras_offset(folder):
    volume, _, result = reconstruct("capture.tif", "--offset", "100")
    assert "capture.tif: offset 100 taken off" in result.stdout
    assert volume.max() < reconstruct("capture.tif")[0].max()


def test_deconvolve_reads_the_same_way(folder):
    save("capture.tif", np.stack([LIGHT, LIGHT]))
    save("psf.tif", 5 + np.pad([[50]], 6))
    arguments = "deconvolve capture.tif psf.tif --steps 1 -o s.tif --page mean --offset 5".split()
    result = CliRunner().invoke(commands, arguments, catch_exceptions=False)
    assert "2 captures: offset 5 taken off" in result.stdout
    assert "offset 5" in read_provenance("s.tif")["correction"]


def test_a_region_in_a_design():
    """Its lenses may lie beyond it, one excepted."""
    from gs_jax.design.design import Design

    data = read_design("design/geomscope.toml").model_dump()
    data["sensor"] = {"shape": (800, 900), "pixel_pitch_um": 4.5, "origin_mm": (-2.0, 3.0)}
    sensor = Design.model_validate(data).imager().sensor
    assert (sensor.shape, sensor.origin) == ((800, 900), (-2.0, 3.0))
    for wrong, words in (({"origin_mm": None}, "beside the sensor"), ({"origin_mm": (90.0, 0.0)}, "beside the sensor")):
        with pytest.raises(ValueError, match=words):
            Design.model_validate(data | {"sensor": data["sensor"] | wrong})
