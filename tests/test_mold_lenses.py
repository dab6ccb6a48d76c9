"""Molds of lenses that are no spheres, that differ, and that face the object."""

import dataclasses
import json
import math
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import quad

from gs_jax import Imager, MicrolensArray, Sensor
from gs_jax.codesign import search_report
from gs_jax.design.design import Design
from gs_jax.io.files import checkpoint_path, side_file
from gs_jax.io.provenance import KEY, read_provenance
from gs_jax.mold import make
from gs_jax.mold.export import float32_mesh, make_mask
from gs_jax.mold.lenslets import DRAFT, Lenslet, lenslet_height, lenslets_of, tessellate, visible_radii
from gs_jax.mold.make import check_measurement, draw_preview, make_mold
from gs_jax.mold.manufacturability import check_design, check_solid
from gs_jax.mold.measurement import measure_lenslets, summarize
from gs_jax.mold.solids import (
    MoldShape,
    array_solid,
    array_volume,
    default_chord,
    lenslets_volume,
    max_chord,
    mold_solid,
    mold_volume,
    plate_thickness,
    volume_tolerance,
)

from .test_mold_files import behind
from .test_mold_report import design

CHORD = 2e-3
CENTERS = np.array([[-0.9, -0.6], [0.4, -0.7], [1.2, 0.5], [-0.3, 0.6], [-1.5, 0.9]])
RADII = np.array([1.6, 2.0, 2.4, 1.8, 2.2])
CONICS = np.array([0.0, -1.0, -0.5, 0.2, -1.6])
DIAMETERS = np.array([1.4, 1.5, 1.1, 1.6, 0.9])


def unequal(**changes) -> MicrolensArray:
    numbers = {"radius_of_curvature": RADII, "conic_constant": CONICS, "aperture_diameter": DIAMETERS}
    return MicrolensArray(**{"centers": CENTERS, "size": (4.0, 3.0), **numbers, **changes})


def heights(array, x, y):
    """The highest lens over the land on a grid, by the definition: conics to their discs, then walls."""
    k, r, reach = (
        np.asarray(array.of_lenses(n)) for n in ("conic_constant", "radius_of_curvature", "aperture_diameter")
    )
    reach = reach / 2
    fall = lambda i, rho: rho**2 / (r[i] + np.sqrt(r[i] ** 2 - (1 + k[i]) * rho**2))
    land = max(fall(i, reach[i]) for i in range(len(r)))
    best = np.zeros((len(x), len(y)))
    for i, center in enumerate(np.asarray(array.centers)):
        rho = np.hypot(x[:, None] - center[0], y - center[1])
        wall = np.maximum(rho - reach[i], 0) / math.tan(DRAFT)
        best = np.maximum(best, land - fall(i, np.minimum(rho, reach[i])) - wall)
    return best


def assert_sound(array, chord=CHORD, shape=MoldShape()):
    part = array_solid(array, chord)
    tolerance = volume_tolerance(array, chord)
    mold = mold_solid(array, part, shape)
    findings = [
        *check_solid(float32_mesh(part), array_volume(array), "array", tolerance),
        *check_solid(float32_mesh(mold), mold_volume(array, shape), "mold", tolerance),
    ]
    assert [finding for finding in findings if finding.level != "ok"] == []
    return float32_mesh(mold)


@pytest.mark.parametrize("conic, terms", [(-1.0, ()), (0.3, ()), (-0.7, (0.02, -0.01)), (0.0, (-0.03,))])
def test_one_lens_of_any_profile_has_its_volume(conic, terms):
    array = MicrolensArray([[0.1, 0.0]], size=(3.0, 2.6), conic_constant=conic, aspheric_terms=terms)
    (cap,) = lenslets_of(array)
    held, _ = quad(lambda r: 2 * math.pi * r * (cap.rim_sag - float(cap.sag(np.array([r**2]))[0])), 0, 1, epsabs=1e-13)
    np.testing.assert_allclose(lenslets_volume(array), held, rtol=1e-10)
    part = array_solid(array, 5e-4)
    np.testing.assert_allclose(part.volume(), array_volume(array), rtol=1e-5)
    assert_sound(array)


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
    found = tessellate(cap, cap.semi_aperture, CHORD)
    corners = np.column_stack([found.points, -found.sag])[found.facets]
    weights = np.random.default_rng(1).dirichlet([1, 1, 1], 60)
    points = np.einsum("qk,fkx->fqx", weights, corners).reshape(-1, 3)
    squared = (points[:, :2] ** 2).sum(axis=1)
    off = (points[:, 2] + cap.sag(squared)) / np.sqrt(1 + squared * cap.sag_slope_over_r(squared) ** 2)
    assert -CHORD < off.min() and off.max() < CHORD
    assert abs(off.mean()) < CHORD / 10


