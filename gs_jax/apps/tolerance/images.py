"""How sharp the images of a device are: the width of its spots and the Strehl ratio, depth by depth."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...geometry import Imager
from ...objectives.conditions import Conditions, clear_diameter
from ...objectives.spot_size import spot_width
from ...optics.psf import axial_strehl
from ...optics.theory import FWHM
from .device_model import Errors, built
from .surface import lens_squares, log_strehl_of_height


def log_sharpness(
    nominal: Imager, at: Conditions, errors: Errors, pixel: Float[Array, ""]
) -> tuple[Float[Array, " depth"], Float[Array, " depth"]]:
    """Logarithms of the spots' width, in the object, mm, and of the Strehl ratio on the axis.

    Both are averages over the plate (the width's square), whose tilt brings lenses nearer to the sensor or farther; the
    width's over the field, too, as `gs_jax.objectives.spot_width` has it. Slopes that steps of the printer add widen
    spots by `(n - 1)` times the slope times `v'`.

    Parameters
    ----------
    nominal, at
        As designed, and the depths.
    errors
        Of the device, in mm and slopes.
    pixel
        Of the printer, mm.
    """
    # Where lenses are does not change images.
    errors = dataclasses.replace(errors, centers=jnp.zeros_like(nominal.array.centers))
    imager = built(nominal, errors)
    widths, ratios = jax.vmap(lambda height: _sharpness(nominal, at, imager, height))(_heights(nominal, imager))
    array, radius = imager.array, clear_diameter(nominal, at) / 2
    height_square, slope_square = lens_squares(array, radius, errors.layer, pixel, imager.wavelength)
    # A printer's steps are along the radius: half of their slopes' square is along each axis.
    bent = (array.refractive_index - 1) * imager.reduced_depth(at.depths)
    squared = jnp.mean(widths**2, 0) + (FWHM * bent) ** 2 * slope_square / 2
    kept = log_strehl_of_height(errors.roughness**2 + height_square, array.refractive_index, imager.wavelength)
    return jnp.log(squared) / 2, jnp.log(jnp.mean(ratios, 0)) + kept


def _heights(nominal: Imager, imager: Imager) -> Float[Array, " place"]:
    """Of four places of the plate, about as high as its lenses: at the RMS of their coordinates, mm.

    The square of a width is a quadratic of the height, so that this average is the lenses'.
    """
    x, y = jnp.sqrt(jnp.mean(nominal.centers**2, 0))
    places = jnp.stack([jnp.stack([x, y]), jnp.stack([x, -y]), jnp.stack([-x, y]), jnp.stack([-x, -y])])
    assert imager.tilt is not None
    return places @ imager.tilt


def _sharpness(nominal, at, imager, height):
    """Of a lens that is higher above the sensor."""
    lifted = dataclasses.replace(imager, sensor_distance=imager.sensor_distance + height)
    radius = clear_diameter(nominal, at) / 2
    ratio = jax.vmap(lambda depth: axial_strehl(lifted, depth, radius=radius))(at.depths)
    return spot_width(lifted, at), ratio
