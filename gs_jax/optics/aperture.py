"""The clear aperture of each lens, and the pitch of an array, as JAX functions of the centres.

The array's surface is the upper envelope of the lenses' caps, so a lens ends where it meets its neighbours' caps: the
clear aperture of lenses that are alike is their Voronoi cell, within the disc of `aperture_diameter` and within the
plate. Seen from the vertex it is star-shaped, so its edge is one distance in each direction. `gs_jax.layouts.cells` has
areas and distances too, on the host and without derivatives.

Where lenses differ, edges are curved: of two spheres the projection of the circle in which they meet. A flat lens may
reappear behind a steep neighbour; what does is not counted.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..base.safe import safe_sqrt
from ..lenses import EACH, MicrolensArray, sag

# Lenses that are handled at once.
_LENSES = 16
# Neighbours that may bound a lens's area. A cell of a random layout has six on average.
_NEIGHBOURS = 64
# Of lenses that differ: neighbours, directions, radii in each at which the edge is looked for, and halvings.
_NEAREST, _DIRECTIONS, _RADII, _HALVINGS = 32, 512, 24, 20


@jax.jit
def aperture_area(array: MicrolensArray) -> Float[Array, " lens"]:
    """Area of each lens's clear aperture, `1/2 int r^2 dphi` over its edge `r(phi)`, mm^2.

    Of lenses that are alike the integral is exact, a sum over the straight edges; so are its derivatives, which a
    quadrature in angle gets wrong at the corners. Of lenses that differ it is a sum over 512 directions, right to 3e-5
    unless the vertex is on the plate's edge. Only the 64 nearest lenses count as neighbours, 32 where lenses differ:
    enough unless the lenses are in heaps of more than that.
    """
    if not array.alike or array.others is not None:
        return jnp.sum(_edges(array) ** 2, 1) * (math.pi / _DIRECTIONS)
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


def _edges(array: MicrolensArray) -> Float[Array, "lens direction"]:
    """How far from its vertex each lens ends, mm, in directions that are evenly spread.

    A neighbour covers a point of a lens within the neighbour's disc, where it is less below the plane of the vertices.
    """
    whole = array.whole
    lenses = len(whole.centers)
    radius, diameter, conic = (jnp.broadcast_to(getattr(whole, name), lenses) for name in EACH)
    angle = 2 * math.pi * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    directions = jnp.asarray(np.stack([np.cos(angle), np.sin(angle)], -1), whole.centers.dtype)

    def edge(lens):
        offset = whole.centers - whole.centers[lens][None]
        _, near = lax.top_k(-jnp.sum(offset**2, axis=1), min(_NEAREST + 1, lenses))
        numbers = (
            whole.centers[lens],
            offset[near],
            radius[near],
            diameter[near] / 2,
            conic[near],
            near == lens.astype(near.dtype),
        )
        return jax.vmap(lambda direction: _first_root(covered, (direction, numbers), diameter[lens] / 2))(directions)

    def covered(distance, place):
        """How much a point of a lens is covered or over, in squared mm; negative where it is clear."""
        direction, (center, offset, radius, rim, conic, own) = place
        # Not quite the rim: that of a hemisphere has an infinite slope.
        inner = rim**2 * (1 - 1e-9)
        apart = jnp.sum((distance * direction[None] - offset) ** 2, -1)
        surface = lambda squared, radius, conic: sag(squared, radius, conic, whole.aspheric_terms)
        below = jax.vmap(surface)(jnp.minimum(apart, inner), radius, conic)
        # The lens itself is the nearest.
        others = jnp.where(own, -jnp.inf, jnp.minimum(2 * radius[0] * (below[0] - below), inner - apart))
        most = jnp.maximum(jnp.max(others), distance**2 - rim[0] ** 2)
        for axis, side in enumerate(whole.size):
            if math.isfinite(side):
                beyond = jnp.abs(center[axis] + distance * direction[axis]) - side / 2
                most = jnp.maximum(most, rim[0] * beyond)
        return most

    return lax.map(jax.checkpoint(edge), jnp.arange(len(array.centers)), batch_size=_LENSES)


def _first_root(function, parameters, end):
    """Where a function first rises through zero between 0 and an end at which it is not negative.

    Bisection, then Newton's step, which has the derivatives of the implicit function.
    """
    fixed_end, fixed = lax.stop_gradient((end, parameters))
    step = fixed_end / _RADII
    positive = jax.vmap(lambda at: function(at, fixed))(step * jnp.arange(1, _RADII + 1, dtype=step.dtype)) > 0
    first = jnp.where(jnp.any(positive), jnp.argmax(positive), _RADII - 1).astype(step.dtype)

    def halve(_, ends):
        low, high = ends
        middle = (low + high) / 2
        under = function(middle, fixed) <= 0
        return jnp.where(under, middle, low), jnp.where(under, high, middle)

    low, high = lax.fori_loop(0, _HALVINGS, halve, (first * step, (first + 1) * step))
    at = (low + high) / 2
    slope = jax.grad(function)(at, fixed)
    return at - jnp.where(slope > 0, function(at, parameters) / jnp.where(slope > 0, slope, 1), 0)


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
