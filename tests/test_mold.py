"""The array and its mold as solids: what they are, not how they are triangulated."""

import math

import equinox as eqx
import jax
import manifold3d as m3
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from gs_jax import MicrolensArray
from gs_jax.design.design import read_design
from gs_jax.mold.export import float32_mesh
from gs_jax.mold.lenslets import lenslet_height, lenslets_of, surface_height
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
    plate_thickness,
    volume_tolerance,
)

from .helpers import aperture_edge, needs

CHORD = 2e-3


def lenses(centers, size, *, diameter=2.0, radius=2.0, thickness=1.0):
    return MicrolensArray(
        np.array(centers, float),
        radius_of_curvature=radius,
        aperture_diameter=diameter,
        substrate_thickness=thickness,
        size=size,
    )


def random_lenses(count=12, size=(5.0, 4.0), seed=0):
    return lenses(np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 2)) * size, size)


def lattice(spacing, *, hexagonal=False):
    i, j = np.meshgrid(np.arange(-2, 3), np.arange(-2, 3))
    shear, row = (0.5, math.sqrt(3) / 2) if hexagonal else (0.0, 1.0)
    return spacing * np.stack([i + shear * j, row * j], axis=-1).reshape(-1, 2)


def assert_sound(array, chord=CHORD):
    """Watertight, manifold, one body without handles, of the right volume, once rounded to float32."""
    mesh = float32_mesh(array_solid(array, chord))
    findings = check_solid(mesh, array_volume(array), "array", volume_tolerance(array, chord))
    assert [finding for finding in findings if finding.level != "ok"] == []
    return mesh


def test_a_single_lens_has_the_volume_of_the_formula():
    array = lenses([[0.2, -0.1]], (3.0, 2.6))
    part, sag = array_solid(array, 5e-4), lenslet_height(array)
    assert part.status() == m3.Error.NoError and part.genus() == 0
    expected = 3.0 * 2.6 * plate_thickness(array) + math.pi * sag**2 * (3 * 2.0 - sag) / 3
    # 1e-4 of the volume is what is promised at a chord error of 0.5 um.
    np.testing.assert_allclose(part.volume(), expected, rtol=1e-4)
    np.testing.assert_allclose(array_volume(array), expected, rtol=1e-13)


def test_the_part_lies_in_the_designs_frame():
    array = random_lenses()
    x0, y0, z0, x1, y1, z1 = array_solid(array, CHORD).bounding_box()
    assert (x0, y0, x1, y1, z1) == (-2.5, -2.0, 2.5, 2.0, 0.0)
    # The vertices are at -t, but for the lift, which is below the chord error.
    assert -1.0 - CHORD < z0 < -1.0


