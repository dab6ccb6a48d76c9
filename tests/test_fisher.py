from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.special import erf

from gs_jax import Imager, MicrolensArray, Sensor
from gs_jax.codesign.fisher import PRIOR, cramer_rao, fisher_information, localization_bound, mean_images, windows
from gs_jax.geometry import envelope
from gs_jax.layouts import poisson_disc_layout
from gs_jax.optics.psf import diffraction_psf
from gs_jax.simulation.synthetic import poisson

POINT = np.array([0.05, -0.03, 20.0])
OPTIONS: dict[str, Any] = dict(photons=800.0, spot=0.009, background=3.0, read_noise=2.0, size=15)
STEPS = np.diag([1e-5, 1e-5, 1e-4])


def imager(centers, pixel=0.005, pixels=600):
    return Imager(MicrolensArray(centers), Sensor((pixels, pixels), pixel), 5.8, 1.5)


def random_imager():
    return imager(np.random.default_rng(0).uniform(-0.9, 0.9, (9, 2)))


def with_centers(base, centers):
    return Imager(MicrolensArray(centers), base.sensor, base.sensor_distance, base.field_radius)


def geometry(point, centers):
    reduced = point[2] + 1 / 1.43
    places = centers + (centers - point[:2]) * 5.8 / reduced
    return places, np.asarray(envelope(((centers - point[:2]) ** 2).sum(1), reduced, 1.5))


def test_fine_pixels_and_no_noise_but_the_lights():
    """Closed form: each lens tells its place to `deviation / sqrt(N)`, and the brightness by `N`."""
    centers, deviation = np.array([[0.4, 0.1], [-0.5, 0.3], [0.1, -0.6]]), 0.02
    microscope = imager(centers, pixel=0.004, pixels=900)
    found = fisher_information(POINT, microscope, photons=1000.0, spot=deviation, read_noise=0.0, size=51)
    slopes = [(np.subtract(*pair)) / 2e-4 for pair in _pairs(lambda p: geometry(p, centers)[0])]
    log_slopes = [(np.subtract(*pair)) / 2e-4 for pair in _pairs(lambda p: np.log(geometry(p, centers)[1]))]
    expected, (_, weights) = np.zeros((4, 4)), geometry(POINT, centers)
    for lens in range(3):
        place = np.stack([*(s[lens] for s in slopes), np.zeros(2)])
        bright = np.array([*(s[lens] for s in log_slopes), 1])
        expected += 1000 * weights[lens] * (place @ place.T / deviation**2 + np.outer(bright, bright))
    # A pixel adds a twelfth of its square to the variance of the spot: 0.3 %.
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=0.005)


def _pairs(function):
    return [(function(POINT + step), function(POINT - step)) for step in np.eye(3) * 1e-4]


def test_it_is_the_sum_over_a_sensors_pixels():
    """A whole sensor, SciPy's error function and finite differences; no two images overlap here."""
    centers = np.array([[0.4, 0.1], [-0.5, 0.3], [0.1, -0.6]])
    microscope = imager(centers)
    borders = (np.arange(601) - 300) * 0.005

    def image(point, log_brightness=0.0):
        share = lambda at: np.diff(erf((borders - at) / (2**0.5 * 0.009))) / 2
        total = sum(w * np.outer(share(y), share(x)) for (x, y), w in zip(*geometry(point, centers), strict=True))
        return 800 * np.exp(log_brightness) * total

    slopes = [(image(POINT + s) - image(POINT - s)) / (2 * s.sum()) for s in STEPS]
    slopes = np.stack([*slopes, image(POINT)])
    expected = np.einsum("arc,brc,rc->ab", slopes, slopes, 1 / (image(POINT) + 3 + 2**2))
    # What a window of 15 pixels, 4 deviations each way, leaves out; finite differences.
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(fisher_information(POINT, microscope, **OPTIONS) / scale, expected / scale, atol=2e-4)
    bound = np.sqrt(np.diag(np.linalg.inv(expected)))[:3]
    np.testing.assert_allclose(cramer_rao(POINT[None], microscope, **OPTIONS)[0], bound, rtol=1e-3)


def test_a_given_psf():
    """A Gaussian as a PSF on pixels: cubic interpolation of a spot two pixels wide is good to a few per cent."""
    place = np.arange(15) - 7
    borders = np.append(place - 0.5, 7.5)
    share = np.diff(erf(borders / (2**0.5 * 0.009 / 0.005))) / 2
    given = OPTIONS | dict(spot=np.outer(share, share))
    expected = cramer_rao(POINT[None], random_imager(), **OPTIONS)
    np.testing.assert_allclose(cramer_rao(POINT[None], random_imager(), **given), expected, rtol=0.05)


def test_more_light_and_more_lenses_are_better():
    base = cramer_rao(POINT[None], random_imager(), **OPTIONS)
    four_fold = cramer_rao(POINT[None], random_imager(), **OPTIONS | dict(photons=4e6, read_noise=0.0, background=0.0))
    bright = cramer_rao(POINT[None], random_imager(), **OPTIONS | dict(photons=1e6, read_noise=0.0, background=0.0))
    np.testing.assert_allclose(bright / four_fold, 2, rtol=1e-6)
    # Three of nine lenses see nothing, so that the program is the same.
    centers = np.where(np.arange(9)[:, None] < 6, np.asarray(random_imager().array.centers), 50.0)
    fewer = with_centers(random_imager(), centers)
    assert (cramer_rao(POINT[None], fewer, **OPTIONS) > base).all()


