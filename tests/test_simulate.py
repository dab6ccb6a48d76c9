import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import KDTree

from experiments.phantoms import beads, snowflake
from gs_jax import Grid, Imager, MicrolensArray, Sensor
from gs_jax.base.errors import InputError
from gs_jax.base.progress import Progress
from gs_jax.optics.psf import PSFS, psf_of_depth
from gs_jax.optics.pupil import pupil_quadrature
from gs_jax.optics.raytrace import trace_lenslet
from gs_jax.simulation import letters, random_points, rasterize, simulate, simulate_points, simulate_volume


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


DEPTHS = (18.0, 18.4, 20.0, 23.0)  # uneven


def scattered(count=300, *, half=(0.3, 0.4), seed=0):
    """Emitters within the hull of the voxel centres of `grid()`."""
    rng = np.random.default_rng(seed)
    low, high = [-half[0], -half[1], DEPTHS[0], 0.5], [half[0], half[1], DEPTHS[-1], 2]
    return rng.uniform(low, high, (count, 4))


def grid(depths=DEPTHS, shape=(9, 7), pitch=0.1, dtype=float):
    return jax.tree.map(lambda leaf: jax.device_put(np.array(leaf, dtype)), Grid(depths, shape, pitch))


# --- rasterize ---


def test_rasterize_is_the_transpose_of_scipys_interpolation():
    """<volume of the emitters, f> is the sum of f, interpolated at them, for any f."""
    emitters, voxels = scattered(), grid()
    f = np.random.default_rng(1).normal(size=(4, 9, 7))
    read = RegularGridInterpolator((np.array(DEPTHS), np.asarray(voxels.y), np.asarray(voxels.x)), f)
    expected = emitters[:, 3] @ read(emitters[:, [2, 1, 0]])
    np.testing.assert_allclose(np.vdot(rasterize(emitters, voxels), f), expected, rtol=1e-12)  # an identity


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-12), (np.float32, 1e-5)])
def test_rasterize_keeps_the_total_and_the_centroid(dtype, tolerance):
    emitters, voxels = scattered(), grid(dtype=dtype)
    volume = np.asarray(rasterize(emitters, voxels))
    assert volume.dtype == dtype
    total = emitters[:, 3].sum()
    np.testing.assert_allclose(volume.sum(), total, rtol=tolerance)
    weight = lambda axis: volume.sum(axis=tuple({0, 1, 2} - {axis}))
    centroid = [np.vdot(weight(axis), at) / total for axis, at in ((2, voxels.x), (1, voxels.y), (0, voxels.depths))]
    np.testing.assert_allclose(centroid, emitters[:, 3] @ emitters[:, :3] / total, rtol=tolerance, atol=tolerance)


def test_rasterize_puts_x_in_columns_y_in_rows_and_z_in_depths():
    """An emitter a quarter of the way to the next voxel, along one axis at a time."""
    voxels = grid()
    for axis, (step, neighbour) in enumerate([(0.1, (1, 4, 4)), (0.1, (1, 5, 3)), (1.6, (2, 4, 3))]):
        emitter = np.array([[0.0, 0.0, 18.4, 2.0]])
        emitter[0, axis] += step / 4
        expected = np.zeros((4, 9, 7))
        expected[1, 4, 3], expected[neighbour] = 1.5, 0.5
        np.testing.assert_allclose(rasterize(emitter, voxels), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("emitter", "voxel"),
    [
        ((0.349, 0.0, 18.0, 1), (0, 4, 6)),  # the outer half of the last column: x = 0.3 to 0.35
        ((0.351, 0.0, 18.0, 1), None),
        ((0.0, -0.449, 18.0, 1), (0, 0, 3)),
        ((0.0, -0.451, 18.0, 1), None),
        ((0.0, 0.0, 17.801, 1), (0, 4, 3)),  # half of the first step, 0.4 mm
        ((0.0, 0.0, 17.799, 1), None),
        ((0.0, 0.0, 24.499, 1), (3, 4, 3)),  # half of the last step, 3 mm
        ((0.0, 0.0, 24.501, 1), None),
        ((50.0, -50.0, 1.0, 1), None),
    ],
)
def test_what_lies_beyond_the_grids_edge_is_left_out(emitter, voxel):
    expected = np.zeros((4, 9, 7))
    if voxel is not None:
        expected[voxel] = 1
    np.testing.assert_allclose(rasterize(np.array([emitter], float), grid()), expected, atol=1e-12)


