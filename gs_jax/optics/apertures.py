"""Clear apertures of the lenses on their plate, differentiable in the centres; and the pitch of an array.

The array's surface is the upper envelope of the lenses' surfaces: a lens ends where it meets its neighbours. For
identical lenses the clear aperture is the Voronoi cell, within the disc of `aperture_diameter` and within the plate.
Seen from the vertex it is star-shaped: its edge is one distance in each direction. Where lenses differ, edges are
curved: projections of the circles in which two spheres meet. A flat lens may reappear behind a steep neighbour; that
part is not counted. `gs_jax.microscope.layouts` has areas and distances on the host.

Images are linear in the lenses: the image of an array is the sum of the images by each type of lens, whose lenses are
identical. The lenses of a tilted array differ in their distance from the sensor: they are divided into bands of height,
which are as types.
"""

import dataclasses
import math
from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Float64, Int

from ..base.arrays import jit, one_program, safe_sqrt
from ..microscope.geometry import Imager
from ..microscope.lenses import EACH, MicrolensArray, sag
from .raytrace import to_numpy

# Lenses computed at once, and neighbours that may bound a lens. A cell of a random layout has six on average.
_BATCH, _NEIGHBOURS = 16, 64
# Lenses nearer than this part of their diameter are in one place.
_COINCIDENT = 1e-5
# For lenses that differ: neighbours, radii in each direction at which the edge is bracketed, and bisections.
_NEAREST, _BRACKETS, _BISECTIONS = 32, 24, 20


@partial(jit, static_argnames="directions")
def aperture_area(array: MicrolensArray, *, directions: int = 512) -> Float[Array, " lens"]:
    """Area of each lens's clear aperture, `1/2 int r^2 dphi` over its edge `r(phi)`, mm^2.

    For identical lenses the integral and its derivatives are exact, as a sum over straight edges. For lenses that
    differ it is a sum over `directions`, of which 512 give 3e-5 unless the vertex is on the plate's edge; it is fast
    where no discs overlap. Only the 64 nearest lenses count as neighbours, 32 where lenses differ.
    """
    if not array.alike or array.others is not None:
        return jnp.sum(_edge_distances(array, directions) ** 2, 1) * (math.pi / directions)
    return _cut_disc_areas(array.centers, array.aperture_diameter / 2, array.half_plate)


# Normals of the plate's sides.
_SIDES = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])


@jax.custom_jvp
def _cut_disc_areas(centers, radius, half_plate) -> Float[Array, " lens"]:
    """Area of each lens's disc within the bisectors with its neighbours and the plate's sides."""
    return _areas_and_slopes(centers, radius, half_plate)[0]


@_cut_disc_areas.defjvp
def _(primals, tangents):
    """By the edges found in the forward pass: compiled derivatives do not go back through the search for them."""
    move, growth, stretch = tangents
    areas, near, by_offset, by_room, by_radius = _areas_and_slopes(*primals)
    sides = jnp.asarray(_SIDES, move.dtype)
    by_neighbours = jnp.sum(by_offset * (move[near] - move[:, None]), (1, 2))
    by_plate = jnp.sum(by_room * (jnp.repeat(stretch, 2)[None] - move @ sides.T), 1)
    return areas, by_neighbours + by_plate + by_radius * growth


def _areas_and_slopes(centers, radius, half_plate):
    """Areas; the neighbours of each lens; and derivatives by their offsets, by the room on the plate, by the radius."""
    count = min(_NEIGHBOURS, centers.shape[0] - 1)
    sides = jnp.asarray(_SIDES, centers.dtype)

    def of_lens(lens):
        offset = centers - centers[lens][None]
        _, near = lax.top_k(-jnp.sum(offset**2, axis=1), count + 1)
        normal, height = _bisectors(offset[near], 2 * radius)
        # Beyond the disc a line closes the polygon without effect, where the plate is infinite.
        room = jnp.minimum(jnp.repeat(half_plate, 2) - sides @ centers[lens], 2 * radius)
        lines = jnp.concatenate([normal, sides]), jnp.concatenate([height, room])
        area, low, high = _disc_polygon_area(*lines, radius)
        # A line that moves outward adds its edge's length, one that turns the edge's moment, the rim its arc.
        arc = (2 * area - lines[1] @ (high - low)) / radius
        length, moment = (high - low)[: len(near)], (high**2 - low**2)[: len(near)]
        along = jnp.stack([-normal[:, 1], normal[:, 0]], -1)
        by_offset = length[:, None] / 2 * normal - (moment / (4 * height))[:, None] * along
        return area, near, by_offset, (high - low)[len(near) :], arc

    return _in_batches(of_lens, jnp.arange(len(centers)))


