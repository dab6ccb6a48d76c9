"""Exact rays through one plano-convex lenslet: refraction and transmitted light.

The lenslet's axis goes through its vertex. The object point is `field` beside the axis and `depth` in front of the
first face, plano or curved; the sensor is `v` behind the other one. Vertex and plano face are `t` apart, so the glass
is thinner off the axis. A ray is given by the point `(x, y)` where it meets the curved side; the ray through the vertex
is the chief ray. Optical paths are differences to the chief ray's, computed as such: in float32 they are right to a
thousandth of a wave.

`refract` takes arrays of JAX or of NumPy, with coordinates first: points are `(2, ...)`. Tables that are constants to
derivatives use NumPy, which needs no compilation.
"""

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..base.arrays import array_namespace
from ..geometry import Imager, chief_ray
from ..lenses import MicrolensArray
from ..typing import Coordinates, ScalarLike, Scalars

Point = Float[Array | np.ndarray, "2"] | tuple[ScalarLike, ScalarLike]
Module = TypeVar("Module", Imager, MicrolensArray)

# Newton steps for the height of refraction at the plane. Each squares an error that starts at 1e-3.
_NEWTON_STEPS = 3
# Angle between successive points of Vogel's spiral, which covers a disc evenly with any number of points.
GOLDEN_ANGLE = np.pi * (3 - 5**0.5)


class RefractedRay(NamedTuple):
    """A ray from the object through the lenslet to the sensor.

    `point`, `sag`, `sag_slope_over_r`: where the ray meets the curved side (mm), and the surface there (mm, 1/mm).
    `air`: reduced distance of that point behind the array's front, mm. `slope`, `glass`, `tangent`: slopes of the ray
    in front of, inside and behind the lenslet. `front`, `back`: cosines with the normal before and behind each face.
    `landing`: on the sensor, mm. `valid`: False where there is no surface or total reflection; the other numbers are
    then finite and meaningless.
    """

    point: Coordinates
    sag: Scalars
    sag_slope_over_r: Scalars
    air: Scalars
    slope: Coordinates
    glass: Coordinates
    tangent: Coordinates
    front: tuple[Scalars, Scalars]
    back: tuple[Scalars, Scalars]
    landing: Coordinates
    valid: Any


class LensletRay(NamedTuple):
    """A ray behind the lenslet.

    `landing`: where it meets the sensor, `(x, y)` from the axis, mm. `tangent`: its slopes `dx/dz, dy/dz`. `path`:
    optical path from the object to the sensor less the chief ray's, mm. `valid`: as of `RefractedRay`.
    """

    landing: Float[Array, "*batch 2"]
    tangent: Float[Array, "*batch 2"]
    path: Float[Array, "*batch"]
    valid: Bool[Array, "*batch"]


def to_numpy(module: Module) -> Module:
    """The imager or array with NumPy arrays in float64."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), module)


def dot(a: Coordinates, b: Coordinates) -> Scalars:
    """Scalar product of coordinates."""
    return a[0] * b[0] + a[1] * b[1]


def secant(slope: Coordinates) -> Scalars:
    """Secant of the ray's angle with the axis."""
    return array_namespace(slope).sqrt(1 + dot(slope, slope))


def refract(imager: Imager, depth: Scalars, point: Coordinates, field: Coordinates) -> RefractedRay:
    """Trace the ray from a field point through a point of the curved side, or of an ideal lens, to the sensor.

    Raises
    ------
    InputError
        If the lenses differ.
    """
    imager.array.check_alike()
    if imager.array.thin_lens_focal_length is not None:
        return _refract_ideal(imager, depth, point, field)
    through = _refract_plane_first if imager.array.orientation == "plano" else _refract_curve_first
    return through(imager, depth, point, field)


