from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from gs_jax import Grid, Imager, MicrolensArray, Sensor, backproject, backproject_adjoint

from .helpers import backproject_loop, scene

# Voxels that are coarser and finer than a pixel: 0.7 pixel, 3 pixels, 1/12 of a pixel apart on the sensor.
GRIDS = {
    "medium": dict(voxels=(21, 17), pitch=0.05),
    "coarse": dict(voxels=(9, 8), pitch=0.21),
    "fine": dict(voxels=(40, 33), pitch=0.006),
}


# What differs between methods is where rays are moved to, which does not depend on the size of voxels.
CASES = pytest.mark.parametrize(
    ("size", "method"),
    [
        *((size, "linear") for size in GRIDS),
        ("medium", "nearest"),
        *(pytest.param(size, "nearest", marks=pytest.mark.integration) for size in ("coarse", "fine")),
    ],
)


def image_of(sensor, dtype=np.float64, key=0):
    return np.random.default_rng(key).random(sensor.shape).astype(dtype)


def volume_of(grid, dtype=np.float64, key=1):
    return np.random.default_rng(key).random(grid.volume_shape).astype(dtype)


@partial(jax.jit, static_argnames="method")
def projections(image, volume, imager, grid, *, method="linear"):
    """Back-projection, also normalized, and the adjoint."""
    return (
        backproject(image, imager, grid, method=method),
        backproject(image, imager, grid, method=method, normalize=True),
        backproject_adjoint(volume, imager, grid, method=method),
    )


@CASES
def test_it_is_the_papers_sum(size, method):
    imager, grid = scene(**GRIDS[size])
    image = image_of(imager.sensor)
    expected, weights = backproject_loop(image, imager, grid, method)
    back, normal, _ = map(np.asarray, projections(image, volume_of(grid), imager, grid, method=method))
    np.testing.assert_allclose(back, expected, rtol=1e-11, atol=1e-12)
    seen = weights > 0
    np.testing.assert_allclose(normal[seen], expected[seen] / weights[seen], rtol=1e-11)
    assert np.all(normal[~seen] == 0)


def test_float32_is_as_accurate_as_float32_can_be():
    """Full-size sensor: coordinates of 5,000 pixels in float32 are rounded to 2e-4 of a pixel unless split."""
    rng = np.random.default_rng(3)
    sensor = Sensor((4096, 4096), 0.0045)
    image = rng.random(sensor.shape, dtype=np.float32)
    centers = rng.uniform(-9, 9, (40, 2)).astype(np.float32).astype(np.float64)
    imager = Imager(MicrolensArray(centers), sensor, 5.8, 3.0)
    grid = Grid([18.0, 21.0], (64, 64), 0.25)
    low = lambda tree: jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), tree)
    exact = np.asarray(backproject(image.astype(np.float64), imager, grid))
    error = np.abs(np.asarray(backproject(image, low(imager), low(grid)), np.float64) - exact).max()
    # White noise has a slope of up to 1 a pixel; a few 1e-6 pixels of 15 lenses add up to this.
    assert error < 2e-5 * exact.max()


@CASES
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-12), (np.float32, 1e-5)])
def test_adjoint(size, method, dtype, tolerance):
    imager, grid = scene(dtype, **GRIDS[size])
    image, volume = image_of(imager.sensor, dtype), volume_of(grid, dtype)
    back, _, forth = projections(image, volume, imager, grid, method=method)
    np.testing.assert_allclose(np.vdot(back, volume), np.vdot(image, forth), rtol=tolerance)


def test_adjoint_over_several_blocks_and_the_sensors_edge():
    """Sub-images wider than a block, that end off the sensor."""
    imager = Imager(MicrolensArray([[0.0, 0.0], [1.4, -1.2], [-3.0, 0.5]]), Sensor((700, 500), 0.0045), 5.8, 3.0)
    grid = Grid([18.0, 21.0], (90, 111), 0.037)
    image, volume = image_of(imager.sensor), volume_of(grid)
    back, forth = backproject(image, imager, grid), backproject_adjoint(volume, imager, grid)
    np.testing.assert_allclose(np.vdot(back, volume), np.vdot(image, forth), rtol=1e-12)


def smooth_image(sensor):
    """Neither flat nor rough, so that a finite difference across a pixel's edge is near the derivative."""
    row, column = jnp.meshgrid(*(jnp.arange(n, dtype=float) for n in sensor.shape), indexing="ij")
    return 2 + jnp.sin(row / 30) + jnp.cos(column / 40 + row / 50)


def volume_of_geometry(centers, v, thickness, rotation, shift, depths, origin, image):
    array = MicrolensArray(centers, substrate_thickness=thickness)
    moved = Imager(array, Sensor((96, 80), 0.02), v, 0.45, rotation=rotation, shift=shift)
    return backproject(image, moved, Grid(depths, (6, 5), 0.15, origin))


