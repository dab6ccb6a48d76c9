"""A tilted array: vertices by SciPy's rotations, operators, points and gradients."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import gs_jax as gs
from experiments.ray_tracer import bundles, traced
from experiments.true_image import scores
from gs_jax.codesign.linear_error import lost_power
from gs_jax.optics.raytrace import to_numpy
from gs_jax.projection.point_sources import forward_points, make_stamps

from .helpers import backproject_loop, scene

TILT = np.array([0.015, -0.02])
PLACES = np.random.default_rng(0).uniform(-4, 4, (20, 2))
POINT = np.array([[0.7, -1.1, 19.0]])


def tilted(tilt: Any = TILT) -> gs.Imager:
    return gs.Imager(
        gs.MicrolensArray(PLACES), gs.Sensor((700, 720), 0.016), 5.8, 2.5, rotation=0.3, shift=(0.1, 0.2), tilt=tilt
    )


@jax.jit
def vertices_and_spots(imager, points):
    return jnp.column_stack([imager.centers, imager.heights]), imager.project(points)


def test_vertices_are_those_of_a_turned_plane():
    plane, found = (np.array(vertices_and_spots(tilted(tilt), POINT)[0]) for tilt in (None, TILT))
    assert not plane[:, 2].any()
    angle = np.arctan(np.linalg.norm(TILT))
    axis = np.cross([0, 0, 1], np.array([*-TILT, 0]) / np.linalg.norm(TILT))
    turned = Rotation.from_rotvec(angle * axis).apply(plane)
    np.testing.assert_allclose(found, turned, atol=1e-12)
    np.testing.assert_allclose(found[:, 2], found[:, :2] @ TILT, atol=1e-12)


def test_chief_rays_are_straight_lines_through_the_vertices():
    imager = to_numpy(tilted())
    vertices, spots = map(np.asarray, vertices_and_spots(tilted(), POINT))
    plate = imager.array.substrate_thickness * (1 - 1 / imager.array.refractive_index)
    source = np.array([*(POINT[0, :2] + plate * TILT), float(imager.reduced_depth(19.0))])
    onward = (vertices[:, 2] + 5.8) / (source[2] - vertices[:, 2])
    landing = vertices[:, :2] + onward[:, None] * (vertices[:, :2] - source[:2])
    np.testing.assert_allclose(spots[:, 0], landing, atol=1e-12)


LAYERS = {
    "no layers": {},
    "filter": {"filters": gs.Layers([2.0], [1.52])},
    "gel": {"sample": gs.Sample(1.43, surface=17.5)},
    "filter, cover slip and gel": {
        "filters": gs.Layers([2.0], [1.52]),
        "sample": gs.Sample(1.43, surface=17.5, layers=gs.Layers([0.17], [1.523])),
    },
    "windows": {"windows": gs.Layers([0.6, 0.55], [1.0, 1.51])},
    "gel in contact": {"filters": gs.Layers([2.0], [1.52]), "sample": gs.Sample(1.43)},
}


@pytest.mark.integration
@pytest.mark.parametrize("orientation", ["plano", "curved"])
@pytest.mark.parametrize("layers", LAYERS)
def test_a_tilt_moves_spots_as_rays_do(layers, orientation):
    """By a plate and filters that tilt, and samples that are level or tilt. The map of no tilt is paraxial."""
    centers = np.array([[0.0, 0.0], [1.0, 0.5], [-0.8, 1.0], [4.0, -3.0], [5.0, -2.0]])
    lenses = gs.MicrolensArray(centers, aperture_diameter=0.02, orientation=orientation)
    points = np.array([[0.0, 0.0, 18.0], [0.5, -0.3, 20.0], [4.1, -2.6, 22.0]])
    errors = []
    for tilt in (None, (0.0175, -0.0105)):
        imager = gs.Imager(lenses, gs.Sensor((600, 600), 0.013), 5.3, 2.0, tilt=tilt, **LAYERS[layers])
        landed, _ = bundles(points, imager, 400)
        light = landed[..., 2:]
        spots = (landed[..., :2] * light).sum(2) / np.maximum(light.sum(2), 1e-30)
        views = imager.views_of_all(points)
        errors.append(np.where(np.hypot(*views.offset.T)[..., None] < 1.6, spots - views.spot.swapaxes(0, 1), 0))
        assert np.count_nonzero(errors[-1]) >= 10
    # In contact, where the gel is 18 mm thick, the map's own error is 4 um.
    np.testing.assert_allclose(*errors, atol=1.5e-3 if layers == "gel in contact" else 2e-4)


def test_light_is_brightest_on_the_axis_that_leans():
    """By the angle between the ray and the plane's normal, in three dimensions."""
    imager = tilted()
    normal = np.array([-TILT[0], -TILT[1], 1.0]) / np.sqrt(1 + TILT @ TILT)
    # A plate has no effect on the ray along the axis.
    distance = 20.0 + float(imager.array.substrate_thickness)
    lean = to_numpy(imager).axis_offset(np.array([20.0]))[0]
    np.testing.assert_allclose(np.cross([*lean, distance], normal), 0, atol=1e-12)
    alone = dataclasses.replace(imager, array=gs.MicrolensArray([[0.0, 0.0]]), field_radius=1.0)
    image = np.asarray(gs.backproject(np.ones((700, 720)), alone, gs.Grid([20.0], (161, 161), 0.02)))[0]
    row, column = np.unravel_index(image.argmax(), image.shape)
    center = to_numpy(alone).centers[0]
    assert np.abs((np.array([column, row]) - 80) * 0.02 - center - lean).max() < 0.02


