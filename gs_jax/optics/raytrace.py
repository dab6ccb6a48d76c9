"""How one lens unit refracts a ray and what light the ray carries, for JAX's arrays and NumPy's alike.

Coordinates come first: a point is `(2, ...)`, and its parts, the depth and
the field broadcast. All arrays of a call, those of the imager too, are JAX's (to derive, compile and map) or NumPy's:
what is traced once and is a constant to derivatives needs no compiler, which takes as long as a hundred times the rays.

One lens unit, exactly: rays through a plano-convex lens by Snell's law, and the wavefront that they carry.

The frame is the lens's own: the axis through its vertex. The object point is `field` beside the axis and `depth` in
front of the first face, plano or curved; the sensor is `v` behind the other one; the vertex and the plano face are `t`
apart, so that the curved side takes glass away off the axis. A ray is named by the point `(x, y)` at which it meets the
curved side: that is where neighbouring lenses cut the aperture, and the ray through such a point is found exactly. The
ray through the vertex is the chief ray. Paths are counted from the chief ray's and computed as differences, so that
float32 keeps a wavefront to a thousandth of a wave.
"""

from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..base.arrays import library_of, safe_sqrt
from ..geometry import Imager, chief_ray
from ..lenses import MicrolensArray
from ..typing import Scalars

# `(2, ...)`, of either library, as all of a call are.
Coordinates = Any
Module = TypeVar("Module", Imager, MicrolensArray)

# Newton's steps for the height of refraction at the plane. Each squares an error that starts at 1e-3.
_NEWTON_STEPS = 3


class Refraction(NamedTuple):
    """A ray through the lens.

    `point`: where it meets the curved side, mm. `sag`, `sag_slope_over_r`: of the surface there, mm and 1/mm. `air`: by
    how much the point is farther than the array's front, mm, glass counted as so much air. `slope`: in front; `glass`:
    in the plate; `tangent`: behind. `front`, `back`: at each face the cosines before and behind it, with the normal.
    `landing`: on the sensor, mm. `valid`: False if the surface does not reach the point or the light is reflected
    totally; the other numbers are then finite and meaningless.
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


def to_numpy(module: Module) -> Module:
    """The same imager, or array, with NumPy's arrays, in float64."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), module)


def dot(a: Coordinates, b: Coordinates) -> Scalars:
    """Scalar product of coordinates."""
    return a[0] * b[0] + a[1] * b[1]


def secant(slope: Coordinates) -> Scalars:
    """Of a ray's angle with the axis."""
    return library_of(slope).sqrt(1 + dot(slope, slope))


def refract(imager: Imager, depth: Scalars, point: Coordinates, field: Coordinates) -> Refraction:
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
    point, sag, sag_slope_over_r, reached = _surface(array, point)
    air = equivalent_air(n, t - sag, depth, point - field)
    slope = (point - field) / (depth + air)
    glass = slope_in_glass(n, slope)
    lateral, axial, inside, behind2 = _bent(n, glass, point, sag_slope_over_r)
    valid = reached & (behind2 > 0)
    behind = xp.sqrt(xp.where(behind2 > 0, behind2, 1))
    tangent = _behind(lateral, axial, n, behind - n * inside, point, sag_slope_over_r, valid)
    landing = point + (imager.sensor_distance + sag) * tangent
    front = 1 / secant(slope), 1 / secant(glass)
    return Refraction(point, sag, sag_slope_over_r, air, slope, glass, tangent, front, (inside, behind), landing, valid)


def _curve_first(imager, depth, point, field) -> Refraction:
    array, xp = imager.array, library_of(point)
    n, t = array.refractive_index, array.substrate_thickness
    point, sag, sag_slope_over_r, reached = _surface(array, point)
    slope = (point - field) / (depth + sag)
    # The surface falls toward the sensor: its normal leans toward the axis.
    lateral, axial, outside, inside2 = _bent(1 / n, slope, point, -sag_slope_over_r)
    inside = xp.sqrt(inside2)
    # Light that comes from behind the surface does not meet it.
    met = reached & (outside > 0)
    glass = _behind(lateral, axial, 1 / n, inside - outside / n, point, -sag_slope_over_r, met)
    in_glass2 = dot(glass, glass) / (1 + dot(glass, glass))
    cosine2 = 1 - n**2 * in_glass2
    valid = met & (cosine2 > 0)
    cosine = xp.sqrt(xp.where(valid, cosine2, 1))
    tangent = xp.where(valid, n * glass / secant(glass), 0) / cosine
    landing = point + (t - sag) * glass + imager.sensor_distance * tangent
    back = 1 / secant(glass), cosine
    return Refraction(point, sag, sag_slope_over_r, sag, slope, glass, tangent, (outside, inside), back, landing, valid)


