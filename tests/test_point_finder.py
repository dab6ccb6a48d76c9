"""Points out of captures that are rendered finer than any voxel, with noise, or ray-traced."""

import inspect
import json
from functools import cache

import equinox as eqx
import jax
import numpy as np
import pytest
import tifffile
from scipy.spatial import KDTree

import gs_jax as gs
from experiments import point_density
from gs_jax.detection import spot_fit
from gs_jax.detection.background import DetectionImage
from gs_jax.detection.particles import find_clusters
from gs_jax.detection.view_samples import detection_stats, lens_types_of
from gs_jax.microscope.layouts import interleave
from gs_jax.optics.apertures import clear_area
from gs_jax.simulation import random_points, simulate_points

from .helpers import compilations, needs


def small() -> tuple[gs.Imager, gs.Grid]:
    """49 ideal lenses, 7 x 7 mm, in focus at 20 mm; a point is seen by about 12. Their cores are on the chief rays."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:7, :7]
    centers = np.stack([column, row], -1).reshape(-1, 2) - 3.0 + rng.uniform(-0.3, 0.3, (49, 2))
    array = gs.MicrolensArray(centers, thin_lens_focal_length=4.5, size=(7.0, 7.0))
    imager = gs.Imager(array, gs.Sensor((896, 960), 0.009), 5.75, 2.0)
    return imager, gs.Grid(np.arange(19.0, 21.01, 0.25), (181, 181), 0.03)


@cache
def rendered(points: tuple) -> np.ndarray:
    imager, _ = small()
    return simulate_points(np.array(points), imager, kind="geometric", progress=gs.Progress())


def image_of(points) -> np.ndarray:
    return rendered(tuple(map(tuple, points)))


def capture_of(points, *, electrons=3000, key=0) -> np.ndarray:
    return np.array(gs.expose(image_of(points), gs.Camera(), jax.random.key(key), peak_electrons=electrons))


def find(image, grid=None) -> np.ndarray:
    imager, default = small()
    return gs.find_points(image, imager, default if grid is None else grid, progress=gs.Progress())


def test_other_numbers_find_the_programs():
    """Another image, and another microscope and depths whose magnification is the same: no compilation."""
    imager, grid = small()
    points = np.array([[0.3, -0.4, 20.2, 1.0], [-0.9, 0.8, 19.6, 0.8]])
    first = gs.find_points(image_of(points), imager, grid)
    other = eqx.tree_at(
        lambda i: (i.array.centers, i.array.thin_lens_focal_length), imager, replace_fn=lambda x: 1.01 * x
    )
    before = compilations()
    gs.find_points(image_of(points)[::-1], imager, grid)
    gs.find_points(image_of(points), other, gs.Grid([18.9, 20.0, 21.1], (91, 91), 0.06))
    assert compilations() == before
    np.testing.assert_array_equal(gs.find_points(image_of(points), imager, grid), first)


def many() -> np.ndarray:
    """24 points of several intensities, none within 0.1 mm of another: three pixels."""
    points = random_points(25, (4.5, 4.5), (19.1, 20.9), seed=2)
    points[:, 3] = np.random.default_rng(0).uniform(0.5, 1.5, 25)
    close = KDTree(points[:, :2]).query_pairs(0.1)
    return np.delete(points, [pair[0] for pair in close], axis=0)


# A pixel is 0.032 mm laterally and, from the outer lenses, 0.33 mm axially in this imager. A third of that is left
# where spots overlap and where aberrations bend chief rays, 0.06 mm at 1 mm from the focus.
LATERAL, AXIAL = 0.01, 0.1


@pytest.mark.integration
def test_points_are_found_placed_and_measured():
    truth = many()
    image = image_of(truth)
    scale = 3000 / image.max() / float(gs.Camera().gain)  # what the camera makes of an intensity of 1, counts
    found = find(capture_of(truth))
    score = gs.localization(found, truth)
    assert score.f1 == 1
    assert score.lateral_rmse < LATERAL and score.axial_rmse < AXIAL
    # Of all that a point sends out, a lens on its axis has the solid angle of its aperture.
    imager, _ = small()
    distance = truth[score.pairs[:, 1], 2] + 1 / 1.43
    share = float(np.mean(clear_area(imager.array))) / (4 * np.pi * distance**2)
    ratio = found[score.pairs[:, 0], 3] * share / truth[score.pairs[:, 1], 3] / scale
    # Light beyond the 7 x 7 pixels is estimated by rays; spots overlap in places.
    assert abs(np.median(ratio) - 1) < 0.1 and ratio.std() < 0.1
    assert (np.diff(found[:, 3]) <= 0).all()


@pytest.mark.integration
def test_offset_and_gain_of_the_camera_do_not_matter():
    capture = capture_of(many()).astype(np.float32)
    one, other = find(capture), find(3 * capture + 500)
    # Float32 sums of other numbers.
    np.testing.assert_allclose(one[:, :3], other[:, :3], atol=1e-3)
    np.testing.assert_allclose(3 * one[:, 3], other[:, 3], rtol=1e-3)


def test_an_uneven_haze_does_not_matter():
    """As bright as the spots' own light in total, and with its shot noise."""
    truth = many()
    image = image_of(truth)
    row, column = np.mgrid[: image.shape[0], : image.shape[1]]
    haze = np.exp(-((row - 300) ** 2 + (column - 600) ** 2) / (2 * 250**2))
    hazy = image + haze * image.sum() / haze.sum()
    capture = np.asarray(gs.expose(hazy, gs.Camera(), jax.random.key(0), peak_electrons=3000))
    score = gs.localization(find(capture), truth)
    assert score.f1 == 1 and score.lateral_rmse < LATERAL and score.axial_rmse < AXIAL
    # Without haze and noise, and the same each time.
    found = find(image)
    assert gs.localization(found, truth).f1 == 1
    np.testing.assert_array_equal(found, find(image))


