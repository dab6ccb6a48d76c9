"""From a design to the files: the command, its report, and what it refuses."""

import json
import math
import tomllib
from pathlib import Path

import manifold3d as m3
import matplotlib.image
import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

from experiments import mold_check
from gs_jax.base.errors import InputError
from gs_jax.cli.fabrication import mold_command as mold
from gs_jax.codesign import search_report
from gs_jax.design.design import Design, read_design
from gs_jax.design.start import geomscope
from gs_jax.io.files import checkpoint_path, side_file
from gs_jax.io.provenance import KEY, read_provenance
from gs_jax.microscope.layouts import coverage
from gs_jax.mold import make
from gs_jax.mold.lenslets import Part
from gs_jax.mold.make import draw_preview, make_mold
from gs_jax.mold.manufacturability import CheckResult, check_design, raise_first_error
from gs_jax.mold.solids import MoldShape, array_volume

from .test_mold import unequal

DESIGN = """
name = "small $x"
[sensor]
pixel_pitch_um = 20.0
shape = [200, 200]
[lens]
radius_of_curvature_mm = 2.0
refractive_index = 1.43
aperture_diameter_mm = 1.4
[array]
size_mm = [3.0, 3.0]
substrate_thickness_mm = 1.0
centers_mm = [[0.0, 0.0], [1.1, 0.2], [-1.0, 0.5], [0.1, -1.2], [0.2, 1.3]]
[imaging]
sensor_distance_mm = 5.8
working_distance_mm = [18.0, 30.0]
wavelength_nm = 520.0
field_radius_mm = 3.0
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "design.toml").write_text(DESIGN)
    return tmp_path


def run(*arguments):
    return CliRunner().invoke(mold, [*map(str, arguments)])


def design(**changes) -> Design:
    """Two lenses of the design above, with other values in one table or more."""
    data = tomllib.loads(DESIGN)
    data["array"]["centers_mm"] = data["array"]["centers_mm"][:2]
    for table, values in changes.items():
        data[table].update(values)
    return Design.model_validate(data)


def part_of(design: Design) -> Part:
    return Part(design.imager().array)


def checks_of(design, shape=MoldShape(), chord=5e-4, resolution=0.025, layer=None):
    return {f.check: f for f in check_design(design, shape, chord=chord, resolution=resolution, layer=layer)}


@pytest.mark.parametrize("positive", [False, True])
def test_mold(folder, positive):
    result = run("design.toml", "-o", "part.stl", "--chord-um", 2, *(["--positive"] if positive else []))
    assert result.exit_code == 0, result.exception
    assert {path.name for path in folder.iterdir()} == {
        "design.toml",
        *("part.stl", "part.stl.png", "part.stl.json", "part.stl.txt"),
    }
    report = json.loads((folder / "part.stl.json").read_text())
    assert result.output == (folder / "part.stl.txt").read_text()
    mesh = trimesh.load_mesh("part.stl")
    assert mesh.is_watertight and len(mesh.faces) == report["facets"]
    np.testing.assert_allclose(mesh.volume, report["analytic_volume_mm3"], rtol=1e-4)
    np.testing.assert_allclose(mesh.extents, report["size_mm"], atol=1e-5)
    if positive:
        np.testing.assert_allclose(
            report["analytic_volume_mm3"], array_volume(part_of(read_design("design.toml"))), rtol=1e-6
        )
    assert report["verification"]["lenses_measured"] == 5
    assert report["verification"]["center_deviation_max_um"] < 0.1
    assert len(report["lens_radius_mm"]) == len(report["lens_center_deviation_um"]) == 5
    assert not [check for check in report["checks"] if check["level"] == "error"]
    picture = matplotlib.image.imread("part.stl.png")
    assert picture.shape[0] > 500 and picture.std() > 0.1


def test_a_part_that_is_not_the_design_is_not_written(folder, monkeypatch):
    wrong = lambda *_, **__: [CheckResult("lenses", "error", "read back, lenses are elsewhere.")]
    monkeypatch.setattr(make, "check_measurement", wrong)
    with pytest.raises(RuntimeError, match="lenses are elsewhere"):
        make_mold(read_design("design.toml"), "part.stl", chord=2e-3)
    assert [path.name for path in folder.iterdir()] == ["design.toml"]


def test_the_options_change_the_mold(folder):
    result = run(
        *("design.toml", "-o", "part.3mf", "--chord-um", 3, "--shrinkage-percent", 2, "--draft-deg", 5),
        *("--headroom-mm", 0.5, "--resolution-um", 100, "--no-label"),
    )
    assert result.exit_code == 0, result.exception
    report = json.loads((folder / "part.3mf.json").read_text())
    assert report["shrinkage_percent"] == 2 and report["draft_deg"] == pytest.approx(5)
    between = part_of(read_design("design.toml")).plate_thickness
    side = 3 / 0.98 + 2 * (between / 0.98 + 0.5) * math.tan(math.radians(5)) + 2 * 4
    np.testing.assert_allclose(report["size_mm"], [side, side, 1 / 0.98 + 2 + 0.5], atol=1e-5)
    assert report["verification"]["center_deviation_max_um"] < 0.1
    assert trimesh.load_mesh("part.3mf").units == "millimeter"


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("-o", "part.obj"), ".3mf"),
        (("-o", "missing/part.stl"), "no folder"),
        (("-o", "part.stl", "--chord-um", 100), "the chord error must be at most"),
    ],
)
def test_wrong_input_is_one_line_and_writes_nothing(folder, arguments, message):
    result = run("design.toml", *arguments)
    assert isinstance(result.exception, InputError) and message in str(result.exception)
    assert [path.name for path in folder.iterdir()] == ["design.toml"]


@pytest.mark.parametrize(
    "option", ["--chord-um", "--shrinkage-percent", "--draft-deg", "--headroom-mm", "--resolution-um"]
)
@pytest.mark.parametrize("value", ["-1", "nan", "x", "1e9"])
def test_a_wrong_number_is_refused(folder, option, value):
    result = run("design.toml", "-o", "part.stl", f"{option}={value}")
    assert result.exit_code == 2 and "must be" in result.output


@pytest.mark.parametrize(
    "changes, message",
    [
        (
            {"array": {"substrate_thickness_mm": 0.0}},
            "`array.substrate_thickness_mm` must be more than the lenses' sag, 0.1265 mm, got 0",
        ),
        (
            {"array": {"substrate_thickness_mm": 0.1}},
            "`array.substrate_thickness_mm` must be more than the lenses' sag, 0.1265 mm, got 0.1",
        ),
        (
            {"lens": {"aperture_diameter_mm": 3.95}, "array": {"substrate_thickness_mm": 3.0}},
            "`lens.aperture_diameter_mm` must be positive and at most 3.864 mm, got 3.95; ",
        ),
        ({"lens": {"focal_length_mm": 4.0}}, "`lens.focal_length_mm` must be R / (n - 1) = 4.651 mm"),
    ],
)
def test_a_design_that_cannot_be_made_is_refused(tmp_path, changes, message):
    with pytest.raises(InputError) as error:
        make_mold(design(**changes), tmp_path / "a.stl")
    assert message in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_a_design_file_is_read_and_named(folder):
    report = make_mold("design.toml", "part.stl", positive=True, chord=6e-3)
    assert report["part"] == "array" and report["design"] == "small $x"
    with pytest.raises(InputError, match="^design.toml: the chord error must be at most .* got 100 um"):
        make_mold("design.toml", "other.stl", chord=0.1)
    with pytest.raises(InputError, match="missing.toml"):
        make_mold("missing.toml", "other.stl")


def test_what_is_doubtful_is_said():
    found = checks_of(design(array={"substrate_thickness_mm": 0.3}))
    assert found["plate"].level == "warning" and "tears" in found["plate"].text
    assert checks_of(design(), MoldShape(wall=0.2))["walls"].level == "warning"
    steep = checks_of(design(lens={"aperture_diameter_mm": 3.0}, array={"substrate_thickness_mm": 2.0}))["edge slope"]
    assert steep.level == "warning" and "beyond 44.4 degrees" in steep.text
    assert checks_of(design(), resolution=0.1)["smallest feature"].level == "warning"
    assert checks_of(design(), resolution=1e-3)["facets"].level == "warning"
    assert checks_of(design(lens={"focal_length_mm": 2.0 / 0.43}))["focal length"].level == "ok"
    raise_first_error(list(found.values()), InputError)
    many = checks_of(design(), chord=1e-7)["facets"]
    assert many.level == "error" and "must be at least 0.000" in many.text


def test_the_words_hold_the_numbers():
    small = design()
    found = checks_of(small)
    spacing = math.hypot(1.1, 0.2)
    groove = 2 - math.sqrt(4 - (spacing / 2) ** 2)
    assert f"{spacing:.4g} mm apart, with a groove {1000 * groove:.4g} um" in found["smallest feature"].text
    share = 1 - coverage(np.array(small.array.centers_mm), small.array.size_mm, diameter=1.4)
    assert f"{100 * share:.3g} % of the plate" in found["coverage"].text
    # The groove is the common chord of two discs.
    assert f"{2 * math.sqrt(0.7**2 - spacing**2 / 4):.4g} mm of sharp edges" in found["sharp edges"].text
    assert "asin(D / 2R) = 20.5 degrees" in found["edge slope"].text


UNEQUAL = {"radius_of_curvature_mm": [2.0, 1.7], "conic_constant": [0.0, -1.0], "aperture_diameter_mm": [1.4, 1.0]}


def test_the_words_about_unequal_lenses_hold_the_numbers():
    one, other = design(), design(lens=UNEQUAL)
    same, checks = checks_of(one), checks_of(other)
    assert checks["plate"] == same["plate"] and part_of(other).height == part_of(one).height
    # Discs of 1.4 and 1 mm on the plate, less the lens that they share; and the wall of the smaller one.
    share = float(checks["coverage"].text.split(" %")[0])
    discs = m3.CrossSection.circle(0.7, 4000) + m3.CrossSection.circle(0.5, 4000).translate([1.1, 0.2])
    plate = m3.CrossSection.square([3.0, 3.0], center=True)
    assert share == pytest.approx(100 - (discs ^ plate).area() / 0.09, abs=0.05)
    # By crossings: the smaller disc cuts the larger one by less.
    ridges = [float(found["sharp edges"].text.split()[0]) for found in (checks, same)]
    assert 0 < ridges[0] < ridges[1]


def test_a_design_of_unequal_lenses_is_made(tmp_path):
    report = make_mold(design(lens=UNEQUAL | {"orientation": "curved"}), tmp_path / "a.stl", chord=1e-3)
    np.testing.assert_allclose(report["lens_radius_mm"], [2.0, 1.7], rtol=1e-3)
    np.testing.assert_allclose(report["lens_conic_constant"], [0, -1], atol=0.01)
    assert "turned over about x" in report["frame"] and "(sensor's side)" in report["frame"]
    assert json.loads((tmp_path / "a.stl.json").read_text())["lens_conic_constant"] == report["lens_conic_constant"]
    text = {check["check"]: check["text"] for check in report["checks"]}
    assert "= 3.953 to 4.651 mm" in text["focal length"] and "slope by up to" in text["edge slope"]


def test_the_picture_of_a_turned_part_has_the_designs_y():
    for orientation, side, bottom in (("plano", "sensor", 1.5), ("curved", "object", -1.5)):
        axes = draw_preview(unequal(orientation=orientation), MoldShape(), "x").axes[0]
        assert axes.get_title().endswith(f"seen from the {side}")
        assert list(axes.images[0].get_extent()) == [-2, 2, bottom, -bottom]


def test_the_experiment_runs_small():
    small = design()
    (record,) = mold_check.run(small, chords_um=(2.0,))
    assert abs(record["block_filled_error"]) < 1e-6 and abs(record["cast_is_array_error"]) < 1e-12
    assert set(mold_check.COLUMNS) <= set(record)


def test_layers_are_compared_with_the_lenses():
    """Half a wave of path is 0.6 um of silicone; steps of 10 um are 2.4 waves."""
    coarse, fine = (checks_of(geomscope(), chord=4e-4, layer=layer)["layers"] for layer in (0.01, 2e-4))
    assert (coarse.level, fine.level) == ("warning", "ok")
    assert "26.8 layers of 10 um high; their steps are 2.4 waves RMS" in coarse.text
    assert "print layers of 0.3 um" in coarse.text


@pytest.mark.integration
def test_the_defaults_do_not_warn_of_themselves(tmp_path):
    report = make_mold(geomscope(), tmp_path / "m.stl")
    found = {finding["check"]: finding["level"] for finding in report["checks"]}
    assert found["facets"] == found["facets' wavefront"] == "ok"


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
