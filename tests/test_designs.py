import copy
import dataclasses
import datetime
import math
import os
import re
import tomllib
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings, strategies as st
from pydantic import ValidationError

from gs_jax import geomscope
from gs_jax.base.errors import InputError, InputWarning
from gs_jax.cli.options import ask_for_unit, shipped_designs
from gs_jax.codesign.search import problem_of
from gs_jax.codesign.study import read_study
from gs_jax.design.design import Design, read_design, write_design
from gs_jax.design.start import commented, design_keys
from gs_jax.design.validation import USUAL, slip
from gs_jax.microscope.layouts import coverage, nearest_neighbour_distances
from gs_jax.microscope.lenses import lenses_by_type
from gs_jax.microscope.media import MATERIALS, refractive_index
from gs_jax.optics.raytrace import to_numpy

from .helpers import DESIGN, examples, needs, quantities

ROOT = Path(__file__).parents[1]
DESIGNS = sorted(p for folder in ("design", "experiments/designs") for p in (ROOT / folder).glob("*.toml"))

BASE = {
    "name": "small",
    "sensor": {"pixel_pitch_um": 4.5, "shape": [400, 300]},
    "lens": {"radius_of_curvature_mm": 2.0, "refractive_index": 1.43, "aperture_diameter_mm": 2.0},
    "array": {
        "size_mm": [3.0, 4.0],
        "substrate_thickness_mm": 1.0,
        "centers_mm": [[-1.0, -0.5], [0.5, 1.25], [1.0, -1.0]],
    },
    "imaging": {
        "sensor_distance_mm": 5.8,
        "working_distance_mm": [18.0, 30.0],
        "wavelength_nm": 520.0,
        "field_radius_mm": 3.0,
    },
}
MISSING = object()


def edited(changes):
    """The base with keys set, or removed where the value is MISSING."""
    data = copy.deepcopy(BASE)
    for dotted, value in changes.items():
        *tables, key = dotted.split(".")
        table = data
        for name in tables:
            table = table.setdefault(name, {})
        if value is MISSING:
            table.pop(key, None)
        else:
            table[key] = value
    return data


def written(folder, changes=None, name="design.toml"):
    path = folder / name
    path.write_text(tomli_w.dumps(edited(changes or {})))
    return path


def message_of(path, *words):
    """The line of the InputError that reading raises; it names the file and all the words."""
    before = sorted(os.listdir(path.parent))
    with pytest.raises(InputError) as caught:
        read_design(path)
    message = str(caught.value)
    assert message.isprintable() and len(message) < 1000
    for word in (path.name, *words):
        assert word in message, f"{word!r} is not in {message!r}"
    assert sorted(os.listdir(path.parent)) == before
    return message


def with_key(path, value):
    """Changes that set one key; those of tables in lists, or of a sample, in a table that is right."""
    table, _, name = path.rpartition(".")

    def table_with(**right):
        return {key: own for key, own in (right | {name: value}).items() if own is not MISSING}

    if table in ("layers.object", "layers.sensor"):
        return {table: [table_with(thickness_mm=0.5)]}
    if table == "sample.layers":
        return {"sample": {"refractive_index": 1.4, "layers": [table_with(thickness_mm=0.5)]}}
    if table == "sample":
        return {"sample": table_with(refractive_index=1.4)}
    is_of_file = path.startswith("array.centers_") and path != "array.centers_mm"
    return ({"array.centers_mm": MISSING, "array.centers_file": "c.csv"} if is_of_file else {}) | {path: value}


@pytest.mark.parametrize("path", [path for path, key in design_keys().items() if key.table or key.name == "name"])
def test_each_key_says_what_it_allows(tmp_path, path):
    """Of another type, not finite, out of range, or missing."""
    key = design_keys()[path]
    refused = [datetime.date(2026, 1, 1), math.nan, 10**400, {"a": 1}, *([] if path == "array.mirror" else [True])]
    if ends := re.match(r"a number .*?(?:from|above) (\S+?),? (?:up )?to (\S+?)(?:,|$)", key.allowed):
        least, most = map(float, ends.groups())
        refused += [least - 0.5 * max(abs(least), 1e-6), 1.5 * most, -math.inf]
    for value in refused + [MISSING] * key.required:
        message = message_of(written(tmp_path, with_key(path, value)), key.name, key.allowed)
        assert value is not MISSING or "nothing" in message


