"""From a design to the files: the command, its report, and what it refuses."""

import json
import math
import tomllib

import matplotlib.image
import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

from experiments import mold_check
from gs_jax.base.errors import InputError
from gs_jax.cli.fabrication import mold_command as mold
from gs_jax.design.design import Design, read_design
from gs_jax.design.start import geomscope
from gs_jax.layouts import coverage
from gs_jax.mold import make
from gs_jax.mold.make import make_mold
from gs_jax.mold.manufacturability import CheckResult, check_design, raise_first_error
from gs_jax.mold.solids import MoldShape, array_volume, plate_thickness

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


def findings_of(design, shape=MoldShape(), chord=5e-4, resolution=0.025):
    return {f.check: f for f in check_design(design, shape, chord=chord, resolution=resolution)}


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
    array = read_design("design.toml").imager().array
    mesh = trimesh.load_mesh("part.stl")
    assert mesh.is_watertight and len(mesh.faces) == report["facets"]
    np.testing.assert_allclose(mesh.volume, report["analytic_volume_mm3"], rtol=1e-4)
    np.testing.assert_allclose(mesh.extents, report["size_mm"], atol=1e-5)
    if positive:
        np.testing.assert_allclose(report["analytic_volume_mm3"], array_volume(array), rtol=1e-6)
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
    between = plate_thickness(read_design("design.toml").imager().array)
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
    found = findings_of(design(array={"substrate_thickness_mm": 0.3}))
    assert found["plate"].level == "warning" and "tears" in found["plate"].text
    assert findings_of(design(), MoldShape(wall=0.2))["walls"].level == "warning"
    steep = findings_of(design(lens={"aperture_diameter_mm": 3.0}, array={"substrate_thickness_mm": 2.0}))["edge slope"]
    assert steep.level == "warning" and "beyond 44.4 degrees" in steep.text
    assert findings_of(design(), resolution=0.1)["smallest feature"].level == "warning"
    assert findings_of(design(), resolution=1e-3)["facets"].level == "warning"
    assert findings_of(design(lens={"focal_length_mm": 2.0 / 0.43}))["focal length"].level == "ok"
    raise_first_error(list(found.values()), InputError)
    many = findings_of(design(), chord=1e-7)["facets"]
    assert many.level == "error" and "must be at least 0.000" in many.text


def test_the_words_hold_the_numbers():
    small = design()
    found = findings_of(small)
    spacing = math.hypot(1.1, 0.2)
    groove = 2 - math.sqrt(4 - (spacing / 2) ** 2)
    assert f"{spacing:.4g} mm apart, with a groove {1000 * groove:.4g} um" in found["smallest feature"].text
    share = 1 - coverage(np.array(small.array.centers_mm), small.array.size_mm, diameter=1.4)
    assert f"{100 * share:.3g} % of the plate" in found["coverage"].text
    # The groove is the common chord of two discs.
    assert f"{2 * math.sqrt(0.7**2 - spacing**2 / 4):.4g} mm of sharp edges" in found["sharp edges"].text
    assert "asin(D / 2R) = 20.5 degrees" in found["edge slope"].text


def test_a_single_lens_is_made(tmp_path):
    report = make_mold(design(array={"centers_mm": [[0.1, 0.0]]}), tmp_path / "a.stl", chord=6e-3)
    assert report["verification"]["lenses_measured"] == 1


def test_the_experiment_runs_small():
    small = design()
    (record,) = mold_check.run(small, chords_um=(2.0,))
    assert abs(record["block_filled_error"]) < 1e-6 and abs(record["cast_is_array_error"]) < 1e-12
    assert len(mold_check.rows([record])[0]) == len(mold_check.COLUMNS)
    assert len(mold_check.draw(small, [record]).axes) == 5


def test_layers_are_compared_with_the_lenses():
    """Half a wave of path is 0.6 um of silicone; steps of 10 um are 2.4 waves."""
    checks = lambda layer: check_design(geomscope(), MoldShape(), chord=4e-4, resolution=0.025, layer=layer)
    coarse, fine = (checks(layer)[-1] for layer in (0.01, 2e-4))
    assert (coarse.check, coarse.level, fine.level) == ("layers", "warning", "ok")
    assert "26.8 layers of 10 um high; their steps are 2.4 waves RMS" in coarse.text
    assert "print layers of 0.3 um" in coarse.text


@pytest.mark.integration
def test_the_defaults_do_not_warn_of_themselves(tmp_path):
    report = make_mold(geomscope(), tmp_path / "m.stl")
    found = {finding["check"]: finding["level"] for finding in report["checks"]}
    assert found["facets"] == found["facets' wavefront"] == "ok"
