"""A design file of one's own: by options, by questions, with a comment for each key."""

import json
import math
import tomllib
import warnings
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from gs_jax.__main__ import commands
from gs_jax.cli import new_design
from gs_jax.design.design import Design, design_text, read_design
from gs_jax.design.start import commented, design_keys, plate_of, radius_of, schema
from gs_jax.microscope.layouts import nearest_neighbour_distances
from gs_jax.mold.manufacturability import check_design
from gs_jax.mold.solids import MoldShape

from .test_designs import BASE, edited

NEEDED = {
    "--pixel-pitch-um": (3.45,),
    "--shape": (300, 400),
    "--focal-length-mm": (4.6,),
    "--centers": ("vendor.csv",),
    "--working-distance-mm": (18, 23),
}
# mm, of a sensor of 1.38 x 1.035 mm.
CENTERS = ((-0.4, -0.2), (0.3, 0.1), (0.05, -0.3), (-0.1, 0.35))


def options(**changed):
    """As arguments, without those that are None."""
    given = NEEDED | {f"--{name.replace('_', '-')}": value for name, value in changed.items()}
    return [str(part) for name, values in given.items() if values is not None for part in (name, *values)]


@pytest.fixture
def lab(folder):
    """A vendor's list: of micrometres, by columns of his own."""
    rows = "".join(f"{i};{1000 * x:g};{1000 * y:g}\n" for i, (x, y) in enumerate(CENTERS))
    (folder / "vendor.csv").write_text("Lens No.;Pos X [µm];Pos Y [µm]\n" + rows, encoding="utf-8")
    return folder


def test_by_options(lab, run):
    """A focal length in place of the radius; what is not said follows, and is named."""
    status, out, err = run("new-design", *options(), "-o", "my.toml")
    assert (status, err) == (0, "") and "4 lenses of f = 4.6 mm (R = 1.978 mm)" in out
    design = read_design("my.toml")
    assert design.array.centers_mm == CENTERS and design.name == "my"
    assert design.lens.radius_of_curvature_mm == radius_of(4.6, 1.43) and design.lens.focal_length_mm is None
    plate = 1.0 / 1.43
    expected = 1 / (1 / 4.6 - (1 / (18 + plate) + 1 / (23 + plate)) / 2)
    assert design.imaging.sensor_distance_mm == pytest.approx(expected, rel=1e-3)
    assert design.array.size_mm == plate_of(np.array(CENTERS))
    for said in ("refractive_index = 1.43", "wavelength_nm = 520", f"size_mm = {design.array.size_mm[0]:g} "):
        assert said in out
    assert "input vendor.csv" in design.provenance and design.provenance["command"].startswith("gs-jax new-design")


def test_everything_can_be_said(lab, run):
    everything = options(
        focal_length_mm=None,
        radius_of_curvature_mm=(2.1,),
        refractive_index=(1.5,),
        aperture_diameter_mm=(0.3,),
        size_mm=(1.2, 1.1),
        substrate_thickness_mm=(0.5,),
        sensor_distance_mm=(5.5,),
        wavelength_nm=(600,),
        field_radius_mm=(0.7,),
        name=("mine",),
    )
    status, out, err = run("new-design", *everything, "-o", "my.toml")
    assert (status, err) == (0, "") and "by default" not in out
    data = tomllib.loads((lab / "my.toml").read_text())
    assert data["name"] == "mine" and data["sensor"] == {"pixel_pitch_um": 3.45, "shape": [300, 400]}
    assert data["lens"] == {"radius_of_curvature_mm": 2.1, "refractive_index": 1.5, "aperture_diameter_mm": 0.3}
    assert data["array"]["size_mm"] == [1.2, 1.1] and data["array"]["substrate_thickness_mm"] == 0.5
    assert data["imaging"] == {
        "sensor_distance_mm": 5.5,
        "working_distance_mm": [18.0, 23.0],
        "wavelength_nm": 600.0,
        "field_radius_mm": 0.7,
    }