GEL = {"refractive_index": 1.33}
# What is changed, and the words that the line must have besides the file's name.
WRONG = [
    ({"sensor": MISSING}, ["`sensor`", "nothing", "a table"]),
    ({"lens": [1, 2]}, ["`lens`", "[1, 2]", "a table"]),
    ({"calibration": 3}, ["`calibration`", "got 3", "a table"]),
    ({"provenance": "me"}, ["`provenance`", "'me'", "a table"]),
    ({"samples": {"gel": 1.33}}, ["`samples.gel` must be a table"]),
    ({"layers.object": {"thickness_mm": 2.0}}, ["`layers.object` must be a list of tables"]),
    # Keys of another name, table or unit.
    ({"lens.radius_mm": 2.0}, ["`lens.radius_mm`", "no such key"]),
    ({"lens.wavelength_nm": 2.0}, ["`lens.wavelength_nm`", "`imaging.wavelength_nm`"]),
    ({"sensor.pixel_pitch_mm": 0.0045}, ["`sensor.pixel_pitch_mm`", "`pixel_pitch_um`"]),
    ({"calibration.rotation_rad": 1.0}, ["`calibration.rotation_rad`", "`rotation_deg`"]),
    ({"layers.object": [{"thicknes_mm": 2.0}]}, ["did you mean `thickness_mm`"]),
    ({"layers.object": [{"thickness_mm": 2.0, "surface_mm": 2.0}]}, ["`sample.surface_mm`"]),
    ({"sensors": {"shape": [4, 4]}}, ["`sensors`", "`sensor`"]),
    ({"zebra": 1}, ["`zebra`", "`sensor`", "`lens`"]),
    ({"bad\n\x1b[31mkey": 1}, ["no such key"]),
    # Elements of lists.
    ({"sensor.shape": [400, 300, 3]}, ["`sensor.shape`", "[400, 300, 3]", "[rows, columns]"]),
    ({"sensor.shape": [400.0, 300.0]}, ["`sensor.shape[0]`", "400.0", "whole numbers"]),
    ({"sensor.shape": [400, 10**9]}, ["`sensor.shape[1]`", "1000000000", "from 2 to 65536"]),
    ({"array.size_mm": [3.0, -4.0]}, ["`array.size_mm[1]`", "-4.0", "[x, y] in mm"]),
    ({"array.size_mm": []}, ["`array.size_mm", "[x, y] in mm"]),
    ({"array.centers_mm": []}, ["`array.centers_mm`", "[]", "1 to 100000"]),
    ({"array.centers_mm": [[0.0, 0.0, 0.0]]}, ["`array.centers_mm[0]`", "[0.0, 0.0, 0.0]", "[x, y] in mm"]),
    ({"array.centers_mm": [[0.0, math.nan]]}, ["`array.centers_mm[0][1]`", "nan"]),
    ({"calibration.tilt_deg": [1.0, 30.0]}, ["`calibration.tilt_deg", "from -10 to 10"]),
    ({"lens.radius_of_curvature_mm": [2.0, "a", 2]}, ["`lens.radius_of_curvature_mm[1]`", "'a'", "for each lens"]),
    ({"lens.aperture_diameter_mm": []}, ["`lens.aperture_diameter_mm`", "got []", "for each lens"]),
    ({"lens.conic_constant": [0.0, 0, 300]}, ["`lens.conic_constant[2]`", "-100 to 100"]),
    ({"lens.aspheric_terms": [0.0] * 7}, ["must be up to 6 numbers"]),
    # Materials.
    ({"lens.refractive_index": 1}, ["`lens.refractive_index`", "above 1"]),
    ({"lens.refractive_index": "air"}, ["`lens.refractive_index` must be above 1"]),
    ({"lens.refractive_index": "PMMA", "imaging.wavelength_nm": 400.0}, ["`imaging.wavelength_nm` and `lens.refrac"]),
    ({"layers.object": [{"thickness_mm": 2.0, "refractive_index": "glass"}]}, ["`layers.object[0].refractive_index`"]),
    # Files of centres.
    ({"array.centers_file": "no.csv"}, ["`array.centers_file`", "`array.centers_mm`", "only one of"]),
    ({"array.centers_mm": MISSING, "array.centers_files": "a.csv"}, ["`array.centers_files`", "`centers_file`"]),
    ({"array.centers_mm": MISSING, "array.centers_file": "no.csv"}, ["`array.centers_file`", "no.csv", "No such file"]),
    ({"array.centers_mm": MISSING, "array.centers_file": "."}, ["`array.centers_file`", "a folder"]),
    ({"array.centers_mm": MISSING, "array.centers_file": "a\0b\n"}, ["`array.centers_file`", "null"]),
    ({"array.centers_mm": MISSING, "array.centers_file": "a" * 300}, ["`array.centers_file`", "name too long"]),
    ({"array.centers_unit": "um"}, ["`array.centers_unit`", "needs `array.centers_file`"]),
    *(({"array.centers_mm": rows, "array.mirror": True}, ["array.centers_mm"]) for rows in (3, [3], [["x", 1]], [[]])),
    # What does not fit together: lenses,
    ({"lens.aperture_diameter_mm": 4.1}, ["`lens.aperture_diameter_mm`", "4.1", "at most 4.0 mm"]),
    ({"lens.conic_constant": 3.0, "lens.aperture_diameter_mm": 2.5}, ["must be at most 2.0 mm, where the conic ends"]),
    ({"lens.aspheric_terms": [-1.0]}, ["with which lenses rise at 0.3"]),
    ({"lens.radius_of_curvature_mm": [2.0, 1.9]}, ["`lens.radius_of_curvature_mm`", "one number or 3", "got 2"]),
    ({"lens.radius_of_curvature_mm": [2.0, 0.9, 2]}, ["`lens.aperture_diameter_mm`", "2.0 of lens 2", "1.8 mm"]),
    ({"lens.aspheric_terms": [-0.1], "lens.radius_of_curvature_mm": [2.0, 2, 4]}, ["lens 3 rises"]),
    # their places,
    ({"array.centers_mm": [[0.0, 0.0], [0.0, 2.1]]}, ["`array.centers_mm`", "lens 2", "2.1", "|y| up to 2.0 mm"]),
    ({"array.centers_mm": [[0.0, 0.0], [1.0, 0.0], [1.0, 0.0009]]}, ["`array.centers_mm`", "lens", "0.001 mm"]),
    ({"array.centers_mm": [[1.0, 0.0]] * 5}, ["`array.centers_mm`", "lens", "0.001 mm"]),
    ({"array.size_mm": [30.0, 30.0], "array.centers_mm": [[-9.0, 0.0]]}, ["`array.centers_mm`", "lens 1", "sensor"]),
    ({"calibration.shift_mm": [9.0, 0.0]}, ["`array.centers_mm`", "lens", "beside the sensor"]),
    # and the light's path.
    ({"imaging.working_distance_mm": [30.0, 18.0]}, ["`imaging.working_distance_mm`", "[30.0, 18.0]", "near below"]),
    ({"layers.sensor": [{"thickness_mm": 7.0}]}, ["`layers.sensor` must be at most `imaging.sensor_distance_mm`, 5.8"]),
    ({"layers.sensor": [{"thickness_mm": 550.0}]}, ["layers.sensor[0].thickness_mm = 550: did you mean 0.55 mm"]),
    ({"layers.object": [{"thickness_mm": 40.0}]}, ["`imaging.working_distance_mm` must be beyond 40 mm"]),
    ({"sample": GEL | {"surface_mm": 31.0}}, ["must be beyond 31 mm, where layers end"]),
    (
        {"layers.object": [{"thickness_mm": 2.0}], "sample": GEL | {"surface_mm": 1.0}},
        ["`sample.surface_mm` must be 2 mm or more"],
    ),
    ({"lens.orientation": "curved", "sample": GEL}, ["curved side in front, got a sample in"]),
    ({"lens.orientation": "curved", "samples": {"gel": GEL}}, ["`samples.gel.surface_mm`"]),
    ({"samples": {"air": GEL}}, ["`samples.air` must have another name"]),
    ({"samples": {"none": GEL}}, ["`samples.none` must have another name"]),
]  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "words"), WRONG, ids=[" ".join(changes)[:40] + str(i) for i, (changes, _) in enumerate(WRONG)]
)
@pytest.mark.filterwarnings("ignore::gs_jax.base.errors.InputWarning")
def test_wrong_design(tmp_path, changes, words):
    message_of(written(tmp_path, changes), *words)


