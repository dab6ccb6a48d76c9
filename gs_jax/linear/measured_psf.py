"""Imaging through a measured stack of PSFs: one shift-invariant PSF for each plane, and a sensor that crops the sum.

A sensor sees only a part of the light that a diffuser or lens array casts, also from points beyond its edges. So the
scene is larger than the image: it holds every point whose PSF reaches the sensor, and the image is the middle of the
sum of its planes' convolutions (Antipa et al., DiffuserCam, Optica 5, 1, 2018). PSFs that vary over the field are
convolutions with a few kernels, weighted by smooth maps.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import ShapeDtypeStruct, lax
from jaxtyping import Array, Complex, Float, Num

from ..base.arrays import as_float, as_shape, native
from ..base.errors import InputError
from .fourier import centred_spectrum, fast_length
from .linear_map import LinearMap
from .matrix_free import MatrixFree


class Convolution(MatrixFree):
    """What the operators of measured PSFs share: spectra of kernels, and the window of the sensor in a larger scene.

    `kept`: 1 for pixels that count, 0 for those that are left out, where images are zero; None keeps all.
    """

    spectra: Complex[Array, "kernel tall half"]
    image_shape: tuple[int, int] = eqx.field(static=True)
    scene_shape: tuple[int, int, int] = eqx.field(static=True)
    kept: Float[Array, "row column"] | None

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the sensor within a plane of the scene."""
        return middle(self.image_shape, self.scene_shape[1:])

    def in_structure(self) -> ShapeDtypeStruct:
        return ShapeDtypeStruct(self.scene_shape, self.spectra.real.dtype)

    def out_structure(self) -> ShapeDtypeStruct:
        return ShapeDtypeStruct(self.image_shape, self.spectra.real.dtype)

    def _image(self, light: Float[Array, "kernel tall wide"]) -> Float[Array, "row column"]:
        """The sum of the light convolved with its kernels, on the pixels that are kept."""
        image = _convolution(_Sizes(self.image_shape, self.scene_shape[1:]), self.spectra, light)
        return image if self.kept is None else self.kept * image


class ConvolutionOperator(Convolution):
    """Imaging through measured PSFs, one for each plane; its transpose `.T` is the exact adjoint.

    *Differentiable.*

    A `lineax` operator like `ImagingOperator`, differentiable also with respect to the PSFs from which it is made. Its
    leaves are their spectra, of the size of the scene. Planes are convolved one after the other, so that no other
    array is of that size. `gs_jax.solve` takes it with every solver, `jax.vmap` maps it over scenes and images.

    Parameters
    ----------
    psf_stack
        Image of a point on the axis at each depth, `(depth, high, wide)`, the point being at `(high // 2, wide // 2)`.
    image_shape
        `(rows, columns)` of the sensor; by default those of the PSFs.
    kept
        1 for pixels that count, 0 for those that are left out, where images are zero. None keeps all.

    Attributes
    ----------
    scene_shape
        `(depth, tall, wide)` of scenes.
    window
        Rows and columns of the sensor within a plane of the scene.

    Raises
    ------
    InputError
        If `psf_stack` is empty or not `(depth, high, wide)`.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> stack = jnp.zeros((2, 20, 30)).at[0, 10, 15].set(1.0).at[1, 10, [5, 25]].set(0.5)
    >>> A = gs.ConvolutionOperator(stack)
    >>> A.in_structure().shape, A.out_structure().shape
    ((2, 40, 60), (20, 30))
    >>> solution = gs.solve(A, jnp.ones((20, 30)), gs.FISTA(steps=10))
    """

    def __init__(
        self,
        psf_stack: Num[Array | np.ndarray, "depth high wide"],
        image_shape: tuple[int, int] | None = None,
        kept: Float[Array | np.ndarray, "row column"] | None = None,
    ):
        psf_stack = jnp.asarray(native(psf_stack))
        if psf_stack.ndim != 3 or min(psf_stack.shape) < 1:
            raise InputError(f"psf_stack must be (depth, row, column) and not empty, got the shape {psf_stack.shape}.")
        self.image_shape = as_shape(image_shape or psf_stack.shape[1:])
        self.spectra, size = _spectra(psf_stack, self.image_shape)
        self.scene_shape = (len(psf_stack), *size)
        self.kept = None if kept is None else jnp.asarray(kept, self.spectra.real.dtype)

    def mv(self, vector: Float[Array | np.ndarray, "depth tall wide"]) -> Float[Array, "row column"]:
        """The image of a scene."""
        return self._image(jnp.asarray(vector, self.spectra.real.dtype))


class _Sizes(NamedTuple):
    image: tuple[int, int]
    scene: tuple[int, int]


def _convolve(sizes: _Sizes, spectra, scene):
    def add(total, plane):
        light, spectrum = plane
        return total + jnp.fft.rfft2(light) * spectrum, None

    total = lax.scan(add, jnp.zeros_like(spectra[0]), (scene, spectra))[0]
    return jnp.fft.irfft2(total, sizes.scene)[middle(*sizes)]