def test_a_random_layout(folder, run):
    made = options(centers=None, count=(30,), shape=(2000, 3000))
    for seed, same in ((0, True), (1, False)):
        run("new-design", *made, "--seed", seed, "-o", f"{seed}.toml")
        run("new-design", *made, "-o", "again.toml", "--force")
        first, again = (read_design(name).array.centers_mm for name in (f"{seed}.toml", "again.toml"))
        assert len(first) == 30 and (first == again) is same
    assert read_design("0.toml").array.size_mm == (10.35, 6.9)


@pytest.mark.parametrize("count", [200, 150, 30])
def test_random_layouts_fit_the_plate_and_make_a_mold(folder, run, count):
    """Of a sensor whose half width has five decimals, with lenses that are cut in half nowhere, and no hemispheres."""
    made = options(centers=None, count=(count,), shape=(2608, 3478), focal_length_mm=(1.2,))
    status, out, err = run("new-design", *made, "-o", "my.toml")
    assert (status, err) == (0, "")
    design = read_design("my.toml")
    from_edge = (np.array(design.array.size_mm) / 2 - np.abs(design.array.centers_mm)).min()
    pitch = nearest_neighbour_distances(np.array(design.array.centers_mm)).mean()
    assert from_edge > 0.45 * pitch
    diameter, radius = np.array([design.lens.aperture_diameter_mm, design.lens.radius_of_curvature_mm])
    assert diameter <= 2 * radius / 1.43
    results = check_design(design, MoldShape(), chord=4e-4, resolution=0.025)
    assert all(result.level != "error" for result in results)


def test_lenses_that_no_mold_makes_are_named(lab, run):
    steep = options(aperture_diameter_mm=(0.99,), focal_length_mm=None, radius_of_curvature_mm=(0.5,))
    status, _, err = run("new-design", *steep, "--sensor-distance-mm", 1.2, "-o", "my.toml")
    assert status == 0 and "my.toml: `gs-jax mold` refuses it: `lens.aperture_diameter_mm` must be" in err
    assert err.count("\n") == 1


def test_mirror_unit_columns_and_corner(lab, run):
    low = np.array([-0.5, -0.5])
    rows = "".join(f"{x:.6f} {y:.6f} 7\n" for x, y in (np.array(CENTERS) - low) / 0.00345)
    (lab / "own.txt").write_text("a b c\n" + rows)
    more = ("--centers-unit", "px", "--centers-columns", "a", "b", "--centers-origin", "corner", "--mirror")
    status, _, err = run("new-design", *options(centers=("own.txt",)), *more, "-o", "my.toml")
    assert (status, err) == (0, "")
    middle = np.array([399, 299]) / 2 * 0.00345
    expected = (np.array(CENTERS) - low - middle) * [-1, 1]
    np.testing.assert_allclose(read_design("my.toml").array.centers_mm, expected, atol=1e-6)


def test_lenses_beyond_the_sensor_are_left_out_on_demand(lab, run):
    (lab / "large.csv").write_text("x_mm,y_mm\n5,0\n" + "".join(f"{x},{y}\n" for x, y in CENTERS))
    large = options(centers=("large.csv",))
    status, _, err = run("new-design", *large, "-o", "my.toml")
    assert status == 2 and "large.csv: 1 of 5 lenses are beyond the sensor's reach" in err and "--crop" in err
    status, out, err = run("new-design", *large, "--crop", "-o", "my.toml")
    assert (status, err) == (0, "") and "left out: 1 lenses" in out
    assert read_design("my.toml").array.centers_mm == CENTERS