TEXTS = {
    "syntax": (b"name = \n", ["TOML", "line 1"]),
    "duplicate": (b'name = "a"\nname = "b"\n', ["TOML", "line 2"]),
    "nested": (b"a = " + b"[" * 100_000, ["TOML"]),
    "digits": (b"a = " + b"1" * 10_000, ["TOML"]),
    "date": (b"a = 2026-13-45\n", ["TOML"]),
    "latin": (b'name = "\xe9"\n', ["UTF-8", "offset 8"]),
    "binary": (bytes(range(256)), ["UTF-8"]),
    "empty": (b"", ["`name`", "`sensor`", "more problems"]),
    "tables": (b"[[sensor]]\nshape = [3, 4]\n", ["`sensor`", "a table"]),
}
CENTERS = {
    "no bytes": (b"", ["c.csv", "header", "x_mm,y_mm"]),
    "header only": (b"x_mm,y_mm\n", ["`array.centers_mm`", "[]"]),
    "ragged": (b"x_mm,y_mm\n1,2\n3\n", ["c.csv", "line 3", "got 1 values"]),
    "wide": (b"x_mm,y_mm\n1,2,3\n", ["c.csv", "line 2", "got 3 values"]),
    "word": (b"x_mm,y_mm\n1,two\n", ["c.csv", "line 2", "y_mm", "'two'", "finite number"]),
    "nan": (b"x_mm,y_mm\nnan,2\n", ["c.csv", "line 2", "x_mm", "'nan'", "finite number"]),
    "underscore": (b"x_mm,y_mm\n1_0,2\n", ["c.csv", "line 2", "x_mm", "'1_0'"]),
    "one byte": (b"x_mm,y_mm\n\xe9,2\n", ["c.csv", "UTF-8"]),
    "wide character": ("x_mm,y_mm\n1,2\n".encode("utf-16"), ["c.csv", "UTF-8"]),
    "field": (b"x_mm,y_mm\n" + b"1" * 200_000, ["c.csv", "line", "field limit"]),
    "rows": (b"x_mm,y_mm\n" + b"1,2\n" * 100_001, ["c.csv", "more than 100000 rows"]),
    # Quickly, too.
    "coincident": (b"x_mm,y_mm\n" + b"0.5,0.5\n" * 100_000, ["`array.centers_mm`", "0.001 mm"]),
    "outside": (b"x_mm,y_mm\n0,0\n9,9\n", ["lens 2", "plate"]),
    "micrometres": (b"0,0\n-1000,500\n", ["lens 2", "plate", 'micrometres (`centers_unit = "um"`)?']),
    "corner": (b"0.1,0.1\n2.9,3.9\n", ["lens 2", "plate", '`centers_origin = "corner"`']),
    "both": (b"100,100\n2900,3900\n", ["lens 1", 'from a corner (`centers_unit = "um"`']),
    "three columns": (b"1,2,3\n", ["c.csv", "3 columns without a header", "`centers_columns`"]),
    "names": (b"n,a,b\n1,2,3\n", ["c.csv", "3 columns: 'n', 'a', 'b'", "`centers_columns`"]),
    "twice": (b"x,x,y\n1,2,3\n", ["c.csv", "3 columns: 'x', 'x', 'y'"]),
    "half a header": (b"1.0,n/a\n1,2\n", ["c.csv", "'1.0,n/a'", "names, or numbers"]),
    "no numbers": (b"# made by hand\n\n", ["c.csv", "no line", "header"]),
    "decimals": (b"x;y\n1,5;1.000,5\n", ["c.csv", "line 2", "'1.000,5'"]),
}


@pytest.mark.parametrize("name", [*TEXTS, *CENTERS])
def test_wrong_text(tmp_path, name):
    path = written(tmp_path, {"array.centers_mm": MISSING, "array.centers_file": "c.csv"})
    text, words = (TEXTS | CENTERS)[name]
    (path if name in TEXTS else tmp_path / "c.csv").write_bytes(text)
    message_of(path, *words)