@pytest.mark.integration
def test_no_tilt_and_a_tilt_of_zero_are_the_same():
    grid, volume = gs.Grid([18.0, 21.0], (61, 67), 0.1), np.random.default_rng(1).random((2, 61, 67))
    image = [gs.forward(volume, imager, grid) for imager in (tilted(None), tilted((0.0, 0.0)))]
    np.testing.assert_allclose(image[0], image[1], atol=1e-10)
    slopes = jax.grad(lambda tilt: jnp.sum(tilted_by(tilt).heights ** 2 + tilted_by(tilt).centers[:, 0]))(jnp.zeros(2))
    assert np.isfinite(slopes).all()


def tilted_by(tilt) -> gs.Imager:
    return eqx.tree_at(lambda i: i.tilt, tilted(), tilt)


@pytest.mark.parametrize("dtype, orientation", [(jnp.float64, "plano"), (jnp.float32, "curved")])
def test_volume_is_that_of_the_literal_loop_at_every_depth(dtype, orientation):
    """The axes lean by 0.6 mm at the nearest plane and 1.8 mm at the farthest: no patch of voxels holds both."""
    flat, grid = scene(dtype, shape=(240, 260), voxels=(21, 23), depths=(10.0, 30.0), pitch=0.2)
    array = dataclasses.replace(flat.array, orientation=orientation)
    imager = dataclasses.replace(flat, array=array, tilt=(0.05, -0.03))
    imager = jax.tree.map(lambda leaf: jax.device_put(np.array(leaf, dtype)), imager)
    image = np.random.default_rng(4).random(imager.sensor.shape).astype(dtype)
    expected = backproject_loop(image, imager, grid)[0]
    tolerance = 1e-10 if dtype == jnp.float64 else 1e-3
    np.testing.assert_allclose(gs.backproject(image, imager, grid), expected, atol=tolerance * expected.max())
    volume = np.random.default_rng(5).random(grid.volume_shape).astype(dtype)
    back = np.vdot(np.float64(image), np.float64(gs.forward(volume, imager, grid)))
    assert back == pytest.approx(np.vdot(np.float64(volume), expected), rel=tolerance)


@pytest.mark.integration
def test_points_are_where_the_grid_has_them_and_are_found():
    """40 points through lenses whose magnifications differ by three percent: chief rays of no tilt miss by pixels."""
    rng = np.random.default_rng(3)
    imager = dataclasses.replace(
        tilted(),
        array=gs.MicrolensArray(rng.uniform(-5, 5, (60, 2)), thin_lens_focal_length=4.65),
        sensor=gs.Sensor((1200, 1200), 0.012),
    )
    grid = gs.Grid([18.0, 20.0, 22.0], (141, 141), 0.05)
    voxels = np.column_stack([rng.integers(0, 3, 12), rng.integers(20, 121, (12, 2))])
    volume = np.zeros(grid.volume_shape)
    volume[tuple(voxels.T)] = 1
    spot = np.zeros((3, 45, 45))
    spot[:, 22, 22] = 1
    drawn = forward_points(
        np.column_stack([grid.to_mm(voxels), np.ones(12)]), imager, make_stamps(np.asarray(grid.depths), spot)
    )
    exact = np.asarray(gs.forward(volume, imager, grid))
    blurred = [gaussian_filter(np.asarray(image), 2) for image in (drawn, exact)]
    # Stamps lie on fifths of pixels: 0.14 with and without a tilt. Without the heights it would be above 1.
    assert np.linalg.norm(blurred[0] - blurred[1]) < 0.15 * np.linalg.norm(blurred[1])
    noisy = 1e4 * blurred[1] / blurred[1].max() + rng.normal(100, 5, exact.shape)
    found = gs.find_points(noisy, imager, grid)
    away = np.linalg.norm(found[:, None, :2] - grid.to_mm(voxels)[None, :, :2], axis=-1)
    # A pixel is 0.041 mm wide at the object.
    assert len(found) == 12 and np.median(away.min(0)) < 0.01 and away.min(0).max() < 0.08


