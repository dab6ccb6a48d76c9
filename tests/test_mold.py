"""The array and its mold as solids: what they are, not how they are triangulated."""

import csv
import dataclasses
import json
import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import equinox as eqx
import jax
import manifold3d as m3
import numpy as np
import pytest
import tifffile
import trimesh
from click.testing import CliRunner
from ezdxf.filemanagement import readfile
from hypothesis import given, settings, strategies as st
from PIL import Image
from scipy.integrate import quad
from scipy.interpolate import RegularGridInterpolator

import gs_jax as gs
from gs_jax import InputError, MicrolensArray
from gs_jax.__main__ import commands
from gs_jax.design.design import read_design
from gs_jax.io.provenance import read_provenance
from gs_jax.mold.export import float32_mesh, make_mask, write_mask
from gs_jax.mold.heights import HEIGHT_SUFFIXES, write_heights
from gs_jax.mold.lenslets import DRAFT, Lenslet, Part, tessellate
from gs_jax.mold.manufacturability import check_solid
from gs_jax.mold.measurement import measure_lenslets
from gs_jax.mold.solids import (
    ENGRAVING_DEPTH,
    MoldShape,
    alignment_marks,
    array_solid,
    array_volume,
    cast_solid,
    engraving_tools,
    lenslets_volume,
    mold_bounds,
    mold_solid,
    mold_volume,
    volume_tolerance,
)

from .helpers import aperture_edge, needs

CHORD = 2e-3
CENTERS = np.array([[-0.9, -0.6], [0.4, -0.7], [1.2, 0.5], [-0.3, 0.6], [-1.5, 0.9]])
RADII = np.array([1.6, 2.0, 2.4, 1.8, 2.2])
CONICS = np.array([0.0, -1.0, -0.5, 0.2, -1.6])
DIAMETERS = np.array([1.4, 1.5, 1.1, 1.6, 0.9])


def lenses(centers, size, *, diameter=2.0, radius=2.0, thickness=1.0) -> Part:
    return Part(MicrolensArray(np.array(centers, float), radius, 1.43, diameter, thickness, size=size))


def random_lenses(count=12, size=(5.0, 4.0), seed=0) -> Part:
    return lenses(np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 2)) * size, size)


def unequal(**changes) -> Part:
    numbers = {"radius_of_curvature": RADII, "conic_constant": CONICS, "aperture_diameter": DIAMETERS}
    return Part(MicrolensArray(**{"centers": CENTERS, "size": (4.0, 3.0), **numbers, **changes}))


def lattice(spacing, *, hexagonal=False):
    i, j = np.meshgrid(np.arange(-2, 3), np.arange(-2, 3))
    shear, row = (0.5, math.sqrt(3) / 2) if hexagonal else (0.0, 1.0)
    return spacing * np.stack([i + shear * j, row * j], axis=-1).reshape(-1, 2)


def assert_sound(part: Part, chord=CHORD, shape=MoldShape()):
    """Array and mold are watertight, manifold, one body without handles, of their volumes, once rounded to float32."""
    solid, tolerance = array_solid(part, chord), volume_tolerance(part, chord)
    mesh, mold = float32_mesh(solid), float32_mesh(mold_solid(part, solid, shape))
    checks = [
        *check_solid(mesh, array_volume(part), "array", tolerance),
        *check_solid(mold, mold_volume(part, shape), "mold", tolerance),
    ]
    assert [check for check in checks if check.level != "ok"] == []
    return mesh, mold


@pytest.fixture(scope="module")
def part() -> Part:
    return random_lenses()


@pytest.fixture(scope="module")
def solid(part) -> m3.Manifold:
    return array_solid(part, CHORD)


def test_the_part_lies_in_the_designs_frame(solid):
    x0, y0, z0, x1, y1, z1 = solid.bounding_box()
    assert (x0, y0, x1, y1, z1) == (-2.5, -2.0, 2.5, 2.0, 0.0)
    # The vertices are at -t, but for the lift, which is below the chord error.
    assert -1.0 - CHORD < z0 < -1.0


@pytest.mark.parametrize("conic, terms", [(0.0, ()), (-1.0, ()), (0.3, ()), (-0.7, (0.02, -0.01)), (0.0, (-0.03,))])
def test_one_lens_of_any_profile_has_its_volume(conic, terms):
    part = Part(MicrolensArray([[0.1, 0.0]], size=(3.0, 2.6), conic_constant=conic, aspheric_terms=terms))
    (cap,) = part.lenslets
    volume, _ = quad(
        lambda r: 2 * math.pi * r * (cap.rim_sag - float(cap.sag(np.array([r**2]))[0])), 0, 1, epsabs=1e-13
    )
    np.testing.assert_allclose(lenslets_volume(part), volume, rtol=1e-10)
    if not (conic or terms):
        cap_volume = math.pi * part.height**2 * (3 * 2.0 - part.height) / 3
        np.testing.assert_allclose(array_volume(part), 3.0 * 2.6 * part.plate_thickness + cap_volume, rtol=1e-13)
    # 1e-4 of the volume is what is promised at a chord error of 0.5 um.
    np.testing.assert_allclose(array_solid(part, 5e-4).volume(), array_volume(part), rtol=1e-5)
    assert_sound(part)


