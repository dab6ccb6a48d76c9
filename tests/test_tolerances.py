"""Tolerances against what is not ours: a literal staircase, Optiland's rays of wrong lenses, SciPy's fits, formulas."""

import dataclasses
import json
import tomllib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from experiments.optics_check import optiland_rays
from gs_jax import Design, Imager, InputError, MicrolensArray, Sensor
from gs_jax.apps import device_model
from gs_jax.apps.device_model import CONSTANT, ERROR_FIELDS, make_problem, measure_devices, no_errors
from gs_jax.apps.report import tolerance_section
from gs_jax.apps.tolerance_spec import ToleranceSpec, read_tolerances
from gs_jax.apps.tolerances import (
    Outcome,
    as_json,
    combine_changes,
    picture,
    rank_tolerances,
    sentences,
    summarise_changes,
    tolerance,
)
from gs_jax.cli.fabrication import tolerance_command as command
from gs_jax.microscope.geometry import envelope
from gs_jax.objectives import Conditions
from gs_jax.objectives.conditions import field_heights
from gs_jax.optics import theory
from gs_jax.optics.diffraction import axial_strehl, strehl
from gs_jax.optics.pupil import pupil_quadrature
from gs_jax.optics.raytrace import to_numpy

depth_errors = jax.jit(device_model.depth_errors)
log_sharpness = eqx.filter_jit(device_model.log_sharpness)
lens_squares, step_squares = jax.jit(device_model.lens_squares), jax.jit(device_model.step_squares)
both_strehls = jax.jit(
    lambda imager, depth: (axial_strehl(imager, depth, radius=0.17), strehl(imager, depth, radius=0.17))
)


@eqx.filter_jit
def sampled(seed, lenses: int, spec: ToleranceSpec) -> device_model.Errors:
    keys, deviations = jax.random.key(seed)[None], device_model.standard_deviations(spec)
    return jax.tree.map(lambda error: error[0], device_model.sample_errors(keys, lenses, deviations))


