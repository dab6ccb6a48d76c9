import itertools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.distance import cdist

from gs_jax.microscope.layouts import (
    coverage,
    hexagonal_layout,
    lloyd_relax,
    max_gap,
    nearest_neighbour_distances,
    poisson_disc_layout,
    random_layout,
    square_layout,
)

from .helpers import needs

PLATE = (20.0, 20.0)
sizes = st.tuples(st.floats(2, 12), st.floats(2, 12))


def grid(size, step):
    """Points of the plate, edges and corners included, at most a step apart; rows of (x, y)."""
    x, y = (np.linspace(-length / 2, length / 2, 1 + int(np.ceil(length / step))) for length in size)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def farthest(centers, size, step):
    return max(cdist(part, centers).min(axis=1).max() for part in np.array_split(grid(size, step), 20))


def neighbours(centers):
    distances = cdist(centers, centers)
    np.fill_diagonal(distances, np.inf)
    return distances.min(axis=1)


def bragg_peak(centers):
    """The brightest diffraction peak, away from the direct beam, as a fraction of a perfect lattice's."""
    k = np.linspace(-8, 8, 321)
    x, y = (np.exp(1j * np.outer(k, c)) for c in centers.T)
    power = np.abs(y @ x.T) ** 2 / len(centers) ** 2
    return power[np.hypot(*np.meshgrid(k, k)) > 3].max()


def scattered(count, size, seed):
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 2)) * size


# 185 lenses hardly suffice, and take a second or two.
CASES = [(count, seed) for count in (200, 213, 215) for seed in range(10)] + [(185, seed) for seed in range(3)]
SLOW = [(185, seed) for seed in range(3, 20)]


@pytest.mark.parametrize("count, seed", CASES + [pytest.param(*case, marks=pytest.mark.slow) for case in SLOW])
def test_random_layout_is_the_papers(count, seed):
    """A random layout with the paper's pitch of 1.23 mm, SD 0.09 mm, and a fill factor of 1."""
    centers = random_layout(count, PLATE, pitch=1.23, seed=seed)
    assert centers.shape == (count, 2) and centers.dtype == np.float64
    assert np.abs(centers).max() <= 10
    distances = neighbours(centers)
    assert abs(distances.mean() - 1.23) < 0.02 and abs(distances.std() - 0.09) < 0.02
    assert farthest(centers, PLATE, 0.1) <= 1
    assert max_gap(centers, PLATE) <= 1
    np.testing.assert_allclose(coverage(centers, PLATE, diameter=2.0), 1, rtol=1e-12)


def test_random_layout_has_no_lattice_and_seeds_differ():
    """A lattice's peak is 1. Jitter of a tenth of the pitch leaves 0.7 of it; the authors' layout has 0.11."""
    lattice = square_layout(PLATE, pitch=1.4)
    jittered = lattice + np.random.default_rng(0).normal(scale=0.14, size=lattice.shape)
    assert bragg_peak(lattice) > 0.9 and bragg_peak(jittered) > 0.5
    layouts = [random_layout(200, PLATE, pitch=1.23, seed=seed) for seed in range(5)]
    assert max(map(bragg_peak, layouts)) < 0.15
    for one, other in itertools.combinations(layouts, 2):
        for turned in (other, -other, other[:, ::-1], other * [1, -1], other * [-1, 1]):
            # Independent lenses have a mean distance of half the spacing or so; the same ones, 0.
            assert cdist(one, turned).min(axis=1).mean() > 0.3


@pytest.mark.parametrize(
    "count, size, options",
    [
        (24, (5, 5), {}),
        (24, (5, 5), {"pitch": 1.1}),
        (100, (30, 4), {"pitch": 1, "pitch_sd": 0.05}),
        (200, (20, 20), {"pitch": 1.5}),
        (2, (5.0, 5.0), {"pitch": 3, "diameter": None}),
        (3, [5, 4], {"pitch_sd": 0, "diameter": None}),
        (7, [5, 4], {"diameter": 6}),
        (2000, (20, 20), {}),
    ],
)
def test_random_layout_of_other_plates(count, size, options):
    centers = random_layout(count, size, **options)
    distances = neighbours(centers)
    pitch = options.get("pitch", 1.23 / np.sqrt(400 / 213) * np.sqrt(size[0] * size[1] / count))
    sd = options.get("pitch_sd", 0.09 / 1.23 * pitch if count > 2 else 0)
    np.testing.assert_allclose([distances.mean(), distances.std()], [pitch, sd], atol=0.0101 * pitch)
    diameter = options.get("diameter", 2)
    if diameter is not None:
        assert farthest(centers, size, 0.1) <= diameter / 2


def test_a_single_lens_lies_in_the_middle():
    np.testing.assert_array_equal(random_layout(1, (3, 4), diameter=5), [[0, 0]])
    np.testing.assert_array_equal(nearest_neighbour_distances(np.zeros((1, 2))), [np.inf])