def test_the_caps_volume_agrees_with_a_sum_over_directions(part):
    angles = (np.arange(20_000) + 0.5) * 2 * math.pi / 20_000
    edge = aperture_edge(part.array, angles)
    base = math.sqrt(3.0)
    inner = (8 - (4 - edge**2) ** 1.5) / 3 - base * edge**2 / 2
    # A midpoint rule on a function with kinks: 1 / count^2.
    np.testing.assert_allclose(lenslets_volume(part), inner.sum() * 2 * math.pi / 20_000, rtol=1e-7)
    height, _ = part.surface(*((np.arange(1000) + 0.5) / 1000 * side - side / 2 for side in part.size))
    # Rims and grooves are kinks, not steps: a midpoint rule on a million points.
    np.testing.assert_allclose(lenslets_volume(part), height.mean() * 20.0, rtol=1e-5)


def test_the_volume_of_unequal_lenses_is_that_of_the_highest():
    """Of the highest lens over the land, by the definition: conics to their discs, then walls."""
    part = unequal()
    x, y = ((np.arange(2400) + 0.5) / 2400 * side - side / 2 for side in part.size)
    fall = lambda rho, r, k: rho**2 / (r + np.sqrt(r**2 - (1 + k) * rho**2))
    numbers = list(zip(CENTERS, DIAMETERS / 2, RADII, CONICS, strict=True))
    land = max(fall(edge, r, k) for _, edge, r, k in numbers)
    best = np.zeros((len(x), len(y)))
    for center, edge, r, k in numbers:
        rho = np.hypot(x[:, None] - center[0], y - center[1])
        wall = np.maximum(rho - edge, 0) / math.tan(DRAFT)
        best = np.maximum(best, land - fall(np.minimum(rho, edge), r, k) - wall)
    # Walls are steps of 0.1 mm on a few hundredths of a percent of the places.
    np.testing.assert_allclose(lenslets_volume(part), best.mean() * 12, rtol=2e-5)
    np.testing.assert_allclose(array_solid(part, 2e-4).volume(), array_volume(part), rtol=2e-5)


def test_lists_of_equal_numbers_are_one_number():
    one = MicrolensArray(CENTERS, aperture_diameter=1.5, size=(4.0, 3.0))
    listed = dataclasses.replace(one, radius_of_curvature=[2.0], conic_constant=[0.0], types=np.zeros(5, int))
    same = [float32_mesh(array_solid(Part(array), CHORD)) for array in (one, listed)]
    np.testing.assert_array_equal(same[0].vertices, same[1].vertices)
    np.testing.assert_array_equal(same[0].facets, same[1].facets)
    # Quadrature over the cells' sectors, and over a grid.
    np.testing.assert_allclose(lenslets_volume(Part(one)), lenslets_volume(Part(listed)), rtol=1e-6)


def test_facets_of_lenses_cover_the_plate_within_the_chord_error(part, solid):
    mesh = float32_mesh(solid)
    corners = mesh.vertices[mesh.facets].astype(float)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    down = normal[:, 2] < -1e-5 * np.linalg.norm(normal, axis=1)
    # float32, ten thousand facets; none of them is overlapped by another.
    np.testing.assert_allclose(-normal[down, 2].sum() / 2, 20.0, rtol=1e-6)
    # Heights over the base, lenses up.
    corners = corners[down] * (1, 1, -1) - (0, 0, part.plate_thickness)
    points = np.einsum("qk,fkx->fqx", np.random.default_rng(1).dirichlet([1, 1, 1], 40), corners).reshape(-1, 3)
    flat = np.repeat((corners[..., 2] < 1e-6).all(axis=1), 40)
    distances = []
    for lens in part.lenslets:
        squared = ((points[~flat, :2] - lens.center) ** 2).sum(axis=1)
        # The edge's corners are a little outside its circle.
        here = squared <= (lens.semi_aperture + CHORD) ** 2
        squared = np.where(here, squared, 0)
        off = points[~flat, 2] - part.height + lens.sag(squared)
        distances.append(np.where(here, off / np.sqrt(1 + squared * lens.sag_slope_over_r(squared) ** 2), np.inf))
    # From whichever lens they are nearest to, to first order.
    distance = np.take_along_axis(np.array(distances), np.abs(distances).argmin(axis=0)[None], axis=0)
    assert -CHORD < distance.min() and distance.max() < CHORD
    # The lift makes the mean zero up to the rims, which stay in the plate's plane.
    assert abs(distance.mean()) < CHORD / 10
    # float32: the plate is flat.
    assert np.abs(points[flat, 2]).max() < 1e-7


