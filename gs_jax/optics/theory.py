"""Formulas of resolution, depth of field and occupancy: the paper's (Eqs. 4-8, 11), and those of diffraction.

Functions of numbers and arrays that broadcast, lengths in mm. Every depth, argument or result, is the reduced depth
`z' = z + t/n` (`Imager.reduced_depth`); in a medium of index n real lengths along z are n times as large. `diameter` is
meant to be that of the clear aperture (`apertures.clear_diameter`); the paper takes the lens's 2 mm in Eqs. 7 and 8,
and the pitch in its numerical aperture.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..base.arrays import safe_quotient, safe_sqrt
from ..typing import Real, Result

# Full width at half maximum of a Gaussian, in standard deviations.
FWHM = math.sqrt(8 * math.log(2))


def f_number(focal_length: Real, diameter: Real) -> Result:
    """F-number `F = f/D` (below Eq. 8)."""
    return jnp.asarray(focal_length) / diameter


def numerical_aperture(focal_length: Real, diameter: Real) -> Result:
    """Numerical aperture `NA = D / (2 f)` on the sensor's side; the paper's "effective NA" of 0.13 is for the pitch."""
    return jnp.asarray(diameter) / (2 * focal_length)


def diffraction_limit(wavelength: Real, numerical_aperture: Real, magnification: Real) -> Result:
    """Lateral resolution of a perfect lens, in the object: `lambda / (2 NA) / M` (Eq. 4), mm."""
    return jnp.asarray(wavelength) / (2 * numerical_aperture) / magnification


def lateral_resolution(wavelength: Real, numerical_aperture: Real, pixel: Real, magnification: Real) -> Result:
    """Lateral resolution, in the object: `max(lambda / (2 NA), d_p) / M` (Eq. 5), mm.

    In focus and without aberrations. Its derivative jumps where the spot is as large as the pixel.
    """
    return jnp.maximum(diffraction_limit(wavelength, numerical_aperture, 1), pixel) / magnification


def airy_sigma(wavelength: Real, distance: Real, diameter: Real) -> Result:
    """Standard deviation of the Gaussian as wide at half its height as the Airy disc, `1.029 lambda v / D`, mm."""
    return 1.029 * jnp.asarray(wavelength) * distance / diameter / FWHM


def cutoff_frequency(wavelength: Real, distance: Real, diameter: Real) -> Result:
    """Highest spatial frequency that a round aperture transfers to the sensor, `D / (lambda v)`, 1/mm."""
    return jnp.asarray(diameter) / (wavelength * distance)


def ideal_mtf(frequency: Real, cutoff: Real) -> Result:
    """Modulation transfer of a round aperture without aberrations, in focus; 0 from `cutoff` on.

    `(2/pi) (arccos s - s sqrt(1 - s^2))` with `s = frequency / cutoff`.
    """
    share = jnp.minimum(jnp.asarray(frequency) / cutoff, 1 - 1e-6)  # arccos has no derivative at 1
    return 2 / jnp.pi * (jnp.arccos(share) - share * safe_sqrt(1 - share**2))


def axial_resolution(lateral: Real, reduced_depth: Real, field_radius: Real) -> Result:
    """Axial resolution `r_xy z / sqrt(A_e / pi)` (Eq. 6), mm."""
    return jnp.asarray(lateral) * reduced_depth / field_radius


def focus_distance(focal_length: Real, reduced_depth: Real) -> Result:
    """Image distance of a thin lens, `1/v_f = 1/f - 1/z'`, mm; infinite for `z' <= f`."""
    return safe_quotient(jnp.asarray(focal_length) * reduced_depth, jnp.asarray(reduced_depth) - focal_length)


def depth_in_focus(focal_length: Real, sensor_distance: Real) -> Result:
    """Reduced depth whose thin-lens image is on the sensor, `1/z' = 1/f - 1/v`, mm; infinite for `v <= f`."""
    return focus_distance(focal_length, sensor_distance)


def blur(focal_length: Real, diameter: Real, reduced_depth: Real, sensor_distance: Real) -> Result:
    """Diameter of a defocused point on the sensor, `D |v - v_f| / v_f`, mm, by the rays of a thin lens.

    Written as `D |1 - v (1/f - 1/z')|`, which holds for virtual images too.
    """
    vergence = 1 / jnp.asarray(focal_length) - 1 / jnp.asarray(reduced_depth)
    return jnp.abs(1 - vergence * sensor_distance) * diameter


def object_blur(focal_length: Real, diameter: Real, reduced_depth: Real, sensor_distance: Real) -> Result:
    """`blur` in the object, `blur / M` with `M = v/z'` (Eq. 3), mm."""
    return blur(focal_length, diameter, reduced_depth, sensor_distance) * reduced_depth / sensor_distance


def near_limit(focal_length: Real, f_number: Real, reduced_depth: Real, circle_of_confusion: Real) -> Result:
    """Nearest depth that is sharp when the sensor is focused on `z'` (Eq. 8), mm.

    `z_N = z f^2 / (f^2 - c F f + c F z)`, where the patch on the sensor is `circle_of_confusion`, a diameter in mm.
    """
    squared = jnp.asarray(focal_length) ** 2
    return squared * reduced_depth / (squared + circle_of_confusion * f_number * (reduced_depth - focal_length))


def far_limit(focal_length: Real, f_number: Real, reduced_depth: Real, circle_of_confusion: Real) -> Result:
    """Farthest depth that is sharp when the sensor is focused on `z'` (Eq. 8), mm.

    `z_F = z f^2 / (f^2 + c F f - c F z)`; infinite from the hyperfocal distance `f^2 / (c F) + f` on.
    """
    squared = jnp.asarray(focal_length) ** 2
    return safe_quotient(
        reduced_depth * squared, squared - circle_of_confusion * f_number * (jnp.asarray(reduced_depth) - focal_length)
    )


def depth_of_field(focal_length: Real, f_number: Real, reduced_depth: Real, circle_of_confusion: Real) -> Result:
    """Depth of field `z_F - z_N`, the exact difference of Eq. 8, mm; infinite from the hyperfocal distance on."""
    arguments = (focal_length, f_number, reduced_depth, circle_of_confusion)
    return far_limit(*arguments) - near_limit(*arguments)


def approximate_depth_of_field(
    focal_length: Real, f_number: Real, reduced_depth: Real, circle_of_confusion: Real
) -> Result:
    """The paper's approximation `2 F c z^2 f^2 / (f^4 - F^2 c^2 z^2)` (Eq. 7), mm.

    It neglects `f` beside `z`: it is larger than `depth_of_field` by the factor `z / (z - f)` for a small
    circle of confusion: 1.3 for the paper's lens at 20 mm.
    """
    squared = jnp.asarray(focal_length) ** 2
    spread = jnp.asarray(f_number) * circle_of_confusion * reduced_depth
    return safe_quotient(2 * spread * reduced_depth * squared, squared**2 - spread**2)


def effective_area(field_radius: Real) -> Result:
    """Area of the lenses that see a point, `A_e = pi r^2`, mm^2."""
    return math.pi * jnp.asarray(field_radius) ** 2


def lenses_per_point(count: Real, plate_area: Real, field_radius: Real) -> Result:
    """Mean number `N_e` of lenses that see a point near the plate's middle: their density times `A_e`."""
    return effective_area(field_radius) * count / plate_area