DEPTHS = (18.0, 20.0, 23.0)
DESIGN = """
name = "small"
[sensor]
pixel_pitch_um = 10.0
shape = [700, 700]
[lens]
radius_of_curvature_mm = 1.4
refractive_index = 1.43
aperture_diameter_mm = 0.4
[array]
size_mm = [6.0, 6.0]
substrate_thickness_mm = 1.0
centers_mm = [[-2.0, -2.1], [0.1, -1.9], [2.1, -2.0], [-1.9, 0.1], [0.0, 0.0], [1.9, -0.1], [-2.1, 2.0], [0.1, 2.1],
    [2.0, 1.9], [-1.0, -1.1], [1.0, -0.9], [-0.9, 1.0], [1.1, 1.0]]
[imaging]
sensor_distance_mm = 3.8
working_distance_mm = [18.0, 23.0]
wavelength_nm = 520.0
field_radius_mm = 2.5
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "design.toml").write_text(DESIGN)
    return tmp_path


@pytest.fixture(scope="module")
def design() -> Design:
    return Design.model_validate(tomllib.loads(DESIGN))


@pytest.fixture(scope="module")
def outcome(design) -> Outcome:
    return tolerance(design, depths=DEPTHS, draws=100)


@pytest.fixture(scope="module")
def pinholes(design):
    """Arguments of `depth_errors` for lenses whose cores are on their chief rays, which have closed forms."""
    imager, cores, sources, points = device_model.depth_arguments(design.imager(), np.array(DEPTHS))
    zero = cores.offsets._replace(offset=np.zeros(cores.offsets.offset.shape), slopes={})
    return imager, cores._replace(offsets=zero, slopes=np.zeros(cores.slopes.shape)), sources, points


def single(**lens) -> Imager:
    array = MicrolensArray([[0.0, 0.0]], radius_of_curvature=1.4, aperture_diameter=0.4, size=(1.0, 1.0), **lens)
    return Imager(array, Sensor((3, 3), 0.0045), 3.8, 2.0, tilt=(0.0, 0.0))


@pytest.mark.parametrize("slope, layer, pixel", [(0.1, 1e-3, 5e-3), (0.02, 1e-3, 5e-3), (0.19, 1e-3, 5e-3)])
def test_a_literal_staircase(slope, layer, pixel):
    """Terraces, their edges smoothed by a running mean over a pixel: less the wanted slope, over whole terraces."""
    count, wide = 2**14, layer / slope
    x = (np.arange(8 * count) + 0.5) * wide / count
    stairs = layer * np.floor(x / wide)
    window = max(round(pixel / wide * count), 1)
    sums = np.cumsum(np.insert(stairs, 0, 0))
    smooth = (sums[window:] - sums[:-window]) / window
    left = smooth - slope * x[: smooth.size]
    left = left[: smooth.size // count * count]
    left = left - left.mean()
    rise = np.diff(left) / (x[1] - x[0])
    height, steep = step_squares(np.array([slope]), layer, pixel)
    np.testing.assert_allclose([height[0], steep[0]], [left.var(), (rise**2).mean()], rtol=5e-3, atol=1e-12)


def test_steps_of_a_lens_are_in_its_middle():
    """Where a terrace is wider than a pixel: for small slopes r / R, integrals over the disc are elementary."""
    array, layer, pixel = single().array, 1e-4, 5e-3
    steepest, edge = layer / pixel, 0.02 / 1.4
    slope = 2 / edge**2 * (steepest * edge**3 / 3 - edge**4 / 4)
    inner = (steepest**2 * edge**2 / 2 - 2 * steepest * edge**3 / 3 + edge**4 / 4) * 2 / edge**2
    height, bent = lens_squares(array, 0.02, layer, pixel, 1e-7)
    np.testing.assert_allclose(height, pixel**2 * inner / 12, rtol=1e-3)
    # All rays are bent by steps of many waves, and next to none by thin ones.
    np.testing.assert_allclose(bent, slope, rtol=2e-2)
    assert lens_squares(array, 0.02, layer, pixel, 520e-6)[1] < 0.02 * slope
    assert lens_squares(array, 0.2, 0.0, pixel, 520e-6) == (0, 0)


@pytest.mark.integration
@pytest.mark.parametrize("orientation, distance", [("plano", 3.8), ("curved", 3.1)])
def test_the_strehl_ratio_of_a_line_of_rays_is_that_of_all(orientation, distance):
    imager = dataclasses.replace(single(orientation=orientation), sensor_distance=distance)
    for depth in (16.0, 20.0, 26.0):
        np.testing.assert_allclose(*both_strehls(imager, depth), atol=3e-4)
    line = jax.jit(lambda v: both_strehls(dataclasses.replace(imager, sensor_distance=v), 18.0)[0])
    check_grads(line, (3.7,), 1, rtol=1e-4)


@pytest.mark.integration
@pytest.mark.parametrize("seed", range(3))
def test_images_of_wrong_lenses_by_optilands_rays(seed):
    """Radius, conic, index and distance wrong at once, 3 standard deviations of the defaults and more."""
    pytest.importorskip("optiland")
    nominal = single(), Conditions(DEPTHS, 0.01)
    spec = ToleranceSpec(layer_um=0, roughness_nm=0, tilt_deg=0, position_um=0)
    errors = jax.tree.map(lambda x: np.asarray(3 * np.asarray(x)), sampled(seed, 1, spec))
    width, ratio = map(np.exp, log_sharpness(*nominal, errors, jnp.asarray(0.005)))
    imager = to_numpy(device_model.perturb(nominal[0], errors))
    points, weights = map(np.asarray, pupil_quadrature(0.2))
    airy = float(theory.airy_sigma(imager.wavelength, imager.sensor_distance, 0.4))
    sag, v = np.asarray(imager.array.sag((points**2).sum(1))), float(imager.sensor_distance)
    for row, depth in enumerate(DEPTHS[:2]):
        squares, shares = [], []
        for height in np.asarray(field_heights(*nominal)):
            landing, _, _ = optiland_rays(imager, depth, points, height)
            squares.append(weights @ ((landing - weights @ landing) ** 2).sum(1) / 2)
            shares.append(float(envelope(height**2, float(imager.reduced_depth(depth)), imager.field_radius)))
        rays = np.average(squares, weights=shares)
        sigma = np.sqrt(rays + airy**2 + 0.0045**2 / 12)
        np.testing.assert_allclose(width[row], theory.FWHM * sigma / imager.magnification(depth), rtol=1e-6)
        # Huygens: from the lens's surface to the middle of the spot, without obliquity.
        landing, _, path = optiland_rays(imager, depth, points, 0.0)
        there = np.hypot(v + sag, np.hypot(*(landing - points).T))
        middle = np.hypot(v + sag, np.hypot(*points.T))
        light = np.abs(weights @ np.exp(2j * np.pi / float(imager.wavelength) * (path - there + middle))) ** 2
        np.testing.assert_allclose(ratio[row], light, rtol=0.01)


@pytest.mark.integration
def test_wrong_distances_and_indices_have_closed_forms(design, pinholes):
    """`M = v/z'` is what is seen, whatever made it: `-z' dv / (v + dv)`, and the plate's `t/n`."""
    n, v = 1.43, 3.8
    reduced = np.asarray(pinholes[3].points)[:, 2] + 1 / n
    changed = lambda **change: dataclasses.replace(no_errors(len(design.array.centers_mm)), **change)
    farther, after = depth_errors(*pinholes, errors=changed(sensor_distance=np.array(0.05)))
    np.testing.assert_allclose(farther, -reduced * 0.05 / (v + 0.05), rtol=1e-6)
    np.testing.assert_allclose(after, 0, atol=1e-9)
    denser, _ = depth_errors(*pinholes, errors=changed(index=np.array(0.01)))
    np.testing.assert_allclose(denser, 1 / (n + 0.01) - 1 / n, rtol=1e-6)
    leaning, after = depth_errors(*pinholes, errors=changed(tilt=np.array([0.01, -0.004])))
    assert np.abs(leaning).max() > 0.05
    np.testing.assert_allclose(after, 0, atol=1e-9)