def test_the_volume_of_unequal_lenses_is_that_of_the_highest():
    array = unequal()
    x, y = ((np.arange(2400) + 0.5) / 2400 * side - side / 2 for side in array.plate)
    # Walls are steps of 0.1 mm on a few hundredths of a percent of the places.
    np.testing.assert_allclose(lenslets_volume(array), heights(array, x, y).mean() * 12, rtol=2e-5)
    assert_sound(array)
    np.testing.assert_allclose(array_solid(array, 2e-4).volume(), array_volume(array), rtol=2e-5)


def test_lists_of_equal_numbers_are_one_number():
    one = MicrolensArray(CENTERS, aperture_diameter=1.5, size=(4.0, 3.0))
    each = dataclasses.replace(one, radius_of_curvature=[2.0], conic_constant=[0.0], types=np.zeros(5, int))
    same = [float32_mesh(array_solid(array, CHORD)) for array in (one, each)]
    np.testing.assert_array_equal(same[0].vertices, same[1].vertices)
    np.testing.assert_array_equal(same[0].facets, same[1].facets)
    # Quadrature over the cells' sectors, and over a grid.
    np.testing.assert_allclose(lenslets_volume(one), lenslets_volume(each), rtol=1e-6)


def test_lenses_meet_where_their_sags_are_equal():
    """Paraboloids meet where `r_1^2 / R_1 = r_2^2 / R_2`: on a circle of Apollonius, not half way."""
    array = MicrolensArray([[-0.5, 0], [0.5, 0]], [1.5, 3.0], 1.43, 1.6, size=(3.0, 2.0), conic_constant=-1.0)
    mesh = float32_mesh(array_solid(array, 1e-4))
    groove = -0.5 + 1 / (1 + math.sqrt(2))
    top = mesh.vertices[(np.abs(mesh.vertices[:, 1]) < 0.02) & (np.abs(mesh.vertices[:, 0]) < 0.4)]
    top = top[top[:, 2] < -0.7]
    assert abs(top[top[:, 2].argmax(), 0] - groove) < 0.02


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({"orientation": "curved"}, id="curved side to the object"),
        pytest.param({"aspheric_terms": [0.01, -0.004]}, id="aspheric terms"),
        pytest.param({"aperture_diameter": 1.5, "conic_constant": 0.0}, id="radii alone"),
        pytest.param({"radius_of_curvature": 2.0, "conic_constant": 0.0}, id="apertures alone"),
        pytest.param(
            {"centers": [[0, 0], [0.2, 0.1]], "aperture_diameter": [2.4, 0.6], "radius_of_curvature": [3.0, 2.0]}
            | {"conic_constant": 0.0},
            id="a small lens within a large one",
        ),
        pytest.param(
            {"centers": [[-1, 0], [0, 0], [1, 0]], "aperture_diameter": 1.0, "radius_of_curvature": [1.0, 1.0, 2.0]}
            | {"conic_constant": 0.0},
            id="walls touch",
        ),
        pytest.param(
            {"centers": [[-1, 0], [0, 0], [1, 0]], "aperture_diameter": 1.0, "conic_constant": [-1.0, -1.0, 0.0]}
            | {"radius_of_curvature": [3.0, 3.0, 1.0]},
            id="high walls touch",
        ),
    ],
)
def test_molds_of_unequal_lenses_are_sound(changes):
    assert_sound(unequal(**changes), shape=MoldShape(shrinkage=0.01, label="x"))


@pytest.mark.integration
@settings(max_examples=8, deadline=None)
@given(
    count=st.integers(1, 12),
    width=st.floats(1.0, 4.0),
    height=st.floats(1.0, 4.0),
    lattice=st.booleans(),
    term=st.floats(-0.02, 0.1),
    seed=st.integers(0, 2**31),
)
def test_any_lenses_are_sound(count, width, height, lattice, term, seed):
    random = np.random.default_rng(seed)
    centers = random.uniform(-0.5, 0.5, (count, 2)) * (width, height)
    if lattice:
        centers = np.unique(np.trunc(centers * 2) / 2, axis=0)
    draw = lambda low, high: random.uniform(low, high, len(centers)).round(1 if lattice else 9)
    array = MicrolensArray(
        centers,
        radius_of_curvature=draw(1.0, 3.0),
        aperture_diameter=draw(0.3, 1.4),
        conic_constant=draw(-2.0, 0.3),
        aspheric_terms=[term],
        substrate_thickness=2.0,
        size=(width, height),
    )
    assert_sound(array, max_chord(lenslets_of(array)) / 3)


