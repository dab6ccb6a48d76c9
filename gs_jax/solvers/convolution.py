"""A shift-invariant imaging system from a measured point spread function: convolution by FFT, and cropping.

A sensor sees only a part of what a diffuser or lens array casts, also from beyond its own edges. So the scene is
larger than the image: it holds every point whose PSF reaches the sensor, and the image is the middle of its
convolution (Antipa et al., DiffuserCam, Optica 5, 1, 2018).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Complex, Float


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
