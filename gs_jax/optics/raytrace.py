"""Exact rays through one plano-convex lenslet and the plane layers of the imager: refraction and transmitted light.

The lenslet's axis goes through its vertex. The object point is `field` beside the axis and `depth` in front of the
first face, plano or curved; the sensor is `v` behind the other one. Vertex and plano face are `t` apart, so the glass
is thinner off the axis. A ray is given by the point `(x, y)` where it meets the curved side; the ray through the vertex
is the chief ray. Optical paths are differences to the chief ray's, computed as such: in float32 they are right to a
thousandth of a wave.

By Snell's law a ray of the slope `q` in air has `q / sqrt(n^2 + (n^2 - 1) q^2)` in a layer of index `n`. Slopes are
those in air, whether there is air or not.

`refract` takes arrays of JAX or of NumPy, with coordinates first: points are `(2, ...)`. Tables that are constants to
derivatives use NumPy, which needs no compilation.
"""

from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..base.arrays import array_namespace, jit
from ..base.typing import Coordinates, Scalar, ScalarLike, Scalars
from ..microscope.geometry import Imager, chief_ray
from ..microscope.lenses import MicrolensArray
from ..microscope.media import object_slabs

Point = Float[Array | np.ndarray, "2"] | tuple[ScalarLike, ScalarLike]
Module = TypeVar("Module", Imager, MicrolensArray)

# Newton steps for the height of a ray. Each squares an error that starts at 1e-3, or at 1e-2 within a sample.
_NEWTON_STEPS, _LAST_STEP = 4, 1e-14


class RefractedRay(NamedTuple):
    """A ray from the object through the lenslet to the sensor.

    `point`, `sag`, `sag_slope_over_r`: where the ray meets the curved side (mm), and the surface there (mm, 1/mm).
    `height`: distance in which the slope in air takes the ray from the object to that point, mm; `excess`: of the
    height over `z'`, mm; `lengthening`: derivative by the height of what the layers make of it. `slope`, `glass`,
    `tangent`: slopes of the ray in front of, inside and behind the lenslet. `curved`: cosines with the normal before
    and behind the curved side. `landing`: on the sensor, mm. `valid`: False where there is no surface or total
    reflection; the other numbers are then finite and meaningless.
    """

    point: Coordinates
    sag: Scalars
    sag_slope_over_r: Scalars
    height: Scalars
    excess: Scalars
    lengthening: Scalars
    slope: Coordinates
    glass: Coordinates
    tangent: Coordinates
    curved: tuple[Scalars, Scalars]
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
    """The imager or array with NumPy arrays, its numbers in float64."""
    return jax.tree.map(lambda x: np.asarray(x, np.float64 if eqx.is_inexact_array(x) else x.dtype), module)


def dot(a: Coordinates, b: Coordinates) -> Scalars:
    """Scalar product of coordinates."""
    return a[0] * b[0] + a[1] * b[1]


def secant(slope: Coordinates) -> Scalars:
    """Secant of the ray's angle with the axis."""
    return array_namespace(slope).sqrt(1 + dot(slope, slope))


def refract(imager: Imager, depth: Scalars, point: Coordinates, field: Coordinates) -> RefractedRay:
    """Trace the ray from a field point through a point of the curved side, or of an ideal lens, to the sensor.

    Raises `InputError` if the lenses differ.
    """
    imager.array.check_alike()
    if imager.array.thin_lens_focal_length is not None:
        return _refract_ideal(imager, depth, point, field)
    through = _refract_plane_first if imager.array.orientation == "plano" else _refract_curve_first
    return through(imager, depth, point, field)


