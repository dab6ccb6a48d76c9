from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from gs_jax import Imager, MicrolensArray, Sensor
from gs_jax.codesign import array_psf
from gs_jax.geometry import envelope
from gs_jax.layouts import hexagonal_layout, poisson_disc_layout
from gs_jax.optics.raytrace import to_numpy

# One program each instead of one for each of their operations.
array_spectrum, crosstalk, mean_inverse_views, sidelobes = map(
    jax.jit, (array_psf.array_spectrum, array_psf.crosstalk, array_psf.mean_inverse_views, array_psf.sidelobes)
)
condition_number, spectral_flatness = map(jax.jit, (array_psf.condition_number, array_psf.spectral_flatness))
SOURCES = np.array([[0.1, -0.2, 20.0], [0.3, 0.4, 18.0]])
WIDTH = 0.02
OWN: dict[str, Any] = dict(lateral=0.1, axial=1.0)


def imager(centers, field_radius=1.5):
    return Imager(MicrolensArray(centers), Sensor((64, 64), 0.05), 5.8, field_radius)


def random_imager(seed=0):
    return imager(np.random.default_rng(seed).uniform(-1, 1, (12, 2)))


def targets(count=40):
    rng = np.random.default_rng(1)
    return np.concatenate([rng.uniform(-0.8, 0.8, (count, 2)), rng.uniform(17, 21, (count, 1))], axis=1)


def with_centers(base, centers):
    return Imager(MicrolensArray(centers), base.sensor, base.sensor_distance, base.field_radius)


def test_readback_is_the_double_sum():
    microscope = random_imager()
    centers = to_numpy(microscope).centers

    def teeth(point):
        reduced = point[2] + 1 / 1.43
        weights = np.asarray(envelope(((centers - point[:2]) ** 2).sum(1), reduced, 1.5))
        return centers + (centers - point[:2]) * 5.8 / reduced, weights

    def read(a, b):
        (p, w), (q, u) = teeth(a), teeth(b)
        return sum(w[i] * u[j] * np.exp(-((p[i] - q[j]) ** 2).sum() / (4 * WIDTH**2)) for i, j in np.ndindex(12, 12))

    expected = [[read(a, b) / read(a, a) for b in targets()] for a in SOURCES]
    # An identity in float64.
    np.testing.assert_allclose(crosstalk(microscope, SOURCES, targets(), width=WIDTH), expected, rtol=1e-9, atol=1e-14)


def test_a_point_reads_itself_and_a_lattice_has_full_ghosts():
    """Two voxels a pitch times s/M apart see a lattice alike; the envelope is wide enough to see both."""
    microscope = imager(hexagonal_layout((60.0, 60.0), pitch=1.0), field_radius=15.0)
    source = np.array([[0.0, 0.0, 20.0]])
    host = to_numpy(microscope)
    shift = float(host.scale(20.0) / host.magnification(20.0))
    beside = source + np.array([[0, 0, 0], [shift, 0, 0], [shift / 2, 0, 0]])
    found = np.asarray(crosstalk(microscope, source, beside, width=WIDTH))
    assert found[0, 0] == pytest.approx(1, rel=1e-12)
    # All but the lenses that only one of the two sees.
    assert 0.5 < found[0, 1] < 1
    assert found[0, 2] < 1e-9


def test_random_lenses_have_lower_ghosts_than_a_lattice():
    source = np.array([[0.0, 0.0, 20.0]])
    x = np.linspace(0, 6, 31)
    at = np.stack([*(a.ravel() for a in np.meshgrid(x, x)), np.full(31**2, 20.0)], axis=1)
    regular = imager(hexagonal_layout((14.0, 14.0), pitch=1.1), field_radius=4.0)
    random = imager(poisson_disc_layout((14.0, 14.0), min_distance=0.9), field_radius=4.0)
    # Teeth of 0.05 mm are 0.18 mm wide in the object: the point's own image ends within three times that.
    peaks = [sidelobes(i, source, at, width=0.05, lateral=0.6, axial=1.0).peak for i in (regular, random)]
    assert peaks[1] < 0.5 * peaks[0]


def test_the_peak_is_between_rms_and_maximum():
    microscope = random_imager()
    found = sidelobes(microscope, SOURCES, targets(), width=WIDTH, power=64.0, **OWN)
    ghosts = np.asarray(crosstalk(microscope, SOURCES, targets(), width=WIDTH))
    apart = SOURCES[:, None] - targets()[None]
    counted = ghosts * (1 - np.exp(-(apart[..., :2] ** 2).sum(-1) / 0.1**2 - apart[..., 2] ** 2))
    assert found.rms == pytest.approx(float(np.sqrt(np.mean(counted**2))), rel=1e-12)
    # The mean of 80 numbers to the power of 64 is at least the largest's share of it.
    assert counted.max() * 80 ** (-1 / 64) <= found.peak <= counted.max()


