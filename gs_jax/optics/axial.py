"""The Strehl ratio of a lens unit on its axis by one line of rays: fast enough for thousands of lenses.

`gs_jax.optics.psf.strehl` has any field, any aperture and the peak wherever it is, for as much as a thousand times the
work. A spot on the axis is round, and what `gs_jax.optics.exit_pupil` sums over the exit pupil is an integral over its
radius `u`: with the phase `phi` of the path there, and light that is even over the lens, hence the amplitude
`sqrt(r dr / (u du))` of the lens's radius `r`, the field in the middle is `int exp(2 pi i phi / wavelength)
sqrt(u u'/r) r dr`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..geometry import Imager
from .unit import chief_length, pupil_radius, unit_rays

# Of Gauss and Legendre's rule in the squared radius: the path may change by dozens of waves.
_NODES = 64


def axial_strehl(
    imager: Imager, depth: Float[ArrayLike, ""], *, radius: Float[ArrayLike, ""] | None = None
) -> Float[Array, ""]:
    """Irradiance in the middle of the spot of a point on the axis, over that without aberrations and defocus.

    Where the Strehl ratio is above 0.1 the middle is the peak; a spot far out of focus may be brighter around it.

    Parameters
    ----------
    imager
        The lens, the light and the sensor's distance.
    depth
        `z` of the object point, mm.
    radius
        Of the clear aperture, mm. Half the aperture's diameter by default.
    """
    radius = pupil_radius(imager, radius)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    at = radius * jnp.asarray(np.sqrt((nodes + 1) / 2), radius.dtype)
    distance = chief_length(imager, unit_rays(imager, depth, np.zeros(2)))

    def trace(at):
        rays = unit_rays(imager, depth, jnp.stack([at, jnp.zeros_like(at)], -1))
        tangent, end = rays.tangent[:, 0], rays.landing[:, 0]
        sine = tangent / jnp.sqrt(1 + tangent**2)
        return end - distance * sine, (rays.path - end * sine + end**2 / (2 * distance), rays.valid)

    seen, denser, (path, valid) = jax.jvp(trace, (at,), (jnp.ones_like(at),), has_aux=True)
    squared = seen * denser / at
    lit = valid & (squared > 0)
    amplitude = jnp.where(lit, jnp.asarray(weights, at.dtype) * jnp.sqrt(jnp.where(lit, squared, 1)), 0)
    phase = jnp.where(lit, 2 * np.pi / imager.wavelength * path, 0)
    light = jnp.sum(amplitude * jnp.cos(phase)) ** 2 + jnp.sum(amplitude * jnp.sin(phase)) ** 2
    return light / jnp.sum(amplitude) ** 2