def test_the_caps_volume_agrees_with_a_sum_over_directions():
    array = random_lenses()
    angles = (np.arange(20_000) + 0.5) * 2 * math.pi / 20_000
    edge = aperture_edge(array, angles)
    base = math.sqrt(3.0)
    inner = (8 - (4 - edge**2) ** 1.5) / 3 - base * edge**2 / 2
    # A midpoint rule on a function with kinks: 1 / count^2.
    np.testing.assert_allclose(lenslets_volume(array), inner.sum() * 2 * math.pi / 20_000, rtol=1e-7)
    x, y = ((np.arange(1000) + 0.5) / 1000 * side - side / 2 for side in array.plate)
    height, _ = surface_height(lenslets_of(array), np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    # Rims and grooves are kinks, not steps: a midpoint rule on a million points.
    np.testing.assert_allclose(lenslets_volume(array), height.mean() * 20.0, rtol=1e-5)


def lens_facets(array):
    """Corners `(facet, corner, 3)` of the facets that are not the plano face's or the sides'; doubled areas from above.

    Heights are those over the base, lenses up.
    """
    mesh = float32_mesh(array_solid(array, CHORD))
    corners = mesh.vertices[mesh.facets].astype(float)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    down = normal[:, 2] < -1e-5 * np.linalg.norm(normal, axis=1)
    return corners[down] * (1, 1, -1) - (0, 0, plate_thickness(array)), -normal[down, 2]


def test_facets_of_lenses_face_outward_and_cover_the_plate():
    _, doubled = lens_facets(random_lenses())
    # float32, ten thousand facets; none of them is overlapped by another.
    np.testing.assert_allclose(doubled.sum() / 2, 20.0, rtol=1e-6)


def test_facets_are_within_the_chord_error():
    """Of whichever lens they are nearest to, to first order."""
    array = random_lenses()
    corners, _ = lens_facets(array)
    points = np.einsum("qk,fkx->fqx", np.random.default_rng(1).dirichlet([1, 1, 1], 40), corners).reshape(-1, 3)
    flat = np.repeat((corners[..., 2] < 1e-6).all(axis=1), 40)
    distances = []
    for lens in lenslets_of(array):
        squared = ((points[~flat, :2] - lens.center) ** 2).sum(axis=1)
        # The edge's corners are a little outside its circle.
        here = squared <= (lens.semi_aperture + CHORD) ** 2
        squared = np.where(here, squared, 0)
        off = points[~flat, 2] - lenslet_height(array) + lens.sag(squared)
        distances.append(np.where(here, off / np.sqrt(1 + squared * lens.sag_slope_over_r(squared) ** 2), np.inf))
    distance = np.take_along_axis(np.array(distances), np.abs(distances).argmin(axis=0)[None], axis=0)
    assert -CHORD < distance.min() and distance.max() < CHORD
    # The lift makes the mean zero up to the rims, which stay in the plate's plane.
    assert abs(distance.mean()) < CHORD / 10
    # float32: the plate is flat.
    assert np.abs(points[flat, 2]).max() < 1e-7


@pytest.mark.parametrize(
    "centers, size",
    [
        pytest.param([[0, 0]], (1.0, 1.0), id="lens covers the plate"),
        pytest.param([[0, 0]], (2.0, 2.0), id="rim touches the plate's edges"),
        pytest.param([[0, 0]], (math.sqrt(2), math.sqrt(2)), id="rim through the plate's corners"),
        pytest.param([[1.5, 1.5]], (3.0, 3.0), id="lens on a corner"),
        pytest.param([[0, 1.5], [0, 0]], (3.0, 3.0), id="lens on an edge"),
        pytest.param([[-1, 0], [1, 0]], (5.0, 5.0), id="lenses touch"),
        pytest.param([[-1 - 1e-6, 0], [1, 0]], (5.0, 5.0), id="1 nm apart"),
        pytest.param([[-1 - 3e-5, 0], [1, 0]], (5.0, 5.0), id="30 nm apart"),
        pytest.param([[-1 + 1e-6, 0], [1, 0]], (5.0, 5.0), id="1 nm overlap"),
        pytest.param([[0, 0], [0.001, 0], [0, 0.001]], (3.0, 3.0), id="1 um apart"),
        pytest.param(lattice(2.0), (10.0, 10.0), id="square lattice, lenses touch"),
        pytest.param(lattice(math.sqrt(2)), (7.0, 7.0), id="square lattice, rims meet at corners"),
        pytest.param(lattice(math.sqrt(2) + 1e-5), (7.0, 7.0), id="square lattice, gaps of 10 nm"),
        pytest.param(lattice(2.0, hexagonal=True), (12.0, 9.0), id="hexagonal, lenses touch"),
        pytest.param(lattice(math.sqrt(3), hexagonal=True), (12.0, 9.0), id="hexagonal, rims meet at corners"),
        pytest.param(lattice(1.2, hexagonal=True), (8.0, 6.0), id="hexagonal, covers"),
    ],
)
def test_degenerate_layouts_are_sound(centers, size):
    assert_sound(lenses(centers, size))


@pytest.mark.integration
@settings(max_examples=25, deadline=None)
@given(
    count=st.integers(1, 30),
    width=st.floats(0.5, 6.0),
    height=st.floats(0.5, 6.0),
    slope=st.floats(0.2, 1.3),
    grid=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_any_layout_is_sound(count, width, height, slope, grid, seed):
    centers = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 2)) * (width, height)
    if grid:
        centers = np.unique(np.clip(centers.round(1), -width / 2, -width / 2 + width).round(1) * 0.9, axis=0)
        centers = centers[(np.abs(centers) <= (width / 2, height / 2)).all(axis=1)]
        centers = centers if len(centers) else np.zeros((1, 2))
    array = lenses(centers, (width, height), diameter=4 * math.sin(slope), thickness=2.5)
    assert_sound(array, chord=lenslet_height(array) / 30)


def test_lenses_in_float32_are_sound():
    with jax.enable_x64(False):
        assert_sound(random_lenses())


@pytest.mark.integration
def test_the_paper_s_array():
    array = read_design(needs("oracle/dev/P1.toml")).imager().array
    mesh = assert_sound(array, chord=5e-4)
    off = abs(mesh.solid().volume() / array_volume(array) - 1)
    # The bar is 1e-4; the lift brings it to 2e-6.
    assert off < 1e-5
    assert len(mesh.facets) < 250_000
    found = measure_lenslets(mesh, array)
    np.testing.assert_allclose(found.center, np.asarray(array.centers), atol=1e-3)
    np.testing.assert_allclose(found.radius, 2.0, rtol=1e-3)


@pytest.mark.slow
def test_two_thousand_lenses():
    i, j = np.meshgrid(np.arange(45), np.arange(45))
    grid = 1.33 * (np.stack([i, j], axis=-1).reshape(-1, 2) - 22)
    moved = grid + np.random.default_rng(0).uniform(-0.4, 0.4, grid.shape)
    assert_sound(lenses(moved[:2000], (60.0, 60.0)), chord=5e-4)


@pytest.mark.parametrize(
    "array, message",
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
            # As an optimiser may leave them.
            eqx.tree_at(lambda array: array.centers, lenses([[0, 0]], (3.0, 3.0)), np.array([[0, math.nan]])),
            "`centers` must be finite",
        ),
        (lenses([[2, 0], [0, 0]], (3.0, 3.0)), "on a plate of 3 x 3 mm, got 1 outside"),
        (lenses([[0, 0]], (math.inf, math.inf)), "two positive lengths"),
    ],
)
def test_what_has_no_solid_is_refused_in_words(array, message):
    with pytest.raises(ValueError, match=message):
        array_solid(array)