@pytest.mark.parametrize(
    "image",
    {
        "zeros": np.zeros((896, 960), np.float32),
        "equal": np.full((896, 960), 7, np.uint16),
        "saturated": np.full((896, 960), 65535, np.uint16),
        "read noise": np.random.default_rng(0).normal(16, 0.2, (896, 960)).astype(np.float32),
        "read noise in counts": np.random.default_rng(1).normal(16, 0.2, (896, 960)).round().astype(np.uint16),
        "few counts": np.random.default_rng(2).poisson(0.001, (896, 960)).astype(np.uint8),
        "shot noise": np.random.default_rng(3).poisson(400, (896, 960)).astype(np.uint16),
        "one bright pixel": np.pad(np.full((1, 1), 900, np.uint16), ((400, 495), (300, 659))),
        "a bright half": np.repeat([[0, 500]], 480, axis=1).repeat(896, axis=0).astype(np.uint16),
        "a slope": np.linspace(0, 1000, 896 * 960, dtype=np.float32).reshape(896, 960),
        "hot pixels": (np.random.default_rng(4).random((896, 960)) < 1e-3).astype(np.uint16) * 1000,
    }.items(),
    ids=lambda item: item[0],
)
def test_where_there_is_no_point_none_is_found(image):
    assert find(image[1]).shape == (0, 4)


@pytest.mark.parametrize(("axis", "distance"), [(0, 0.08), (1, 0.08), (2, 0.9)])
def test_two_points_close_together_are_two(axis, distance):
    """Two and a half pixels apart, axially in the outer lenses."""
    truth = np.array([[0.3, -0.2, 20.0, 1.0]] * 2)
    truth[:, axis] += distance * np.array([-0.5, 0.5])
    found = find(capture_of(truth))
    score = gs.localization(found, truth, lateral=0.03, axial=0.2)
    assert len(found) == 2 and score.recall == 1


