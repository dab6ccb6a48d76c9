"""STL and 3MF as other programs read them, and what is measured in them."""

import struct
import zipfile

import manifold3d
import numpy as np
import pytest
import trimesh

from gs_jax import Imager, MicrolensArray, Sensor
from gs_jax.base.errors import InputError
from gs_jax.mold.export import Mesh, float32_mesh, read_mesh, write_mesh
from gs_jax.mold.lenslets import Part
from gs_jax.mold.make import check_measurement
from gs_jax.mold.manufacturability import CheckResult, check_solid
from gs_jax.mold.measurement import LensletMeasurement, measure_lenslets, summarize
from gs_jax.mold.solids import MoldShape, array_solid, array_volume, mold_solid

from .test_mold import CENTERS, CHORD, CONICS, RADII, lenses, random_lenses, unequal


def corners_in_stl(path):
    """The facets of a binary STL file by its definition: 80 bytes, their number, then 50 bytes each."""
    data = path.read_bytes()
    (count,) = struct.unpack_from("<I", data, 80)
    assert len(data) == 84 + 50 * count
    rows = np.frombuffer(data, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")]), offset=84)
    return rows["normal"].astype(float), rows["corners"].astype(float)


def summary_of(lenses: LensletMeasurement, part: Part) -> dict:
    return summarize(lenses, Imager(part.array, Sensor((64, 64), 0.0045), 5.8, 3.0))


def check_of(summary: dict, chord: float, radius=2.0) -> CheckResult:
    return check_measurement(summary, chord=chord, radius=radius)[0]


def measured_as(other: Part, part: Part, chord: float) -> LensletMeasurement:
    """The lenses of one part as measured against another."""
    return measure_lenslets(float32_mesh(array_solid(other, chord)), part)


def volume_of(corners):
    return np.einsum("fx,fx->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6


def test_stl_holds_the_solid(tmp_path):
    solid = array_solid(random_lenses(), CHORD)
    write_mesh(tmp_path / "a.stl", float32_mesh(solid), "small array")
    assert (tmp_path / "a.stl").read_bytes()[:80].rstrip() == b"gs_jax, unit: mm, small array"
    normal, corners = corners_in_stl(tmp_path / "a.stl")
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    assert area.min() > 0
    # Facets 1e-4 mm wide in coordinates that are rounded by 1e-7 mm.
    np.testing.assert_allclose(normal, cross / area[:, None], atol=2e-3)
    # float32 coordinates: random errors, 1e-7 each, over a thousand facets.
    np.testing.assert_allclose(volume_of(corners), solid.volume(), rtol=1e-7)


@pytest.mark.parametrize("suffix", [".stl", ".3mf", ".STL"])
def test_a_file_is_watertight_for_others_and_reads_back(tmp_path, suffix):
    part, path = random_lenses(), tmp_path / f"a{suffix}"
    mesh = float32_mesh(array_solid(part, 2e-4))
    write_mesh(path, mesh, 'a <b> & "c"')
    other = trimesh.load_mesh(path)
    assert other.is_watertight and other.is_winding_consistent and other.euler_number == 2
    # The bar, at a finer chord error than the default: small lenses have more rim.
    np.testing.assert_allclose(other.volume, array_volume(part), rtol=1e-4)
    again = read_mesh(path)
    np.testing.assert_array_equal(np.float32(again.vertices), mesh.vertices)
    np.testing.assert_array_equal(np.sort(again.facets, axis=0), np.sort(mesh.facets, axis=0))


def test_units_of_a_file_are_converted(tmp_path):
    path, other = tmp_path / "a.3mf", tmp_path / "inch.3mf"
    mesh = float32_mesh(manifold3d.Manifold.cube([1.0, 1.0, 1.0]))
    write_mesh(path, mesh, "a")
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(other, "w") as target:
        for name in source.namelist():
            target.writestr(name, source.read(name).replace(b'unit="millimeter"', b'unit="inch"'))
    for file, unit in ((path, 1.0), (other, 25.4)):
        np.testing.assert_allclose(np.ptp(read_mesh(file).vertices, axis=0), unit, rtol=1e-6)


def test_vertices_that_float32_cannot_tell_apart_are_merged():
    """A tetrahedron with one corner cut off by 1e-9 mm: in float32, 8 mm from the origin, it is whole again."""
    top = np.array([[0, 0, 8.0], [1e-9, 0, 8.0], [0, 1e-9, 8.0]])
    corners = np.concatenate([[[4.0, 4, 0], [-4.0, 4, 0], [0, -4.0, 0]], top]) + 8
    facets = np.array([[0, 2, 1], [3, 4, 5], [0, 1, 5], [0, 5, 4], [1, 2, 3], [1, 3, 5], [2, 0, 4], [2, 4, 3]])
    cut = Mesh(corners, facets)
    assert not cut.solid().is_empty()
    mesh = float32_mesh(cut.solid())
    assert len(mesh.vertices) == 4 and len(mesh.facets) == 4
    assert all(finding.level == "ok" for finding in check_solid(mesh, 8 * 8 / 2 * 8 / 3, "tetrahedron"))


def test_what_is_no_solid_is_found():
    mesh = float32_mesh(array_solid(random_lenses(), CHORD))
    levels = lambda mesh, volume: {f.check: f.level for f in check_solid(mesh, volume, "part")}
    volume = mesh.solid().volume()
    assert set(levels(mesh, volume).values()) == {"ok"}
    assert levels(mesh, volume * 1.001)["volume"] == "error"
    torn = Mesh(mesh.vertices, mesh.facets[1:])
    assert levels(torn, volume)["watertight"] == levels(torn, volume)["manifold"] == "error"
    apart = mesh.vertices + np.array([9, 0, 0], np.float32)
    two = Mesh(np.concatenate([mesh.vertices, apart]), np.concatenate([mesh.facets, mesh.facets + len(apart)]))
    assert levels(two, 2 * volume)["genus"] == "error"


@pytest.mark.parametrize("name", ["a.obj", "a", "a.stl.txt"])
def test_another_suffix_is_refused(tmp_path, name):
    mesh = float32_mesh(array_solid(random_lenses(), CHORD))
    with pytest.raises(InputError, match=r"\.3mf"):
        write_mesh(tmp_path / name, mesh, "a")
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match=r"\.3mf"):
        read_mesh(tmp_path / name)


@pytest.mark.parametrize(
    "name, data", [("a.stl", b"\0" * 84), ("a.stl", b"junk"), ("a.3mf", b"PK junk"), ("a.stl", b"")]
)
def test_a_broken_file_is_refused(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=name):
        read_mesh(tmp_path / name)


def test_nothing_is_left_of_a_file_that_could_not_be_written(tmp_path):
    with pytest.raises(InputError, match="no folder"):
        write_mesh(tmp_path / "missing" / "a.stl", float32_mesh(array_solid(random_lenses(), CHORD)), "a")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("shape", [None, MoldShape(shrinkage=0.03, label="x")])
def test_lenses_are_where_they_should_be(tmp_path, shape):
    part = random_lenses()
    solid = array_solid(part, 5e-4)
    solid = solid if shape is None else mold_solid(part, solid, shape)
    write_mesh(tmp_path / "a.stl", float32_mesh(solid), "a")
    found = measure_lenslets(read_mesh(tmp_path / "a.stl"), part, scale=1.0 if shape is None else shape.scale)
    # The bars are 1 um and 0.1 %. What is left is float32 and, in the radius, the lift of the vertices: 0.3 um of 2 mm.
    np.testing.assert_allclose(found.center, np.asarray(part.centers), atol=1e-5)
    np.testing.assert_allclose(found.radius, 2.0, rtol=3e-4)
    assert np.nanmax(np.abs(found.offset)) < 2e-4 and found.misfit.max() < 1e-6


def test_lenses_that_are_not_where_they_should_be_are_found():
    """A part made of other centres and another radius than it is measured against."""
    part = random_lenses()
    moved = np.asarray(part.centers) + np.random.default_rng(2).uniform(-2e-3, 2e-3, (12, 2))
    moved = np.clip(moved, (-2.5, -2.0), (2.5, 2.0))
    # The same rims and sag as a sphere of another radius would have are not kept: the plate's plane is where it was.
    other = lenses(moved, (5.0, 4.0), radius=2.001, thickness=1.0)
    found = measured_as(other, part, 5e-4)
    np.testing.assert_allclose(found.center, moved, atol=1e-4)
    np.testing.assert_allclose(found.radius, 2.001, atol=1e-3)
    measured = summary_of(found, part)
    assert measured["center_deviation_max_um"] == pytest.approx(
        1000 * np.linalg.norm(moved - np.asarray(part.centers), axis=1).max(), abs=0.1
    )
    assert check_of(measured, 5e-4).level == "error"


def test_facets_cost_light_as_the_square_of_their_depth():
    """An equilateral facet `rho^2 / (2 R)` deep is `1 - r^2 / rho^2` of it deep at `r` from its middle."""
    corners = np.array([[1, 0], [-0.5, 3**0.5 / 2], [-0.5, -(3**0.5) / 2]])
    samples = np.random.default_rng(0).dirichlet([1, 1, 1], 200_000) @ corners
    variation = (samples**2).sum(axis=1).std()
    part = lenses([[0, 0]], (2.4, 2.4))
    measured = {}
    for chord in (2e-4, 4e-4):
        measured[chord] = summary_of(measured_as(part, part, chord), part)
    rms = {chord: numbers["surface_error_rms_um"] / 1000 for chord, numbers in measured.items()}
    # Not all facets are equilateral, or as deep as they may be.
    for chord, found in rms.items():
        assert 0.7 * variation < found / chord < 1.1 * variation
    np.testing.assert_allclose(rms[4e-4] / rms[2e-4], 2, rtol=0.1)
    numbers = measured[2e-4]
    waves = 0.43 * numbers["surface_error_rms_um"] / 0.52
    assert numbers["wavefront_error_rms_waves"] == pytest.approx(waves, rel=1e-6)
    assert numbers["strehl_of_facets_median"] == pytest.approx(np.exp(-((2 * np.pi * waves) ** 2)), rel=1e-6)
    # A surface within lambda / 14 is Marechal's: 0.075 waves for 0.8 by the exponential formula.
    assert numbers["surface_error_for_strehl_0.8_um"] == pytest.approx(0.0752 * 0.52 / 0.43, rel=1e-3)


def test_a_file_without_lenses_is_refused():
    block = trimesh.creation.box((5, 4, 1))
    with pytest.raises(ValueError, match="no facet near any lens"):
        measure_lenslets(Mesh(block.vertices, block.faces), random_lenses())


def test_a_lens_that_is_not_there_is_said():
    part, one = lenses([[-1.0, 0], [1.0, 0]], (5.0, 4.0)), lenses([[-1.0, 0]], (5.0, 4.0))
    found = measured_as(one, part, CHORD)
    assert np.isnan(found.radius).tolist() == [False, True]
    measured = summary_of(found, part)
    assert measured["lenses_not_measured"] == [2] and measured["lenses_measured"] == 1
    assert "lenses not measured" in {check.check for check in check_measurement(measured, chord=CHORD, radius=2.0)}


def test_float32_arrays_are_measured_alike():
    part = Part(MicrolensArray(np.array([[0.1, 0.2]], np.float32), size=(3.0, 3.0)))
    assert measured_as(part, part, CHORD).vertices[0] > 50


@pytest.mark.parametrize("orientation", ["plano", "curved"])
def test_radius_and_conic_are_read_back(orientation):
    part = unequal(orientation=orientation)
    found = measure_lenslets(float32_mesh(mold_solid(part, array_solid(part, 2e-4))), part)
    np.testing.assert_allclose(found.center, CENTERS * (1, -1 if orientation == "curved" else 1), atol=1e-5)
    # The lift is a tenth of a micrometre.
    np.testing.assert_allclose(found.radius, RADII, rtol=3e-4)
    np.testing.assert_allclose(found.conic, CONICS, atol=2e-3)
    assert (found.conic_deviation < 1e-3).all()
    measured = summary_of(found, part)
    assert measured["lenses_conic_measured"] == 5 and measured["conic_deviation_max"] < 2e-3
    assert check_of(measured, 2e-4, radius=1.6).level == "ok"


def test_another_conic_is_found():
    part = unequal()
    # The land is at the deepest rim: the vertices are where they were.
    found = measured_as(unequal(conic_constant=CONICS + 0.3), part, 2e-4)
    np.testing.assert_allclose(found.conic, CONICS + 0.3, atol=3e-3)
    assert check_of(summary_of(found, part), 2e-4, radius=1.6).level == "error"


def test_a_small_aperture_does_not_say_its_conic():
    array = MicrolensArray([[-0.5, 0], [0.5, 0]], 2.0, 1.43, [0.2, 0.9], size=(2.0, 1.0), conic_constant=-1.0)
    part = Part(array)
    found = measured_as(part, part, 5e-5)
    assert np.isnan(found.conic).tolist() == [True, False]
    np.testing.assert_allclose(found.radius, 2.0, rtol=1e-3)
    assert "conic constants of 1 within" in check_of(summary_of(found, part), 5e-5).text


@pytest.mark.parametrize(
    ("diameter", "radius", "conic"), [(0.13, 0.13, 0.0), (0.1, 0.2, -0.6), (0.05, 0.05, 0.0), (0.05, 0.2, 0.0)]
)
def test_small_lenses_are_made_and_measured_by_default(diameter, radius, conic):
    """The chord follows the height of the lens, down to 1.6 um: coarser facets left none to measure, or wild conics."""
    size = (3 * diameter, 4 * diameter)
    part = Part(
        MicrolensArray(diameter * CENTERS[:, ::-1], radius, 1.43, diameter, 0.3, size=size, conic_constant=conic)
    )
    assert part.default_chord == pytest.approx(0.01 * part.height) and part.default_chord < 4e-4
    imager = Imager(part.array, Sensor((100, 100), 1e-3), sensor_distance=radius / 0.43, field_radius=1.0)
    for chord in (part.default_chord, part.max_chord):
        summary = summarize(measured_as(part, part, chord), imager)
        lenses_check = check_of(summary, chord, radius)
        # The coarsest facets may leave too few for some lenses, which then are not measured.
        assert lenses_check.level == "ok" or not summary["lenses_measured"], lenses_check.text
        assert summary["lenses_measured"] == len(CENTERS) or chord > part.default_chord
