import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from gs_jax.simulation import Camera, electrons, expose, poisson

KEY = jax.random.key(7)
draw = jax.jit(poisson)


def flat(level, shape=(400, 500), peak=1000.0):
    """An image of one level, in electrons if exposed at `peak`: one pixel, the first, is the brightest."""
    image = np.full(shape, level / peak)
    image[0, 0] = 1.0
    return image


def without_the_brightest(counts):
    return np.asarray(counts, float).ravel()[1:]


# --- poisson ---


def chi_square_p(sample, mean):
    """Probability of a worse fit to the Poisson distribution; rare counts go together."""
    sample = np.asarray(sample, int).ravel()
    low, high = stats.poisson.ppf([20 / sample.size, 1 - 20 / sample.size], mean)
    edges = np.arange(low, high + 1)
    found = np.bincount(np.digitize(sample, edges), minlength=len(edges) + 1)
    expected = np.diff(stats.poisson.cdf(edges - 1, mean), prepend=0, append=1) * sample.size
    used = expected > 0
    return stats.chisquare(found[used], expected[used]).pvalue


@pytest.mark.integration
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("mean", [0.01, 0.3, 1.0, 3.7, 15.99, 16.0, 60.0, 400.0, 1e4, 1e6])
def test_poisson_has_its_distribution(mean, dtype):
    """A million samples: the expansion's error adds 3 to a chi-square of 35 or so at 16, less above."""
    sample = np.asarray(draw(KEY, np.full(n := 1_000_000, mean, dtype)))
    assert sample.dtype == dtype and (sample == np.floor(sample)).all()
    # Of larger means the sample is too sparse.
    assert mean > 1e4 or chi_square_p(sample, mean) > 1e-4
    # Five standard deviations; the variance of a variance is (3 m^2 + m - m^2) / n.
    sample = sample.astype(float)
    assert abs(sample.mean() - mean) < 5 * math.sqrt(mean / n)
    assert abs(sample.var() - mean) < 5 * math.sqrt((2 * mean**2 + mean) / n)


@pytest.mark.parametrize("mean", [16.0, 20.0, 100.0, 1e4])
def test_the_expansion_has_the_error_that_is_stated(mean):
    """Exactly, without samples: the normal quantiles at which it steps, against the cumulated distribution."""
    w = np.linspace(-6, 6, 400_001)
    value = mean + np.sqrt(mean) * w + (w**2 + 2) / 6 - (w**3 + 2 * w) / (72 * np.sqrt(mean))
    assert (np.diff(value) > 0).all()
    k = np.arange(math.ceil(value[0]), math.floor(value[-1]))
    cumulated = stats.norm.cdf(np.interp(k, value, w))
    assert np.abs(cumulated - stats.poisson.cdf(k - 1, mean)).max() < 1.35e-4
    probability = np.diff(cumulated)
    average = probability @ k[:-1]
    variance = probability @ k[:-1] ** 2 - average**2
    np.testing.assert_allclose(average, mean, atol=1e-6)
    np.testing.assert_allclose(variance, mean, rtol=2.4e-5)


def test_poisson_of_nothing_and_of_many_means_at_once():
    assert not np.any(draw(KEY, np.zeros(100_000)))
    means = np.random.default_rng(0).uniform(0, 40, 100_000)
    sample = np.asarray(draw(KEY, means))
    # Through its own cumulated distribution, smoothed over its steps, each sample is uniform.
    u = np.random.default_rng(1).random(means.size)
    level = stats.poisson.cdf(sample - 1, means) + u * stats.poisson.pmf(sample, means)
    assert stats.kstest(level, "uniform").pvalue > 1e-3


def test_poisson_searches_end_in_float32():
    """Where rounding leaves the summed probabilities below 1, the largest variates find no number that reaches them."""
    sample = draw(KEY, np.linspace(0, 16, 1_000_000, dtype=np.float32))
    assert float(np.max(sample)) <= stats.poisson.ppf(1 - 1e-9, 16)


