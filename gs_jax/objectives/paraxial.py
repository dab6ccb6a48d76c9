"""Quantities by paraxial and third-order optics: resolution, focus, light and Strehl ratio (Eqs. 4-11)."""

import math
from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Float

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
)


@by_type
def f_number(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """F-number of the clear aperture (below Eq. 8); one a type."""
    return theory.f_number(imager.array.focal_length, clear_diameter(imager, depths))


@by_type
def numerical_aperture(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Numerical aperture of the clear aperture, on the sensor's side; one a type."""
    return theory.numerical_aperture(imager.array.focal_length, clear_diameter(imager, depths))


@by_type
def lateral_resolution(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Lateral resolution in focus, without aberrations (Eq. 5); a row a type."""
    at = as_conditions(imager, depths)
    pixel, magnification = imager.sensor.pixel_pitch, imager.magnification(at.depths)
    return theory.lateral_resolution(imager.wavelength, numerical_aperture(imager, at), pixel, magnification)


@by_type
def axial_resolution(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Axial resolution in focus, without aberrations (Eq. 6); a row a type."""
    at = as_conditions(imager, depths)
    along = imager.depth_in_medium(at.depths)
    return theory.axial_resolution(lateral_resolution(imager, at), along, field_radius(imager, at))


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
    return imager.depth_of(theory.near_limit(*_focus(imager, depths)))


@by_type
def far_limit(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """The farthest depth that is in focus with a sensor focused on each depth; a row a type."""
    return imager.depth_of(theory.far_limit(*_focus(imager, depths)))


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
    return imager.sensor_distance_of(reduced)


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
    reduced, v = imager.reduced_depth(at.depths), imager.reduced_sensor_distance
    return theory.object_blur(imager.array.focal_length, clear_diameter(imager, at), reduced, v)


def lenses_per_point(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Number of lenses that see a point, `N_e`: lenses on the plate over its area, times `A_e`."""
    count, radius = float(imager.array.centers.shape[0]), field_radius(imager, as_conditions(imager, depths))
    return theory.lenses_per_point(count, jnp.prod(finite_plate(imager)), radius)


def occupancy(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Occupancy of the sensor, `V = N_e M^2` (Eq. 11), by all lenses."""
    at = as_conditions(imager, depths)
    return theory.occupancy(lenses_per_point(imager, at), imager.magnification(at.depths))


def coverage(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Share of the plate that is clear aperture."""
    count = imager.array.centers.shape[0]
    return count * math.pi / 4 * clear_diameter(imager, depths) ** 2 / jnp.prod(finite_plate(imager))


def light(imager: Imager, depths: Depths) -> Float[Array, " depth"]:
    """Share of a point's light that its `N_e` lenses collect, `N_e pi a^2 / (4 pi n^2 z'^2)` for a clear radius `a`.

    `n` is the index of the object's medium.
    """
    at = as_conditions(imager, depths)
    away = imager.depth_in_medium(at.depths)
    return lenses_per_point(imager, at) * (clear_diameter(imager, at) / 4 / away) ** 2


def field_of_view(imager: Imager, depths: Depths) -> Float[Array, "depth axis"]:
    """Width of the object that is imaged at all, along x and y."""
    at, sensor, plate = as_conditions(imager, depths), imager.sensor, finite_plate(imager)
    widths = jnp.array(sensor.shape[::-1], plate.dtype) * sensor.pixel_pitch
    magnification = imager.magnification(at.depths)[:, None]
    return theory.field_of_view(plate[None], widths[None], magnification, field_radius(imager, at))


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