def _ideally(imager, depth, point, field) -> Refraction:
    """An ideal lens: the slope behind it is `(image - point) / v'`, written with `1/v'`, may be zero."""
    array, v, xp = imager.array, imager.reduced_sensor_distance, library_of(point)
    reduced = depth + array.reduced_thickness_front
    focal_length: Scalars = array.thin_lens_focal_length
    vergence = 1 / focal_length - 1 / reduced
    slope = (point - field) / reduced
    tangent = -field / reduced - vergence * point
    landing = chief_ray(xp.zeros_like(point), field, v / reduced) + point * (1 - v * vergence)
    zero = xp.zeros_like(slope[0])
    faces = zero + 1, zero + 1
    air = zero + array.reduced_thickness_front
    return Refraction(point, zero, zero, air, slope, slope, tangent, faces, faces, landing, zero == 0)


def _surface(array, point):
    """A point of the curved side, its sag and `sag_slope_over_r`, and whether it exists: the axis where it does not."""
    xp, r2 = library_of(point), dot(point, point)
    reached = array.reaches(r2)
    point, r2 = xp.where(reached, point, 0), xp.where(reached, r2, 0)
    return point, array.sag(r2), array.sag_slope_over_r(r2), reached


def _bent(ratio, slope, point, sag_slope_over_r):
    """A ray's lateral and axial parts, its cosine with a surface's normal, and the squared cosine of what is refracted.

    `ratio` is the index before the surface over that behind it. The normal goes along the light; it is
    `(sag_slope_over_r point, 1)`, normalised.
    """
    length = secant(slope)
    lateral, axial = slope / length, 1 / length
    cosine = (sag_slope_over_r * dot(lateral, point) + axial) / _normal(point, sag_slope_over_r)
    return lateral, axial, cosine, 1 - ratio**2 * (1 - cosine**2)


def _behind(lateral, axial, ratio, bend, point, sag_slope_over_r, valid):
    """Slopes behind a surface: of `ratio` times the ray plus `bend` times the normal (Snell)."""
    xp, bend = library_of(point), bend / _normal(point, sag_slope_over_r)
    return xp.where(valid, ratio * lateral + bend * sag_slope_over_r * point, 0) / xp.where(
        valid, ratio * axial + bend, 1
    )


def _normal(point, sag_slope_over_r):
    """Length of `(sag_slope_over_r point, 1)`."""
    return library_of(point).sqrt(1 + sag_slope_over_r**2 * dot(point, point))


def solid_angle(imager: Imager, depth: Scalars, ray: Refraction) -> Scalars:
    """Of an object point's light, per area of the lens where it meets the curved side, 1/mm^2.

    The Jacobian of the slope `q = a / h` by the point, times `(1 + q^2)^(-3/2)`. With `a` the way sideways and `h` the
    depth in air, it is `|1 - a . grad h / h| / h^2`. With the plane in front `grad h` follows from `equivalent_air`'s
    equation, with the curve in front `h` grows by the sag. An ideal lens has a constant `h`.
    """
    h = depth + ray.air
    tilt = secant(ray.slope) ** -3 / h**2
    array = imager.array
    if array.thin_lens_focal_length is not None:
        return tilt
    n, xp = array.refractive_index, library_of(ray.slope)
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


def transmittance(imager: Imager, ray: Refraction) -> Scalars:
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


def equivalent_air(n: Scalars, thickness: Scalars, depth: Scalars, across: Coordinates) -> Scalars:
    """The layer of air `g` in which a ray goes as far sideways as in the glass: `across = slope (depth + g)`."""
    square, xp = dot(across, across), library_of(across)
    g = thickness / n
    for _ in range(_NEWTON_STEPS):
        h = depth + g
        flat = n**2 + (n**2 - 1) * square / h**2
        in_air = thickness / xp.sqrt(flat)
        g = g - (g - in_air) / (1 - in_air * (n**2 - 1) * square / (h**3 * flat))
    return g


def slope_in_glass(n: Scalars, slope: Coordinates) -> Coordinates:
    """Snell's law at the plane for slopes: `sin = slope / sqrt(1 + slope^2)` over `n`."""
    return slope / library_of(slope).sqrt(n**2 + (n**2 - 1) * dot(slope, slope))


Point = Float[ArrayLike, "2"] | tuple[Float[ArrayLike, ""], Float[ArrayLike, ""]]

# Newton's steps to the best focus. The first is right to 1e-3, and each squares its error.
_FOCUS_STEPS = 3