def test_wrong_path(tmp_path, monkeypatch):
    message_of(tmp_path / "none.toml", "No such file")
    (tmp_path / "folder.toml").mkdir()
    message_of(tmp_path / "folder.toml", "a folder")
    os.mkfifo(tmp_path / "pipe.toml")
    message_of(tmp_path / "pipe.toml", "must be a file, got a device or a pipe")
    assert "null" in str(pytest.raises(InputError, read_design, "a\0b").value)
    with (tmp_path / "large.toml").open("wb") as file:
        file.truncate(2**26 + 1)
    message_of(tmp_path / "large.toml", str(2**26))

    def denied(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    path = written(tmp_path)
    monkeypatch.setattr("builtins.open", denied)  # the tests may run as root, whom no mode stops
    message_of(path, "Permission denied")


def test_problems_are_joined_in_one_line(tmp_path):
    changes = {"name": MISSING, "lens.refractive_index": 0.5, "imaging.field_radius_mm": "3", "sensor.shape": [1, 1]}
    assert message_of(written(tmp_path, changes)).count("; ") == 3


def test_values_reach_the_geometry_in_mm(tmp_path):
    changes = {"lens.focal_length_mm": 4.0, "calibration.rotation_deg": 90, "calibration.shift_mm": [0.25, -0.5]}
    imager = read_design(written(tmp_path, changes)).imager()
    assert imager.array.centers.dtype == jnp.float64
    imager = to_numpy(imager)
    assert imager.sensor.pixel_pitch == pytest.approx(0.0045, rel=1e-15) and imager.sensor.shape == (400, 300)
    assert float(imager.array.focal_length) == 4.0 and imager.field_radius == 3.0
    assert float(imager.sensor_distance) == 5.8 and float(imager.array.substrate_thickness) == 1.0
    x, y = np.array(BASE["array"]["centers_mm"]).T
    np.testing.assert_allclose(imager.centers, np.stack([-y + 0.25, x - 0.5], 1), atol=1e-15)
    assert imager.tilt is None
    tilted = to_numpy(read_design(written(tmp_path, {"calibration.tilt_deg": [1.0, 0.0]})).imager())
    np.testing.assert_allclose(tilted.heights, np.sin(np.radians(1)) * x, atol=1e-15)


def test_reach_is_the_radius_of_the_sub_image(tmp_path):
    near, field = 18.0, 3.0
    radius = 5.8 / (near + 1.0 / 1.43) * field
    edge = 300 * 0.0045 / 2
    for x, fine in ((edge + radius - 1e-6, True), (edge + radius + 1e-6, False)):
        path = written(tmp_path, {"array.centers_mm": [[x, 0.0]], "array.size_mm": [5.0, 5.0]})
        if fine:
            read_design(path)
        else:
            message_of(path, "beside the sensor")


def test_least_is_enough_and_integers_are_numbers(tmp_path):
    design = read_design(written(tmp_path, {"lens.radius_of_curvature_mm": 2, "array.centers_mm": [[0, 1]]}))
    assert design.lens.focal_length_mm is None and design.provenance == {}
    assert design.calibration.rotation_deg == 0.0 and design.calibration.shift_mm == (0.0, 0.0)
    assert type(design.lens.radius_of_curvature_mm) is float and design.array.centers_mm == ((0.0, 1.0),)
    with pytest.raises(ValidationError):
        design.name = "other"


def test_the_authors_array():
    design = read_design(needs("oracle/dev/P1.toml"))
    assert len(design.array.centers_mm) == 213 and design.array.centers_mm[1] == (-9.34, -7.77)
    assert design.imager().sensor.shape == (5120, 5120)


def test_what_is_written(tmp_path, monkeypatch):
    """As the contract has it; a file of centres, relative to the design, is written inline."""
    (tmp_path / "sub").mkdir()
    (tmp_path / "c.csv").write_bytes(b"\xef\xbb\xbfx_mm,y_mm\r\n0.1,-0.2\r\n\r\n1e-1,1.5\r\n")
    strings = {"a": "[\n    1,\n    2,\n]", "b": ["x,y", "[1, 2]"], "c": [["a", 1], [1, 2], [[1, 2], 3]], "d": [1]}
    provenance = strings | {"made": datetime.date(2026, 1, 1)}
    file = {"array.centers_mm": MISSING, "array.centers_file": "../c.csv"}
    path = written(tmp_path / "sub", file | {"provenance": provenance})
    monkeypatch.chdir(tmp_path)
    design = read_design(Path("sub/design.toml"))
    assert design.array.centers_mm == ((0.1, -0.2), (0.1, 1.5)) and design.provenance == provenance
    write_design(path, design)
    text = path.read_text()
    assert "    [0.1, -0.2],\n" in text and "shape = [400, 300]\n" in text
    assert "working_distance_mm = [18.0, 30.0]\n" in text
    changes = {"provenance": provenance, "array.centers_mm": [[0.1, -0.2], [0.1, 1.5]]}
    assert tomllib.loads(text) == edited(changes) and read_design(path) == design
    for wrong, words in ((tmp_path / "a.json", ".toml"), (tmp_path / "none" / "a.toml", "there is no folder")):
        with pytest.raises(InputError, match=re.escape(words)):
            write_design(wrong, design)
    assert sorted(os.listdir(tmp_path)) == ["c.csv", "sub"]


VALUES = st.recursive(
    st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.text() | st.dates(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@pytest.mark.filterwarnings("ignore::gs_jax.base.errors.InputWarning")
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    name=st.text(),
    radius=st.floats(1.0, 1e4),
    shift=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    x=st.floats(-0.9, 0.49),
    provenance=st.dictionaries(st.text(), VALUES, max_size=3),
)
def test_round_trip(tmp_path, name, radius, shift, x, provenance):
    changes = {"lens.radius_of_curvature_mm": radius, "calibration.shift_mm": shift, "provenance": provenance}
    centers = [[x, -1.0], [0.5, 1.25]]
    design = Design.model_validate(edited(changes | {"name": name, "array.centers_mm": centers}))
    write_design(tmp_path / "a.toml", design)
    assert read_design(tmp_path / "a.toml") == design
    assert os.listdir(tmp_path) == ["a.toml"]


@settings(max_examples=examples(300), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_text_is_read_or_refused(tmp_path, data):
    """Random bytes; bytes of a valid file changed, cut out or doubled; a value replaced by any other."""

    def mutated(text):
        text = bytearray(text)
        for _ in range(data.draw(st.integers(1, 3))):
            at = data.draw(st.integers(0, len(text) - 1))
            text[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
        return text

    path, kind = written(tmp_path), data.draw(st.sampled_from(["random", "design", "centers", "value"]))
    if kind == "random":
        texts = st.text(max_size=200).map(lambda text: text.encode("utf-8", "surrogatepass"))
        path.write_bytes(data.draw(st.binary(max_size=200) | texts))
    elif kind == "design":
        path.write_bytes(mutated(tomli_w.dumps(BASE | {"calibration": {"shift_mm": [0.1, 0.1]}}).encode()))
    elif kind == "centers":
        (tmp_path / "c.csv").write_bytes(mutated(b"x_mm,y_mm\n-1.0,0.5\n0.25,1.0\n"))
        path = written(tmp_path, {"array.centers_mm": MISSING, "array.centers_file": "c.csv"})
    else:
        keys = [f"{table}.{key}" for table in BASE if table != "name" for key in BASE[table]]
        path.write_text(tomli_w.dumps(edited({data.draw(st.sampled_from(keys)): data.draw(VALUES)})))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)
            design = read_design(path)
    except InputError as error:
        assert str(error).isprintable() and path.name in str(error)
    else:
        assert isinstance(design, Design) and design.imager().centers.shape[1] == 2


RADII = [2.0, 1.9, 2.0]
LISTS = {"lens.radius_of_curvature_mm": RADII, "lens.conic_constant": [0.0, -0.5, 0]}


def test_lists_are_numbers_of_each_lens(tmp_path):
    design = read_design(written(tmp_path, LISTS))
    array = design.imager().array
    np.testing.assert_array_equal(array.of_lenses("radius_of_curvature"), RADII)
    np.testing.assert_array_equal(array.of_lenses("conic_constant"), [0, -0.5, 0])
    assert array.aperture_diameter.shape == () and lenses_by_type(array) == ((0, 2), (1,))
    assert "3 lenses of 2 types, R = 1.9 to 2 mm, k = -0.5 to 0, n = 1.43, D = 2 mm" in repr(design)
    write_design(tmp_path / "same.toml", design)
    (tmp_path / "commented.toml").write_text(commented(design))
    assert read_design(tmp_path / "same.toml") == read_design(tmp_path / "commented.toml") == design
    # A list of one number is that number: what is alike stays as fast as it is.
    alike = read_design(written(tmp_path, {"lens.radius_of_curvature_mm": [1.9, 1.9, 1.9]}))
    assert alike.imager().array.alike and "3 lenses, R = 1.9 mm" in repr(alike)


def test_the_shape_of_a_lens_goes_to_the_imager_and_back(tmp_path):
    shape = {"orientation": "curved", "conic_constant": -0.7, "aspheric_terms": (0.01, -0.002)}
    data = copy.deepcopy(BASE)
    data["lens"] |= shape
    design = Design.model_validate(data)
    write_design(tmp_path / "shape.toml", design)
    assert (found := read_design(tmp_path / "shape.toml")) == design
    array = found.imager().array
    assert array.orientation == "curved" and float(array.conic_constant) == -0.7
    np.testing.assert_allclose(array.aspheric_terms, [0.01, -0.002])
    # The plate counts on the sensor's side.
    imager = found.imager()
    np.testing.assert_allclose(imager.reduced_depth(20.0), 20.0)
    v = design.imaging.sensor_distance_mm
    np.testing.assert_allclose(imager.reduced_sensor_distance, v + 1 / 1.43)
    assert "k = -0.7, 2 aspheric terms, curved side to the object" in repr(found)


EVERYTHING = {
    "lens.radius_of_curvature_mm": [2.0, 2.1, 2.0],
    "lens.conic_constant": -0.6,
    "lens.orientation": "curved",
    "sensor.origin_mm": [0.13, -0.07],
    "sensor.pixel_pitch_um": 3.45,
    "imaging.wavelength_nm": 532.1,
    "calibration": {"rotation_deg": 31.4, "shift_mm": [0.1, -0.2], "tilt_deg": [0.9, -0.7]},
}


def with_numbers(design):
    """The design with numbers, that single precision keeps, in place of names of materials, which no imager has."""

    def numbers(node):
        if isinstance(node, dict):
            return {key: numbers(value) for key, value in node.items()}
        if isinstance(node, tuple | list):
            return tuple(map(numbers, node))
        return round(refractive_index(node, design.imaging.wavelength_nm), 6) if node in MATERIALS else node

    return Design.model_validate(numbers(design.model_dump(exclude_none=True)))


@pytest.mark.parametrize("x64", [False, True])
@pytest.mark.parametrize("path", [*DESIGNS, None], ids=lambda path: path.stem if path else "everything")
def test_a_design_is_its_imagers(path, x64):
    with jax.enable_x64(x64 or path is None):
        design = read_design(path) if path else Design.model_validate(edited(EVERYTHING))
        design = with_numbers(design.model_copy(update={"provenance": {}}))
        imager, depths = design.imager(), design.imaging.working_distance_mm
        found = Design.from_imager(imager, name=design.name, working_distance_mm=depths)
        assert found == design
        (leaves, tree), (expected, structure) = map(jax.tree.flatten, (found.imager(), imager))
        assert tree == structure and [leaf.dtype for leaf in leaves] == [leaf.dtype for leaf in expected]
        assert all(np.array_equal(a, b) for a, b in zip(leaves, expected, strict=True))


def test_a_design_of_an_imager_says_what_is_sharp():
    design = geomscope()
    found = Design.from_imager(design.imager(), name="mine").imaging.working_distance_mm
    in_focus = 1 / (0.43 / 2.0 - 1 / 5.8) - 1.0 / 1.43
    limits = quantities(design.imager(), np.array([in_focus]), ("near_limit", "far_limit"))
    assert found == pytest.approx([float(limits[name][0]) for name in ("near_limit", "far_limit")], abs=2e-3)
    with pytest.raises(InputError, match="working_distance_mm must be given .*: no depth is in focus"):
        Design.from_imager(design.replace(sensor_distance_mm=4.0).imager(), name="mine")
    endless = dataclasses.replace(design.imager().array, size=(math.inf, math.inf))
    with pytest.raises(InputError, match="`array.size` must be given"):
        Design.from_imager(dataclasses.replace(design.imager(), array=endless), name="mine")


def test_keys_are_replaced_and_checked():
    design = geomscope()
    moved = design.replace(centers_mm=np.array([[0.0, 0.0], [1.5, 0.25]]), sensor_distance_mm=6.0, name="two")
    assert moved.array.centers_mm == ((0.0, 0.0), (1.5, 0.25)) and moved.imaging.sensor_distance_mm == 6.0
    assert moved.name == "two" and moved.lens == design.lens
    with pytest.raises(InputError, match="such as sensor_distance_mm, .*got sensor_distance"):
        design.replace(sensor_distance=6.0)
    with pytest.raises(InputError, match="`imaging.sensor_distance_mm` must be a number of mm.*-1"):
        design.replace(sensor_distance_mm=-1)
    with pytest.raises(InputError, match="near below far"):
        design.replace(working_distance_mm=(30.0, 18.0))


def test_searches_keep_which_lens_is_of_which_kind(tmp_path):
    design = read_design(written(tmp_path, LISTS))
    study = read_study("experiments/designs/studies/geomscope-targets.toml")
    assert lenses_by_type(problem_of(design, study).imager.array) == ((0, 2), (1,))


@pytest.mark.parametrize(
    ("folder", "name", "distance"), [("design", "geomscope", 5.8), ("experiments/designs", "geomscope-table1", 4.0)]
)
def test_designs_are_what_their_script_makes(folder, name, distance):
    shipped = read_design(ROOT / folder / f"{name}.toml")
    made = geomscope(sensor_distance_mm=distance)
    # The layout's search sums floats, so another processor may round its way to another layout: not the centres.
    same = lambda design: design.model_dump(exclude={"name", "provenance", "array"})
    assert shipped.name == name
    assert same(shipped) == same(made)


def test_the_layout_has_the_papers_statistics():
    design = read_design(ROOT / "design" / "geomscope.toml")
    centers = np.array(design.array.centers_mm)
    distances = nearest_neighbour_distances(centers)
    assert len(centers) == 200
    assert abs(distances.mean() - 1.23) <= 0.02 and abs(distances.std() - 0.09) <= 0.02
    assert coverage(centers, design.array.size_mm, diameter=2.0) == pytest.approx(1, abs=1e-4)


# Lens centres as vendors, programs and people write them.


# Of three lenses, mm.
CENTERS_CENTERS = ((-1.0, -0.5), (0.5, 1.25), (1.0, -1.0))
FORMS = {
    "ours": "x_mm,y_mm\n-1,-0.5\n0.5,1.25\n1,-1\n",
    "no header": "-1,-0.5\n0.5,1.25\n1,-1\n",
    "spaced": " x_mm , y_mm \n -1, -0.5\n0.5 ,1.25 \n\n  1 , -1  \n",
    "semicolons": "x_mm;y_mm\n-1;-0.5\n0.5;1.25\n1;-1\n",
    "decimal commas": "x;y\n-1,0;-0,5\n0,5;1,25\n1;-1\n",
    "tabs": "x\ty\n-1\t-0.5\n0.5\t1.25\n1\t-1\n",
    "blanks": "x (mm)  y (mm)\n-1.0   -0.5\n 0.5    1.25\n 1.0   -1.0\n",
    "blanks alone": "-1 -0.5\r\n0.5 1.25\r\n1 -1\r\n",
    "numpy's": "# X [mm] Y [mm]\n-1.000e+00 -5.000e-01\n5.0e-01 1.25e+00\n1 -1\n",
    "remarks": "# array 12 of July\n\nx,y\n# first\n-1,-0.5\n0.5,1.25\n1,-1\n",
    "micrometres": "x_um,y_um\n-1000,-500\n500,1250\n1000,-1000\n",
    "a vendor's": '"Lens #","Pos X (µm)","Pos Y (µm)","Sag"\n1,-1000,-500,ok\n2,500,1250,ok\n3,1000,-1000,bad\n',
    "another letter": "no;X [μm];Y [μm]\nA;-1000;-500\nB;500;1250\nC;1000;-1000\n",
    "in words": "center x micron,center y micron\n-1000,-500\n500,1250\n1000,-1000\n",
    "y first": "Y,X\n-0.5,-1\n1.25,0.5\n-1,1\n",
    "Fiji's": " ,Area,X,Y,XM\n1,7,-1,-0.5,0\n2,7,0.5,1.25,0\n3,7,1,-1,0\n",
}


def with_file(folder, text, **keys):
    (folder / "c.csv").write_text(text, encoding="utf-8", newline="")
    changes = {"array.centers_mm": MISSING, "array.centers_file": "c.csv"}
    return written(folder, changes | {f"array.{key}": value for key, value in keys.items()})


@pytest.mark.parametrize("text", FORMS.values(), ids=FORMS)
def test_forms(tmp_path, text):
    assert read_design(with_file(tmp_path, text)).array.centers_mm == CENTERS_CENTERS


def test_a_spreadsheets_micrometres(tmp_path):
    """Of Windows: one byte for the Greek letter, a line end of its own, decimal commas."""
    path = with_file(tmp_path, "")
    text = "Nr.;X [µm];Y [µm]\r\n1;-1000,0;-500,0\r\n2;500,0;1250,0\r\n3;1000,0;-1000,0\r\n"
    (tmp_path / "c.csv").write_bytes(text.encode("cp1252"))
    assert read_design(path).array.centers_mm == CENTERS_CENTERS


def test_columns_by_name_and_unit_by_key(tmp_path):
    text = "a,b,c\n9,-500,-1000\n9,1250,500\n9,-1000,1000\n"
    path = with_file(tmp_path, text, centers_columns=["c", "b"], centers_unit="um")
    assert read_design(path).array.centers_mm == CENTERS_CENTERS
    blanks = "n  X (um)  Y (um)  Z (um)\n9 0 -1000 -500\n9 0 500 1250\n9 0 1000 -1000\n"
    path = with_file(tmp_path, blanks, centers_columns=["Y (um)", "Z (um)"])
    assert read_design(path).array.centers_mm == CENTERS_CENTERS
    message_of(with_file(tmp_path, text, centers_columns=["c", "d"]), "column 'd'", "'a', 'b', 'c'")
    message_of(with_file(tmp_path, "1,2\n", centers_columns=["c", "d"]), "no header", "'c' and 'd'")


@pytest.mark.parametrize(
    ("header", "factors"),
    [
        ("x_cm,y_cm", (10, 10)),
        ("x_m,y_m", (1000, 1000)),
        ("x_inch,y_inch", (25.4, 25.4)),
        ("X [in],Y [in]", (25.4, 25.4)),
        ('X ("),Y (")', (25.4, 25.4)),
        ("x_nm,y_nm", (1e-6, 1e-6)),
        ("x (mil),y (mil)", (0.0254, 0.0254)),
        ("x (foot),y (foot)", (304.8, 304.8)),
        ("center x in micrometers,center y in micrometers", (1e-3, 1e-3)),
        # One alone is that of both, two are each its own.
        ("x_cm,y", (10, 10)),
        ("x_mm,y_um", (1, 1e-3)),
        ("x_pos,y_pos", (1, 1)),
        ("x_m,y_m,radius_of_curvature_mm", (1000, 1000)),
    ],
)
def test_units_of_headers(tmp_path, header, factors):
    rows = "\n".join(",".join(map(repr, [*(np.array(row) / factors).tolist(), 2.0])) for row in CENTERS_CENTERS)
    rows = rows if header.count(",") == 2 else rows.replace(",2.0", "")
    changes = {"lens.radius_of_curvature_mm": MISSING, "array.centers_mm": MISSING, "array.centers_file": "c.csv"}
    (tmp_path / "c.csv").write_text(f"{header}\n{rows}\n", encoding="utf-8")
    changes = changes if header.count(",") == 2 else {**changes, "lens.radius_of_curvature_mm": 2.0}
    np.testing.assert_allclose(read_design(written(tmp_path, changes)).array.centers_mm, CENTERS_CENTERS, rtol=1e-12)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("x_furlong,y_furlong", ["c.csv", "column 'x_furlong'", "nm, um, mm, cm", "got 'furlong'"]),
        ("x (deg),y (deg)", ["column 'x (deg)'", "got 'deg'"]),
        ("x_px,y_mm", ["both columns must be in pixels, or none", "x_px,y_mm"]),
        ("x_mm,y_mm,radius_of_curvature_um", ["column 'radius_of_curvature_um' must be radius_of_curvature_mm"]),
    ],
)
def test_other_units_are_refused_by_name(tmp_path, header, words):
    rows = "".join(f"{x},{y}{',2' * (header.count(',') - 1)}\n" for x, y in CENTERS_CENTERS)
    message_of(with_file(tmp_path, f"{header}\n{rows}"), *words)


def test_pixels_are_those_of_a_capture(tmp_path):
    """As the contract has it: x = (column - (columns - 1) / 2) pitch; the sensor has 400 rows of 300 pixels."""
    middle, pitch = np.array([299, 399]) / 2, 0.0045
    for first, origin in ((middle, {}), (0 * middle, {"centers_origin": "center"})):
        rows = "".join(f"{x!r},{y!r}\n" for x, y in (np.array(CENTERS_CENTERS) / pitch + first).tolist())
        path = with_file(tmp_path, f"x_px,y_px\n{rows}", **origin)
        np.testing.assert_allclose(read_design(path).array.centers_mm, CENTERS_CENTERS, atol=1e-12)


def test_from_a_corner(tmp_path):
    """Of the plate, 3 x 4 mm."""
    path = with_file(tmp_path, "x_um,y_um\n500,1500\n2000,3250\n2500,1000\n", centers_origin="corner")
    np.testing.assert_allclose(read_design(path).array.centers_mm, CENTERS_CENTERS, atol=1e-12)


def test_mirror_is_x_against_minus_x(tmp_path):
    expected = tuple((-x, y) for x, y in CENTERS_CENTERS)
    path = with_file(tmp_path, FORMS["ours"], mirror=True)
    assert read_design(path).array.centers_mm == expected
    assert read_design(written(tmp_path, {"array.mirror": True})).array.centers_mm == expected


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"centers_unit": "um"}, ["x_mm,y_mm", "unit must be", "got um"]),
        ({"centers_units": "um"}, ["`array.centers_units`", "`centers_unit`"]),
    ],
)
def test_wrong_keys(tmp_path, keys, words):
    message_of(with_file(tmp_path, FORMS["ours"], **keys), *words)


