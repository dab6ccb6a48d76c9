"""Calibration: spots and their lenses, geometry from spots that we put somewhere, and from ray-traced captures."""

import dataclasses
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.quiver import QuiverKey
from scipy.io import loadmat
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import gs_jax as gs
from experiments.calibration import NAMES, device, on_captures, true_values
from experiments.printed_array import FAR as FAR_MM, SHAPE, recipe
from gs_jax.__main__ import commands
from gs_jax.calibration.calibrated_design import apply_calibration, pattern_scales, plot_residuals
from gs_jax.calibration.fit import PATTERN_FITTED, Calibration, self_calibrate
from gs_jax.calibration.initial_guess import guess_without_lenses, match_pattern, match_shift
from gs_jax.calibration.spot_model import FITTABLE, FITTED, OF_DEVICE, core_offsets
from gs_jax.calibration.spots import Sources, Spots, alternatives, find_blurred_spots, find_spots, half_light_radii
from gs_jax.cli.captures import FIT_NAMES
from gs_jax.io.camera import Readout
from gs_jax.io.point_tables import read_positions
from gs_jax.io.provenance import read_provenance
from gs_jax.microscope.layouts import hexagonal_layout, square_layout
from gs_jax.microscope.lenses import lenses_by_type
from gs_jax.microscope.media import reduced_distance
from gs_jax.optics.apertures import split_by_type
from gs_jax.optics.raytrace import to_numpy

from .helpers import needs

POINTS = np.array([[0.4, -0.3, 18.0], [-1.0, 0.2, 20.0], [0.3, 1.1, 22.0]])


def render_spots(places, shape, seed=0, noise=2.0) -> np.ndarray:
    """Gaussian spots at `(row, column)` on an offset, with noise, a hot pixel and a spot of no source."""
    rng = np.random.default_rng(seed)
    image = rng.normal(100, noise, shape)
    side = np.arange(-8, 9)
    for number, (row, column) in enumerate([*places, rng.uniform(100, 200, 2)]):
        r, c = round(row), round(column)
        if min(r, c, shape[0] - 1 - r, shape[1] - 1 - c) > 8:
            along, across = (np.exp(-((side + at - place) ** 2) / 4.5) for at, place in ((r, row), (c, column)))
            image[r - 8 : r + 9, c - 8 : c + 9] += (300 - 2 * number) * np.outer(along, across)
    image[50, 60] += 2000
    return image


def traced_spots(imager: gs.Imager, point) -> np.ndarray:
    """Trace the cores of a point's spots, `(row, column)`, nearest lenses first, without a tenth of them.

    Computed in the plate's frame and rotated into the sensor's, so that the tilt is exact. Plate and filters are
    optically thinner along its normal, and a sample with a surface of its own along the sensor's.
    """
    imager = to_numpy(imager)
    array, sample = imager.array, imager.sample
    thickness = float(array.substrate_thickness)
    thinner = thickness * (1 - 1 / float(array.refractive_index))
    in_front, behind = (thickness, 0.0) if array.orientation == "plano" else (0.0, thinner)
    filters = 0.0 if imager.filters is None else float(imager.filters.shortening)
    in_sample = 0.0 if sample is None else point[2] - float(reduced_distance(np.asarray(point[2]), None, sample))
    tilt = np.zeros(2) if imager.tilt is None else np.asarray(imager.tilt)
    steepest = np.append(tilt, 0) / max(np.linalg.norm(tilt), 1e-12)
    turn = Rotation.from_rotvec(np.arctan(np.linalg.norm(tilt)) * np.cross(steepest, [0, 0, 1]))
    level = eqx.tree_at(lambda i: i.tilt, imager, None, is_leaf=lambda leaf: leaf is None)
    v = float(imager.reduced_sensor_distance)
    source = turn.inv().apply([*point[:2], point[2] - in_sample + in_front])
    source[2] -= filters + (thinner if in_front else 0)
    centers = level.centers
    beside = source[:2] - centers
    field = np.hypot(*beside.T)
    order = np.argsort(field)[: int(0.9 * len(field))]
    order = order[field[order] < 1.1 * imager.field_radius][1:]
    centers, beside, field = centers[order], beside[order], field[order]
    some = np.linspace(0, 1.1 * imager.field_radius, 13)
    depth = level.depth_of(source[2:])
    types = split_by_type(level, lenses_by_type(level.array))
    offsets = [np.interp(field, some, core_offsets(one, depth, some)[0]) for one in types]
    offset = np.choose(np.asarray(level.array.type_of_lens)[order], offsets)
    landing = centers - v / source[2] * beside + (offset / np.maximum(field, 1e-12))[:, None] * beside
    vertices = turn.apply(np.column_stack([centers, 0 * field]))
    onward = turn.apply(np.column_stack([landing, 0 * field - v])) - vertices
    # Behind a plate the light goes on as from farther along its normal.
    vertices = vertices - behind * turn.apply([0, 0, 1])
    onward = onward[:, :2] * ((v + behind + vertices[:, 2]) / -onward[:, 2])[:, None]
    return np.asarray(imager.sensor.to_pixels(vertices[:, :2] + onward))


def captures(imager: gs.Imager, points=POINTS, of=None) -> list[np.ndarray]:
    """Captures of points, whose capture numbers are `of`; by default one point in each."""
    of = np.arange(len(points)) if of is None else np.asarray(of)
    places = [np.concatenate([traced_spots(imager, p) for p in points[of == k]]) for k in range(of.max() + 1)]
    return [render_spots(each, imager.sensor.shape, seed) for seed, each in enumerate(places)]


def check(found: Calibration, actual: gs.Imager, names=NAMES, **also):
    """Within four standard deviations, and a fiftieth of a pixel's worth."""
    true = true_values(actual) | also
    for name in names:
        off = found.values[name] - true[name]
        off = (off + 180) % 360 - 180 if name == "rotation_deg" else off
        assert abs(off) < 4 * found.deviations[name] + (0.01 if "tilt" in name else 1e-6), (name, off)


def test_spots_are_found_within_a_fiftieth_of_a_pixel():
    rng = np.random.default_rng(0)
    places = np.stack(np.meshgrid(*2 * [np.linspace(250, 900, 6)], indexing="ij"), -1).reshape(-1, 2)
    places = places + rng.uniform(-0.5, 0.5, places.shape)
    found = find_spots(render_spots(places, (1000, 1000)), 60)
    distance = np.linalg.norm(found[:, None] - places, axis=-1).min(0)
    assert distance.max() < 0.05 and np.sqrt((distance**2).mean()) < 0.02
    assert len(find_spots(np.random.default_rng(1).normal(100, 2, (300, 300)), 60)) == 0


