"""Background, view samples and detection statistics: against SciPy, NumPy, `Imager.project`, and chance itself."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.stats import binom

from gs_jax import Grid, Sensor, geomscope
from gs_jax.detection import view_samples
from gs_jax.detection.background import (
    background_tiles,
    gaussian_smooth,
    interpolate_tiles,
    mirror_indices,
    subtract_background,
)
from gs_jax.detection.view_samples import (
    ViewSamples,
    detection_stats,
    log_false_alarms,
    sample_views,
    search_grid,
    separate_points,
    spot_profile,
    survival_function,
    view_quantile,
)
from gs_jax.optics.psf_core import MIN_SHARPNESS, sharpness
from gs_jax.optics.raytrace import to_numpy

from .helpers import scene
from .test_point_finder import capture_of, find, many, small

# One pixel beside a whole tile, less than one, and as small as sensors are.
SHAPES = pytest.mark.parametrize("shape", [(97, 160), (64, 33), (31, 20), (2, 5), (5, 2)])


def image_of(shape, dtype=np.float32):
    return np.random.default_rng(0).gamma(2, 100, shape).astype(dtype)


@SHAPES
@pytest.mark.parametrize("deviation", [0.7, 2.0])
def test_smoothing_is_a_gaussian_mirrored_at_the_edges(shape, deviation):
    image = image_of(shape)
    np.testing.assert_allclose(gaussian_smooth(image, deviation), gaussian_filter(image, deviation), rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int64, np.float64])
def test_images_of_any_type_are_smoothed_as_floats(dtype):
    image = image_of((70, 50), dtype)
    smooth = gaussian_smooth(image, 0.7)
    assert smooth.dtype == np.float32
    np.testing.assert_allclose(smooth, gaussian_smooth(image.astype(np.float32), 0.7), rtol=1e-6)
    np.testing.assert_array_equal(gaussian_smooth(np.asfortranarray(image), 0.7), smooth)


@SHAPES
def test_tiles_have_the_median_and_the_deviation_of_darker_pixels(shape):
    image = image_of(shape)
    median, noise = background_tiles(image)
    rows, columns = (-(-n // 32) for n in shape)
    assert median.shape == noise.shape == (rows, columns)
    padded = np.pad(image, ((0, 32 * rows - shape[0]), (0, 32 * columns - shape[1])), mode="edge")
    for row, column in np.ndindex(rows, columns):
        pixels = padded[32 * row : 32 * row + 32, 32 * column : 32 * column + 32].ravel()[::3]
        middle = np.median(pixels)
        assert median[row, column] == middle
        assert noise[row, column] == pytest.approx(np.sqrt(2 * np.mean(np.minimum(pixels - middle, 0) ** 2)), rel=1e-5)


@SHAPES
def test_tiles_are_interpolated_linearly(shape):
    rows, columns = (-(-n // 32) for n in shape)
    tiles = image_of((rows, columns))
    expected = jax.image.resize(tiles, (32 * rows, 32 * columns), "linear")[: shape[0], : shape[1]]
    np.testing.assert_allclose(interpolate_tiles(tiles, shape), expected, rtol=1e-6)


def test_indices_are_mirrored_as_often_as_it_takes():
    wide = np.pad(np.arange(3), 8, mode="symmetric")
    np.testing.assert_array_equal(mirror_indices(np.arange(-8, 11), 3), wide)


def test_a_slope_is_background_and_a_spot_is_light():
    row, column = np.mgrid[:256, :320]
    image = 100 + 0.2 * row + 0.1 * column + np.random.default_rng(0).normal(0, 2, row.shape)
    image[128, 160] += 1000
    light = subtract_background(image).light
    # The middle of a Gaussian of 0.7 pixels, sampled: a delta through the same filter.
    delta = np.zeros((9, 9))
    delta[4, 4] = 1000
    assert light[128, 160] == pytest.approx(gaussian_filter(delta, 0.7).max(), abs=5)
    # The median of 340 pixels on a slope of 7 a tile, each of noise 0.9: two standard deviations are 0.3.
    assert abs(np.median(light[32:-32, 32:-32])) < 0.3


def test_noise_is_measured_after_smoothing_and_without_spots():
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 2, (640, 640))
    # One tile has 340 neighbouring, hence related, pixels: 10 %; their mean is much better.
    measured = subtract_background(50 + noise).noise.mean()
    assert measured == pytest.approx(gaussian_filter(noise, 0.7).std(), rel=0.03)
    noise[rng.integers(0, 640, 1600), rng.integers(0, 640, 1600)] += 60
    # 4 pixels of 1024 in a tile are spots, some of 20 smoothed pixels each: they move the median a little.
    assert subtract_background(50 + noise).noise.mean() == pytest.approx(measured, rel=0.1)


@pytest.mark.parametrize("value", [0, 7, 65535])
def test_a_flat_image_has_neither_light_nor_noise(value):
    flat = subtract_background(np.full((50, 70), value, np.uint16))
    assert not flat.light.any() and not flat.noise.any()


# Coordinates in float32 are rounded to 1e-5 pixels here.
@pytest.mark.parametrize("dtype, tolerance", [(jnp.float64, 1e-9), (jnp.float32, 1e-4)])
@pytest.mark.parametrize("orientation, tilt", [(o, t) for o in ("plano", "curved") for t in (None, (0.02, -0.01))])
def test_samples_are_those_of_all_lenses_in_reach(dtype, tolerance, orientation, tilt):
    imager, _ = scene(dtype)
    array = dataclasses.replace(imager.array, orientation=orientation)
    imager = dataclasses.replace(imager, array=array, tilt=None if tilt is None else jnp.asarray(tilt, dtype))
    image = subtract_background(np.random.default_rng(0).random(imager.sensor.shape))
    points = np.array([[0.1, -0.2, 20.0], [-0.6, 0.5, 18.0], [30.0, 0.0, 20.0]])
    samples, host = sample_views(points, image, imager), to_numpy(imager)
    views = host.views_of_all(points)
    for number, seen in enumerate(samples.seen):
        distance = np.linalg.norm(views.offset[:, number], axis=-1)
        pixels = host.sensor.to_pixels(views.spot[:, number])
        on_sensor = ((pixels >= 0) & (pixels <= np.array(imager.sensor.shape) - 1)).all(1)
        lenses = np.flatnonzero((distance < imager.field_radius) & on_sensor)
        lenses = lenses[np.argsort(distance[lenses])]
        assert seen.sum() == len(lenses) and (len(lenses) > 1 or number > 0)
        np.testing.assert_allclose(samples.pixels[number, seen], pixels[lenses], atol=tolerance)
        expected = map_coordinates(image.light, pixels[lenses].T, np.float64, order=1)
        np.testing.assert_allclose(samples.light[number, seen], expected, atol=tolerance)
        np.testing.assert_allclose(samples.field[number, seen], distance[lenses], atol=tolerance)
        assert not any(part[number, ~seen].any() for part in samples[1:4])
    assert not samples.seen[2].any()
    none = sample_views(np.zeros((0, 3)), image, imager)
    assert none.light.shape == none.seen.shape and len(none.light) == 0


def test_the_quantile_is_what_so_many_views_reach():
    rng = np.random.default_rng(0)
    light, seen = rng.normal(size=(50, 12)), rng.random((50, 12)) < 0.7
    seen[0] = False
    for share in (0.3, 0.7, 1.0):
        level = view_quantile(light, seen, share)
        assert level[0] == -np.inf
        for one, mine, quantile in zip(light[1:], seen[1:], level[1:], strict=True):
            reached = (one[mine] >= quantile).sum()
            assert reached >= share * mine.sum() > reached - 1 and quantile in one[mine]
    # 0.7 x 10 is a little more than 7 in binary.
    assert view_quantile(np.arange(10.0)[None], np.ones((1, 10), bool), 0.7)[0] == 3


def test_false_alarms_are_the_tail_of_the_binomial():
    level, count = np.array([2.0, 2.0, 5.0]), np.array([4, 10, 0])
    alarms = log_false_alarms(level, count, lambda level: 0.1 / level, 1000, 0.7)
    np.testing.assert_allclose(alarms[:2], np.log(1000 * binom.sf([2, 6], [4, 10], 0.05)), rtol=1e-12)
    assert alarms[2] == np.inf  # no lens, no evidence


def test_false_alarms_are_as_frequent_as_predicted():
    """Lenses that look at random pixels: about 100 positions are at or below an expectation of 100."""
    rng = np.random.default_rng(0)
    light = rng.exponential(size=(1000, 1000)).astype(np.float32)
    tests, count = 200_000, np.full(200_000, 6)
    views = rng.choice(light.ravel(), (tests, 6)).astype(np.float64)
    level = view_quantile(views, np.ones(views.shape, bool), 0.5)
    alarms = (log_false_alarms(level, count, survival_function(light), tests, 0.5) <= np.log(100)).sum()
    assert abs(alarms - 100) < 30  # three standard deviations


def test_the_survival_function_counts_pixels():
    light = np.random.default_rng(0).normal(size=(300, 200)).astype(np.float32)
    survival, levels = survival_function(light), np.array([-1.0, 0.5, 3.0, 100.0])
    expected = [max((light >= level).mean(), 1 / light.size) for level in levels]
    np.testing.assert_allclose(survival(levels), expected, atol=1e-12)
    np.testing.assert_array_equal(survival_function(light, 0.5)(levels[1:]), survival(levels[1:]))


def test_the_profile_of_gaussian_spots_is_gaussian_even_with_neighbours():
    middles = np.random.default_rng(0).uniform(30, 370, (12, 2))
    row, column = np.mgrid[:400, :400]
    gaussian = lambda at: np.exp(-((row - at[0]) ** 2 + (column - at[1]) ** 2) / (2 * 3.0**2))
    light = np.sum([gaussian(at) for at in (*middles, middles[0] + [6, 0])], axis=0).astype(np.float32)
    profile = spot_profile(middles, np.ones(12), light)
    radius = np.arange(12)
    # Radii are rounded to pixels, the slope is 0.2 a pixel at most.
    np.testing.assert_allclose(profile[:12], np.exp(-(radius**2) / (2 * 3.0**2)), atol=0.1)
    assert profile[0] == 1 and profile[-1] == 0 and (np.diff(profile) <= 0).all()
    none = spot_profile(np.zeros((0, 2)), np.zeros(0), light)
    assert none[0] == 1 and not none[1:].any()


def test_gaussian_spots_are_separated_wherever_they_are():
    """In the middle, near another, wider than others, and half beyond the edge."""
    row, column = np.mgrid[:150, :200]
    middles = np.array([[60.3, 70.8], [64.0, 75.0], [100.2, 120.5], [75.0, 150.0], [0.0, 100.0]])
    heights, widths = np.array([5.0, 4.0, 3.0, 2.0, 4.0]), np.array([2.0, 2.0, 2.0, 6.0, 2.0])
    shapes = zip(heights, widths, middles, strict=True)
    spots = [h * np.exp(-((row - r) ** 2 + (column - c) ** 2) / (2 * w**2)) for h, w, (r, c) in shapes]
    light = np.sum(spots, axis=0).astype(np.float32)
    views, ones = map_coordinates(light, middles.T, np.float64, order=1)[:, None], np.ones((5, 1))
    own = separate_points(ViewSamples(middles[:, None], views, ones, ones, ones > 0), light)
    # The profile is linear between pixels, and rounded to them.
    assert own.taken.all() and own.rest.shape == light.shape and np.abs(own.rest).max() < 0.15 * light.max()
    np.testing.assert_allclose(own.light[:, 0], heights, rtol=0.15)


def test_a_flat_spot_is_subtracted_wherever_its_middle_is_taken_to_be():
    """Blurred discs of 4 pixels, sampled 2 pixels beside their middles by all lenses."""
    row, column = np.mgrid[:100, :100]
    middles = np.array([[30.3, 30.8], [30.0, 70.0], [70.2, 30.5], [70.0, 69.5]])
    discs = [np.hypot(row - r, column - c) < 4 for r, c in middles]
    light, ones = gaussian_filter(np.sum(discs, axis=0).astype(np.float32), 0.7), np.ones((1, 4))
    own = separate_points(ViewSamples(middles[None] + [1.4, -1.4], ones, ones, ones, ones > 0), light)
    # Radii are rounded to pixels where the rim's slope is a third in a pixel.
    assert np.abs(own.rest).max() < 0.5 and own.light.tolist() == [[1, 1, 1, 1]]


def test_sharpness_separates_the_design_in_focus_from_the_printed_one():
    """By our tracer's cores: a fifth to a half of the light, and a hundredth."""
    depths = Grid([18.0, 22.0], (3, 3), 1.0)
    assert 0.15 < sharpness(geomscope(sensor_distance_mm=5.8).imager(), depths) < 0.5
    assert sharpness(geomscope(sensor_distance_mm=4.0).imager(), depths) < 0.02 < MIN_SHARPNESS


