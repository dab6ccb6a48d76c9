"""The paper's particle clustering, by hand and by a literal loop."""

import numpy as np
import pytest
from skimage.measure import label

from gs_jax import Grid
from gs_jax.apps.benchmark import render_points
from gs_jax.detection.particles import find_clusters


def volume_grid(shape=(5, 40, 40)) -> Grid:
    return Grid(np.array([18.0, 18.5, 19.5, 21.0, 23.0])[: shape[0]], shape[1:], 0.1)


def blob(grid, place, value, width) -> np.ndarray:
    d, r, c = np.ogrid[: grid.depths.size, : grid.shape[0], : grid.shape[1]]
    distance2 = (d - place[0]) ** 2 + (r - place[1]) ** 2 + (c - place[2]) ** 2
    return value * np.exp(-distance2 / (2 * width**2))


def test_two_groups_of_the_lowest_threshold_and_two_of_a_higher():
    """Two blobs that touch at 10 % of their maximum and are apart at 20 %, one far away and half as bright."""
    grid = volume_grid()
    places = [(2, 10, 10), (2, 10, 18), (1, 30, 33)]
    blobs = [blob(grid, place, v, 2.0) for place, v in zip(places, (1.0, 0.9, 0.5), strict=True)]
    volume = np.sum(blobs, axis=0)
    touching = float(volume[2, 10, 14])
    assert 0.05 < touching < 0.3
    brightest = find_clusters(volume, grid, thresholds=(0.5 * touching,))
    assert len(brightest) == 2
    found = find_clusters(volume, grid, thresholds=(0.5 * touching, 1.5 * touching))
    x, y, z = (np.asarray(axis) for axis in (grid.x, grid.y, grid.depths))
    expected = [(x[c], y[r], z[d]) for d, r, c in places]
    np.testing.assert_allclose(found[:, :3], expected, atol=1e-12)
    # The plane's median is subtracted: the tails of the blobs, 1e-6.
    np.testing.assert_allclose(found[:, 3], [volume[place] for place in places], rtol=1e-5)


def test_the_authors_thresholds_as_a_loop_over_the_whole_volume():
    """The same groups, found by relabelling the whole volume for each group."""
    grid = volume_grid((4, 30, 30))
    rng = np.random.default_rng(0)
    places, values = rng.uniform(0, (4, 30, 30), (12, 3)), rng.uniform(0.2, 1, 12)
    volume = np.sum([blob(grid, place, v, 1.5) for place, v in zip(places, values, strict=True)], axis=0)
    volume -= np.median(volume, axis=(1, 2), keepdims=True)
    volume = volume.astype(np.float32)
    volume -= np.median(volume, axis=(1, 2), keepdims=True)
    masks, peaks = [np.ones(volume.shape, bool)], set()
    for threshold in (0.05, 0.1, 0.15, 0.2):
        masks, before = [], masks
        for mask in before:
            groups = np.asarray(label(mask & (volume > threshold * volume[mask].max()), connectivity=3))
            masks += [groups == number for number in range(1, groups.max() + 1)]
        peaks |= {int(np.where(mask, volume, -1).argmax()) for mask in masks}
    found = find_clusters(volume, grid)
    assert len(found) == len(peaks)
    np.testing.assert_allclose(found[:, 3], np.sort(volume.ravel()[list(peaks)])[::-1], rtol=1e-6)


def test_voxels_are_connected_by_their_corners():
    volume = np.zeros((3, 9, 9))
    volume[0, 2, 2], volume[1, 3, 3], volume[2, 6, 6] = 1.0, 0.9, 0.8
    found = find_clusters(volume, volume_grid((3, 9, 9)))
    np.testing.assert_allclose(found[:, 3], [1.0, 0.8], rtol=1e-6)


def test_of_equal_voxels_the_first_is_the_point():
    volume = np.zeros((1, 5, 5))
    volume[0, 2, 1:4] = 1
    ((x, y, z, value),) = find_clusters(volume, Grid([20.0], (5, 5), 0.1))
    assert (x, y, z, value) == (pytest.approx(-0.1), 0, 20, 1)


def test_flat_and_wrong_volumes():
    grid = Grid([18.0, 20.0], (6, 6), 0.1)
    for value in (0.0, 3.0, -1.0):
        assert find_clusters(np.full((2, 6, 6), value), grid).shape == (0, 4)
    with pytest.raises(ValueError, match=r"grid's shape \(2, 6, 6\), got \(1, 6, 6\)"):
        find_clusters(np.zeros((1, 6, 6)), grid)
    with pytest.raises(ValueError, match=r"between 0 and 1, got \(0.1, 1.0\)"):
        find_clusters(np.zeros((2, 6, 6)), grid, thresholds=(0.1, 1.0))


def test_clusters_of_noise_are_left_out():
    grid = Grid([20.0], (40, 36), 0.1)
    noise = 0.02 * np.random.default_rng(0).standard_normal((1, 40, 36)).astype(np.float32)
    # A maximum among 1440 Gaussian values exceeds five deviations once in 2000 times.
    assert not len(find_clusters(noise, grid))
    points = np.array([[0.35, -0.45, 20.0, 2.0], [-0.55, 0.85, 20.0, 1.0]])
    found = find_clusters(render_points(points, grid, 0.12) + noise, grid)
    np.testing.assert_allclose(found[:, :2], points[:, :2], atol=0.051)  # half a voxel