def test_an_ideal_lens_puts_its_core_on_the_chief_ray():
    imager = device(0)[0]
    ideal = dataclasses.replace(imager, array=dataclasses.replace(imager.array, thin_lens_focal_length=4.65))
    focused = eqx.tree_at(lambda i: i.sensor_distance, ideal, jnp.asarray(1 / (1 / 4.65 - 1 / (20 + 1 / 1.43))))
    np.testing.assert_allclose(core_offsets(focused, np.array([20.0]), np.linspace(0, 2, 3)), 0, atol=1e-4)


@pytest.mark.parametrize("types", [1, 2])
def test_lenses_beside_the_sensor_are_left_out(types):
    """A plate that is larger than the sensor, mounted to one side; numbers of single lenses stay theirs."""
    design = gs.geomscope()
    if types == 2:
        centers = np.array(design.array.centers_mm)
        design = design.replace(radius_of_curvature_mm=np.where(centers[:, 0] > 0, 2.0, 2.1))
    imager = eqx.tree_at(lambda i: i.shift, design.imager(), jnp.array([4.0, 0.0]))
    nothing = Spots(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    sources = Sources(POINTS, np.arange(3))
    found = Calibration(imager, False, {}, {}, sources, nothing, np.zeros((0, 2)))
    new = apply_calibration(design, found._replace(residuals=np.ones((1, 2))))
    left, all_of_them = len(new.array.centers_mm), len(design.array.centers_mm)
    assert 0.5 * all_of_them < left < all_of_them
    assert new.provenance["lenses_beside_the_sensor"] == all_of_them - left
    if types == 2:
        expected = np.where(np.array(new.array.centers_mm)[:, 0] > 0, 2.0, 2.1)
        np.testing.assert_array_equal(new.lens.radius_of_curvature_mm, expected)


# Of an array, relative: what is near to a lens depends on the pitch.
SIZES = pytest.mark.parametrize("size", [1.0, 0.1])


@SIZES
@pytest.mark.parametrize("seed", range(6))
def test_a_pattern_is_matched_at_any_rotation_mirrored_or_not(seed, size):
    rng = np.random.default_rng(seed)
    centers = np.asarray(device(seed)[1].array.centers)
    c = centers @ (1, 1j)
    factor, shift = 1.29 * np.exp(1j * rng.uniform(-np.pi, np.pi)), complex(*rng.uniform(-3, 3, 2))
    near = np.argsort(np.abs(c - complex(*rng.uniform(-2, 2, 2))))[:20]
    p = factor * (c.conj() if seed % 2 else c)[near] + shift + rng.normal(0, 0.003, (20, 2)) @ (1, 1j)
    p[[3, 7, 11]] = rng.uniform(-4, 4, (3, 2)) @ (1, 1j)
    found = match_pattern(size * np.stack([p.real, p.imag], -1), size * centers, 1.27, 0.05)
    assert found.mirrored == bool(seed % 2) and found.is_clear and found.on_lenses >= 17
    assert abs(found.factor - factor) < 0.005 and abs(found.shift / size - shift) < 0.02


@SIZES
def test_chance_is_no_pattern(size):
    centers = size * np.asarray(device(0)[1].array.centers)
    spots = size * np.random.default_rng(0).uniform(-4, 4, (20, 2))
    assert (
        not match_pattern(spots, centers, 1.28, 0.05).is_clear
        and not match_pattern(spots[:2], centers, 1.28, 0.05).is_clear
    )


@pytest.mark.integration
@pytest.mark.parametrize("seed", [0, 1])
def test_geometry_is_found_from_a_poor_start(seed):
    actual, design, mirrored = device(seed)
    found = gs.calibrate(captures(actual), POINTS, design)
    assert found.mirrored == mirrored and found.rms < 0.1
    check(found, actual)
    # Spots near to where they are due, though the image has others.
    assert len(found.residuals) > 20 and np.hypot(*found.residuals.T).max() < 1
    depth, seen, fitted = pattern_scales(found).T
    np.testing.assert_allclose(seen, fitted, atol=2e-4)
    assert set(depth) <= {18.0, 20.0, 22.0} and len(axes := plot_residuals(found).axes) == 3
    legend = axes[0].get_legend()
    assert legend is not None and [text.get_text() for text in legend.get_texts()] == [
        f"capture {k}" for k in (1, 2, 3)
    ]
    assert any("pixels" in child.text.get_text() for child in axes[0].findobj(QuiverKey))


@pytest.mark.integration
def test_a_binned_region_calibrates_the_whole():
    actual, design, _ = device(0)
    binning = 2
    row, column, rows, columns = 100, 50, 1200, 1400
    region = Readout(roi=(row, column, rows, columns), binning=binning).sensor(design.sensor)
    images = [
        image[row : row + rows, column : column + columns]
        .reshape(rows // binning, binning, columns // binning, binning)
        .mean((1, 3))
        for image in captures(actual)
    ]
    found = gs.calibrate(images, POINTS, eqx.tree_at(lambda i: i.sensor, design, region))
    np.testing.assert_allclose(found.imager.centers, actual.centers, atol=4e-3)
    assert float(found.imager.sensor_distance) == pytest.approx(float(actual.sensor_distance), abs=1e-2)
    left, right, bottom, top = region.extent
    axes = plot_residuals(found).axes[0]
    assert (axes.get_xlim(), axes.get_ylim()) == (pytest.approx((left, right)), pytest.approx((bottom, top)))


def smaller(imager: gs.Imager, times: float) -> gs.Imager:
    """All lengths so many times smaller: its captures are the same."""
    a, sensor = imager.array, imager.sensor
    lengths = {name: getattr(a, name) / times for name in ("centers", "radius_of_curvature", "aperture_diameter")}
    array = dataclasses.replace(a, substrate_thickness=a.substrate_thickness / times, **lengths)
    sensor = dataclasses.replace(sensor, pixel_pitch=sensor.pixel_pitch / times)
    numbers = {name: getattr(imager, name) / times for name in ("sensor_distance", "field_radius", "shift")}
    return dataclasses.replace(imager, array=array, sensor=sensor, **numbers)


@pytest.mark.integration
def test_one_capture_calibrates_a_device_fifty_times_as_small():
    (actual, design, mirrored), times = device(0), 50.0
    found = gs.calibrate(captures(actual)[1:2], POINTS[1:2] / times, smaller(design, times))
    assert found.mirrored == mirrored and found.rms < 0.1
    np.testing.assert_allclose(times * found.imager.centers, actual.centers, atol=2e-3)
    check(found, smaller(actual, times), NAMES[:1])


MANY = np.array([[x, y, z] for z in (18.0, 20.0, 22.0) for x, y in ((-1.2, 0.3), (1.1, 0.8), (0.1, -1.0))])


@pytest.mark.integration
@pytest.mark.parametrize(
    ("seed", "points", "hidden", "of", "held"),
    [
        # An unknown depth is looked for in a capture of its own.
        pytest.param(5, MANY, {0: 2, 4: 2, 8: 3}, [0, 1, 2, 0, 1, 2, 0, 1, 3], "", id="some"),
        pytest.param(5, MANY[[4, 0, 1]], {1: 2, 2: 2}, [0, 1, 1], "", id="two of one depth in one capture"),
        # The shift is the design's: any other shows the same spots, from sources that are displaced.
        pytest.param(6, POINTS, {0: 2, 1: 2, 2: 2}, [0, 1, 2], "shift", id="all in the plane"),
    ],
)
def test_unknown_coordinates_of_sources_are_found(seed, points, hidden, of, held):
    """The first coordinates of some sources are `hidden`."""
    actual, design, _ = device(seed)
    given = points.copy()
    for source, count in hidden.items():
        given[source, :count] = np.nan
    design = eqx.tree_at(lambda i: i.shift, design, actual.shift) if held else design
    fit = [name for name in FITTED if name != held]
    found = gs.calibrate(captures(actual, points, of), given, design, captures=np.array(of), fit=fit)
    check(found, actual, [name for name in NAMES if not held or held not in name])
    sources = found.sources.points
    if of == [0, 1, 1] and abs(sources[1, 0] - points[1, 0]) > 0.5:  # nobody said which of the two is which
        sources = sources[[0, 2, 1]]
    np.testing.assert_allclose(sources[:, :2], points[:, :2], atol=5e-3)
    np.testing.assert_allclose(sources[:, 2], points[:, 2], atol=0.05 if len(points) == 9 else 5e-3)
    assert len(found.residuals) > (60 if len(points) == 9 else 20)


@pytest.mark.integration
def test_scale_offset_and_each_lens():
    actual, design, _ = device(7)
    moves = np.random.default_rng(0).normal(0, 0.008, design.array.centers.shape)
    actual = eqx.tree_at(lambda i: i.array.centers, actual, 1.004 * actual.array.centers + moves)
    found = gs.calibrate(captures(actual, MANY), MANY - [0, 0, 0.15], design, fit=OF_DEVICE)
    check(found, actual, scale=1.004, depth_offset_mm=0.15)
    seen = np.unique(found.spots.lenses)
    away = np.asarray(found.imager.centers - actual.centers)[seen]
    assert np.sqrt((away**2).mean()) < 0.001 and found.rms < 0.1


@pytest.mark.integration
def test_lenses_of_no_list_are_found():
    actual, design, _ = device(5)
    design = eqx.tree_at(lambda i: i.array.centers, design, 1.7 * design.array.centers[::-1])
    found = gs.calibrate(captures(actual, MANY), MANY, design, find_lenses=True)
    away = np.asarray(KDTree(np.asarray(actual.centers)).query(np.asarray(found.imager.centers))[0])
    assert len(away) >= 10 and np.median(away) < 0.002 and away.max() < 0.01
    check(found, actual, NAMES[:1])


@pytest.mark.integration
@pytest.mark.parametrize("numbers", [{"radius_of_curvature": (2.0, 2.1)}, {"aperture_diameter": (2.0, 1.0)}])
def test_lenses_of_two_types_and_no_list_are_found(numbers):
    """With all of the light and noise; the list has other places, and its types in another order."""
    centers = np.asarray(gs.random_layout(28, (7.5, 7.5), seed=1))
    each: dict[str, Any] = {name: np.resize(values, len(centers)) for name, values in numbers.items()}
    actual = gs.Imager(gs.MicrolensArray(centers, size=(7.5, 7.5), **each), gs.Sensor((1000, 1000), 0.009), 5.8, 2.5)
    points = np.array([[0.4, -0.3, 18.0], [-0.5, 0.2, 22.0]])
    images = [
        gs.expose(gs.simulate(np.append(p, 1)[None], actual), gs.Camera(), jax.random.key(0), peak_electrons=1e4)
        for p in points
    ]
    listed = {name: values[::-1] for name, values in each.items()}
    array = dataclasses.replace(actual.array, centers=1.7 * centers[::-1], types=None, **listed)
    design = dataclasses.replace(actual, array=array, sensor_distance=5.86)
    found = gs.calibrate(images, points, design, find_lenses=True)
    away, lens = KDTree(centers).query(np.asarray(found.imager.centers))
    assert len(away) >= 10 and away.max() < 0.01
    for name, values in each.items():
        np.testing.assert_allclose(found.imager.array.of_lenses(name), values[lens], rtol=1e-6)
    off = float(found.imager.sensor_distance - actual.sensor_distance)
    assert abs(off) < 4 * found.deviations["sensor_distance_mm"]


def test_lenses_of_no_list_are_where_they_are_without_the_designs_tilt():
    """They are found in the sensor's frame: rotation, shift and tilt are in their places."""
    actual, design, _ = device(5)
    level = eqx.tree_at(lambda i: i.tilt, actual, jnp.zeros(2))
    points = MANY[:3]
    found = [np.asarray(level.project(points[[k]]))[:, 0] for k in range(3)]
    tilted = eqx.tree_at(lambda i: i.tilt, design, jnp.array([0.03, -0.02]), is_leaf=lambda leaf: leaf is None)
    start = guess_without_lenses(found, Sources(points, np.arange(3)), tilted).imager
    away = KDTree(np.asarray(level.centers)).query(np.asarray(start.centers))[0]
    # The sensor's distance is searched for in steps of a hundredth.
    assert start.tilt is None and np.max(away) < 0.01


@pytest.mark.integration
def test_a_scene_that_nobody_knows():
    actual, design, mirrored = device(4)
    assert not mirrored
    # What a scene cannot tell is right; the rotation is two degrees off, and the tilt is unknown.
    start = eqx.tree_at(lambda i: (i.rotation, i.tilt), actual, (actual.rotation + np.radians(2), None))
    image = captures(actual, MANY, np.zeros(9, int))[0]
    grid = gs.Grid([17.0, 23.0], (121, 121), 0.05)
    found = self_calibrate(image, start, grid)
    check(found, actual, [name for name in NAMES if "rotation" in name or "tilt" in name])
    assert len(found.sources.points) >= 7 and found.rms < 0.2
    with pytest.raises(gs.InputError, match="fit must be some of rotation, .* and sample_index for a scene, got shift"):
        self_calibrate(image, start, grid, fit=["shift"])
    blank = np.random.default_rng(0).normal(100, 2, design.sensor.shape)
    with pytest.raises(gs.InputError, match="capture: a sparse scene in focus with 5 or more points is needed, got 0"):
        self_calibrate(blank, start, grid)


@pytest.fixture(scope="module")
def blank():
    """A design, and noise in its sensor."""
    _, design, _ = device(0)
    return design, np.random.default_rng(0).normal(100, 2, design.sensor.shape)


UNKNOWN = POINTS[:2] * [[1, 1, np.nan], [1, 1, 1]]


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        (POINTS[:1], {}, "got 0 of 0 bright spots on lenses at best"),
        (POINTS[:2], {"find_lenses": True}, "captures: got 0 of 0 spots on lenses that several captures show"),
        (UNKNOWN, {"find_lenses": True}, "positions: two or more known points, .*, got 1 of 2 points unknown"),
        (POINTS[:2], {"lost": True}, "capture 2 must be finite, got 1 of .* pixels NaN"),
        (POINTS, {"images": 1}, "positions: .*1 to 1, got a source in capture 2"),
        (POINTS[:0], {"images": 1}, "positions: .*or more sources, got 0 sources for 1 captures, none in capture 1"),
        ([[0.0, 0.0, -20.0]], {}, "positions: .*depths must be positive, got -20 mm"),
        ([[0.0, 0.0, np.nan]], {}, "positions: .*no known depth to fit sensor_distance by; give the depth of"),
        ([[np.nan, 0.0, 20.0]], {}, "positions: .*no source with known x and y to fit shift by; give x and y of"),
    ],
)
def test_what_cannot_be_calibrated_is_refused_in_words(blank, points, options, message):
    design, blank = blank
    images = [blank] * options.get("images", len(points))
    if options.get("lost"):
        images[1] = np.where(blank == blank.max(), np.nan, blank)
    with pytest.raises(gs.InputError, match=message):
        gs.calibrate(images, np.array(points), design, find_lenses=options.get("find_lenses", False))


