"""The array and its mold as solids: what they are, not how they are triangulated."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import manifold3d as m3
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import quad

from gs_jax import MicrolensArray
from gs_jax.design.design import read_design
from gs_jax.mold.export import float32_mesh, make_mask
from gs_jax.mold.lenslets import DRAFT, Lenslet, Part, tessellate
from gs_jax.mold.manufacturability import check_solid
from gs_jax.mold.measurement import measure_lenslets
from gs_jax.mold.solids import (
    ENGRAVING_DEPTH,
    MoldShape,
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
