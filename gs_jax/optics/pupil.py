"""Points and rays over the pupil: the clear aperture of the mean lens, quadrature, and the light in each ray.

How much of a point's light a ray carries follows from its solid angle, and from Fresnel losses at every face.
`emission_lines` has the imager at each wavelength of its emission band.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from ..base.arrays import array_namespace, one_program
from ..base.typing import Coordinates, Scalar, ScalarLike, Scalars
from ..microscope.geometry import Imager
from ..microscope.lenses import EACH, MicrolensArray, sag
from ..microscope.media import object_indices
from .apertures import clear_area
from .raytrace import RefractedRay, dot, refract, secant, square_and_root, to_numpy
from .theory import airy_sigma

# Radii and angles of aperture profiles.
_RADII, _ANGLES = 64, 64
# Angle between successive points of Vogel's spiral, which covers a disc evenly with any number of points.
GOLDEN_ANGLE = np.pi * (3 - 5**0.5)


class ApertureProfile(NamedTuple):
    """Clear apertures by radius, averaged over lenses and angles.

    `radius`, mm. `open`: fraction of the circle that is clear. `by_area`: change of that with a lens's clear area,
    1/mm^2, by linear regression over the lenses; 0 if they are identical.
    """

    radius: Float64[np.ndarray, " radius"]
    open: Float64[np.ndarray, " radius"]
    by_area: Float64[np.ndarray, " radius"]

    @property
    def diameter(self) -> float:
        """Diameter of the disc with the mean clear area, mm."""
        return 4 * math.sqrt(float(self.radius[0] * (self.open * self.radius).sum()))


def aperture_profile(array: MicrolensArray, *, by_area: bool = True) -> ApertureProfile:
    """Trace the profile of the clear apertures; without `by_area` that of the mean lens alone."""
    radius, fractions = _open_fractions(array)
    slope = np.zeros(_RADII)
    if by_area:
        areas = np.asarray(clear_area(array), np.float64)
        excess = areas - areas.mean()
        if (spread := (excess**2).sum()) > 1e-6 * (areas**2).sum():
            slope = excess @ fractions / spread
    return ApertureProfile(radius, fractions.mean(0), slope)


def _open_fractions(array):
    """Radii, and the clear fraction of each lens's circle at each radius."""
    array.check_alike()
    centers = np.asarray(array.centers, np.float64)
    diameter = float(array.aperture_diameter)
    radius = (np.arange(_RADII) + 0.5) * diameter / 2 / _RADII
    angle = 2 * np.pi * (np.arange(_ANGLES) + 0.5) / _ANGLES
    points = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    covered = _covered_by_identical(centers, diameter) if array.others is None else _covered_by_others(array)
    return radius, np.stack([1 - covered(lens, points).mean(1) for lens in range(len(centers))])


def _covered_by_identical(centers, diameter) -> Callable:
    def covered(lens, points):
        offsets = np.delete(centers, lens, 0) - centers[lens]
        offsets = offsets[(offsets**2).sum(1) <= diameter**2]
        return (points @ offsets.T > (offsets**2).sum(1) / 2).any(-1)

    return covered


def _covered_by_others(array) -> Callable:
    """Function of a lens and points: whether a point is in the disc of a neighbour whose surface is higher there."""
    whole, mine = to_numpy(array.whole), to_numpy(array)
    radius, diameter, conic = map(whole.of_lenses, EACH)
    rim, own = diameter / 2, float(mine.aperture_diameter) / 2

    def covered(lens, points):
        offsets, squared = whole.centers - whole.centers[lens], (points**2).sum(-1)
        here, found = mine.sag(np.minimum(squared, own**2)), np.zeros(squared.shape, bool)
        for j in np.flatnonzero(np.hypot(*offsets.T) <= rim + own):
            apart = ((points - offsets[j]) ** 2).sum(-1)
            its = sag(np.minimum(apart, rim[j] ** 2), radius[j], conic[j], mine.aspheric_terms)
            found |= (j != lens) & (apart <= rim[j] ** 2) & (its < here)
        return found

    return covered


class PupilSamples(NamedTuple):
    """Rays from points at `(field, 0)` beside a lens's axis, at one depth, to the sensor.

    `landing`: from the axis, mm. `light`: fraction of the light that the point emits in all directions, for the mean
    lens; `light_per_area`: change of that with a lens's clear area, 1/mm^2.
    """

    landing: Float64[np.ndarray, "field ray 2"]
    light: Float64[np.ndarray, "field ray"]
    light_per_area: Float64[np.ndarray, "field ray"]