def _refract_plane_first(imager, depth, point, field) -> RefractedRay:
    array, xp = imager.array, array_namespace(point)
    n, t = array.refractive_index, array.substrate_thickness
    point, sag, ratio, reached = _surface(array, point)
    air = equivalent_air(n, t - sag, depth, point - field)
    slope = (point - field) / (depth + air)
    glass = slope_in_glass(n, slope)
    lateral, axial, inside, behind2 = _incidence(n, glass, point, ratio)
    valid = reached & (behind2 > 0)
    behind = xp.sqrt(xp.where(behind2 > 0, behind2, 1))
    tangent = _snell(lateral, axial, n, behind - n * inside, point, ratio, valid)
    landing = point + (imager.sensor_distance + sag) * tangent
    front = 1 / secant(slope), 1 / secant(glass)
    return RefractedRay(point, sag, ratio, air, slope, glass, tangent, front, (inside, behind), landing, valid)


def _refract_curve_first(imager, depth, point, field) -> RefractedRay:
    array, xp = imager.array, array_namespace(point)
    n, t = array.refractive_index, array.substrate_thickness
    point, sag, ratio, reached = _surface(array, point)
    slope = (point - field) / (depth + sag)
    # The surface falls toward the sensor: its normal leans toward the axis.
    lateral, axial, outside, inside2 = _incidence(1 / n, slope, point, -ratio)
    inside = xp.sqrt(inside2)
    # Light that comes from behind the surface does not meet it.
    met = reached & (outside > 0)
    glass = _snell(lateral, axial, 1 / n, inside - outside / n, point, -ratio, met)
    in_glass2 = dot(glass, glass) / (1 + dot(glass, glass))
    cosine2 = 1 - n**2 * in_glass2
    valid = met & (cosine2 > 0)
    cosine = xp.sqrt(xp.where(valid, cosine2, 1))
    tangent = xp.where(valid, n * glass / secant(glass), 0) / cosine
    landing = point + (t - sag) * glass + imager.sensor_distance * tangent
    back = 1 / secant(glass), cosine
    return RefractedRay(point, sag, ratio, sag, slope, glass, tangent, (outside, inside), back, landing, valid)


def _refract_ideal(imager, depth, point, field) -> RefractedRay:
    """An ideal lens. The slope `(image - point) / v'` behind it is written with `1/v'`, which may be zero."""
    array, v, xp = imager.array, imager.reduced_sensor_distance, array_namespace(point)
    reduced = depth + array.reduced_thickness_front
    focal_length: Scalars = array.thin_lens_focal_length
    vergence = 1 / focal_length - 1 / reduced
    slope = (point - field) / reduced
    tangent = -field / reduced - vergence * point
    landing = chief_ray(xp.zeros_like(point), field, v / reduced) + point * (1 - v * vergence)
    zero = xp.zeros_like(slope[0])
    faces = zero + 1, zero + 1
    air = zero + array.reduced_thickness_front
    return RefractedRay(point, zero, zero, air, slope, slope, tangent, faces, faces, landing, zero == 0)


def _surface(array, point):
    """The point on the curved side, its sag and slope ratio, and whether it exists; the axis where it does not."""
    xp, r2 = array_namespace(point), dot(point, point)
    reached = array.reaches(r2)
    point, r2 = xp.where(reached, point, 0), xp.where(reached, r2, 0)
    return point, array.sag(r2), array.sag_slope_over_r(r2), reached


def _incidence(index_ratio, slope, point, ratio):
    """Lateral and axial parts of the ray, its cosine with the normal, and the squared cosine of the refracted ray.

    `index_ratio` is the index before the surface over that behind it. The normal is `(ratio point, 1)`, normalised.
    """
    length = secant(slope)
    lateral, axial = slope / length, 1 / length
    cosine = (ratio * dot(lateral, point) + axial) / _normal_length(point, ratio)
    return lateral, axial, cosine, 1 - index_ratio**2 * (1 - cosine**2)


def _snell(lateral, axial, index_ratio, bend, point, ratio, valid):
    """Slopes behind a surface: those of `index_ratio` times the ray plus `bend` times the normal."""
    xp, bend = array_namespace(point), bend / _normal_length(point, ratio)
    return xp.where(valid, index_ratio * lateral + bend * ratio * point, 0) / xp.where(
        valid, index_ratio * axial + bend, 1
    )


def _normal_length(point, ratio):
    return array_namespace(point).sqrt(1 + ratio**2 * dot(point, point))