def _edge_distances(array: MicrolensArray, count: int) -> Float[Array, "lens direction"]:
    """Distance from each vertex to the lens's edge, mm, in evenly spaced directions."""
    whole = array.whole
    angle = 2 * math.pi * (np.arange(count) + 0.5) / count
    directions = jnp.asarray(np.stack([np.cos(angle), np.sin(angle)], -1), whole.centers.dtype)
    own = whole.of_lenses("aperture_diameter") / 2

    def gap(lens):
        between = safe_sqrt(jnp.sum((whole.centers - whole.centers[lens][None]) ** 2, 1)) - own - own[lens]
        return jnp.min(jnp.where(jnp.arange(len(own)) == lens, jnp.inf, between))

    gaps = _map_lenses(gap, lax.stop_gradient(whole).centers) if len(own) > 1 else jnp.inf
    discs = lambda: _disc_edges(array.centers, own[: len(array.centers)], whole.half_plate, directions)
    return lax.cond(jnp.min(gaps) >= 0, discs, lambda: _envelope_edges(whole, len(array.centers), directions))


def _disc_edges(centers, radius, half_size, directions):
    """Distance to the edge of each disc or of the plate."""
    edges = jnp.broadcast_to(radius[:, None], (len(centers), len(directions)))
    for axis in range(2):
        along = directions[:, axis]
        room = half_size[axis] - centers[:, axis, None] * jnp.sign(along)[None]
        edges = jnp.minimum(edges, room / jnp.abs(along)[None])
    return edges


def _envelope_edges(whole: MicrolensArray, count: int, directions) -> Float[Array, "lens direction"]:
    """Distance to the edge of each of the first lenses: a search, then one Newton step, which has the derivatives."""
    lenses, still = jnp.arange(count), lax.stop_gradient(whole)

    def search(lens):
        neighbours = _nearest_lenses(still, lens)
        excess = lambda direction: lambda distance: _excess(still, neighbours, direction, distance)
        return jax.vmap(lambda direction: _first_root(excess(direction), neighbours[3][0]))(directions)

    def newton(root):
        lens, at, slope = root
        neighbours = _nearest_lenses(whole, lens)
        off = jax.vmap(lambda direction, distance: _excess(whole, neighbours, direction, distance))(directions, at)
        return at - jnp.where(slope > 0, off / jnp.where(slope > 0, slope, 1), 0)

    at, slope = lax.stop_gradient(_in_batches(search, lenses))
    return _in_batches(jax.checkpoint(newton), (lenses, at, slope))


def _nearest_lenses(whole: MicrolensArray, lens):
    """Return the lens's centre and, for it and its neighbours, offset, radius, rim, conic and an is-self mask."""
    radius, diameter, conic = map(whole.of_lenses, EACH)
    offset = whole.centers - whole.centers[lens][None]
    _, near = lax.top_k(-jnp.sum(offset**2, axis=1), min(_NEAREST + 1, len(whole.centers)))
    own = near == lens.astype(near.dtype)
    return whole.centers[lens], offset[near], radius[near], diameter[near] / 2, conic[near], own


def _excess(whole: MicrolensArray, neighbours, direction, distance):
    """Negative inside the clear aperture, positive where a point is covered or beyond an edge; in squared mm.

    A neighbour covers the points in its disc at which its surface is higher.
    """
    center, offset, radius, rim, conic, own = neighbours
    # Not quite the rim: that of a hemisphere has an infinite slope.
    inner = rim**2 * (1 - 1e-9)
    apart = jnp.sum((distance * direction[None] - offset) ** 2, -1)
    surface = lambda squared, radius, conic: sag(squared, radius, conic, whole.aspheric_terms)
    below = jax.vmap(surface)(jnp.minimum(apart, inner), radius, conic)
    # The lens itself is the nearest.
    others = jnp.where(own, -jnp.inf, jnp.minimum(2 * radius[0] * (below[0] - below), inner - apart))
    # Not `max`: recomputed for its derivatives with other rounding, it may be none of its arguments.
    most = jnp.maximum(others[jnp.argmax(others)], distance**2 - rim[0] ** 2)
    for axis in range(0 if whole.size is None else 2):
        beyond = jnp.abs(center[axis] + distance * direction[axis]) - whole.half_plate[axis]
        most = jnp.maximum(most, rim[0] * beyond)
    return most