def lines(centers, point, v, tilt, rotation, shift, plate) -> np.ndarray:
    """Straight lines in space, from a point through the vertices of a plate that is turned as a body, to the sensor.

    The plate, 1 mm thick and as `plate` of air, brings the point nearer along its normal.
    """
    turned = Rotation.from_euler("z", rotation).apply(np.column_stack([centers, 0 * centers[:, 0]]))
    turned[:, :2] += shift
    axis = np.cross([*tilt, 0], [0, 0, 1])
    vertices = Rotation.from_rotvec(np.arctan(np.hypot(*tilt)) * axis / max(float(np.linalg.norm(axis)), 1e-300)).apply(
        turned
    ) + [0, 0, v]
    normal = np.array([*-np.asarray(tilt), 1]) / np.sqrt(1 + np.dot(tilt, tilt))
    source = np.array([*point[:2], point[2] + 1 + v]) - (1 - plate) * normal
    along = vertices - source
    return (vertices - along * (vertices[:, 2:] / along[:, 2:]))[:, :2]


@pytest.mark.parametrize("seed", range(2))
def test_depths_by_scipys_fits(design, pinholes, seed):
    """The device's spots, the calibration and the points by straight lines and SciPy; nothing of ours."""
    centers, nominal = np.array(design.array.centers_mm), design.imager()
    errors = sampled(seed, len(centers), ToleranceSpec(radius_percent=0, conic=0))
    v, plate = 3.8 + float(errors.sensor_distance), 1 / (1.43 + float(errors.index))
    wrong, tilt = centers + np.asarray(errors.centers), np.asarray(errors.tilt)
    tight = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14, "x_scale": "jac"}

    def spots(points):
        rows = zip(*map(np.asarray, points), strict=True)
        return [(p, lenses[on], lines(wrong[lenses[on]], p, v, tilt, 0, (0, 0), plate)) for p, lenses, on in rows]

    def off(unknown, some):
        made = [lines(centers[at], p, unknown[0], unknown[1:3], unknown[3], unknown[4:], 1 / 1.43) for p, at, _ in some]
        return np.concatenate([(a - b[2]).ravel() for a, b in zip(made, some, strict=True)])

    seen = spots(pinholes[2])
    fitted = least_squares(off, [3.8, 0, 0, 0, 0, 0], args=(seen,), **tight).x
    assert nominal.tilt is None
    for found, believed in zip(depth_errors(*pinholes, errors=errors), ([3.8, 0, 0, 0, 0, 0], fitted), strict=True):
        for row, one in list(enumerate(spots(pinholes[3])))[::4]:
            place = lambda q, one=one, believed=believed: off(believed, [(q, *one[1:])])
            z = least_squares(place, one[0], **tight).x[2]
            # Our steps end within 0.1 um: a thousandth of what can be told apart.
            np.testing.assert_allclose(found[row], z - one[0][2], atol=1e-4)


