"""How one lens unit refracts a ray and what light the ray carries, for JAX's arrays and NumPy's alike.

The frame is that of `gs_jax.optics.unit`. Coordinates come first: a point is `(2, ...)`, and its parts, the depth and
the field broadcast. All arrays of a call, those of the imager too, are JAX's (to derive, compile and map) or NumPy's:
what is traced once and is a constant to derivatives needs no compiler, which takes as long as a hundred times the rays.
"""

from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from ..base.arrays import library_of
from ..geometry import Imager, chief_ray
from ..lenses import MicrolensArray, Scalars

# `(2, ...)`, of either library, as all of a call are.
Coordinates = Any
Module = TypeVar("Module", Imager, MicrolensArray)

# Newton's steps for the height of refraction at the plane. Each squares an error that starts at 1e-3.
_STEPS = 3


class Refraction(NamedTuple):
    """A ray through the lens.

    `point`: where it meets the curved side, mm. `sag`, `steepness`: of the surface there, mm and 1/mm. `air`: by how
    much the point is farther than the array's front, mm, glass counted as so much air. `slope`: in front; `glass`: in
    the plate; `tangent`: behind. `front`, `back`: at each face the cosines before and behind it, with the normal.
    `landing`: on the sensor, mm. `valid`: False if the surface does not reach the point or the light is reflected
    totally; the other numbers are then finite and meaningless.
    """

    point: Coordinates
    sag: Scalars
    steepness: Scalars
    air: Scalars
    slope: Coordinates
    glass: Coordinates
    tangent: Coordinates
    front: tuple[Scalars, Scalars]
    back: tuple[Scalars, Scalars]
    landing: Coordinates
    valid: Any


def on_host(module: Module) -> Module:
    """The same imager, or array, with NumPy's arrays, in float64."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), module)


def dot(a: Coordinates, b: Coordinates) -> Scalars:
    """Scalar product of coordinates."""
    return a[0] * b[0] + a[1] * b[1]


def secant(slope: Coordinates) -> Scalars:
    """Of a ray's angle with the axis."""
    return library_of(slope).sqrt(1 + dot(slope, slope))


def refracted(imager: Imager, depth: Scalars, point: Coordinates, field: Coordinates) -> Refraction:
    """The ray from a field through a point of the curved side, or of an ideal lens, and on to the sensor.

    Raises
    ------
    InputError
        If the imager's lenses differ.
    """
    imager.array.check_alike()
    if imager.array.thin_lens_focal_length is not None:
        return _ideally(imager, depth, point, field)
    through = _plane_first if imager.array.orientation == "plano" else _curve_first
    return through(imager, depth, point, field)


def _plane_first(imager, depth, point, field) -> Refraction:
    array, xp = imager.array, library_of(point)
    n, t = array.refractive_index, array.substrate_thickness
    point, sag, steepness, reached = _surface(array, point)
    air = as_air(n, t - sag, depth, point - field)
    slope = (point - field) / (depth + air)
    glass = slope_in_glass(n, slope)
    lateral, axial, inside, behind2 = _bent(n, glass, point, steepness)
    valid = reached & (behind2 > 0)
    behind = xp.sqrt(xp.where(behind2 > 0, behind2, 1))
    tangent = _behind(lateral, axial, n, behind - n * inside, point, steepness, valid)
    landing = point + (imager.sensor_distance + sag) * tangent
    front = 1 / secant(slope), 1 / secant(glass)
    return Refraction(point, sag, steepness, air, slope, glass, tangent, front, (inside, behind), landing, valid)


def _curve_first(imager, depth, point, field) -> Refraction:
    array, xp = imager.array, library_of(point)
    n, t = array.refractive_index, array.substrate_thickness
    point, sag, steepness, reached = _surface(array, point)
    slope = (point - field) / (depth + sag)
    # The surface falls toward the sensor: its normal leans toward the axis.
    lateral, axial, outside, inside2 = _bent(1 / n, slope, point, -steepness)
    inside = xp.sqrt(inside2)
    # Light that comes from behind the surface does not meet it.
    met = reached & (outside > 0)
    glass = _behind(lateral, axial, 1 / n, inside - outside / n, point, -steepness, met)
    in_glass2 = dot(glass, glass) / (1 + dot(glass, glass))
    cosine2 = 1 - n**2 * in_glass2
    valid = met & (cosine2 > 0)
    cosine = xp.sqrt(xp.where(valid, cosine2, 1))
    tangent = xp.where(valid, n * glass / secant(glass), 0) / cosine
    landing = point + (t - sag) * glass + imager.sensor_distance * tangent
    back = 1 / secant(glass), cosine
    return Refraction(point, sag, steepness, sag, slope, glass, tangent, (outside, inside), back, landing, valid)


