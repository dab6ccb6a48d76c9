import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.ndimage import gaussian_filter

from gs_jax import Grid, Imager, MicrolensArray, Sensor, backproject, forward
from gs_jax.codesign import end_to_end
from gs_jax.codesign.end_to_end import reconstruction_loss
from gs_jax.metrics import quality
from gs_jax.optics.raytrace import to_numpy
from gs_jax.projection.rays import crop_field

from .helpers import scene

# One program each instead of one for each of their operations.
footprints, misfit_db, noisy = map(jax.jit, (end_to_end.footprints, end_to_end.misfit_db, end_to_end.noisy))
local_contrast = jax.jit(end_to_end.local_contrast, static_argnames="width")
random_scene = jax.jit(end_to_end.random_scene, static_argnames=("density", "width"))
KEY = jax.random.key(3)
OPTIONS: dict[str, Any] = dict(density=0.05, width=0.06, background_width=0.2, scenes=2)


def psfs(dtype=jnp.float64):
    kernel = np.exp(-((np.arange(5) - 2) ** 2) / 2)
    kernel = np.outer(kernel, kernel) / kernel.sum() ** 2
    return np.broadcast_to(kernel, (3, 5, 5)).astype(dtype)


def test_scenes_have_the_density_and_width_asked_for():
    grid = Grid([18.0, 20.0], (200, 200), 0.02)
    found = random_scene(KEY, grid, density=0.01, width=0.05)
    # Mean brightness 0.75 of 800 blobs of area 2 pi width^2: the Poisson noise of the number is 3.5 %.
    assert found.mean() == pytest.approx(0.01 * 0.75 * 2 * np.pi * (0.05 / 0.02) ** 2, rel=0.12)
    single = np.asarray(random_scene(KEY, Grid([18.0], (301, 301), 0.02), density=1e-5, width=0.1))[0]
    total = single.sum()
    row, column = np.unravel_index(int(single.argmax()), single.shape)
    y = (np.arange(301) - row) * 0.02
    assert np.sum(single * y[:, None] ** 2) / total == pytest.approx(0.01, rel=1e-3)


def test_local_contrast_is_a_high_pass_of_scipy():
    grid = Grid([18.0], (90, 80), 0.05)
    volume = np.random.default_rng(0).random((1, 90, 80))
    mean = lambda v: gaussian_filter(v, 4, mode="constant", truncate=8, radius=None)
    expected = np.maximum(volume[0] - mean(volume[0]) / mean(np.ones((90, 80))), 0)
    # SciPy's kernel ends at 8 deviations: exp(-32).
    np.testing.assert_allclose(np.asarray(local_contrast(volume, grid, width=0.2))[0], expected, atol=1e-12)


def test_misfit_is_minus_psnr_up_to_the_scene():
    rng = np.random.default_rng(0)
    truth = rng.random((2, 9, 9))
    estimates = [truth + s * rng.random(truth.shape) for s in (0.3, 1.0)]
    psnr = [quality(e, truth).psnr_db for e in estimates]
    misfit = [float(misfit_db(e, truth)) for e in estimates]
    np.testing.assert_allclose(misfit[1] - misfit[0], psnr[0] - psnr[1], rtol=1e-9)
    assert misfit_db(3 * truth, truth) == pytest.approx(10 * np.log10(10 * np.finfo(float).eps))
    assert misfit_db(np.zeros_like(truth), truth) == 0


def test_noise_has_the_variance_of_light_and_camera():
    image = np.full((200, 200), 50.0)
    found = np.asarray(noisy(KEY, image, 3.0)) - image
    # 40,000 numbers: 0.7 %.
    assert found.var() == pytest.approx(59, rel=0.03) and abs(found.mean()) < 0.15
    np.testing.assert_array_equal(noisy(KEY, np.zeros((200, 200)), 0.0), 0)


def test_reconstruct_is_back_projection_less_its_mean():
    imager, grid = scene()
    image = np.random.default_rng(0).random(imager.sensor.shape)

    @jax.jit
    def both(image, imager, grid):
        ours = end_to_end.reconstruct(image, imager, grid, background_width=0.2)
        weight = backproject(jnp.ones_like(image), imager, grid)
        return ours, backproject(image, imager, grid, normalize=True), weight

    ours, volume, weight = both(image, imager, grid)
    assert weight.min() > 0.5  # so nothing is dimmed
    np.testing.assert_allclose(ours, local_contrast(volume, grid, width=0.2), atol=1e-12)


@pytest.mark.integration
@pytest.mark.parametrize("shape, tilt", [((60, 50), None), ((61, 50), (0.1, 0.05)), ((96, 80), None)])
def test_a_part_of_the_field_sees_what_the_whole_sees(shape, tilt):
    """A volume beside the axis, in the frame of the part and in that of the whole."""
    whole = dataclasses.replace(scene()[0], tilt=tilt)
    part, one, lit = crop_field(whole, Grid([20.0], (5, 5), 0.05), jnp.array([0.13, -0.21]), shape)
    place = (whole.centers - part.centers)[0]
    np.testing.assert_allclose(place, [0.13, -0.21], atol=0.0101)
    volume = jax.random.uniform(KEY, (1, 5, 5))
    grid = Grid([20.0], (201, 201), 0.01)
    # The same voxels on a grid of the whole: every fifth, around the place.
    assert jnp.abs(place / 0.01 - jnp.round(place / 0.01)).max() < 1e-6
    middle = np.round(np.asarray(place) / 0.01).astype(int) + 100
    rows, columns = (m + 5 * (np.arange(5) - 2) for m in middle[::-1])
    big = jnp.zeros((1, 201, 201)).at[0, rows[:, None], columns[None]].set(volume[0])
    image, local = forward(big, whole, grid), forward(volume, part, one)
    assert lit.sum() <= image.size
    # The totals agree where both see everything: compare pixel by pixel through the back-projection's own map.
    corner = np.round(np.asarray(place[::-1]) / 0.02 + (np.array([96, 80]) - np.array(shape)) / 2).astype(int)
    first, last = np.maximum(corner, 0), np.minimum(corner + np.array(shape), (96, 80))
    inner = tuple(slice(f - c, l - c) for f, l, c in zip(first, last, corner, strict=True))
    outer = tuple(slice(f, l) for f, l in zip(first, last, strict=True))
    expected = np.asarray(image[outer])
    # Rays between the last pixels of one sensor and its edge are dropped by that one alone.
    trim = np.s_[1:-1, 1:-1]
    np.testing.assert_allclose(np.asarray(local[inner])[trim], expected[trim], atol=1e-9)
    np.testing.assert_array_equal(lit[inner], True)
    assert lit.sum() == expected.size