@pytest.mark.integration
def test_gradients_are_finite_differences(design, outcome):
    deviations = device_model.standard_deviations(outcome.tolerances)
    nothing, names = no_errors(len(design.array.centers_mm)), ["radius", "conic", "index", "sensor distance"]
    change = lambda field, sign: {field: np.asarray(sign * 0.01 * np.asarray(getattr(deviations, field)))}
    ends = [dataclasses.replace(nothing, **change(ERROR_FIELDS[name], sign)) for name in names for sign in (1, -1)]
    stacked = jax.tree.map(lambda *values: np.stack(values), *ends)
    measures = measure_devices(make_problem(design, np.array(DEPTHS)), stacked)
    for row, name in enumerate(names):
        for values, by_gradient in zip(measures, outcome.alone[name], strict=True):
            slope = np.abs(values[2 * row] - values[2 * row + 1]) / 0.02
            np.testing.assert_allclose(slope, by_gradient, rtol=1e-3, atol=1e-6)


@pytest.mark.integration
def test_sensitivities(outcome):
    """A calibration finds distance and tilt, which cost nothing then; roughness takes light from the core."""
    alone = outcome.alone
    assert all(np.abs(alone[name].calibrated).max() < 1e-3 for name in ("sensor distance", "tilt"))
    assert alone["position"].calibrated.max() > 0.01 and alone["sensor distance"].designed.min() > 0.2
    # The closed form, but for cores that move with the distance.
    np.testing.assert_allclose(alone["sensor distance"].designed[:5], (18 + 1 / 1.43) * 0.05 / 3.8, rtol=0.05)
    lost = -((2 * np.pi * 0.43 * 20e-6 / 520e-6) ** 2)
    np.testing.assert_allclose(alone["roughness"].log_strehl, lost, rtol=1e-6)
    np.testing.assert_allclose(alone["roughness"].log_width, 0, atol=1e-12)
    assert (np.asarray(alone["printed layers"].log_width) > 0).all()
    squares = sum(np.asarray(alone[name].calibrated) ** 2 for name in ERROR_FIELDS if name not in CONSTANT)
    np.testing.assert_allclose(combine_changes(alone).calibrated, np.sqrt(squares))
    # Where all is nearly linear; 100 devices have an RMS within 20 % or so.
    rows = summarise_changes(outcome)
    for key in ("depth_error_um", "depth_error_calibrated_um"):
        assert rows["all, drawn"][key] == pytest.approx(rows["all, by gradient"][key], rel=0.25)


@pytest.mark.integration
def test_yields(design, outcome):
    assert 0 <= outcome.all_met.mean() <= min(met.mean() for met in outcome.met.values())
    assert set(outcome.yields_without) == set(ERROR_FIELDS) and rank_tolerances(outcome)[0] in sentences(outcome)[1]
    perfect = ToleranceSpec(**dict.fromkeys(set(ToleranceSpec.model_fields) - {"pixel_um"}, 0.0))
    good = tolerance(design, perfect, depths=DEPTHS, draws=2)
    assert good.all_met.all() and not good.yields_without
    assert "No tolerance alone costs yield" in sentences(good)[1]
    hard = tolerance(design, perfect, depths=DEPTHS, draws=2, max_width=1e-4)
    assert not hard.met["spot width"].any() and hard.met["depth"].all()