COLUMNS = "x_mm;y_mm;radius_of_curvature_mm;conic_constant\n-1;-0.5;2;0\n0,5;1,25;1,9;-0,5\n1;-1;2;0\n"


def test_columns_of_each_lens(tmp_path):
    lists = read_design(written(tmp_path, LISTS, "lists.toml"))
    (tmp_path / "c.csv").write_text(COLUMNS)
    keys = {"lens.radius_of_curvature_mm": MISSING, "array.centers_mm": MISSING, "array.centers_file": "c.csv"}
    assert read_design(written(tmp_path, keys)) == lists
    both = "only one of `lens.radius_of_curvature_mm`", "`array.centers_file`"
    message_of(with_file(tmp_path, COLUMNS), *both)
    message_of(with_file(tmp_path, COLUMNS.replace("1,9", "thick")), "line 3, radius_of_curvature_mm", "thick")
    twice = COLUMNS.replace("conic_constant", "radius_of_curvature_mm")
    message_of(with_file(tmp_path, twice), "'radius_of_curvature_mm' must be in the header once")


# Slips of a unit get a question, and good designs get none.


SLIPS = [
    ("imaging.sensor_distance_mm", 5800.0, "imaging.sensor_distance_mm = 5800: did you mean 5.8 mm (5800 um)?"),
    ("sensor.pixel_pitch_um", 4500.0, "did you mean 4.5 um (4500 nm)?"),
    ("lens.radius_of_curvature_mm", 2000, "lens.radius_of_curvature_mm = 2000: did you mean 2 mm (2000 um)?"),
    ("lens.radius_of_curvature_mm", [2000.0, 1900, 2000], "did you mean [1.9, 2] mm ([1900, 2000] um)?"),
    ("lens.focal_length_mm", 4600.0, "did you mean 4.6 mm (4600 um)?"),
    ("imaging.working_distance_mm", [0.018, 0.03], "= [0.018, 0.03]: did you mean [18, 30] mm ([0.018, 0.03] m)?"),
    ("imaging.field_radius_mm", 3000.0, "did you mean 3 mm (3000 um)?"),
    ("imaging.wavelength_nm", 52.0, "is it meant? Usual is 150 to 15000 nm."),
    ("lens.refractive_index", 4.6, "lens.refractive_index = 4.6: is it meant? Usual is 1.3 to 4.1."),
    ("sample", {"refractive_index": 2.4}, "sample.refractive_index = 2.4: is it meant? Usual is 1 to 2."),
    (
        "samples",
        {"gel": {"refractive_index": 1.3, "layers": [{"thickness_mm": 170.0}]}},
        "samples.gel.layers[0].thickness_mm = 170: did you mean 0.17 mm (170 um)?",
    ),
    # What is usual alone, and does not go together.
    ("sample", {"refractive_index": 1.43, "surface_mm": 19.0}, "The object's medium begins at 19 mm."),
    ("imaging.sensor_distance_mm", 58.0, "imaging.sensor_distance_mm = 58: is it meant? Lenses of f = 4.651 mm image"),
    ("imaging.working_distance_mm", [3.0, 30.0], "Nearer than the focal length, 4.651 mm, no real image forms."),
    ("array.substrate_thickness_mm", 0.05, "which alone are 0.268 mm high."),
    ("imaging.field_radius_mm", 80.0, "imaging.field_radius_mm = 80: is it meant?"),
    ("array.centers_mm", [[0.001, 0.0], [0.0, 0.0], [0.0, 0.002]], "are 0.00"),
]