def test_which_are_beyond_depends_on_the_turn(lab, run):
    """Along the short side of the sensor, which a quarter turn makes the long one."""
    (lab / "long.csv").write_text("x_mm,y_mm\n0,1.1\n0,-1.1\n0.1,0\n-0.1,0\n")
    long = options(centers=("long.csv",), field_radius_mm=(1.5,))
    for angle, status in ((0, 2), (90, 0), (-90, 0)):
        done, _, err = run("new-design", *long, "--rotation-deg", angle, "-o", f"{angle}.toml")
        assert done == status, err
    assert read_design("90.toml").calibration.rotation_deg == 90.0


WRONG = [
    (["--shape"], {"shape": None}),
    (["--pixel-pitch-um", "--working-distance-mm"], {"pixel_pitch_um": None, "working_distance_mm": None}),
    (["--focal-length-mm (or --radius-of-curvature-mm)"], {"focal_length_mm": None}),
    (["--centers (or --count)"], {"centers": None}),
    (["must be used without --focal-length-mm"], {"radius_of_curvature_mm": (2,)}),
    (["must be used without --centers"], {"count": (5,)}),
    (["--centers-unit", "must be used with --centers"], {"centers": None, "count": (5,), "centers_unit": ("um",)}),
    (["none.csv", "No such file"], {"centers": ("none.csv",)}),
    (["vendor.csv", "µm", "unit must be", "mm"], {"centers_unit": ("mm",)}),
    (["vendor.csv", "'Z'"], {"centers_columns": ("Pos X [µm]", "Z")}),
    (["bare.csv", "reach 400 without a unit", "--centers-unit um"], {"centers": ("bare.csv",)}),
    (["corner.csv", "no x or y is below 0", "--centers-origin corner"], {"centers": ("corner.csv",)}),
    (["working_distance_mm", "near below far"], {"working_distance_mm": (23, 18)}),
    (["aperture_diameter_mm", "at most 3.956 mm"], {"aperture_diameter_mm": (5,)}),
    (["sensor.shape[0]", "got 1"], {"shape": (1, 400)}),
    (["did you mean 520 nm (0.52 um)?", "must be"], {"wavelength_nm": (0.52,)}),
    (["--sensor-distance-mm", "must be given"], {"working_distance_mm": (1, 2)}),
    (["refractive_index", "got 0.9"], {"refractive_index": (0.9,)}),
    (["size_mm", "lens 1", "plate"], {"size_mm": (0.5, 0.5)}),
]


@pytest.mark.parametrize(("words", "changed"), WRONG, ids=[" ".join(changed) for _, changed in WRONG])
def test_wrong_options_are_one_line(lab, run, words, changed):
    (lab / "bare.csv").write_text("-400,-200\n300,100\n")
    (lab / "corner.csv").write_text("0.4,0.2\n0.3,0.1\n")
    before = sorted(lab.iterdir())
    status, out, err = run("new-design", *options(**changed), "-o", "my.toml")
    assert (status, out, err.count("\n")) == (2, "", 1) and len(err) < 400
    assert all(word in err for word in words), err
    assert sorted(lab.iterdir()) == before


def test_a_slip_is_asked_about_and_written(lab, run):
    """Nobody is there to answer; what is possible is done."""
    slipped = options(sensor_distance_mm=(5800,))
    status, _, err = run("new-design", *slipped, "-o", "my.toml")
    question = "imaging.sensor_distance_mm = 5800: did you mean 5.8 mm (5800 um)?"
    assert status == 0 and err == f"gs-jax: my.toml: {question}\n"


def test_nothing_is_replaced_unasked(lab, run):
    (lab / "my.toml").write_text("mine")
    status, _, err = run("new-design", *options(), "-o", "my.toml")
    assert status == 2 and "--force" in err and (lab / "my.toml").read_text() == "mine"
    assert run("new-design", *options(), "-o", "my.toml", "--force")[0] == 0
    status, _, err = run("new-design", *options(), "-o", "vendor.csv", "--force")
    assert status == 2 and ".toml" in err


def answered(monkeypatch, *answers, arguments=()):
    monkeypatch.setattr(new_design, "at_terminal", lambda: True)
    return CliRunner().invoke(commands, ["new-design", "-o", "my.toml", *arguments], input="\n".join(answers) + "\n")