def _refract_plane_first(imager, depth, point, field) -> RefractedRay:
    array, xp = imager.array, array_namespace(point)
    n, (point, sag, ratio, reached) = array.refractive_index, _surface(array, point)
    slabs = slabs_in_front(imager, depth, sag)
    height, excess, lengthening = _height(imager.reduced_depth(depth), -sag / n, slabs, point - field)
    slope = (point - field) / height
    glass = slope_in_glass(n, slope)
    lateral, axial, inside, behind2 = _incidence(n, glass, point, ratio)
    valid = reached & (behind2 > 0)
    behind = xp.sqrt(xp.where(behind2 > 0, behind2, 1))
    tangent = _snell(lateral, axial, n, behind - n * inside, point, ratio, valid)
    landing = point + sag * tangent + _to_sensor(imager, sag, tangent)
    numbers = sag, ratio, height, excess, lengthening
    return RefractedRay(point, *numbers, slope, glass, tangent, (inside, behind), landing, valid)


def _refract_curve_first(imager, depth, point, field) -> RefractedRay:
    array, xp = imager.array, array_namespace(point)
    n, (point, sag, ratio, reached) = array.refractive_index, _surface(array, point)
    slabs = slabs_in_front(imager, depth)
    height, excess, lengthening = _height(imager.reduced_depth(depth), sag, slabs, point - field)
    slope = (point - field) / height
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
    landing = point + _to_sensor(imager, sag, tangent)
    numbers = sag, ratio, height, excess, lengthening
    return RefractedRay(point, *numbers, slope, glass, tangent, (outside, inside), landing, valid)


def _refract_ideal(imager, depth, point, field) -> RefractedRay:
    """An ideal lens. The slope `(image - point) / v'` behind it is written with `1/v'`, which may be zero."""
    array, v, xp = imager.array, imager.reduced_sensor_distance, array_namespace(point)
    reduced = imager.reduced_depth(depth)
    focal_length: Scalars = array.thin_lens_focal_length
    vergence = 1 / focal_length - 1 / reduced
    slope = (point - field) / reduced
    tangent = -field / reduced - vergence * point
    landing = chief_ray(xp.zeros_like(point), field, v / reduced) + point * (1 - v * vergence)
    zero = xp.zeros_like(slope[0])
    numbers = zero, zero, zero + reduced, zero, zero
    return RefractedRay(point, *numbers, slope, slope, tangent, (zero + 1, zero + 1), landing, zero == 0)


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


def _height(reduced: Scalars, paraxial: Scalars, slabs, across: Coordinates) -> tuple[Scalars, Scalars, Scalars]:
    """Distance `h` in which a ray's slope in air takes it as far sideways as all it crosses: `across = slope h`.

    `slabs` are thickness and index of what is not air; `reduced + paraxial` is their reduced thickness and that of the
    air, to which a ray near the axis is due. The second result is `h - reduced`, with the precision of the
    difference, the third the derivative by `h` of what the layers make of it, before the last step.
    """
    square, excess, change = dot(across, across), paraxial + 0 * across[0], 0.0
    for _ in range(_NEWTON_STEPS):
        h = reduced + excess
        slope2 = square / (h * h)
        off, change = 0.0, 0.0
        for thickness, n in slabs:
            flat, root = square_and_root(n, slope2)
            share = thickness * (n**2 - 1) / root
            # Of t / sqrt(flat) over t / n.
            off = off + share / (n * (n + root))
            change = change + share / flat
        change = slope2 * change / h
        step = (excess - paraxial + slope2 * off) / (1 - change)
        excess = excess - step
        # As soon as the next step would be 1e-14 of the height: solid angles, too, are those of compiled rays.
        if isinstance(square, np.ndarray) and (step * step * change <= _LAST_STEP * h * h).all():
            break
    return reduced + excess, excess, change


def square_and_root(n, square):
    """`n^2 + (n^2 - 1) q^2` and its root: a slope in a layer is that in air over the root."""
    flat = n**2 + (n**2 - 1) * square
    return flat, array_namespace(flat).sqrt(flat)


def slabs_in_front(imager: Imager, depth: Scalars, sag: Scalars = 0.0) -> list[tuple[Scalars, Scalar]]:
    """Thickness and index of all but air between an object at a depth and a point of the curved side."""
    slabs, plate = object_slabs(depth, imager.filters, imager.sample), _plate(imager, sag)
    return [*slabs, plate] if imager.array.orientation == "plano" else slabs