@pytest.mark.parametrize(
    "cap",
    [
        pytest.param(Lenslet(np.zeros(2), 1.0, 2.0, -1.0), id="paraboloid"),
        pytest.param(Lenslet(np.zeros(2), 1.3, 2.0, -8.0), id="hyperboloid"),
        pytest.param(Lenslet(np.zeros(2), 1.0, 2.0, 0.0, (-0.1,)), id="hollow toward the rim"),
        pytest.param(Lenslet(np.zeros(2), 1.0, 2.0, 0.5, (0.1, 0.05)), id="steep toward the rim"),
        pytest.param(Lenslet(np.zeros(2), 1.9, 2.0, 0.0), id="steep sphere"),
    ],
)
def test_facets_of_any_profile_are_within_the_chord_error(cap):
    result = tessellate(cap, cap.semi_aperture, CHORD)
    corners = np.column_stack([result.points, -result.sag])[result.facets]
    weights = np.random.default_rng(1).dirichlet([1, 1, 1], 60)
    points = np.einsum("qk,fkx->fqx", weights, corners).reshape(-1, 3)
    squared = (points[:, :2] ** 2).sum(axis=1)
    off = (points[:, 2] + cap.sag(squared)) / np.sqrt(1 + squared * cap.sag_slope_over_r(squared) ** 2)
    assert -CHORD < off.min() and off.max() < CHORD
    assert abs(off.mean()) < CHORD / 10


SPHERES = {"conic_constant": 0.0, "centers": [[-1, 0], [0, 0], [1, 0]], "aperture_diameter": 1.0}


@pytest.mark.parametrize(
    "part",
    [
        pytest.param(lenses([[0, 0]], (1.0, 1.0)), id="lens covers the plate"),
        pytest.param(lenses([[0, 0]], (2.0, 2.0)), id="rim touches the plate's edges"),
        pytest.param(lenses([[0, 0]], (math.sqrt(2), math.sqrt(2))), id="rim through the plate's corners"),
        pytest.param(lenses([[1.5, 1.5]], (3.0, 3.0)), id="lens on a corner"),
        pytest.param(lenses([[0, 1.5], [0, 0]], (3.0, 3.0)), id="lens on an edge"),
        pytest.param(lenses([[-1, 0], [1, 0]], (5.0, 5.0)), id="lenses touch"),
        pytest.param(lenses([[-1 - 1e-6, 0], [1, 0]], (5.0, 5.0)), id="1 nm apart"),
        pytest.param(lenses([[-1 - 3e-5, 0], [1, 0]], (5.0, 5.0)), id="30 nm apart"),
        pytest.param(lenses([[-1 + 1e-6, 0], [1, 0]], (5.0, 5.0)), id="1 nm overlap"),
        pytest.param(lenses([[0, 0], [0.001, 0], [0, 0.001]], (3.0, 3.0)), id="1 um apart"),
        pytest.param(lenses(lattice(2.0), (10.0, 10.0)), id="square lattice, lenses touch"),
        pytest.param(lenses(lattice(math.sqrt(2)), (7.0, 7.0)), id="square lattice, rims meet at corners"),
        pytest.param(lenses(lattice(math.sqrt(2) + 1e-5), (7.0, 7.0)), id="square lattice, gaps of 10 nm"),
        pytest.param(lenses(lattice(2.0, hexagonal=True), (12.0, 9.0)), id="hexagonal, lenses touch"),
        pytest.param(lenses(lattice(math.sqrt(3), hexagonal=True), (12.0, 9.0)), id="hexagonal, rims meet at corners"),
        pytest.param(lenses(lattice(1.2, hexagonal=True), (8.0, 6.0)), id="hexagonal, covers"),
        pytest.param(unequal(), id="unequal lenses"),
        pytest.param(unequal(orientation="curved"), id="curved side to the object"),
        pytest.param(unequal(aspheric_terms=[0.01, -0.004]), id="aspheric terms"),
        pytest.param(unequal(aperture_diameter=1.5, conic_constant=0.0), id="radii alone"),
        pytest.param(unequal(radius_of_curvature=2.0, conic_constant=0.0), id="apertures alone"),
        pytest.param(
            Part(MicrolensArray([[0, 0], [0.2, 0.1]], [3.0, 2.0], 1.43, [2.4, 0.6], size=(4.0, 3.0))),
            id="a small lens within a large one",
        ),
        pytest.param(unequal(**SPHERES, radius_of_curvature=[1.0, 1.0, 2.0]), id="walls touch"),
        pytest.param(
            unequal(**SPHERES | {"conic_constant": [-1.0, -1.0, 0.0]}, radius_of_curvature=[3.0, 3.0, 1.0]),
            id="high walls touch",
        ),
    ],
)
def test_degenerate_and_unequal_lenses_are_sound(part):
    assert_sound(part, shape=MoldShape(shrinkage=0.01, label="x"))