def test_by_questions(lab, monkeypatch):
    """Wrong answers and slips are asked again; nothing else is."""
    answers = [
        ("3450", "distance of neighbouring pixels' centres; pixels are square (usually 0.5 to 50 um) [4.5]"),
        ("y", "sensor.pixel_pitch_um = 3450: did you mean 3.45 um (3450 nm)?"),
        ("300", "size of the image in pixels"),
        ("300 x 400", "must be [rows, columns]"),
        ("", "n of lenses and plate"),
        ("", "focal length or its radius"),
        ("4,6", "focal length of a lens, in air"),
        ("4.6", "must be a number of mm"),
        ("none.csv", "file of lens centres"),
        ("vendor.csv", "Error: none.csv: cannot be read"),
        ("0.6 0.6", "width (x) and height (y) of the plate"),
        ("", "a plate that holds all lenses"),
        ("5", "D of each lens"),
        ("", "at most 3.956 mm, twice the radius"),
        ("", "t of the plate"),
        ("23 18", "nearest and farthest object"),
        ("18 23", "near below far"),
        ("", "v from the array's back"),
        ("52", "wavelength"),
        ("n", "imaging.wavelength_nm = 52: is it meant?"),
        ("530", ""),
        ("", "radius of back-projection"),
    ]
    done = answered(monkeypatch, *(answer for answer, _ in answers))
    assert done.exit_code == 0, done.output
    assert all(question in done.output for _, question in answers), done.output
    design = read_design("my.toml")
    assert design.sensor.pixel_pitch_um == 3.45 and design.sensor.shape == (300, 400)
    assert design.imaging.wavelength_nm == 530.0 and design.array.centers_mm == CENTERS
    assert design.lens.radius_of_curvature_mm == 1.978


def test_questions_about_centres(lab, monkeypatch):
    """Without a unit, from a corner; and what the options say is not asked for."""
    (lab / "bare.txt").write_text("".join(f"{1000 * x + 500:g} {1000 * y + 500:g}\n" for x, y in CENTERS))
    arguments = options(centers=None)
    answers = ["", "bare.txt", "um", "corner", *[""] * 6]
    done = answered(monkeypatch, *answers, arguments=arguments)
    assert done.exit_code == 0 and "unit of the file's numbers" in done.output, done.output
    assert "no x or y is below 0" in done.output and "pixels" not in done.output
    # The middle of the lenses is that of the plate, whose corner is not known.
    expected = np.array(CENTERS) - (np.min(CENTERS, 0) + np.max(CENTERS, 0)) / 2
    np.testing.assert_allclose(read_design("my.toml").array.centers_mm, expected, atol=1e-6)


def test_questions_for_a_layout_and_a_radius(lab, monkeypatch):
    answers = ["3.45", "2000 3000", "", "radius", "2", "", "30", *[""] * 7]
    done = answered(monkeypatch, *answers)
    assert done.exit_code == 0, done.output
    design = read_design("my.toml")
    assert len(design.array.centers_mm) == 30 and design.lens.radius_of_curvature_mm == 2.0
    assert design.imaging.working_distance_mm == (18.0, 30.0)


def test_what_is_commented_reads_back(tmp_path):
    changes = {"lens.focal_length_mm": 4.0, "calibration.rotation_deg": 12.5, "provenance.note": "a\n[b]"}
    design = Design.model_validate(edited(changes))
    text = commented(design)
    assert tomllib.loads(text) == tomllib.loads(design_text(design))
    assert Design.model_validate(tomllib.loads(text)) == design
    keys = [line.partition(" = ")[0] for line in text.splitlines() if " = " in line and line[0].isalpha()]
    lines = text.splitlines()
    for key in set(keys) - {"note"}:
        at = next(i for i, line in enumerate(lines) if line.startswith(f"{key} = "))
        assert lines[at - 1].startswith("# "), key
    assert all(len(line) <= 120 for line in lines)