@pytest.mark.parametrize("orientation", ["plano", "curved"])
def test_radius_and_conic_are_read_back(orientation):
    array = unequal(orientation=orientation)
    found = measure_lenslets(assert_sound(array, 2e-4), array)
    mirrored = CENTERS * (1, -1 if orientation == "curved" else 1)
    np.testing.assert_allclose(found.center, mirrored, atol=1e-5)
    # The lift is a tenth of a micrometre.
    np.testing.assert_allclose(found.radius, RADII, rtol=3e-4)
    np.testing.assert_allclose(found.conic, CONICS, atol=2e-3)
    assert (found.conic_deviation < 1e-3).all()
    measured = summarize(found, behind(array))
    assert measured["lenses_conic_measured"] == 5 and measured["conic_deviation_max"] < 2e-3
    assert check_measurement(measured, chord=2e-4, radius=1.6)[0].level == "ok"


def test_another_conic_is_found():
    array = unequal()
    other = unequal(conic_constant=CONICS + 0.3)
    # The land is at the deepest rim: the vertices are where they were.
    found = measure_lenslets(float32_mesh(array_solid(other, 2e-4)), array)
    np.testing.assert_allclose(found.conic, CONICS + 0.3, atol=3e-3)
    assert check_measurement(summarize(found, behind(array)), chord=2e-4, radius=1.6)[0].level == "error"


def test_a_small_aperture_does_not_say_its_conic():
    array = MicrolensArray([[-0.5, 0], [0.5, 0]], 2.0, 1.43, [0.2, 0.9], size=(2.0, 1.0), conic_constant=-1.0)
    found = measure_lenslets(float32_mesh(array_solid(array, 5e-5)), array)
    assert np.isnan(found.conic).tolist() == [True, False]
    np.testing.assert_allclose(found.radius, 2.0, rtol=1e-3)
    text = check_measurement(summarize(found, behind(array)), chord=5e-5, radius=2.0)[0].text
    assert "conic constants of 1 within" in text


def test_a_part_whose_curved_side_faces_the_object_is_turned_over_and_not_mirrored():
    plano, curved = unequal(), unequal(orientation="curved")
    part = array_solid(curved, CHORD)
    # As it stands before the sensor: turned back about x, its lenses look toward +z, at the design's places.
    standing = part.rotate([180, 0, 0])
    assert standing.bounding_box()[5] == pytest.approx(1.0, abs=CHORD)
    up = array_solid(plano, CHORD).mirror([0, 0, 1])
    # Other facets of the same lenses, seen in the mirror from below.
    assert (standing - up).volume() + (up - standing).volume() < 1e-3 * up.volume()
    np.testing.assert_allclose(make_mask(curved).circles[:, :2], make_mask(plano).circles[:, :2] * (1, -1))


def test_what_neighbours_hide_is_not_facetted():
    near = MicrolensArray(CENTERS[:3], 2.0, 1.43, 1.5, size=(4.0, 3.0))
    assert visible_radii(lenslets_of(near), near.plate) == pytest.approx([0.75] * 3)
    i, j = np.meshgrid(np.arange(-3, 4), np.arange(-3, 4))
    dense = MicrolensArray(0.4 * np.stack([i, j], axis=-1).reshape(-1, 2), 2.0, 1.43, 2.0, size=(2.8, 2.8))
    reaches = visible_radii(lenslets_of(dense), dense.plate)
    # A cell's corner, and a tile or two.
    assert 0.2 * math.sqrt(2) < max(reaches) < 0.36
    assert_sound(dense)


class UnequalDesign(Design):
    """A design of lenses that differ, as far as the part is concerned."""

    def imager(self, sample=None, wavelength_nm=None):
        imager = super().imager(sample, wavelength_nm)
        own = {"radius_of_curvature": [2.0, 1.7], "conic_constant": [0.0, -1.0], "aperture_diameter": [1.4, 1.0]}
        return dataclasses.replace(imager, array=dataclasses.replace(imager.array, **own))


def test_a_design_of_unequal_lenses_is_made(tmp_path):
    data = design(lens={"orientation": "curved"}).model_dump(exclude_defaults=True)
    report = make_mold(UnequalDesign.model_validate(data), tmp_path / "a.stl", chord=1e-3)
    np.testing.assert_allclose(report["lens_radius_mm"], [2.0, 1.7], rtol=1e-3)
    np.testing.assert_allclose(report["lens_conic_constant"], [0, -1], atol=0.01)
    assert "turned over about x" in report["frame"] and "(sensor's side)" in report["frame"]
    assert json.loads((tmp_path / "a.stl.json").read_text())["lens_conic_constant"] == report["lens_conic_constant"]
    text = {finding["check"]: finding["text"] for finding in report["checks"]}
    assert "= 3.953 to 4.651 mm" in text["focal length"] and "slope by up to" in text["edge slope"]


