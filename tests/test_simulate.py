from typing import Any

import numpy as np
import pytest

from gs_jax import Grid, Imager, MicrolensArray, Sensor
from gs_jax.base.errors import InputError
from gs_jax.base.progress import Progress
from gs_jax.optics.psf import PSFS, psf_of_depth
from gs_jax.optics.pupil import pupil_quadrature
from gs_jax.optics.raytrace import trace_lenslet
from gs_jax.simulation import simulate, simulate_points, simulate_volume


def imager(sensor_distance=5.8, pixel=0.01):
    array = MicrolensArray([[0.0, 0.0], [0.2, 0.1]], aperture_diameter=0.3, size=(2.0, 2.0))
    return Imager(array, Sensor((96, 80), pixel), sensor_distance, 0.6)


@pytest.mark.integration
@pytest.mark.parametrize("kind", PSFS)
def test_a_point_is_a_small_voxel(kind):
    out_of_focus = imager(sensor_distance=4.8)  # a pixel is small beside the blur
    options: dict[str, Any] = dict(kind=kind, progress=Progress())
    grid = Grid([19.0, 21.0], (5, 5), 0.01)
    volume = np.zeros((2, 5, 5), np.float32)
    assert not simulate_volume(volume, out_of_focus, grid, **options).any()
    volume[1, 3, 1] = 2
    point = np.array([[float(grid.x[1]), float(grid.y[3]), 21.0, 2.0]])
    from_points = simulate_points(point, out_of_focus, **options)
    assert not simulate_points(point + [50, 0, 0, 0], out_of_focus, **options).any()
    assert not simulate_points(point[:0], out_of_focus, **options).any()
    from_volume = simulate_volume(volume, out_of_focus, grid, **options)
    np.testing.assert_allclose(from_points.sum(), from_volume.sum(), rtol=1e-2)  # diffraction beyond the windows
    for index in np.indices(from_points.shape):
        middle = lambda image: (index * image).sum() / image.sum()  # noqa: B023
        assert abs(middle(from_points) - middle(from_volume)) < 0.1  # the steps of a stamp
    # The volume's point is shared by four pixels first.
    np.testing.assert_allclose(from_points.max(), from_volume.max(), rtol=0.3)


@pytest.mark.integration
@pytest.mark.parametrize(("sensor_distance", "pixel"), [(5.0, 0.002), (5.0, 0.001), (5.8, 0.01)])
def test_the_window_holds_the_light(sensor_distance, pixel):
    """Near the focus of the rim's rays other zones land farther out: all rays that get through, counted one by one."""
    array = MicrolensArray([[0.0, 0.0]], aperture_diameter=1.6, size=(4.0, 4.0))
    wide = Imager(array, Sensor((64, 64), pixel), sensor_distance, 0.6)
    window = psf_of_depth(wide, [20.0], "geometric")(20.0).shape[0]
    points, weights = pupil_quadrature(0.8, rings=40)
    rays = trace_lenslet(wide, 20.0, points)
    inside = (np.abs(rays.landing) < window / 2 * pixel).all(1)
    assert np.sum(weights, where=rays.valid & inside) > 0.999 * np.sum(weights, where=rays.valid)


@pytest.mark.integration
def test_a_coarse_volume_has_no_dots():
    """Voxels three pixels apart on the sensor make an image as even as an even object does."""
    grid = Grid([20.0], (9, 9), 0.12)
    image = simulate_volume(np.ones((1, 9, 9), np.float32), imager(), grid)
    middle = image[40:56, 34:46]
    np.testing.assert_allclose(middle, middle.mean(), rtol=0.05)  # the envelope falls by 2 %, the raster's ripple by 3


@pytest.mark.integration
def test_many_depths_share_stamps():
    """Between the depths of the stamps the PSF is interpolated: the image of a column of points stays smooth."""
    z = np.linspace(20, 20.5, 40)
    points = np.column_stack([np.zeros_like(z), np.zeros_like(z), z, np.ones_like(z)])
    options: dict[str, Any] = dict(kind="geometric", progress=Progress())
    together = simulate_points(points, imager(), **options)
    apart = np.sum([simulate_points(point[None], imager(), **options) for point in points[::4]], axis=0)
    np.testing.assert_allclose(
        together / together.sum(), apart / apart.sum(), atol=0.05 * together.max() / together.sum()
    )


@pytest.mark.integration
def test_depths_are_taken_some_at_a_time(monkeypatch):
    """A long column of points, one of them on the border of two slabs, is the sum of its images in one slab."""
    z = np.append(np.linspace(15, 16.3, 30), 15.5)
    points = np.column_stack([0 * z, 0 * z, z, np.ones_like(z)])
    options: dict[str, Any] = dict(kind="gaussian")
    whole = simulate_points(points, imager(), **options)
    monkeypatch.setattr("gs_jax.simulation._SLAB", 5)
    np.testing.assert_allclose(simulate_points(points, imager(), **options), whole, atol=1e-12 * whole.max())


def test_what_cannot_be_simulated_is_refused():
    options: dict[str, Any] = dict(progress=Progress())
    with pytest.raises(InputError, match="blur must reach at most 128 pixels of the sensor each way, got"):
        simulate_points(np.array([[0.0, 0.0, 0.05, 1.0]]), imager(pixel=0.002), **options)
    with pytest.raises(InputError, match="voxels must not be negative, got -1"):
        simulate_volume(-np.ones((1, 3, 3), np.float32), imager(), Grid([20.0], (3, 3), 0.05), **options)
    for scene, grid, message in (
        # More than float32 holds.
        (np.array([[0.0, 0.0, 20.0, 1e39]]), None, r"scene: intensity must be at most 1e\+30, got 1e\+39"),
        (np.full((1, 3, 3), 3e38), Grid([20.0], (3, 3), 0.05), r"scene: intensity must be at most 1e\+30, got 3e\+38"),
        (np.full((1, 3, 3), np.nan), Grid([20.0], (3, 3), 0.05), "scene must be finite, got 9 of 9 voxels NaN"),
        (np.array([[0.0, np.nan, 20.0, 1.0]]), None, "scene must be finite, got 1 of 4 numbers NaN"),
        (np.zeros((3, 5, 4)), None, r"scene must be points \(point, 4\), or a volume with its grid"),
        (np.zeros((1, 3, 4)), Grid([20.0], (3, 3), 0.05), r"scene must have the grid's shape \(1, 3, 3\)"),
        (np.array([[0.0, 0.0, -20.0, 1.0]]), None, "depths of points must be positive, got -20 mm"),
    ):
        with pytest.raises(InputError, match=message):
            simulate(scene, imager(), grid, optics="near", psf="geometric")
