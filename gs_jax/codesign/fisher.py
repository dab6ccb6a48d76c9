"""Cramer-Rao bounds: the least standard deviations with which the position of a point can be estimated.

A point at `(x, y, z)` has an image under every lens that sees it, and each image moves by its own parallax. The Fisher
information of all pixels gives the bound of any unbiased estimate, so it judges a layout without a reconstruction. A
pixel `k` with mean `m_k` and variance `m_k + read_noise^2` (shot noise, with the background in `m_k`; read noise is
treated as Poisson light of the same variance) contributes

    F = sum_k (d m_k) (d m_k)' / (m_k + read_noise^2)

(Ober, Ram and Ward, Biophys. J. 86, 1185, 2004; read noise as in Huang et al., Nat. Methods 10, 653, 2013). The paper
has no such bound. Images of one point by different lenses are assumed not to overlap.

`crowded_bound` is the bound in a crowded scene, with the light of an exposure and the lenses' own spots. Its noise is
white over an image, so a lens whose image of the point moves by `s` contributes the information of the matched filter

    F = N^2 / n  integral |2 pi v . s|^2 |H(v)|^2 dv

for `N` electrons, the transfer function `H` and noise of the density `n` (Kay, Fundamentals of Statistical Signal
Processing I, 1993, section 3.5). Stray light adds little at the frequencies that count; a Gaussian of the spot's
variance would not distinguish a sharp core in stray light from no core. The noise is that of a scene
(`linear_error.noise_density`) plus the point's own.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..base.arrays import jit
from ..geometry import Imager, envelope
from ..objectives.conditions import Conditions, field_radius, of_lenses
from ..typing import Real
from .linear_error import lens_electrons, noise_density, transfer_power

# Prior standard deviations of x, y, z (mm) and of the logarithm of the brightness.
PRIOR = (10.0, 10.0, 10.0, 10.0)


Spot = Real | Float[Array | np.ndarray, "size size"]
Parameters = Float[Array, "4"]


def mean_images(
    parameters: Parameters, imager: Imager, *, photons: Real, spot: Spot, corners: Float[Array, "lens 2"], size: int
) -> Float[Array, "lens row column"]:
    """The mean image of a point in the window of each lens, electrons, without background.

    Parameters
    ----------
    parameters
        `x, y, z` of the point, mm, and the logarithm of its brightness.
    imager
        The lens array and the sensor.
    photons
        Electrons that a lens on its axis collects from a point of brightness 1; other lenses collect the envelope C
        of them.
    spot
        Standard deviation of a Gaussian image, mm, or a PSF on the sensor's pixels, as `diffraction_psf` makes it, of
        `size`. The PSF moves by cubic interpolation.
    corners
        First `(row, column)` of each window.
    size
        Of a window along a side, pixels, odd.
    """
    point, brightness = parameters[:3], jnp.exp(parameters[3])
    views = imager.views_of_all(point[None])
    places, weights = imager.sensor.to_pixels(views.spot[:, 0]) - corners, imager.brightness(views)[:, 0]
    spot = jnp.asarray(spot, parameters.dtype)
    if spot.ndim:
        light = jax.vmap(lambda place: _shifted(spot, place - size // 2))(places)
    else:
        light = jax.vmap(lambda place: _gaussian(spot / imager.sensor.pixel_pitch, place, size))(places)
    return jnp.asarray(photons * brightness * weights)[:, None, None] * light


def windows(
    point: Float[Array | np.ndarray, "3"], imager: Imager, size: int
) -> tuple[Float[Array, "lens 2"], Float[Array, "lens row column"]]:
    """Windows around the images of a point: first `(row, column)` of each, and a mask that is 1 on the sensor."""
    places = imager.sensor.to_pixels(imager.project(jnp.asarray(point)[None])[:, 0])
    corners = lax.stop_gradient(jnp.round(places)) - size // 2
    index = corners[:, :, None] + jnp.arange(size, dtype=corners.dtype)[None, None]
    inside = [(at >= 0) & (at <= n - 1) for at, n in zip((index[:, 0], index[:, 1]), imager.sensor.shape, strict=True)]
    return corners, (inside[0][:, :, None] & inside[1][:, None, :]).astype(corners.dtype)


@partial(jit, static_argnames="size")
def fisher_information(
    point: Float[Array | np.ndarray, "3"],
    imager: Imager,
    *,
    photons: Real,
    spot: Spot,
    background: Real = 0.0,
    read_noise: Real = 2.0,
    size: int = 15,
) -> Float[Array, "4 4"]:
    """Fisher information about `x, y, z` (mm) and the logarithm of the brightness of a point.

    Differentiable in all continuous arguments. It has small steps where an image crosses a pixel and its window moves.

    Parameters
    ----------
    point
        `(x, y, z)`, mm.
    imager, photons, spot
        As for `mean_images`.
    background
        Mean electrons in each pixel beside the point's.
    read_noise
        Standard deviation, electrons. If both are 0, pixels without light have no information.
    size
        Of the window around each image, pixels, odd; of the PSF if there is one. Wide enough for the spot.

    Raises
    ------
    ValueError
        If the size is not odd and positive, or the spot is neither a number nor `(size, size)`.
    """
    shape = np.shape(spot)
    if size < 1 or size % 2 == 0:
        raise ValueError(f"`size` must be odd and positive, got {size}.")
    if shape not in ((), (size, size)):
        raise ValueError(f"`spot` must be a number or of shape {(size, size)}, got {shape}.")
    dtype = imager.sensor_distance.dtype
    start = jnp.concatenate([jnp.asarray(point, dtype), jnp.zeros(1, dtype)])
    corners, on_sensor = windows(start[:3], imager, size)
    images = lambda parameters: mean_images(parameters, imager, photons=photons, spot=spot, corners=corners, size=size)
    mean, slopes = images(start), jax.jacfwd(images)(start)
    variance = mean + background + jnp.asarray(read_noise, dtype) ** 2
    # An interpolated PSF may be negative where there is little background.
    positive = variance > 0
    weight = jnp.where(positive, on_sensor / jnp.where(positive, variance, 1), 0)
    return jnp.einsum("lrci,lrcj,lrc->ij", slopes, slopes, weight)


@partial(jit, static_argnames="size")
def cramer_rao(
    points: Float[Array | np.ndarray, "point 3"],
    imager: Imager,
    *,
    prior: tuple[float, float, float, float] = PRIOR,
    **options: Any,
) -> Float[Array, "point 3"]:
    """Cramer-Rao bound of `x, y, z` of single points of unknown brightness, as standard deviations, mm.

    `sqrt(diag((F + diag(1 / prior^2))^-1))`. The prior is so wide that it does not change the bound of a point that is
    seen. It keeps the bound and its gradient finite where no lens sees a point.

    Parameters
    ----------
    points
        `(x, y, z)`, mm.
    prior
        Standard deviations of x, y, z, mm, and of the logarithm of the brightness.
    imager, options
        As for `fisher_information`.
    """
    points, scale = jnp.asarray(points), jnp.asarray(prior, imager.sensor_distance.dtype)

    def bound(point):
        information = fisher_information(point, imager, **options)
        # Scaled to a unit diagonal: lengths and brightness differ by orders of magnitude.
        total = information + jnp.diag(scale**-2)
        unit = jnp.diag(total) ** -0.5
        inverse = jnp.linalg.inv(unit[:, None] * total * unit[None])
        return jnp.sqrt(jnp.diag(inverse)[:3]) * unit[:3]

    return lax.map(bound, points)


def localization_bound(imager: Imager, points: Float[Array | np.ndarray, "point 3"], **options) -> Float[Array, "3"]:
    """Root mean square of `cramer_rao` over points, along x, y and z, mm, with its options."""
    return jnp.sqrt(jnp.mean(cramer_rao(points, imager, **options) ** 2, axis=0))


def _gaussian(deviation, place, size):
    """Integral of a Gaussian over each pixel; lengths in pixels, `place` from the centre of the first one."""
    borders = jnp.arange(size + 1, dtype=place.dtype) - 0.5
    rows, columns = (jnp.diff(jax.scipy.stats.norm.cdf(borders, at, deviation)) for at in place)
    return rows[:, None] * columns[None]


def _shifted(psf, shift):
    """Shift a PSF by `(rows, columns)`, pixels; it is zero beyond its window."""
    padded = jnp.pad(psf, 2)
    shifted = jax.image.scale_and_translate(
        padded, padded.shape, (0, 1), jnp.ones(2, psf.dtype), shift.astype(psf.dtype), "cubic", antialias=False
    )
    return shifted[2:-2, 2:-2]


# Nodes of the quadrature over frequencies up to Nyquist.
_NODES = 24


def crowded_bound(imager: Imager, at: Conditions, places: Float[Array, "place 2"]) -> Float[Array, "depth 3"]:
    """Cramer-Rao bound of x, y, z in a crowded scene, for points as bright as an emitter of 40 um x 40 um, mm.

    `at`: conditions, whose depths are those of the points. `places`: `(x, y)` of points, mm. The result is the root
    mean square over them.
    """
    spot, prior = _spot(imager, at), jnp.asarray(PRIOR[:3], at.depths.dtype)

    def variance(place):
        information = _information(imager, at, spot, place)
        return jnp.diagonal(jnp.linalg.inv(information + jnp.diag(prior**-2)[None]), axis1=1, axis2=2)

    return jnp.sqrt(jnp.mean(jax.lax.map(variance, places), 0))


def _spot(imager, at):
    """Integrals of a spot's square and of its squared derivative, 1/mm^2, `(depth, lens)`, and the noise density."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    dtype, highest = at.depths.dtype, 1 / (2 * imager.sensor.pixel_pitch)
    frequency = highest * jnp.asarray((nodes + 1) / 2, dtype)
    ring = jnp.asarray(np.pi * weights, dtype) * highest * frequency
    power = of_lenses(imager, transfer_power(imager, at, frequency))
    energy = power @ ring
    slope = power @ (ring * (2 * jnp.pi * frequency) ** 2) / 2
    return energy.T, slope.T, noise_density(imager, at)[None]


def _information(imager, at, spot, place) -> Float[Array, "depth 3 3"]:
    """Fisher information about `x, y, z` of a point by all lenses."""
    energy, slope, noise = spot
    points = jnp.concatenate([jnp.tile(place, (at.depths.size, 1)), at.depths[:, None]], 1)
    views = imager.views_of_all(points)
    weight = envelope(jnp.sum(views.offset**2, -1), views.reduced_depth, field_radius(imager, at)).T
    light = of_lenses(imager, lens_electrons(imager, at)).T * weight
    per_shift = light**2 * slope / (noise + light * energy)
    # Derivative of image positions by x, y, z.
    shift = jax.vmap(jax.jacfwd(lambda point: imager.project(point[None])[:, 0]))(points)
    return jnp.einsum("dl,dlai,dlaj->dij", per_shift, shift, shift)
