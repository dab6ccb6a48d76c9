import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import fftconvolve

from gs_jax import Grid, Imager, MicrolensArray, Sensor, backproject_adjoint, forward
from gs_jax.apps.benchmark import peak_mib
from gs_jax.microscope.geometry import envelope
from gs_jax.optics.psf import gaussian_psf
from gs_jax.optics.raytrace import to_numpy
from gs_jax.projection.point_sources import STEPS, forward_points, make_stamps

from .helpers import scene


def psfs(depths, size=5, dtype=jnp.float64):
    """Lopsided, one for each depth, of sum 1."""
    kernels = np.random.default_rng(1).uniform(0.1, 1, (depths, size, size))
    return (kernels / kernels.sum((1, 2), keepdims=True)).astype(dtype)


def with_sensor(imager, shape):
    return eqx.tree_at(lambda i: i.sensor, imager, Sensor(shape, imager.sensor.pixel_pitch))


def volume_of(grid, dtype=jnp.float64):
    return np.random.default_rng(2).random(grid.volume_shape).astype(dtype)


@pytest.mark.integration
def test_without_a_psf_it_is_the_adjoint_of_back_projection():
    imager, grid = scene()
    volume = volume_of(grid)
    expected = backproject_adjoint(volume, imager, grid)
    np.testing.assert_array_equal(forward(volume, imager, grid), expected)
    point = jnp.zeros((3, 5, 5)).at[:, 2, 2].set(1.0)
    # Except at the edge, which shares the light of rays up to a pixel beyond it.
    inner = np.s_[1:-1, 1:-1]
    image = forward(volume, imager, grid, point)[inner]
    np.testing.assert_allclose(image, expected[inner], atol=1e-13 * expected.max())
    integers = jax.random.randint(jax.random.key(2), grid.volume_shape, 0, 9)
    for psf in (None, point):
        floats = forward(integers.astype(float), imager, grid, psf)
        np.testing.assert_array_equal(forward(integers, imager, grid, psf), floats)


@pytest.mark.integration
def test_each_depth_is_convolved_with_its_psf():
    imager, grid = scene()
    volume, kernels = volume_of(grid), psfs(3)
    expected = np.zeros(imager.sensor.shape)
    wide = with_sensor(imager, [n + 6 for n in imager.sensor.shape])
    for depth, plane, kernel in zip(grid.depths, volume, kernels, strict=True):
        sharp = backproject_adjoint(plane[None], wide, Grid(depth[None], grid.shape, grid.pitch))
        expected += fftconvolve(sharp[1:-1, 1:-1], kernel, mode="valid")
    np.testing.assert_allclose(forward(volume, imager, grid, kernels), expected, atol=1e-12 * float(expected.max()))


@pytest.mark.integration
def test_light_of_chief_rays_beside_the_sensor():
    """The middle of a larger sensor: a PSF of 11 pixels reaches 5 pixels in."""
    imager, grid = scene(shape=(48, 40))
    volume, kernels = volume_of(grid), psfs(3, 11)
    expected = forward(volume, with_sensor(imager, (48 + 40, 40 + 40)), grid, kernels)[20:-20, 20:-20]
    np.testing.assert_allclose(forward(volume, imager, grid, kernels), expected, atol=1e-12 * float(expected.max()))
    # Points' images are made one by one, and nowhere else.
    lone = Grid([20.0], (1, 1), 0.01)
    beside = Imager(MicrolensArray([[0.0, 0.0]]), Sensor((41, 41), 0.01), 5.0, 3.0, shift=(0.22, 0.0))
    fine = np.zeros((1, 55, 55))
    fine[0, 20:35, 20:35] = 1 / 225
    point = forward_points(np.array([[0.0, 0.0, 20.0, 1.0]]), beside, make_stamps(np.array([20.0]), fine))
    kernel = jnp.asarray(fine.reshape(1, 11, 5, 11, 5).sum((2, 4)))
    np.testing.assert_allclose(forward(jnp.ones((1, 1, 1)), beside, lone, kernel), point, atol=1e-6)


def test_the_surface_of_a_lens_has_gradients_by_its_psf():
    """Against differences; the map of chief rays has none, so a PSF computed before gives none."""
    array = MicrolensArray([[-0.6, 0.3], [0.1, -0.5]], aperture_diameter=0.6)
    imager, grid = Imager(array, Sensor((24, 24), 0.1), 5.0, 1.2), Grid([18.0, 22.0], (3, 3), 0.6)
    weights, volume = np.random.default_rng(3).normal(size=(24, 24)), volume_of(grid)
    names = ("radius_of_curvature", "conic_constant", "aperture_diameter")
    surface = lambda imager: [getattr(imager.array, name) for name in names]
    start = np.stack(surface(imager))

    def score(of_map, of_psf):
        here, lens = (eqx.tree_at(surface, imager, list(numbers)) for numbers in (of_map, of_psf))
        psf = jax.vmap(lambda depth: gaussian_psf(lens, depth, size=7))(grid.depths)
        return jnp.vdot(weights, forward(volume, here, grid, psf) ** 2)

    with_slopes = jax.jit(jax.value_and_grad(score, (0, 1)))
    _, (by_map, by_psf) = with_slopes(start, start)
    value = lambda numbers: float(with_slopes(numbers, numbers)[0])
    slopes = [(value(start + step) - value(start - step)) / 2e-4 for step in 1e-4 * np.eye(3)]
    np.testing.assert_allclose(by_psf, slopes, rtol=1e-5)
    assert np.all(np.asarray(by_psf) != 0) and not np.any(by_map)