# --- expose ---


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("gain", [0.5, 10.0])
def test_photon_transfer(gain, dtype):
    """Variance against mean, counts: a line with the slope 1 / gain, and read noise and rounding at its foot."""
    camera, levels = Camera(gain=gain, offset=100.0, read_noise=8.0), np.array([50.0, 200.0, 1000.0, 5000.0])
    image = np.repeat(levels / 5000, 50_000).reshape(400, 500).astype(dtype)
    counts = np.asarray(expose(image, camera, KEY, peak_electrons=5000), float).reshape(4, -1)
    mean, variance = counts.mean(axis=1), counts.var(axis=1)
    n = counts.shape[1]
    # Five standard deviations of a mean and of a variance of n values.
    np.testing.assert_allclose(mean, 100 + levels / gain, atol=5 * math.sqrt(variance.max() / n))
    np.testing.assert_allclose(variance, levels / gain**2 + (8 / gain) ** 2 + 1 / 12, rtol=5 * math.sqrt(2 / n))
    slope = np.polyfit(mean, variance, 1)[0]
    np.testing.assert_allclose(slope, 1 / gain, rtol=0.05)


def test_dark_images_are_offset_and_read_noise():
    dark = np.zeros((400, 500))
    counts = np.asarray(expose(dark, Camera(), KEY, peak_electrons=1e4))
    assert counts.dtype == np.uint16
    # N(16, 0.2) rounds to 16 but for 1.2 %.
    np.testing.assert_allclose((counts != 16).mean(), 2 * stats.norm.sf(0.5 / 0.2), rtol=0.15)
    assert (np.asarray(expose(dark, Camera(read_noise=0.0), KEY, peak_electrons=1e4)) == 16).all()
    # Counts end at zero. Five standard deviations of a share of 200,000.
    counts = np.asarray(expose(dark, Camera(gain=1.0, offset=0.0, read_noise=5.0), KEY, peak_electrons=1.0))
    np.testing.assert_allclose((counts == 0).mean(), stats.norm.cdf(0.1), atol=5 * 0.5 / math.sqrt(200_000))
    assert counts.max() < 50


@pytest.mark.integration
def test_the_brightest_pixel_has_the_peak():
    image = np.random.default_rng(0).uniform(0, 3e-9, (48, 60))
    mean = np.mean(
        [electrons(expose(image, Camera(), jax.random.key(k), peak_electrons=500), Camera()) for k in range(200)],
        axis=0,
    )
    # Shot noise of 500, rounding to 10 electrons, 200 exposures: 1.6 electrons; 5 of these for 3000 pixels.
    np.testing.assert_allclose(mean, image * (500 / image.max()), atol=8)


def test_the_well_and_the_converter_saturate():
    image = flat(2000.0, peak=4000.0)
    quiet = Camera(gain=1.0, offset=0.0, read_noise=0.0, full_well=1000.0)
    assert (without_the_brightest(expose(image, quiet, KEY, peak_electrons=4000)) == 1000).all()
    noisy = Camera(gain=1.0, offset=50.0, read_noise=5.0, full_well=1000.0)
    values = without_the_brightest(expose(image, noisy, KEY, peak_electrons=4000))
    np.testing.assert_allclose([values.mean(), values.std()], [1050, 5], rtol=0.01)  # read noise on a full well
    for bits, dtype in ((8, np.uint8), (9, np.uint16)):
        counts = np.asarray(expose(image[:8, :9], Camera(gain=1.0, bits=bits), KEY, peak_electrons=4000))
        assert counts.dtype == dtype and (counts == 2**bits - 1).all()
    assert (np.asarray(expose(image, Camera(gain=0.01), KEY, peak_electrons=4000)) == 65535).all()


