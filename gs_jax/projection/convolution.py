"""Sums of convolutions with small kernels: in tiles that stay in a CPU's cache, else by FFTs of whole images."""

import operator
from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import ShapeDtypeStruct, lax
from jaxtyping import Array, Float

from ..linear.fourier import fast_length, kernel_spectrum
from ..linear.linear_map import LinearMap
from ..microscope.geometry import Imager
from ..microscope.grid import Sensor
from .cpu.loading import kernels


def with_margin(imager: Imager, size: int) -> Imager:
    """The imager with a larger sensor, which holds all light that a kernel of this size spreads onto the true one.

    The margin is half a kernel and one line each way, as rays that land there share their light with the next line.
    """
    rows, columns = imager.sensor.shape
    wide = Sensor((rows + size + 1, columns + size + 1), imager.sensor.pixel_pitch, imager.sensor.origin)
    return eqx.tree_at(lambda i: i.sensor, imager, wide)


class Sizes(NamedTuple):
    """Shapes of the sum and of the sharp images; `whole` and `symmetric` as for `sum_of_convolutions`."""

    image: tuple[int, int]
    sharp: tuple[int, int]
    whole: bool
    symmetric: bool


def sum_of_convolutions(
    sharp: Sequence[Float[Array, "wide_rows wide_columns"]],
    kernels: Float[Array, "image size size"],
    *,
    whole: bool = False,
    symmetric: bool = False,
) -> Float[Array, "rows columns"]:
    """The sum of sharp images `with_margin`, each convolved with its kernel.

    Parameters
    ----------
    sharp, kernels
        As many of both, the kernels of odd size.
    whole
        Return all that is not zero, `wide + size - 1` lines each way from `size` lines before the sensor, and not only
        the sensor.
    symmetric
        The kernels are their own mirror images up and down and left and right, which saves time.
    """
    size = kernels.shape[-1]
    change = size - 1 if whole else -size - 1
    rows, columns = sharp[0].shape
    sizes = Sizes((rows + change, columns + change), (rows, columns), whole, symmetric)
    return _convolution(sizes, kernels, tuple(sharp))


def _convolve(sizes: Sizes, kernels, sharp):
    """By FFTs of whole images. What wraps round falls on lines that are not returned."""
    half = kernels.shape[-1] // 2
    if sizes.whole:
        fit, first, need = (lambda image: jnp.pad(image, [(half, 0), (half, 0)])), 0, sizes.image
    else:
        fit, first, need = (lambda image: image[1:-1, 1:-1]), half, [n - 2 for n in sizes.sharp]
    padded = rows, columns = [fast_length(n, even=True) for n in need]
    place = np.arange(-half, half + 1)
    down, across = np.arange(rows)[:, None] * place / rows, np.arange(columns // 2 + 1)[:, None] * place / columns

    def product(image, kernel):
        image_spectrum = jnp.fft.rfft2(fit(image), padded)
        real, imaginary = kernel_spectrum(kernel, down, across, symmetric=sizes.symmetric)
        if imaginary is None:
            return lax.complex(image_spectrum.real * real, image_spectrum.imag * real)
        return image_spectrum * lax.complex(real, imaginary)

    total = reduce(operator.add, map(product, sharp, kernels))
    return jnp.fft.irfft2(total, padded)[first : first + sizes.image[0], first : first + sizes.image[1]]


def _correlate(sizes: Sizes, kernels, image):
    sharp = [ShapeDtypeStruct(sizes.sharp, image.dtype)] * len(kernels)
    return jax.linear_transpose(lambda sharp: _convolve(sizes, kernels, sharp), tuple(sharp))(image)[0]


def _kernels_vjp(sizes, kernels, sharp, image):
    return jax.vjp(lambda kernels: _convolve(sizes, kernels, sharp), kernels)[1](image)[0]


_convolution = LinearMap(_convolve, _correlate, _kernels_vjp, kernels("convolve", "correlate"))
