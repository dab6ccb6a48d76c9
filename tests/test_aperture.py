import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from jax.test_util import check_grads
from scipy.spatial.distance import cdist

from gs_jax import MicrolensArray
from gs_jax.layouts import coverage, nearest_neighbour_distances
from gs_jax.optics.apertures import aperture_area, clear_diameter, pitch

from .helpers import aperture_edge

gradient_of_diameter = jax.jit(jax.grad(clear_diameter))


def layout(count, size=(8.0, 6.0), seed=0):
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 2)) * size


def array(centers, size=(8.0, 6.0), diameter=2.0):
    return MicrolensArray(centers, aperture_diameter=diameter, size=size)


def nearest_lens_inside(lenses, points):
    """Which lens each point belongs to, or -1: by distances alone."""
    distances = cdist(points, lenses.centers)
    outside = distances.min(axis=1) > float(lenses.aperture_diameter) / 2
    outside |= (np.abs(points) > np.array(lenses.size) / 2).any(axis=1)
    return np.where(outside, -1, distances.argmin(axis=1))


def test_the_edge_is_where_points_change_hands():
    lenses, angles = array(layout(32)), np.linspace(0, 2 * np.pi, 73)[:-1]
    edge = aperture_edge(lenses, angles)
    direction = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    for factor, inside in [(1 - 1e-9, True), (1 + 1e-9, False)]:
        points = np.asarray(lenses.centers)[:, None] + factor * edge[..., None] * direction
        owner = nearest_lens_inside(lenses, points.reshape(-1, 2)).reshape(edge.shape)
        assert np.all((owner == np.arange(32)[:, None]) == inside)


@settings(max_examples=30, deadline=None)  # the first one compiles
@given(st.integers(1, 64), st.integers(0, 10_000), st.floats(0.05, 6.0))
def test_areas_add_up_to_the_exact_coverage(count, seed, diameter):
    """The other one clips Qhull's cells; this one never sees a cell."""
    centers = layout(64, seed=seed)[:count]
    centers = np.concatenate([centers, np.tile(centers[:1], (64 - count, 1))])
    lenses = array(centers, diameter=diameter)
    # Copies of a lens do not bound each other, so they count once here.
    total = float(aperture_area(lenses)[:count].sum())
    # Qhull joins vertices closer than 1e-8 or so.
    np.testing.assert_allclose(total / 48, coverage(centers[:count], (8.0, 6.0), diameter=diameter), rtol=1e-7)


