import math
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tifffile
from scipy import stats

import gs_jax as gs
from gs_jax import Grid, Imager, Sensor, backproject, forward, psf_model, read_capture, read_design
from gs_jax.base.errors import InputError
from gs_jax.io.camera import (
    Correction,
    Readout,
    correct,
    count_saturated,
    fill_bad_pixels,
    find_hot_in_capture,
    find_hot_in_dark,
    flat_field_gain,
    read_corrected,
)
from gs_jax.io.captures import PATTERNS, mosaic_channel
from gs_jax.simulation import Camera, electrons, expose, poisson

from .helpers import CAPTURES, scene

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


# What a camera does to light, undone: dark frame, flat field, bad pixels; and what is said of it.


SHAPE = (60, 70)
ROW, COLUMN = np.indices(SHAPE)
GAIN = 1.2 - 0.9 * ((ROW - 30) ** 2 + (COLUMN - 35) ** 2) / (30**2 + 35**2)
DARK = 16 + 3 * (COLUMN % 2)


def saved(path, pixels, dtype: Any = np.float32):
    tifffile.imwrite(path, np.asarray(pixels, dtype), photometric="minisblack")
    return path


def test_a_camera_is_undone_exactly(tmp_path):
    light = np.random.default_rng(0).random(SHAPE) * 1000
    capture = saved(tmp_path / "a.tif", GAIN * light + DARK)
    known = Correction(saved(tmp_path / "d.tif", [DARK] * 3), saved(tmp_path / "f.tif", [GAIN * 500 + DARK] * 2))
    image, done, warnings = read_corrected(capture, Sensor(SHAPE, 0.01), correction=known)
    # The flat field's mean is 1. In float32 of counts up to 1200.
    np.testing.assert_allclose(image, light * GAIN.mean(), rtol=1e-5, atol=1e-3)
    assert image.dtype == np.float32 and not warnings
    low, high = GAIN.min() / GAIN.mean(), GAIN.max() / GAIN.mean()
    assert done == [
        "dark frame d.tif taken off, median 17.5",
        f"flat field f.tif divided out, {low:.3g} to {high:.3g}",
    ]
    image, done, _ = read_corrected(capture, correction=Correction(offset=16.0))
    np.testing.assert_allclose(image, GAIN * light + DARK - 16, rtol=1e-6, atol=1e-4)
    assert done == ["offset 16 taken off"]


def test_nothing_to_do_leaves_the_file_as_it_is(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 900, SHAPE)
    found = read_corrected(saved(tmp_path / "a.tif", pixels, np.uint16), Sensor(SHAPE, 0.01))
    assert found.image.dtype == np.uint16 and not found.done and not found.warnings
    np.testing.assert_array_equal(found.image, pixels)


def test_vignetting_is_taken_out_of_a_volume():
    imager, grid = scene()
    light = np.random.default_rng(1).random(imager.sensor.shape)
    row, column = np.indices(light.shape)
    gain = np.cos(np.hypot(row - 47.5, column - 39.5) / 60) ** 4
    flat, _ = flat_field_gain(gain * 2e4 + 16, 16.0)
    whole = np.asarray(backproject(light, imager, grid))
    off = lambda image: np.abs(np.asarray(backproject(image, imager, grid)) / gain.mean() - whole).max() / whole.max()
    capture = gain * light + 16
    assert off(correct(capture, 16.0, flat)) < 1e-5
    assert off(capture - 16) > 0.3


def test_a_hot_pixel_is_not_the_brightest_voxel():
    """Of a ray-traced point, seen by 7 lenses, as brightly as a pixel may be."""
    imager = read_design(CAPTURES / "crop.toml").imager()
    image, hot = read_capture(CAPTURES / "point.tif"), (700, 300)
    grid = Grid.over(imager.sensor, depths=[20.0], pitch=0.03)
    brightest = lambda image: int(jnp.argmax(backproject(image.astype(np.float32), imager, grid)))
    broken = image.copy()
    broken[hot] = 65535
    assert brightest(broken) != brightest(image)
    found = find_hot_in_capture(broken)
    assert np.argwhere(found).tolist() == [list(hot)]
    assert brightest(fill_bad_pixels(broken, found)) == brightest(image)


