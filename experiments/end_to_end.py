"""End-to-end loss: how well random scenes are reconstructed from their noisy images by back-projection.

`reconstruction_loss` is a loss for `gs_jax.optimize` and stochastic optimisers: the layouts of `results/layout.md`
follow its gradient. One key gives one smooth function. The reconstruction is normalised `backproject` minus its local
background: light from other depths gives a smooth haze whose low frequencies no layout can remove.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray

from gs_jax.base.typing import Real
from gs_jax.microscope.geometry import Imager
from gs_jax.microscope.grid import Grid
from gs_jax.projection.backprojection import backproject
from gs_jax.projection.forward_model import forward

Volume = Float[Array | np.ndarray, "depth y x"]
# Default side of the PSF of a voxel, pixels: three standard deviations of voxels up to 5 pixels wide.
_FOOTPRINT = 17
# Summed weight below which a voxel is dimmed: half of a lens on its axis.
_LEAST_WEIGHT = 0.5


def random_scene(
    key: PRNGKeyArray, grid: Grid, *, density: Real = 0.02, width: Real = 0.04
) -> Float[Array, "depth y x"]:
    """Gaussian blobs of this standard deviation, mm, at random voxels; `density` blobs per voxel, peaks 0.5 to 1."""
    where, bright = jax.random.split(key)
    shape, dtype = grid.volume_shape, grid.depths.dtype
    lit = jax.random.bernoulli(where, density, shape)
    points = jnp.where(lit, jax.random.uniform(bright, shape, dtype, 0.5, 1.0), 0)
    across = [_gaussian(n, width / grid.pitch, dtype) for n in grid.shape]
    return jnp.einsum("ij,djk,lk->dil", across[0], points, across[1])


def local_contrast(volume: Volume, grid: Grid, *, width: Real) -> Float[Array, "depth y x"]:
    """Subtract from each plane its Gaussian mean over `width` (mm), and clip at zero.

    Means at the edges are over existing voxels.
    """
    dtype = jnp.asarray(volume).dtype
    rows, columns = (_gaussian(n, width / grid.pitch, dtype) for n in grid.shape)
    rows, columns = rows / rows.sum(1, keepdims=True), columns / columns.sum(1, keepdims=True)
    return jax.nn.relu(volume - jnp.einsum("ij,djk,lk->dil", rows, volume, columns))


def reconstruct(
    image: Float[Array | np.ndarray, "row column"],
    imager: Imager,
    grid: Grid,
    *,
    background_width: Real,
) -> Float[Array, "depth y x"]:
    """Local contrast of the back-projection, normalised by the sum of weights.

    A voxel with less weight than half a lens on its axis is dimmed in proportion, so that the edge of the field is
    smooth. `background_width` is in mm.
    """
    weight = backproject(jnp.ones(image.shape, image.dtype), imager, grid)
    mean = backproject(image, imager, grid) / jnp.maximum(weight, _LEAST_WEIGHT)
    return local_contrast(mean, grid, width=background_width)


def footprints(
    imager: Imager, grid: Grid, psf: Float[Array | np.ndarray, "plane tall wide"] | None = None
) -> Float[Array, "plane tall wide"]:
    """Blur PSFs of points to PSFs of voxels, by a Gaussian with a standard deviation of half a voxel's image.

    `forward` images voxels as points. Where these are a pixel apart or more, the image of a smooth scene is a grid of
    dots, and the loss depends on how each lens's grid falls on the pixels: it changes by a tenth of a dB when a lens
    moves by 2 um. With this blur the modulation is below 1 %.
    A `psf` needs room for the blur.
    """
    dtype = imager.sensor_distance.dtype
    if psf is None:
        planes, middle = grid.depths.size, _FOOTPRINT // 2
        psf = jnp.zeros((planes, _FOOTPRINT, _FOOTPRINT), dtype).at[:, middle, middle].set(1)
    psf = jnp.asarray(psf)
    width = imager.magnification(grid.depths) * grid.pitch / (2 * imager.sensor.pixel_pitch)

    def blur(size):
        kernel = jax.vmap(lambda w: _gaussian(size, w, dtype))(width)
        return kernel / kernel.sum(1, keepdims=True)

    _, rows, columns = psf.shape
    return jnp.einsum("dij,djk,dlk->dil", blur(rows), psf, blur(columns))


def misfit_db(estimate: Volume, truth: Volume) -> Float[Array, ""]:
    """Squared error after the best gain, in dB of the truth's energy: `10 log10(1 - <a,b>^2 / (<a,a> <b,b>))`.

    For one truth it is minus the PSNR of `gs_jax.metrics.quality`, up to a constant. It is 0 dB, without a derivative,
    where either volume is zero. Its minimum, at a perfect estimate, is ten times the rounding error.
    """
    estimate, truth = jnp.asarray(estimate), jnp.asarray(truth)
    energies = jnp.vdot(estimate, estimate) * jnp.vdot(truth, truth)
    some = energies > 0
    alike = jnp.vdot(estimate, truth) ** 2 / jnp.where(some, energies, 1)
    least = 10 * float(jnp.finfo(estimate.dtype).eps)
    return 10 * jnp.log10(jnp.where(some, jnp.maximum(1 - alike, least), 1))


def noisy(key: PRNGKeyArray, image: Float[Array, "row column"], read_noise: Real) -> Float[Array, "row column"]:
    """Add Gaussian shot and read noise to an image in electrons, differentiably.

    A standard normal draw is scaled by `sqrt(image + read_noise^2)`. Negative pixels, by rounding of an FFT, have no
    shot noise.
    """
    variance = jnp.maximum(image, 0) + jnp.asarray(read_noise, image.dtype) ** 2
    some = variance > 0
    deviation = jnp.where(some, jnp.sqrt(jnp.where(some, variance, 1)), 0)
    return image + deviation * jax.random.normal(key, image.shape, image.dtype)


def reconstruction_loss(
    imager: Imager,
    key: PRNGKeyArray,
    *,
    grid: Grid,
    psf: Float[Array | np.ndarray, "plane tall wide"] | None = None,
    scenes: int = 2,
    density: Real = 0.02,
    width: Real = 0.04,
    electrons: Real = 1000.0,
    read_noise: Real = 2.0,
    background_width: Real = 0.2,
) -> Float[Array, ""]:
    """Mean misfit of random scenes that are imaged with noise and reconstructed, dB; lower is better.

    Differentiable once, in both modes, with respect to the imager, the grid's depths and the PSF.

    Scenes and noise follow from `key`; scenes are computed one after the other. `electrons` is the mean number that a
    voxel of brightness 1 adds to the sensor through a lens on its axis. A `psf` that is computed from the imager
    contributes to the gradient. `background_width` is a few times `width`, both in mm.
    """
    if scenes < 1:
        raise ValueError(f"`scenes` must be 1 or more, got {scenes}.")
    images = footprints(imager, grid, psf)

    def one(key):
        scene_key, noise_key = jax.random.split(key)
        truth = random_scene(scene_key, grid, density=density, width=width)
        image = noisy(noise_key, jnp.asarray(electrons * forward(truth, imager, grid, images)), read_noise)
        return misfit_db(reconstruct(image, imager, grid, background_width=background_width), truth)

    return jnp.mean(lax.map(one, jax.random.split(key, scenes)))


def _gaussian(size: int, deviation: Real, dtype) -> Float[Array, "size size"]:
    """A blur as a matrix, `exp(-(i - j)^2 / (2 deviation^2))`, without wrap-around."""
    place = jnp.arange(size, dtype=dtype)
    return jnp.exp(-(((place[:, None] - place[None]) / deviation) ** 2) / 2)