@pytest.mark.parametrize(("key", "value", "question"), SLIPS, ids=[f"{key} {value}" for key, value, _ in SLIPS])
def test_questions(tmp_path, key, value, question):
    path = written(tmp_path, {key: value})
    with pytest.warns(InputWarning) as said:
        read_design(path)
    text = str(said[0].message)
    assert len(said) == 1 and question in text and len(text) - len(str(path)) < 200
    assert text.startswith(f"{path}: {'imaging' if 'begins' in text else key}")


REFUSED = [
    ("imaging.wavelength_nm", 0.52, "imaging.wavelength_nm = 0.52: did you mean 520 nm (0.52 um)?"),
    ("imaging.wavelength_nm", 520e-9, "did you mean 520 nm (5.2e-07 m)?"),
    ("imaging.sensor_distance_mm", 0.0058, "did you mean 5.8 mm (0.0058 m)?"),
    ("array.substrate_thickness_mm", 1000.0, "did you mean 1 mm (1000 um)?"),
    ("sensor.pixel_pitch_um", 4.5e-6, "did you mean 4.5 um (4.5e-06 m)?"),
    ("sensor.pixel_pitch_um", 0.0045, "did you mean 4.5 um (0.0045 mm)?"),  # lenses are beside so small a sensor
    ("imaging.sensor_distance_mm", 58000, "did you mean 58 mm (58000 um)?"),
    ("lens.aperture_diameter_mm", 2000.0, "did you mean 2 mm (2000 um)?"),  # larger than its sphere
    ("lens.radius_of_curvature_mm", 0.002, "did you mean 2 mm (0.002 m)?"),
    ("array.size_mm", [0.003, 0.004], "did you mean [3, 4] mm"),
]