def test_the_energy_is_the_envelope_times_the_object():
    imager = Imager(MicrolensArray([[0.1, 0.0], [-0.3, 0.2]]), Sensor((200, 200), 0.02), 5.8, 0.45)
    grid = Grid([20.0, 24.0], (3, 3), 0.1)
    volume = volume_of(grid)
    y, x = np.meshgrid(grid.y, grid.x, indexing="ij")
    expected, host = 0, to_numpy(imager)
    for z, plane in zip(np.asarray(grid.depths), volume, strict=True):
        for cx, cy in host.centers:
            light = envelope((x - cx) ** 2 + (y - cy) ** 2, host.reduced_depth(z), imager.field_radius)
            expected += np.vdot(light, plane)
    np.testing.assert_allclose(forward(volume, imager, grid, psfs(2)).sum(), expected, rtol=1e-12)


@pytest.mark.parametrize("shape", [(2, 5, 5), (3, 4, 4), (3, 5, 3)])
def test_wrong_psfs_are_refused(shape):
    imager, grid = scene()
    with pytest.raises(ValueError, match=r"`optics` must be \(3, size, size\) with an odd size"):
        forward(volume_of(grid), imager, grid, np.ones(shape))


def zones_of_lenses(grid, centers):
    """Which lens each voxel is nearest to."""
    y, x = np.meshgrid(grid.y, grid.x, indexing="ij")
    return np.argmin((x[..., None] - centers[:, 0]) ** 2 + (y[..., None] - centers[:, 1]) ** 2, axis=-1)


def equation_2(volume, imager, grid, psf, zone):
    """Eq. (2) as printed: for each depth and zone, the scaled local object convolved with the scaled local PSF.

    Convolutions of rasters, so all places must be pixel centres. The object is also turned round, which the paper
    does not print. `zone` numbers the zone of each voxel; its centroid is rounded to a voxel.
    """
    rows, columns = imager.sensor.shape
    image = np.zeros((rows, columns))
    x, y, imager = np.asarray(grid.x), np.asarray(grid.y), to_numpy(imager)
    raster = lambda place: np.round(np.asarray(imager.sensor.to_pixels(np.asarray(place)))).astype(int)
    for d, z in enumerate(np.asarray(grid.depths)):
        scale, magnification = float(imager.scale(z)), float(imager.magnification(z))
        for i in np.unique(zone):
            r, c = np.nonzero(zone == i)
            x_i, y_i = x[round(c.mean())], y[round(r.mean())]
            local_object, comb = np.zeros((rows, columns)), np.zeros((rows, columns))
            turned = raster(-magnification * np.column_stack([x[c] - x_i, y[r] - y_i]))
            np.add.at(local_object, tuple(turned.T), np.asarray(volume)[d, r, c])
            distance2 = ((np.asarray(imager.centers) - [x_i, y_i]) ** 2).sum(1)
            light = np.asarray(envelope(distance2, imager.reduced_depth(z), imager.field_radius))
            peaks = raster(scale * np.asarray(imager.centers) - magnification * np.array([[x_i, y_i]]))
            np.add.at(comb, tuple(peaks.T), light)
            image += fftconvolve(local_object, fftconvolve(comb, psf[d], mode="same"), mode="same")
    return image


def zone_scene(field_radius):
    """All places on pixel centres: M = 1/2, centres and voxels at multiples of two pixels."""
    centers = 0.04 * np.random.default_rng(4).integers(-12, 13, (9, 2))
    imager = Imager(MicrolensArray(centers, substrate_thickness=0.0), Sensor((161, 161), 0.02), 5.0, field_radius)
    return imager, Grid([10.0], (23, 23), 0.04)


@pytest.mark.parametrize("zones", [pytest.param("voxels", marks=pytest.mark.integration), "lenses"])
def test_equation_2_as_printed_where_voxels_are_at_the_middle_of_zones(zones):
    imager, grid = zone_scene(0.4)
    if zones == "voxels":
        zone, volume = np.arange(23 * 23).reshape(23, 23), volume_of(grid)
    else:
        zone, volume = zones_of_lenses(grid, np.asarray(imager.centers)), np.zeros((1, 23, 23))
        for i in np.unique(zone):
            r, c = np.nonzero(zone == i)
            volume[0, round(r.mean()), round(c.mean())] = 1
    expected = equation_2(volume, imager, grid, psfs(1), zone)
    np.testing.assert_allclose(forward(volume, imager, grid, psfs(1)), expected, atol=1e-12 * float(expected.max()))


