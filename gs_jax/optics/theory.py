"""Formulas of a lens: focus and its depth (the paper's Eqs. 7 and 8), and diffraction of a round aperture.

Functions of numbers and arrays that broadcast, lengths in mm. Every depth, argument or result, is the reduced depth
`z' = z + t/n` (`Imager.reduced_depth`); in a medium of index n real lengths along z are n times as large. `diameter` is
meant to be that of the clear aperture (`apertures.clear_diameter`); the paper takes the lens's 2 mm in Eqs. 7 and 8.
The paper's other formulas are quantities of an imager, in `gs_jax.objectives`.
"""

import math

import jax.numpy as jnp

from ..base.arrays import safe_quotient, safe_sqrt
from ..base.typing import Real, Result

# Full width at half maximum of a Gaussian, in standard deviations.
FWHM = math.sqrt(8 * math.log(2))


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