def test_counts_are_rounded_electrons():
    """Without read noise: whole numbers of electrons, over a gain that does not divide them."""
    camera = Camera(gain=4.0, offset=10.0, read_noise=0.0)
    values = without_the_brightest(expose(flat(3.0), camera, KEY, peak_electrons=1000)).astype(int) - 10
    drawn = stats.poisson.pmf(np.arange(60), 3.0)
    expected = np.bincount(np.round(np.arange(60) / 4).astype(int), drawn)[:4]
    found = np.bincount(values)[:4] / values.size
    np.testing.assert_allclose(found, expected, atol=5 * math.sqrt(0.25 / values.size))


def test_electrons_are_linear_and_exact():
    counts = np.array([[0, 16, 17, 65535]], np.uint16)
    result = electrons(counts, Camera())
    assert result.dtype == jnp.float32
    np.testing.assert_array_equal(result, [[-160, 0, 10, 655190]])
    np.testing.assert_array_equal(electrons(np.array([[255]], np.uint8), Camera(gain=2.0, offset=5.0)), [[500]])


def test_keys_and_independence():
    image = np.ones((400, 500))
    once, again, other = (np.asarray(expose(image, Camera(), jax.random.key(k), peak_electrons=1e4)) for k in (0, 0, 1))
    np.testing.assert_array_equal(once, again)
    # Of neighbouring rows and columns, of two keys, and of rows a block apart: no correlation.
    pairs = [(once, other), (once[1:], once[:-1]), (once[:, 1:], once[:, :-1]), (once[16:], once[:-16])]
    for a, b in pairs:
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 5 / math.sqrt(a.size)


@pytest.mark.integration
def test_vmap_over_images_and_keys():
    """Of 19 rows, which are not a whole number of blocks; another camera is the same program."""
    images = jnp.asarray(np.random.default_rng(0).random((2, 19, 20)))
    run = lambda image, key: expose(image, Camera(), key, peak_electrons=100.0)
    keys = jax.random.split(KEY, 2)
    expected = [run(image, key) for image, key in zip(images, keys, strict=True)]
    np.testing.assert_array_equal(jax.vmap(run)(images, keys), expected)
    traces = []
    compiled = jax.jit(lambda camera: traces.append(camera) or expose(images[0], camera, KEY, peak_electrons=100.0))
    for gain in (1.0, 2.0):
        compiled(Camera(gain=gain))
    assert len(traces) == 1


def test_memory_is_image_and_counts_and_a_small_constant():
    """What XLA itself plans to allocate, at full scale."""
    image = jax.ShapeDtypeStruct((5120, 5120), jnp.float32)
    camera = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), Camera())
    run = jax.jit(lambda image: expose(image, camera, KEY, peak_electrons=1e4))
    plan = run.lower(image).compile().memory_analysis()
    assert plan is not None
    assert plan.output_size_in_bytes == 2 * 5120**2
    assert plan.temp_size_in_bytes < 60 * 2**20


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: expose(flat(-1.0), Camera(), KEY, peak_electrons=1), "`image` must be finite and not negative, got"),
        (lambda: expose(flat(math.nan), Camera(), KEY, peak_electrons=1), "`image` .* got 199999 pixels that are not"),
        (lambda: expose(flat(math.inf), Camera(), KEY, peak_electrons=1), "`image` .* got 199999 pixels"),
        (lambda: expose(flat(1.0), Camera(), KEY, peak_electrons=0), "`peak_electrons` must be positive and finite"),
        (lambda: expose(flat(1.0), Camera(), KEY, peak_electrons=math.nan), "`peak_electrons` .* got nan"),
        (lambda: Camera(gain=0.0), "`gain` must be positive and finite, got 0.0"),
        (lambda: Camera(offset=-1.0), "`offset` must be finite and not negative, got -1.0"),
        (lambda: Camera(read_noise=math.nan), "`read_noise` .* got nan"),
        (lambda: Camera(full_well=0.0), "`full_well` must be positive, got 0.0"),
        (lambda: Camera(bits=17), "`bits` must be 1 to 16, got 17"),
    ],
)
def test_wrong_arguments_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
