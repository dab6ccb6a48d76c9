"""Quantities of an imager: by paraxial and third-order optics (Eqs. 4-11), and by the array's geometry.

The first are resolution, focus, light and Strehl ratio, the others spacing, gaps between apertures, height and slope of
the lenses.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..base.arrays import safe_sqrt
from ..geometry import Imager
from ..layers import object_index
from ..optics import aberrations, theory
from ..optics.aberrations import WavefrontCoefficients
from .conditions import (
    Depths,
    as_conditions,
    best_type,
    by_type,
    clear_diameter,
    field_heights,
    field_radius,
    finite_plate,
    whole_array,
)


@by_type
def f_number(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """F-number `f / D` of the clear aperture (below Eq. 8); one a type."""
    return imager.array.focal_length / clear_diameter(imager, depths)


@by_type
def numerical_aperture(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Numerical aperture `D / (2 f)` of the clear aperture, on the sensor's side; one a type.

    The paper's "effective NA" of 0.13 takes the pitch for `D`.
    """
    return clear_diameter(imager, depths) / (2 * imager.array.focal_length)


@by_type
def lateral_resolution(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Lateral resolution in focus, without aberrations, `max(lambda / (2 NA), d_p) / M` (Eqs. 4, 5); a row a type.

    Its derivative jumps where the spot is as large as the pixel.
    """
    at = as_conditions(imager, depths)
    diffraction = imager.wavelength / (2 * numerical_aperture(imager, at))
    return jnp.maximum(diffraction, imager.sensor.pixel_pitch) / imager.magnification(at.depths)


@by_type
def axial_resolution(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Axial resolution in focus, without aberrations, `r_xy z / sqrt(A_e / pi)` (Eq. 6); a row a type."""
    at = as_conditions(imager, depths)
    return lateral_resolution(imager, at) * imager.depth_in_medium(at.depths) / field_radius(imager, at)


@by_type
def depth_of_field(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Depth of field of a sensor that is focused on each depth (Eq. 8); infinite beyond the hyperfocal distance."""
    return theory.depth_of_field(*_focus(imager, depths)) * object_index(imager.sample)


@by_type
def approximate_depth_of_field(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Depth of field by the approximation of Eq. 7; a row a type."""
    return theory.approximate_depth_of_field(*_focus(imager, depths)) * object_index(imager.sample)


@by_type
def near_limit(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """The nearest depth that is in focus with a sensor focused on each depth; a row a type."""
    at = as_conditions(imager, depths)
    return imager.depth_of(theory.near_limit(*_focus(imager, at))) + (0 if at.height is None else at.height)


@by_type
def far_limit(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """The farthest depth that is in focus with a sensor focused on each depth; a row a type."""
    at = as_conditions(imager, depths)
    return imager.depth_of(theory.far_limit(*_focus(imager, at))) + (0 if at.height is None else at.height)


def _focus(imager, depths):
    at = as_conditions(imager, depths)
    circle_of_confusion = 2 * imager.sensor.pixel_pitch if at.circle_of_confusion is None else at.circle_of_confusion
    circle_of_confusion = jnp.asarray(circle_of_confusion, at.depths.dtype)
    return imager.array.focal_length, f_number(imager, at), imager.reduced_depth(at.depths), circle_of_confusion


@by_type
def focus_distance(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Sensor distance `v` at which a thin lens images each depth; infinite if it does not; a row a type."""
    at = as_conditions(imager, depths)
    reduced = theory.focus_distance(imager.array.focal_length, imager.reduced_depth(at.depths))
    return imager.sensor_distance_of(reduced) - (0 if at.height is None else at.height)


@by_type
def focus_offset(imager: Imager, depths: Depths) -> Float[Array, ""]:
    """Distance of the depth in focus (thin lens) from the middle of the depths, in vergence; one a type.

    It is 1 at the nearest and the farthest depth. In vergence, focus at infinity and beyond is nothing special.
    """
    at, f = as_conditions(imager, depths), imager.array.focal_length
    near, far = imager.reduced_depth(at.depths[0]), imager.reduced_depth(at.depths[-1])
    in_focus = 1 / f - 1 / imager.reduced_sensor_distance
    return jnp.abs(2 * in_focus - 1 / near - 1 / far) / (1 / near - 1 / far)


@by_type
def sensor_blur(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Diameter of a thin lens's blur on the sensor; a row a type."""
    at = as_conditions(imager, depths)
    reduced, v = imager.reduced_depth(at.depths), imager.reduced_sensor_distance
    return theory.blur(imager.array.focal_length, clear_diameter(imager, at), reduced, v)


@best_type
def blur(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Diameter of a thin lens's blur in the object; of the best type."""
    at = as_conditions(imager, depths)
    return sensor_blur(imager, at) / imager.magnification(at.depths)


@whole_array
def lenses_per_point(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Number of lenses that see a point, `N_e`: lenses on the plate over its area, times `A_e = pi r^2`."""
    at = as_conditions(imager, depths)
    return jnp.pi * field_radius(imager, at) ** 2 * _count(imager, at) / jnp.prod(finite_plate(imager))


def _count(imager, at):
    """Number of the lenses that are meant."""
    return float(len(imager.array.centers)) if at.lenses is None else jnp.sum(at.lenses).astype(at.depths.dtype)


@whole_array
def occupancy(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Occupancy of the sensor, `V = N_e M^2` (Eq. 11), by all lenses.

    The illuminated fraction of the sensor, for an object that fills the field.
    """
    at = as_conditions(imager, depths)
    return imager.magnification(at.depths) ** 2 * lenses_per_point(imager, at)


@partial(whole_array, aperture=True)
def coverage(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Share of the plate that is clear aperture."""
    at = as_conditions(imager, depths)
    discs = _count(imager, at) * math.pi / 4 * clear_diameter(imager, at) ** 2
    return discs / jnp.prod(finite_plate(imager))


@partial(whole_array, aperture=True)
def light(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Share of a point's light that its `N_e` lenses collect, `N_e pi a^2 / (4 pi n^2 z'^2)` for a clear radius `a`.

    `n` is the index of the object's medium.
    """
    at = as_conditions(imager, depths)
    away = imager.depth_in_medium(at.depths)
    return lenses_per_point(imager, at) * (clear_diameter(imager, at) / 4 / away) ** 2


@whole_array
def field_of_view(imager: Imager, depths: Depths) -> Float[Array, "depth axis"]:
    """Width of the object that at least one lens images onto the sensor, along x and y.

    A lens at `c`, `|c| <= plate/2`, sees a point at `q` within the field radius r whose chief ray lands at
    `|s c - M q| <= sensor/2`. The outermost such lens, at `c = min(plate/2, sensor/2 + M r)`, sees points up to `c +
    r`.
    """
    at, sensor, plate = as_conditions(imager, depths), imager.sensor, finite_plate(imager)
    half = jnp.array(sensor.shape[::-1], plate.dtype) * (sensor.pixel_pitch / 2)
    radius = field_radius(imager, at)
    reach = half[None] + imager.magnification(at.depths)[:, None] * radius
    return 2 * (jnp.minimum(plate[None] / 2, reach) + radius)


@whole_array
def thickness(imager: Imager) -> Float[Array, ""]:
    """Thickness of the device: from its front, that of the array or of the filters on it, to the sensor."""
    thickness = imager.sensor_distance + imager.array.substrate_thickness
    return thickness if imager.filters is None else thickness + imager.filters.total


def third_order_wavefront(imager: Imager, depths: Depths, heights: Float[Array, " field"]) -> WavefrontCoefficients:
    """Third-order errors of lenses that are alike at heights beside a lens's axis: `(depth, field)`, or broadcast."""
    at = as_conditions(imager, depths)
    radius, reduced = clear_diameter(imager, at) / 2, imager.reduced_depth(at.depths)
    return aberrations.seidel_of_array(
        imager.array, radius, reduced[:, None], heights[None], imager.reduced_sensor_distance
    )


@partial(best_type, best=jnp.argmax)
def log_strehl(imager: Imager, depths: Depths) -> Float[Array, "depth field"]:
    """Logarithm of the Strehl ratio (Eq. 9 with Eq. 10) at four heights of the field; of the best type."""
    at = as_conditions(imager, depths)
    wavefront = third_order_wavefront(imager, at, field_heights(imager, at))
    return aberrations.log_strehl(aberrations.linear_rms(wavefront), imager.wavelength)


def strehl(imager: Imager, depths: Depths) -> Float[Array, "depth field"]:
    """Strehl ratio (Eq. 9 with Eq. 10) at four heights of the field, 0 to 1; of the best type."""
    return jnp.exp(log_strehl(imager, depths))


@best_type
def wavefront_error(imager: Imager, depths: Depths) -> Float[Array, "depth field"]:
    """RMS of the third-order wavefront, astigmatism and field curvature included, in waves; of the best type."""
    at = as_conditions(imager, depths)
    wavefront = third_order_wavefront(imager, at, field_heights(imager, at))
    return aberrations.independent_rms(wavefront) / imager.wavelength


# Points along a side of the plate where the distance to the nearest lens is computed, and along a lens's radius.
_POINTS = 41
# The curvature, 1/mm, below which a surface counts as flat.
_FLAT = 1e-6


@whole_array
def spacing(imager: Imager) -> Float[Array, " lens"]:
    """Distance of each lens from its nearest neighbour; infinite for a single lens."""
    return safe_sqrt(_nearest(_squared_distances(imager.array.centers, imager.array.centers)))


@whole_array
def aperture_gap(imager: Imager) -> Float[Array, " lens"]:
    """Gap between each lens's aperture and the nearest other one; negative where they overlap.

    It is the smallest feature of a mask that blocks the light between the lenses.
    """
    centers, radius = imager.array.centers, imager.array.of_lenses("aperture_diameter") / 2
    return _nearest(safe_sqrt(_squared_distances(centers, centers)) - radius[:, None] - radius[None])


@whole_array
def uncovered_distance(imager: Imager) -> Float[Array, " point"]:
    """Distance of 41 x 41 points of the plate, from edge to edge, from the nearest lens centre."""
    plate = finite_plate(imager)
    side = jnp.linspace(-0.5, 0.5, _POINTS, dtype=plate.dtype)
    points = jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2) * plate[None]
    return safe_sqrt(jnp.min(_squared_distances(points, imager.array.centers), 1))


def _squared_distances(points, centers):
    return jnp.sum((points[:, None] - centers[None]) ** 2, -1)


def _nearest(distances):
    return jnp.min(jnp.where(jnp.eye(len(distances), dtype=bool), jnp.inf, distances), 1)


@by_type
def sag(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Height of a whole lens, of a sphere `R - sqrt(R^2 - D^2/4)`: the depth of the mold; one a type."""
    return imager.array.sag(_on_surface(imager, (imager.array.aperture_diameter / 2) ** 2))


@by_type
def edge_slope(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Slope of the surface at the rim of the clear disc, of a sphere `asin(a / R)`, radians; one a type."""
    square = _on_surface(imager, (clear_diameter(imager, depths) / 2) ** 2)
    return jnp.arctan(safe_sqrt(square) * imager.array.sag_slope_over_r(square))


@by_type
def surface_radius(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, " point"]:
    """Radius of curvature of the surface at points from the vertex to the rim: a cutting tool's is below the least."""
    diameter = clear_diameter(imager, depths)
    radii = jnp.linspace(0, 1, _POINTS, dtype=diameter.dtype) * diameter / 2
    array, square = imager.array, _on_surface(imager, radii**2)
    sag_slope_over_r, change = jax.jvp(array.sag_slope_over_r, (square,), (jnp.ones_like(square),))
    length2 = 1 + square * sag_slope_over_r**2
    # Along the radius s'' / (1 + s'^2)^(3/2), across it s' / r / (1 + s'^2)^(1/2).
    along, across = (sag_slope_over_r + 2 * square * change) / length2**1.5, sag_slope_over_r / length2**0.5
    return 1 / jnp.maximum(jnp.maximum(along, across), _FLAT)


def _on_surface(imager, squared_radius):
    """Squared radii, limited to where a conic surface ends."""
    array = imager.array
    ends = 1 + array.conic_constant > 0
    end = (1 - 1e-6) ** 2 * array.radius_of_curvature**2 / jnp.where(ends, 1 + array.conic_constant, 1)
    return jnp.where(ends, jnp.minimum(squared_radius, end), squared_radius)
