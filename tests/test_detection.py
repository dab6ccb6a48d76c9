"""The paper's particle clustering, by hand and by a literal loop."""

import inspect
import sys
from importlib.util import find_spec

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tifffile
from skimage.measure import label

from gs_jax import Grid
from gs_jax.apps.benchmark import render_points
from gs_jax.base.errors import InputError
from gs_jax.codesign.study import Row, TermTable
from gs_jax.codesign.terms import Objective, Term, evaluate
from gs_jax.detection.particles import MEMORY, find_clusters, link_particles, tracks_table
from gs_jax.io.point_tables import read_points

from .test_recording import bead_frames, command


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


# Particles that are known: the same one in every frame, also after it was not seen.


needs_trackpy = pytest.mark.skipif(not find_spec("trackpy"), reason="needs pip install 'gs-jax[track]'")


def walks(frames=60, particles=30):
    """Drifting particles with jitter, in another order in each frame, each now and then not seen; their numbers."""
    rng = np.random.default_rng(0)
    # A grid of 0.5 mm: they stay apart.
    at = 0.5 * np.array([(i % 6, i // 6, 40.0) for i in range(particles)]) + rng.uniform(-0.05, 0.05, (particles, 3))
    drift = rng.normal(0, 0.003, (particles, 3))
    unseen = np.zeros(particles, int)
    for _ in range(frames):
        at = at + drift + rng.normal(0, 0.005, at.shape)
        gone = (rng.random(particles) < 0.1) & (unseen < MEMORY)
        unseen = np.where(gone, unseen + 1, 0)
        shown = rng.permutation(np.flatnonzero(~gone))
        yield at[shown], shown


@needs_trackpy
def test_particles_are_those_that_moved():
    places, numbers = zip(*walks(), strict=True)
    assert any(len(shown) < 30 for shown in numbers)
    found = list(link_particles(iter(places), 0.1))
    # One name for each, and each name for one.
    pairs = {pair for pair in zip(np.concatenate(found), np.concatenate(numbers), strict=True)}
    assert len(pairs) == 30 == len({name for name, _ in pairs}) == len({number for _, number in pairs})


@needs_trackpy
def test_who_is_gone_for_long_is_somebody_else():
    here, nobody = np.array([[0.0, 0, 20]]), np.zeros((0, 3))
    for gone, same in ((MEMORY, True), (MEMORY + 1, False)):
        first, *_, last = link_particles([here, *[nobody] * gone, here], 0.1)
        assert (first == last) is same
    assert list(link_particles([nobody, nobody], 0.1)) == [[], []] and list(link_particles([], 0.1)) == []


@needs_trackpy
def test_along_z_particles_may_be_lost_less_easily():
    """Points whose depths are eight times less certain, 0.5 mm apart: a ball that holds the error holds others, too."""
    rng, still = np.random.default_rng(0), np.array([[0.5 * (i % 4), 0.5 * (i // 4), 20.0] for i in range(16)])
    frames = [still + rng.normal(0, (0.02, 0.02, 0.16), still.shape) for _ in range(30)]
    assert len(set(np.concatenate(list(link_particles(frames, 0.2))))) > 16
    assert all(list(row) == list(range(16)) for row in link_particles(frames, (0.2, 1.2)))
    gone = [still, *[np.zeros((0, 3))] * 4, still]
    assert set(list(link_particles(gone, 0.2, memory=4))[-1]) == set(range(16))
    assert not set(list(link_particles(gone, 0.2, memory=3))[-1]) & set(range(16))


def test_tracks_are_measured():
    """By hand, of points in any order: one that goes 3, 4 and 0 along x, y and z, then 12 along z, and one alone."""
    frames, particles = np.array([6, 0, 2, 3]), np.array([5, 5, 7, 5])
    positions = np.array([[3.0, 4, 32], [0, 0, 20], [1, 1, 20], [3, 4, 20]])
    table = tracks_table(frames, particles, positions, 0.5)
    expected = {"particle": [5, 7], "points": [3, 1], "first_frame": [0, 2], "last_frame": [6, 2]}
    expected |= {"duration_s": [3, 0], "path_mm": [17, 0], "speed_mm_s": [17 / 3, np.nan], "lateral_path_mm": [5, 0]}
    expected |= {"lateral_speed_mm_s": [5 / 3, np.nan], "displacement_mm": [13, 0]}
    assert list(table) == list(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(table[name], values, err_msg=name)
    assert tracks_table(frames, particles, positions)["speed_mm_frame"][0] == pytest.approx(17 / 6)
    nobody = tracks_table(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)))
    assert all(len(column) == 0 for column in nobody.values())


@needs_trackpy
def test_crowds_are_refused():
    crowd = np.random.default_rng(0).uniform(0, 0.1, (200, 3))
    with pytest.raises(InputError, match="--track: too many particles are within 1000 um"):
        list(link_particles([crowd, crowd], 1.0))


@needs_trackpy
def test_beads_of_a_recording(folder, run):
    """Two that move, of which one is dark in a frame, and frames of which one cannot be read."""
    (folder / "frames").mkdir()
    for frame, image in enumerate(bead_frames([(-0.3 + 0.05 * t, 0.3)[: 1 if t == 2 else 2] for t in range(5)])):
        tifffile.imwrite(f"frames/{frame}.tif", image[:50] if frame == 3 else image)
    how = ("--suppress", "clusters", "--points", "p.csv", "--track", "120,400", "--depths", "20")
    status, out, err = run(*command("frames", *how))
    assert status == 1 and "p.csv: 7 points of 2 particles" in out, (out, err)
    header, *rows = (folder / "p.csv").read_text().splitlines()
    assert header == "x_mm,y_mm,z_mm,intensity,frame,particle"
    found = np.array([row.split(",") for row in rows], float)
    moving, still = (found[found[:, 5] == particle] for particle in found[np.argsort(found[:2, 0]), 5])
    assert moving[:, 4].tolist() == [0, 1, 2, 4] and still[:, 4].tolist() == [0, 1, 4]
    assert np.ptp(moving[:, 0]) == pytest.approx(0.2, abs=0.06) and np.ptp(still[:, 0]) < 0.06
    assert read_points(folder / "p.csv").shape == (7, 4)
    header, *rows = (folder / "p.csv.tracks.csv").read_text().splitlines()
    assert header.startswith("particle,points,first_frame,last_frame,duration_frames,path_mm,speed_mm_frame,")
    tracks = np.array([row.split(",") for row in rows], float)
    assert tracks[:, 1].tolist() in ([4, 3], [3, 4]) and tracks[:, 4].tolist() == [4, 4]
    assert (folder / "p.csv.tracks.png").read_bytes()[:4] == b"\x89PNG"
    # A table that a person may have changed is not replaced.
    (folder / "p.csv").unlink()
    status, _, err = run(*command("frames", *how, "--resume"))
    assert status == 2 and "p.csv.tracks.csv: the output must be a new file" in err


def test_what_cannot_be_tracked_is_one_line(folder, run, monkeypatch):
    tifffile.imwrite("rec.tif", np.full((2, 96, 80), 16, np.uint16), photometric="minisblack")
    status, _, err = run(*command("rec.tif", "--track", "100"))
    assert status == 2 and "--track must be used with --points POINTS.csv, which has the particles." in err
    status, _, err = run(*command("capture.tif", "--track", "100", "--points", "p.csv"))
    assert status == 2 and "--track must be used with a recording" in err
    for words, message in (
        (("--track", "100,200,300"), "must be XY or XY,Z in um, got '100,200,300'."),
        (("--track", "100,far"), "got 'far'"),
        (("--track-memory", "3"), "--track-memory must be used with --track."),
    ):
        status, _, err = run(*command("rec.tif", *words, "--points", "p.csv"))
        assert status == 2 and message in err and err.count("\n") == 1
    monkeypatch.setitem(sys.modules, "trackpy", None)
    status, _, err = run(*command("rec.tif", "--track", "100", "--points", "p.csv"))
    assert (status, err) == (2, "gs-jax: trackpy is not installed; it comes with pip install 'gs-jax[track]'.\n")
    assert not (folder / "v.zarr").exists()


# Terms compared with their targets: residuals for solvers, rows for people.


KEY = jax.random.key(0)
# What stands for an imager here is an array, which the checked signatures would refuse.
RESIDUAL, EVALUATE = inspect.unwrap(Objective.residual), inspect.unwrap(evaluate)
ITSELF = Term("itself", lambda x, at: x)
EXPONENTIAL = Term("its exponential", lambda x, at: jnp.log(x), log=True)
X = np.array([1.0, 2.0, 4.0])


@eqx.filter_jit
def judged(objective, x, margin):
    """Residuals and their derivatives: a program for each kind of target."""
    residual = lambda x: RESIDUAL(objective, x, None, KEY, margin=margin)
    return residual(x), jax.jacrev(residual)(x)


def residuals(kind, x, margin=0.0, *, term=ITSELF, weight=1.0):
    return np.asarray(judged(Objective(term, kind, 2.0, weight), x, np.array(margin))[0])


@pytest.mark.parametrize(
    ("kind", "margin", "expected"),
    [
        ("at_most", 0.0, [0, 0, np.log(2)]),
        ("at_most", 0.1, [0, np.log(1.1), np.log(2.1)]),
        ("at_least", 0.0, [0.5, 0, 0]),
        ("at_least", 0.1, [0.6, 0.1, 0]),
        ("equal", 0.1, [-0.5, 0, 1]),
    ],
)
def test_residuals(kind, margin, expected):
    """By hand; three entries share the weight."""
    np.testing.assert_allclose(residuals(kind, X, margin, weight=3.0), 3 * np.array(expected) / np.sqrt(3), atol=1e-12)


@pytest.mark.parametrize(("kind", "sign"), [("minimise", 1), ("maximise", -1)])
def test_goals_count_their_worst(kind, sign):
    """Also those of a logarithm, far below its size, where it is negative: less stays better."""
    power = np.mean((X / 2) ** (8 * sign)) ** (1 / 8)
    np.testing.assert_allclose(residuals(kind, X), [power], rtol=1e-12)
    small = residuals(kind, 1e-3 * X, term=EXPONENTIAL)
    np.testing.assert_allclose(small, [power * 1e-3**sign], rtol=1e-12)


def test_logarithms():
    found = residuals("at_least", X, 0.1, term=EXPONENTIAL)
    np.testing.assert_allclose(found * np.sqrt(3), np.maximum(0.1 - np.log(X / 2), 0), atol=1e-12)


@pytest.mark.parametrize("kind", ["at_most", "at_least", "equal", "minimise", "maximise"])
def test_gradients(kind):
    """Of finite differences, and finite at zero."""
    numeric = [(residuals(kind, X + step, 0.1) - residuals(kind, X - step, 0.1)) / 2e-6 for step in 1e-6 * np.eye(3)]
    slopes = judged(Objective(ITSELF, kind, 2.0, 1.0), X, np.array(0.1))[1]
    np.testing.assert_allclose(slopes, np.transpose(numeric), rtol=1e-6, atol=1e-8)
    assert np.isfinite(judged(Objective(ITSELF, kind, 2.0, 1.0), np.zeros(3), np.array(0.0))[1]).all()


def test_an_infinite_depth_of_field_is_enough():
    value, slope = judged(Objective(ITSELF, "at_least", 2.0, 1.0), np.full(3, np.inf), np.array(0.0))
    assert not np.any(value) and not np.any(slope)


@pytest.mark.parametrize(
    ("kind", "met", "worst"),
    [("at_most", False, 4.0), ("at_least", False, 1.0), ("equal", False, 4.0), ("minimise", None, 4.0)],
)
def test_assessment(kind, met, worst):
    table = TermTable.model_validate({"name": "occupancy", kind: 2.0})
    assert table.assess(X) == Row(1.0, 4.0, met) and table.worst(X) == worst
    if met is not None:
        assert table.assess([2.0]).met


def test_random_terms_take_the_key():
    noise = Term("noise", lambda x, at, key: x + jax.random.normal(key), random=True)
    draw = jax.jit(lambda key: EVALUATE(noise, X, None, key))
    assert (draw(KEY) == draw(KEY)).all() and (draw(KEY) != draw(jax.random.key(1))).all()


def test_whole_numbers_have_no_slope():
    with pytest.raises(InputError, match=r"a term \(itself\) must be of floating point, got int"):
        EVALUATE(ITSELF, jnp.arange(3), None, KEY)