@pytest.mark.slow
def test_a_spot_that_is_a_ring_is_one_point():
    """Two of these points are out of focus, and the rim of their spots is as bright as the middle."""
    truth, capture = point_density.scene(10, 0, gs.geomscope(), gs.Progress())
    imager = gs.geomscope().imager()
    found = gs.find_points(
        capture, imager, gs.Grid.over(imager.sensor, depths=[17.0, 23.0], pitch=0.03), progress=gs.Progress()
    )
    assert len(found) == 10 and gs.localization(found, truth).f1 == 1


def test_what_is_beside_a_wide_spot_is_no_point():
    """A bright point nearer than all others, in water: spherical aberration widens its spots, theirs are sharp."""
    design = gs.geomscope()
    centers = np.array(design.array.centers_mm)
    centers = centers[np.argsort(np.abs(centers).max(1), kind="stable")[:16]]
    side = 2 * np.abs(centers).max() + 1.2
    water = {"refractive_index": 1.333, "surface_mm": 16.5}
    small = design.replace(centers_mm=centers, size_mm=(side, side), shape=(1200, 1200), sample=water)
    imager = small.imager()
    truth = np.array(
        [[0.165, -0.275, 17.4, 5.0], [-0.55, -0.58, 20.5, 5.0], [0.38, 0.5, 21.0, 4.0], [0.13, 0.275, 21.5, 3.0]]
    )
    image = gs.simulate(truth, imager, optics="near", psf="geometric")
    capture = np.asarray(gs.expose(image, gs.Camera(), jax.random.key(0), peak_electrons=10_000))
    found = gs.find_points(capture, imager, gs.Grid([17.0, 22.0], (101, 101), 0.03))
    # The images are centred on chief rays, not on the cores that are searched for: 0.3 mm.
    assert len(found) == len(truth) and gs.localization(found, truth).f1 == 1


@pytest.mark.integration
def test_what_only_half_of_the_lenses_see_is_a_ghost():
    """Spots of the left lenses of one point and of the right lenses of another: one half of each is taken away."""
    imager, grid = small()
    points = np.array([[-0.5, 0.0, 20.0, 1.0], [0.5, 0.4, 20.0, 1.0]])
    left = np.asarray(imager.centers)[:, 0] < points[:, :1]
    image = np.zeros(imager.sensor.shape, np.float32)
    for point, mask in zip(points, left, strict=True):
        half = eqx.tree_at(lambda i: i.array.centers, imager, imager.array.centers[mask])
        image += simulate_points(point[None], half, kind="geometric", progress=gs.Progress())
    capture = np.asarray(gs.expose(image, gs.Camera(), jax.random.key(0), peak_electrons=3000))
    assert len(find(capture)) == 0
    volume = gs.backproject(capture.astype(np.float32), imager, grid)
    assert len(find_clusters(volume, grid, noise_floor=0)) >= 2


@pytest.mark.integration
def test_points_of_two_foci():
    """All of the light and noise; one type is in focus at 20 mm, the other at 27 mm, about 23 mm both are read."""
    design = gs.geomscope()
    centers = np.array(design.array.centers_mm)
    centers = centers[np.argsort(np.abs(centers).max(1), kind="stable")[:32]]
    side = 2 * np.abs(centers).max() + 1.2
    radii = np.array([2.03, 2.18])[interleave(centers, 2)]
    small = design.replace(centers_mm=centers, size_mm=(side, side), shape=(1250, 1250), pixel_pitch_um=9.0)
    imager = small.replace(radius_of_curvature_mm=radii).imager()
    truth = random_points(20, (2.4, 2.4), (18.5, 29.5), seed=0)
    # Cores are traced once for each depth.
    truth[:, 2] = np.linspace(18.8, 29.3, 7)[np.arange(20) % 7]
    image = gs.simulate(truth, imager)
    capture = np.asarray(gs.expose(image, gs.Camera(), jax.random.key(0), peak_electrons=2e4))
    found = gs.find_points(capture, imager, gs.Grid.over(imager.sensor, depths=[18.0, 30.0], pitch=0.1))
    score = gs.localization(found, truth, lateral=0.045, axial=0.43)
    assert score.f1 >= 0.95
    # A third of a pixel in the object, and what moves a spot of the outer lenses by as much.
    assert score.lateral_rmse < 0.012 and score.axial_rmse < 0.1