@pytest.mark.integration
@settings(max_examples=33, deadline=None)
@given(
    count=st.integers(1, 30),
    width=st.floats(0.5, 6.0),
    height=st.floats(0.5, 6.0),
    slope=st.floats(0.2, 1.3),
    term=st.floats(-0.02, 0.1),
    grid=st.booleans(),
    alike=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_any_lenses_are_sound(count, width, height, slope, term, grid, alike, seed):
    random = np.random.default_rng(seed)
    centers = random.uniform(-0.5, 0.5, (count, 2)) * (width, height)
    if grid:
        centers = np.unique(np.trunc(centers * 2) / 2, axis=0)
    draw = lambda low, high: random.uniform(low, high, len(centers)).round(1 if grid else 9)
    numbers: dict[str, Any] = {"aperture_diameter": 4 * math.sin(slope)}
    if not alike:
        numbers = {"radius_of_curvature": draw(1.0, 3.0), "aperture_diameter": draw(0.3, 1.4)}
        numbers |= {"conic_constant": draw(-2.0, 0.3), "aspheric_terms": [term]}
    part = Part(MicrolensArray(centers, substrate_thickness=2.5, size=(width, height), **numbers))
    assert_sound(part, part.max_chord / 3)


def test_lenses_in_float32_are_sound():
    with jax.enable_x64(False):
        assert_sound(random_lenses())


@pytest.mark.integration
def test_the_paper_s_array():
    part = Part(read_design(needs("oracle/dev/P1.toml")).imager().array)
    mesh, _ = assert_sound(part, chord=5e-4)
    off = abs(mesh.solid().volume() / array_volume(part) - 1)
    # The bar is 1e-4; the lift brings it to 2e-6.
    assert off < 1e-5
    assert len(mesh.facets) < 250_000
    lenses = measure_lenslets(mesh, part)
    np.testing.assert_allclose(lenses.center, part.centers, atol=1e-3)
    np.testing.assert_allclose(lenses.radius, 2.0, rtol=1e-3)


@pytest.mark.slow
def test_two_thousand_lenses():
    i, j = np.meshgrid(np.arange(45), np.arange(45))
    grid = 1.33 * (np.stack([i, j], axis=-1).reshape(-1, 2) - 22)
    moved = grid + np.random.default_rng(0).uniform(-0.4, 0.4, grid.shape)
    assert_sound(lenses(moved[:2000], (60.0, 60.0)), chord=5e-4)


def test_lenses_meet_where_their_sags_are_equal():
    """Paraboloids meet where `r_1^2 / R_1 = r_2^2 / R_2`: on a circle of Apollonius, not half way."""
    array = MicrolensArray([[-0.5, 0], [0.5, 0]], [1.5, 3.0], 1.43, 1.6, size=(3.0, 2.0), conic_constant=-1.0)
    mesh = float32_mesh(array_solid(Part(array), 1e-4))
    groove = -0.5 + 1 / (1 + math.sqrt(2))
    top = mesh.vertices[(np.abs(mesh.vertices[:, 1]) < 0.02) & (np.abs(mesh.vertices[:, 0]) < 0.4)]
    top = top[top[:, 2] < -0.7]
    assert abs(top[top[:, 2].argmax(), 0] - groove) < 0.02


def test_a_part_whose_curved_side_faces_the_object_is_turned_over_and_not_mirrored():
    plano, curved = unequal(), unequal(orientation="curved")
    # As it stands before the sensor: turned back about x, its lenses look toward +z, at the design's places.
    standing = array_solid(curved, CHORD).rotate([180, 0, 0])
    assert standing.bounding_box()[5] == pytest.approx(1.0, abs=CHORD)
    up = array_solid(plano, CHORD).mirror([0, 0, 1])
    # Other facets of the same lenses, seen in the mirror from below.
    assert (standing - up).volume() + (up - standing).volume() < 1e-3 * up.volume()
    circles = [make_mask(part.array).circles[:, :2] for part in (plano, curved)]
    np.testing.assert_allclose(circles[1], circles[0] * (1, -1))


def test_hidden_surfaces_have_no_facets():
    near = lenses(CENTERS[:3], (4.0, 3.0), diameter=1.5)
    assert near.visible_radii == pytest.approx([0.75] * 3)
    i, j = np.meshgrid(np.arange(-3, 4), np.arange(-3, 4))
    dense = lenses(0.4 * np.stack([i, j], axis=-1).reshape(-1, 2), (2.8, 2.8))
    # A cell's corner, and a tile or two.
    assert 0.2 * math.sqrt(2) < max(dense.visible_radii) < 0.36
    assert_sound(dense)


@pytest.mark.parametrize(
    "part, message",
    [
        (lenses([[0, 0], [0, 0]], (3.0, 3.0)), "`centers` must be 0.001 mm apart"),
        (
            lenses([[0, 0]], (3.0, 3.0), thickness=0.2),
            "`substrate_thickness` must be more than the lenses' sag, 0.2679",
        ),
        (lenses([[0, 0]], (3.0, 3.0), thickness=0.0), "`substrate_thickness` must be more"),
        (lenses([[0, 0]], (5.0, 5.0), diameter=4.0, thickness=3.0), "`aperture_diameter` must be positive and at most"),
        (lenses([[0, 0]], (5.0, 5.0), diameter=5.0, thickness=3.0), "`aperture_diameter` must be positive and at most"),
        (
            unequal(aperture_diameter=[1.0, 1.99, 1, 1, 1], radius_of_curvature=1.0, conic_constant=0.0),
            "at most 1.932 mm for lens 2, got 1.99",
        ),
        (
            # As an optimiser may leave them.
            Part(eqx.tree_at(lambda a: a.centers, lenses([[0, 0]], (3.0, 3.0)).array, np.array([[0, math.nan]]))),
            "`centers` must be finite",
        ),
        (lenses([[2, 0], [0, 0]], (3.0, 3.0)), "on a plate of 3 x 3 mm, got 1 outside"),
        (lenses([[0, 0]], (math.inf, math.inf)), "two positive lengths"),
    ],
)
def test_an_array_without_a_solid_is_refused(part, message):
    with pytest.raises(ValueError, match=message):
        array_solid(part)


@pytest.mark.parametrize(
    "chord, message",
    [
        *((chord, "`chord` must be positive and at most 0.02679 mm") for chord in (0.0, -1.0, math.nan, 0.1)),
        (1e-7, "takes about .* facets"),
    ],
)
def test_a_wrong_chord_error_is_refused(part, chord, message):
    with pytest.raises(ValueError, match=message):
        array_solid(part, chord)


SHAPES = [
    MoldShape(label="geomscope"),
    MoldShape(headroom=0.7, marks=False),
    MoldShape(draft=0.05),
    MoldShape(draft=0.1, headroom=0.4, shrinkage=0.013, label="x"),
]


@pytest.mark.parametrize("shape", SHAPES)
def test_the_mold_is_sound_and_the_cast_fills_it(part, solid, shape):
    mold, low_high = mold_solid(part, solid, shape), mold_bounds(part, shape)
    checks = check_solid(float32_mesh(mold), mold_volume(part, shape), "mold")
    assert [check for check in checks if check.level != "ok"] == []
    np.testing.assert_allclose(np.reshape(mold.bounding_box(), (2, 3)), low_high, atol=1e-12)
    cast = cast_solid(part, solid, shape)
    assert (mold ^ cast).volume() < 1e-9
    block = np.prod(np.diff(low_high, axis=0))
    engraved = sum((tool.trim_by_plane([0, 0, -1], -shape.headroom)).volume() for tool in engraving_tools(part, shape))
    # The same facets on both sides: rounding alone.
    np.testing.assert_allclose(mold.volume() + cast.volume() + engraved, block, rtol=1e-12)


def test_the_walls_open_by_the_draft(part, solid):
    shape = MoldShape(draft=0.1, headroom=0.5, marks=False)
    mold, high = mold_solid(part, solid, shape), mold_bounds(part, shape)[1]
    for height in (-0.5, 0.0, 0.4):
        opening = high[0] * high[1] * 4 - mold.slice(height).area()
        wider = 2 * (height + part.plate_thickness) * math.tan(0.1)
        # Sections are rounded to about 1e-8 mm.
        np.testing.assert_allclose(opening, (5.0 + wider) * (4.0 + wider), rtol=1e-7)


def test_the_marks_tell_the_corner_without_one(part, solid):
    shape = MoldShape(wall=3.0)
    high = mold_bounds(part, shape)[1]
    rim, corner = mold_solid(part, solid, shape).slice(-ENGRAVING_DEPTH / 2), m3.CrossSection.square([3.0, 3.0], True)
    full = {
        (sx, sy): (rim ^ corner.translate([sx * (high[0] - 1.5), sy * (high[1] - 1.5)])).area()
        for sx in (-1, 1)
        for sy in (-1, 1)
    }
    assert full.pop((1, 1)) == pytest.approx(9.0)
    # A cross of two bars, 1.8 mm long and 0.3 mm wide.
    assert list(full.values()) == pytest.approx([9.0 - 2 * 1.8 * 0.3 + 0.3**2] * 3)


@pytest.mark.parametrize("label", ["geomscope-p1", "$x_1$ & 50 %", "W" * 200, "q"])
def test_a_label_fits_on_the_rim(part, label):
    shape = MoldShape(label=label, marks=False)
    (tool,) = engraving_tools(part, shape)
    low, high = mold_bounds(part, shape)
    x0, y0, z0, x1, y1, _ = tool.bounding_box()
    assert low[0] + 4 <= x0 < x1 <= high[0] - 4 and low[1] < y0 < y1 < low[1] + 4
    assert z0 == pytest.approx(-ENGRAVING_DEPTH)


def test_a_label_that_cannot_be_drawn_is_left_out(part):
    for label in ("", "   ", "\n", "日本"):
        assert engraving_tools(part, MoldShape(label=label, marks=False)) == []


@pytest.mark.parametrize(
    "wrong",
    [{"wall": 0.0}, {"floor": -1.0}, {"headroom": -0.1}, {"draft": 1.0}, {"shrinkage": 0.5}, {"wall": math.nan}],
)
def test_a_wrong_shape_is_refused(wrong):
    with pytest.raises(ValueError, match=f"`{next(iter(wrong))}` must be"):
        MoldShape(**wrong)


# The opaque mask between lenses, as other programs read it.


DESIGNS = Path(__file__).parents[1] / "design"
# One alone, two that overlap, one across the edge of the plate; of three sizes.
ARRAY = MicrolensArray(
    [[-2.0, 1.0], [1.0, 0.0], [1.6, 0.0], [0.0, -3.0]], 2.0, 1.43, [0.8, 1.4, 1, 1], 1.0, size=(6.0, 6.0)
)
# Of two discs of radii 0.7 and 0.5, 0.6 apart: both less the lens that they share, of two segments on a chord.
CHORD_AT = (0.6**2 + 0.7**2 - 0.5**2) / (2 * 0.6)
SEGMENTS = [r**2 * math.acos(h / r) - h * math.sqrt(r**2 - h**2) for r, h in ((0.7, CHORD_AT), (0.5, 0.6 - CHORD_AT))]
PAIR = math.pi * (0.7**2 + 0.5**2) - sum(SEGMENTS)


def area(ring) -> float:
    x, y = np.asarray(ring).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def test_openings_are_the_lenses_on_the_plate():
    mask = make_mask(ARRAY)
    np.testing.assert_allclose(mask.circles, [[-2, 1, 0.8]])
    assert sum(map(area, mask.openings)) == pytest.approx(PAIR + math.pi / 8, rel=1e-3)
    assert max(np.abs(ring).max() for ring in mask.openings) <= 3
    low, high = mold_bounds(Part(ARRAY), MoldShape())
    np.testing.assert_allclose([mask.outline.min(0), mask.outline.max(0)], [low[:2], high[:2]])
    assert sum(map(area, mask.marks)) == pytest.approx(
        sum(plan.area() for plan in alignment_marks(Part(ARRAY), MoldShape()))
    )
    assert len(mask.marks) == 3


def test_dxf(tmp_path):
    write_mask(tmp_path / "a.dxf", make_mask(ARRAY))
    document = readfile(tmp_path / "a.dxf")
    assert document.units == 4 and not document.audit().errors  # mm
    found = {layer: [e for e in document.modelspace() if e.dxf.layer == layer] for layer in ("OPENINGS", "MARKS")}
    (circle,) = (e for e in found["OPENINGS"] if e.dxftype() == "CIRCLE")
    assert tuple(circle.dxf.center)[:2] == (-2, 1) and circle.dxf.radius == 0.4
    assert len(found["MARKS"]) == 3 and len(found["OPENINGS"]) == 3


def test_svg(tmp_path):
    write_mask(tmp_path / "a.svg", make_mask(ARRAY))
    root = ElementTree.parse(tmp_path / "a.svg").getroot()
    assert root.get("width") == f"{np.ptp(make_mask(ARRAY).outline[:, 0]):.10g}mm"
    (circle,) = root.iterfind(".//{*}circle")
    # The y axis of SVG points down, that of the drawing up.
    assert (circle.get("cx"), circle.get("cy"), circle.get("r")) == ("-2", "1", "0.4")
    (group,) = root
    assert group.get("transform") == "matrix(1 0 0 -1 0 0)"


def test_gds_has_polygons_without_holes(tmp_path):
    gdstk = pytest.importorskip("gdstk")
    ring = [(math.cos(a), math.sin(a)) for a in np.arange(6) * math.pi / 3]
    mask = make_mask(MicrolensArray(np.array(ring), 2.0, 1.43, 1.4, 1.0, size=(6.0, 6.0)))
    assert sorted(area(ring) > 0 for ring in mask.openings) == [False, True]
    write_mask(tmp_path / "a.gds", mask)
    library = gdstk.read_gds(tmp_path / "a.gds")
    (cell,) = library.cells
    found = sum(polygon.area() for polygon in cell.polygons if polygon.layer == 1)
    assert library.unit == 1e-6 and found == pytest.approx(1e6 * sum(map(area, mask.openings)), rel=1e-4)


def test_nothing_to_mask_is_said(tmp_path):
    covered = MicrolensArray([[0.0, 0.0], [0.5, 0.0]], 3.0, 1.43, 3.0, 1.0, size=(1.0, 1.0))
    with pytest.raises(InputError, match="lenses cover it"):
        make_mask(covered)
    result = CliRunner().invoke(commands, ["mask", str(DESIGNS / "geomscope.toml"), "-o", str(tmp_path / "a.svg")])
    assert isinstance(result.exception, InputError) and "geomscope.toml" in str(result.exception)
    assert not list(tmp_path.iterdir())


def test_the_command_draws_and_signs(tmp_path):
    path = tmp_path / "a.dxf"
    result = CliRunner().invoke(commands, ["mask", str(DESIGNS / "geomscope-optimized.toml"), "-o", str(path)])
    assert result.exit_code == 0 and "195 round openings and 5 others" in result.stdout
    assert read_provenance(path)["command"].startswith("gs-jax mask ")


# Files for makers and optical programs, as others read them: against the formula of the sag, and the mesh.


HEIGHTS_CENTERS = ((-1.1, 0.7), (0.9, -0.4), (0.2, 1.4), (1.3, 1.1))
SIZE = (4.0, 5.0)
STEP = 0.05
NM = 1e-6
# Conics and terms of both signs, and lenses with walls.
KINDS = {
    "plano": {},
    "curved": {"orientation": "curved"},
    "unlike": {
        "radius_of_curvature_mm": (2.0, 2.4, 2.0, 2.4),
        "conic_constant": (0.0, -1.0, 0.5, 0.0),
        "aperture_diameter_mm": (1.6, 1.4, 1.2, 1.6),
    },
    "curved asphere": {"orientation": "curved", "conic_constant": -0.6, "aspheric_terms": (2e-3, -1e-4)},
}


def design_of(kind: str) -> gs.Design:
    design = gs.geomscope()
    array = design.array.model_copy(update={"centers_mm": HEIGHTS_CENTERS, "size_mm": SIZE})
    lens = design.lens.model_copy(update={"aperture_diameter_mm": 1.6} | KINDS[kind])
    return design.model_copy(update={"array": array, "lens": lens})


def height(design: gs.Design, x, y):
    """Height above the plate at a point of the design, by the formula of ISO 10110-12; NaN on walls."""
    lens: Any = design.lens
    numbers = lens.radius_of_curvature_mm, lens.conic_constant, np.array(lens.aperture_diameter_mm) / 2
    lenses = list(zip(*(np.broadcast_to(each, len(HEIGHTS_CENTERS)) for each in numbers), strict=True))

    def sag(r, radius, conic):
        c = 1 / radius
        terms = sum(a * r**order for order, a in zip((4, 6), lens.aspheric_terms or (), strict=False))
        return c * r**2 / (1 + np.sqrt(1 - (1 + conic) * c**2 * r**2)) + terms

    top = max(sag(edge, *shape) for *shape, edge in lenses)
    found, walls = (np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y))) for _ in range(2))
    for (cx, cy), (*shape, edge) in zip(HEIGHTS_CENTERS, lenses, strict=True):
        r, rim = np.hypot(x - cx, y - cy), top - sag(edge, *shape)
        found = np.maximum(found, np.where(r <= edge, top - sag(np.minimum(r, edge), *shape), 0))
        walls = np.maximum(walls, np.where((r > edge) & (r < edge + rim * math.tan(math.radians(5.1))), rim, 0))
    return np.where(walls > found + NM, np.nan, found), top


