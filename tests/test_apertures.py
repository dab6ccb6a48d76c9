"""Clear apertures of identical lenses and of lenses that differ, and the pitch."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from jax.test_util import check_grads
from scipy.spatial.distance import cdist

from gs_jax import MicrolensArray
from gs_jax.microscope.layouts import coverage, nearest_neighbour_distances
from gs_jax.microscope.lenses import lenses_by_type
from gs_jax.optics.apertures import _edge_distances, aperture_area, clear_area, clear_diameter, pitch
from gs_jax.optics.pupil import aperture_profile

from .helpers import aperture_edge

gradient_of_diameter = jax.jit(jax.grad(clear_diameter))


def layout(count, size=(8.0, 6.0), seed=0):
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 2)) * size


def array(centers, size=(8.0, 6.0), diameter=2.0):
    return MicrolensArray(centers, aperture_diameter=diameter, size=size)


@settings(max_examples=30, deadline=None)  # the first one compiles
@given(st.integers(1, 64), st.integers(0, 10_000), st.floats(0.05, 6.0))
def test_areas_add_up_to_the_exact_coverage(count, seed, diameter):
    """The other one clips Qhull's cells; this one never sees a cell."""
    centers = layout(64, seed=seed)[:count]
    centers = np.concatenate([centers, np.tile(centers[:1], (64 - count, 1))])
    lenses = array(centers, diameter=diameter)
    # Copies of a lens do not bound each other, so they count once here.
    total = float(np.asarray(aperture_area(lenses))[:count].sum())
    # Qhull joins vertices closer than 1e-8 or so.
    np.testing.assert_allclose(total / 48, coverage(centers[:count], (8.0, 6.0), diameter=diameter), rtol=1e-7)


def test_the_edge_is_where_points_change_hands():
    """From a lens to another, or to none: by distances alone."""
    lenses, angles = array(layout(32)), np.linspace(0, 2 * np.pi, 73)[:-1]
    edges = aperture_edge(lenses, angles)[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    for factor, inside in [(1 - 1e-9, True), (1 + 1e-9, False)]:
        points = (np.asarray(lenses.centers)[:, None] + factor * edges).reshape(-1, 2)
        distances = cdist(points, lenses.centers)
        outside = distances.min(axis=1) > float(lenses.aperture_diameter) / 2
        outside |= (np.abs(points) > np.array(lenses.size) / 2).any(axis=1)
        owner = np.where(outside, -1, distances.argmin(axis=1)).reshape(32, -1)
        assert np.all((owner == np.arange(32)[:, None]) == inside)


@pytest.mark.parametrize("scale", [1.1, 0.9, 1.37])
def test_a_compiled_lens_does_not_bound_itself(scale):
    """Compilers that optimise fuse the product into the difference of centres: not 0 of a lens and itself."""
    lenses = array([[-1.313, 0.437], [0.221, 0.119], [1.127, -0.741], [0.333, 1.416], [-0.629, -1.243]], diameter=1.1)
    areas = lambda scale: aperture_area(dataclasses.replace(lenses, centers=scale * lenses.centers))
    alone = aperture_area(dataclasses.replace(lenses, centers=scale * np.asarray(lenses.centers)))
    np.testing.assert_allclose(jax.jit(areas)(np.array(scale)), alone, rtol=1e-9)


def test_area_is_the_integral_of_the_edge():
    lenses, count = array(layout(64)), 4096
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
    np.testing.assert_allclose(jax.jit(jax.grad(one))(4.0), -2.0, rtol=1e-12)


def test_a_regular_array():
    x, y = np.meshgrid(np.arange(-5.0, 6), np.arange(-5.0, 6))
    centers = np.stack([x.ravel(), y.ravel()], axis=1)
    np.testing.assert_allclose(aperture_area(array(centers, (11.0, 11.0))), 1, rtol=1e-13)
    np.testing.assert_allclose(clear_diameter(array(centers, (11.0, 11.0))), 2 / np.sqrt(np.pi), rtol=1e-13)
    mean, deviation = pitch(centers)
    assert (mean, deviation) == (1, 0)
    assert np.isfinite(jax.jit(jax.grad(lambda c: pitch(c)[1]))(centers)).all()


@pytest.mark.parametrize("angle", [0.3, np.pi / 4])
def test_float32_and_rounding(angle):
    """A rotated square lattice: four lines cross at each corner, and are parallel but for rounding."""
    x, y = np.meshgrid(np.arange(-5.0, 6), np.arange(-5.0, 6))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    centers = np.stack([x.ravel(), y.ravel()], axis=1) @ turn
    inner = np.hypot(*centers.T) < 4
    for dtype, tolerance in [(np.float64, 1e-12), (np.float32, 1e-5)]:
        lenses = jax.tree.map(lambda leaf: np.asarray(leaf, dtype), MicrolensArray(centers))  # noqa: B023
        area = np.asarray(aperture_area(lenses))
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
    mean, deviation = pitch(centers)
    np.testing.assert_allclose([mean, deviation], [expected.mean(), expected.std()], rtol=1e-13)


def test_pitch_of_one_lens_and_of_coincident_lenses():
    assert pitch(np.zeros((1, 2))) == (np.inf, 0)
    value, slope = jax.jit(jax.value_and_grad(lambda c: sum(pitch(c))))(np.zeros((3, 2)))
    assert value == 0 and not slope.any()


@pytest.mark.integration
def test_memory_of_a_thousand_lenses():
    """What XLA plans to allocate, for the gradient too."""
    lenses = array(layout(1000, (44.0, 44.0)), (44.0, 44.0))
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), lenses)
    compiled = jax.jit(jax.grad(clear_diameter)).lower(shapes).compile()
    memory = compiled.memory_analysis()
    assert memory is not None and memory.temp_size_in_bytes < 60 * 2**20


