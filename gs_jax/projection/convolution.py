"""Sums of convolutions with small kernels: on a processor in tiles that stay in the cache, else by large transforms."""

import operator
from collections.abc import Sequence
from functools import cache, reduce
from inspect import unwrap
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import ShapeDtypeStruct, lax
from jaxtyping import Array, Float

from ..geometry import Imager, Sensor
from ..optics.diffraction import phasor
from .cpu import dispatch as native
from .cpu.dispatch import native_on_cpu
from .linear_map import linear_call


def with_margin(imager: Imager, size: int) -> Imager:
    """The imager with a sensor that holds what a kernel of this size spreads onto the true one.

    Sharp images up to half a kernel beyond the sensor, whose light spreads onto it, and a line more each way, as rays
    that land there share their light with the next.
    """
    rows, columns = imager.sensor.shape
    wide = Sensor((rows + size + 1, columns + size + 1), imager.sensor.pixel_pitch, imager.sensor.origin)
    return eqx.tree_at(lambda i: i.sensor, imager, wide)


class Sizes(NamedTuple):
    """Of a sharp image `with_margin` and of a sum: the sensor's, or with `whole` all that kernels spread light to.

    All of it begins `size` lines before the sensor.
    """

    image: tuple[int, int]
    sharp: tuple[int, int]
    whole: bool
    symmetric: bool