def slabs_behind(imager: Imager, sag: Scalars = 0.0) -> list[tuple[Scalars, Scalar]]:
    """Thickness and index of all but air between a point of the curved side and the sensor."""
    windows, plate = [] if imager.windows is None else imager.windows.slabs, _plate(imager, sag)
    return windows if imager.array.orientation == "plano" else [plate, *windows]


def _plate(imager: Imager, sag: Scalars) -> tuple[Scalars, Scalar]:
    return imager.array.substrate_thickness - sag, imager.array.refractive_index


def _to_sensor(imager: Imager, sag: Scalars, tangent: Coordinates) -> Coordinates:
    """How far sideways a ray goes from the array's vertices, or from the curved side in glass, to the sensor."""
    square, along = dot(tangent, tangent), _air_behind(imager)
    for thickness, n in slabs_behind(imager, sag):
        along = along + thickness / square_and_root(n, square)[1]
    return along * tangent


def _air_behind(imager: Imager) -> Scalar:
    """Thickness of the air between the array's back and the sensor."""
    return imager.sensor_distance - (0 if imager.windows is None else imager.windows.total)


def slope_in_glass(n: Scalars, slope: Coordinates) -> Coordinates:
    """Snell's law at the plane for slopes: `sin = slope / sqrt(1 + slope^2)` over `n`."""
    return slope / array_namespace(slope).sqrt(n**2 + (n**2 - 1) * dot(slope, slope))


@jit
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
    """Optical path less the chief ray's, which leaves as it came: at the vertex both faces are parallel."""
    reduced, zero = imager.reduced_depth(depth), jnp.zeros_like(depth)
    h_chief, excess_chief, _ = _height(reduced, zero, slabs_in_front(imager, depth), -field)
    q_chief = -field / h_chief
    change = ray.point / ray.height + field * (ray.excess - excess_chief) / (ray.height * h_chief)
    in_front = ray.slope, q_chief, dot(change, ray.slope + q_chief)
    behind = ray.tangent, q_chief, dot(ray.tangent - q_chief, ray.tangent + q_chief)
    air = depth - sum(thickness for thickness, _ in object_slabs(depth, imager.filters, imager.sample))
    path = _longer(air, 1, *in_front) + _longer(_air_behind(imager), 1, *behind)
    for thickness, n in slabs_in_front(imager, depth):
        path = path + _longer(thickness, n, *in_front)
    for thickness, n in slabs_behind(imager):
        path = path + _longer(thickness, n, *behind)
    # Off the axis there is air in place of glass.
    array = imager.array
    in_air = secant(ray.tangent if array.orientation == "plano" else ray.slope)
    return path + ray.sag * (in_air - array.refractive_index * secant(ray.glass))


def _longer(thickness, n, slope, slope_chief, squares):
    """Optical path through a layer less the chief ray's, by slopes in air and the difference of their squares."""
    flat, flat_chief = (square_and_root(n, dot(q, q))[0] for q in (slope, slope_chief))
    longer = secant(slope_in_glass(n, slope)) + secant(slope_in_glass(n, slope_chief))
    return n**3 * thickness * squares / (flat * flat_chief * longer)


def chief_ray_length(imager: Imager, chief: LensletRay) -> Float[Array, ""]:
    """Length of the chief ray from the vertex, as seen from the sensor, to the sensor, mm."""
    squared = jnp.sum(chief.tangent**2)
    if imager.array.thin_lens_focal_length is not None:
        return imager.reduced_sensor_distance * jnp.sqrt(1 + squared)
    # With the ray's own angle, as in `_height`.
    behind = _air_behind(imager)
    for thickness, n in slabs_behind(imager):
        behind = behind + thickness / square_and_root(n, squared)[1]
    return behind * jnp.sqrt(1 + squared)


def direction_cosines(tangent: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
    """Lateral direction cosines of a ray with the slopes `tangent`."""
    return tangent / jnp.sqrt(1 + jnp.sum(tangent**2, -1, keepdims=True))
