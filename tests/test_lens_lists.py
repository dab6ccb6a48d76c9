"""Designs whose lenses differ: lists in `[lens]`, and columns of the file of centres."""

import json
import re

import numpy as np
import pytest

from gs_jax.codesign.search import problem_of
from gs_jax.codesign.study import read_study
from gs_jax.design.datasheets import datasheet, findings, summary, tables
from gs_jax.design.design import read_design, write_design
from gs_jax.design.start import commented, schema
from gs_jax.lenses import lenses_by_type

from .test_centers import with_file
from .test_designs import MISSING, message_of, written

RADII = [2.0, 1.9, 2.0]
LISTS = {"lens.radius_of_curvature_mm": RADII, "lens.conic_constant": [0.0, -0.5, 0]}
COLUMNS = "x_mm;y_mm;radius_of_curvature_mm;conic_constant\n-1;-0.5;2;0\n0,5;1,25;1,9;-0,5\n1;-1;2;0\n"


def test_lists_are_numbers_of_each_lens(tmp_path):
    design = read_design(written(tmp_path, LISTS))
    array = design.imager().array
    np.testing.assert_array_equal(array.of_lenses("radius_of_curvature"), RADII)
    np.testing.assert_array_equal(array.of_lenses("conic_constant"), [0, -0.5, 0])
    assert array.aperture_diameter.shape == () and not array.alike
    assert lenses_by_type(array) == ((0, 2), (1,))
    assert "3 lenses of 2 types, R = 1.9 to 2 mm, k = -0.5 to 0, n = 1.43, D = 2 mm" in repr(design)


def test_lists_are_read_back(tmp_path):
    design = read_design(written(tmp_path, LISTS))
    write_design(tmp_path / "same.toml", design)
    (tmp_path / "commented.toml").write_text(commented(design))
    assert read_design(tmp_path / "same.toml") == read_design(tmp_path / "commented.toml") == design


def test_a_list_of_one_number_is_that_number(tmp_path):
    """What is alike stays as fast as it is."""
    design = read_design(written(tmp_path, {"lens.radius_of_curvature_mm": [1.9, 1.9, 1.9]}))
    assert design.imager().array.alike and len(lenses_by_type(design.imager().array)) == 1
    assert "3 lenses, R = 1.9 mm" in repr(design)


def test_columns_of_the_centers(tmp_path):
    keys = {"lens.radius_of_curvature_mm": MISSING}
    lists = read_design(written(tmp_path, LISTS, "lists.toml"))
    (tmp_path / "c.csv").write_text(COLUMNS)
    file = {"array.centers_mm": MISSING, "array.centers_file": "c.csv"}
    assert read_design(written(tmp_path, keys | file)) == lists
    both = "only one of `lens.radius_of_curvature_mm`", "`array.centers_file`"
    message_of(with_file(tmp_path, COLUMNS), *both)
    message_of(with_file(tmp_path, COLUMNS.replace("1,9", "thick")), "line 3, radius_of_curvature_mm", "thick")
    twice = COLUMNS.replace("conic_constant", "radius_of_curvature_mm")
    message_of(with_file(tmp_path, twice), "'radius_of_curvature_mm' must be in the header once")


WRONG = [
    ({"lens.radius_of_curvature_mm": [2.0, 1.9]}, ["`lens.radius_of_curvature_mm`", "one number or 3", "got 2"]),
    ({"lens.conic_constant": [0.0] * 4}, ["`lens.conic_constant`", "one number or 3", "got 4"]),
    ({"lens.radius_of_curvature_mm": [2.0, "a", 2]}, ["`lens.radius_of_curvature_mm[1]`", "'a'", "for each lens"]),
    ({"lens.radius_of_curvature_mm": [2.0, -1.0, 2]}, ["`lens.radius_of_curvature_mm[1]`", "-1.0"]),
    ({"lens.aperture_diameter_mm": []}, ["`lens.aperture_diameter_mm`", "got []", "for each lens"]),
    ({"lens.aperture_diameter_mm": "wide"}, ["`lens.aperture_diameter_mm`", "got 'wide'"]),
    ({"lens.radius_of_curvature_mm": [2.0, 0.9, 2]}, ["`lens.aperture_diameter_mm`", "2.0 of lens 2", "1.8 mm"]),
    ({"lens.conic_constant": [0.0, 0, 300]}, ["`lens.conic_constant[2]`", "-100 to 100"]),
    (
        {"lens.aspheric_terms": [-0.1], "lens.radius_of_curvature_mm": [2.0, 2, 4]},
        ["`lens.aspheric_terms`", "lens 3 rises"],
    ),
]


@pytest.mark.parametrize(("changes", "words"), WRONG, ids=[" ".join(words) for _, words in WRONG])
def test_wrong_lists(tmp_path, changes, words):
    message_of(written(tmp_path, changes), *words)


def test_a_slip_of_the_unit_in_a_list(tmp_path):
    path = written(tmp_path, {"lens.radius_of_curvature_mm": [2000.0, 1900, 2000]})
    with pytest.warns(UserWarning, match=re.escape("did you mean [1.9, 2] mm ([1900, 2000] um)?")):
        read_design(path)


def test_editors_know_lists_and_columns():
    lens = schema()["$defs"]["LensTable"]
    one, each = lens["properties"]["radius_of_curvature_mm"]["oneOf"]
    assert one["type"] == "number" and each["items"]["maximum"] == 1e4
    assert lens["required"] == ["refractive_index"]
    assert "null" not in json.dumps(schema())


def test_searches_keep_which_lens_is_of_which_kind(tmp_path):
    design = read_design(written(tmp_path, LISTS))
    study = read_study("experiments/designs/studies/geomscope-targets.toml")
    assert lenses_by_type(problem_of(design, study).imager.array) == ((0, 2), (1,))


@pytest.mark.integration
def test_a_datasheet_of_kinds(tmp_path):
    """Each kind is what a design of it alone is, but for where its neighbours cut it."""
    design = read_design(written(tmp_path, {"lens.radius_of_curvature_mm": RADII}))
    sheet = datasheet(design, [18.0, 24.0])
    first, second = sheet["kinds"]
    assert (first["lenses"], second["lenses"], first["radius_of_curvature_mm"]) == (2, 1, 2.0)
    widths = np.array([first["spot_width_um"], second["spot_width_um"]])
    np.testing.assert_array_equal(sheet["spot_width_um"], widths.min(0))
    np.testing.assert_array_equal(sheet["sharpest_kind"], widths.argmin(0) + 1)
    alone = datasheet(read_design(written(tmp_path)), [18.0, 24.0])
    assert "kinds" not in alone and sheet["lenses_per_point"] == alone["lenses_per_point"]
    np.testing.assert_allclose(first["spot_width_um"], alone["spot_width_um"], rtol=0.1)
    assert sheet["coverage"] == pytest.approx(alone["coverage"], rel=0.01)
    assert "2 types of lenses, f = 4.419 to 4.651 mm" in summary(design, sheet)
    assert len(tables(sheet)) == len(tables(alone)) + 1
    said = findings(design, sheet)
    assert any(sentence.startswith("Lenses of f = 4.419 mm: in focus by Eqs. 7 and 8") for sentence in said)