def _first_root(function, end):
    """First root of a rising function between 0 and `end`, where it is not negative, and its slope there: bisection."""
    step = end / _BRACKETS
    positive = jax.vmap(function)(step * jnp.arange(1, _BRACKETS + 1, dtype=step.dtype)) > 0
    first = jnp.where(jnp.any(positive), jnp.argmax(positive), _BRACKETS - 1).astype(step.dtype)

    def halve(_, ends):
        low, high = ends
        middle = (low + high) / 2
        under = function(middle) <= 0
        return jnp.where(under, middle, low), jnp.where(under, high, middle)

    low, high = lax.fori_loop(0, _BISECTIONS, halve, (first * step, (first + 1) * step))
    at = (low + high) / 2
    return at, jax.grad(function)(at)


@one_program
def clear_diameter(array: MicrolensArray) -> Float[Array, ""]:
    """Diameter of the disc with the mean clear aperture of the lenses, mm."""
    everywhere = jnp.ones((1, len(array.centers)), bool)
    return jnp.sqrt(4 / math.pi * _mean_areas(512, everywhere, array)[0])


def clear_diameters(array: MicrolensArray, *, directions: int = 512) -> Float[Array, " type"]:
    """`clear_diameter` of each lens type; `directions` as in `aperture_area`."""
    number = jnp.arange(array.type_count)[:, None]
    return jnp.sqrt(4 / math.pi * _mean_areas(directions, number == array.type_of_lens[None], array))


# Derivatives by one reverse pass per mean: a few numbers of many, which XLA then computes once for all uses.
@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _mean_areas(directions: int, members: Bool[Array, "type lens"], array: MicrolensArray) -> Float[Array, " type"]:
    members = members.astype(array.centers.dtype)
    return members @ aperture_area(array, directions=directions) / jnp.sum(members, 1)


@_mean_areas.defjvp
def _(directions, primals, tangents):
    (members, array), (_, changes) = primals, tangents
    numbers, rest = eqx.partition(array, eqx.is_inexact_array)
    changes = eqx.filter(changes, jax.tree.map(eqx.is_inexact_array, array))
    areas, back = jax.vjp(lambda n: _mean_areas.fun(directions, members, eqx.combine(n, rest)), numbers)
    (slopes,) = jax.vmap(back)(jnp.eye(len(areas), dtype=areas.dtype))
    pairs = zip(jax.tree.leaves(slopes), jax.tree.leaves(changes), strict=True)
    return areas, sum(jnp.tensordot(slope, change, change.ndim) for slope, change in pairs)


