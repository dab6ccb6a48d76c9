"""What a reconstruction gets in a given time, as terms of co-design: prescription, light, noise and parallax together.

`transfer`, `linear_error` and `precision` want places; a study names a term and an exposure. A few places of the plate
stand for all.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..design.microscope import Microscope
from .linear_error import lost_power
from .precision import crowded_bound

# Places along a side of the part of the plate whose points see a whole field of lenses.
_PLACES = 2


def volume_error(c: Microscope) -> Float[Array, ""]:
    """Relative error of volumes by the best linear estimate: the root of the mean of `lost_power` over the depths."""
    return jnp.sqrt(jnp.mean(lost_power(c.each, places_of(c))))


def crowded(c: Microscope) -> Float[Array, "depth 3"]:
    """`crowded_bound` of x, y, z at each depth, um."""
    return 1000 * crowded_bound(c.each, places_of(c))


def places_of(c: Microscope) -> Float[Array, "place 2"]:
    """Four places, a field radius from the plate's edge where it is that large, mm."""
    side = jnp.asarray((np.arange(_PLACES) + 0.5) / _PLACES - 0.5, c.plate.dtype)
    inner = jnp.maximum(c.plate - 2 * c.imager.field_radius, c.plate / 4)
    return jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2) * inner[None]