def _ideally(imager, depth, point, field) -> Refraction:
    """An ideal lens: the slope behind it is `(image - point) / v'`, written with `1/v'`, may be zero."""
    array, v, xp = imager.array, imager.reduced_sensor_distance, library_of(point)
    reduced = depth + array.air_in_front
    focal_length: Scalars = array.thin_lens_focal_length
    vergence = 1 / focal_length - 1 / reduced
    slope = (point - field) / reduced
    tangent = -field / reduced - vergence * point
    landing = chief_ray(xp.zeros_like(point), field, v / reduced) + point * (1 - v * vergence)
    zero = xp.zeros_like(slope[0])
    faces = zero + 1, zero + 1
    air = zero + array.air_in_front
    return Refraction(point, zero, zero, air, slope, slope, tangent, faces, faces, landing, zero == 0)


def _surface(array, point):
    """A point of the curved side, its sag and steepness, and whether there is one: on the axis where there is none."""
    xp, r2 = library_of(point), dot(point, point)
    reached = array.reaches(r2)
    point, r2 = xp.where(reached, point, 0), xp.where(reached, r2, 0)
    return point, array.sag(r2), array.steepness(r2), reached


def _bent(ratio, slope, point, steepness):
    """A ray's lateral and axial parts, its cosine with a surface's normal, and the squared cosine of what is refracted.

    `ratio` is the index before the surface over that behind it. The normal goes along the light; it is
    `(steepness point, 1)`, normalised.
    """
    length = secant(slope)
    lateral, axial = slope / length, 1 / length
    cosine = (steepness * dot(lateral, point) + axial) / _normal(point, steepness)
    return lateral, axial, cosine, 1 - ratio**2 * (1 - cosine**2)


def _behind(lateral, axial, ratio, bend, point, steepness, valid):
    """Slopes behind a surface: of `ratio` times the ray plus `bend` times the normal (Snell)."""
    xp, bend = library_of(point), bend / _normal(point, steepness)
    return xp.where(valid, ratio * lateral + bend * steepness * point, 0) / xp.where(valid, ratio * axial + bend, 1)


def _normal(point, steepness):
    """Length of `(steepness point, 1)`."""
    return library_of(point).sqrt(1 + steepness**2 * dot(point, point))


def solid_angle(imager: Imager, depth: Scalars, ray: Refraction) -> Scalars:
    """Of an object point's light, per area of the lens where it meets the curved side, 1/mm^2.

    The Jacobian of the slope `q = a / h` by the point, times `(1 + q^2)^(-3/2)`. With `a` the way sideways and `h` the
    depth in air, it is `|1 - a . grad h / h| / h^2`. With the plane in front `grad h` follows from `as_air`'s equation,
    with the curve in front `h` grows by the sag. An ideal lens has a constant `h`.
    """
    h = depth + ray.air
    tilt = secant(ray.slope) ** -3 / h**2
    array = imager.array
    if array.thin_lens_focal_length is not None:
        return tilt
    n, xp = array.refractive_index, library_of(ray.slope)
    steeper = dot(ray.slope, ray.point) * ray.steepness
    if array.orientation == "curved":
        return abs(1 - steeper) * tilt
    square = dot(ray.slope, ray.slope)
    flat = n**2 + (n**2 - 1) * square
    thick = array.substrate_thickness - ray.sag
    change = thick * (n**2 - 1) * square / (flat * xp.sqrt(flat))
    # The glass is thinner farther out.
    along = -(change + h * steeper / xp.sqrt(flat)) / (1 - change / h)
    return abs(1 - along / h) * tilt


def passed(imager: Imager, ray: Refraction) -> Scalars:
    """Share of the light that both faces let through: Fresnel's equations, unpolarised. An ideal lens passes all."""
    if imager.array.thin_lens_focal_length is not None:
        return ray.front[0]
    n = imager.array.refractive_index
    (before, in_front), (at_back, behind) = ray.front, ray.back
    return _through(1, before, n, in_front) * _through(n, at_back, 1, behind)


def _through(n_in, cos_in, n_out, cos_out):
    across = (n_in * cos_in - n_out * cos_out) / (n_in * cos_in + n_out * cos_out)
    along = (n_out * cos_in - n_in * cos_out) / (n_out * cos_in + n_in * cos_out)
    return 1 - (across**2 + along**2) / 2


def as_air(n: Scalars, thickness: Scalars, depth: Scalars, across: Coordinates) -> Scalars:
    """The layer of air `g` in which a ray goes as far sideways as in the glass: `across = slope (depth + g)`."""
    square, xp = dot(across, across), library_of(across)
    g = thickness / n
    for _ in range(_STEPS):
        h = depth + g
        flat = n**2 + (n**2 - 1) * square / h**2
        in_air = thickness / xp.sqrt(flat)
        g = g - (g - in_air) / (1 - in_air * (n**2 - 1) * square / (h**3 * flat))
    return g


def slope_in_glass(n: Scalars, slope: Coordinates) -> Coordinates:
    """Snell's law at the plane for slopes: `sin = slope / sqrt(1 + slope^2)` over `n`."""
    return slope / library_of(slope).sqrt(n**2 + (n**2 - 1) * dot(slope, slope))