@pytest.mark.integration
def test_numbers_that_the_spots_do_not_determine_are_refused():
    actual, design, _ = device(0)
    with pytest.raises(gs.InputError, match="spots do not determine sensor_distance_mm.*depth_offset"):
        gs.calibrate(captures(actual)[1:2], POINTS[1:2], design, fit=OF_DEVICE[:-1])


def test_a_displaced_pattern():
    pattern = np.random.default_rng(0).uniform(-4, 4, (30, 2))
    spots = np.concatenate([pattern[::2] + [0.7, -1.3], [[0.0, 0.0]]])
    shift, count = match_shift(spots, pattern, 0.06)
    np.testing.assert_allclose(shift, [0.7, -1.3], atol=0.01)
    assert count >= 15 and match_shift(spots[:0], pattern, 0.06)[1] == 0


def test_positions_are_read_with_what_is_known(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("capture, x_mm, z_mm\nb.tif, 0.5, 18\n1,,20\n2,-1,\n")
    points, of = read_positions(path, ["some/a.tif", "b.tif"])
    np.testing.assert_array_equal(points, [[0.5, np.nan, 18], [np.nan, np.nan, 20], [-1, np.nan, np.nan]])
    assert of.tolist() == [1, 0, 1]
    path.write_text("x_mm,y_mm,z_mm\n1,2,3\n4,5,6\n")
    assert read_positions(path, ["a.tif", "b.tif"])[1].tolist() == [0, 1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,z\n1,2,3\n", "header must be some of capture,x_mm,y_mm,z_mm, got 'x,y,z'"),
        ("", "header must be .*, got ''"),
        ("x_mm,x_mm\n1,2\n", "header must be"),
        ("x_mm,y_mm,z_mm\n1,2,far\n", "line 2, z_mm must be a number of mm, or nothing.*, got 'far'"),
        ("x_mm,y_mm,z_mm\n1,2,3,4\n", "line 2 must be x_mm,y_mm,z_mm, got more values"),
        ("capture,z_mm\nc.tif,3\n", "line 2, capture must be a number from 1 to 2 or the name.*'c.tif'"),
        ("capture,z_mm\n3,3\n", "line 2, capture must be .*'3'"),
    ],
)
def test_wrong_positions_are_one_line(tmp_path, text, message):
    path = tmp_path / "p.csv"
    path.write_text(text)
    with pytest.raises(gs.InputError, match=message):
        read_positions(path, ["a.tif", "b.tif"])