@pytest.mark.parametrize(
    "chord, message",
    [
        *((chord, "`chord` must be positive and at most 0.02679 mm") for chord in (0.0, -1.0, math.nan, 0.1)),
        (1e-7, "takes about .* facets"),
    ],
)
def test_a_wrong_chord_error_is_refused(chord, message):
    with pytest.raises(ValueError, match=message):
        array_solid(random_lenses(), chord)


SHAPES = [
    MoldShape(label="geomscope"),
    MoldShape(headroom=0.7, marks=False),
    MoldShape(draft=0.05),
    MoldShape(draft=0.1, headroom=0.4, shrinkage=0.013, label="x"),
]


@pytest.mark.parametrize("shape", SHAPES)
def test_the_mold_is_sound_and_the_cast_fills_it(shape):
    array = random_lenses()
    part = array_solid(array, CHORD)
    mold, low_high = mold_solid(array, part, shape), mold_bounds(array, shape)
    findings = check_solid(float32_mesh(mold), mold_volume(array, shape), "mold")
    assert [finding for finding in findings if finding.level != "ok"] == []
    np.testing.assert_allclose(np.reshape(mold.bounding_box(), (2, 3)), low_high, atol=1e-12)
    cast = cast_solid(array, part, shape)
    assert (mold ^ cast).volume() < 1e-9
    block = np.prod(np.diff(low_high, axis=0))
    engraved = sum((tool.trim_by_plane([0, 0, -1], -shape.headroom)).volume() for tool in engraving_tools(array, shape))
    # The same facets on both sides: rounding alone.
    np.testing.assert_allclose(mold.volume() + cast.volume() + engraved, block, rtol=1e-12)


def test_shrinkage_is_made_up_for():
    array = random_lenses()
    part = array_solid(array, CHORD)
    cast = cast_solid(array, part, MoldShape(shrinkage=0.02))
    np.testing.assert_allclose(cast.volume() * 0.98**3, part.volume(), rtol=1e-12)
    # A point of the cast returns to its place when it shrinks about the origin.
    np.testing.assert_allclose(np.array(cast.bounding_box()) * 0.98, part.bounding_box(), rtol=1e-12)


def test_the_walls_open_by_the_draft():
    array, shape = random_lenses(), MoldShape(draft=0.1, headroom=0.5, marks=False)
    mold = mold_solid(array, array_solid(array, CHORD), shape)
    high = mold_bounds(array, shape)[1]
    for height in (-0.5, 0.0, 0.4):
        opening = high[0] * high[1] * 4 - mold.slice(height).area()
        wider = 2 * (height + plate_thickness(array)) * math.tan(0.1)
        # Sections are rounded to about 1e-8 mm.
        np.testing.assert_allclose(opening, (5.0 + wider) * (4.0 + wider), rtol=1e-7)


def test_the_marks_tell_the_corner_without_one():
    array, shape = random_lenses(), MoldShape(wall=3.0)
    high = mold_bounds(array, shape)[1]
    rim = mold_solid(array, array_solid(array, CHORD), shape).slice(-ENGRAVING_DEPTH / 2)
    outline = lambda sx, sy: m3.CrossSection.square([3.0, 3.0], center=True).translate(
        [sx * (high[0] - 1.5), sy * (high[1] - 1.5)]
    )
    full = {(sx, sy): (rim ^ outline(sx, sy)).area() for sx in (-1, 1) for sy in (-1, 1)}
    assert full.pop((1, 1)) == pytest.approx(9.0)
    # A cross of two bars, 1.8 mm long and 0.3 mm wide.
    assert list(full.values()) == pytest.approx([9.0 - 2 * 1.8 * 0.3 + 0.3**2] * 3)


@pytest.mark.parametrize("label", ["geomscope-p1", "$x_1$ & 50 %", "W" * 200, "q"])
def test_a_label_fits_on_the_rim(label):
    array, shape = random_lenses(), MoldShape(label=label, marks=False)
    (tool,) = engraving_tools(array, shape)
    low, high = mold_bounds(array, shape)
    x0, y0, z0, x1, y1, _ = tool.bounding_box()
    assert low[0] + 4 <= x0 < x1 <= high[0] - 4 and low[1] < y0 < y1 < low[1] + 4
    assert z0 == pytest.approx(-ENGRAVING_DEPTH)


@pytest.mark.parametrize("label", ["", "   ", "\n", "日本"])
def test_a_label_that_cannot_be_drawn_is_left_out(label):
    assert engraving_tools(random_lenses(), MoldShape(label=label, marks=False)) == []


@pytest.mark.parametrize(
    "wrong",
    [{"wall": 0.0}, {"floor": -1.0}, {"headroom": -0.1}, {"draft": 1.0}, {"shrinkage": 0.5}, {"wall": math.nan}],
)
def test_a_wrong_shape_is_refused(wrong):
    with pytest.raises(ValueError, match=f"`{next(iter(wrong))}` must be"):
        MoldShape(**wrong)