def test_equation_2_as_printed_departs_by_the_envelope_across_a_zone():
    departure = []
    for field_radius in (0.4, 4.0):
        imager, grid = zone_scene(field_radius)
        volume, kernels = volume_of(grid), psfs(1)
        zone = zones_of_lenses(grid, np.asarray(imager.centers))
        ours = np.asarray(forward(volume, imager, grid, kernels))
        departure.append(np.abs(equation_2(volume, imager, grid, kernels, zone) - ours).sum() / ours.sum())
    # With a field as small as here the zones decide which lens sees a voxel; a wide one is all but flat across them.
    assert departure[0] > 0.05
    assert departure[1] < 0.01


# The image of points.


def spots_one_by_one(points, imager, depths, fine):
    """`forward_points` as it is told, without stamps: on pixels a fifth as large, which are then summed."""
    size, imager = fine.shape[-1], to_numpy(imager)
    rows, columns = (n * STEPS for n in imager.sensor.shape)
    image = np.zeros((rows + 2 * size, columns + 2 * size))
    pixels = imager.sensor.to_pixels(imager.project(points[:, :3]))
    distance2 = ((imager.centers[:, None] - points[None, :, :2]) ** 2).sum(-1)
    weights = points[:, 3] * envelope(distance2, imager.reduced_depth(points[:, 2])[None], imager.field_radius)
    planes = np.interp(points[:, 2], depths, np.arange(len(depths)))
    for lens, number in zip(*np.nonzero(weights), strict=True):
        near = min(int(planes[number]), len(depths) - 2)
        part = planes[number] - near
        row, column = np.floor(pixels[lens, number] * STEPS + 0.5).astype(int) + STEPS // 2 - size // 2 + size
        if 0 <= row <= rows + size and 0 <= column <= columns + size:
            spot = (1 - part) * fine[near] + part * fine[near + 1]
            image[row : row + size, column : column + size] += weights[lens, number] * spot
    inner = image[size:-size, size:-size].reshape(rows // STEPS, STEPS, columns // STEPS, STEPS)
    return inner.sum((1, 3))


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_many_points_are_spots_one_by_one(dtype):
    """More points, spots and pixels than are taken at a time; some beside the sensor, before and behind the depths."""
    rng = np.random.default_rng(5)
    imager, _ = scene(dtype, shape=(530, 40))
    points = rng.uniform([-1, -1.5, 17, 0.5], [1, 1.5, 24, 2.0], (2500, 4))
    points[0, :2] = to_numpy(imager).centers[0]
    depths, fine = np.array([18.0, 19.0, 22.0]), np.zeros((3, 5 * STEPS, 5 * STEPS))
    fine[:, 2:-2, 2:-2] = rng.uniform(0, 1, (3, 21, 21))  # a margin for what moves
    image = forward_points(points.astype(dtype), imager, make_stamps(depths, fine.astype(dtype)))
    assert image.dtype == dtype
    expected = spots_one_by_one(points.astype(dtype), imager, depths, fine)
    if dtype == jnp.float64:
        np.testing.assert_allclose(image, expected, atol=1e-12 * float(expected.max()))
    else:  # where a chief ray lands half-way between two fifths, rounding decides
        np.testing.assert_allclose(image.sum(), expected.sum(), rtol=1e-5)
        assert np.abs(image - expected).sum() < 2e-3 * expected.sum()


@pytest.mark.integration
def test_many_points_take_little_memory():
    """200 lenses by 50 000 points are 160 MB; 3 of 4 points are seen by no lens, the others by one."""
    centers = np.stack(np.meshgrid(np.arange(20.0), np.arange(10.0)), -1).reshape(-1, 2)
    imager = Imager(MicrolensArray(centers), Sensor((64, 64), 0.3), 5.8, 0.25)
    points = np.random.default_rng(6).uniform([0, 0, 20, 1], [20, 10, 22, 2], (50_000, 4))
    kernels = make_stamps(np.array([20.0, 22.0]), np.ones((2, 15, 15)))
    forward_points(points[:10], imager, kernels)
    memory, image = peak_mib(lambda: forward_points(points, imager, kernels))
    assert image.any() and not memory > 100  # NaN where it is not known


def test_no_points_give_a_dark_image():
    imager, _ = scene()
    image = forward_points(np.zeros((0, 4)), imager, make_stamps(np.array([20.0]), np.ones((1, 15, 15))))
    assert image.shape == imager.sensor.shape and not image.any()


@pytest.mark.parametrize(
    ("depths", "size", "words"),
    [([20.0], 10, "`fine` must be"), ([20.0], 14, "`fine` must be"), ([20.0, 19.0], 15, "`depths` must ascend")],
)
def test_wrong_stamps_are_refused(depths, size, words):
    with pytest.raises(ValueError, match=words):
        make_stamps(np.array(depths), np.ones((len(depths), size, size)))