def test_a_single_depth_and_a_single_voxel():
    emitters = np.array([[0.01, 0.0, 20.04, 1], [0.0, 0.0, 20.06, 1], [0.06, 0.0, 20.0, 1]])  # in, too deep, beside
    np.testing.assert_array_equal(rasterize(emitters, grid([20.0], (1, 1))), [[[1.0]]])


@pytest.mark.integration
def test_gradients_of_rasterize():
    voxels, emitters = grid(), scattered(20)
    weights = jnp.asarray(np.random.default_rng(2).normal(size=(4, 9, 7)))
    moment = lambda emitters, depths: jnp.vdot(weights, rasterize(emitters, Grid(depths, voxels.shape, voxels.pitch)))
    # Linear between the kinks at voxel centres along each axis: at this generic point central differences are exact
    # in the emitters, and rounding (1e-16 / 1e-6) is what is left; in the depths they are off by eps^2.
    check_grads(moment, (jnp.asarray(emitters), voxels.depths), order=1, eps=1e-6, atol=1e-7, rtol=1e-7)


def test_gradients_are_finite_at_kinks_edges_and_outside():
    emitters = np.array([[0, 0, 18, 1], [0.3, -0.4, 23, 1], [0.35, 0, 17.8, 0], [9, 9, 40, 1]], float)
    square = lambda emitters, depths: (rasterize(emitters, Grid(depths, (9, 7), 0.1)) ** 2).sum()
    for gradient in jax.jit(jax.grad(square, (0, 1)))(emitters, grid().depths):
        assert np.isfinite(gradient).all()


def test_rasterize_under_jit_and_of_nothing():
    emitters, voxels = scattered(), grid()
    np.testing.assert_allclose(jax.jit(rasterize)(emitters, voxels), rasterize(emitters, voxels), rtol=1e-12)
    assert not rasterize(np.zeros((0, 4)), voxels).any()


# --- scenes ---


def test_random_points_are_uniform_in_their_box():
    points = random_points(4000, (20, 10), (18, 22), seed=3)
    assert points.shape == (4000, 4) and points.dtype == np.float64 and (points[:, 3] == 1).all()
    low, high = np.array([-10, -5, 18]), np.array([10, 5, 22])
    # Kolmogorov-Smirnov at a level of 1e-6: 2.6 / sqrt(n).
    for values, a, b in zip(points.T[:3], low, high, strict=True):
        cumulated = (np.sort(values) - a) / (b - a)
        assert np.abs(cumulated - np.arange(4000) / 4000).max() < 2.6 / math.sqrt(4000)
    np.testing.assert_array_equal(points, random_points(4000, (20, 10), (18, 22), seed=3))
    assert (points != random_points(4000, (20, 10), (18, 22), seed=4))[:, :3].all()


def test_beads_are_balls_in_their_slab():
    scene = beads(40, (2, 1), (18, 18.5), diameter=0.1, pitch=0.005)
    np.testing.assert_allclose(scene[:, 3].sum(), 40 * math.pi / 6 * 0.1**3, rtol=1e-12)
    assert (np.abs(scene[:, :3] - (0, 0, 18.25)) <= (1, 0.5, 0.25)).all() and np.ptp(scene[:, 2]) > 0.45
    for ball in scene.reshape(40, -1, 4)[:, :, :3]:
        distance2 = ((ball - ball.mean(axis=0)) ** 2).sum(axis=1)
        assert distance2.max() <= 0.05**2 * (1 + 1e-9)
        # A full ball has a mean squared distance of 3/5 R^2; a ball of 20 cells across has a rough edge.
        np.testing.assert_allclose(distance2.mean(), 0.6 * 0.05**2, rtol=0.01)
    assert beads(3, (1, 1), (18, 19), diameter=0.005, pitch=0.01).shape == (3, 4)


def test_snowflake_is_six_fold_and_has_its_size_and_width():
    flat = snowflake((20, 20), 12.0, width=0.5, pitch=0.02)
    at = flat[:, 0] + 1j * flat[:, 1]
    tree = KDTree(flat[:, :2])
    distance = lambda points: tree.query(np.stack([points.real, points.imag], axis=1))[0].max()
    turned = [distance(at * np.exp(1j * np.pi / 6 * turns)) for turns in range(12)]
    assert max(turned[::2]) < 1e-12 and turned[1] > 1 and distance(at.conj()) < 1e-12
    np.testing.assert_allclose(np.abs(at).max(), 6, atol=0.02)  # a pitch
    arm = np.abs(at.imag[(at.real > 1.4) & (at.real < 2.0)])  # before the first branch, between the arms
    np.testing.assert_allclose(2 * arm[arm < 0.6].max(), 0.5, atol=0.02)