def equivalent_air(n: Scalars, thickness: Scalars, depth: Scalars, across: Coordinates) -> Scalars:
    """Layer of air `g` in which a ray goes as far sideways as in the glass: `across = slope (depth + g)`."""
    square, xp = dot(across, across), array_namespace(across)
    g = thickness / n
    for _ in range(_NEWTON_STEPS):
        h = depth + g
        flat = n**2 + (n**2 - 1) * square / h**2
        in_air = thickness / xp.sqrt(flat)
        g = g - (g - in_air) / (1 - in_air * (n**2 - 1) * square / (h**3 * flat))
    return g


def slope_in_glass(n: Scalars, slope: Coordinates) -> Coordinates:
    """Snell's law at the plane for slopes: `sin = slope / sqrt(1 + slope^2)` over `n`."""
    return slope / array_namespace(slope).sqrt(n**2 + (n**2 - 1) * dot(slope, slope))


def solid_angle(imager: Imager, depth: Scalars, ray: RefractedRay) -> Scalars:
    """Solid angle that the lens takes of an object point's light, per area of its curved side, 1/mm^2.

    The Jacobian of the slope `q = a / h` by the point, times `(1 + q^2)^(-3/2)`, with the lateral distance `a` and the
    reduced depth `h`: `|1 - a . grad h / h| / h^2`. With the plane in front `grad h` follows from the equation of
    `equivalent_air`; with the curve in front `h` grows by the sag; for an ideal lens `h` is constant.
    """
    h = depth + ray.air
    tilt = secant(ray.slope) ** -3 / h**2
    array = imager.array
    if array.thin_lens_focal_length is not None:
        return tilt
    n, xp = array.refractive_index, array_namespace(ray.slope)
    steeper = dot(ray.slope, ray.point) * ray.sag_slope_over_r
    if array.orientation == "curved":
        return abs(1 - steeper) * tilt
    square = dot(ray.slope, ray.slope)
    flat = n**2 + (n**2 - 1) * square
    thick = array.substrate_thickness - ray.sag
    change = thick * (n**2 - 1) * square / (flat * xp.sqrt(flat))
    # The glass is thinner farther out.
    along = -(change + h * steeper / xp.sqrt(flat)) / (1 - change / h)
    return abs(1 - along / h) * tilt


def transmittance(imager: Imager, ray: RefractedRay) -> Scalars:
    """Fraction of the light that both faces transmit: Fresnel's equations, unpolarised; 1 for an ideal lens."""
    if imager.array.thin_lens_focal_length is not None:
        return ray.front[0]
    n = imager.array.refractive_index
    (before, in_front), (at_back, behind) = ray.front, ray.back
    return _fresnel(1, before, n, in_front) * _fresnel(n, at_back, 1, behind)


def _fresnel(n_in, cos_in, n_out, cos_out):
    across = (n_in * cos_in - n_out * cos_out) / (n_in * cos_in + n_out * cos_out)
    along = (n_out * cos_in - n_in * cos_out) / (n_out * cos_in + n_in * cos_out)
    return 1 - (across**2 + along**2) / 2


@jax.jit
def trace_lenslet(
    imager: Imager, depth: ScalarLike, pupil_points: Float[Array | np.ndarray, "*batch 2"], field: Point = (0.0, 0.0)
) -> LensletRay:
    """Trace rays from one object point through points of the lenslet to the sensor.

    With `thin_lens_focal_length` the lenslet is an ideal lens in the vertex plane, free of aberrations.

    Parameters
    ----------
    imager
        Its array gives the lens, its `sensor_distance` the place of the sensor.
    depth
        `z` of the object point, in front of the array, mm.
    pupil_points
        Points `(x, y)` where the rays meet the curved side, from the axis, mm.
    field
        `(x, y)` of the object point from the axis, mm.
    """
    dtype = imager.sensor_distance.dtype
    depth, field = jnp.asarray(depth, dtype), jnp.asarray(field, dtype)
    points = jnp.asarray(pupil_points, dtype)
    # Points last: the processor works along the last axis, and two are too few.
    over_points = jax.vmap(lambda point: tuple(_trace(imager, depth, point, field)), 1, (1, 1, 0, 0))
    landing, tangent, path, valid = over_points(points.reshape(-1, 2).T)
    landing, tangent = landing.T.reshape(points.shape), tangent.T.reshape(points.shape)
    return LensletRay(landing, tangent, path.reshape(points.shape[:-1]), valid.reshape(points.shape[:-1]))


