"""Readings against `Imager.project`, statistics against SciPy and against chance itself."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.stats import binom

from gs_jax.detection.consistency import (
    Readings,
    Signal,
    agreed_level,
    log_false_alarms,
    readings,
    signal,
    spot_profile,
    survival,
    without_spots,
)

from .helpers import scene


@pytest.mark.parametrize("orientation, tilt", [("curved", None), ("plano", (0.02, -0.01)), ("curved", (0.02, -0.01))])
def test_points_are_read_where_the_imager_has_them(orientation, tilt):
    flat = scene()[0]
    array = dataclasses.replace(flat.array, orientation=orientation)
    imager = dataclasses.replace(flat, array=array, tilt=tilt)
    points = np.array([[0.05, -0.1, 18.0], [-0.2, 0.12, 23.0]])
    light = np.zeros(imager.sensor.shape, np.float32)
    found = readings(points, Signal(light, light), imager)
    places = np.asarray(imager.sensor.to_pixels(imager.project(points)))
    for number, seen in enumerate(found.seen):
        read = found.pixels[number, seen]
        assert len(read) > 1
        nearest = np.linalg.norm(read[:, None] - places[None, :, number], axis=-1).min(1)
        np.testing.assert_allclose(nearest, 0, atol=1e-9)


def test_a_slope_is_background_and_a_spot_is_light():
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:256, :320]
    image = 100 + 0.2 * row + 0.1 * column + rng.normal(0, 2, row.shape)
    image[128, 160] += 1000
    found = signal(image)
    # The middle of a Gaussian of 0.7 pixels, sampled: a delta through the same filter.
    delta = np.zeros((9, 9))
    delta[4, 4] = 1000
    assert found.light[128, 160] == pytest.approx(gaussian_filter(delta, 0.7).max(), abs=5)
    # The median of 340 pixels on a slope of 7 a square, each of noise 0.9: two standard deviations are 0.3.
    inner = found.light[32:-32, 32:-32]
    assert abs(np.median(inner)) < 0.3


def test_the_noise_is_what_is_left_of_it_after_smoothing():
    noise = np.random.default_rng(0).normal(0, 2, (640, 640))
    # One square has 340 neighbouring, hence related, pixels: 10 %; their mean is much better.
    assert signal(50 + noise).noise.mean() == pytest.approx(gaussian_filter(noise, 0.7).std(), rel=0.03)


@pytest.mark.parametrize("value", [0, 7, 65535])
def test_a_flat_image_has_neither_light_nor_noise(value):
    found = signal(np.full((50, 70), value, np.uint16))
    assert not found.light.any() and not found.noise.any()


def test_spots_do_not_add_to_the_noise():
    rng = np.random.default_rng(1)
    image = rng.normal(0, 1, (320, 320))
    bright = image.copy()
    bright[rng.integers(0, 320, 400), rng.integers(0, 320, 400)] += 30
    # 4 pixels of 1024 in a square are spots, some of 20 smoothed pixels each: they move the median a little.
    assert signal(bright).noise.mean() == pytest.approx(signal(image).noise.mean(), rel=0.1)


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_readings_are_the_image_where_the_lenses_project_to(dtype):
    imager, _ = scene(dtype)
    image = np.random.default_rng(0).random(imager.sensor.shape)
    found_signal = signal(image)
    points = np.array([[0.1, -0.2, 20.0], [-0.6, 0.5, 18.0], [30.0, 0.0, 20.0]])
    found = readings(points, found_signal, imager)
    pixels = np.asarray(imager.sensor.to_pixels(imager.project(jnp.asarray(points, dtype))))
    centers = np.asarray(imager.centers)
    # Coordinates in float32 are rounded to 1e-5 pixels here.
    tolerance = 1e-10 if dtype == jnp.float64 else 1e-4
    for number, point in enumerate(points):
        distance = np.hypot(*(centers - point[:2]).T)
        place = pixels[:, number]
        on_sensor = ((place >= 0) & (place <= np.array(image.shape) - 1)).all(1)
        lenses = np.flatnonzero((distance < imager.field_radius) & on_sensor)
        lenses = lenses[np.argsort(distance[lenses])]
        seen = found.seen[number]
        assert seen.sum() == len(lenses)
        np.testing.assert_allclose(found.pixels[number, seen], place[lenses], atol=tolerance)
        expected = map_coordinates(found_signal.light, place[lenses].T, np.float64, order=1)
        np.testing.assert_allclose(found.light[number, seen], expected, atol=tolerance)
        np.testing.assert_allclose(found.field[number, seen], distance[lenses], atol=tolerance)
        for part in found[1:4]:
            assert not part[number, ~seen].any()
    assert not found.seen[2].any()


def test_readings_of_no_points():
    imager, _ = scene()
    found = readings(np.zeros((0, 3)), signal(np.ones(imager.sensor.shape)), imager)
    assert found.light.shape == found.seen.shape and len(found.light) == 0


def test_the_agreed_level_is_what_so_many_lenses_reach():
    rng = np.random.default_rng(0)
    light, seen = rng.normal(size=(50, 12)), rng.random((50, 12)) < 0.7
    seen[0] = False
    for share in (0.3, 0.7, 1.0):
        level = agreed_level(light, seen, share)
        assert level[0] == -np.inf
        for one, mine, found in zip(light[1:], seen[1:], level[1:], strict=True):
            reached = (one[mine] >= found).sum()
            assert reached >= share * mine.sum() > reached - 1
            assert found in one[mine]


def test_seven_of_ten_is_seven():
    """0.7 x 10 is a little more than 7 in binary."""
    assert agreed_level(np.arange(10.0)[None], np.ones((1, 10), bool), 0.7)[0] == 3


def test_false_alarms_are_the_tail_of_the_binomial():
    level, count = np.array([2.0, 2.0, 5.0]), np.array([4, 10, 0])
    alarms = log_false_alarms(level, count, 0.7, lambda level: 0.1 / level, 1000)
    np.testing.assert_allclose(alarms[:2], np.log(1000 * binom.sf([2, 6], [4, 10], 0.05)), rtol=1e-12)
    assert alarms[2] == np.inf  # no lens says nothing


def test_false_alarms_are_as_frequent_as_predicted():
    """Lenses that look at random pixels: the count of places at or below an expectation of 100 is about 100."""
    rng = np.random.default_rng(0)
    light = rng.exponential(size=(1000, 1000)).astype(np.float32)
    tests, count = 200_000, np.full(200_000, 6)
    read = rng.choice(light.ravel(), (tests, 6)).astype(np.float64)
    level = agreed_level(read, np.ones(read.shape, bool), 0.5)
    alarms = (log_false_alarms(level, count, 0.5, survival(light), tests) <= np.log(100)).sum()
    assert abs(alarms - 100) < 30  # three standard deviations


def test_survival_counts_pixels():
    light = np.random.default_rng(0).normal(size=(300, 200)).astype(np.float32)
    as_bright = survival(light)
    for level in (-1.0, 0.5, 3.0):
        assert as_bright(np.array([level]))[0] == pytest.approx((light >= level).mean(), abs=1e-12)
    assert as_bright(np.array([100.0]))[0] == 1 / light.size
    levels = np.array([0.5, 3.0, 100.0])
    np.testing.assert_array_equal(survival(light, 0.5)(levels), as_bright(levels))


def test_the_profile_of_gaussian_spots_is_gaussian_even_with_neighbours():
    rng = np.random.default_rng(0)
    middles = rng.uniform(30, 370, (12, 2))
    row, column = np.mgrid[:400, :400]
    distance2 = lambda at: (row - at[0]) ** 2 + (column - at[1]) ** 2
    light = np.sum([np.exp(-distance2(at) / (2 * 3.0**2)) for at in middles], axis=0)
    light += np.exp(-distance2(middles[0] + [6, 0]) / (2 * 3.0**2))
    light = light.astype(np.float32)
    ones = np.ones((12, 1))
    spots = Readings(middles[:, None], ones, ones, ones, np.ones((12, 1), bool))
    profile = spot_profile(spots, light)
    radius = np.arange(len(profile))
    # Radii are rounded to pixels, the slope is 0.2 a pixel at most.
    np.testing.assert_allclose(profile[:12], np.exp(-(radius[:12] ** 2) / (2 * 3.0**2)), atol=0.1)
    assert profile[0] == 1 and profile[-1] == 0 and (np.diff(profile) <= 0).all()


def test_the_profile_without_spots():
    empty = np.zeros((0, 0))
    none = Readings(np.zeros((0, 0, 2)), empty, empty, empty, empty > 0)
    profile = spot_profile(none, np.zeros((10, 10), np.float32))
    assert profile[0] == 1 and not profile[1:].any()


def test_a_gaussian_spot_can_be_taken_away_wherever_it_is():
    """In the middle, near another, and half beyond the edge."""
    row, column = np.mgrid[:150, :200]
    middles = np.array([[60.3, 70.8], [64.0, 75.0], [100.2, 120.5], [75.0, 140.0], [0.0, 100.0]])
    heights = np.array([5.0, 4.0, 3.0, 2.0, 4.0])
    spots = [h * np.exp(-((row - r) ** 2 + (column - c) ** 2) / 8) for h, (r, c) in zip(heights, middles, strict=True)]
    light = np.sum(spots, axis=0).astype(np.float32)
    read = map_coordinates(light, middles.T, np.float64, order=1)[:, None]
    ones = np.ones((5, 1))
    left = without_spots(light, Readings(middles[:, None], read, ones, ones, ones > 0), heights[:, None])
    # The profile is linear between pixels, and rounded to them.
    assert np.abs(left).max() < 0.15 * light.max()
    assert left.shape == light.shape
