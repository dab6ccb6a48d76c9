"""Lens centres as vendors, programs and people write them."""

import numpy as np
import pytest

from gs_jax.design.design import read_design

from .test_designs import LISTS, MISSING, message_of, written

# Of three lenses, mm.
CENTERS = ((-1.0, -0.5), (0.5, 1.25), (1.0, -1.0))
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
    assert read_design(with_file(tmp_path, text)).array.centers_mm == CENTERS


def test_a_spreadsheets_micrometres(tmp_path):
    """Of Windows: one byte for the Greek letter, a line end of its own, decimal commas."""
    path = with_file(tmp_path, "")
    text = "Nr.;X [µm];Y [µm]\r\n1;-1000,0;-500,0\r\n2;500,0;1250,0\r\n3;1000,0;-1000,0\r\n"
    (tmp_path / "c.csv").write_bytes(text.encode("cp1252"))
    assert read_design(path).array.centers_mm == CENTERS


def test_columns_by_name_and_unit_by_key(tmp_path):
    text = "a,b,c\n9,-500,-1000\n9,1250,500\n9,-1000,1000\n"
    path = with_file(tmp_path, text, centers_columns=["c", "b"], centers_unit="um")
    assert read_design(path).array.centers_mm == CENTERS
    blanks = "n  X (um)  Y (um)  Z (um)\n9 0 -1000 -500\n9 0 500 1250\n9 0 1000 -1000\n"
    path = with_file(tmp_path, blanks, centers_columns=["Y (um)", "Z (um)"])
    assert read_design(path).array.centers_mm == CENTERS
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
    rows = "\n".join(",".join(map(repr, [*(np.array(row) / factors).tolist(), 2.0])) for row in CENTERS)
    rows = rows if header.count(",") == 2 else rows.replace(",2.0", "")
    changes = {"lens.radius_of_curvature_mm": MISSING, "array.centers_mm": MISSING, "array.centers_file": "c.csv"}
    (tmp_path / "c.csv").write_text(f"{header}\n{rows}\n", encoding="utf-8")
    changes = changes if header.count(",") == 2 else {**changes, "lens.radius_of_curvature_mm": 2.0}
    np.testing.assert_allclose(read_design(written(tmp_path, changes)).array.centers_mm, CENTERS, rtol=1e-12)


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
    rows = "".join(f"{x},{y}{',2' * (header.count(',') - 1)}\n" for x, y in CENTERS)
    message_of(with_file(tmp_path, f"{header}\n{rows}"), *words)


def test_pixels_are_those_of_a_capture(tmp_path):
    """As the contract has it: x = (column - (columns - 1) / 2) pitch; the sensor has 400 rows of 300 pixels."""
    middle, pitch = np.array([299, 399]) / 2, 0.0045
    for first, origin in ((middle, {}), (0 * middle, {"centers_origin": "center"})):
        rows = "".join(f"{x!r},{y!r}\n" for x, y in (np.array(CENTERS) / pitch + first).tolist())
        path = with_file(tmp_path, f"x_px,y_px\n{rows}", **origin)
        np.testing.assert_allclose(read_design(path).array.centers_mm, CENTERS, atol=1e-12)


def test_from_a_corner(tmp_path):
    """Of the plate, 3 x 4 mm."""
    path = with_file(tmp_path, "x_um,y_um\n500,1500\n2000,3250\n2500,1000\n", centers_origin="corner")
    np.testing.assert_allclose(read_design(path).array.centers_mm, CENTERS, atol=1e-12)


def test_mirror_is_x_against_minus_x(tmp_path):
    expected = tuple((-x, y) for x, y in CENTERS)
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