def count_lenses(
    centers: Float[Array | np.ndarray, "lens 2"], points: Float[Array | np.ndarray, "point 2"], field_radius: Real
) -> Int[Array, " point"]:
    """Number of lenses within the field radius of each point `(x, y)`: `N_e` counted. It has no gradient."""
    squared = jnp.sum((jnp.asarray(centers)[None] - jnp.asarray(points)[:, None]) ** 2, axis=2)
    return jnp.sum(squared <= jnp.asarray(field_radius) ** 2, axis=1)


def occupancy(lenses_per_point: Real, magnification: Real) -> Result:
    """Occupancy `V = N_e M^2` (Eq. 11): the illuminated fraction of the sensor for an object that fills the field."""
    return jnp.asarray(magnification) ** 2 * lenses_per_point


def field_of_view(plate: Real, sensor: Real, magnification: Real, field_radius: Real) -> Result:
    """Width of the object along an axis that at least one lens images onto the sensor, mm.

    A lens at `c`, `|c| <= plate/2`, sees a point at `q` within the field radius r whose chief ray lands at
    `|s c - M q| <= sensor/2`. The outermost such lens, at `c = min(plate/2, sensor/2 + M r)`, sees points up to `c +
    r`.
    """
    half = jnp.asarray(sensor) / 2 + magnification * field_radius
    return 2 * (jnp.minimum(jnp.asarray(plate) / 2, half) + field_radius)