def _trace(imager: Imager, depth: Array, point: Array, field: Array) -> LensletRay:
    ray = refract(imager, depth, point, field)
    if imager.array.thin_lens_focal_length is None:
        return LensletRay(ray.landing, ray.tangent, _thick_path(imager, depth, ray, field), ray.valid)
    v, reduced = imager.reduced_sensor_distance, imager.reduced_depth(depth)
    vergence, tilt = 1 / imager.array.focal_length - 1 / reduced, -field / reduced
    # |point - image| - |image| = v' (s - s_chief), from the object on; then v (s - s_chief) along the ray.
    longer = (vergence * dot(point, point) - 2 * dot(point, tilt)) / (secant(ray.tangent) + secant(tilt))
    return LensletRay(ray.landing, ray.tangent, longer * (v * vergence - 1), ray.valid)


def _thick_path(imager: Imager, depth: Array, ray: RefractedRay, field: Array) -> Array:
    """Optical path less the chief ray's (`_chief`), which leaves as it came: at the vertex both faces are parallel."""
    array, v = imager.array, imager.sensor_distance
    n, t = array.refractive_index, array.substrate_thickness
    plane_first = array.orientation == "plano"
    air_chief = equivalent_air(n, t, depth, -field) if plane_first else jnp.zeros_like(ray.air)
    h, h_chief = depth + ray.air, depth + air_chief
    q, q_chief = ray.slope, -field / h_chief
    change = ray.point / h + field * (ray.air - air_chief) / (h * h_chief)
    s_chief, s_glass = secant(q_chief), secant(ray.glass)
    glass_chief = slope_in_glass(n, q_chief)
    squares = dot(change, q + q_chief)
    path = depth * squares / (secant(q) + s_chief)
    s = secant(ray.tangent)
    if plane_first:
        # Snell's law for the square of the slope in glass; see `slope_in_glass`.
        flat, flat_chief = n**2 + (n**2 - 1) * dot(q, q), n**2 + (n**2 - 1) * dot(q_chief, q_chief)
        glass_squares, in_air = n**2 * squares / (flat * flat_chief), s
    else:
        glass_squares, in_air = dot(ray.glass - glass_chief, ray.glass + glass_chief), secant(q)
    path = path + n * t * glass_squares / (s_glass + secant(glass_chief))
    # Off the axis there is air in place of glass.
    path = path + ray.sag * (in_air - n * s_glass)
    return path + v * dot(ray.tangent - q_chief, ray.tangent + q_chief) / (s + s_chief)


def chief_ray_length(imager: Imager, chief: LensletRay) -> Float[Array, ""]:
    """Length of the chief ray from the vertex, as seen from the sensor, to the sensor, mm."""
    squared, n, behind = jnp.sum(chief.tangent**2), imager.array.refractive_index, imager.array.reduced_thickness_back
    if imager.array.thin_lens_focal_length is None:  # with the ray's own angle, as in `equivalent_air`
        behind = behind * n / jnp.sqrt(n**2 + (n**2 - 1) * squared)
    return (imager.sensor_distance + behind) * jnp.sqrt(1 + squared)


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


def vogel_spiral(radius: Float[np.ndarray, " k"], order: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k 2"]:
    """Points of Vogel's spiral with these radii and numbers: evenly spread angles."""
    return radius[:, None] * np.stack([np.cos(GOLDEN_ANGLE * order), np.sin(GOLDEN_ANGLE * order)], -1)


def direction_cosines(tangent: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
    """Lateral direction cosines of a ray with the slopes `tangent`."""
    return tangent / jnp.sqrt(1 + jnp.sum(tangent**2, -1, keepdims=True))
