import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import ConvexHull, KDTree

from gs_jax import Grid
from gs_jax.simulation.phantoms import beads, letters, random_points, rasterize, snowflake, usaf_1951, usaf_bars

from .helpers import needs

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


@pytest.mark.parametrize(("pitch", "tolerance"), [(0.01, 0.05), (0.005, 0.01)])
def test_beads_are_balls(pitch, tolerance):
    scene = beads(5, (2, 1), (18, 20.5), diameter=0.1, pitch=pitch)
    np.testing.assert_allclose(scene[:, 3].sum(), 5 * math.pi / 6 * 0.1**3, rtol=1e-12)
    for ball in scene.reshape(5, -1, 4)[:, :, :3]:
        middle = ball.mean(axis=0)
        distance2 = ((ball - middle) ** 2).sum(axis=1)
        assert distance2.max() <= 0.05**2 * (1 + 1e-9)
        # A full ball has a mean squared distance of 3/5 R^2; a ball of 10 or 20 cells across has a rough edge.
        np.testing.assert_allclose(distance2.mean(), 0.6 * 0.05**2, rtol=tolerance)


def test_beads_of_the_paper_lie_in_the_slab():
    scene = beads(2000, (23, 23), (18, 20.5), pitch=0.0025)
    assert len(scene) == 2000 * 8
    assert np.abs(scene[:, :2]).max() <= 11.5 and scene[:, 2].min() >= 18 and scene[:, 2].max() <= 20.5
    assert np.ptp(scene[:, 2]) > 2.49


def test_a_bead_smaller_than_the_pitch_is_one_emitter():
    assert beads(3, (1, 1), (18, 19), diameter=0.005, pitch=0.01).shape == (3, 4)


def test_usaf_widths_are_the_standards():
    bars = usaf_bars((2, 3)).reshape(2, 6, 6, 2, 2)  # group, element, bar, axis, ends
    # The published table, line pairs per mm, rounded to three digits.
    table = [4.00, 4.49, 5.04, 5.66, 6.35, 7.13, 8.00, 8.98, 10.1, 11.3, 12.7, 14.3]
    size = np.ptp(bars, axis=-1)
    width, length = size[:, :, :3, 0], size[:, :, :3, 1]
    np.testing.assert_allclose(1 / (2 * width), np.repeat(table, 3).reshape(2, 6, 3), rtol=5e-3)
    np.testing.assert_allclose(length, 5 * width, rtol=1e-12)
    np.testing.assert_allclose(size[:, :, 3:], size[:, :, :3, ::-1], rtol=1e-12)  # horizontal: x and y swapped
    for axis, set_of_three in ((0, slice(0, 3)), (1, slice(3, 6))):
        starts = bars[:, :, set_of_three, axis, 0]
        np.testing.assert_allclose(np.diff(starts), 2 * width[..., :2], rtol=1e-9)


def test_usaf_bars_do_not_touch_and_are_centred():
    bars = usaf_bars((0, 1, 2, 3))
    np.testing.assert_allclose(bars[:, 0::2].min(axis=0), -bars[:, 1::2].max(axis=0), rtol=1e-12)
    for i, (left, right, top, bottom) in enumerate(bars):
        others = np.delete(bars, i, axis=0)
        apart = (others[:, 0] > right) | (others[:, 1] < left) | (others[:, 2] > bottom) | (others[:, 3] < top)
        assert apart.all()


def test_usaf_agrees_with_the_ray_traced_target():
    truth = json.loads(needs("oracle/dev/f.json").read_text())["elements"]
    bars = usaf_bars((2, 3)).reshape(12, 6, 4)
    for element, ours in zip(truth, bars, strict=True):
        theirs = np.array(element["vertical_bars"] + element["horizontal_bars"])
        np.testing.assert_allclose(np.ptp(ours.reshape(6, 2, 2), axis=2), np.ptp(theirs.reshape(6, 2, 2), axis=2))
        np.testing.assert_allclose(ours[0, 1] - ours[0, 0], element["width_mm"])
    emitters = np.load(needs("oracle/dev/f_emitters.npz"))["emitters"]
    # Theirs come from tiles of another size, whose lit areas are rounded to 2^-14 or so.
    np.testing.assert_allclose(usaf_1951(depth=18, pitch=0.01)[:, 3].sum(), emitters[:, 3].sum(), rtol=1e-4)