class LensletRay(NamedTuple):
    """A ray behind the lens.

    `landing`: where it meets the sensor, `(x, y)` from the lens's axis, mm. `tangent`: its slopes `dx/dz, dy/dz`.
    `path`: optical path from the object to the sensor less the chief ray's, mm. `valid`: False if the surface
    does not reach the pupil point or the light is reflected totally; the other numbers are then finite and meaningless.
    """

    landing: Float[Array, "*batch 2"]
    tangent: Float[Array, "*batch 2"]
    path: Float[Array, "*batch"]
    valid: Bool[Array, "*batch"]


@jax.jit
def trace_lenslet(
    imager: Imager,
    depth: Float[ArrayLike, ""],
    pupil_points: Float[Array | np.ndarray, "*batch 2"],
    field: Point = (0.0, 0.0),
) -> LensletRay:
    """Rays from one object point through points of the lens, to the sensor.

    With `thin_lens_focal_length` the unit is an ideal lens in the vertex plane: the object's image at
    `1/f - 1/z'` is free of aberrations.

    Parameters
    ----------
    imager
        Its array says what the lens is, its `sensor_distance` where the sensor is.
    depth
        `z` of the object point, in front of the array, mm.
    pupil_points
        `(*batch, 2)` points `(x, y)` at which the rays meet the curved side, from the axis, mm.
    field
        `(x, y)` of the object point from the lens's axis, mm.
    """
    dtype = imager.sensor_distance.dtype
    depth, field = jnp.asarray(depth, dtype), jnp.asarray(field, dtype)
    points = jnp.asarray(pupil_points, dtype)
    # Points last: the processor works along the last axis, and two are too few.
    over_points = jax.vmap(lambda point: tuple(_ray(imager, depth, point, field)), 1, (1, 1, 0, 0))
    landing, tangent, path, valid = over_points(points.reshape(-1, 2).T)
    landing, tangent = landing.T.reshape(points.shape), tangent.T.reshape(points.shape)
    return LensletRay(landing, tangent, path.reshape(points.shape[:-1]), valid.reshape(points.shape[:-1]))


@jax.jit
def wavefront(
    imager: Imager,
    depth: Float[ArrayLike, ""],
    pupil_points: Float[Array | np.ndarray, "*batch 2"],
    field: Point = (0.0, 0.0),
) -> Float[Array, "*batch"]:
    """Wavefront error, mm: optical path to the reference sphere less the chief ray's.

    The sphere goes through the vertex, as it is seen from the sensor, and has its centre where the chief ray meets the
    sensor: what is out of focus on
    the sensor is in the wavefront, as defocus. A path that is too long, hence light that is late, is positive.

    Parameters
    ----------
    imager, depth, pupil_points, field
        As for `trace_lenslet`.

    Returns
    -------
    Array
        `(*batch,)`; NaN where no ray gets through.
    """
    rays = trace_lenslet(imager, depth, pupil_points, field)
    chief = trace_lenslet(imager, depth, np.zeros(2), field)
    radius2 = chief_ray_length(imager, chief) ** 2
    offset = rays.landing - chief.landing.reshape((1,) * (rays.path.ndim) + (2,))
    cosines = direction_cosines(rays.tangent)
    along, offset2 = jnp.sum(offset * cosines, -1), jnp.sum(offset**2, -1)
    # From the sphere to the sensor along the ray: m = along + sqrt(radius^2 - offset^2 + along^2), the chief's radius.
    root = jnp.sqrt(jnp.maximum(radius2 - offset2 + along**2, 0))
    past = along + (along**2 - offset2) / (root + jnp.sqrt(radius2))
    return jnp.where(rays.valid, rays.path - past, jnp.nan)


@jax.jit
def wavefront_rms(
    imager: Imager,
    depth: Float[ArrayLike, ""],
    *,
    field: Point = (0.0, 0.0),
    radius: Float[ArrayLike, ""] | None = None,
) -> Float[Array, ""]:
    """RMS wavefront error over the pupil, mm, without piston and tilt: neither changes the shape of the spot.

    NaN if part of the pupil reflects the light totally.

    Parameters
    ----------
    imager, depth, field
        As for `trace_lenslet`.
    radius
        Of the pupil, mm. Half the aperture's diameter by default.
    """
    points, weights = pupil_quadrature(pupil_radius(imager, radius))
    return safe_sqrt(jnp.sum(weights * _without_tilt(wavefront(imager, depth, points, field), points, weights) ** 2))