def test_every_key_is_described():
    for key in design_keys().values():
        assert key.meaning and key.allowed, key.name
        words = {"mm": "mm", "um": "micrometres", "nm": "nanometres", "deg": "degrees", "": ""}
        assert words[key.unit] in key.allowed, key.name


def is_kind(value: Any, kind: str) -> bool:
    kinds = {"object": dict, "array": list, "string": str, "number": (int, float), "integer": int, "boolean": bool}
    return isinstance(value, kinds[kind]) and (kind == "boolean" or not isinstance(value, bool))


def refused_by(node: Any, value: Any, top: Any) -> str | None:
    """Where a schema of the kind that is written refuses a value; None where it does not."""
    if "$ref" in node:
        return refused_by(top["$defs"][node["$ref"].rpartition("/")[2]], value, top)
    if "type" not in node:
        found = [refused_by(each, value, top) for each in node["oneOf"]]
        return None if found.count(None) == 1 else next(filter(None, reversed(found)))
    if not is_kind(value, node["type"]) or value not in node.get("enum", [value]):
        return "kind"
    if node["type"] == "object":
        if missing := set(node.get("required", ())) - value.keys():
            return missing.pop()
        if "oneOf" in node and sum(set(each["required"]) <= value.keys() for each in node["oneOf"]) != 1:
            return "oneOf"
        if node.get("additionalProperties") is False and (extra := value.keys() - node["properties"].keys()):
            return extra.pop()
        inner = [(each, node.get("properties", {}).get(name)) for name, each in value.items()]
        return next((name for each, of in inner if of and (name := refused_by(of, each, top))), None)
    if node["type"] == "array":
        if not node.get("minItems", 0) <= len(value) <= node.get("maxItems", len(value)):
            return "length"
        return next((name for each in value if (name := refused_by(node["items"], each, top))), None)
    if node["type"] in ("number", "integer"):
        fine = node.get("minimum", value) <= value <= node.get("maximum", value)
        return None if fine and value > node.get("exclusiveMinimum", -math.inf) else "range"
    return "length" if isinstance(value, str) and len(value) < node.get("minLength", 0) else None


def test_the_schema_takes_what_is_shipped(folder, run):
    from gs_jax.cli.options import shipped_designs

    status, out, err = run("new-design", "--schema")
    made = json.loads(out)
    assert (status, err) == (0, "") and made == json.loads(json.dumps(schema()))
    assert "null" not in out and "prefixItems" not in out
    for path in shipped_designs():
        assert refused_by(made, tomllib.loads(path.read_text()), made) is None, path
    file = edited({"array.centers_file": "a.csv", "array.centers_unit": "um", "array.mirror": True})
    assert refused_by(made, file, made) == "oneOf"
    del file["array"]["centers_mm"]
    assert refused_by(made, file, made) is None
    file["lens"]["radius_of_curvature_mm"] = [2.0, 1.9]
    assert refused_by(made, file, made) is None
    file["lens"]["radius_of_curvature_mm"] = [2.0, -1.9]
    assert refused_by(made, file, made) == "range"
    assert made["$defs"]["LensTable"]["required"] == ["refractive_index"]
    # It refuses as reading does.
    assert refused_by(made, BASE, made) is None
    for key, value, where in [
        ("name", 3, "kind"),
        ("sensor.shape", [3], "length"),
        ("sensor.shape", [3, 1], "range"),
        ("sensor.pitch", 3, "pitch"),
        ("lens.refractive_index", 1.0, "range"),
        ("imaging.wavelength_nm", 0.52, "range"),
        ("array.centers_unit", "inch", "kind"),
        ("array.centers_mm", [[1.0, "a"]], "kind"),
    ]:
        assert refused_by(made, edited({key: value}), made) == where
        with pytest.raises(ValueError), warnings.catch_warnings():
            Design.model_validate(edited({key: value}))