@given(st.integers(1, 40), sizes, st.integers(0, 2**32))
@settings(max_examples=40, deadline=None)
def test_random_layout_is_on_the_plate_and_the_same_again(count, size, seed):
    centers = random_layout(count, size, diameter=None, seed=seed)
    assert centers.shape == (count, 2)
    assert (np.abs(centers) <= np.array(size) / 2).all()
    assert centers.tobytes() == random_layout(count, size, diameter=None, seed=seed).tobytes()


@pytest.mark.parametrize(
    "count, size, options, message",
    [
        (0, PLATE, {}, "`count` must be 1 or more, got 0"),
        (200, (20.0, 0.0), {}, "`size` must be two positive lengths, mm"),
        (200, (20.0, float("nan")), {}, "`size` must be"),
        (200, (20.0,), {}, "`size` must be two"),
        (200, PLATE, {"pitch": 0.0}, "`pitch` must be positive"),
        (200, PLATE, {"pitch": 1.23, "pitch_sd": -0.1}, "`pitch_sd` must be at least 0"),
        (200, PLATE, {"diameter": -1.0}, "`diameter` must be positive"),
        (200, PLATE, {"pitch": 2.0}, "`pitch` must be at most 1.627 mm for 200 lenses on 20 x 20 mm, got 2"),
        (100, PLATE, {}, "`count` must be 154 or more for lenses of 2 mm to cover 20 x 20 mm, got 100"),
        (1, (1.9, 1.0), {"diameter": 2.1}, "`count` must be 2 or more"),
        (1, (1.0, 1.0), {"pitch": 1.0}, "must be None for a single lens"),
        (12, (5.0, 5.0), {}, "the search came to pitch 1.* mm of 1.296, SD .* largest gap 1.* mm of at most 1"),
    ],
)
def test_random_layout_says_what_is_wrong(count, size, options, message):
    with pytest.raises(ValueError, match=message) as error:
        random_layout(count, size, **options)
    assert "\n" not in str(error.value)


def test_hexagonal_limit_is_that_of_a_hexagonal_layout():
    """Its plate ends at lattice points on all sides, so that no layout is denser; the bound is 1.7 % above."""
    size = (10, 4 * np.sqrt(3))
    lattice = hexagonal_layout(size, pitch=1)
    assert len(lattice) == 5 * 11 + 4 * 10
    with pytest.raises(ValueError, match="must be at most") as error:
        random_layout(len(lattice), size, pitch=1.1)
    assert 1 <= float(str(error.value).split()[5]) < 1.02


@given(sizes, st.floats(0.4, 3), st.integers(0, 2**32))
@settings(max_examples=30, deadline=None)
def test_poisson_discs_keep_their_distance_and_leave_no_room(size, distance, seed):
    centers = poisson_disc_layout(size, min_distance=distance, seed=seed)
    assert (np.abs(centers) <= np.array(size) / 2).all()
    assert neighbours(centers).min() >= distance
    assert farthest(centers, size, distance / 10) <= distance * (1 + 1e-8)
    assert centers.tobytes() == poisson_disc_layout(size, min_distance=distance, seed=seed).tobytes()


@given(sizes, st.floats(0.3, 5))
def test_lattices_have_every_point_that_fits(size, pitch):
    half = np.array(size) / 2
    for layout, row, shift in ((square_layout, 1, 0), (hexagonal_layout, np.sqrt(3) / 2, 0.5)):
        centers = layout(size, pitch=pitch)
        i, j = np.mgrid[-30:30, -30:30].reshape(2, -1)
        expected = np.stack([(i + shift * (j % 2)) * pitch, j * row * pitch], axis=1)
        # A point that rounding alone puts off the plate is on its edge.
        expected = expected[(np.abs(expected) <= half * (1 + 1e-9)).all(axis=1)]
        np.testing.assert_allclose(
            sorted(map(tuple, centers.round(9))), sorted(map(tuple, expected.round(9))), atol=1e-8
        )
        if size[0] >= 2 * pitch:  # else a row may have one lens
            np.testing.assert_allclose(nearest_neighbour_distances(centers), pitch, rtol=1e-12)


def test_regular_layouts_have_the_holes_and_the_coverage_of_closed_forms():
    """On plates whose edges are lattice lines, so that there is no effect of the border."""
    square, hexagonal = square_layout((12, 8), pitch=2), hexagonal_layout((12, 8 * np.sqrt(3)), pitch=2)
    np.testing.assert_allclose(max_gap(square, (12, 8)), np.sqrt(2), rtol=1e-7)
    np.testing.assert_allclose(max_gap(hexagonal, (12, 8 * np.sqrt(3))), 2 / np.sqrt(3), rtol=1e-7)
    np.testing.assert_allclose(coverage(square, (12, 8), diameter=2), np.pi / 4, rtol=1e-7)
    np.testing.assert_allclose(coverage(hexagonal, (12, 8 * np.sqrt(3)), diameter=2), np.pi / np.sqrt(12), rtol=1e-7)
    angle = np.arccos(1 / 1.2)  # discs of radius 1.2 overlap in four lenses of two segments each
    overlapping = np.pi * 1.2**2 - 4 * 1.2**2 * (angle - np.sin(angle) * np.cos(angle))
    np.testing.assert_allclose(coverage(square, (12, 8), diameter=2.4), overlapping / 4, rtol=1e-7)
    assert coverage(square, (12, 8), diameter=2.83) == 1