@pytest.mark.parametrize("tilt", [0.3, -2.0])
def test_snowflake_spans_its_depths_and_stays_flat(tilt):
    """As in Fig. 8: 20 to 25 mm."""
    pitch = 0.05
    scene = snowflake(tilt=tilt, pitch=pitch)
    z = scene[:, 2]
    np.testing.assert_allclose([z.min(), z.max()], [20, 25], atol=pitch / 2)
    middle = scene[:, :3].mean(axis=0)
    np.testing.assert_allclose(middle, [0, 0, 22.5], atol=1e-9)
    values, vectors = np.linalg.eigh(np.cov((scene[:, :3] - middle).T))
    assert values[0] < 1e-9
    slope = -vectors[:2, 0] / vectors[2, 0]  # steepest toward the tilt
    np.testing.assert_allclose(slope / np.hypot(*slope), [math.cos(tilt), math.sin(tilt)], atol=1e-7)
    # Inclined, not sheared: six tips at 10 mm from the middle, less a pitch.
    np.testing.assert_allclose(np.linalg.norm(scene[:, :3] - middle, axis=1).max(), 10, atol=pitch)


@pytest.mark.parametrize("make", [lambda p: snowflake(pitch=p), lambda p: letters("GEO", depth=20, height=3, pitch=p)])
def test_brightness_does_not_depend_on_the_pitch(make):
    # Squares on the outline count by what is covered; where it bends, to second order in the pitch.
    np.testing.assert_allclose(make(0.05)[:, 3].sum(), make(0.02)[:, 3].sum(), rtol=3e-4)


def test_letters_read_correctly_with_row_0_at_the_top():
    image = np.asarray(rasterize(letters("L", depth=20, height=3, pitch=0.03), grid([20.0], (41, 41), 0.1)))[0]
    rows, columns = np.nonzero(image > 0.5 * image.max())
    assert rows.max() - rows.min() > columns.max() - columns.min()  # higher than wide
    stem, foot = image[:, columns.min()] > 0, image[rows.max()] > 0
    assert stem.sum() >= 29 and foot.sum() >= 12
    assert not image[: rows.max() - 5, columns.min() + 6 :].any()  # nothing at the upper right

    image = np.asarray(rasterize(letters("iI", depth=20, height=3, pitch=0.03), grid([20.0], (41, 41), 0.1)))[0]
    left, right = ((half > 0).any(axis=1) for half in np.hsplit(image[:, :40], 2))
    parts = lambda rows: np.count_nonzero(np.diff(rows.astype(int)) == 1)
    assert parts(left) == 2 and parts(right) == 1  # i, with its dot, to the left


@pytest.mark.parametrize("pitch", [0.05, 0.3])
def test_letters_have_the_height_and_the_middle_wanted(pitch):
    scene = letters("H", depth=20, height=3, pitch=pitch)
    x, y, z, area = scene.T
    full = 3 / math.ceil(3 / pitch)
    # The stem of the H has whole squares from top to bottom; letters are drawn 600 or more pixels high.
    _, column = np.unique(x.round(9), return_inverse=True)
    np.testing.assert_allclose(np.bincount(column, area).max() / full, 3, rtol=1 / 300)
    steps = np.diff(np.unique(y.round(9)))
    assert np.allclose(steps, full, rtol=1e-6)
    np.testing.assert_allclose([area @ x, area @ y], 0, atol=area.sum() * 3 / 300)
    assert (z == 20).all() and area.min() > 0 and area.max() <= full**2 * (1 + 1e-9)
    assert full <= pitch


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: random_points(0, (1, 1), (18, 20)), "`count` must be 1 or more, got 0"),
        (lambda: random_points(5, (1, -1), (18, 20)), "`size` must be two positive lengths"),
        (lambda: random_points(5, (1, 1), (20, 18)), r"`depth_range` must be \(near, far\).*got \(20, 18\)"),
        (lambda: random_points(5, (1, 1), (18, math.nan)), "`depth_range`"),
        (lambda: letters(" \n", depth=20, height=3, pitch=0.1), "`text` must have a visible character, got ' "),
        (lambda: letters("A", depth=20, height=-3, pitch=1), "`height` must be positive"),
        (lambda: rasterize(scattered(), grid([18.0, 18.0])), r"`grid.depths` must ascend, got \[18.0, 18.0\]"),
        (lambda: rasterize(np.array([[0, 0, np.nan, 1]]), grid()), r"`emitters` must be finite, got \[0.0, 0.0, nan"),
    ],
)
def test_wrong_arguments_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