@pytest.mark.integration
def test_the_picture_and_the_numbers(outcome):
    figure = picture(outcome)
    assert len(figure.axes) == 4 and all(", " in axes.get_xlabel() for axes in figure.axes)
    numbers = json.loads(json.dumps(as_json(outcome), allow_nan=False))
    assert numbers["depth_mm"] == list(DEPTHS) and len(numbers["places_mm"]) == 5
    low, middle, high = (numbers["drawn"]["spot_width_um"][key] for key in ("p5", "p50", "p95"))
    assert all(a < b < c for a, b, c in zip(low, middle, high, strict=True))
    assert set(numbers["by_gradient"]) == {*ERROR_FIELDS, "all"} and sorted(numbers["costs"]) == sorted(ERROR_FIELDS)
    section = tolerance_section(numbers)
    rows = section["rows"]
    assert (
        "devices, median" in section["chart"]
        and {row[0] for row in rows} > set(ERROR_FIELDS)
        and {len(row) for row in rows} == {6}
    )


@pytest.mark.integration
def test_the_command(folder, run):
    (folder / "made.toml").write_text("position_um = 1.0\ntilt_deg = 0.1\n")
    options = ("--tolerances", "made.toml", "--tilt-deg", 0.3, "--depths", "18:22:2", "--draws", 20, "-q")
    status, out, err = run("tolerance", "design.toml", *options, "-o", "t.json")
    assert (status, err) == (0, "") and "Yield:" in out and "all, by gradient" in out and "…" not in out
    assert max(map(len, out.split("- Yield")[0].splitlines())) <= 80
    numbers = json.loads((folder / "t.json").read_text())
    assert numbers["tolerances"] == ToleranceSpec(position_um=1.0, tilt_deg=0.3).model_dump()
    assert numbers["drawn"]["devices"] == 20 and numbers["provenance"]["command"].startswith("gs-jax tolerance")
    assert {path.name for path in folder.iterdir()} == {"design.toml", "made.toml", "t.json", "t.json.png"}


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("--position-um", "-1"), "must be 0 to 1000 um, got '-1'"),
        (("--index", "x"), "must be 0 to 0.1, got 'x'"),
        (("--tolerances", "wrong.toml"), "`possition_um`: no such key; did you mean `position_um`?"),
        (("-o", "t.txt"), "suffix must be .json, got '.txt'"),
        (("--draws", "0"), "0 is not in the range"),
        (("--positions", "places.csv"), "places.csv: every source must have x, y and z"),
        (("--min-strehl", "2"), "must be 0.001 to 1, got '2'"),
    ],
)
def test_wrong_input_is_one_line(folder, run, arguments, message):
    (folder / "wrong.toml").write_text("possition_um = 1.0\n")
    (folder / "places.csv").write_text("x_mm,y_mm\n0,0\n")
    status, _, err = run("tolerance", "design.toml", *arguments)
    assert status == 2 and message in err and len(err.strip().splitlines()) == 1
    assert not (folder / "t.json").exists()


def test_designs_that_have_no_answer(design):
    ideal = design.model_copy(update={"lens": design.lens.model_copy(update={"focal_length_mm": 3.0})})
    with pytest.raises(InputError, match="`lens.focal_length_mm` must be left out, .*, got 3"):
        tolerance(ideal)
    few = design.array.model_copy(update={"centers_mm": ((0.0, 0.0),)})
    with pytest.raises(InputError, match="2 or more lenses must see"):
        tolerance(design.model_copy(update={"array": few}))
    with pytest.raises(InputError, match="`max_width` must be positive"):
        tolerance(design, max_width=-1.0)
    with pytest.raises(InputError, match="`draws` must be one or more"):
        tolerance(design, draws=0)


def test_files_and_options_agree(folder):
    (folder / "all.toml").write_text("\n".join(f"{k} = {v}" for k, v in ToleranceSpec().model_dump().items()))
    assert read_tolerances("all.toml") == ToleranceSpec()
    options = {param.name for param in command.params}
    assert set(ToleranceSpec.model_fields) <= options
    for text in ("roughness_nm = -1.0", "conic = true", "nonsense"):
        (folder / "bad.toml").write_text(text)
        with pytest.raises(InputError, match="bad.toml"):
            read_tolerances("bad.toml")