def _correlate(sizes: _Sizes, spectra, image):
    spectrum = jnp.fft.rfft2(jnp.zeros(sizes.scene, image.dtype).at[middle(*sizes)].set(image))
    return lax.map(lambda psf: jnp.fft.irfft2(spectrum * psf.conj(), sizes.scene), spectra)


_convolution = LinearMap(_convolve, _correlate)


def _spectra(kernels: Num[Array | np.ndarray, "kernel high wide"], image_shape: tuple[int, int]):
    """Spectra of kernels on the smallest scene that holds all points whose light reaches the sensor, and its size."""
    kernels = jnp.asarray(native(kernels))
    kernels = kernels if jnp.issubdtype(kernels.dtype, jnp.floating) else kernels.astype(float)
    size = scene_size(image_shape, kernels.shape[1:])
    return lax.map(lambda plane: centred_spectrum(plane, size), kernels), size


def warp_psf(
    psf: Float[Array, "high wide"], scale: Float[Array, ""], blur: Float[Array, ""]
) -> Float[Array, "high wide"]:
    """Scale a PSF about its point, and blur it; its sum stays.

    *Differentiable.*

    Parameters
    ----------
    psf
        Image of a point at `(high // 2, wide // 2)`.
    scale
        Magnification.
    blur
        Standard deviation of a Gaussian, pixels; at 0 the derivative is 0.
    """
    middle = jnp.array([n // 2 + 0.5 for n in psf.shape], psf.dtype)
    scales, translation = jnp.stack([scale, scale]), middle * (1 - scale)
    moved = jax.image.scale_and_translate(psf, psf.shape, (0, 1), scales, translation, "lanczos3", antialias=False)
    down, across = (np.fft.fftfreq(psf.shape[0]), np.fft.rfftfreq(psf.shape[1]))
    squares = jnp.asarray(2 * np.pi**2 * (down[:, None] ** 2 + across**2), psf.dtype)
    spectrum, passed = jnp.fft.rfft2(moved), jnp.exp(-(blur**2) * squares)
    blurred = jnp.fft.irfft2(lax.complex(passed * spectrum.real, passed * spectrum.imag), psf.shape)
    return blurred * (psf.sum() / blurred.sum())


def scene_size(image_shape: tuple[int, ...], psf_shape: tuple[int, ...]) -> tuple[int, int]:
    """Smallest size of fast FFTs that holds every point whose PSF reaches the sensor."""
    rows, columns = (fast_length(n + k - 1) for n, k in zip(image_shape, psf_shape, strict=True))
    return rows, columns


def middle(image_shape: tuple[int, int], size: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of a sensor within a plane of a scene."""
    corner = [(n - m) // 2 for n, m in zip(size, image_shape, strict=True)]
    rows, columns = (slice(a, a + m) for a, m in zip(corner, image_shape, strict=True))
    return rows, columns


class FieldConvolutionOperator(Convolution):
    """Imaging through PSFs that vary over the field: the image is the sum of `kernel * (weight scene)` over components.

    *Differentiable.*

    A `lineax` operator; its transpose `.T` is the exact adjoint. So few components describe the PSF
    everywhere when it varies smoothly (Flicker and Rigaut, J. Opt. Soc. Am. A 22, 504, 2005; of random multifocal
    masks: Yanny et al., Light Sci. Appl. 9, 171, 2020). `fit_field` of `gs_jax.reconstruction.field_fit` finds them.

    Parameters
    ----------
    kernels
        Of each plane, the component's point being at `(high // 2, wide // 2)`.
    weights
        Of each component over the scene, whose size is that of `scene_size(image_shape, (high, wide))`.
    image_shape
        `(rows, columns)` of the sensor.
    """

    weights: Float[Array, "depth component down across"]

    def __init__(
        self,
        kernels: Float[Array | np.ndarray, "depth component high wide"],
        weights: Float[Array | np.ndarray, "depth component down across"],
        image_shape: tuple[int, int],
    ):
        self.image_shape, self.kept = as_shape(image_shape), None
        self.spectra, size = _spectra(kernels.reshape(-1, *kernels.shape[2:]), self.image_shape)
        self.scene_shape = (len(kernels), *size)
        self.weights = as_float(weights).astype(self.spectra.real.dtype)
        if self.weights.shape != (expected := (*kernels.shape[:2], *size)):
            raise ValueError(f"`weights` must be {expected}, got {self.weights.shape}.")

    def mv(self, vector: Float[Array | np.ndarray, "depth tall wide"]) -> Float[Array, "row column"]:
        """The image of a scene."""
        light = self.weights * jnp.asarray(vector, self.weights.dtype)[:, None]
        return self._image(light.reshape(-1, *self.scene_shape[1:]))