def convolved(
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
        Return all that is not zero, `wide + size - 1` lines each way, and not only what is on the sensor.
    symmetric
        The kernels are their own mirror images up and down and left and right, which saves time.
    """
    size = kernels.shape[-1]
    change = size - 1 if whole else -size - 1
    rows, columns = sharp[0].shape
    sizes = Sizes((rows + change, columns + change), (rows, columns), whole, symmetric)
    return linear_call(_convolve, _correlate, _kernels_bar, sizes, kernels, tuple(sharp))


def _convolve_natively(sizes, kernels, sharp):
    size = kernels.shape[-1]
    (image,) = _overlap_save(kernels[:, ::-1, ::-1], sharp, [sizes.image], 1 - size if sizes.whole else 1)
    return image


def _correlate_natively(sizes, kernels, image):
    shift = 0 if sizes.whole else -kernels.shape[-1]
    return tuple(_overlap_save(kernels, (image,), [sizes.sharp] * len(kernels), shift))


@native_on_cpu("overlap_save", _convolve_natively)
def _convolve(sizes: Sizes, kernels, sharp):
    """By transforms of whole images. What wraps round falls on lines that are not returned."""
    half = kernels.shape[-1] // 2
    if sizes.whole:
        fit, first, need = (lambda image: jnp.pad(image, [(half, 0), (half, 0)])), 0, sizes.image
    else:
        fit, first, need = (lambda image: image[1:-1, 1:-1]), half, [n - 2 for n in sizes.sharp]
    padded = rows, columns = [_fast_length(n) for n in need]
    place = np.arange(-half, half + 1)
    down, across = np.arange(rows)[:, None] * place / rows, np.arange(columns // 2 + 1)[:, None] * place / columns

    def product(image, kernel):
        of_image = jnp.fft.rfft2(fit(image), padded)
        real, imaginary = _spectrum(kernel, down, across, symmetric=sizes.symmetric)
        if imaginary is None:
            return lax.complex(of_image.real * real, of_image.imag * real)
        return of_image * lax.complex(real, imaginary)

    spectrum = reduce(operator.add, map(product, sharp, kernels))
    return jnp.fft.irfft2(spectrum, padded)[first : first + sizes.image[0], first : first + sizes.image[1]]


@native_on_cpu("overlap_save", _correlate_natively)
def _correlate(sizes: Sizes, kernels, image):
    sharp = [ShapeDtypeStruct(sizes.sharp, image.dtype)] * len(kernels)
    (found,) = jax.linear_transpose(lambda sharp: unwrap(_convolve)(sizes, kernels, sharp), tuple(sharp))(image)
    return found


def _kernels_bar(sizes, kernels, sharp, image):
    plain = lambda kernels: unwrap(_convolve)(sizes, kernels, sharp)
    return jax.vjp(plain, kernels)[1](image)[0]


def _spectrum(kernel, down, across, *, symmetric=False):
    """Real and imaginary parts at some turns `(frequency, line)` each way; only the first if the kernel is symmetric.

    A kernel is nearly all padding: two products of matrices are less than a transform.
    """
    matrix = lambda function, turns: jnp.asarray(function(2 * np.pi * (turns % 1)), kernel.dtype)
    cosines, sines = matrix(np.cos, down) @ kernel, matrix(np.sin, down) @ kernel
    by_cosine, by_sine = matrix(np.cos, across).T, matrix(np.sin, across).T
    if symmetric:
        return cosines @ by_cosine, None
    return cosines @ by_cosine - sines @ by_sine, -(sines @ by_cosine + cosines @ by_sine)


def _overlap_save(kernels, images, shapes, shift):
    """By `tiles.overlap_save`: sums of such shapes, of the images from `shift` on, correlated with the kernels."""
    size = kernels.shape[-1]
    side = _side(size)
    frequencies = _order(side)
    turns = -frequencies[:, None] * np.arange(size) / side
    real, imaginary = jax.vmap(lambda kernel: _spectrum(kernel, turns, turns))(kernels)
    strips = lambda part: part.reshape(len(kernels), -1, native.WIDTH, side).swapaxes(2, 3)
    spectra = jnp.stack([strips(real), strips(imaginary)], 2).reshape(len(kernels), 2 * side, side) / side**2
    angles = 2 * np.pi * np.arange(side) / side
    plan = np.array([len(images), len(shapes), shift, (side - size + 1) // native.WIDTH * native.WIDTH], np.int32)
    results = [ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    table = np.stack([np.cos(angles), np.sin(angles)], -1).astype(np.float32)
    return native.call("overlap_save", results, plan, table, spectra, *images)


def _side(size):
    """Of the tiles: larger ones waste less at their edges, and outgrow the cache."""
    side = 256
    while side < 3 * size:
        side *= 2
    return side


@cache
def _order(side: int) -> np.ndarray:
    """Which frequency is where after transforms by fours."""
    if side <= 2:
        return np.arange(side)
    return (4 * _order(side // 4)[None] + np.arange(4)[:, None]).ravel()


def _fast_length(lines: int) -> int:
    from scipy.fft import next_fast_len  # here, so that back-projection, which transforms nothing, does without SciPy

    return 2 * int(next_fast_len(-(-lines // 2), real=True) or 0)


def doubled(coarse: Float[Array, "short narrow"], first: int, shape: tuple[int, int]) -> Float[Array, "row column"]:
    """An image on pixels half as large, interpolated without more blur (sinc); what it is made of sums up to the same.

    Returned are `shape` pixels, of which the first is in the large pixel number `first`, each way.
    """
    rows, columns = (_fast_length(n) for n in coarse.shape)
    spectrum = jnp.fft.rfft2(coarse, (rows, columns))
    low = rows // 2
    # Left out are the highest frequencies of an even number of pixels, which have no sign.
    kept = columns // 2
    turn = lambda frequency, size: phasor(1, (-np.pi * 0.5 / size) * frequency.astype(coarse.dtype))
    across, down = jnp.arange(kept), jnp.concatenate([jnp.arange(low), jnp.arange(low - rows, 0)])
    moved = spectrum[:, :kept] * turn(down, rows)[:, None] * turn(across, columns)[None]
    wide = [(0, 0), (0, columns + 1 - kept)]
    spectrum = jnp.concatenate(
        [jnp.pad(moved[:low], wide), jnp.zeros((rows + 1, columns + 1), moved.dtype), jnp.pad(moved[low + 1 :], wide)]
    )
    start = 2 * first
    return jnp.fft.irfft2(spectrum, (2 * rows, 2 * columns))[start : start + shape[0], start : start + shape[1]]


def image_in_groups(add, image, planes, together: int):
    """`add(image, group)` over consecutive groups of so many planes; the last may have less."""
    count = len(jax.tree.leaves(planes)[0])
    whole = count // together * together
    grouped = jax.tree.map(lambda a: a[:whole].reshape(-1, together, *a.shape[1:]), planes)
    image = lax.scan(lambda image, group: (add(image, group), None), image, grouped)[0] if whole else image
    return add(image, jax.tree.map(lambda a: a[whole:], planes)) if whole < count else image