def test_other_positions_that_may_have_been_meant():
    points = np.array([[0.0, 0.0, 18.0], [0.5, 0.0, 20.0], [0.0, 0.0, 22.0]])
    meant = {said: found.points for said, found in alternatives(Sources(points, np.arange(3)))}
    # Near and far are captures 1 and 3; there is no y to reverse.
    both = "the direction of z reversed (near and far swapped) or captures 1 and 3 swapped"
    assert [said for said in meant if "sign of y" in said] == [] and any(said.startswith(both) for said in meant)
    np.testing.assert_array_equal(meant["captures 1 and 2 swapped"], points[[1, 0, 2]])
    reversed_x = next(found for said, found in meant.items() if said.startswith("the sign of x reversed"))
    np.testing.assert_array_equal(reversed_x, points * [-1, 1, 1])
    # An unknown coordinate stays unknown, and a pattern is not moved.
    rows = np.append(points * [np.nan, 1, 1], [[1.0, 2.0, 1e4]], 0)
    some = Sources(rows, np.arange(4), np.array([1.0, 1.0, 1.0, 7.0]))
    for _, found in alternatives(some):
        assert np.isnan(found.points[:3, 0]).all() and found.points[3].tolist() == [1.0, 2.0, 1e4]


STAGE = np.array([[0.0, 0.0, 18.0], [0.5, 0.3, 20.0], [-0.4, 0.1, 20.0], [0.0, 0.0, 22.0]])