def axes(count, step=STEP):
    return (np.arange(count) - (count - 1) / 2) * step


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


def test_maps_show_the_side_of_the_lenses(kind, tmp_path):
    design = design_of(kind)
    # From the sensor the design's y points down, from the object up.
    down = design.lens.orientation == "plano"
    y, x = np.meshgrid(axes(101) * (1 if down else -1), axes(81), indexing="ij")
    expected, top = height(design, x, y)
    compared = np.isfinite(expected)
    assert np.mean(compared) > 0.9

    write_heights(design, tmp_path / "a.tif", step=STEP)
    with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
        page = tiff.pages.first
        numerator, denominator = page.tags["XResolution"].value
        assert numerator / denominator == pytest.approx(10 / STEP) and page.tags["ResolutionUnit"].value == 3
        pixels = page.asarray()
    assert pixels.dtype == np.float32
    np.testing.assert_allclose(pixels[compared], expected[compared], atol=NM)

    report = write_heights(design, tmp_path / "a.png", step=STEP)
    with Image.open(tmp_path / "a.png") as image:
        scale, pixels = json.loads(image.info["mm_per_count"]), np.asarray(image)
    assert pixels.dtype == np.uint16 and scale == report["mm_per_count"] == pytest.approx(top / 65535)
    np.testing.assert_allclose(pixels[compared] * scale, expected[compared], atol=scale / 2 + NM)

    write_heights(design, tmp_path / "a.xyz", step=STEP)
    right, up, out = np.loadtxt(tmp_path / "a.xyz").T
    expected, _ = height(design, right, -up if down else up)
    compared = np.isfinite(expected)
    np.testing.assert_allclose(out[compared], expected[compared], atol=NM)