@jit
def pitch(centers: Float[Array | np.ndarray, "lens 2"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean (the paper's "average pitch size") and standard deviation of the distances to the nearest neighbours, mm.

    A single lens has an infinite pitch and no deviation. Where a distance or the deviation is zero, its derivative is
    0.
    """
    centers = jnp.asarray(centers)
    if centers.shape[0] == 1:
        return jnp.full((), jnp.inf, centers.dtype), jnp.zeros((), centers.dtype)

    def nearest(lens):
        squared = jnp.sum((centers - centers[lens][None]) ** 2, axis=1)
        return jnp.min(jnp.where(jnp.arange(centers.shape[0]) == lens, jnp.inf, squared))

    distances = safe_sqrt(_map_lenses(nearest, centers))
    mean = jnp.mean(distances)
    return mean, safe_sqrt(jnp.mean((distances - mean) ** 2))


def _bisectors(offset, diameter):
    """Unit normals and distances of the bisectors with lenses at these offsets; for the lens itself, out of reach."""
    distance = safe_sqrt(jnp.sum(offset**2, axis=1))
    # Not 0: compiled, the difference of a lens's centre and itself may be rounded to another number.
    apart = distance > _COINCIDENT * diameter
    along_x = jnp.array([[1, 0]], offset.dtype)
    normal = jnp.where(apart[:, None], offset, along_x) / jnp.where(apart, distance, 1)[:, None]
    return normal, jnp.where(apart, distance / 2, diameter)


def _disc_polygon_area(normal, height, radius):
    """Area of a disc within the polygon of lines at these distances from its centre: a sum over its edges.

    And where the edge on each line begins and ends within the disc, from the foot on; both 0 without an edge.
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
    low, high = jnp.where(edge, low, 0), jnp.where(edge, high, 0)
    area = jnp.sum(wedge_area(high, height, radius) - wedge_area(low, height, radius))
    half_chord = safe_sqrt(radius**2 - height**2)
    return area, *(jnp.clip(end, -half_chord, half_chord) for end in (low, high))


def wedge_area(end, height, radius):
    """Area of a disc within the triangle from its centre to a line at `height`, from the foot to `end`."""
    half_chord = safe_sqrt(radius**2 - height**2)
    inside = jnp.clip(end, -half_chord, half_chord)
    beyond = jnp.abs(end) > half_chord
    sine = jnp.where(beyond, (end - inside) * height, 0)
    angle = jnp.arctan2(sine, jnp.where(beyond, height**2 + end * inside, 1))
    return (height * inside + radius**2 * angle) / 2


def _map_lenses(function, centers):
    # Recomputed in the reverse pass, as the intermediate results of all lenses' neighbours would be large.
    return _in_batches(jax.checkpoint(function), jnp.arange(centers.shape[0]))


def _in_batches(function, of_lenses):
    """`lax.map` in batches of one size: for fewer at the end JAX would compile the function a second time."""
    count = len(jax.tree.leaves(of_lenses)[0])
    missing = -count % min(_BATCH, count)
    whole = jax.tree.map(lambda a: jnp.pad(a, [(0, missing), *[(0, 0)] * (a.ndim - 1)], mode="edge"), of_lenses)
    return jax.tree.map(lambda a: a[:count], lax.map(function, whole, batch_size=_BATCH))


def clear_area(array: MicrolensArray) -> Float[Array, " lens"]:
    """Area of each lens's clear aperture without the plate's edge, mm^2.

    Glass beyond the plate's nominal size transmits light, too: in ray-traced captures of the authors' array, apertures
    that are cut there make the model 20 % too dark at the sensor's rim.
    """
    return aperture_area(dataclasses.replace(array, size=None))


# Bands of height of a tilted array: within one the blur changes by so many pixels; so many at most, as each costs as
# much as an array without tilt.
_BLUR, _BANDS = 2.0, 5


def height_bands(imager: Imager) -> Int[np.ndarray, " lens"]:
    """Number the lenses by bands of height: all 0 unless the array is so tilted that its lenses differ in blur."""
    heights = np.asarray(to_numpy(imager).heights)
    low, spread = heights.min(), np.ptp(heights)
    blur = spread * float(np.max(imager.array.aperture_diameter)) / float(imager.reduced_sensor_distance)
    count = min(max(math.ceil(blur / (_BLUR * imager.sensor.pixel_pitch)), 1), _BANDS)
    return np.minimum((heights - low) / (spread / count or 1), count - 1).astype(int)


def lens_groups(imager: Imager) -> tuple[tuple[int, ...], ...]:
    """Indices of lenses that image alike: those of a type, and of a band of height if the array is tilted."""
    types, bands = np.asarray(imager.array.type_of_lens), height_bands(imager)
    numbers = np.unique(bands * (types.max() + 1) + types, return_inverse=True)[1]
    return tuple(tuple(np.flatnonzero(numbers == number).tolist()) for number in range(numbers.max() + 1))


def split_by_type(imager: Imager, lenses: Sequence[Sequence[int]]) -> list[Imager]:
    """The imager with the lenses of each type alone, whose apertures the other lenses still bound."""
    return [eqx.tree_at(lambda i: i.array, imager, imager.array.subset(which)) for which in lenses]


def split_groups(imager: Imager) -> tuple[list[Imager], tuple[tuple[int, ...], ...]]:
    """The imager with the lenses of each group alone, and the `lens_groups`; itself where all lenses are alike."""
    groups = lens_groups(imager)
    return [imager] if len(groups) == 1 else split_by_type(imager, groups), groups


def relative_areas(imagers: Sequence[Imager]) -> Float64[np.ndarray, " type"]:
    """Mean clear area of each type over that of all lenses: its relative light near the axis."""
    areas = [np.asarray(clear_area(one.array), np.float64) for one in imagers]
    return np.array([area.mean() for area in areas]) / np.concatenate(areas).mean()
