"""PSFs of many depths in one window, which holds the rays of all.

To add a kind of PSF, write its function beside those of `gs_jax.optics.psf` and name it in `PSFS`.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.errors import InputError
from ..geometry import Imager
from .aperture import clear_diameter
from .psf import diffraction_psf, gaussian_psf, geometric_psf
from .unit import unit_rays

PSFS = {"diffraction": diffraction_psf, "geometric": geometric_psf, "gaussian": gaussian_psf}
# Window of the PSF: room for the diffraction around the rays, and the most that the rays may reach, pixels.
_MARGIN, _FARTHEST = 16, 128
# Rays along the aperture's radius that are asked how far they reach.
_ZONES = 65


def psf_of_depth(
    imager: Imager, depths: Sequence[float] | np.ndarray, kind: str, steps: int = 1
) -> Callable[..., Float[Array, "row column"]]:
    """Function from a depth to its PSF, in a window that holds the rays of all depths.

    Rays that the lens reflects totally do not count.

    Parameters
    ----------
    imager
        Its mean clear aperture is taken.
    depths
        Between the nearest and the farthest of them, mm.
    kind
        Of the PSF: a key of `PSFS`.
    steps
        As many pixels of the sensor as make a pixel that is meant: the margins of the window grow with them.

    Raises
    ------
    InputError
        If the rays reach farther than 128 pixels.
    """
    radius = clear_diameter(imager.array) / 2
    # All zones: near the focus of the rim's rays those of other zones land farther out.
    fan = radius * jnp.linspace(0, 1, _ZONES)[:, None] * jnp.array([[1.0, 0.0]])
    ends = [unit_rays(imager, depth, fan) for depth in (min(depths), max(depths))]
    reaches = [float(jnp.where(rays.valid, jnp.abs(rays.landing[:, 0]), 0).max()) for rays in ends]
    pixels = max(reaches) / (imager.sensor.pixel_pitch * steps)
    if not pixels <= _FARTHEST:
        depth = (min(depths), max(depths))[int(np.argmax(reaches))]
        raise InputError(
            f"found an object at {depth:g} mm, blurred over {pixels:.3g} pixels of the sensor each way, "
            f"allowed: {_FARTHEST}."
        )
    size = steps * (2 * math.ceil(pixels + _MARGIN) + 1)
    make = PSFS[kind]
    if kind == "diffraction":  # as fine as the aperture diffracts
        sharp = float(2 * radius * imager.sensor.pixel_pitch / (imager.wavelength * imager.reduced_sensor_distance))
        make = partial(make, samples=math.ceil(sharp))
    return lambda depth: make(imager, depth, size=size, radius=radius)