def test_area_is_the_integral_of_the_edge():
    lenses, count = array(layout(32)), 4096
    angles = (np.arange(count) + 0.5) * (2 * np.pi / count)
    integral = np.sum(aperture_edge(lenses, angles) ** 2, axis=1) * np.pi / count
    # The midpoint rule at corners, and at jumps where a lens is close to the plate's edge.
    np.testing.assert_allclose(aperture_area(lenses), integral, rtol=2e-4)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("lenses", "expected"),
    [
        (MicrolensArray([[0.3, 0.1]]), [np.pi]),
        (MicrolensArray([[0.3, 0.1], [0.3, 0.1], [0.3, 0.1]]), [np.pi] * 3),
        (MicrolensArray([[0.0, 0.0], [0.0, 0.0], [2.0, 0.0], [2.0, 0.0]]), [np.pi] * 4),
        (array([[0.0, 0.0]], size=(1.0, 1.2)), [1.2]),
        (array([[4.0, 0.0]]), [np.pi / 2]),
        (array([[4.0, -3.0]]), [np.pi / 4]),
        # A lens with neighbours at distance 1 on all sides: a square.
        (array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]), [1.0]),
        # Two coincident lenses bound a third one once, at half the distance: a disc less a segment.
        (MicrolensArray([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0]]), [2 * np.pi / 3 + np.sqrt(3) / 4]),
    ],
)
def test_closed_forms_and_degenerate_layouts(lenses, expected):
    # Copies of a lens change nothing, and few shapes compile.
    copies = jnp.tile(lenses.centers[:1], (5 - len(lenses.centers), 1))
    lenses = MicrolensArray(jnp.concatenate([lenses.centers, copies]), size=lenses.size)
    np.testing.assert_allclose(aperture_area(lenses)[: len(expected)], expected, rtol=1e-13)
    gradient = gradient_of_diameter(lenses)
    assert all(jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


def test_a_lens_on_the_plates_edge_feels_it():
    """Half of the disc is cut off; moving in by dx gains a strip of 2 dx."""
    one = lambda x: aperture_area(array(jnp.stack([x, jnp.zeros(())])[None]))[0]
    np.testing.assert_allclose(jax.grad(one)(jnp.array(4.0)), -2.0, rtol=1e-12)


def test_a_regular_array():
    x, y = np.meshgrid(np.arange(-5.0, 6), np.arange(-5.0, 6))
    centers = np.stack([x.ravel(), y.ravel()], axis=1)
    np.testing.assert_allclose(aperture_area(array(centers, (11.0, 11.0))), 1, rtol=1e-13)
    np.testing.assert_allclose(clear_diameter(array(centers, (11.0, 11.0))), 2 / np.sqrt(np.pi), rtol=1e-13)
    mean, deviation = pitch(jnp.asarray(centers))
    assert (mean, deviation) == (1, 0)
    assert jnp.all(jnp.isfinite(jax.grad(lambda c: pitch(c)[1])(jnp.asarray(centers))))


@pytest.mark.parametrize("angle", [0.3, np.pi / 4])
def test_float32_and_rounding(angle):
    """A rotated square lattice: four lines cross at each corner, and are parallel but for rounding."""
    x, y = np.meshgrid(np.arange(-5.0, 6), np.arange(-5.0, 6))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    centers = np.stack([x.ravel(), y.ravel()], axis=1) @ turn
    inner = np.hypot(*centers.T) < 4
    for dtype, tolerance in [(jnp.float64, 1e-12), (jnp.float32, 1e-5)]:
        lenses = jax.tree.map(lambda leaf: leaf.astype(dtype), MicrolensArray(centers))  # noqa: B023
        area = aperture_area(lenses)
        assert area.dtype == dtype
        np.testing.assert_allclose(area[inner], 1, rtol=tolerance)


@pytest.mark.integration
@pytest.mark.parametrize("size", [(8.0, 6.0), (np.inf, np.inf)])
def test_gradients(size):
    @jax.jit
    def values(centers, diameter):
        lenses = array(centers, size, diameter)
        return aperture_area(lenses), clear_diameter(lenses), pitch(centers)

    # Steps of 1e-6 mm stay within a piece: edges, neighbours and who is nearest change only at special layouts.
    check_grads(values, (jnp.asarray(layout(32)), jnp.array(2.0)), order=1, eps=1e-6, atol=1e-6, rtol=1e-6)


def test_pitch_is_the_mean_distance_to_the_nearest():
    centers = layout(213)
    expected = nearest_neighbour_distances(centers)
    mean, deviation = pitch(jnp.asarray(centers))
    np.testing.assert_allclose([mean, deviation], [expected.mean(), expected.std()], rtol=1e-13)


def test_pitch_of_one_lens_and_of_coincident_lenses():
    assert pitch(jnp.zeros((1, 2))) == (jnp.inf, 0)
    assert pitch(jnp.zeros((3, 2))) == (0, 0)
    assert jnp.all(jax.grad(lambda c: sum(pitch(c)))(jnp.zeros((3, 2))) == 0)


@pytest.mark.integration
def test_memory_of_a_thousand_lenses():
    """What XLA plans to allocate, for the gradient too."""
    lenses = array(layout(1000, (44.0, 44.0)), (44.0, 44.0))
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), lenses)
    compiled = jax.jit(jax.grad(clear_diameter)).lower(shapes).compile()
    memory = compiled.memory_analysis()
    assert memory is not None and memory.temp_size_in_bytes < 60 * 2**20
