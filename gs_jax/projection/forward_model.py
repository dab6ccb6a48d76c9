"""The forward model, Eq. (2): what the sensor sees of a volume or of points."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Num
from scipy.fft import next_fast_len

from ..geometry import Grid, Imager, Sensor
from .backprojection import as_volume, backproject_adjoint


@jax.jit
def forward(
    volume: Num[Array | np.ndarray, "depth y x"],
    imager: Imager,
    grid: Grid,
    psf: Float[Array | np.ndarray, "plane tall wide"] | None = None,
) -> Float[Array, "row column"]:
    """The image of a volume: Eq. (2), summed lens by lens and without its zones.

    Each voxel is a point at its centre. Every lens images it at the chief ray's pixel (scale `s_z`, magnification
    `M_z`), weighted by the envelope C, and spread by PSF_o of its depth. The paper takes C from the centre of the
    voxel's zone instead of from the voxel, which is the only difference. As in Eq. (2) a voxel counts the same at
    every depth; the aperture's solid angle would add a factor 1/z'^2. Chief rays that miss the sensor by less than half
    a PSF count with what spreads onto it.

    Linear in the volume and in the PSF; differentiable with respect to everything that is continuous.

    Parameters
    ----------
    volume
        `grid.volume_shape`; integers count as the imager's type.
    imager, grid
        As for `backproject`.
    psf
        PSF_o at each depth on the sensor's pixels, from `gs_jax.optics.psf`: `(len(depths), size, size)`, odd size. By
        default a point, which makes this the adjoint of `backproject`.

    Returns
    -------
    Array
        `sensor.shape`, of the volume's type. With a PSF it is as exact as an FFT of that type, so dark pixels may
        be about 1e-7 of the brightest below zero in float32.

    Raises
    ------
    ValueError
        If the volume is not of the grid's shape, or there is not one PSF of odd size for each depth.
    """
    volume = as_volume(volume, imager)
    if psf is None:
        return backproject_adjoint(volume, imager, grid)
    size = psf.shape[-1]
    if psf.shape != (grid.depths.size, size, size) or size % 2 == 0:
        raise ValueError(f"`psf` must be ({grid.depths.size}, size, size) with an odd size, got {psf.shape}.")
    # Sharp images up to half a PSF beyond the sensor, whose light spreads onto it; a line more each way, as rays that
    # land there share their light with the next. What a transform without these lines wraps round falls on its first
    # `size - 1`, which are beyond the sensor.
    rows, columns = imager.sensor.shape
    wide = Sensor((rows + size + 1, columns + size + 1), imager.sensor.pixel_pitch)
    imager = eqx.tree_at(lambda i: i.sensor, imager, wide)
    padded = [int(next_fast_len(n + size - 1, real=True) or 0) for n in (rows, columns)]
    transform = partial(jnp.fft.rfft2, s=padded)

    # Not kept for the gradient: a spectrum for each depth is more than the volume.
    @jax.checkpoint
    def add_depth(spectrum, plane):
        depth, voxels, kernel = plane
        sharp = backproject_adjoint(voxels[None], imager, grid.at(depth))[1:-1, 1:-1]
        return spectrum + transform(sharp) * transform(kernel), None

    dark = jnp.zeros((padded[0], padded[1] // 2 + 1), volume.dtype)
    planes = grid.depths, volume, jnp.asarray(psf, volume.dtype)
    spectrum = lax.scan(add_depth, lax.complex(dark, dark), planes)[0]
    return jnp.fft.irfft2(spectrum, s=padded)[size - 1 : size - 1 + rows, size - 1 : size - 1 + columns]
