"""The clear aperture of each lens, and the pitch of an array, as JAX functions of the centres.

The array's surface is the upper envelope of the lenses' spherical caps, so a lens ends where it meets its neighbours'
caps: its clear aperture is its Voronoi cell, within the disc of `aperture_diameter` and within the plate. Seen from
the vertex it is star-shaped, so its edge is one distance in each direction. `gs_jax.layouts.cells` has areas and
distances too, on the host and without derivatives.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..base.safe import safe_sqrt
from ..lenses import MicrolensArray

# Lenses that are handled at once.
_LENSES = 16
# Neighbours that may bound a lens's area. A cell of a random layout has six on average.
_NEIGHBOURS = 64


@jax.jit
def aperture_area(array: MicrolensArray) -> Float[Array, " lens"]:
    """Area of each lens's clear aperture, `1/2 int r^2 dphi` over its edge `r(phi)`, mm^2.

    The integral is exact, a sum over the straight edges; so are its derivatives, which a quadrature in angle gets wrong
    at the corners. Only the 64 nearest lenses count as neighbours: enough unless the lenses are in heaps of more
    than that.

    Raises
    ------
    ValueError
        If lenses differ: what bounds them are no straight edges.
    """
    array.check_alike()
    count = min(_NEIGHBOURS, array.centers.shape[0] - 1)
    radius = array.aperture_diameter / 2
    sides = jnp.array([[1, 0], [-1, 0], [0, 1], [0, -1]], array.centers.dtype)

    def area(lens):
        offset = array.centers - array.centers[lens][None]
        _, near = lax.top_k(-jnp.sum(offset**2, axis=1), count + 1)
        normal, height = _bisectors(offset[near], array.aperture_diameter)
        # Where the plate goes on, a line beyond the disc closes the polygon, and changes nothing.
        half = jnp.repeat(jnp.array(array.size, height.dtype) / 2, 2)
        room = jnp.minimum(half - sides @ array.centers[lens], array.aperture_diameter)
        return _disc_within(jnp.concatenate([normal, sides]), jnp.concatenate([height, room]), radius)

    return _for_each_lens(area, array.centers)


def clear_diameter(array: MicrolensArray) -> Float[Array, ""]:
    """Diameter of the disc whose area is the mean clear aperture of the lenses, mm."""
    return jnp.sqrt(4 / math.pi * jnp.mean(aperture_area(array)))


@jax.jit
def pitch(centers: Float[Array | np.ndarray, "lens 2"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean and standard deviation of the lenses' distances to their nearest neighbours, mm.

    The paper's "average pitch size" is this mean. A single lens has an infinite pitch with a deviation of zero. Where a
    distance or the deviation is zero it has no derivative, and zero is given.
    """
    centers = jnp.asarray(centers)
    if centers.shape[0] == 1:
        return jnp.full((), jnp.inf, centers.dtype), jnp.zeros((), centers.dtype)

    def nearest(lens):
        squared = jnp.sum((centers - centers[lens][None]) ** 2, axis=1)
        return jnp.min(jnp.where(jnp.arange(centers.shape[0]) == lens, jnp.inf, squared))

    distances = safe_sqrt(_for_each_lens(nearest, centers))
    mean = jnp.mean(distances)
    return mean, safe_sqrt(jnp.mean((distances - mean) ** 2))


def _bisectors(offset, diameter):
    """Unit normals and distances of the lines halfway to lenses at these offsets; of the lens itself, out of reach."""
    distance = safe_sqrt(jnp.sum(offset**2, axis=1))
    apart = distance > 0
    along_x = jnp.array([[1, 0]], offset.dtype)
    normal = jnp.where(apart[:, None], offset, along_x) / jnp.where(apart, distance, 1)[:, None]
    return normal, jnp.where(apart, distance / 2, diameter)


def _disc_within(normal, height, radius):
    """Area that a disc shares with the polygon of lines at these distances from its centre.

    Each edge of the polygon, from `low` to `high` along its line, makes a triangle with the centre.
    """
    cos = normal @ normal.T
    sin = normal[:, :1] * normal[:, 1:].T - normal[:, 1:] * normal[:, :1].T
    crossing = jnp.abs(sin) > 8 * jnp.finfo(height.dtype).eps
    where = (height[None] - height[:, None] * cos) / jnp.where(crossing, sin, 1)
    high = jnp.min(jnp.where(crossing & (sin > 0), where, jnp.inf), axis=1)
    low = jnp.max(jnp.where(crossing & (sin < 0), where, -jnp.inf), axis=1)
    # Of lines that coincide, the first is an edge.
    order = jnp.arange(height.size)
    tie = (height[None] == height[:, None]) & (order[None] < order[:, None])
    hidden = jnp.any(~crossing & (cos > 0) & ((height[None] < height[:, None]) | tie), axis=1)
    edge = ~hidden & (low < high)
    wedges = wedge(jnp.where(edge, high, 0), height, radius) - wedge(jnp.where(edge, low, 0), height, radius)
    return jnp.sum(wedges)


def wedge(end, height, radius):
    """Area that a disc shares with the triangle from its centre to a line at `height`, from the foot to `end`."""
    half_chord = safe_sqrt(radius**2 - height**2)
    inside = jnp.clip(end, -half_chord, half_chord)
    beyond = jnp.abs(end) > half_chord
    sine = jnp.where(beyond, (end - inside) * height, 0)
    angle = jnp.arctan2(sine, jnp.where(beyond, height**2 + end * inside, 1))
    return (height * inside + radius**2 * angle) / 2


def _for_each_lens(function, centers):
    # Recomputed in the reverse pass: what all lenses' neighbours leave behind would be large.
    return lax.map(jax.checkpoint(function), jnp.arange(centers.shape[0]), batch_size=_LENSES)