@pytest.mark.integration
@pytest.mark.parametrize("modes", [["fwd"], ["rev"]])
def test_gradients_by_everything(modes):
    imager, grid = scene(voxels=(6, 5), pitch=0.15)
    geometry = imager.array.centers, imager.sensor_distance, jnp.array(1.0), imager.rotation, imager.shift, grid.depths
    origin = jnp.array([0.011, -0.007])
    # Steps of 1e-6 mm stay within a pixel (bilinear interpolation has kinks at pixel centres) at this generic point.
    tolerances = dict(order=1, modes=modes, eps=1e-6, atol=1e-5, rtol=1e-5)
    check_grads(volume_of_geometry, (*geometry, origin, smooth_image(imager.sensor)), **tolerances)
    # A smooth weight: the adjoint's pixels are as kinked as the interpolation.
    moment = lambda imager, depths, volume: jnp.vdot(
        smooth_image(imager.sensor), backproject_adjoint(volume, imager, Grid(depths, grid.shape, grid.pitch))
    )
    check_grads(moment, (imager, grid.depths, volume_of(grid)), **tolerances)
    normalized = lambda imager: backproject(smooth_image(imager.sensor), imager, grid, normalize=True)
    check_grads(normalized, (imager,), **tolerances)


@pytest.mark.integration
def test_many_depths_go_in_groups():
    """37 depths are three groups of 13, of which two are padding."""
    imager, grid = scene(voxels=(7, 6), pitch=0.15, depths=np.linspace(18, 24, 37))
    image, volume = image_of(imager.sensor), volume_of(grid)
    one = grid.at(grid.depths[30:31])
    np.testing.assert_allclose(backproject(image, imager, grid)[30], backproject(image, imager, one)[0], rtol=1e-13)
    adjoint = backproject_adjoint(volume, imager, grid)
    np.testing.assert_allclose(jnp.vdot(backproject(image, imager, grid), volume), jnp.vdot(image, adjoint), rtol=1e-12)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integers_are_read_as_they_are(dtype):
    imager, grid = scene()
    image = np.random.default_rng(0).integers(0, 255, imager.sensor.shape).astype(dtype)
    expected = projections(image.astype(np.float64), volume_of(grid), imager, grid)[0]
    np.testing.assert_allclose(backproject(image, imager, grid), expected, rtol=1e-13)


@pytest.mark.integration
def test_memory_is_image_and_volume_and_a_small_constant():
    """What XLA itself plans to allocate, at full scale."""
    centers = np.random.default_rng(0).uniform(-10, 10, (213, 2))
    imager = Imager(MicrolensArray(centers), Sensor((5120, 5120), 0.0045), 5.8, 3.0)
    grid = Grid(np.linspace(18, 24, 13), (555, 555), 23.04 / 555)
    low = lambda tree: jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, jnp.float32), tree)
    image = jax.ShapeDtypeStruct(imager.sensor.shape, jnp.float32)
    volume = jax.ShapeDtypeStruct((13, 555, 555), jnp.float32)

    def gradient(image, imager, volume, grid):
        return jax.grad(lambda i: jnp.vdot(backproject(image, i, grid), volume))(imager)

    for function, arguments in [
        (backproject, (image, low(imager), low(grid))),
        (backproject_adjoint, (volume, low(imager), low(grid))),
        (jax.jit(gradient), (image, low(imager), volume, low(grid))),
    ]:
        assert function.lower(*arguments).compile().memory_analysis().temp_size_in_bytes < 60 * 2**20


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda i, g: backproject(np.zeros((4, 4)), i, g), r"sensor's shape \(96, 80\), got \(4, 4\)"),
        (lambda i, g: backproject(np.zeros((96, 80)), i, g, method="cubic"), '"linear" or "nearest", got \'cubic\''),
        (lambda i, g: backproject_adjoint(np.zeros((1, 2, 3)), i, g), r"grid's shape \(3, 21, 17\), got \(1, 2, 3\)"),
    ],
)
def test_wrong_arguments_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call(*scene())


@pytest.mark.parametrize("interpolation", ["linear", "nearest"])
def test_a_region_of_interest_is_a_part_of_the_whole(interpolation):
    imager, grid = scene()
    image = image_of(imager.sensor)
    rows, columns = slice(2, 9), slice(5, 14)
    x, y = np.asarray(grid.x), np.asarray(grid.y)
    region = Grid(grid.depths, (7, 9), grid.pitch, (x[columns].mean(), y[rows].mean()))
    whole = np.asarray(projections(image, volume_of(grid), imager, grid, method=interpolation)[0])
    part = backproject(image, imager, region, method=interpolation)
    np.testing.assert_allclose(part, whole[:, rows, columns], rtol=1e-11, atol=1e-12)