@pytest.mark.integration
@pytest.mark.parametrize("find_lenses", [False, True])
@pytest.mark.parametrize(
    ("places", "message"),
    [
        (STAGE * [-1, 1, 1], "with the sign of x reversed all would fit, 0.2. pixels RMS: correct the positions"),
        (STAGE[[3, 1, 2, 0]], r"captures 1, 4 of 4 do not fit.*near and far swapped\) or captures 1 and 4 swapped all"),
        (STAGE[[0, 2, 1, 3]], "with captures 2 and 3 swapped all would fit"),
        (STAGE + [[0, 0, 0], [0.7, 0, 0], [0, 0, 0], [0, 0, 0]], "capture 2 of 4 does not fit, with 0 of 1. .*no axis"),
    ],
    ids=["x", "near-far", "swapped", "displaced"],
)
def test_captures_that_do_not_fit_are_refused(tmp_path, monkeypatch, places, message, find_lenses):
    """By the command, which prints a line for each capture, and writes nothing."""
    monkeypatch.chdir(tmp_path)
    array = gs.MicrolensArray(gs.random_layout(20, (6.0, 6.0), pitch=1.2, seed=1), size=(6.0, 6.0))
    listed = gs.Imager(array, gs.Sensor((600, 600), 0.0135), sensor_distance=5.8, field_radius=3.0)
    true = dataclasses.replace(listed, sensor_distance=5.9, rotation=0.02)
    gs.write_design("small.toml", gs.Design.from_imager(listed, name="small", working_distance_mm=(18.0, 23.0)))
    names = [f"{number}.tif" for number in range(4)]
    for name, place in zip(names, STAGE, strict=True):
        image = gs.simulate(np.append(place, 1.0)[None], true, optics="near", psf="geometric")
        gs.write_capture(name, np.asarray(image, np.float32))
    options = ["--find-lenses"] if find_lenses else ["--hold", "tilt"]
    for rows, output in ((STAGE, "fits.toml"), (places, "wrong.toml")):
        np.savetxt("p.csv", rows, delimiter=",", header="x_mm,y_mm,z_mm", comments="")
        arguments = ["calibrate", "small.toml", *names, "--positions", "p.csv", *options, "-o", output]
        told = CliRunner().invoke(commands, arguments)
        lines = [line for line in told.stdout.splitlines() if "expected spots" in line]
        assert (told.exception is None) == (output == "fits.toml") == (tmp_path / output).exists()
        if told.exception is None:
            assert [line.split(":")[0] for line in lines] == names and all("pixels RMS" in line for line in lines)
        else:
            assert isinstance(told.exception, gs.InputError) and re.search(message, str(told.exception))
            assert len(str(told.exception)) < 380 and not (tmp_path / "wrong.toml.png").exists()
            assert not lines or any(": 0 of " in line for line in lines)


@pytest.mark.integration
@pytest.mark.parametrize("fit", [FITTED, ()])
def test_a_device_that_is_no_bare_array_is_refused_in_a_line(fit):
    """Real spots of an LED, through optics that no design here has."""
    data = needs("stage/z.toml").parent
    imager, paths = gs.read_design(data / "z.toml").imager(), sorted((data / "cap").glob("*.tif"))
    places = read_positions(data / "places5.csv", paths)[0][:2]
    images = [gs.read_capture(path, imager.sensor.shape) for path in paths[:2]]
    with pytest.raises(
        gs.InputError, match="captures: captures 1, 2 of 2 do not fit.* nothing but a lens array before"
    ):
        gs.calibrate(images, places, imager, fit=fit, find_lenses=True)


def test_the_command_knows_what_can_be_fitted():
    assert tuple(name.replace("-", "_") for name in FIT_NAMES) == FITTABLE


@pytest.mark.integration
def test_the_command(tmp_path):
    """With a small design, whose array is mirrored and turned in the captures."""
    actual, design, mirrored = device(2)
    # Wide enough for the whole plate: designs whose lenses cannot be seen are refused.
    wide = gs.Sensor((2400, 2400), 0.006)
    actual, design = (dataclasses.replace(imager, sensor=wide) for imager in (actual, design))
    array = dataclasses.replace(design.array, size=(14.0, 14.0))
    listed = dataclasses.replace(design, array=array)
    gs.write_design(
        tmp_path / "design.toml", gs.Design.from_imager(listed, name="small", working_distance_mm=(18.0, 30.0))
    )
    names = []
    for number, image in enumerate(captures(actual)):
        names.append(str(tmp_path / f"{number}.tif"))
        gs.write_capture(names[-1], image.astype(np.float32))
    lines = [",".join(map(str, point)) for point in POINTS.tolist()]
    (tmp_path / "p.csv").write_text("\n".join(["x_mm,y_mm,z_mm", *lines]) + "\n")
    arguments = ["calibrate", str(tmp_path / "design.toml"), *names, "--positions", str(tmp_path / "p.csv"), "-o"]
    result = CliRunner().invoke(commands, [*arguments, str(tmp_path / "new.toml")], catch_exceptions=False)
    assert "pixels RMS" in result.stdout and ("mirrored" in result.stdout) == mirrored
    new = gs.read_design(tmp_path / "new.toml").imager()
    np.testing.assert_allclose(new.centers, actual.centers, atol=2e-3)
    assert float(new.sensor_distance) == pytest.approx(float(actual.sensor_distance), abs=5e-3)
    assert "standard_deviations" in read_provenance(tmp_path / "new.toml") and (tmp_path / "new.toml.png").exists()
    shown = CliRunner().invoke(commands, ["metrics", str(tmp_path / "new.toml")], catch_exceptions=False).stdout
    assert "calibrated by" in shown and "sensor_distance_mm +- " in shown
    assert new.tilt is not None and "calibrated_values" in read_provenance(tmp_path / "new.toml")
    (tmp_path / "p.csv").write_text("x_mm,y_mm,z_mm\n0,0,20\n")
    for more, message in (
        (
            [],
            "positions: every capture needs one or more sources, got 1 sources for 3 captures",
        ),
        (["--from-scene"], "--from-scene needs one capture, without --positions"),
        (["--pattern", names[0], "--find-lenses"], "--pattern needs DESIGN's lenses"),
        (["--fit", "focus"], "must be some of sensor-distance, rotation"),
    ):
        wrong = CliRunner().invoke(commands, [*arguments, str(tmp_path / "other.toml"), *more])
        assert message in f"{wrong.exception} {wrong.output}" and wrong.exit_code


