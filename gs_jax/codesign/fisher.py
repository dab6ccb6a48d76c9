"""How precisely a point can be located: Fisher information of its image, and the Cramer-Rao bound.

A point at `(x, y, z)` is imaged by every lens that sees it, each image moved by its own parallax. What the pixels tell
together about the place is the Fisher information; its inverse bounds the covariance of any unbiased estimate, so it
judges a layout without a reconstruction. Light on pixel `k` has mean `m_k` and variance `m_k + read_noise^2`
(shot noise, background included in `m_k`, and read noise as the same variance of Poisson light), for which

    F = sum_k (d m_k) (d m_k)' / (m_k + read_noise^2)

(Ober, Ram and Ward, Biophys. J. 86, 1185, 2004; read noise as in Huang et al., Nat. Methods 10, 653, 2013). The
paper has no such bound. Images of one point by different lenses are taken as apart from each other.
"""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..geometry import Imager, envelope
from ..objectives.conditions import Conditions, field_radius
from ..typing import Real
from .linear_error import lens_electrons, noise_density, transfer_power

# What is known before the image, standard deviations of x, y, z (mm) and of the logarithm of the brightness.
PRIOR = (10.0, 10.0, 10.0, 10.0)


Spot = Real | Float[Array | np.ndarray, "size size"]
Parameters = Float[Array, "4"]


def mean_images(
    parameters: Parameters,
    imager: Imager,
    *,
    photons: Real,
    spot: Spot,
    corners: Float[Array, "lens 2"],
    size: int,
) -> Float[Array, "lens row column"]:
    """The mean image of a point in the window of each lens, electrons, without background.

    Parameters
    ----------
    parameters
        `x, y, z` of the point, mm, and the logarithm of its brightness.
    imager
        What sees it.
    photons
        Electrons that a lens on its axis gets of a point of brightness 1; other lenses get the envelope C of them.
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
        light = jax.vmap(lambda place: _moved(spot, place - size // 2))(places)
    else:
        light = jax.vmap(lambda place: _gaussian(spot / imager.sensor.pixel_pitch, place, size))(places)
    return jnp.asarray(photons * brightness * weights)[:, None, None] * light


def windows(
    point: Float[Array | np.ndarray, "3"], imager: Imager, size: int
) -> tuple[Float[Array, "lens 2"], Float[Array, "lens row column"]]:
    """Windows around the images of a point: first `(row, column)` of each, and 1 on the sensor and 0 beside it."""
    places = imager.sensor.to_pixels(imager.project(jnp.asarray(point)[None])[:, 0])
    corners = lax.stop_gradient(jnp.round(places)) - size // 2
    index = corners[:, :, None] + jnp.arange(size, dtype=corners.dtype)[None, None]
    inside = [(at >= 0) & (at <= n - 1) for at, n in zip((index[:, 0], index[:, 1]), imager.sensor.shape, strict=True)]
    return corners, (inside[0][:, :, None] & inside[1][:, None, :]).astype(corners.dtype)


@partial(jax.jit, static_argnames="size")
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

    Differentiable in everything that is continuous. It is smooth but where a lens's image crosses a pixel: there the
    window moves on, and what it loses at one side is not quite what it gains at the other.

    Parameters
    ----------
    point
        `(x, y, z)`, mm.
    imager, photons, spot
        As for `mean_images`.
    background
        Mean electrons in each pixel beside the point's.
    read_noise
        Standard deviation, electrons. If both are 0, pixels without light say nothing.
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
    # An interpolated PSF may fall below zero; with enough background that does not matter.
    known = variance > 0
    weight = jnp.where(known, on_sensor / jnp.where(known, variance, 1), 0)
    return jnp.einsum("lrci,lrcj,lrc->ij", slopes, slopes, weight)


@partial(jax.jit, static_argnames="size")
def cramer_rao(
    points: Float[Array | np.ndarray, "point 3"],
    imager: Imager,
    *,
    photons: Real,
    spot: Spot,
    background: Real = 0.0,
    read_noise: Real = 2.0,
    size: int = 15,
    prior: tuple[float, float, float, float] = PRIOR,
) -> Float[Array, "point 3"]:
    """The least standard deviations of `x, y, z` of points, each alone and of unknown brightness, mm.

    `sqrt(diag((F + diag(1 / prior^2))^-1))`. The prior stands for what is known anyway; it is so wide that it does
    not matter to a point that is seen, and it keeps the bound and its gradient finite where no lens sees one.

    Parameters
    ----------
    points
        `(x, y, z)`, mm.
    imager, photons, spot, background, read_noise, size
        As for `fisher_information`.
    prior
        Standard deviations of x, y, z, mm, and of the logarithm of the brightness.
    """
    points, scale = jnp.asarray(points), jnp.asarray(prior, imager.sensor_distance.dtype)

    def bound(point):
        information = fisher_information(
            point, imager, photons=photons, spot=spot, background=background, read_noise=read_noise, size=size
        )
        # In units in which the diagonal is 1: lengths and brightness differ by many orders.
        total = information + jnp.diag(scale**-2)
        unit = jnp.diag(total) ** -0.5
        inverse = jnp.linalg.inv(unit[:, None] * total * unit[None])
        return jnp.sqrt(jnp.diag(inverse)[:3]) * unit[:3]

    return lax.map(bound, points)


def localization_bound(imager: Imager, points: Float[Array | np.ndarray, "point 3"], **options) -> Float[Array, "3"]:
    """Root mean square of `cramer_rao` over points, along x, y and z, mm: terms for co-design. Options are its."""
    return jnp.sqrt(jnp.mean(cramer_rao(points, imager, **options) ** 2, axis=0))


def _gaussian(deviation, place, size):
    """A Gaussian's share of each pixel; lengths in pixels, `place` from the middle of the first one."""
    borders = jnp.arange(size + 1, dtype=place.dtype) - 0.5
    rows, columns = (jnp.diff(jax.scipy.stats.norm.cdf(borders, at, deviation)) for at in place)
    return rows[:, None] * columns[None]