def test_two_lenses_may_be_blocked():
    truth = np.array([[0.1, 0.2, 20.1, 1.0]])
    imager, _ = small()
    capture = capture_of(truth)
    distance = np.hypot(*(np.asarray(imager.centers) - truth[0, :2]).T)
    pixels = np.asarray(imager.sensor.to_pixels(imager.project(truth[:, :3])))[:, 0]
    assert (distance < imager.field_radius).sum() >= 7
    for lens in np.argsort(distance)[:2]:
        row, column = pixels[lens].astype(int)
        capture[row - 40 : row + 40, column - 40 : column + 40] = 16
    score = gs.localization(find(capture), truth)
    assert score.f1 == 1 and score.lateral_rmse < LATERAL


@pytest.mark.integration
def test_the_voxels_do_not_matter_and_the_box_does():
    capture, truth = capture_of(many()), many()
    _, grid = small()
    fine = find(capture)
    np.testing.assert_array_equal(fine, find(capture, grid.at(grid.depths[::-1])))
    coarse = find(capture, gs.Grid([19.0, 21.0], (45, 45), 0.12))
    assert gs.localization(coarse, fine, lateral=0.01, axial=0.05).f1 == 1
    half = find(capture, gs.Grid(grid.depths, (91, 181), 0.03))
    assert gs.localization(half, truth[np.abs(truth[:, 1]) < 1.365]).f1 == 1
    deep = find(capture, gs.Grid([20.0, 21.0], grid.shape, grid.pitch))
    assert gs.localization(deep, fine[fine[:, 2] > 20.1], axial=0.1).recall == 1
    assert (deep[:, 2] > 19.8).all()
    plane = np.array([[0.5, 0.5, 20.0, 1.0], [-0.5, 0.0, 20.0, 1.0]])
    assert gs.localization(find(capture_of(plane), gs.Grid([20.0], grid.shape, grid.pitch)), plane).f1 == 1


def test_without_a_lens_in_reach_nothing_is_found():
    imager, grid = small()
    far = gs.Imager(gs.MicrolensArray([[50.0, 0.0], [51.0, 0.0], [50.0, 1.0]]), imager.sensor, 5.75, 2.0)
    assert len(gs.find_points(capture_of(many()), far, grid, progress=gs.Progress())) == 0


def test_a_wrong_image_is_named():
    with pytest.raises(ValueError, match=r"sensor's shape \(896, 960\), got \(4, 5\)"):
        find(np.zeros((4, 5)))
    spoilt = np.ones((896, 960))
    spoilt[:2, 0] = np.nan, np.inf
    for search in (find, lambda image: detection_stats(np.array([[0.0, 0.0, 20.0, 1.0]]), image, *small())):
        with pytest.raises(gs.InputError, match="image must be finite, got 2 of 860160 pixels NaN"):
            search(spoilt)
    with pytest.raises(gs.InputError, match="image must be real, got complex numbers"):
        find(np.ones((896, 960), complex))
    with pytest.raises(gs.InputError, match="imager must be an Imager, as .*, got <class"):
        inspect.unwrap(gs.find_points)(spoilt, gs.Imager, small()[1])


# Ray-traced captures: the independent check.


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["a", "b", "c", "d", "i_18_px", "i_20_c", "i_22_my"])
def test_ray_traced_points_are_found_and_nothing_else(scene):
    """Uncalibrated: 3 um laterally, and 3 um axially for the 120 points, 20 um for others."""
    needs("geomscope/centers.csv")
    data = needs("oracle/dev/P1.toml").parent
    truth = np.array(json.loads((data / f"{scene}.json").read_text())["points_x_y_z_flux"])
    imager = gs.read_design(data / "P1.toml").imager()
    grid = gs.Grid.over(imager.sensor, depths=np.arange(17, 23.01, 0.25), pitch=0.03)
    capture = tifffile.imread(data / f"P1_{scene}.tif")
    found = gs.find_points(capture, imager, grid, progress=gs.Progress())
    score = gs.localization(found, truth)
    assert score.f1 == 1
    assert score.lateral_rmse <= 0.003 and score.axial_rmse <= (0.003 if scene == "d" else 0.02)