@pytest.mark.slow
def test_ray_traced_captures():
    found, whole = on_captures(needs("oracle/dev/P1.toml").parent, gs.Progress())
    assert whole.rms < 0.3 and max(found["held_out_rms_pixels"].values()) < 0.3
    assert found["values"]["sensor_distance_mm"] == pytest.approx(5.85, abs=1e-3)
    assert found["points_f1"] == 1 and found["points_axial_um"] < 20


# Calibration by wide spots: a white surface's images, which are discs that we draw, and a real printed array.


FAR = np.array([[0.0, 0.0, FAR_MM]])


def discs(shape, middles, radius: float, seed=0) -> np.ndarray:
    """Evenly lit discs at `(row, column)`, darker toward their edges, on an offset, with shot noise."""
    rows, columns = np.arange(shape[0])[:, None], np.arange(shape[1])[None]
    light = np.zeros(shape)
    for row, column in middles:
        distance = np.hypot(rows - row, columns - column)
        light += np.clip(radius - distance + 0.5, 0, 1) * (1 - 0.3 * np.minimum(distance / radius, 1) ** 2)
    return 100 + np.random.default_rng(seed).poisson(3000 * light + 20).astype(float)


def pattern_device() -> tuple[gs.Imager, gs.Imager]:
    """A device with its array mirrored, turned, moved and shrunk, and its design."""
    centers = np.asarray(gs.random_layout(24, (5.5, 5.5), pitch=0.9, seed=3))
    design = gs.Imager(gs.MicrolensArray(centers), gs.Sensor((480, 500), 0.015), 5.8, 2.5)
    built = dataclasses.replace(design.array, centers=0.98 * centers * (1, -1))
    return dataclasses.replace(design, array=built, rotation=2.0, shift=(0.3, -0.2)), design


def white(actual: gs.Imager, place=FAR, radius=20.0) -> np.ndarray:
    middles = np.asarray(actual.project(place))[:, 0]
    return discs(actual.sensor.shape, np.asarray(actual.sensor.to_pixels(middles)), radius)


def test_middles_and_widths_of_discs():
    rng = np.random.default_rng(0)
    places = np.stack(np.meshgrid([60, 110, 160], [60, 110, 160, 210]), -1).reshape(-1, 2) + rng.uniform(-2, 2, (12, 2))
    image = discs((220, 270), places, 15.0)
    middles, radii = find_blurred_spots(image, 50.0, 20)
    away = np.linalg.norm(middles[:, None] - places, axis=-1)
    assert len(middles) == 12 and away.min(0).max() < 0.05
    # Half of an even disc's light is within 0.71 of its radius; these are darker toward the edge.
    assert np.all((radii > 9.9) & (radii < 10.6))
    assert half_light_radii(np.zeros((50, 50)), np.array([[25.0, 25.0]]), np.array([30.0])) == 0
    assert len(find_blurred_spots(np.zeros((80, 80)), 30.0, 5)[0]) == 0


def test_chance_is_no_pattern_of_wide_spots():
    centers = np.asarray(gs.random_layout(40, (8.0, 8.0), pitch=1.0, seed=1))
    chance = np.random.default_rng(0).uniform(-4, 4, (20, 2))
    assert not match_pattern(chance, centers, 1.0, 0.5, blurred=True).is_clear


@pytest.mark.parametrize("layout", [hexagonal_layout, square_layout])
@pytest.mark.parametrize(("turned", "moved"), [(0.0, 0j), (2.0, 0.7 + 0.9j)])
def test_of_a_regular_array_the_pose_next_to_the_design_is_found(layout, turned, moved):
    """The design is turned and moved already in the second: every other lens of the array fits as well."""
    centers = np.asarray(layout((9.0, 9.0), pitch=1.0))
    factor, shift = 1.05 * np.exp(1j * (turned + 0.1)), moved + 0.2 - 0.3j
    spots = (centers @ (1, 1j) * factor + shift)[np.argsort(np.hypot(*centers.T))][:20]
    design = np.exp(1j * turned)
    found = match_pattern(np.stack([spots.real, spots.imag], -1), centers, design, 0.5, blurred=True, shift=moved)
    assert not found.mirrored and found.on_lenses == 20
    assert abs(found.factor - factor) < 1e-6 and abs(found.shift - shift) < 1e-6


@pytest.mark.integration
def test_a_white_surface_shows_rotation_shift_and_scale():
    actual, design = pattern_device()
    found = gs.calibrate([white(actual)], FAR, design, fit=PATTERN_FITTED, blurred=[0])
    assert found.mirrored and len(found.residuals) == 24 and found.rms < 0.1
    np.testing.assert_allclose(found.imager.centers, actual.centers, atol=0.02 * actual.sensor.pixel_pitch)
    assert found.values["scale"] == pytest.approx(0.98, abs=1e-4)
    # Discs that touch draw each other's middles a little.
    touching = gs.calibrate([white(actual, radius=27.0)], FAR, design, fit=PATTERN_FITTED, blurred=[0])
    np.testing.assert_allclose(touching.imager.centers, actual.centers, atol=0.1 * actual.sensor.pixel_pitch)
    # Images that overlap show no lenses, nor does the dark.
    for image in (white(actual, radius=45.0), np.random.default_rng(0).normal(100, 2, actual.sensor.shape)):
        with pytest.raises(gs.InputError, match="captures: a pattern must show an image of each lens .*, got"):
            gs.calibrate([image], FAR, design, fit=PATTERN_FITTED, blurred=[0])
    with pytest.raises(gs.InputError, match="capture 1 must have one source, .*, got 2"):
        gs.calibrate(
            [white(actual)], np.repeat(FAR, 2, 0), design, fit=PATTERN_FITTED, captures=np.zeros(2, int), blurred=[0]
        )


@pytest.mark.parametrize("layout", [square_layout, pytest.param(hexagonal_layout, marks=pytest.mark.integration)])
def test_discs_that_touch_in_uneven_light_leave_errors_that_hold(layout):
    """Four fifths of the picture are lit: its median is the discs' own light, a third darker at one side."""
    size, pixel = 0.125, 0.0074
    centers = np.asarray(layout((1.6, 1.6), pitch=size))
    design = gs.Imager(gs.MicrolensArray(centers), gs.Sensor((250, 250), pixel), 2.4, 0.5)
    built = dataclasses.replace(design.array, centers=1.01 * centers)
    actual = dataclasses.replace(design, array=built, rotation=0.01)
    y, x = np.mgrid[-0.5:0.5:250j, -0.5:0.5:250j]
    image = white(actual, radius=1.01 * size / 2 / pixel + 0.3) * (1 + 0.3 * x - 0.6 * (x**2 + y**2))
    found = gs.calibrate([image], FAR, design, fit=PATTERN_FITTED, blurred=[0])
    assert len(found.residuals) == len(centers) and found.rms < 0.18
    for name, true in (("scale", 1.01), ("rotation_deg", np.degrees(0.01))):
        assert abs(found.values[name] - true) < 3 * found.deviations[name]
    assert found.deviations["scale"] < 5e-4


