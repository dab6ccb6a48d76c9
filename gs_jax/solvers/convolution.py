"""A shift-invariant imaging system from a measured point spread function: convolution by FFT, and cropping.

A sensor sees only a part of what a diffuser or lens array casts, also from beyond its own edges. So the scene is
larger than the image: it holds every point whose PSF reaches the sensor, and the image is the middle of its
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
from .admm import Prior, Splitting, advance, or_one
from .base import as_image, check_options


class Convolution(eqx.Module):
    """A PSF for each depth, as spectra on the scene's grid. Make it with `of`."""

    spectra: Complex[Array, "depth tall half"]
    image_shape: tuple[int, int] = eqx.field(static=True)
    scene_shape: tuple[int, int, int] = eqx.field(static=True)

    @classmethod
    def of(cls, psf: Float[Array | np.ndarray, "depth high wide"], image_shape: tuple[int, int]) -> "Convolution":
        """The system of a measured PSF.

        Parameters
        ----------
        psf
            The image of a point on the axis at each depth, with the point's place at `(high // 2, wide // 2)`.
        image_shape
            `(rows, columns)` of the images.

        Raises
        ------
        ValueError
            If `psf` is not `(depth, row, column)`, or empty.
        """
        if psf.ndim != 3 or min(psf.shape) < 1:
            raise ValueError(f"`psf` must be (depth, row, column) with a pixel at least, got {psf.shape}.")
        from scipy.fft import next_fast_len  # here, so that solvers that transform nothing do without SciPy

        size = [int(next_fast_len(n + k - 1, real=True) or 0) for n, k in zip(image_shape, psf.shape[1:], strict=True)]
        padded = jnp.pad(jnp.asarray(psf), [(0, 0), *((0, n - k) for n, k in zip(size, psf.shape[1:], strict=True))])
        centred = jnp.roll(padded, [-(k // 2) for k in psf.shape[1:]], (1, 2))
        rows, columns = image_shape
        return cls(jnp.fft.rfft2(centred), (rows, columns), (len(psf), size[0], size[1]))

    @property
    def place(self) -> tuple[slice, slice]:
        """Where the image lies within a plane of the scene."""
        corner = [(n - m) // 2 for n, m in zip(self.scene_shape[1:], self.image_shape, strict=True)]
        rows, columns = (slice(a, a + m) for a, m in zip(corner, self.image_shape, strict=True))
        return rows, columns

    def __call__(self, scene: Float[Array | np.ndarray, "depth tall wide"]) -> Float[Array, "row column"]:
        """The image of a scene of `scene_shape`."""
        spectrum = jnp.sum(jnp.fft.rfft2(scene) * self.spectra, axis=0)
        return jnp.fft.irfft2(spectrum, s=self.scene_shape[1:])[self.place]

    @property
    def operator(self) -> lx.AbstractLinearOperator:
        """The same as a `lineax` operator, for any solver; its transpose is exact."""
        scene = jax.ShapeDtypeStruct(self.scene_shape, self.spectra.real.dtype)
        return lx.FunctionLinearOperator(eqx.Partial(type(self).__call__, self), scene)


# The first penalty of the convolved scene, in parts of the image's weight. Measured: with 1 or 0.01 the cost falls more
# slowly, on DiffuserCam's image and on random ones.
_START = 0.1


class State(NamedTuple):
    """Of `ConvolutionADMM`: the splitting, what is known of the scene, and the system divided by its gain.

    `spectrum` is the divided system's, `solvent` the inverse of the x-step's matrix, both in Fourier space.
    """

    splitting: Splitting
    prior: Prior
    gain: Array
    spectrum: Array
    solvent: Array


class ConvolutionADMM(eqx.Module):
    """What `ADMM` minimises, for a `Convolution`; parameters and errors as there.

    The x-step is exact and the steps are not over-relaxed: with 1.6 or 1.8 the cost of DiffuserCam's image falls more
    slowly.

    Differences wrap round the edge of the scene, in depth too. The estimate is of `system.scene_shape`;
    `system.place` says where the image is in it.

    The convolved scene has a penalty of its own, `rho / gain^2`: `gain^2` is the geometric mean of the largest and the
    mean eigenvalue of `A'A`. For one split the best penalty is the geometric mean of the extreme eigenvalues (Ghadimi
    et al., IEEE Trans. Autom. Control 60, 644, 2015); a diffuser's smallest is 0, hence the mean. With the mean alone
    low spatial frequencies, up to `max / mean` (4e5 for 2 million pixels) times as strong, outweigh what is known of
    the scene, which then comes in slowly.
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
        prior = Prior.of(self, A.T.mv(as_image(A, image)), wrap=True)
        shape, axes = system.scene_shape, _axes(system)
        # The sum of 2-D convolutions is plane 0 of a 3-D convolution, with the depths of the PSF in reverse.
        backwards = jnp.roll(system.spectra[::-1], 1, axis=0)
        spectrum = jnp.fft.fft(backwards, axis=0) if shape[0] > 1 else backwards
        power = jnp.abs(spectrum) ** 2
        gain = safe_sqrt(safe_sqrt(jnp.mean(power) * jnp.max(power)))
        spectrum = _times(divide(jnp.ones_like(gain), gain), spectrum)
        curvature = _curvature(shape, axes, gain.dtype)[..., : spectrum.shape[-1]]
        solvent = 1 / (jnp.abs(spectrum) ** 2 + prior.varies * curvature + 1)
        x = jnp.zeros(shape, gain.dtype)
        split = (x, *prior.split(x))
        return State(Splitting.start(x, split, or_one(_START * gain**2)), prior, gain, spectrum, solvent)

    def step(self, system: Convolution, image: Image, state: State) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        image = as_image(system.operator, image)
        splitting, prior, gain, spectrum, solvent = state
        shape, axes = system.scene_shape, _axes(system)
        transform = lambda x: jnp.fft.rfftn(x, axes=axes)
        inverse = lambda f: jnp.fft.irfftn(f, s=[shape[axis] for axis in axes], axes=axes)
        seen = (0, *system.place)

        def update(x, target, rho):
            v, *rest = target
            found = _times(solvent, spectrum.conj() * transform(v) + transform(prior.adjoint(rest)))
            x = inverse(found)
            return x, (inverse(spectrum * found), *prior.split(x))

        def prox(split, rho):
            v, *rest = split
            measured = (rho * v[seen] + gain * image) / (rho + gain**2)
            return v.at[seen].set(measured), *prior.prox(rest, rho)

        def cost(x, split):
            v, *rest = split
            residual = gain * v[seen] - image
            return jnp.vdot(residual, residual) / 2 + prior.cost(rest)

        splitting, now, residual = advance(splitting, update, prox, cost)
        return state._replace(splitting=splitting), now, residual

    def estimate(self, state: State) -> Float[Array, "depth tall wide"]:
        return state.splitting.z[-1]


def _axes(system):
    """Those that are transformed."""
    return (0, 1, 2) if system.scene_shape[0] > 1 else (1, 2)


def _times(factor, spectrum):
    """A real factor times complex numbers, without making the factor complex."""
    return lax.complex(factor * spectrum.real, factor * spectrum.imag)


def _curvature(shape, axes, dtype):
    """Eigenvalues of `D'D` with differences that wrap: `2 - 2 cos(2 pi k / n)`, summed over the axes."""
    total = jnp.zeros((1, 1, 1), dtype)
    for axis in axes:
        angle = 2 * jnp.pi * jnp.arange(shape[axis], dtype=dtype) / shape[axis]
        total = total + (2 - 2 * jnp.cos(angle)).reshape([-1 if a == axis else 1 for a in range(3)])
    return total