@jax.jit
def best_focus(
    imager: Imager,
    depth: Float[ArrayLike, ""],
    *,
    field: Point = (0.0, 0.0),
    radius: Float[ArrayLike, ""] | None = None,
) -> Float[Array, ""]:
    """Sensor distance `v` of the least `wavefront_rms`, mm. The imager's own sensor distance does not matter.

    Under spherical aberration it lies between the paraxial image and the smallest RMS spot, near the caustic's sharp
    core. There is none for an object within the focal length; the result is then not a distance. NaN if part of the
    pupil reflects the light totally.

    Parameters
    ----------
    imager, depth, field, radius
        As for `wavefront_rms`.
    """
    points, weights = pupil_quadrature(pupil_radius(imager, radius))

    def error(vergence):
        moved = eqx.tree_at(lambda i: i.sensor_distance, imager, 1 / vergence - imager.array.reduced_thickness_back)
        return _without_tilt(wavefront(moved, depth, points, field), points, weights)

    # Gauss-Newton: the wavefront is all but linear in 1/v', so that the first step is right to 1e-3.
    vergence = 1 / imager.array.focal_length - 1 / imager.reduced_depth(jnp.asarray(depth, weights.dtype))

    def step(_, vergence):
        value, slope = jax.jvp(error, (vergence,), (jnp.ones_like(vergence),))
        return vergence - jnp.sum(weights * value * slope) / jnp.sum(weights * slope**2)

    return 1 / jax.lax.fori_loop(0, _FOCUS_STEPS, step, vergence) - imager.array.reduced_thickness_back


def chief_ray_length(imager: Imager, chief: LensletRay) -> Float[Array, ""]:
    """From the vertex, as it is seen from the sensor, to the sensor along the chief ray, mm."""
    squared, n, behind = jnp.sum(chief.tangent**2), imager.array.refractive_index, imager.array.reduced_thickness_back
    if imager.array.thin_lens_focal_length is None:  # with the ray's own angle, as in `refraction.equivalent_air`
        behind = behind * n / jnp.sqrt(n**2 + (n**2 - 1) * squared)
    return (imager.sensor_distance + behind) * jnp.sqrt(1 + squared)


def pupil_radius(imager: Imager, radius: Float[ArrayLike, ""] | None = None) -> Float[Array, ""]:
    """`radius` in the imager's precision; half the aperture's diameter if it is None."""
    if radius is None:
        return imager.array.aperture_diameter / 2
    return jnp.asarray(radius, imager.sensor_distance.dtype)


def _without_tilt(error: Array, points: Array, weights: Array) -> Array:
    """Less its average and its slopes: by symmetry `1, x, y` are orthogonal over a disc."""
    error = error - jnp.sum(weights * error)
    slopes = jnp.sum((weights * error)[:, None] * points, 0) / jnp.sum(weights[:, None] * points**2, 0)
    return error - points @ slopes


def pupil_quadrature(
    radius: Float[ArrayLike, ""], rings: int = 8
) -> tuple[Float[Array, "point 2"], Float[Array, " point"]]:
    """Points and weights of an average over a disc, exact for polynomials of `(x, y)` up to degree `4 rings - 2`.

    Gauss-Legendre in the squared radius, equal angles around: the product rule of Abramowitz and Stegun 25.4.61.
    The weights sum to 1.
    """
    radius = jnp.asarray(radius)
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    around = 4 * rings
    angle = 2 * np.pi * (np.arange(around) + 0.5) / around
    unit = np.sqrt((nodes + 1) / 2)[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    points = jnp.asarray(unit.reshape(-1, 2), radius.dtype) * radius
    return points, jnp.asarray(np.repeat(weights / (2 * around), around), radius.dtype)


def direction_cosines(tangent: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
    """Lateral direction cosines of a ray with the slopes `tangent`."""
    return tangent / jnp.sqrt(1 + jnp.sum(tangent**2, -1, keepdims=True))


def _ray(imager: Imager, depth: Array, point: Array, field: Array) -> LensletRay:
    """Quantities with `_chief` are those of the ray through the vertex."""
    ray = refract(imager, depth, point, field)
    if imager.array.thin_lens_focal_length is None:
        return LensletRay(ray.landing, ray.tangent, _thick_path(imager, depth, ray, field), ray.valid)
    v, reduced = imager.reduced_sensor_distance, imager.reduced_depth(depth)
    vergence, tilt = 1 / imager.array.focal_length - 1 / reduced, -field / reduced
    # |point - image| - |image| = v' (s - s_chief), from the object on; then v (s - s_chief) along the ray.
    longer = (vergence * dot(point, point) - 2 * dot(point, tilt)) / (secant(ray.tangent) + secant(tilt))
    return LensletRay(ray.landing, ray.tangent, longer * (v * vergence - 1), ray.valid)


def _thick_path(imager: Imager, depth: Array, ray: Refraction, field: Array) -> Array:
    """At the vertex the surface is parallel to the plane: the chief ray leaves as it came."""
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