@pytest.mark.integration
@pytest.mark.parametrize(
    ("design", "image", "pitch", "by_phase", "rms"),
    [
        # By the phase of the lattice and by masks of the discs.
        ("ur.toml", "ur_w.tif", 0.125, 17.209, 0.18),
        # By the phase, whose mean over both directions changes by 0.001 with the window.
        ("guv.toml", "Radiometry_GUVExperim1.tif", 0.1, 15.4007, 0.14),
    ],
)
def test_real_white_images(design, image, pitch, by_phase, rms):
    data = needs("whiteimages/ur_w.tif").parent
    imager = gs.read_design(data / design).imager()
    found = gs.calibrate(
        [gs.read_capture(data / image, imager.sensor.shape)], FAR, imager, fit=PATTERN_FITTED, blurred=[0]
    )
    pixels = pitch * float(imager.scale(FAR_MM)) / imager.sensor.pixel_pitch
    assert found.rms < rms and abs(found.values["scale"] * pixels - by_phase) < 3 * found.deviations["scale"] * pixels
    assert found.deviations["scale"] < 5e-4


@pytest.mark.integration
def test_an_overexposed_white_image_is_said_to_be(tmp_path):
    data = needs("whiteimages/ur_over.tif").parent
    names = [str(data / "ur.toml"), "--pattern", str(data / "ur_over.tif"), "-o", str(tmp_path / "found.toml")]
    result = CliRunner().invoke(commands, ["calibrate", *names])
    assert "ur_over.tif: 310649 pixels (0.63 of all) are saturated at 255" in result.stderr


@pytest.mark.integration
def test_centres_agree_with_those_of_another_program():
    """In a quarter of a foreign ray-traced white image."""
    data = needs("plenoptic/white.tif").parent
    theirs = loadmat(data / "sf_cal.mat")["cal"][0, 0]
    theirs = np.stack([theirs[name].ravel() - 1 for name in ("exactY", "exactX")], -1)
    imager = gs.read_design(data / "plen.toml").imager()
    image = gs.read_capture(data / "white.tif", imager.sensor.shape)[:1000, :1000]
    imager = dataclasses.replace(imager, sensor=Readout(roi=(0, 0, 1000, 1000)).sensor(imager.sensor))
    near = np.abs(np.asarray(imager.array.centers) + 3.1).max(1) < 2.9
    imager = dataclasses.replace(imager, array=dataclasses.replace(imager.array, centers=imager.array.centers[near]))
    found = gs.calibrate([image], FAR, imager, fit=PATTERN_FITTED, blurred=[0])
    away, which = KDTree(theirs).query(spots := np.asarray(imager.sensor.to_pixels(found.spots.positions)))
    off = (spots - theirs[which])[away < 5]
    assert len(off) > 2000 and np.abs(off.mean(0)).max() < 0.01 and np.sqrt((off**2).sum(1).mean()) < 0.1


@pytest.mark.integration
def test_the_command_takes_a_white_surface_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    actual, listed = pattern_device()
    listed = dataclasses.replace(listed, array=dataclasses.replace(listed.array, size=(5.6, 5.6)))
    gs.write_design("listed.toml", gs.Design.from_imager(listed, name="small", working_distance_mm=(18.0, 23.0)))
    gs.write_capture("white.tif", white(actual).astype(np.float32))
    arguments = ["calibrate", "listed.toml", "--pattern", "white.tif", "-o", "found.toml"]
    told = CliRunner().invoke(commands, arguments, catch_exceptions=False).stdout
    assert "found.toml: 24 spots" in told and "the array mirrored (y to -y) and rotated" in told
    found = gs.read_design("found.toml")
    np.testing.assert_allclose(found.imager().centers, actual.centers, atol=0.02 * actual.sensor.pixel_pitch)
    assert found.imaging == gs.read_design("listed.toml").imaging and (tmp_path / "found.toml.png").exists()
    assert set(found.provenance["calibrated_values"]) == {"rotation_deg", "shift_x_mm", "shift_y_mm", "scale"}
    wrong = CliRunner().invoke(commands, [*arguments, "--force", "--hold", "scale"])
    assert "apart from its neighbours, at the design's scale unless that is fitted, got" in str(wrong.exception)


@pytest.mark.integration
def test_a_white_surface_tells_scale_from_sensor_distance():
    """Which a bead alone does not. The surface's light comes from far to one side, as nobody said."""
    actual, design = pattern_device()
    surface, bead = white(actual, np.array([[300.0, -200.0, FAR_MM]])), np.array([[0.3, -0.2, 18.0]])
    start, places = dataclasses.replace(design, sensor_distance=5.6), np.append(bead, [[np.nan, np.nan, FAR_MM]], 0)
    fit = ("sensor_distance", *PATTERN_FITTED)
    # Four lenses are no pattern of their own.
    few = render_spots(traced_spots(actual, bead[0])[:4], actual.sensor.shape)
    for image in (*captures(actual, bead), few):
        found = gs.calibrate([image, surface], places, start, fit=fit, blurred=[1])
        assert found.values["sensor_distance_mm"] == pytest.approx(5.8, abs=0.005)
        assert found.values["scale"] == pytest.approx(0.98, abs=3e-4)


@pytest.mark.integration
def test_a_printed_array_of_37_radii():
    """Mirrored, turned, out of focus and of unknown scale: what `experiments/printed_array.py` measures in full."""
    data = needs("randoscope/psf.tif").parent
    found = gs.calibrate([gs.read_capture(data / "psf.tif", SHAPE)], FAR, recipe(data), fit=PATTERN_FITTED, blurred=[0])
    assert found.mirrored and len(found.residuals) == 37 and found.rms < 2
    assert found.values["rotation_deg"] == pytest.approx(150.4, abs=0.5)
    assert found.values["scale"] == pytest.approx(1.36, abs=0.01)


# Calibration through layers: in air with filter and window in place, then of what is not known about a sample.


FILTER, WINDOW = gs.Layers([2.0], [1.52]), gs.Layers([0.6, 0.55], [1.0, 1.51])
GEL = gs.Sample(1.43, surface=17.0, layers=gs.Layers([0.17], [1.523]))