def sample_pupil(
    imager: Imager, depth: float, fields: Float64[np.ndarray, " field"], aperture: ApertureProfile, count: int
) -> PupilSamples:
    """Trace `count` rays, evenly over the lens's disc, for each field; a band's wavelengths share them equally."""
    lines = emission_lines(imager)
    parts = [_one_colour(one, depth, fields, aperture, count // len(lines)) for _, one in lines]
    if len(parts) == 1:
        return parts[0]
    light = [[float(weight) * part for part in each[1:]] for (weight, _), each in zip(lines, parts, strict=True)]
    landing = np.concatenate([part.landing for part in parts], 1)
    return PupilSamples(landing, *(np.concatenate(part, 1) for part in zip(*light, strict=True)))


def _one_colour(imager, depth, fields, aperture, count) -> PupilSamples:
    order, rim = np.arange(count) + 0.5, float(imager.array.aperture_diameter) / 2
    radius = rim * np.sqrt(order / count)
    points = vogel_spiral(radius, order)
    host, landing, light = to_numpy(imager), np.empty((len(fields), count, 2)), np.empty((len(fields), count))
    # Field by field: the data of each stays in the processor's cache.
    for k, field in enumerate(fields):
        at, light[k] = trace_light(host, float(depth), points.T, np.array([[field], [0.0]]))
        landing[k] = at.T
    light *= np.pi * rim**2 / count
    share, slope = (np.interp(radius, aperture.radius, part) for part in (aperture.open, aperture.by_area))
    return PupilSamples(landing, light * share, light * slope)


def trace_light(
    imager: Imager, depth: Scalars, points: Coordinates, field: Coordinates
) -> tuple[Coordinates, Float64[np.ndarray, " point"]]:
    """Where rays land, and the fraction of the point's light in them, per area of the curved side (1/mm^2).

    Coordinates come first and are NumPy's, as the imager's numbers (`to_numpy`).
    """
    ray = refract(imager, depth, points, field)
    light = solid_angle(imager, ray) * transmittance(imager, ray) / (4 * np.pi)
    return ray.landing, np.where(ray.valid, light, 0)


def add_diffraction(imager: Imager, rays: PupilSamples, aperture: ApertureProfile) -> PupilSamples:
    """Move rays by Gaussian random numbers (fixed seed) as wide as the Airy disc of the clear aperture."""
    width = float(airy_sigma(imager.wavelength, imager.reduced_sensor_distance, aperture.diameter))
    moves = np.random.default_rng(0).normal(0, width, rays.landing.shape[1:])
    return rays._replace(landing=rays.landing + moves)


def vogel_spiral(radius: Float[np.ndarray, " k"], order: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k 2"]:
    """Points of Vogel's spiral with these radii and numbers: evenly spread angles."""
    return radius[:, None] * np.stack([np.cos(GOLDEN_ANGLE * order), np.sin(GOLDEN_ANGLE * order)], -1)


def pupil_radius(imager: Imager, radius: ScalarLike | None = None) -> Float[Array, ""]:
    """`radius` in the imager's precision; half the aperture's diameter if it is None."""
    if radius is None:
        return imager.array.aperture_diameter / 2
    return jnp.asarray(radius, imager.sensor_distance.dtype)


def pupil_quadrature(radius: ScalarLike, rings: int = 8) -> tuple[Float[Array, "point 2"], Float[Array, " point"]]:
    """Points and weights (sum 1) of the mean over a disc, exact for polynomials up to degree `4 rings - 2`.

    Gauss-Legendre in the squared radius, equal angles around (Abramowitz and Stegun 25.4.61).
    """
    radius = jnp.asarray(radius)
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    around = 4 * rings
    angle = 2 * np.pi * (np.arange(around) + 0.5) / around
    unit = np.sqrt((nodes + 1) / 2)[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    points = jnp.asarray(unit.reshape(-1, 2), radius.dtype) * radius
    return points, jnp.asarray(np.repeat(weights / (2 * around), around), radius.dtype)


def solid_angle(imager: Imager, ray: RefractedRay) -> Scalars:
    """Solid angle that the lens takes of an object point's light, per area of its curved side, 1/mm^2.

    In air it is the Jacobian of the slope `q = a / h` by the point, times `(1 + q^2)^(-3/2)`, with the lateral distance
    `a` and the height `h`: `|1 - a . grad h / h| / h^2`. The gradient follows from the equation of `_height`, where
    the sag makes the glass thinner, or the air thicker. In a medium of index `n` the same rays fill
    `cos / (n^2 cos_n)` of that, as `n sin` does not change.
    """
    h, square, array = ray.height, dot(ray.slope, ray.slope), imager.array
    along = 0 * h
    if array.thin_lens_focal_length is None:
        growing = h * dot(ray.slope, ray.point) * ray.sag_slope_over_r
        if array.orientation == "plano":
            growing = -growing / square_and_root(array.refractive_index, square)[1]
        along = (growing - ray.lengthening * h) / (1 - ray.lengthening)
    longer = secant(ray.slope)
    angle = abs(1 - along / h) / (longer * longer * longer * h * h)
    if imager.sample is None:
        return angle
    n = imager.sample.refractive_index
    return angle / (n**2 * _cosine(n, square) * longer)


def transmittance(imager: Imager, ray: RefractedRay) -> Scalars:
    """Fraction of the light that all faces transmit: Fresnel's equations, unpolarised; an ideal lens has no faces."""
    array = imager.array
    in_front = object_indices(imager.filters, imager.sample)
    behind = [] if imager.windows is None else [1.0, *imager.windows.refractive_index[::-1]]
    light = 1 + 0 * ray.height
    if array.thin_lens_focal_length is None:
        n, (before, after) = array.refractive_index, ray.curved
        if array.orientation == "plano":
            in_front, light = [*in_front, n], _fresnel(n, before, 1, after)
        else:
            in_front, behind, light = [*in_front, 1.0], [n, *(behind or [1.0])], _fresnel(1, before, n, after)
    return light * _through(in_front, ray.slope) * _through(behind, ray.tangent)


def _through(indices, slope: Coordinates) -> Scalars:
    """Light that plane faces between media of these indices transmit; `slope` is the ray's in air."""
    square = dot(slope, slope)
    light, cosines = 1.0, [_cosine(n, square) for n in indices]
    for k in range(len(indices) - 1):
        light = light * _fresnel(indices[k], cosines[k], indices[k + 1], cosines[k + 1])
    return light


def _cosine(n: Scalar, square: Scalars) -> Scalars:
    """Cosine of a ray's angle in a medium, by the square of its slope in air: `sqrt(1 - sin^2 / n^2)`."""
    xp = array_namespace(square)
    return xp.sqrt((1 + square - square / n**2) / (1 + square))


def _fresnel(n_in, cos_in, n_out, cos_out):
    across = (n_in * cos_in - n_out * cos_out) / (n_in * cos_in + n_out * cos_out)
    along = (n_out * cos_in - n_in * cos_out) / (n_out * cos_in + n_in * cos_out)
    return 1 - (across**2 + along**2) / 2


def emission_lines(imager: Imager) -> list[tuple[Scalar, Imager]]:
    """Share of the light and imager of each wavelength of the band; without a band, the imager itself."""
    band, parts = imager.band, _dispersive(imager)
    if band is None:
        return [(1.0, imager)]
    for part, shift in parts:
        if shift.shape[1:] != part.refractive_index.shape:
            shape = *shift.shape[:1], *part.refractive_index.shape
            raise ValueError(f"`band` must have {shape} refractive indices of a part of the imager, got {shift.shape}.")

    return _lines(imager)


@one_program
def _lines(imager: Imager) -> list[tuple[Scalar, Imager]]:
    band, parts = imager.band, _dispersive(imager)
    assert band is not None

    def line(k):
        indices = [part.refractive_index + shift[k] for part, shift in parts]
        places = lambda i: [i.band, i.wavelength, *(part.refractive_index for part, _ in _dispersive(i))]
        return eqx.tree_at(places, imager, [None, band.wavelengths[k], *indices])

    return [(band.weights[k], line(k)) for k in range(len(band))]


def _dispersive(imager: Imager) -> list:
    """Parts of an imager whose index depends on the wavelength, and their shifts."""
    band, sample = imager.band, imager.sample
    if band is None:
        return []
    cover = None if sample is None else sample.layers
    parts = imager.array, imager.filters, imager.windows, sample, cover
    shifts = band.lens, band.filters, band.windows, band.sample, band.cover
    return [(part, shift) for part, shift in zip(parts, shifts, strict=True) if part is not None and shift is not None]