def test_a_grid_sag_has_z_along_the_light(kind, tmp_path):
    design = design_of(kind)
    write_heights(design, tmp_path / "a.dat", step=STEP)
    first, *_ = (tmp_path / "a.dat").read_text().split("\n")
    assert first == "81 101 0.05 0.05 0 0 0"
    z, dx, dy, dxdy, flag = np.loadtxt(tmp_path / "a.dat", skiprows=1).T.reshape(5, 101, 81)
    assert not flag.any()
    # OpticStudio begins at the least x and the largest y.
    y, x = np.meshgrid(-axes(101), axes(81), indexing="ij")
    toward = 1 if design.lens.orientation == "plano" else -1
    along = lambda x, y: toward * (height(design, x, -y)[0] - height(design, x, -y)[1])
    expected = along(x, y)
    compared = np.isfinite(expected)
    np.testing.assert_allclose(z[compared], expected[compared], atol=NM)
    # Around the vertices, where differences do not cross an edge. The steps leave errors of 1e-6.
    h = 1e-4
    smooth = np.min([np.hypot(x - cx, -y - cy) for cx, cy in HEIGHTS_CENTERS], axis=0) < 0.4
    assert smooth.sum() > 500
    slopes = (along(x + h, y) - along(x - h, y)) / (2 * h), (along(x, y + h) - along(x, y - h)) / (2 * h)
    corners = along(x + h, y + h) - along(x + h, y - h) - along(x - h, y + h) + along(x - h, y - h)
    for found, value in ((dx, slopes[0]), (dy, slopes[1]), (dxdy, corners / (4 * h**2))):
        np.testing.assert_allclose(found[smooth], value[smooth], atol=1e-5)


