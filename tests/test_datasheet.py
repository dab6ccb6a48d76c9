import dataclasses
import io
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from rich.console import Console

from gs_jax import Imager, MicrolensArray, Sensor, objectives
from gs_jax.design.datasheets import datasheet, findings, summary, tables
from gs_jax.design.design import read_design
from gs_jax.design.start import geomscope
from gs_jax.objectives.conditions import per_type
from gs_jax.objectives.quantities import third_order_wavefront
from gs_jax.optics import theory
from gs_jax.optics.aberrations import linear_rms
from gs_jax.optics.apertures import clear_diameter, pitch

from .helpers import scene
from .test_designs import written

LISTS = (
    "depth_mm magnification scale lenses_per_point occupancy lateral_resolution_um axial_resolution_um "
    "depth_of_field_mm near_limit_mm far_limit_mm strehl_on_axis focus_distance_mm blur_um fwhm_um rms_width_um "
    "half_light_radius_um spot_radius_um spot_width_um"
).split()
SCALARS = "f_number numerical_aperture focal_length_mm pitch_mm pitch_sd_mm field_radius_mm coverage".split()
TABLE1 = Path(__file__).parents[1] / "experiments" / "designs" / "geomscope-table1.toml"


@pytest.fixture(scope="module")
def table1():
    return read_design(TABLE1)


def changed(design, table, **values):
    return design.model_copy(update={table: getattr(design, table).model_copy(update=values)})


def test_the_keys_and_their_types(table1):
    sheet = datasheet(table1)
    assert list(sheet) == LISTS + SCALARS
    assert all(len(sheet[key]) == 7 for key in LISTS)
    assert (sheet["depth_mm"][0], sheet["depth_mm"][-1]) == (18.0, 30.0)
    assert json.loads(json.dumps(sheet, allow_nan=False)) == sheet


@pytest.mark.integration
def test_the_papers_design(table1):
    """Table 1 and thin-lens figures at 20 mm, with the clear diameter for the diameter."""
    sheet = datasheet(table1, [18.0, 20.0, 30.0])
    np.testing.assert_allclose(sheet["focal_length_mm"], 4.65, rtol=1e-3)
    np.testing.assert_allclose([sheet["pitch_mm"], sheet["pitch_sd_mm"]], [1.23, 0.09], atol=0.005)
    np.testing.assert_allclose([sheet["magnification"][0], sheet["magnification"][-1]], [0.214, 0.130], atol=0.001)
    np.testing.assert_allclose(np.subtract(sheet["scale"], sheet["magnification"]), 1, rtol=1e-5)
    # 200 lenses share 400 mm^2.
    np.testing.assert_allclose(sheet["focal_length_mm"] / sheet["f_number"], np.sqrt(8 / np.pi), rtol=1e-3)
    np.testing.assert_allclose(sheet["focus_distance_mm"][1], 6.00, atol=0.005)
    np.testing.assert_allclose(sheet["blur_um"][1], 532, atol=1)
    np.testing.assert_allclose(sheet["lenses_per_point"], 14.1372, rtol=1e-5)


def test_limits_are_depths_from_the_plate(table1):
    sheet, f, plate = datasheet(table1, [20.0], circle_of_confusion=0.018), 2 / 0.43, 1 / 1.43
    arguments = (f, sheet["f_number"], 20 + plate, 0.018)
    np.testing.assert_allclose(sheet["near_limit_mm"], theory.near_limit(*arguments) - plate, rtol=1e-5)
    np.testing.assert_allclose(sheet["far_limit_mm"], theory.far_limit(*arguments) - plate, rtol=1e-5)
    # Both rounded to six digits.
    width = sheet["far_limit_mm"][0] - sheet["near_limit_mm"][0]
    np.testing.assert_allclose(sheet["depth_of_field_mm"], width, rtol=1e-4)


def test_the_clear_diameter_is_that_of_the_array(table1):
    sheet, array = datasheet(table1), table1.imager().array
    np.testing.assert_allclose(sheet["focal_length_mm"] / sheet["f_number"], clear_diameter(array), rtol=1e-5)
    mean, deviation = pitch(array.centers)
    np.testing.assert_allclose([sheet["pitch_mm"], sheet["pitch_sd_mm"]], [mean, deviation], rtol=1e-5)


@pytest.mark.integration
def test_infinity_is_none(table1):
    sheet = datasheet(table1, [3.0, 200.0], circle_of_confusion=0.1)
    assert sheet["focus_distance_mm"][0] is None
    assert sheet["far_limit_mm"][1] is None and sheet["depth_of_field_mm"][1] is None
    assert any(sentence.startswith("At 3 mm no real image forms") for sentence in findings(table1, sheet))
    single = changed(table1, "array", centers_mm=((0.0, 0.0),))
    assert datasheet(single)["pitch_mm"] is None