ODD = [
    np.array([[0.3, -0.2]]),
    np.array([[2.0, 1.5]]),  # a corner
    np.array([[-1.0, 0.1], [1.2, 0.1]]),
    np.array([[-2.0, 0.0], [2.0, 0.0], [0.3, 1.5], [0.0, -1.5]]),  # one on each edge
    np.array([[-1.0, -0.5], [0.0, 0.0], [1.0, 0.5]]),  # a line
    np.array([[0.5, 0.5], [0.5, 0.5], [-1.0, 0.0]]),  # a pair in one place
]


@pytest.mark.parametrize("centers", ODD + [scattered(count, (4, 3), count) for count in (2, 5, 30)])
def test_hole_and_coverage_agree_with_a_dense_grid(centers):
    size, step = (4, 3), 0.01
    found = farthest(centers, size, step)
    # A grid misses the farthest point by half a diagonal of its meshes.
    assert found - 1e-7 <= max_gap(centers, size) <= found + step / np.sqrt(2)
    points = grid((4 - step, 3 - step), step)  # the middles of meshes
    nearest = cdist(points, centers).min(axis=1)
    for diameter in (0.3, 1.0, 2.5):
        # Meshes cut by a circle are right on average: 0.1 % of the plate is what some 10 lenses leave.
        np.testing.assert_allclose(
            coverage(centers, size, diameter=diameter), np.mean(nearest < diameter / 2), atol=1e-3
        )


@pytest.mark.parametrize("centers", ODD[:-1] + [scattered(30, (4, 3), 1)])
def test_lloyd_moves_to_the_centroids_of_a_dense_grid(centers):
    points = grid((4 - 0.01, 3 - 0.01), 0.01)
    owner = cdist(points, centers).argmin(axis=1)
    centroids = np.array([points[owner == lens].mean(axis=0) for lens in range(len(centers))])
    np.testing.assert_allclose(lloyd_relax(centers, (4, 3), iterations=1), centroids, atol=5e-3)


def test_lloyd_evens_out():
    start = scattered(50, (6, 4), 0)
    relaxed = lloyd_relax(start, (6, 4), iterations=30)
    assert max_gap(relaxed, (6, 4)) < 0.6 * max_gap(start, (6, 4))
    assert neighbours(relaxed).min() > 3 * neighbours(start).min()
    with pytest.raises(ValueError, match="`centers` must differ"):
        lloyd_relax(ODD[-1], (4, 3), iterations=1)


def test_measures_refuse_lenses_beside_the_plate():
    for measure in (max_gap, lambda *a: coverage(*a, diameter=1), lambda *a: lloyd_relax(*a, iterations=1)):
        with pytest.raises(ValueError, match="on a plate of 4 x 3 mm, got 1 outside"):
            measure(np.array([[0.0, 0.0], [0.0, 1.6]]), (4, 3))


def test_a_lens_on_the_edge_is_on_the_plate_in_single_precision():
    """Of a file that holds tenths of micrometres: 9.6 mm is more in float32."""
    centers = np.array([[9.6, 0.0], [0.0, -9.6], [0.0, 0.0]], np.float32)
    assert coverage(centers, (19.2, 19.2), diameter=1.0) == pytest.approx(2 * np.pi / 4 / 19.2**2, rel=1e-3)


def test_authors_layout():
    """Their 213 centres: pitch 1.230 mm, SD 0.099 mm, and discs of 2 mm that cover 98.3 % (FACTS.md)."""
    centers = np.loadtxt(needs("geomscope/centers.csv"), delimiter=",", skiprows=1)
    assert centers.shape == (213, 2)
    distances = nearest_neighbour_distances(centers)
    np.testing.assert_allclose(distances, neighbours(centers), rtol=1e-12)
    np.testing.assert_allclose([distances.mean(), distances.std()], [1.230, 0.099], atol=5e-4)
    np.testing.assert_allclose([distances.min(), distances.max()], [1.101, 1.545], atol=5e-4)
    # FACTS.md has it from a grid with points on the border; ours is exact.
    np.testing.assert_allclose(coverage(centers, PLATE, diameter=2), 0.983, atol=1e-3)
    near = cdist(grid((19.95, 19.95), 0.05), centers).min(axis=1) < 1
    np.testing.assert_allclose(coverage(centers, PLATE, diameter=2), near.mean(), atol=2e-4)
    assert max_gap(centers, PLATE) > 1
