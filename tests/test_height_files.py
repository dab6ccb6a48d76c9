"""Files for makers and optical programs, as others read them: against the formula of the sag, and the mesh."""

import csv
import json
import math
from typing import Any

import numpy as np
import pytest
import tifffile
import trimesh
from click.testing import CliRunner
from PIL import Image
from scipy.interpolate import RegularGridInterpolator

import gs_jax as gs
from gs_jax.__main__ import commands
from gs_jax.io.provenance import read_provenance
from gs_jax.mold.heights import HEIGHT_SUFFIXES, write_heights

CENTERS = ((-1.1, 0.7), (0.9, -0.4), (0.2, 1.4), (1.3, 1.1))
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
    array = design.array.model_copy(update={"centers_mm": CENTERS, "size_mm": SIZE})
    lens = design.lens.model_copy(update={"aperture_diameter_mm": 1.6} | KINDS[kind])
    return design.model_copy(update={"array": array, "lens": lens})


def height(design: gs.Design, x, y):
    """Height above the plate at a point of the design, by the formula of ISO 10110-12; NaN on walls."""
    lens: Any = design.lens
    numbers = lens.radius_of_curvature_mm, lens.conic_constant, np.array(lens.aperture_diameter_mm) / 2
    lenses = list(zip(*(np.broadcast_to(each, len(CENTERS)) for each in numbers), strict=True))

    def sag(r, radius, conic):
        c = 1 / radius
        terms = sum(a * r**order for order, a in zip((4, 6), lens.aspheric_terms or (), strict=False))
        return c * r**2 / (1 + np.sqrt(1 - (1 + conic) * c**2 * r**2)) + terms

    top = max(sag(edge, *shape) for *shape, edge in lenses)
    found, walls = (np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y))) for _ in range(2))
    for (cx, cy), (*shape, edge) in zip(CENTERS, lenses, strict=True):
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
    smooth = np.min([np.hypot(x - cx, -y - cy) for cx, cy in CENTERS], axis=0) < 0.4
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
    assert plate["object_type"] == "Rectangular Volume" and len(lenses) == len(CENTERS)
    assert [(float(lens["x_mm"]), -float(lens["y_mm"])) for lens in lenses] == list(CENTERS)
    # Where the vertices and the plano face are, along the light.
    front, thickness = float(plate["z_mm"]), float(plate["thickness_mm"])
    t = design.array.substrate_thickness_mm
    is_front = design.lens.orientation == "curved"
    assert (front + thickness if is_front else front) == pytest.approx(t if is_front else -t, abs=NM)
    for lens, radius in zip(lenses, np.broadcast_to(design.lens.radius_of_curvature_mm, len(CENTERS)), strict=True):
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
