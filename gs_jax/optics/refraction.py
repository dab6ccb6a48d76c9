"""How one lens unit refracts a ray and what light the ray carries, for JAX's arrays and NumPy's alike.

The frame is that of `gs_jax.optics.unit`. Coordinates come first: a point is `(2, ...)`, and its parts, the depth and
the field broadcast. All arrays of a call, those of the imager too, are JAX's (to derive, compile and map) or NumPy's:
what is traced once and is a constant to derivatives needs no compiler, which takes as long as a hundred times the rays.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..geometry import Imager, chief_ray

# Of either library, as all of a call are; `Coordinates` are `(2, ...)`.
Scalars = Any
Coordinates = Any

# Newton's steps for the height of refraction at the plane. Each squares an error that starts at 1e-3.
_STEPS = 3


class Refraction(NamedTuple):
    """A ray through the lens.

    `point`: where it leaves the lens, mm. `sag`: how far that is behind the plane of the vertex, toward the plate, mm.
    `air`: the glass as so much air, mm. `slope`: in front; `glass`: in the plate; `tangent`: behind. `cosine`: of the
    angle in the glass with the sphere's normal. `landing`: on the sensor, mm. `valid`: False if the point is not on the
    sphere or the light is reflected totally; the other numbers are then finite and meaningless.
    """

    point: Coordinates
    sag: Scalars
    air: Scalars
    slope: Coordinates
    glass: Coordinates
    cosine: Scalars
    tangent: Coordinates
    landing: Coordinates
    valid: Any


def on_host(imager: Imager) -> Imager:
    """The same imager with NumPy's arrays, in float64."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), imager)


def dot(a: Coordinates, b: Coordinates) -> Scalars:
    """Scalar product of coordinates."""
    return a[0] * b[0] + a[1] * b[1]


def secant(slope: Coordinates) -> Scalars:
    """Of a ray's angle with the axis."""
    return _arrays(slope).sqrt(1 + dot(slope, slope))


def refracted(imager: Imager, depth: Scalars, point: Coordinates, field: Coordinates) -> Refraction:
    """The ray from a field to where it leaves the lens, and on to the sensor: plane, plate, sphere."""
    array, xp = imager.array, _arrays(point)
    n, t, radius = array.refractive_index, array.substrate_thickness, array.radius_of_curvature
    r2 = dot(point, point)
    on_sphere = r2 < radius**2
    point, r2 = xp.where(on_sphere, point, 0), xp.where(on_sphere, r2, 0)
    depth_of_center = xp.sqrt(radius**2 - r2)
    sag = r2 / (radius + depth_of_center)
    air = as_air(n, t - sag, depth, point - field)
    slope = (point - field) / (depth + air)
    glass = slope_in_glass(n, slope)
    # Lateral and axial parts of the ray and of the sphere's normal.
    s_glass = secant(glass)
    ray, ray_z = glass / s_glass, 1 / s_glass
    normal, normal_z = point / radius, depth_of_center / radius
    cosine = dot(ray, normal) + ray_z * normal_z
    behind2 = 1 - n**2 * (1 - cosine**2)
    valid = on_sphere & (behind2 > 0)
    bend = xp.sqrt(xp.where(behind2 > 0, behind2, 1)) - n * cosine
    tangent = xp.where(valid, n * ray + bend * normal, 0) / xp.where(valid, n * ray_z + bend * normal_z, 1)
    landing = point + (imager.sensor_distance + sag) * tangent
    return Refraction(point, sag, air, slope, glass, cosine, tangent, landing, valid)


def refracted_ideally(imager: Imager, depth: Scalars, point: Coordinates, field: Coordinates) -> Refraction:
    """The same of an ideal lens: the slope behind it is `(image - point) / v'`, written with `1/v'`, may be zero."""
    array, v, xp = imager.array, imager.sensor_distance, _arrays(point)
    air = array.substrate_thickness / array.refractive_index
    reduced = depth + air
    focal_length: Scalars = array.thin_lens_focal_length
    vergence = 1 / focal_length - 1 / reduced
    slope = (point - field) / reduced
    tangent = -field / reduced - vergence * point
    landing = chief_ray(xp.zeros_like(point), field, v / reduced) + point * (1 - v * vergence)
    zero = xp.zeros_like(slope[0])
    return Refraction(point, zero, zero + air, slope, slope, zero + 1, tangent, landing, zero == 0)


def solid_angle(imager: Imager, depth: Scalars, ray: Refraction) -> Scalars:
    """Of an object point's light, per area of the lens where it leaves, 1/mm^2.

    The Jacobian of the slope `q = a / h` by the point, times `(1 + q^2)^(-3/2)`. With `a` the way sideways and `h` the
    depth in air, it is `|1 - a . grad h / h| / h^2`, and `grad h` follows from `as_air`'s equation. An ideal lens has a
    constant `h`.
    """
    h = depth + ray.air
    tilt = secant(ray.slope) ** -3 / h**2
    if imager.array.thin_lens_focal_length is not None:
        return tilt
    n, xp = imager.array.refractive_index, _arrays(ray.slope)
    across, square = ray.slope * h, dot(ray.slope, ray.slope)
    flat = n**2 + (n**2 - 1) * square
    thick = imager.array.substrate_thickness - ray.sag
    change = thick * (n**2 - 1) * square / (flat * xp.sqrt(flat))
    # The glass is thinner farther out: sag grows as r / (R - sag).
    thinner = dot(across, ray.point) / (imager.array.radius_of_curvature - ray.sag) / xp.sqrt(flat)
    along = -(change + thinner) / (1 - change / h)
    return abs(1 - along / h) * tilt


def passed(imager: Imager, ray: Refraction) -> Scalars:
    """Share of the light that both faces let through: Fresnel's equations, unpolarised. An ideal lens passes all."""
    if imager.array.thin_lens_focal_length is not None:
        return ray.cosine
    n, xp = imager.array.refractive_index, _arrays(ray.slope)
    behind = xp.sqrt(xp.maximum(1 - n**2 * (1 - ray.cosine**2), 0))
    return _through(1, 1 / secant(ray.slope), n, 1 / secant(ray.glass)) * _through(n, ray.cosine, 1, behind)


def _through(n_in, cos_in, n_out, cos_out):
    across = (n_in * cos_in - n_out * cos_out) / (n_in * cos_in + n_out * cos_out)
    along = (n_out * cos_in - n_in * cos_out) / (n_out * cos_in + n_in * cos_out)
    return 1 - (across**2 + along**2) / 2


def as_air(n: Scalars, thickness: Scalars, depth: Scalars, across: Coordinates) -> Scalars:
    """The layer of air `g` in which a ray goes as far sideways as in the glass: `across = slope (depth + g)`."""
    square, xp = dot(across, across), _arrays(across)
    g = thickness / n
    for _ in range(_STEPS):
        h = depth + g
        flat = n**2 + (n**2 - 1) * square / h**2
        in_air = thickness / xp.sqrt(flat)
        g = g - (g - in_air) / (1 - in_air * (n**2 - 1) * square / (h**3 * flat))
    return g


def slope_in_glass(n: Scalars, slope: Coordinates) -> Coordinates:
    """Snell's law at the plane for slopes: `sin = slope / sqrt(1 + slope^2)` over `n`."""
    return slope / _arrays(slope).sqrt(n**2 + (n**2 - 1) * dot(slope, slope))


def _arrays(x: Coordinates) -> Any:
    """NumPy or JAX's, whose array this is."""
    return np if isinstance(x, np.ndarray) else jnp
