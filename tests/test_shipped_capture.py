"""The ray-traced captures in tests/data: nothing of our model is in them. See its README."""

import numpy as np
import pytest

import gs_jax as gs

from .helpers import CAPTURES

pytestmark = pytest.mark.integration

BLACK = 16  # The camera's value in the dark.


@pytest.fixture(scope="module")
def imager() -> gs.Imager:
    return gs.read_design(CAPTURES / "crop.toml").imager()


def image_and_truth(name: str, imager: gs.Imager) -> tuple[np.ndarray, np.ndarray]:
    image = gs.read_capture(CAPTURES / f"{name}.tif", imager.sensor.shape)
    return np.asarray(image, np.float64) - BLACK, gs.read_points(CAPTURES / f"{name}.csv")


def test_back_projection_is_brightest_where_the_point_was(imager):
    image, ((x, y, z, _),) = image_and_truth("point", imager)
    grid = gs.Grid.over(imager.sensor, depths=z + np.arange(-0.4, 0.41, 0.1), pitch=0.02)
    volume = np.asarray(gs.backproject(image, imager, grid))
    ((*lateral, depth),) = grid.to_mm(np.argwhere(volume == volume.max()))
    np.testing.assert_allclose(lateral, (x, y), atol=0.02)  # a voxel
    assert abs(depth - z) <= 0.1  # aberrations focus nearer or farther than the chief rays cross


def test_forward_puts_light_where_rays_put_it(imager):
    """For each lens up to 2 mm beside the point, the middle of the spot's core, and its light."""
    image, (point,) = image_and_truth("point", imager)
    grid = gs.Grid(point[2:3], (1, 1), 0.01, point[:2])
    ours = np.asarray(gs.forward(np.ones((1, 1, 1)), imager, grid))
    pixels = np.asarray(imager.sensor.to_pixels(imager.project(point[None, :3])[:, 0]))
    beside = np.hypot(*(np.asarray(imager.centers) - point[:2]).T)
    spots = [core(image, at, 20) for at in pixels[beside <= 2]]
    model = [core(ours, at, 2) for at in pixels[beside <= 2]]
    assert len(spots) == 7
    offsets = np.array([spot[0] - voxel[0] for spot, voxel in zip(spots, model, strict=True)])
    # The brightest pixel, about which the core is taken, is at most half a pixel from its middle; and noise.
    assert np.abs(offsets).max() < 0.6 and np.abs(offsets.mean(0)).max() < 0.2
    light = np.array([spot[1] / voxel[1] for spot, voxel in zip(spots, model, strict=True)])
    np.testing.assert_allclose(light / light.mean(), 1, atol=0.05)  # aberrations move light out of the core


def core(image: np.ndarray, near: np.ndarray, reach: int) -> tuple[np.ndarray, float]:
    """Centroid and light of the 5 x 5 pixels about the brightest within `reach` pixels."""
    pixels = np.indices(image.shape)
    middle = np.floor(near + 0.5)[:, None, None]
    window = np.abs(pixels - middle).max(0) <= reach
    peak = np.unravel_index(np.argmax(np.where(window, image, -np.inf)), image.shape)
    square = tuple(slice(at - 2, at + 3) for at in peak)
    light = image[square].sum()
    return (pixels[:, *square] * image[square]).sum((1, 2)) / light, light


@pytest.mark.parametrize("name", ["point", "points"])
def test_points_are_found_and_nothing_else(imager, name):
    """The bars of the whole captures; points beside the sensor throw light on it and are not to be found."""
    image, truth = image_and_truth(name, imager)
    grid = gs.Grid.over(imager.sensor, depths=np.arange(17.0, 23.01, 0.25), pitch=0.03)
    left, right, bottom, top = grid.extent
    x, y = truth[:, 0], truth[:, 1]
    truth = truth[(left <= x) & (x <= right) & (top <= y) & (y <= bottom)]
    found = gs.find_points(image, imager, grid, progress=gs.Progress())
    score = gs.localization(found, truth)
    assert score.f1 == 1 and len(truth) == {"point": 1, "points": 12}[name]
    assert score.lateral_rmse <= 0.015 and score.axial_rmse <= 0.12
    of_found, of_truth = score.pairs.T
    flux = found[of_found, 3] / truth[of_truth, 3]
    np.testing.assert_allclose(flux / flux.mean(), 1, atol=0.06)