# --- lenses that differ ---

SIZE = (4.0, 3.0)
ANGLES = 2 * np.pi * (np.arange(512) + 0.5) / 512


def unequal(count=9, size=SIZE, **numbers):
    which = np.arange(count) % 3
    given: dict[str, Any] = {
        "radius_of_curvature": np.array([2.0, 1.7, 2.4])[which],
        "conic_constant": np.array([0.0, -0.6, 0.0])[which],
        "aperture_diameter": np.array([2.0, 2.0, 1.6])[which],
    }
    square = np.stack(np.meshgrid([-1.2, 0, 1.2], [-0.9, 0, 0.9][: count // 3]), -1).reshape(-1, 2)
    return MicrolensArray(square + 0.2 * layout(count, (1.0, 1.0)), size=size, **(given | numbers))


def test_two_spheres_meet_in_a_circle():
    """Of `p^2 + (w - R)^2 = R^2` about both vertices: seen from above, a quadratic equation in each direction."""
    first, second, apart = 2.0, 1.6, 1.1
    array = MicrolensArray([[0.0, 0.0], [apart, 0.0]], radius_of_curvature=[first, second], aperture_diameter=2.0)
    # The sag on both spheres is w = (2 p.d - d^2) / (2 (R_1 - R_2)) = b r - a in the direction of p.
    a, b = apart**2 / 2 / (first - second), apart * np.cos(ANGLES) / (first - second)
    # r^2 + (b r - a)^2 = 2 R_1 (b r - a)
    p, q, s = 1 + b**2, -2 * b * (a + first), a**2 + 2 * first * a
    with np.errstate(invalid="ignore"):
        roots = (-q + np.sqrt(q**2 - 4 * p * s) * [[-1], [1]]) / (2 * p)
    roots = np.where((roots > 0) & (b * roots >= a), roots, np.inf)
    edges = jax.jit(_edge_distances, static_argnums=1)(array, 512)
    np.testing.assert_allclose(np.asarray(edges)[0], np.minimum(roots.min(0), 1.0), rtol=1e-9)


def test_alike_lenses_end_at_their_cells():
    """A list of equal numbers is what one number is, but for the sum over directions: 3e-5."""
    alike = MicrolensArray(layout(12, (5.0, 4.0)), size=(6.0, 5.0))
    list_of_one = dataclasses.replace(alike, radius_of_curvature=[2.0], types=np.zeros(12, int))
    np.testing.assert_allclose(aperture_area(list_of_one), aperture_area(alike), rtol=5e-5)


def test_lenses_that_are_apart_are_discs_on_the_plate():
    """What the plate cuts off them is a segment; where they overlap by 1 um they are nearly that."""
    centers, diameters = np.array([[-0.75, 0.0], [0.6, 0.1]]), np.array([0.9, 1.0])
    array = MicrolensArray(centers, radius_of_curvature=[2.0, 1.7], aperture_diameter=diameters, size=(2.0, 3.0))
    full, segment = np.pi / 4 * diameters**2, []
    for room, radius in ((0.25, 0.45), (0.4, 0.5)):
        segment.append(radius**2 * np.arccos(room / radius) - room * np.sqrt(radius**2 - room**2))
    np.testing.assert_allclose(aperture_area(array), full - np.array(segment), rtol=5e-5)
    near = [dataclasses.replace(array, centers=[[-0.75, 0.0], [x, 0.1]]) for x in (0.195, 0.194)]  # apart, and not
    np.testing.assert_allclose(aperture_area(near[0]), aperture_area(near[1]), rtol=1e-3)


@pytest.mark.integration
def test_areas_are_those_of_a_raster():
    """The highest cap at each place, steps of 4 um: an edge of 1 mm along a row of them is right to 2e-3 of a lens."""
    array, step = unequal(), 0.004
    axes = [np.arange(-side / 2 + step / 2, side / 2, step) for side in SIZE]
    places, below = np.stack(np.meshgrid(*axes, indexing="ij"), -1), []
    for lens in map(array.lens, range(9)):
        apart = ((places - np.asarray(lens.centers)) ** 2).sum(-1)
        rim = float(lens.aperture_diameter / 2) ** 2
        below.append(np.where(apart < rim, lens.sag(np.minimum(apart, rim)), np.inf))
    owner = np.argmin(below, 0)[np.isfinite(below).any(0)]
    np.testing.assert_allclose(aperture_area(array), np.bincount(owner) * step**2, rtol=2e-3)


def test_a_kind_keeps_its_neighbours():
    array = unequal()
    which = lenses_by_type(array)
    assert which == ((0, 3, 6), (1, 4, 7), (2, 5, 8))
    parts = [array.subset(type_) for type_ in which]
    assert all(part.alike and len(part.centers) == 3 and len(part.whole.centers) == 9 for part in parts)
    areas = np.concatenate([aperture_area(part) for part in parts])
    np.testing.assert_allclose(areas, np.asarray(aperture_area(array))[np.concatenate(which)], rtol=1e-12)


@pytest.mark.integration
def test_how_open_lenses_are_by_radius():
    """The integral over the radii is the area; of the same lenses as two types the shares are those of one."""
    disc = dataclasses.replace(unequal(), size=(np.inf, np.inf))
    for type_ in map(disc.subset, lenses_by_type(disc)):
        open_, step = (
            aperture_profile(type_).open,
            aperture_profile(type_).radius[1] - aperture_profile(type_).radius[0],
        )
        area = (2 * np.pi * aperture_profile(type_).radius * step * open_).sum()
        np.testing.assert_allclose(area, aperture_area(type_).mean(), rtol=2e-2)  # 64 radii and angles
    alike = MicrolensArray(layout(12, (4.0, 4.0)))
    halves = [aperture_profile(alike.subset(np.arange(half, 12, 2))).open for half in (0, 1)]
    np.testing.assert_allclose(np.mean(halves, 0), aperture_profile(alike).open, atol=1e-12)


@pytest.mark.integration
@pytest.mark.parametrize("size", [SIZE, (np.inf, np.inf)])
def test_gradients_of_areas_of_lenses_that_differ(size):
    array = unequal(6, size)

    def total(numbers):
        return jnp.sum(aperture_area(dataclasses.replace(array, **numbers)) ** 2)

    found = jax.jit(jax.value_and_grad(total))
    names = ("centers", "radius_of_curvature", "aperture_diameter", "conic_constant")
    at = {name: np.asarray(getattr(array, name)) for name in names}
    slopes, rng = found(at)[1], np.random.default_rng(0)
    for _ in range(3):
        way = {name: rng.standard_normal(value.shape) for name, value in at.items()}
        # Where an edge jumps between neighbours, at a corner, the sum over directions has kinks: 1e-6 meets few.
        ends = [float(found({name: at[name] + s * 1e-6 * way[name] for name in names})[0]) for s in (1, -1)]
        expected = sum(float(np.vdot(slopes[name], way[name])) for name in names)
        assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_clear_areas_are_of_the_arrays_precision():
    array = MicrolensArray([[0.0, 0.0], [1.2, 0.1]])
    for dtype in (np.float32, np.float64):
        own = jax.tree.map(lambda leaf, dtype=dtype: jax.device_put(np.asarray(leaf, dtype)), array)
        assert clear_area(own).dtype == dtype
