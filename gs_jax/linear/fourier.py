"""Fourier transforms of images and of convolution kernels."""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Complex, Float


def phasor(length: ArrayLike, phase: Array) -> Complex[Array, "..."]:
    """`length exp(i phase)`, in the phase's precision."""
    return lax.complex(length * jnp.cos(phase), length * jnp.sin(phase))


def fast_length(lines: int, *, even: bool = False) -> int:
    """Smallest length of fast FFTs of real numbers that holds so many lines, or smallest even one."""
    from scipy.fft import next_fast_len  # imported here: back-projection needs no FFT and no SciPy

    factor = 2 if even else 1
    return factor * int(next_fast_len(-(-lines // factor), real=True) or 0)


def kernel_spectrum(kernel, down, across, *, symmetric=False):
    """Real and imaginary part of a kernel's spectrum, or the real part and None for a symmetric kernel.

    `down` and `across` are turns `(frequency, line)`. Two matrix products cost less than an FFT of the padded kernel.
    """

    def matrix(function, turns):
        return jnp.asarray(function(2 * np.pi * (turns % 1)), kernel.dtype)

    cosines, sines = matrix(np.cos, down) @ kernel, matrix(np.sin, down) @ kernel
    by_cosine, by_sine = matrix(np.cos, across).T, matrix(np.sin, across).T
    if symmetric:
        return cosines @ by_cosine, None
    return cosines @ by_cosine - sines @ by_sine, -(sines @ by_cosine + cosines @ by_sine)


def centred_spectrum(psf: Float[Array, "high wide"], size: tuple[int, int]) -> Complex[Array, "tall half"]:
    """Spectrum of a PSF that is padded to a size, its middle at the origin."""
    padded = jnp.pad(psf, [(0, n - k) for n, k in zip(size, psf.shape, strict=True)])
    return jnp.fft.rfft2(jnp.roll(padded, [-(k // 2) for k in psf.shape], (0, 1)))


def upsample_by_two(
    coarse: Float[Array, "short narrow"], first: int, shape: tuple[int, int]
) -> Float[Array, "row column"]:
    """An image on pixels half as large, by sinc interpolation, with the same sum.

    Returns `shape` pixels, of which the first is in the large pixel number `first`, each way.
    """
    rows, columns = (fast_length(n, even=True) for n in coarse.shape)
    # Without the highest frequencies of an even number of pixels, which have no sign.
    low, kept = rows // 2, columns // 2
    across, down = jnp.arange(kept), jnp.concatenate([jnp.arange(low), jnp.arange(low - rows, 0)])

    def turn(frequency, size):
        return phasor(1, (-np.pi * 0.5 / size) * frequency.astype(coarse.dtype))

    spectrum = jnp.fft.rfft2(coarse, (rows, columns))
    moved = spectrum[:, :kept] * turn(down, rows)[:, None] * turn(across, columns)[None]
    wide = [(0, 0), (0, columns + 1 - kept)]
    spectrum = jnp.concatenate(
        [jnp.pad(moved[:low], wide), jnp.zeros((rows + 1, columns + 1), moved.dtype), jnp.pad(moved[low + 1 :], wide)]
    )
    start = 2 * first
    return jnp.fft.irfft2(spectrum, (2 * rows, 2 * columns))[start : start + shape[0], start : start + shape[1]]