def test_the_two_tables_fit_a_terminal(table1):
    console = Console(width=80, record=True, file=io.StringIO())
    for table in tables(datasheet(table1)):
        console.print(table)
    text = console.export_text()
    assert "…" not in text and "magnifi-" in text and "531.8" in text
    assert "1.23 mm" in summary(table1, datasheet(table1))


def test_what_is_wrong_with_the_printed_design(table1):
    text = "\n".join(findings(table1, datasheet(table1, [20.0])))
    for words in [
        "At 20 mm the image forms 2 mm behind the sensor: blur 530 um on the sensor, 2.8 mm in the object.",
        "1 of 1 depths are out of focus: blurred by more than the circle of confusion, 9 um.",
        "The sensor at 4 mm is not behind the focal plane at 4.651 mm: no depth is in focus.",
        "13 waves RMS, and Eq. 9 holds below about 0.1",
        "the diffraction spot is 1.5 um, a pixel 4.5 um",
        "takes the pitch, 1.23 mm, for the diameter, which gives 0.132",
    ]:
        assert words in text
    assert "occupancy" not in text


def test_what_is_wrong_with_the_design_in_focus(table1):
    design = changed(table1, "imaging", sensor_distance_mm=5.8)
    text = "\n".join(findings(design, datasheet(design)))
    assert "At 30 mm the image forms 320 um before the sensor" in text
    assert (
        "In focus by Eqs. 7 and 8, of a thin lens, are 22.26 to 23.33 mm; the working distance is 18 to 30 mm." in text
    )
    # Traced rays focus best from 20 mm with the sensor at 5.75 to 5.85 mm.
    assert "cores of spots hold half of the most light, or more, at 17.7 to 22 mm" in text
    assert "half of its light is within a radius of 110 to 480 um, and the RMS width is 140 to 440 um" in text
    assert "image is 16 to 170 um wide at half its height on the axis" in text and "mask" not in text
    assert "At 18 mm the occupancy is 1.4" in text
    # Traced rays are sharpest 0.15 to 0.25 mm before the thin lens's image; the least variance is farther.
    assert "draws the sharpest image of 18 mm toward the lens, by up to 460 um" in text


@pytest.mark.integration
def test_an_ideal_lens_has_no_aberrations(table1):
    """In focus at 20 mm its wavefront is perfect there, and what is wrong elsewhere is defocus."""
    thin = changed(changed(table1, "lens", focal_length_mm=4.65), "imaging", sensor_distance_mm=6.0)
    reduced = 1 / (1 / 4.65 - 1 / 6.0)
    sheet = datasheet(thin, [reduced - 1 / 1.43 * thin.array.substrate_thickness_mm])
    assert sheet["strehl_on_axis"] == pytest.approx([1.0])
    text = "\n".join(findings(thin, datasheet(thin)))
    assert "wavefront error on the axis" in text and "spherical" not in text and "halves" not in text


def test_nothing_is_wrong_with_a_small_lens_in_focus(table1):
    """A thousandth of the aperture's area: a pinhole that is as wide as the pitch."""
    design = changed(table1, "lens", aperture_diameter_mm=0.06)
    design = changed(design, "imaging", sensor_distance_mm=6.0, field_radius_mm=1.0)
    sheet = datasheet(design, [20.0])
    sentences = findings(design, sheet)
    assert len(sentences) == 2 and "takes the pitch" in sentences[0]
    # 200 lenses, 0.06 mm wide, on 20 x 20 mm.
    assert sentences[1].startswith("99.9 % of the plate is no lens's: an opaque mask must cover it")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (dict(depths=[]), r"`depths` must be one or more positive lengths, mm, got \[\]"),
        (dict(depths=[20.0, -1.0]), "`depths` must be"),
        (dict(circle_of_confusion=0.0), "`circle_of_confusion` must be positive and finite"),
    ],
)
def test_wrong_arguments_are_named(table1, arguments, words):
    with pytest.raises(ValueError, match=words):
        datasheet(table1, **arguments)


def test_an_infinite_plate_has_no_density():
    imager, grid = scene()
    for function in (objectives.occupancy, jax.jit(objectives.occupancy)):
        with pytest.raises(ValueError, match="`imager.array.size` must be given"):
            function(imager, grid.depths)


BY_DEPTH = (
    "lenses_per_point occupancy coverage depth_of_field approximate_depth_of_field near_limit far_limit focus_distance "
    "sensor_blur blur lateral_resolution axial_resolution light field_of_view log_strehl"
).split()