def test_off_the_sensor_and_out_of_sight():
    """Images that miss the sensor say nothing; then only the prior is left."""
    small = Imager(MicrolensArray([[1.2, 0.0], [0.0, 1.2]]), Sensor((60, 60), 0.005), 5.8, 1.5)
    np.testing.assert_allclose(cramer_rao(POINT[None], small, **OPTIONS), 10, rtol=1e-9)
    far = np.array([[50.0, 0.0, 20.0]])
    np.testing.assert_allclose(cramer_rao(far, random_imager(), **OPTIONS), 10, rtol=1e-9)


@pytest.mark.integration
@pytest.mark.parametrize("noise", [0.0, 2.0])
@pytest.mark.parametrize("place", [0.1, 40.0], ids=["coincident", "out of sight"])
def test_gradients_are_finite(place, noise):
    options = OPTIONS | dict(background=0.0, read_noise=noise)
    total = lambda c: localization_bound(with_centers(random_imager(), c), POINT[None], **options).sum()
    assert jnp.isfinite(jax.grad(total)(jnp.full((4, 2), place))).all()


@pytest.mark.slow
def test_gradients():
    base, points = random_imager(), np.stack([POINT, POINT + 0.1])

    def bound(centers, distance, deviation):
        microscope = Imager(MicrolensArray(centers), base.sensor, distance, base.field_radius)
        return jnp.log(localization_bound(microscope, points, **OPTIONS | dict(spot=deviation * 1e-3)))

    arguments = (base.array.centers, base.sensor_distance, jnp.array(9.0))
    check_grads(bound, arguments, order=1, modes=("fwd", "rev"), eps=1e-6, atol=1e-5, rtol=1e-5)


@pytest.mark.slow
def test_a_psf_that_follows_from_the_imager_has_a_gradient():
    def bound(distance):
        base = random_imager()
        microscope = Imager(base.array, base.sensor, distance, base.field_radius)
        spot = diffraction_psf(microscope, 20.0, size=15, radius=0.3)
        return jnp.log(localization_bound(microscope, POINT[None], **OPTIONS | dict(spot=spot)))

    check_grads(jax.jit(bound), (jnp.array(5.8),), order=1, eps=1e-6, atol=1e-4, rtol=1e-4)


def test_float32():
    low = jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf, np.float32)), random_imager())
    found = cramer_rao(POINT[None].astype(np.float32), low, **OPTIONS)
    assert found.dtype == jnp.float32
    # The inverse of a matrix of condition 1e2 to 1e3, once its diagonal is 1.
    np.testing.assert_allclose(found, cramer_rao(POINT[None], random_imager(), **OPTIONS), rtol=1e-2)


@pytest.mark.parametrize(
    ("options", "words"),
    [(dict(size=4), "odd and positive, got 4"), (dict(spot=np.ones((3, 5))), r"of shape \(15, 15\), got \(3, 5\)")],
)
def test_wrong_arguments_are_named(options, words):
    with pytest.raises(ValueError, match=words):
        fisher_information(POINT, random_imager(), **OPTIONS | options)


@partial(jax.jit, static_argnames="draws")
def errors_of_maximum_likelihood(scope, key, *, draws, size=15, spot=0.008, background=5.0, read_noise=2.0):
    """Errors in x, y, z of Fisher scoring on noisy images of a point at a random subpixel position, and the bounds."""
    options: dict[str, Any] = dict(photons=jnp.array(300.0), spot=spot, size=size)

    def draw(key):
        place, light, read, start = jax.random.split(key, 4)
        pixel = scope.sensor.pixel_pitch / scope.magnification(20.0)
        lateral = pixel * jax.random.uniform(place, (2,), minval=-0.5, maxval=0.5)
        truth = jnp.concatenate([lateral, jnp.array([20.0, 0.0])])
        corners, on_sensor = windows(truth[:3], scope, size)
        images = lambda p: mean_images(p, scope, corners=corners, **options) + background
        data = poisson(light, images(truth)) + read_noise * jax.random.normal(read, on_sensor.shape)

        def scoring(p, _):
            mean, slopes = images(p), jax.jacfwd(images)(p)
            weight = on_sensor / (mean + read_noise**2)
            information = jnp.einsum("lrci,lrcj,lrc->ij", slopes, slopes, weight) + jnp.diag(jnp.array(PRIOR) ** -2)
            score = jnp.einsum("lrci,lrc->i", slopes, weight * (data - mean))
            unit = jnp.diag(information) ** -0.5
            step = unit * jnp.linalg.solve(unit[:, None] * information * unit[None], unit * score)
            return p + jnp.clip(step, -0.1, 0.1), None

        # Starts within a pixel and some depth of the truth: global search is not tested here.
        near = truth + jnp.array([pixel, pixel, 0.05, 0.2]) * jax.random.normal(start, (4,)) / 2
        estimate, _ = jax.lax.scan(scoring, near, length=12)
        bound = cramer_rao(truth[None, :3], scope, background=background, read_noise=read_noise, **options)[0]
        return (estimate - truth)[:3], bound

    return jax.lax.map(draw, jax.random.split(key, draws), batch_size=50)


@pytest.mark.slow
def test_maximum_likelihood_reaches_the_bound():
    centers = poisson_disc_layout((5.0, 5.0), min_distance=1.0, seed=0)
    scope = Imager(MicrolensArray(centers), Sensor((1400, 1400), 0.0045), 5.8, 2.5)
    errors, bounds = errors_of_maximum_likelihood(scope, jax.random.key(1), draws=400)
    # The standard error of a standard deviation of 400 draws is 3.5 %.
    np.testing.assert_allclose(jnp.sqrt(jnp.mean(errors**2, 0) / jnp.mean(bounds**2, 0)), 1, atol=0.12)
