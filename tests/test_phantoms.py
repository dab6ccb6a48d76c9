import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import KDTree

from experiments.phantoms import beads, snowflake
from gs_jax import Grid
from gs_jax.simulation import letters, random_points, rasterize

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