def layered(kind: str) -> tuple[gs.Imager, gs.Imager]:
    """A tilted device with filter and window, and its design, whose sensor distance is off."""
    actual, design, _ = device(0)
    numbers = {"types": {"radius_of_curvature": np.resize([2.0, 2.05], 60)}, "curved": {"orientation": "curved"}}
    array = dataclasses.replace(actual.array, **numbers.get(kind, {}))
    filters = gs.Layers([0.3, 2.0], [1.0, 1.52]) if kind == "curved" else FILTER
    actual = dataclasses.replace(actual, array=array, filters=filters, windows=WINDOW)
    # In focus, as without layers.
    actual = dataclasses.replace(actual, sensor_distance=to_numpy(actual).sensor_distance_of(5.8))
    array = dataclasses.replace(array, centers=design.array.centers)
    moved = {
        "sensor_distance": 1.03 * float(actual.sensor_distance),
        "rotation": 0.0,
        "shift": (0.0, 0.0),
        "tilt": None,
    }
    return actual, dataclasses.replace(actual, array=array, **moved)


@pytest.mark.parametrize("kind", ["curved", pytest.param("types", marks=pytest.mark.integration)])
def test_a_stack_is_calibrated_in_air(kind):
    actual, design = layered(kind)
    points = MANY[[0, 7]]
    found = gs.calibrate(captures(actual, points), points, design)
    assert found.rms < 0.1
    check(found, actual)


SCENE = np.zeros(9, int)


@pytest.mark.parametrize("kind", ["plano", pytest.param("types", marks=pytest.mark.integration)])
def test_points_of_known_depths_give_surface_and_index(kind):
    actual, _ = layered(kind)
    # In the second, the layers of the design end where the sample begins.
    layers = gs.Layers([2.0, 14.83, 0.17], [1.52, 1.0, 1.523])
    guess = dataclasses.replace(actual, sample=gs.Sample(1.38, 16.5, GEL.layers))
    if kind == "types":
        guess = dataclasses.replace(actual, filters=layers, sample=gs.Sample(1.38))
    actual = dataclasses.replace(actual, sample=GEL)
    found = gs.calibrate(captures(actual, MANY, SCENE), MANY, guess, captures=SCENE, fit=("sample_at", "sample_index"))
    for name, true in (("sample_at_mm", 17.0), ("sample_index", 1.43)):
        assert abs(found.values[name] - true) < 4 * found.deviations[name] < 0.2
    sample = found.imager.sample
    assert sample is not None and sample.surface is not None
    assert float(sample.surface) == found.values["sample_at_mm"]
    # What is not fitted is the imager's.
    assert float(found.imager.sensor_distance) == float(actual.sensor_distance) and not found.mirrored


@pytest.mark.integration
def test_points_that_nobody_knows_do_not_give_an_index():
    wet = dataclasses.replace(layered("plano")[0], sample=GEL)
    image, grid = captures(wet, MANY, SCENE)[0], gs.Grid([17.2, 23.0], (121, 121), 0.05)
    with pytest.raises(gs.InputError, match="do not determine sample_index.*; give the depths of points in the sample"):
        self_calibrate(image, wet, grid, fit=("sample_index",))


@pytest.mark.parametrize(
    ("sample", "fit", "depth", "words"),
    [
        (None, "sample_index", 20.0, "fit: sample_index needs a microscope with a sample, got one in air"),
        (gs.Sample(1.33), "sample_at", 20.0, "fit: sample_at needs a sample behind a gap of air, got one in contact"),
        (GEL, "tilt", 16.0, "positions: depths must be 17 mm, where the sample begins, or more, got 16 mm"),
        (None, "tilt", 1.5, "positions: depths must be 2 mm, where the filters end, or more, got 1.5 mm"),
    ],
)
def test_what_cannot_be_fitted_of_a_sample_is_refused_in_words(sample, fit, depth, words):
    scope = dataclasses.replace(layered("plano")[0], sample=sample)
    with pytest.raises(gs.InputError, match=words):
        gs.calibrate([np.zeros(scope.sensor.shape)], np.array([[0.0, 0.0, depth]]), scope, fit=[fit])


@pytest.mark.integration
def test_the_command_takes_sources_in_air_and_then_a_gel(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    actual, listed = (dataclasses.replace(one, sensor=gs.Sensor((2400, 2400), 0.006)) for one in layered("plano"))
    listed = dataclasses.replace(listed, array=dataclasses.replace(listed.array, size=(14.0, 14.0)))
    gel = {"refractive_index": 1.38, "surface_mm": 16.5, "layers": [{"thickness_mm": 0.17, "refractive_index": 1.523}]}
    design = gs.Design.from_imager(listed, name="small", working_distance_mm=(18.0, 30.0))
    gs.write_design("small.toml", design.replace(samples={"gel": gel}))
    scenes = {"air.tif": actual, "gel.tif": dataclasses.replace(actual, sample=GEL)}
    for name, scope in scenes.items():
        gs.write_capture(name, captures(scope, MANY, SCENE)[0].astype(np.float32))
    lines = [f"1,{x},{y},{z}" for x, y, z in MANY]
    (tmp_path / "p.csv").write_text("\n".join(["capture,x_mm,y_mm,z_mm", *lines]) + "\n")
    run = lambda *options: CliRunner().invoke(commands, ["calibrate", *options, "--positions", "p.csv"])
    told = run("small.toml", "air.tif", "-o", "found.toml")
    assert "sources in air, behind 2 mm of n = 1.52; if they were in a sample: --sample gel" in told.stdout
    found = gs.read_design("found.toml")
    assert found.samples == gs.read_design("small.toml").samples
    assert found.imaging.sensor_distance_mm == pytest.approx(float(actual.sensor_distance), abs=5e-3)
    held = ("--hold", "sensor_distance,rotation,shift,tilt", "--fit", "sample_at,sample_index")
    told = run("found.toml", "gel.tif", "--sample", "gel", *held, "-o", "gel.toml")
    assert "sources in n = 1.4" in told.stdout and "sample_index" in told.stdout
    new = gs.read_design("gel.toml")
    # It moves by eight times the error of the sensor's distance.
    assert new.samples["gel"].surface_mm == pytest.approx(17.0, abs=0.05)
    assert new.samples["gel"].refractive_index == pytest.approx(1.43, abs=0.01)
    assert new.imaging == found.imaging and new.sample == found.sample
