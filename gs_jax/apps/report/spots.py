"""Point spread functions through depth and field, and what contrast they leave."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...geometry import Imager
from ...optics.psf import diffraction_psf, window_fraction

# Pixels of a window, and how many radii of 80 % of the light it is wide; samples in a pixel; of a modulation transfer
# function, with the zeros about the window that make the curve smooth.
_WINDOW, _WIDE, _MOST_SAMPLES, _PADDED = (25, 65), 2.6, 12, 512
# Share of the field radius, and depths that are shown at most.
FIELDS = (0.0, 0.5, 1.0)
_DEPTHS = 5


class Spots(NamedTuple):
    """Spots on the sensor, `[depth, field, row, column]`, each with the sum 1.

    `caught` is the share of the light through the lens that falls into the window; depths and heights are mm.
    """

    images: Float[np.ndarray, "depth field row column"]
    caught: Float[np.ndarray, "depth field"]
    depths: Float[np.ndarray, " depth"]
    heights: Float[np.ndarray, " field"]


def one_lens(imager: Imager, index: int = 0) -> Imager:
    """The same with one kind of lens, where they differ."""
    return imager if imager.array.alike else eqx.tree_at(lambda i: i.array, imager, imager.array.lens(index))


def spots_of(imager: Imager, depths: Float[np.ndarray, " depth"], diameter: float, radius: float) -> Spots:
    """Spots at a few depths over those given, mm, and over the field, by diffraction.

    `diameter` is that of the clear aperture, `radius` holds most of a spot's light on the sensor, mm.
    """
    imager, heights = one_lens(imager), np.array(FIELDS) * imager.field_radius
    chosen = np.linspace(depths.min(), depths.max(), min(_DEPTHS, len(depths)))
    # What falls outside of `samples / s` windows is folded back (`diffraction_psf`).
    s = diameter * imager.sensor.pixel_pitch / (float(imager.wavelength) * float(imager.reduced_sensor_distance))
    samples = int(np.clip(np.ceil(1.3 * s), 2, _MOST_SAMPLES))
    size = 2 * int(np.clip(_WIDE * radius / imager.sensor.pixel_pitch, *_WINDOW) // 2) + 1
    axis = {"radius": jnp.asarray(diameter / 2), "samples": samples}
    images, caught = np.empty((len(chosen), len(heights), size, size)), np.empty((len(chosen), len(heights)))
    for row, depth in enumerate(chosen):
        for column, height in enumerate(heights):
            given = {"field": (jnp.asarray(height), jnp.asarray(0.0)), "size": size, **axis}
            images[row, column] = diffraction_psf(imager, jnp.asarray(depth), **given)
            caught[row, column] = window_fraction(imager, jnp.asarray(depth), **given)
    return Spots(images, caught, chosen, heights)


class Contrast(NamedTuple):
    """A modulation transfer function: contrast at frequencies in the object, 1/mm; mean over x and y."""

    frequency: Float[np.ndarray, " frequency"]
    contrast: Float[np.ndarray, " frequency"]


def contrast(image: Float[np.ndarray, "row column"], caught: float, pixel: float, magnification: float) -> Contrast:
    """Of a spot on pixels, mm, up to the frequency that these resolve.

    Light beside the window is counted as evenly spread, so that between zero and the first frequency of the window the
    curve falls by it.
    """
    across = np.abs(np.fft.rfft(image.sum(0), _PADDED))
    along = np.abs(np.fft.rfft(image.sum(1), _PADDED))
    frequency = np.fft.rfftfreq(_PADDED, pixel) * magnification
    values = caught * (across + along) / 2
    values[0] = 1.0
    return Contrast(frequency, values)


def perfect(frequency: Float[np.ndarray, " frequency"], imager: Imager, depth: float, diameter: float) -> Contrast:
    """That of a lens without errors in focus, round, of this diameter, mm, and of square pixels."""
    v, magnification = float(imager.reduced_sensor_distance), float(imager.magnification(depth))
    on_sensor = frequency / magnification
    share = np.clip(on_sensor * float(imager.wavelength) * v / diameter, 0, 1)
    lens = 2 / np.pi * (np.arccos(share) - share * np.sqrt(1 - share**2))
    return Contrast(frequency, lens * np.abs(np.sinc(on_sensor * imager.sensor.pixel_pitch)))