def test_the_list_of_lenses_is_the_surface(kind, tmp_path):
    design = design_of(kind)
    write_heights(design, tmp_path / "a.csv")
    with open(tmp_path / "a.csv", newline="") as file:
        plate, *lenses = csv.DictReader(file)
    assert plate["object_type"] == "Rectangular Volume" and len(lenses) == len(HEIGHTS_CENTERS)
    assert [(float(lens["x_mm"]), -float(lens["y_mm"])) for lens in lenses] == list(HEIGHTS_CENTERS)
    # Where the vertices and the plano face are, along the light.
    front, thickness = float(plate["z_mm"]), float(plate["thickness_mm"])
    t = design.array.substrate_thickness_mm
    is_front = design.lens.orientation == "curved"
    assert (front + thickness if is_front else front) == pytest.approx(t if is_front else -t, abs=NM)
    for lens, radius in zip(
        lenses, np.broadcast_to(design.lens.radius_of_curvature_mm, len(HEIGHTS_CENTERS)), strict=True
    ):
        vertex = float(lens["z_mm"]) + (0 if is_front else float(lens["thickness_mm"]))
        assert vertex == pytest.approx(0, abs=NM)
        assert float(lens["radius_1_mm" if is_front else "radius_2_mm"]) == (radius if is_front else -radius)
        assert float(lens["radius_2_mm" if is_front else "radius_1_mm"]) == 0


