"""Smoothing, levels of squares and what is between them: against SciPy's and JAX's general functions."""

import jax
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from gs_jax.detection.background import between, mirrored, smoothed, square_levels

# One pixel beside a whole square, less than one, and as small as sensors are.
SHAPES = [(97, 160), (64, 33), (31, 20), (2, 5), (5, 2)]


def image_of(shape, dtype=np.float32):
    return np.random.default_rng(0).gamma(2, 100, shape).astype(dtype)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("deviation", [0.7, 2.0])
def test_smoothing_is_a_gaussian_mirrored_at_the_edges(shape, deviation):
    image = image_of(shape)
    np.testing.assert_allclose(smoothed(image, deviation), gaussian_filter(image, deviation), rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int64, np.float64])
def test_images_of_any_type_are_smoothed_as_floats(dtype):
    image = image_of((70, 50), dtype)
    found = smoothed(image, 0.7)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, smoothed(image.astype(np.float32), 0.7), rtol=1e-6)
    np.testing.assert_array_equal(smoothed(np.asfortranarray(image), 0.7), found)


@pytest.mark.parametrize("shape", SHAPES)
def test_levels_are_medians_and_what_is_darker(shape):
    image = image_of(shape)
    median, noise = square_levels(image)
    rows, columns = (-(-n // 32) for n in shape)
    assert median.shape == noise.shape == (rows, columns)
    padded = np.pad(image, ((0, 32 * rows - shape[0]), (0, 32 * columns - shape[1])), mode="edge")
    for row, column in np.ndindex(rows, columns):
        pixels = padded[32 * row : 32 * row + 32, 32 * column : 32 * column + 32].ravel()[::3]
        middle = np.median(pixels)
        assert median[row, column] == middle
        darker = np.minimum(pixels - middle, 0)
        assert noise[row, column] == pytest.approx(np.sqrt(2 * np.mean(darker**2)), rel=1e-5)


@pytest.mark.parametrize("shape", SHAPES)
def test_between_the_squares_levels_are_linear(shape):
    rows, columns = (-(-n // 32) for n in shape)
    levels = image_of((rows, columns))
    expected = jax.image.resize(levels, (32 * rows, 32 * columns), "linear")[: shape[0], : shape[1]]
    np.testing.assert_allclose(between(levels, shape), expected, rtol=1e-6)


def test_beyond_the_ends_indices_are_mirrored_as_often_as_it_takes():
    wide = np.pad(np.arange(3), 8, mode="symmetric")
    np.testing.assert_array_equal(mirrored(np.arange(-8, 11), 3), wide)
