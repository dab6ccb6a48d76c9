"""Shift-invariant imaging by a measured PSF, as convolution and crop, and its ADMM solver with an exact x-step.

A sensor sees only a part of the light that a diffuser or lens array casts, also from points beyond its edges. So the
scene is larger than the image: it holds every point whose PSF reaches the sensor, and the image is the middle of its
convolution (Antipa et al., DiffuserCam, Optica 5, 1, 2018).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from ..base.arrays import divide, safe_sqrt
from ..typing import Image, Real
from .admm import Regularizer, Splitting, advance, positive_or_one
from .base import as_image, check_options

# Initial penalty of the convolved scene, relative to the image's weight. With 1 or 0.01 the cost falls more slowly, on
# DiffuserCam's image and on random ones.
_INITIAL_PENALTY = 0.1


class Convolution(eqx.Module):
    """Convolution with a PSF for each depth, stored as spectra on the scene's grid. Make it with `of`."""

    spectra: Complex[Array, "depth tall half"]
    image_shape: tuple[int, int] = eqx.field(static=True)
    scene_shape: tuple[int, int, int] = eqx.field(static=True)

    @classmethod
    def of(cls, psf: Float[Array | np.ndarray, "depth high wide"], image_shape: tuple[int, int]) -> "Convolution":
        """Convolution with a measured PSF.

        Parameters
        ----------
        psf
            Image of a point on the axis at each depth, the point being at `(high // 2, wide // 2)`.
        image_shape
            `(rows, columns)` of the images.

        Raises
        ------
        ValueError
            If `psf` is empty or not `(depth, row, column)`.
        """
        if psf.ndim != 3 or min(psf.shape) < 1:
            raise ValueError(f"`psf` must be (depth, row, column) and not empty, got {psf.shape}.")
        from scipy.fft import next_fast_len  # imported here: solvers without FFTs do not need SciPy

        size = [int(next_fast_len(n + k - 1, real=True) or 0) for n, k in zip(image_shape, psf.shape[1:], strict=True)]
        padded = jnp.pad(jnp.asarray(psf), [(0, 0), *((0, n - k) for n, k in zip(size, psf.shape[1:], strict=True))])
        centred = jnp.roll(padded, [-(k // 2) for k in psf.shape[1:]], (1, 2))
        rows, columns = image_shape
        return cls(jnp.fft.rfft2(centred), (rows, columns), (len(psf), size[0], size[1]))

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the image within a plane of the scene."""
        corner = [(n - m) // 2 for n, m in zip(self.scene_shape[1:], self.image_shape, strict=True)]
        rows, columns = (slice(a, a + m) for a, m in zip(corner, self.image_shape, strict=True))
        return rows, columns

    def __call__(self, scene: Float[Array | np.ndarray, "depth tall wide"]) -> Float[Array, "row column"]:
        """Image of a scene of `scene_shape`."""
        spectrum = jnp.sum(jnp.fft.rfft2(scene) * self.spectra, axis=0)
        return jnp.fft.irfft2(spectrum, s=self.scene_shape[1:])[self.window]

    @property
    def operator(self) -> lx.AbstractLinearOperator:
        """`lineax` operator for any solver; its transpose is exact."""
        scene = jax.ShapeDtypeStruct(self.scene_shape, self.spectra.real.dtype)
        return lx.FunctionLinearOperator(eqx.Partial(type(self).__call__, self), scene)


class State(NamedTuple):
    """State of `ConvolutionADMM`.

    `gain` is the scale by which the system is divided, `spectrum` the spectrum of the divided system, and
    `inverse_spectrum` that of the inverse of the x-step's matrix.
    """

    splitting: Splitting
    regularizer: Regularizer
    gain: Array
    spectrum: Array
    inverse_spectrum: Array


class ConvolutionADMM(eqx.Module):
    """ADMM for a `Convolution`, with an exact x-step by four FFTs; cost, parameters and errors as for `ADMM`.

    As in DiffuserCam (Antipa et al., Optica 5, 1, 2018) the convolved scene is split too, which separates the crop to
    the sensor from the convolution. The steps are not over-relaxed: with 1.6 or 1.8 the cost of DiffuserCam's image
    falls more slowly. Differences are periodic, in depth too. The estimate has `system.scene_shape`;
    `system.window` is the image's place in it.

    The convolved scene has its own penalty `rho / gain^2`, where `gain^2` is the geometric mean of the largest and the
    mean eigenvalue of `A'A`. For one split the best penalty is the geometric mean of the extreme eigenvalues (Ghadimi
    et al., IEEE Trans. Autom. Control 60, 644, 2015); the smallest of a diffuser is 0, hence the mean. With the mean
    alone, low spatial frequencies, up to `max / mean` times as strong (4e5 for 2 million pixels), outweigh the
    regularizer, which then acts slowly.
    """

    steps: int = eqx.field(static=True, default=20)
    tolerance: float = eqx.field(static=True, default=0.0)
    sparsity: Real | Float[Array, ""] = 0.01
    tv: Real | Float[Array, ""] = 0.0
    isotropic: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check_options(self)

    def init(self, system: Convolution, image: Image) -> State:
        A = system.operator
        regularizer = Regularizer.of(self, A.T.mv(as_image(A, image)), wrap=True)
        shape, axes = system.scene_shape, _axes(system)
        # The sum of 2-D convolutions is plane 0 of a 3-D convolution with the PSF's depths reversed.
        backwards = jnp.roll(system.spectra[::-1], 1, axis=0)
        spectrum = jnp.fft.fft(backwards, axis=0) if shape[0] > 1 else backwards
        power = jnp.abs(spectrum) ** 2
        gain = safe_sqrt(safe_sqrt(jnp.mean(power) * jnp.max(power)))
        spectrum = _scale(divide(jnp.ones_like(gain), gain), spectrum)
        laplacian = _laplacian_spectrum(shape, axes, gain.dtype)[..., : spectrum.shape[-1]]
        inverse_spectrum = 1 / (jnp.abs(spectrum) ** 2 + regularizer.splits_differences * laplacian + 1)
        x = jnp.zeros(shape, gain.dtype)
        splitting = Splitting.start(x, (x, *regularizer.split(x)), positive_or_one(_INITIAL_PENALTY * gain**2))
        return State(splitting, regularizer, gain, spectrum, inverse_spectrum)

    def step(self, system: Convolution, image: Image, state: State) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        image = as_image(system.operator, image)
        splitting, regularizer, gain, spectrum, inverse_spectrum = state
        shape, axes = system.scene_shape, _axes(system)
        transform = lambda x: jnp.fft.rfftn(x, axes=axes)
        inverse = lambda f: jnp.fft.irfftn(f, s=[shape[axis] for axis in axes], axes=axes)
        window = (0, *system.window)

        def update(x, target, rho):
            v, *rest = target
            right_side = spectrum.conj() * transform(v) + transform(regularizer.adjoint(rest))
            solution = _scale(inverse_spectrum, right_side)
            x = inverse(solution)
            return x, (inverse(spectrum * solution), *regularizer.split(x))

        def prox(split, rho):
            v, *rest = split
            measured = (rho * v[window] + gain * image) / (rho + gain**2)
            return v.at[window].set(measured), *regularizer.prox(rest, rho)

        def cost(x, split):
            v, *rest = split
            residual = gain * v[window] - image
            return jnp.vdot(residual, residual) / 2 + regularizer.cost(rest)

        splitting, now, residual = advance(splitting, update, prox, cost)
        return state._replace(splitting=splitting), now, residual

    def estimate(self, state: State) -> Float[Array, "depth tall wide"]:
        return state.splitting.z[-1]


def _axes(system):
    return (0, 1, 2) if system.scene_shape[0] > 1 else (1, 2)


def _scale(factor, spectrum):
    # Complex times real would convert the factor to a complex number.
    return lax.complex(factor * spectrum.real, factor * spectrum.imag)


def _laplacian_spectrum(shape, axes, dtype):
    """Eigenvalues of `D'D` with periodic differences: `2 - 2 cos(2 pi k / n)`, summed over the axes."""
    total = jnp.zeros((1, 1, 1), dtype)
    for axis in axes:
        angle = 2 * jnp.pi * jnp.arange(shape[axis], dtype=dtype) / shape[axis]
        total = total + (2 - 2 * jnp.cos(angle)).reshape([-1 if a == axis else 1 for a in range(3)])
    return total
