"""Lenses that differ on one plate: where they end, and types of them."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gs_jax import MicrolensArray
from gs_jax.lenses import lenses_by_type
from gs_jax.optics.apertures import _edge_distances, aperture_area
from gs_jax.optics.psf_core import aperture_profile

from .test_aperture import layout

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
    np.testing.assert_allclose(_edge_distances(array, 512)[0], np.minimum(roots.min(0), 1.0), rtol=1e-9)


def test_alike_lenses_end_at_their_cells():
    """A list of equal numbers is what one number is, but for the sum over directions: 3e-5."""
    alike = MicrolensArray(layout(12, (5.0, 4.0)), size=(6.0, 5.0))
    list_of_one = dataclasses.replace(alike, radius_of_curvature=np.full(12, 2.0))
    np.testing.assert_allclose(aperture_area(list_of_one), aperture_area(alike), rtol=5e-5)


def test_lenses_that_are_apart_are_discs_on_the_plate():
    """What the plate cuts off them is a segment; where they overlap by 1 um they are nearly that."""
    centers, diameters = jnp.array([[-0.75, 0.0], [0.6, 0.1]]), jnp.array([0.9, 1.0])
    array = MicrolensArray(centers, radius_of_curvature=[2.0, 1.7], aperture_diameter=diameters, size=(2.0, 3.0))
    full, segment = np.pi / 4 * diameters**2, []
    for room, radius in ((0.25, 0.45), (0.4, 0.5)):
        segment.append(radius**2 * np.arccos(room / radius) - room * np.sqrt(radius**2 - room**2))
    np.testing.assert_allclose(aperture_area(array), full - np.array(segment), rtol=5e-5)
    near = [dataclasses.replace(array, centers=centers.at[1, 0].set(x)) for x in (0.195, 0.194)]  # apart, and not
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
    np.testing.assert_allclose(areas, aperture_area(array)[np.concatenate(which)], rtol=1e-12)


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
def test_gradients_of_areas(size):
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
