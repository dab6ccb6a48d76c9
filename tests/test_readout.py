"""Regions, binned pixels and colours of a sensor: the frame stays that of the whole."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import gs_jax as gs
from gs_jax import Grid, Imager, Sensor, backproject, forward, psf_model
from gs_jax.base.errors import InputError
from gs_jax.io.camera import Readout
from gs_jax.io.captures import PATTERNS, mosaic_channel

from .helpers import CAPTURES, scene

WHOLE = Sensor((96, 80), 0.02)
# What the camera makes of all its pixels.
READOUTS = {
    "roi": Readout(roi=(7, 10, 61, 50)),
    "binned": Readout(binning=2),
    "odd": Readout(roi=(5, 3, 88, 74), binning=3),
    **{
        f"{pattern} {channel}": Readout(bayer=pattern, channel=channel)
        for pattern, channel in zip(PATTERNS, ("red", "green", "blue", "red"), strict=True)
    },
    "mosaic's region": Readout(roi=(7, 10, 61, 51), bayer="GRBG", channel="blue"),
}


def read_out(image, readout):
    row, column, rows, columns = readout.roi or (0, 0, *image.shape)
    side, image = readout.binning, image[row : row + rows, column : column + columns]
    rows, columns = (n // side for n in image.shape)
    image = image[: rows * side, : columns * side].reshape(rows, side, columns, side).sum((1, 3))
    return mosaic_channel(image, readout.bayer, readout.channel) if readout.bayer else image


def with_sensor(imager, sensor) -> Imager:
    return eqx.tree_at(lambda i: i.sensor, imager, sensor)


def test_an_origin_is_the_middle_of_the_pixels():
    sensor = Sensor((5, 4), 0.01, (0.3, -0.2))
    np.testing.assert_allclose(sensor.to_mm(np.array([2.0, 1.5])), [0.3, -0.2], rtol=1e-14)
    points = np.random.default_rng(0).normal(size=(7, 2))
    np.testing.assert_allclose(sensor.to_mm(sensor.to_pixels(points)), points, rtol=1e-12)
    np.testing.assert_allclose(sensor.extent, [0.28, 0.32, -0.175, -0.225])
    grid = Grid.over(sensor, depths=[20.0], pitch=0.01)
    np.testing.assert_allclose(grid.origin, sensor.origin)
    with pytest.raises(ValueError, match="origin"):
        Sensor((5, 4), 0.01, (np.nan, 0.0))


@pytest.mark.parametrize("name", READOUTS)
def test_coordinates_of_pixels_are_those_of_the_whole_sensor(name):
    """The image of x, read out, is the x of the pixels that were read out; likewise y."""
    readout = READOUTS[name]
    sensor = readout.sensor(WHOLE)
    row, column = np.indices(WHOLE.shape)
    x, y = np.moveaxis(np.asarray(WHOLE.to_mm(np.stack([row, column], -1).astype(float))), -1, 0)
    light = readout.binning**2
    assert read_out(x, readout).shape == sensor.shape
    here = np.asarray(sensor.to_mm(np.moveaxis(np.indices(sensor.shape), 0, -1).astype(float)))
    # Green is a mean in float32.
    np.testing.assert_allclose(read_out(x, readout) / light, here[..., 0], atol=1e-6)
    np.testing.assert_allclose(read_out(y, readout) / light, here[..., 1], atol=1e-6)


@pytest.mark.parametrize("method", ["nearest", "linear"])
def test_back_projection_of_a_region_is_that_of_the_whole_without_the_rest(method):
    imager, grid = scene()
    row, column, rows, columns = 20, 9, 50, 61
    lit = np.zeros(WHOLE.shape)
    # A dark line around: linear interpolation between it and what is beyond.
    inside = np.s_[row + 1 : row + rows - 1, column + 1 : column + columns - 1]
    lit[inside] = np.random.default_rng(1).random((rows - 2, columns - 2))
    part = with_sensor(imager, Readout(roi=(row, column, rows, columns)).sensor(imager.sensor))
    seen = backproject(lit[row : row + rows, column : column + columns], part, grid, method=method)
    np.testing.assert_allclose(seen, backproject(lit, imager, grid, method=method), atol=1e-12)


@pytest.mark.integration
@pytest.mark.parametrize("level", ["pinhole", "near"])
def test_the_image_on_a_region_is_the_region_of_the_image(level):
    imager, grid = scene()
    volume = np.random.default_rng(2).random(grid.volume_shape)
    part = with_sensor(imager, Readout(roi=(11, 8, 70, 64)).sensor(imager.sensor))
    optics = psf_model(imager, grid, level)
    whole = np.asarray(forward(volume, imager, grid, optics))[11:81, 8:72]
    # Without a PSF rays that land within a pixel of the region's edge are not read.
    edge = np.s_[1:-1, 1:-1]
    seen = np.asarray(forward(volume, part, grid, optics))
    np.testing.assert_allclose(seen[edge], whole[edge], atol=1e-9 * whole.max())


@pytest.mark.integration
@pytest.mark.parametrize("level", ["pinhole", "full"])
def test_an_origin_moves_the_frame_and_nothing_else(level):
    """The chief-ray map does not mind where the origin is; of "full", coarse pixels lie on the region."""
    imager, grid = scene()
    grid = grid.at([20.0])
    volume = np.random.default_rng(3).random(grid.volume_shape)
    region = Readout(roi=(11, 8, 71, 64)).sensor(imager.sensor)
    optics = psf_model(imager, grid, level)
    seen = forward(volume, with_sensor(imager, region), grid, optics)
    moved = eqx.tree_at(
        lambda i: i.shift, with_sensor(imager, Sensor(region.shape, 0.02)), imager.shift - jnp.array(region.origin)
    )
    grid = eqx.tree_at(lambda g: g.origin, grid, grid.origin - jnp.array(region.origin))
    np.testing.assert_allclose(seen, forward(volume, moved, grid, optics), atol=1e-12 * float(seen.max()))


@pytest.mark.slow
@pytest.mark.parametrize(
    "readout",
    [Readout(roi=(201, 100, 900, 1001)), Readout(binning=2), Readout(bayer="GRBG", channel="green")],
)
def test_points_are_the_same(readout):
    """Of the ray-traced crop, whose points the whole capture shows to 2 um and 45 um: within a pixel of the readout."""
    imager, truth = gs.read_design(CAPTURES / "crop.toml").imager(), gs.read_points(CAPTURES / "points.csv")
    image = read_out(gs.read_capture(CAPTURES / "points.tif").astype(float), readout)
    part = with_sensor(imager, readout.sensor(imager.sensor))
    grid = Grid.over(part.sensor, depths=jnp.arange(18.0, 22.1, 0.25), pitch=0.05)
    found = gs.find_points(image, part, grid)
    left, right, bottom, top = part.sensor.extent
    x, y = truth[:, 0], truth[:, 1]
    inside = truth[(left < x) & (x < right) & (top < y) & (y < bottom)]
    pixel = part.sensor.pixel_pitch / float(imager.magnification(20.0))
    distance = np.abs(found[:, None, :3] - inside[None, :, :3])
    same = (distance[..., :2] < pixel).all(-1) & (distance[..., 2] < 0.2)
    assert same.any(1).all() and same.any(0).mean() > 0.8


@pytest.mark.parametrize(
    ("readout", "words"),
    [
        (Readout(roi=(50, 0, 47, 80)), ["--roi", "rows 50 to 96", "96 x 80"]),
        (Readout(roi=(0, 0, 10, 10), binning=8), ["1 x 1", "2 x 2"]),
        (Readout(binning=2, bayer="RGGB", channel="red"), ["--binning 2", "--bayer RGGB"]),
        (Readout(bayer="RGGB"), ["--bayer RGGB", "red, green, blue"]),
        (Readout(bayer="RGGG", channel="red"), ["'RGGG'", "GBRG"]),
    ],
)
def test_wrong_readouts(readout, words):
    with pytest.raises(InputError) as caught:
        readout.sensor(WHOLE)
    for word in words:
        assert word in str(caught.value)
