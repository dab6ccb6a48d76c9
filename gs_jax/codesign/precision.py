"""How precisely a point of a crowded scene can be located through the lenses' own images: a Cramer-Rao bound.

`gs_jax.codesign.fisher` has the bound of a point of given light and spot, pixel by pixel. Here light follows from the
aperture and the exposure, and the spot from the prescription. Noise is taken as white over an image: then a lens whose
image of the point moves by `s` tells of it

    F = N^2 / n  integral |2 pi v . s|^2 |H(v)|^2 dv,

for `N` electrons, the transfer function `H` and noise of the density `n`: the matched filter's (Kay, Fundamentals of
Statistical Signal Processing I, 1993, section 3.5). Of a wide halo little is left at frequencies that tell; a Gaussian
of its variance would make no difference between a sharp core in a halo and no core at all. The noise is that of a
scene (`linear_error.noise_density`) and the point's own, at the mean density that its light is in itself.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..designs.microscope import Microscope
from ..geometry import envelope
from .fisher import PRIOR
from .linear_error import noise_density
from .transfer import lens_electrons, transfer_power

# Frequencies, up to the pixels' own highest.
_NODES = 24


def crowded_bound(c: Microscope, places: Float[Array, "place 2"]) -> Float[Array, "depth 3"]:
    """The least standard deviations of x, y, z of points as bright as a lit place of 40 um x 40 um, mm.

    Parameters
    ----------
    c
        Its depths are those of the points.
    places
        `(x, y)` of points, mm. Root mean squares over them are given.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    dtype, highest = c.depths.dtype, 1 / (2 * c.imager.sensor.pixel_pitch)
    frequency = highest * jnp.asarray((nodes + 1) / 2, dtype)
    ring = jnp.asarray(np.pi * weights, dtype) * highest * frequency
    power = transfer_power(c, frequency)
    energy = jnp.sum(ring[None] * power, 1)  # of the spot, squared, 1/mm^2
    slope = jnp.sum(ring[None] * power * (2 * jnp.pi * frequency[None]) ** 2, 1) / 2  # of its derivative by x or y
    electrons, prior = lens_electrons(c), jnp.asarray(PRIOR[:3], dtype)

    def at(place):
        beside = c.imager.array.centers - place[None]
        weight = envelope(jnp.sum(beside**2, 1)[None], c.reduced[:, None], c.field_radius)
        light = electrons[:, None] * weight
        told = light**2 * slope[:, None] / (noise_density(c, c.occupancy) + light * energy[:, None])
        # How far images move, over the magnification: with the point, and with its depth.
        moved = jnp.concatenate(
            [
                jnp.broadcast_to(jnp.eye(2, dtype=dtype), (c.depths.size, len(beside), 2, 2)),
                (beside[None] / c.reduced[:, None, None])[..., None],
            ],
            -1,
        )
        information = jnp.einsum("dl,dlai,dlaj->dij", told * c.magnification[:, None] ** 2, moved, moved)
        return jnp.diagonal(jnp.linalg.inv(information + jnp.diag(prior**-2)[None]), axis1=1, axis2=2)

    return jnp.sqrt(jnp.mean(jax.lax.map(at, places), 0))
