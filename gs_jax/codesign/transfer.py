"""What of a scene's detail a microscope's lenses pass on, and with how much light: for terms at equal exposure.

An exposure is a time and a brightness, the same for all candidates: the electrons that each mm^2 of clear aperture, 20
mm away, gets of a lit place of 40 um x 40 um. So an aperture pays for its sharpness, a magnification for its detail.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.arrays import safe_sqrt
from ..geometry import Imager, envelope
from ..objectives.conditions import Conditions, clear_diameter, field_heights, field_radius
from ..optics.raytrace import pupil_quadrature, trace_lenslet

# What an exposure is counted for, mm.
AWAY, PLACE = 20.0, 0.04
# Rings of rays: enough for spots of some twenty periods across.
_RINGS = 16
# Frequencies at which spots read it off.
_READ = 24
# Directions of frequencies over half a turn.
_DIRECTIONS = 4


def directions(dtype) -> Float[Array, "2 direction"]:
    """Unit vectors, evenly over half a turn: the other half says the same."""
    angle = jnp.asarray((np.arange(_DIRECTIONS) + 0.5) * np.pi / _DIRECTIONS, dtype)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def transfer_power(
    imager: Imager, at: Conditions, frequencies: Float[Array, " frequency"]
) -> Float[Array, "depth frequency"]:
    """Squared modulus of the transfer function, mean over a lens's field and over directions.

    The Fourier transform of exact rays through the clear aperture, which has all of defocus and aberrations, times the
    transfer functions of a perfect lens and of a pixel. That product is right in both limits, of a spot much wider
    than the Airy disc and of one without aberrations; between them it is a little low.

    Parameters
    ----------
    imager
        With lenses that are alike.
    at
        Depths, and the exposure.
    frequencies
        On the sensor, 1/mm.
    """
    points, weights = pupil_quadrature(clear_diameter(imager, at) / 2, _RINGS)
    heights, ways = field_heights(imager, at), directions(at.depths.dtype)

    def power(depth, height):
        rays = trace_lenslet(imager, depth, points, (height, jnp.zeros_like(height)))
        lit = jnp.where(rays.valid, weights, 0)
        # What is reflected totally at the rim is missing. From the middle of the spot, for small phases.
        middle = jnp.sum(lit[:, None] * rays.landing, 0) / jnp.maximum(jnp.sum(lit), 1e-6)
        phase = 2 * jnp.pi * frequencies[:, None, None] * ((rays.landing - middle[None]) @ ways)[None]
        parts = (jnp.einsum("r,frw->fw", lit, wave(phase)) for wave in (jnp.cos, jnp.sin))
        return jnp.mean(sum(part**2 for part in parts), 1)

    found = jax.lax.map(lambda depth: jax.vmap(power, (None, 0))(depth, heights), at.depths)
    weight = envelope(heights[None] ** 2, imager.reduced_depth(at.depths)[:, None], field_radius(imager, at))
    mean = jnp.einsum("dh,dhf->df", weight / jnp.sum(weight, 1, keepdims=True), found)
    others = _perfect(imager, at, frequencies) * jnp.sinc(frequencies * imager.sensor.pixel_pitch)
    return mean * (others**2)[None]


def _perfect(imager: Imager, at: Conditions, frequencies):
    """Transfer function of a round aperture without aberrations."""
    share = frequencies * imager.wavelength * imager.reduced_sensor_distance / clear_diameter(imager, at)
    share = jnp.minimum(share, 1 - 1e-6)  # where it ends its slope by the share is zero, and arccos has none
    return 2 / jnp.pi * (jnp.arccos(share) - share * safe_sqrt(1 - share**2))


def spots(imager: Imager, at: Conditions, size: int) -> Float[Array, "depth size size"]:
    """Even spots with the transfer function's modulus, on the sensor's pixels, with the sum 1: PSFs for `forward`.

    What of a spot is not even, and where the transfer function is negative, is not in them; light beyond the window
    is in it at the other side. The root of `transfer_power` is read off between 24 frequencies.

    Parameters
    ----------
    size
        Pixels along a side, odd.
    """
    dtype, pixel = at.depths.dtype, imager.sensor.pixel_pitch
    own = jnp.asarray(np.linspace(0, np.sqrt(0.5), _READ), dtype)
    modulus = safe_sqrt(transfer_power(imager, at, own / pixel))
    along = np.fft.fftfreq(size)
    away = jnp.asarray(np.hypot(along[:, None], along[None]), dtype)
    table = jax.vmap(lambda values: jnp.interp(away, own, values))(modulus)
    light = jnp.maximum(jnp.fft.fftshift(jnp.real(jnp.fft.ifft2(table)), axes=(1, 2)), 0)
    return light / jnp.sum(light, (1, 2), keepdims=True)


def lens_electrons(imager: Imager, at: Conditions) -> Float[Array, " depth"]:
    """Electrons that a lens on its axis gets of a lit place of 40 um x 40 um, or of a point as bright as that."""
    area = jnp.pi / 4 * clear_diameter(imager, at) ** 2
    return at.exposure * area * (AWAY / imager.reduced_depth(at.depths)) ** 2


def lit_density(imager: Imager, at: Conditions) -> Float[Array, " depth"]:
    """Electrons per mm^2 of the sensor behind a lens that images a lit plane."""
    return lens_electrons(imager, at) / (PLACE * imager.magnification(at.depths)) ** 2