@pytest.mark.integration
def test_voxels_leave_no_gaps_in_the_image():
    """An even volume, voxels 1.9 to 2.2 pixels apart: as points they are a grid of dots, as footprints even light."""
    imager = Imager(MicrolensArray(np.zeros((1, 2))), Sensor((96, 80), 0.02), 5.8, 2.0)
    grid = Grid([18.0], (61, 61), 0.13)
    inner = np.s_[38:58, 30:50]  # the envelope falls by a few per cent over it
    even = np.ones((1, 61, 61))
    ripple = lambda psf: (
        np.std(forward(even, imager, grid, psf)[inner]) / np.mean(forward(even, imager, grid, psf)[inner])
    )
    assert ripple(None) > 0.1 and ripple(footprints(imager, grid)) < 0.01


def test_footprints_keep_the_light_and_add_variance():
    imager, fine = scene()
    grid = Grid(fine.depths, (5, 5), 0.15)
    found = np.asarray(footprints(imager, grid, psfs()))
    np.testing.assert_allclose(found.sum((1, 2)), 1, rtol=1e-12)
    assert (found[:, 2, 2] < psfs()[:, 2, 2]).all()
    place = np.arange(17) - 8
    alone = np.asarray(footprints(imager, grid))
    magnification = to_numpy(imager).magnification(np.asarray(grid.depths))
    width = magnification * float(grid.pitch) / 2 / imager.sensor.pixel_pitch
    # Sampled Gaussians of a pixel and more have their variance, to 1e-6.
    np.testing.assert_allclose((alone * place**2).sum((1, 2)), width**2, rtol=1e-4)


@jax.jit
def loss(imager, key, grid, psf, electrons=1000.0):
    """Compiled once; scenes that were constants would be computed by the compiler, slowly."""
    return reconstruction_loss(imager, key, grid=grid, psf=psf, electrons=electrons, **OPTIONS)


@pytest.mark.integration
def test_light_lowers_the_loss():
    """In electrons of a voxel through a lens: shot noise is most of the error at 1, nothing at a million."""
    imager, grid = scene()
    dark, bright = (loss(imager, KEY, grid, psfs(), electrons) for electrons in (1.0, 1e6))
    assert bright < dark - 0.3


@pytest.mark.integration
def test_the_key_decides():
    imager, grid = scene()
    of = lambda key: loss(imager, key, grid, psfs())
    assert of(KEY) == of(KEY) != of(jax.random.key(4))


@pytest.mark.slow
def test_gradients_by_everything_that_is_continuous():
    """Scenes at a random place, with margin and window; forward and reverse."""
    imager, grid = scene(voxels=(15, 13))

    def loss(imager, depths, psf):
        return reconstruction_loss(
            imager, KEY, grid=Grid(depths, grid.shape, grid.pitch), psf=psf, margin=2, window=(70, 64),
            field=(0.2, 0.2), **OPTIONS,
        )  # fmt: skip

    # Interpolation has kinks every pixel: steps must be small, and what they leave is rounding.
    check_grads(
        jax.jit(loss), (imager, grid.depths, psfs()), order=1, modes=("fwd", "rev"), eps=1e-7, atol=1e-4, rtol=1e-3
    )


@jax.jit
def slopes(centers, imager, key, grid, psf):
    """Compiled once for both places, as `loss`."""
    options: dict[str, Any] = OPTIONS | dict(read_noise=0.0, scenes=1)
    moved = lambda c: Imager(MicrolensArray(c), imager.sensor, imager.sensor_distance, imager.field_radius)
    return jax.value_and_grad(lambda c: reconstruction_loss(moved(c), key, grid=grid, psf=psf, **options))(centers)


@pytest.mark.integration
@pytest.mark.parametrize("place", [0.0, 30.0], ids=["coincident", "out of sight"])
def test_gradients_are_finite(place):
    imager, grid = scene()
    value, gradient = slopes(jnp.full((4, 2), place), imager, KEY, grid, psfs())
    assert jnp.isfinite(value) and jnp.isfinite(gradient).all()


@pytest.mark.integration
def test_float32():
    (low, grid), (high, exact) = scene(jnp.float32), scene()
    found = loss(low, KEY, grid, psfs(jnp.float32))
    assert found.dtype == jnp.float32
    # Random numbers differ between the types, so only the level does compare: two scenes of this size, 1 dB.
    assert found == pytest.approx(float(loss(high, KEY, exact, psfs())), abs=2)


@pytest.mark.parametrize(
    ("options", "words"), [(dict(scenes=0), "1 or more, got 0"), (dict(margin=9), "leave voxels of .* got 9")]
)
def test_wrong_arguments_are_named(options, words):
    imager, grid = scene()
    with pytest.raises(ValueError, match=words):
        reconstruction_loss(imager, KEY, grid=grid, **OPTIONS | options)