@pytest.mark.parametrize("side", [1, 2, 4])
@pytest.mark.parametrize("name", ["point", "points"])
def test_sharp_spots_stay(name, side):
    """Whose middles are a pixel wide at half their height; binned, less."""
    image = read_capture(CAPTURES / f"{name}.tif").astype(np.uint16)
    rows, columns = (n // side for n in image.shape)
    image = image.reshape(rows, side, columns, side).sum((1, 3))
    assert not find_hot_in_capture(image.astype(np.float32)).any()
    broken = np.zeros_like(image, bool)
    broken[7::50, 9::60] = True
    assert (find_hot_in_capture(np.where(broken, 60_000, image).astype(np.uint16)) == broken).mean() > 0.999


def test_hot_pixels_of_a_dark_frame():
    """Beside a glow that is far brighter than the noise."""
    rng = np.random.default_rng(2)
    dark = 100 + rng.normal(0, 2, (200, 300)) + 300 * np.exp(-np.indices((200, 300))[1] / 40)
    hot = np.zeros(dark.shape, bool)
    hot[rng.integers(0, 200, 30), rng.integers(0, 300, 30)] = True
    np.testing.assert_array_equal(find_hot_in_dark(np.where(hot, dark + 500, dark).round().astype(np.uint16)), hot)


def test_bad_pixels_are_filled_from_good_ones():
    ramp = ROW + 2.0 * COLUMN
    bad = np.zeros(SHAPE, bool)
    bad[[0, 10, 59], [0, 10, 69]] = True
    bad[20:26, 30:37] = bad[:, 50] = True
    filled = fill_bad_pixels(np.where(bad, 1e6, ramp), bad)
    np.testing.assert_array_equal(filled[~bad], ramp[~bad])
    # Single ones by symmetry, but at the edge; a hole by its edge.
    assert filled[10, 10] == ramp[10, 10]
    assert np.abs(filled - ramp)[bad].max() < 10
    with pytest.raises(ValueError, match="must leave a good pixel"):
        fill_bad_pixels(ramp, np.ones(SHAPE, bool))


@pytest.mark.parametrize(
    ("top", "count", "dtype", "is_cut"),
    [
        (255, 5, np.uint8, True),
        (4095, 5, np.uint16, True),
        (65535, 5, np.uint16, True),
        (65520, 5, np.uint16, True),
        (3000, 50, np.uint16, True),
        (3000, 3, np.uint16, False),
        (3000, 50, np.float32, False),
        (65535, 1, np.uint16, False),
        (18, 50, np.uint16, False),
        (0, 0, np.uint8, False),
    ],
)
def test_what_is_cut_off(top, count, dtype, is_cut):
    image = np.random.default_rng(3).integers(0, max(top * 0.9, 1), SHAPE).astype(dtype)
    image.flat[:count] = top
    assert count_saturated(image) == ((count, top) if is_cut else None)


@pytest.mark.parametrize("light", [3e38, -3e38])
def test_light_whose_squares_float32_cannot_hold_is_refused(tmp_path, light):
    """Volumes of it would have infinities."""
    path = saved(tmp_path / "a.tif", np.full((1, 8, 8), light), np.float32)
    with pytest.raises(InputError, match=r"pixels must be at most 1e\+15 in size, got 3e\+38 \(.*a.tif\)"):
        read_corrected(path)


def test_what_was_done_is_said(tmp_path):
    """A mosaic's region, pages averaged, cut off in places, with a mask."""
    rng = np.random.default_rng(4)
    pages = rng.integers(0, 200, (4, 40, 50))
    pages[:, :5, :4] = 255
    mask = np.zeros((40, 50), bool)
    mask[8, 11] = mask[11, 8] = True
    np.save(tmp_path / "mask.npy", mask)
    readout = Readout(roi=(2, 4, 40, 50), bayer="RGGB", channel="green")
    image, done, warnings = read_corrected(
        saved(tmp_path / "a.tif", pages, np.uint8),
        Sensor(SHAPE, 0.01),
        page="mean",
        readout=readout,
        correction=Correction(bad_pixels=tmp_path / "mask.npy"),
    )
    assert image.shape == readout.sensor(Sensor(SHAPE, 0.01)).shape
    assert done == [
        "mean of 4 pages",
        "green of the mosaic RGGB, an image of its cells of 2 x 2 pixels",
        "rows 2 to 41, columns 4 to 53 of the sensor",
        "2 bad pixels filled from neighbours: 2 in mask.npy",
    ]
    assert len(warnings) == 1 and "a.tif: 80 pixels (0.01 of all) are saturated at 255" in warnings[0]


WRONG = {
    "dark": (Correction(dark=Path("other.tif")), ["other.tif", "40 x 50", "60 x 70"]),
    "flat": (Correction(flat=Path("other.tif")), ["other.tif", "40 x 50", "60 x 70"]),
    "mask": (Correction(bad_pixels=Path("other.tif")), ["other.tif", "40 x 50", "60 x 70"]),
    "missing": (Correction(dark=Path("none.tif")), ["none.tif", "No such file"]),
    "good": (Correction(bad_pixels=Path("good.npy")), ["good.npy", "100%", "0 for good"]),
    "unlit": (Correction(Path("dark.tif"), Path("dark.tif")), ["dark.tif", "median of 0", "even light"]),
    "both": (Correction(dark=Path("dark.tif"), offset=3.0), ["--offset", "dark.tif"]),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_file_is_named(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    for file, pixels in (("other.tif", np.ones((40, 50))), ("dark.tif", DARK), ("a.tif", np.ones(SHAPE))):
        saved(file, pixels)
    np.save("good.npy", np.ones(SHAPE, bool))
    for sensor in (Sensor(SHAPE, 0.01), None):
        with pytest.raises(InputError) as caught:
            read_corrected("a.tif", sensor, correction=WRONG[name][0])
        message = str(caught.value)
        assert message.isprintable() and len(message) < 400 and all(word in message for word in WRONG[name][1])


# Regions, binned pixels and colours of a sensor: the frame stays that of the whole.


WHOLE = Sensor((96, 80), 0.02)
# What the camera makes of all its pixels.
READOUTS = {
    "roi": Readout(roi=(7, 10, 61, 50)),
    "binned": Readout(binning=2),
    "odd": Readout(roi=(5, 3, 88, 74), binning=3),
    **{
        f"{pattern} {channel}": Readout(bayer=pattern, channel=channel)
        for pattern, channel in zip(PATTERNS, ("red", "green", "blue", "red"), strict=True)
    },
    "mosaic's region": Readout(roi=(7, 10, 61, 51), bayer="GRBG", channel="blue"),
}


def read_out(image, readout):
    row, column, rows, columns = readout.roi or (0, 0, *image.shape)
    side, image = readout.binning, image[row : row + rows, column : column + columns]
    rows, columns = (n // side for n in image.shape)
    image = image[: rows * side, : columns * side].reshape(rows, side, columns, side).sum((1, 3))
    return mosaic_channel(image, readout.bayer, readout.channel) if readout.bayer else image


def with_sensor(imager, sensor) -> Imager:
    return eqx.tree_at(lambda i: i.sensor, imager, sensor)


def test_an_origin_is_the_middle_of_the_pixels():
    sensor = Sensor((5, 4), 0.01, (0.3, -0.2))
    np.testing.assert_allclose(sensor.to_mm(np.array([2.0, 1.5])), [0.3, -0.2], rtol=1e-14)
    points = np.random.default_rng(0).normal(size=(7, 2))
    np.testing.assert_allclose(sensor.to_mm(sensor.to_pixels(points)), points, rtol=1e-12)
    np.testing.assert_allclose(sensor.extent, [0.28, 0.32, -0.175, -0.225])
    grid = Grid.over(sensor, depths=[20.0], pitch=0.01)
    np.testing.assert_allclose(grid.origin, sensor.origin)
    with pytest.raises(ValueError, match="origin"):
        Sensor((5, 4), 0.01, (np.nan, 0.0))


@pytest.mark.parametrize("name", READOUTS)
def test_coordinates_of_pixels_are_those_of_the_whole_sensor(name):
    """The image of x, read out, is the x of the pixels that were read out; likewise y."""
    readout = READOUTS[name]
    sensor = readout.sensor(WHOLE)
    row, column = np.indices(WHOLE.shape)
    x, y = np.moveaxis(np.asarray(WHOLE.to_mm(np.stack([row, column], -1).astype(float))), -1, 0)
    light = readout.binning**2
    assert read_out(x, readout).shape == sensor.shape
    here = np.asarray(sensor.to_mm(np.moveaxis(np.indices(sensor.shape), 0, -1).astype(float)))
    # Green is a mean in float32.
    np.testing.assert_allclose(read_out(x, readout) / light, here[..., 0], atol=1e-6)
    np.testing.assert_allclose(read_out(y, readout) / light, here[..., 1], atol=1e-6)


@pytest.mark.parametrize("method", ["nearest", "linear"])
def test_back_projection_of_a_region_is_that_of_the_whole_without_the_rest(method):
    imager, grid = scene()
    row, column, rows, columns = 20, 9, 50, 61
    lit = np.zeros(WHOLE.shape)
    # A dark line around: linear interpolation between it and what is beyond.
    inside = np.s_[row + 1 : row + rows - 1, column + 1 : column + columns - 1]
    lit[inside] = np.random.default_rng(1).random((rows - 2, columns - 2))
    part = with_sensor(imager, Readout(roi=(row, column, rows, columns)).sensor(imager.sensor))
    seen = backproject(lit[row : row + rows, column : column + columns], part, grid, method=method)
    np.testing.assert_allclose(seen, backproject(lit, imager, grid, method=method), atol=1e-12)


@pytest.mark.integration
@pytest.mark.parametrize("level", ["pinhole", "near"])
def test_the_image_on_a_region_is_the_region_of_the_image(level):
    imager, grid = scene()
    volume = np.random.default_rng(2).random(grid.volume_shape)
    part = with_sensor(imager, Readout(roi=(11, 8, 70, 64)).sensor(imager.sensor))
    optics = psf_model(imager, grid, level)
    whole = np.asarray(forward(volume, imager, grid, optics))[11:81, 8:72]
    # Without a PSF rays that land within a pixel of the region's edge are not read.
    edge = np.s_[1:-1, 1:-1]
    seen = np.asarray(forward(volume, part, grid, optics))
    np.testing.assert_allclose(seen[edge], whole[edge], atol=1e-9 * whole.max())


@pytest.mark.integration
@pytest.mark.parametrize("level", ["pinhole", "full"])
def test_an_origin_moves_the_frame_and_nothing_else(level):
    """The chief-ray map does not mind where the origin is; of "full", coarse pixels lie on the region."""
    imager, grid = scene()
    grid = grid.at([20.0])
    volume = np.random.default_rng(3).random(grid.volume_shape)
    region = Readout(roi=(11, 8, 71, 64)).sensor(imager.sensor)
    optics = psf_model(imager, grid, level)
    seen = forward(volume, with_sensor(imager, region), grid, optics)
    moved = eqx.tree_at(
        lambda i: i.shift, with_sensor(imager, Sensor(region.shape, 0.02)), imager.shift - jnp.array(region.origin)
    )
    grid = eqx.tree_at(lambda g: g.origin, grid, grid.origin - jnp.array(region.origin))
    np.testing.assert_allclose(seen, forward(volume, moved, grid, optics), atol=1e-12 * float(seen.max()))


@pytest.mark.slow
@pytest.mark.parametrize(
    "readout",
    [Readout(roi=(201, 100, 900, 1001)), Readout(binning=2), Readout(bayer="GRBG", channel="green")],
)
def test_points_are_the_same(readout):
    """Of the ray-traced crop, whose points the whole capture shows to 2 um and 45 um: within a pixel of the readout."""
    imager, truth = gs.read_design(CAPTURES / "crop.toml").imager(), gs.read_points(CAPTURES / "points.csv")
    image = read_out(gs.read_capture(CAPTURES / "points.tif").astype(float), readout)
    part = with_sensor(imager, readout.sensor(imager.sensor))
    grid = Grid.over(part.sensor, depths=jnp.arange(18.0, 22.1, 0.25), pitch=0.05)
    found = gs.find_points(image, part, grid)
    left, right, bottom, top = part.sensor.extent
    x, y = truth[:, 0], truth[:, 1]
    inside = truth[(left < x) & (x < right) & (top < y) & (y < bottom)]
    pixel = part.sensor.pixel_pitch / float(imager.magnification(20.0))
    distance = np.abs(found[:, None, :3] - inside[None, :, :3])
    same = (distance[..., :2] < pixel).all(-1) & (distance[..., 2] < 0.2)
    assert same.any(1).all() and same.any(0).mean() > 0.8


@pytest.mark.parametrize(
    ("readout", "words"),
    [
        (Readout(roi=(50, 0, 47, 80)), ["--roi", "rows 50 to 96", "96 x 80"]),
        (Readout(roi=(0, 0, 10, 10), binning=8), ["1 x 1", "2 x 2"]),
        (Readout(binning=2, bayer="RGGB", channel="red"), ["--binning 2", "--bayer RGGB"]),
        (Readout(bayer="RGGB"), ["--bayer RGGB", "red, green, blue"]),
        (Readout(bayer="RGGG", channel="red"), ["'RGGG'", "GBRG"]),
    ],
)
def test_wrong_readouts(readout, words):
    with pytest.raises(InputError) as caught:
        readout.sensor(WHOLE)
    for word in words:
        assert word in str(caught.value)
