"""Sums of convolutions with small kernels, by one inverse transform for all of them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from ..geometry import Imager, Sensor
from ..optics.exit_pupil import phasor


def with_margin(imager: Imager, size: int) -> Imager:
    """The imager with a sensor that holds what a kernel of this size spreads onto the true one.

    Sharp images up to half a kernel beyond the sensor, whose light spreads onto it, and a line more each way, as rays
    that land there share their light with the next.
    """
    rows, columns = imager.sensor.shape
    wide = Sensor((rows + size + 1, columns + size + 1), imager.sensor.pixel_pitch, imager.sensor.origin)
    return eqx.tree_at(lambda i: i.sensor, imager, wide)


def padded_shape(sensor: Sensor, size: int) -> tuple[int, int]:
    """Of the transforms, even. What wraps round falls on the first `size - 1` lines, which are beyond the sensor."""
    from scipy.fft import next_fast_len  # here, so that back-projection, which transforms nothing, does without SciPy

    rows, columns = (2 * int(next_fast_len(-(-(n + size - 1) // 2), real=True) or 0) for n in sensor.shape)
    return rows, columns


def add_spectrum(
    spectrum: Complex[Array, "tall half"],
    sharp: Float[Array, "row column"],
    kernel: Float[Array, "size size"],
    padded: tuple[int, int],
) -> Complex[Array, "tall half"]:
    """Adds the convolution of a sharp image `with_margin` and a kernel."""
    rows, columns = padded
    # A kernel is nearly all padding: along the columns only its own are transformed.
    of_kernel = jnp.fft.fft(jnp.fft.rfft(kernel, columns, axis=1), rows, axis=0)
    return spectrum + jnp.fft.rfft2(sharp[1:-1, 1:-1], padded) * of_kernel


def add_symmetric_spectrum(
    spectrum: Complex[Array, "tall half"],
    sharp: Float[Array, "row column"],
    kernel: Float[Array, "size size"],
    padded: tuple[int, int],
) -> Complex[Array, "tall half"]:
    """`add_spectrum` for a kernel that is its own mirror image up and down and left and right, in less time.

    About its middle such a kernel has a real spectrum, two small products of matrices. Everything comes out
    `size // 2` lines nearer to the start than with `add_spectrum`.
    """
    rows, columns = padded
    half = kernel.shape[0] // 2
    quarter = kernel[half:, half:]
    of_kernel = (
        _cosines(rows, rows, half, kernel.dtype) @ quarter @ _cosines(columns // 2 + 1, columns, half, kernel.dtype).T
    )
    image = jnp.fft.rfft2(sharp[1:-1, 1:-1], padded)
    return spectrum + lax.complex(image.real * of_kernel, image.imag * of_kernel)


def _cosines(frequencies, size, half, dtype):
    place = np.arange(half + 1)
    turns = (np.arange(frequencies)[:, None] * place) % size / size
    return jnp.asarray(np.where(place > 0, 2, 1) * np.cos(2 * np.pi * turns), dtype)


def image_of(
    spectrum: Complex[Array, "tall half"], sensor: Sensor, first: int, padded: tuple[int, int]
) -> Float[Array, "row column"]:
    """The sum of all convolutions, on the sensor, whose first line is the `first` of the sum."""
    rows, columns = sensor.shape
    return jnp.fft.irfft2(spectrum, padded)[first : first + rows, first : first + columns]


def add_halved(
    spectrum: Complex[Array, "tall half"], coarse: Complex[Array, "short quarter"], padded: tuple[int, int], first: int
) -> Complex[Array, "tall half"]:
    """Adds the spectrum of an image on pixels twice as large, interpolated without more blur (sinc).

    Its large pixel 0 covers the pixels `first` and `first + 1` of the other.
    """
    rows, columns = (n // 2 for n in padded)
    low, dtype = rows // 2, spectrum.real.dtype
    # Left out are the highest frequencies of an even number of pixels, which have no sign.
    kept = (columns - 1) // 2 + 1
    across, down = jnp.arange(kept), jnp.concatenate([jnp.arange(low), jnp.arange(low - rows, 0)])
    turn = lambda frequency, size: phasor(1, (-2 * np.pi * (first + 0.5) / size) * frequency.astype(dtype))
    moved = coarse[:, :kept] * turn(down, padded[0])[:, None] * turn(across, padded[1])[None]
    spectrum = spectrum.at[:low, :kept].add(moved[:low])
    return spectrum.at[padded[0] - (rows - low) + 1 :, :kept].add(moved[low + 1 :])