def _moved(psf, shift):
    """A PSF moved by `(rows, columns)`, pixels; beyond its window it is dark."""
    padded = jnp.pad(psf, 2)
    moved = jax.image.scale_and_translate(
        padded, padded.shape, (0, 1), jnp.ones(2, psf.dtype), shift.astype(psf.dtype), "cubic", antialias=False
    )
    return moved[2:-2, 2:-2]


# Frequencies, up to the pixels' own highest.
_NODES = 24


def crowded_bound(
    parts: Sequence[tuple[Imager, Conditions]], places: Float[Array, "place 2"]
) -> Float[Array, "depth 3"]:
    """The least standard deviations of x, y, z of points as bright as a lit place of 40 um x 40 um, mm.

    Parameters
    ----------
    parts
        The lenses of each type and their conditions, as of `gs_jax.objectives.conditions.per_type`. The depths are
        those of the points.
    places
        `(x, y)` of points, mm. Root mean squares over them are given.
    """
    spots = [_spot(*part, parts) for part in parts]
    prior = jnp.asarray(PRIOR[:3], parts[0][1].depths.dtype)

    def at(place):
        told = sum(_information(*part, spot, place) for part, spot in zip(parts, spots, strict=True))
        return jnp.diagonal(jnp.linalg.inv(told + jnp.diag(prior**-2)[None]), axis1=1, axis2=2)

    return jnp.sqrt(jnp.mean(jax.lax.map(at, places), 0))


def _spot(imager, at, parts):
    """At each depth of the spot of a lens its squared light, 1/mm^2, and of its derivative by x or y; and its noise."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    dtype, highest = at.depths.dtype, 1 / (2 * imager.sensor.pixel_pitch)
    frequency = highest * jnp.asarray((nodes + 1) / 2, dtype)
    ring = jnp.asarray(np.pi * weights, dtype) * highest * frequency
    power = transfer_power(imager, at, frequency)
    energy = jnp.sum(ring[None] * power, 1)
    slope = jnp.sum(ring[None] * power * (2 * jnp.pi * frequency[None]) ** 2, 1) / 2
    return energy, slope, noise_density(imager, at, parts)


def _information(imager, at, spot, place) -> Float[Array, "depth 3 3"]:
    """Information about `x, y, z` of a point at a place by these lenses."""
    energy, slope, noise = spot
    beside = imager.array.centers - place[None]
    weight = envelope(jnp.sum(beside**2, 1)[None], imager.reduced_depth(at.depths)[:, None], field_radius(imager, at))
    light = lens_electrons(imager, at)[:, None] * weight
    told = light**2 * slope[:, None] / (noise + light * energy[:, None])
    # How far images move, over the magnification: with the point, and with its depth.
    moved = jnp.concatenate(
        [
            jnp.broadcast_to(jnp.eye(2, dtype=at.depths.dtype), (at.depths.size, len(beside), 2, 2)),
            (beside[None] / imager.reduced_depth(at.depths)[:, None, None])[..., None],
        ],
        -1,
    )
    return jnp.einsum("dl,dlai,dlaj->dij", told * imager.magnification(at.depths)[:, None] ** 2, moved, moved)