def test_a_lattices_spectrum_is_its_reciprocal_lattice():
    microscope = imager(hexagonal_layout((40.0, 40.0), pitch=1.0), field_radius=8.0)
    host = to_numpy(microscope)
    scale = float(host.scale(20.0))
    first = np.array([0, 2 / 3**0.5]) / scale  # shortest reciprocal vector of rows along x
    frequencies = np.array([[0.0, 0.0], first, first / 2])
    found = np.asarray(array_spectrum(microscope, np.array([[0.0, 0.0, 20.0]]), frequencies))[0]
    weights = envelope((host.centers**2).sum(1), host.reduced_depth(20.0), 8.0)
    assert found[0] == pytest.approx(float(weights.sum() ** 2 / (weights**2).sum()), rel=1e-12)
    assert found[1] == pytest.approx(float(found[0]), rel=1e-9)
    assert found[2] < 1e-2 * found[0]


def test_random_lenses_have_the_spectrum_1():
    """On average over layouts; 400 layouts of exponential powers have a standard error of 5 %."""
    frequency, point = np.array([[9.0, 4.0]]), np.array([[0.0, 0.0, 20.0]])
    layouts = np.stack([random_imager(seed).array.centers for seed in range(400)])
    found = jax.jit(jax.vmap(lambda c: array_spectrum(imager(c), point, frequency)[0, 0]))(layouts)
    assert np.mean(found) == pytest.approx(1, abs=0.15)


def test_mean_inverse_views_counts_lenses():
    """A field so wide and flat that the envelope is 1."""
    microscope = imager(np.random.default_rng(0).uniform(-1, 1, (7, 2)), field_radius=50.0)
    found = mean_inverse_views(microscope, np.array([[0.0, 0.0, 1e4], [100.0, 0.0, 1e4]]))
    assert found == pytest.approx((1 / 7.5 + 2) / 2, rel=1e-6)


def test_flatness_and_condition_number():
    flat = np.full((2, 50), 3.0)
    assert spectral_flatness(flat) == pytest.approx(1)
    assert condition_number(flat) == pytest.approx(1)
    uneven = np.random.default_rng(0).exponential(size=(1, 2000))
    # The geometric mean of exponential numbers is exp(-Euler's constant) of the arithmetic; 2000 of them, 3 %.
    assert spectral_flatness(uneven, floor=0.0) == pytest.approx(np.exp(-np.euler_gamma), rel=0.05)
    ratio = (uneven.max() + 0.1) / (uneven.min() + 0.1)
    assert ratio * 2000 ** (-2 / 16) <= condition_number(uneven, floor=0.1) <= ratio


@pytest.mark.integration
def test_gradients():
    base, frequencies = random_imager(), np.random.default_rng(2).uniform(-10, 10, (30, 2))

    def terms(centers):
        microscope = with_centers(base, centers)
        spectrum = array_spectrum(microscope, SOURCES, frequencies)
        ghosts = sidelobes(microscope, SOURCES, targets(), width=0.05, **OWN)
        flat = spectral_flatness(spectrum), jnp.log(condition_number(spectrum))
        return *ghosts, mean_inverse_views(microscope, SOURCES), *flat

    check_grads(terms, (base.array.centers,), order=1, modes=("fwd", "rev"), eps=1e-7, atol=1e-5, rtol=1e-5)


@pytest.mark.integration
@pytest.mark.parametrize("place", [0.0, 30.0], ids=["coincident", "out of sight"])
def test_gradients_are_finite(place):
    base, frequencies = random_imager(), np.array([[0.0, 0.0], [3.0, 1.0]])

    def total(c):
        microscope = with_centers(base, c)
        spectrum = array_spectrum(microscope, SOURCES, frequencies)
        ghosts = sidelobes(microscope, SOURCES, targets(), width=WIDTH, **OWN)
        return (
            mean_inverse_views(microscope, SOURCES)
            + ghosts.peak
            + ghosts.rms
            + spectral_flatness(spectrum)
            + condition_number(spectrum)
        )

    value, gradient = jax.value_and_grad(total)(jnp.full((5, 2), place))
    assert jnp.isfinite(value) and jnp.isfinite(gradient).all()


def test_float32():
    low = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), random_imager())
    found = sidelobes(low, SOURCES, targets(), width=WIDTH, **OWN)
    exact = sidelobes(random_imager(), SOURCES, targets(), width=WIDTH, **OWN)
    assert found.peak.dtype == jnp.float32
    # Teeth are rounded by 1e-7 mm; a tooth's slope is at most 40 per mm.
    np.testing.assert_allclose(found, exact, rtol=1e-3)