@pytest.mark.parametrize(("key", "value", "question"), REFUSED, ids=[f"{key} {value}" for key, value, _ in REFUSED])
def test_what_is_impossible_is_refused_with_the_question(tmp_path, key, value, question):
    with pytest.raises(InputError) as caught:
        read_design(written(tmp_path, {key: value}))
    assert question in str(caught.value) and "must be" in str(caught.value)


def test_good_designs_raise_none(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for path in shipped_designs():
            read_design(path)
        write_design(tmp_path / "a.toml", geomscope())
        read_design(tmp_path / "a.toml")


@pytest.mark.parametrize("name", ["P1", "P2"])
def test_the_authors_raise_none(name):
    read_design(needs(f"oracle/dev/{name}.toml"))


@pytest.mark.parametrize("value", [True, "5", None, [], [1.0, "a"], {}, 10**400, -5.0, 0.0, float("nan"), float("inf")])
def test_of_what_is_no_number_nothing_is_said(value):
    assert all(slip(key, value) is None for key in USUAL)


@pytest.mark.integration
def test_commands_say_it_once_and_go_on(folder, run):
    """Whatever reads the design; a warning of another kind stays what it is."""
    (folder / "design.toml").write_text(DESIGN.replace("sensor_distance_mm = 5.8", "sensor_distance_mm = 58.0"))
    status, out, err = run("metrics", "design.toml")
    assert status == 0 and "small" in out and "Warning" not in err
    assert err.splitlines() == [line for line in err.splitlines() if line.startswith("gs-jax: design.toml: imaging.")]
    assert err.count("\n") == 1


def test_points_in_another_unit_are_asked_for():
    points = np.array([[0.1, 0.2, 18000.0, 1.0], [0.3, 0.2, 20000.0, 1.0]])
    with pytest.warns(InputWarning, match=r"p.csv: z_mm = \[18000, 20000\]: did you mean \[18, 20\] mm"):
        ask_for_unit("p.csv", points)
    # A far source beside near ones, or alone, is meant.
    for meant in (points[:1], points * [1, 1, 0.001, 1], np.array([[0, 0, 20.0], [0, 0, 1e4]])):
        ask_for_unit("p.csv", meant)
