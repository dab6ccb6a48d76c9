"""Sums of convolutions: by tiles in numba and by FFTs of whole images, against SciPy's; their derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.signal import fftconvolve

from gs_jax.linear.fourier import upsample_by_two
from gs_jax.projection.convolution import sum_of_convolutions
from gs_jax.projection.cpu.loading import cpu_kernel


def problem(shape=(170, 205), size=9, count=2, dtype=jnp.float32, *, symmetric=False):
    rng = np.random.default_rng(0)
    sharp = tuple(rng.normal(size=shape).astype(dtype) for _ in range(count))
    kernels = rng.normal(size=(count, size, size))
    if symmetric:
        kernels = kernels + kernels[:, ::-1]
        kernels = kernels + kernels[:, :, ::-1]
    return sharp, kernels.astype(dtype)


def expected(sharp, kernels, *, whole):
    """The sensor ends half a kernel and one line before the sharp images."""
    fit, mode = ((lambda a: a), "full") if whole else ((lambda a: a[1:-1, 1:-1]), "valid")
    pairs = zip(sharp, kernels, strict=True)
    return sum(fftconvolve(fit(np.asarray(a, float)), np.asarray(k, float), mode=mode) for a, k in pairs)


# Tiles of 256 and 512 pixels, one and an odd number of them; images of odd and even sizes.
SIZES = [((170, 205), 9, 2), ((30, 41), 3, 1), ((260, 300), 65, 3), ((301, 333), 129, 2)]


@pytest.mark.parametrize(("shape", "size", "count"), SIZES)
@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_sum_is_scipys(shape, size, count, whole, dtype):
    sharp, kernels = problem(shape, size, count, dtype, symmetric=whole)
    lowered = jax.jit(partial(sum_of_convolutions, whole=whole, symmetric=whole)).lower(sharp, kernels)
    by_kernel = dtype == jnp.float32 and cpu_kernel("convolve") is not None
    assert ("gs_jax_cpu" in lowered.as_text()) == by_kernel
    right = expected(sharp, kernels, whole=whole)
    # As an FFT rounds: relative to the largest.
    tolerance = 2e-6 if dtype == jnp.float32 else 1e-13
    np.testing.assert_allclose(lowered.compile()(sharp, kernels), right, atol=tolerance * np.abs(right).max())


@pytest.mark.parametrize("whole", [False, True])
def test_adjoint(whole):
    sharp, kernels = problem()

    @jax.jit
    def both(sharp, kernels, other):
        function = lambda sharp: sum_of_convolutions(sharp, kernels, whole=whole)
        return function(sharp), jax.linear_transpose(function, sharp)(other)[0]

    shape = np.shape(expected(sharp, kernels, whole=whole))
    other = np.cos(np.arange(np.prod(shape), dtype=np.float32)).reshape(shape)
    image, back = jax.tree.map(np.asarray, both(sharp, kernels, other))
    total = sum(np.vdot(a, b) for a, b in zip(sharp, back, strict=True))
    assert abs(total - np.vdot(image, other)) < 1e-6 * np.linalg.norm(image) * np.linalg.norm(other)
    double = jax.tree.map(lambda a: a.astype(np.float64), (sharp, kernels, other))
    for ours, plain in zip(back, both(*double)[1], strict=True):
        np.testing.assert_allclose(ours, plain, atol=2e-6 * np.abs(plain).max())


@pytest.mark.parametrize("whole", [False, True])
def test_derivatives(whole):
    sharp, kernels = problem((20, 23), 5, 2, jnp.float64)
    function = jax.jit(partial(sum_of_convolutions, whole=whole))
    check_grads(function, (sharp, kernels), order=1, eps=1e-3, atol=1e-9, rtol=1e-9)
    by_kernels = jax.jit(jax.grad(lambda sharp, kernels: (sum_of_convolutions(sharp, kernels) ** 2).sum(), argnums=1))
    np.testing.assert_allclose(by_kernels(*problem((20, 23), 5, 2)), by_kernels(sharp, kernels), rtol=1e-4)


def test_dark_tiles_are_skipped():
    sharp, kernels = problem((600, 400), 9, 2)
    lit, run = np.where(np.arange(600)[:, None] < 200, sharp[0], 0), jax.jit(sum_of_convolutions)
    image = np.asarray(run((lit, np.zeros_like(lit)), kernels))
    right = expected((lit,), kernels[:1], whole=False)
    np.testing.assert_allclose(image, right, atol=2e-6 * np.abs(right).max())
    # Exactly: tiles keep 240 lines.
    assert not np.any(image[240:])
    wrong = sharp[0].copy()
    wrong[300, 100] = np.nan
    assert np.isnan(run((wrong, lit), kernels)).any()


def comparisons():
    test_the_sum_is_scipys(*SIZES[1], whole=False, dtype=jnp.float32)
    test_adjoint(whole=False)


def test_upsampling_is_a_sinc():
    n = np.arange(64)
    wave = lambda place: np.cos(2 * np.pi * 5 * place / 64)
    coarse = wave(n)[:, None] * wave(n)[None]
    # The middle of the first fine pixel is a quarter of a large one before that of its large one.
    place = wave(6 - 0.25 + np.arange(100) / 2)
    fine = jax.jit(upsample_by_two, static_argnums=(1, 2))(coarse, 6, (100, 100))
    np.testing.assert_allclose(fine, place[:, None] * place[None] / 4, atol=1e-12)