def test_scores_of_several_captures_are_those_of_all_their_points():
    truth = [many(), many()[:10]]
    found = [many()[:12], many()[5:10]]
    both = point_density.scores(list(zip(found, truth, strict=True)))
    assert both["precision"] == 1 and both["recall"] == 17 / (len(truth[0]) + 10) and both["lateral_rmse_um"] == 0


@pytest.mark.integration
def test_no_point_is_found_where_none_is_among_beads_of_many_intensities():
    """Two draws of 20 beads in each medium: in water one profile of all spots left four points beside beads."""
    for row in point_density.draws(gs.geomscope(), 2, (20,), progress=gs.Progress()):
        assert row["false"] == 0 and row["recall"] >= 0.95
        assert row["lateral_rmse_um"] <= 5 and row["axial_rmse_um"] <= 60


@pytest.mark.slow
def test_a_hundred_simulated_points_are_found():
    (row,) = point_density.run(gs.geomscope(), {100: 1}, progress=gs.Progress())
    assert row["gs_jax"]["f1"] >= 0.95
    assert row["gs_jax"]["lateral_rmse_um"] <= 15 and row["gs_jax"]["axial_rmse_um"] <= 120


def light_of(imager: gs.Imager, points: np.ndarray) -> DetectionImage:
    """Spots as the tables have them, in the middle of their pixels or between, without noise."""
    (tables,) = spot_fit.spot_tables((imager,), 18.0, 22.0)
    lens_type = lens_types_of(imager, np.array([18.0, 22.0]))[0]
    light = np.zeros(imager.sensor.shape, np.float32)
    views = spot_fit._find_views(points[:, :3], lens_type, tables, light.shape)
    np.add.at(light, views.pixels, (points[views.point, 3, None] * views.spot[0]).astype(np.float32))
    return DetectionImage(light, np.full_like(light, 1e-9))


def test_spots_are_fitted_on_an_axis_and_kept_at_the_rim():
    """A point on a lens's axis has its position and light; one whose spots are all at the rim keeps what it has."""
    imager, _ = small()
    center = np.asarray(imager.array.centers[24], np.float64)
    truth = np.array([[*center, 20.0, 5.0]])
    image, types = light_of(imager, truth), lens_types_of(imager, np.array([18.0, 22.0]))
    beside = truth[:, :3] + [0.01, -0.01, 0.1]
    fit = spot_fit.fit_points(beside, np.array([image.light.max()]), image, types)
    np.testing.assert_allclose(fit.positions, truth[:, :3], atol=2e-3)
    np.testing.assert_allclose(fit.intensities, truth[:, 3], rtol=0.02)
    away = np.array([[60.0, 60.0, 20.0]])
    fit = spot_fit.fit_points(away, np.array([1.0]), image, types)
    assert (fit.positions == away).all() and fit.intensities > 0


@pytest.mark.parametrize("depths", [(8.0, 32.0), (17.0, 23.0)])
def test_tables_of_spots_are_close_enough_together(depths):
    """Between two of them the light in the middle pixel is that of a table traced there."""
    imager = gs.geomscope().imager()
    (tables,) = spot_fit.spot_tables((imager,), *depths)
    between = tables.depths[:-1] + np.diff(tables.depths) / 2
    between = between[np.abs(between - 20).argsort()[:2]]
    for z in between:
        (here,) = spot_fit.spot_tables((imager,), z - 0.01, z + 0.01)
        np.testing.assert_allclose(tables.height_at(z), here.height_at(z), rtol=0.06)