def test_the_words_about_unequal_lenses_hold_the_numbers():
    small = UnequalDesign.model_validate(design().model_dump(exclude_defaults=True))
    found = {f.check: f.text for f in check_design(small, MoldShape(), chord=1e-3, resolution=0.025)}
    each = small.imager().array
    one = dataclasses.replace(each, radius_of_curvature=2.0, conic_constant=0.0, aperture_diameter=1.4)
    same = {f.check: f.text for f in check_design(design(), MoldShape(), chord=1e-3, resolution=0.025)}
    assert found["plate"] == same["plate"] and lenslet_height(each) == lenslet_height(one)
    # Discs of 1.4 and 1 mm on the plate, less the lens that they share; and the wall of the smaller one.
    share = float(found["coverage"].split(" %")[0])
    discs = m3.CrossSection.circle(0.7, 4000) + m3.CrossSection.circle(0.5, 4000).translate([1.1, 0.2])
    plate = m3.CrossSection.square([3.0, 3.0], center=True)
    assert share == pytest.approx(100 - (discs ^ plate).area() / 0.09, abs=0.05)


def test_the_length_of_ridges_by_their_crossings():
    one = design()
    each = UnequalDesign.model_validate(one.model_dump(exclude_defaults=True))
    of = lambda d: {f.check: f.text for f in check_design(d, MoldShape(), chord=1e-3, resolution=0.025)}["sharp edges"]
    ridges = lambda d: float(of(d).split()[0])
    # The smaller disc cuts the larger one by less.
    assert 0 < ridges(each) < ridges(one)


def test_the_picture_of_a_turned_part_has_the_designs_y():
    titles = {}
    for orientation in ("plano", "curved"):
        axes = draw_preview(unequal(orientation=orientation), MoldShape(), "x").axes[0]
        titles[orientation] = axes.get_title(), axes.images[0].get_extent()
    assert titles["plano"][0].endswith("seen from the sensor") and titles["curved"][0].endswith("seen from the object")
    assert list(titles["plano"][1]) == [-2, 2, 1.5, -1.5] and list(titles["curved"][1]) == [-2, 2, -1.5, 1.5]


def test_a_lens_that_is_too_steep_is_named():
    with pytest.raises(ValueError, match="at most 1.932 mm for lens 2, got 1.99"):
        array_solid(unequal(aperture_diameter=[1.0, 1.99, 1, 1, 1], radius_of_curvature=1.0, conic_constant=0.0))
    assert plate_thickness(unequal()) == pytest.approx(1 - lenslet_height(unequal()))


@pytest.mark.parametrize(
    ("diameter", "radius", "conic"), [(0.13, 0.13, 0.0), (0.1, 0.2, -0.6), (0.05, 0.05, 0.0), (0.05, 0.2, 0.0)]
)
def test_small_lenses_are_made_and_measured_by_default(diameter, radius, conic):
    """The chord follows the height of the lens, down to 1.6 um: coarser facets left none to measure, or wild conics."""
    centers = diameter * CENTERS[:, ::-1]
    array = MicrolensArray(
        centers,
        size=(3 * diameter, 4 * diameter),
        aperture_diameter=diameter,
        radius_of_curvature=radius,
        conic_constant=conic,
        substrate_thickness=0.3,
    )
    chord = default_chord(array)
    assert chord == pytest.approx(0.01 * lenslet_height(array)) and chord < 4e-4
    imager = Imager(array, Sensor((100, 100), 1e-3), sensor_distance=radius / 0.43, field_radius=1.0)
    for part in (chord, max_chord(lenslets_of(array))):
        summary = summarize(measure_lenslets(float32_mesh(array_solid(array, part)), array), imager)
        (lenses, *_) = check_measurement(summary, chord=part, radius=radius)
        # The coarsest facets may leave too few for some lenses, which then are not measured.
        assert lenses.level == "ok" or not summary["lenses_measured"], lenses.text
        assert summary["lenses_measured"] == len(centers) or part > chord


def test_files_beside_outputs_of_different_commands_differ():
    outputs = [Path("focused.stl"), Path("focused.toml"), Path("focused.json"), Path("focused.npz")]
    beside = [
        *make.side_files(outputs[0]),
        *search_report.side_files(outputs[1]),
        side_file(outputs[2], ".png"),
        *(side_file(outputs[3], suffix) for suffix in (".json", ".checkpoint")),
    ]
    assert len({*outputs, *beside}) == len(outputs) + len(beside)


def test_files_of_older_versions_are_still_read(tmp_path):
    (tmp_path / "old.stl").touch()
    (tmp_path / "old.json").write_text(json.dumps({KEY: {"gs_jax": "0.1"}}))
    assert read_provenance(tmp_path / "old.stl") == {"gs_jax": "0.1"}
    (tmp_path / "new.checkpoint").touch()
    assert checkpoint_path(tmp_path / "new.toml", resume=True) == tmp_path / "new.checkpoint"
    assert checkpoint_path(tmp_path / "new.toml") == tmp_path / "new.toml.checkpoint"