@pytest.mark.parametrize("pitch", [0.5, 0.02, 0.007])
def test_usaf_emitters_fill_their_bars(pitch):
    bars, emitters = usaf_bars((2,)), usaf_1951((2,), depth=18, pitch=pitch)
    area = (bars[:, 1] - bars[:, 0]) * (bars[:, 3] - bars[:, 2])
    np.testing.assert_allclose(emitters[:, 3].sum(), area.sum(), rtol=1e-12)
    assert (emitters[:, 2] == 18).all()
    x, y = emitters[:, :2].T
    for (left, right, top, bottom), one in zip(bars, area, strict=True):
        inside = (x > left) & (x < right) & (y > top) & (y < bottom)
        np.testing.assert_allclose(emitters[inside, 3].sum(), one, rtol=1e-12)
        np.testing.assert_allclose(emitters[inside, 3] @ emitters[inside, 0] / one, (left + right) / 2, rtol=1e-9)
    if len(emitters) > len(bars):
        assert KDTree(emitters[:, :2]).query(emitters[:, :2], k=2)[0][:, 1].max() <= pitch


def test_usaf_bars_are_first_vertical_then_horizontal_in_an_image():
    """Groups from left to right; within the first element three columns, then three rows, at the top left."""
    image = np.asarray(rasterize(usaf_1951(depth=18, pitch=0.005), grid([18.0], (420, 300), 0.01)))[0] > 0.5e-4
    (x0, _, y0, y1), *_, (x2, x3, *_) = usaf_bars()[:3]
    row, columns = round((y0 + y1) / 0.02 + 209.5), [round(x / 0.01 + 149.5) for x in (x0 - 0.05, x3 + 0.05)]
    profile = image[row, columns[0] : columns[1]]
    assert np.count_nonzero(np.diff(profile.astype(int)) == 1) == 3
    assert image[:210, :150].any() and row < 210 and columns[1] < 150


def test_snowflake_is_six_fold():
    flat = snowflake((20, 20), 12.0, width=0.5, pitch=0.03)
    tree = KDTree(flat[:, :2])
    x, y = flat[:, :2].T
    for angle in math.pi / 3 * np.arange(1, 6):
        turned = np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y], axis=1)
        assert tree.query(turned)[0].max() < 1e-12
    assert tree.query(np.stack([x, -y], axis=1))[0].max() < 1e-12  # and a mirror
    angle = math.pi / 6
    turned = np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y], axis=1)
    assert tree.query(turned)[0].max() > 1  # not twelve-fold


def test_snowflake_has_its_size_and_width():
    flat = snowflake((20, 20), 12.0, width=0.5, pitch=0.01)
    x, y = flat[:, :2].T
    np.testing.assert_allclose(np.hypot(x, y).max(), 6, atol=0.01)  # a pitch
    arm = np.abs(y[(x > 1.4) & (x < 2.0)])  # before the first branch, between the arms
    np.testing.assert_allclose(2 * arm[arm < 0.6].max(), 0.5, atol=0.01)


@pytest.mark.parametrize("tilt", [0.0, 0.3, math.pi / 6, -2.0])
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
    tips = np.linalg.norm(scene[:, :3] - middle, axis=1)
    np.testing.assert_allclose(tips.max(), 10, atol=pitch)
    assert ConvexHull(scene[:, :2]).volume < ConvexHull(snowflake((20, 20), pitch=pitch)[:, :2]).volume


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


@pytest.mark.parametrize("pitch", [0.013, 0.05, 0.3])
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
        (lambda: beads(5, (1, 1), (18, 18.1), diameter=0.2, pitch=0.1), "`diameter` must be at most 0.1 mm"),
        (lambda: beads(5, (1, 1), (18, 19), pitch=0), "`pitch` must be positive"),
        (lambda: usaf_bars(()), "`groups` must be one group or more"),
        (lambda: usaf_1951(depth=18, pitch=math.nan), "`pitch` must be positive"),
        (lambda: snowflake((10, 31), 20, pitch=0.1), "`depth_range` must span at most 20 mm for that size, got 21"),
        (lambda: snowflake(size=9, pitch=0.1), "`size` must be at least 14 widths, 9.8 mm, got 9"),
        (lambda: letters(" \n", depth=20, height=3, pitch=0.1), "`text` must have a visible character, got ' "),
        (lambda: letters("A", depth=20, height=-3, pitch=1), "`height` must be positive"),
        (lambda: rasterize(scattered(), grid([18.0, 18.0])), r"`grid.depths` must ascend, got \[18.0, 18.0\]"),
        (lambda: rasterize(np.array([[0, 0, np.nan, 1]]), grid()), r"`emitters` must be finite, got \[0.0, 0.0, nan"),
    ],
)
def test_wrong_arguments_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
