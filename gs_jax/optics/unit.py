"""One lens unit, exactly: rays through a plano-convex lens by Snell's law, and the wavefront that they carry.

The frame is the lens's own: the axis through its vertex. The object point is `field` beside the axis and `depth` in
front of the first face, plano or curved; the sensor is `v` behind the other one; the vertex and the plano face are `t`
apart, so that the curved side takes glass away off the axis. A ray is named by the point `(x, y)` at which it meets the
curved side: that is where neighbouring lenses cut the aperture, and the ray through such a point is found exactly. The
ray through the vertex is the chief ray. Paths are counted from the chief ray's and computed as differences, so that
float32 keeps a wavefront to a thousandth of a wave.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..base.arrays import safe_sqrt
from ..geometry import Imager
from .refraction import Refraction, as_air, dot, refracted, secant, slope_in_glass

Point = Float[ArrayLike, "2"] | tuple[Float[ArrayLike, ""], Float[ArrayLike, ""]]

# Newton's steps to the best focus. The first is right to 1e-3, and each squares its error.
_STEPS = 3


class UnitRay(NamedTuple):
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
def unit_rays(
    imager: Imager,
    depth: Float[ArrayLike, ""],
    pupil_points: Float[Array | np.ndarray, "*batch 2"],
    field: Point = (0.0, 0.0),
) -> UnitRay:
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
    return UnitRay(landing, tangent, path.reshape(points.shape[:-1]), valid.reshape(points.shape[:-1]))


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
        As for `unit_rays`.

    Returns
    -------
    Array
        `(*batch,)`; NaN where no ray gets through.
    """
    rays = unit_rays(imager, depth, pupil_points, field)
    chief = unit_rays(imager, depth, np.zeros(2), field)
    radius2 = chief_length(imager, chief) ** 2
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
        As for `unit_rays`.
    radius
        Of the pupil, mm. Half the aperture's diameter by default.
    """
    points, weights = pupil_disc(pupil_radius(imager, radius))
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
    points, weights = pupil_disc(pupil_radius(imager, radius))

    def error(vergence):
        moved = eqx.tree_at(lambda i: i.sensor_distance, imager, 1 / vergence - imager.array.air_behind)
        return _without_tilt(wavefront(moved, depth, points, field), points, weights)

    # Gauss-Newton: the wavefront is all but linear in 1/v', so that the first step is right to 1e-3.
    vergence = 1 / imager.array.focal_length - 1 / imager.reduced_depth(jnp.asarray(depth, weights.dtype))

    def step(_, vergence):
        value, slope = jax.jvp(error, (vergence,), (jnp.ones_like(vergence),))
        return vergence - jnp.sum(weights * value * slope) / jnp.sum(weights * slope**2)

    return 1 / jax.lax.fori_loop(0, _STEPS, step, vergence) - imager.array.air_behind


def chief_length(imager: Imager, chief: UnitRay) -> Float[Array, ""]:
    """From the vertex, as it is seen from the sensor, to the sensor along the chief ray, mm."""
    squared, n, behind = jnp.sum(chief.tangent**2), imager.array.refractive_index, imager.array.air_behind
    if imager.array.thin_lens_focal_length is None:  # with the ray's own angle, as in `refraction.as_air`
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


def pupil_disc(radius: Float[ArrayLike, ""], rings: int = 8) -> tuple[Float[Array, "point 2"], Float[Array, " point"]]:
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


def _ray(imager: Imager, depth: Array, point: Array, field: Array) -> UnitRay:
    """Quantities with `_chief` are those of the ray through the vertex."""
    ray = refracted(imager, depth, point, field)
    if imager.array.thin_lens_focal_length is None:
        return UnitRay(ray.landing, ray.tangent, _thick_path(imager, depth, ray, field), ray.valid)
    v, reduced = imager.reduced_sensor_distance, imager.reduced_depth(depth)
    vergence, tilt = 1 / imager.array.focal_length - 1 / reduced, -field / reduced
    # |point - image| - |image| = v' (s - s_chief), from the object on; then v (s - s_chief) along the ray.
    longer = (vergence * dot(point, point) - 2 * dot(point, tilt)) / (secant(ray.tangent) + secant(tilt))
    return UnitRay(ray.landing, ray.tangent, longer * (v * vergence - 1), ray.valid)


def _thick_path(imager: Imager, depth: Array, ray: Refraction, field: Array) -> Array:
    """At the vertex the surface is parallel to the plane: the chief ray leaves as it came."""
    array, v = imager.array, imager.sensor_distance
    n, t = array.refractive_index, array.substrate_thickness
    plane_first = array.orientation == "plano"
    air_chief = as_air(n, t, depth, -field) if plane_first else jnp.zeros_like(ray.air)
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