@pytest.mark.integration
def test_gradients_by_everything_that_is_continuous():
    imager, grid = scene()
    array = imager.array

    @jax.jit
    def values(centers, radius, index, diameter, thickness, v, depths, field_radius, um):
        moved = MicrolensArray(
            um * centers,
            radius_of_curvature=radius,
            refractive_index=index,
            aperture_diameter=diameter,
            substrate_thickness=thickness,
            size=2 * jnp.stack([um, um]),
        )
        imager = Imager(moved, Sensor((40, 40), 1e-3), v, 1.0, wavelength=um * 1e-3)
        at = objectives.Conditions(depths, um * 1e-2, field_radius=field_radius)
        named = [getattr(objectives, name) for name in BY_DEPTH]
        wavefront = third_order_wavefront(imager, at, jnp.array([0.0, 0.1]))
        values = [jnp.log(objectives.lateral_resolution(imager, at)), linear_rms(wavefront), pitch(centers)]
        values += [imager.magnification(depths), imager.scale(depths)]
        return [function(imager, at) for function in named], objectives.depth_of_field(imager, at.middle), values

    one = jnp.array
    arguments = (array.centers, one(2.0), one(1.43), one(0.5), one(1.0), one(5.8), grid.depths, one(0.4), one(0.52))
    # Blurs and resolutions are 1e-2 mm: the tolerance is a millionth of a wave's worth of it.
    check_grads(values, arguments, order=1, eps=1e-7, atol=1e-6, rtol=1e-5)


@pytest.mark.integration
@pytest.mark.parametrize("how", ["alike", "kinds"])
def test_the_clear_aperture_follows_the_imager(how):
    """Of lenses whose discs overlap, whatever of the imager is replaced: also where centres coincide, in value."""
    centers = jnp.array([[-0.4, 0.1], [0.35, -0.2], [0.1, 0.7], [0.6, 0.65]])
    diameter = jnp.array([1.0, 1.0, 0.9, 0.9]) if how == "kinds" else jnp.array(1.0)
    array = MicrolensArray(centers, aperture_diameter=diameter, size=(2.0, 2.0))
    imager = Imager(array, Sensor((40, 40), 1e-3), 5.8, 0.4)
    at = objectives.Conditions([20.0], 0.01, directions=16)

    @jax.jit
    def values(diameter, centers):
        changed = dataclasses.replace(array, aperture_diameter=diameter, centers=centers, types=None)
        parts = per_type(dataclasses.replace(imager, array=changed), at)
        named = objectives.f_number, objectives.lateral_resolution, objectives.depth_of_field
        each = [[function(*part) for function in named] for part in parts]
        return objectives.coverage(dataclasses.replace(imager, array=changed), at), each

    # Steps of 1e-6 of numbers of order one.
    check_grads(values, (diameter, centers), order=1, modes=["rev"], eps=1e-6, atol=1e-5, rtol=1e-5)
    (coverage, [whole, *_]), (fewer, [half, *_]) = values(diameter, centers), values(diameter / 2, centers)
    assert half[0] > 1.5 * whole[0] and half[1] > 1.2 * whole[1] and half[2] > 1.5 * whole[2] and fewer < coverage / 2
    slope = jax.jit(jax.grad(lambda centers: values(diameter, centers)[0]))
    assert jnp.abs(slope(centers)).max() > 0.01
    if how == "alike":
        assert jnp.all(jnp.isfinite(slope(jnp.zeros_like(centers))))


def test_the_built_in_design_matches_its_file():
    """The command's figures and the API's are the same."""
    sheet = datasheet(geomscope(), [20.0])
    np.testing.assert_allclose(sheet["blur_um"], 53, atol=0.5)


@pytest.mark.integration
def test_the_command(tmp_path, run, table1):
    output = tmp_path / "sheet.json"
    options = ("--depths", "20:22:1", "--confusion-um", "18", "--json", output)
    status, out, err = run("metrics", TABLE1, *options)
    assert (status, err) == (0, "") and out.count("\n") == 5 and "FWHM" in out and out.endswith("--verbose\n")
    status, out, _ = run("metrics", TABLE1, *options, "--verbose")
    assert json.loads(output.read_text()) == datasheet(table1, [20.0, 21.0, 22.0], circle_of_confusion=0.018)
    assert "- At 20 mm the image forms 2 mm behind the sensor" in out and "the circle of confusion, 18 um" in out


@pytest.mark.integration
def test_a_datasheet_of_kinds(tmp_path):
    """Each kind is what a design of it alone is, but for where its neighbours cut it."""
    design = read_design(written(tmp_path, {"lens.radius_of_curvature_mm": [2.0, 1.9, 2.0]}))
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