def test_the_map_is_that_of_the_mesh(tmp_path):
    """Vertices of the array that is printed are in the map, whose rows run along the y of the part."""
    for kind in ("plano", "curved"):
        design = design_of(kind)
        gs.make_mold(design, tmp_path / "a.stl", positive=True, chord=0.003)
        report = write_heights(design, tmp_path / "a.tif", step=STEP)
        x, y, z = np.asarray(trimesh.load_mesh(tmp_path / "a.stl").vertices, float).T
        plate = report["plate_thickness_mm"] - report["vertex_height_mm"]
        on_lenses = -z > plate + 0.01
        heights = RegularGridInterpolator((axes(101), axes(81)), tifffile.imread(tmp_path / "a.tif"))
        difference = heights(np.stack([y, x], axis=1)[on_lenses]) - (-z - plate)[on_lenses]
        # Within the chord; in grooves, interpolation is worse.
        assert on_lenses.sum() > 300 and np.mean(np.abs(difference) < 0.004) > 0.75


def test_the_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    gs.write_design("d.toml", design_of("curved"))
    run = lambda *arguments: CliRunner().invoke(commands, ["heights", "d.toml", *map(str, arguments)])
    for suffix in HEIGHT_SUFFIXES:
        done = run("-o", f"a{suffix}", *(() if suffix == ".csv" else ("--step-um", 50)))
        assert done.exit_code == 0 and "read back" in done.output, done.output
        assert "heights d.toml" in read_provenance(f"a{suffix}")["command"]
        about = json.loads((tmp_path / f"a{suffix}.json").read_text())
        assert about["lenses_face"] == "the object" and about["deviation_nm"] < (3 if suffix == ".png" else 0.5)
    for arguments, words in {
        ("-o", "a.step"): "suffix must be .tif, .png, .xyz, .dat, .csv, got '.step'",
        ("-o", "b.xyz", "--step-um", "0.5"): "step of the grid must be at least .* got 0.5 um: 8001 x 10001 points",
        ("-o", "a.csv"): "a.csv: the output must be a new file",
    }.items():
        with pytest.raises(gs.InputError, match=words):
            CliRunner().invoke(
                commands, ["heights", "d.toml", *arguments], catch_exceptions=False, standalone_mode=False
            )
    with pytest.raises(gs.InputError, match="step of the grid must be at most 1000 um, got 1001 um"):
        write_heights("d.toml", "b.tif", step=1.001)
    done = run("-o", "a.csv", "--force")
    assert "gs-jax: replaced a.csv, a.csv.json" in done.stderr
    design = design_of("plano")
    ideal = design.model_copy(update={"lens": design.lens.model_copy(update={"focal_length_mm": 4.0})})
    with pytest.raises(gs.InputError, match=r"`lens.focal_length_mm` must be R / \(n - 1\) = 4.651 mm, .* got 4"):
        write_heights(ideal, "b.tif")
    assert not list(tmp_path.glob("b.*"))