def test_hypotheses_are_counted_where_cores_are_searched_for(monkeypatch):
    """As many as `find_points` tests; and a background is not subtracted twice."""
    imager = dataclasses.replace(geomscope().imager(), sensor=Sensor((64, 64), 0.05))
    grid, count, counted = Grid([18.0, 22.0], (5, 5), 0.04), view_samples.num_hypotheses, []
    monkeypatch.setattr(view_samples, "num_hypotheses", lambda voxels: counted.append(voxels) or count(voxels))
    monkeypatch.setattr(view_samples, "subtract_background", None)
    image = subtract_background(np.random.default_rng(0).normal(size=(64, 64)))
    detection_stats(np.array([[0.1, 0.2, 20.0, 1.0]]), image, imager, grid)
    (voxels,) = counted
    np.testing.assert_allclose(voxels.depths, search_grid(imager, grid).depths, rtol=1e-6)


@pytest.mark.integration
def test_statistics_of_points_that_are_there():
    imager, grid = small()
    image = capture_of(many())
    points = find(image)
    stats = detection_stats(points, image, imager, grid)
    assert all(len(part) == len(points) for part in stats) and len(points)
    assert (stats.lit >= 0.7 * stats.lenses).all() and (stats.lenses >= 3).all()
    assert (stats.log10_false_alarms <= -1).all() and (stats.signal_to_noise > 5).all()
    nowhere = detection_stats(points + np.array([0.31, 0.27, 0.4, 0.0]), image, imager, grid)
    assert np.median(nowhere.log10_false_alarms) > -1 and np.median(nowhere.signal_to_noise) < 5
    # Files hold no infinity.
    assert stats.log10_false_alarms.min() >= -999
    assert all(len(part) == 0 for part in detection_stats(np.zeros((0, 4)), image, imager, grid))