def test_quantities_are_means_over_the_heights_of_the_lenses():
    """Each lens by itself as one of a level array, which is farther from the sensor and nearer to the object."""
    depths = np.array([18.0, 20.5, 23.0])
    imager = dataclasses.replace(tilted((0.05, -0.03)), filters=gs.Layers([2.0], [1.52]), sample=gs.Sample(1.43, 17.5))
    level = dataclasses.replace(imager, tilt=None)
    one = []
    focus = eqx.filter_jit(gs.objectives.focus_distance)
    for height in to_numpy(imager).heights:
        alone = dataclasses.replace(level, sensor_distance=5.8 + height, sample=gs.Sample(1.43, 17.5 - height))
        one.append(np.asarray(focus(alone, depths - height)) - height)
    # The rule of three heights is exact for polynomials: of 20 lenses at random, to a hundredth of the change.
    expected, change = np.mean(one, 0), np.std(one, 0)
    np.testing.assert_allclose(focus(imager, depths), expected, atol=0.02 * change.max())
    widths = [np.asarray(eqx.filter_jit(gs.objectives.sensor_blur)(one, depths)) for one in (level, imager)]
    assert (np.abs(widths[1] / widths[0] - 1) > 1e-3).all()
    slope = jax.jit(jax.grad(lambda tilt: gs.objectives.sensor_blur(tilted_by(tilt), [20.0])[0]))(np.zeros(2))
    assert np.isfinite(slope).all()


def test_the_error_of_volumes_sees_the_pose():
    """Objects that turn and move with the array are seen as before; a tilt changes what is seen."""
    # Level too, but of the structure of those that lean: compiled once.
    lenses = gs.MicrolensArray(PLACES, size=(8.0, 8.0))
    level = gs.Imager(lenses, gs.Sensor((1000, 1020), 0.016), 5.8, 2.5, tilt=(0.0, 0.0))
    at = gs.objectives.Conditions([19.0, 21.0])
    place = np.array([[0.4, -0.7]])
    # An eighth of a turn, which permutes the directions of frequencies.
    turned = dataclasses.replace(level, rotation=np.pi / 4, shift=(0.2, -0.1))
    moved = place @ (np.array([[1, 1], [-1, 1]]) / np.sqrt(2)) + np.array([0.2, -0.1])
    jitted = jax.jit(lambda imager, place: lost_power(imager, at, place))
    error = lambda imager, place: np.asarray(jitted(imager, place))
    np.testing.assert_allclose(error(turned, moved), error(level, place), rtol=1e-6)
    leaning = dataclasses.replace(level, tilt=(0.05, 0.0))
    assert (np.abs(error(leaning, place) / error(level, place) - 1) > 1e-3).all()


@pytest.mark.integration
def test_rays_leave_no_more_unexplained_than_of_a_level_array():
    """Of a point's whole image. Without bands of height it is twice as much (0.33 for 0.17 and 0.19)."""
    centers = gs.random_layout(60, (9.0, 9.0), diameter=1.9, seed=1)
    lenses, point = gs.MicrolensArray(centers, aperture_diameter=1.9), np.array([[0.2, -0.1, 20.0, 1.0]])
    errors = []
    for tilt in (None, (0.0175, -0.005)):
        imager = gs.Imager(
            lenses, gs.Sensor((1000, 1000), 0.01), 5.8, 3.0, tilt=tilt, **LAYERS["filter, cover slip and gel"]
        )
        errors.append(scores(gs.simulate(point, imager), traced(point, imager, 60_000))["bin_1"]["error"])
    assert errors[1] < 1.2 * errors[0]
