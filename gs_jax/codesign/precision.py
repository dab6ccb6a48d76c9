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

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..geometry import Imager, envelope
from ..objectives.conditions import Conditions, field_radius
from .fisher import PRIOR
from .linear_error import noise_density
from .transfer import lens_electrons, transfer_power

# Frequencies, up to the pixels' own highest.
_NODES = 24


def crowded_bound(
    parts: Sequence[tuple[Imager, Conditions]], places: Float[Array, "place 2"]
) -> Float[Array, "depth 3"]:
    """The least standard deviations of x, y, z of points as bright as a lit place of 40 um x 40 um, mm.

    Parameters
    ----------
    parts
        The lenses of each type and their conditions, as of `gs_jax.objectives.conditions.per_type`. The depths are
        those of the points.
    places
        `(x, y)` of points, mm. Root mean squares over them are given.
    """
    spots = [_spot(*part, parts) for part in parts]
    prior = jnp.asarray(PRIOR[:3], parts[0][1].depths.dtype)

    def at(place):
        told = sum(_information(*part, spot, place) for part, spot in zip(parts, spots, strict=True))
        return jnp.diagonal(jnp.linalg.inv(told + jnp.diag(prior**-2)[None]), axis1=1, axis2=2)

    return jnp.sqrt(jnp.mean(jax.lax.map(at, places), 0))


def _spot(imager, at, parts):
    """At each depth of the spot of a lens its squared light, 1/mm^2, and of its derivative by x or y; and its noise."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    dtype, highest = at.depths.dtype, 1 / (2 * imager.sensor.pixel_pitch)
    frequency = highest * jnp.asarray((nodes + 1) / 2, dtype)
    ring = jnp.asarray(np.pi * weights, dtype) * highest * frequency
    power = transfer_power(imager, at, frequency)
    energy = jnp.sum(ring[None] * power, 1)
    slope = jnp.sum(ring[None] * power * (2 * jnp.pi * frequency[None]) ** 2, 1) / 2
    return energy, slope, noise_density(imager, at, parts)


def _information(imager, at, spot, place) -> Float[Array, "depth 3 3"]:
    """Information about `x, y, z` of a point at a place by these lenses."""
    energy, slope, noise = spot
    beside = imager.array.centers - place[None]
    weight = envelope(jnp.sum(beside**2, 1)[None], imager.reduced_depth(at.depths)[:, None], field_radius(imager, at))
    light = lens_electrons(imager, at)[:, None] * weight
    told = light**2 * slope[:, None] / (noise + light * energy[:, None])
    # How far images move, over the magnification: with the point, and with its depth.
    moved = jnp.concatenate(
        [
            jnp.broadcast_to(jnp.eye(2, dtype=at.depths.dtype), (at.depths.size, len(beside), 2, 2)),
            (beside[None] / imager.reduced_depth(at.depths)[:, None, None])[..., None],
        ],
        -1,
    )
    return jnp.einsum("dl,dlai,dlaj->dij", told * imager.magnification(at.depths)[:, None] ** 2, moved, moved)
