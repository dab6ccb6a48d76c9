"""Slips of a unit get a question, and good designs get none."""

import warnings

import numpy as np
import pytest

from gs_jax.base.errors import InputError, InputWarning
from gs_jax.cli.options import ask_for_unit, shipped_designs
from gs_jax.design.design import read_design, write_design
from gs_jax.design.start import geomscope
from gs_jax.design.validation import USUAL, slip

from .helpers import DESIGN, needs
from .test_designs import written

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
