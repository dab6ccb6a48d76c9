"""Facets of one cap, whose distance from its surface is bounded.

A surface of revolution has a conformal map to the plane, `ln q = int sqrt(1 + s'^2) / r dr`: circles that are small
stay circles, so Delaunay's triangulation of the map is the surface's. Of a sphere the map is the stereographic
projection, and the facets are those of the convex hull, of all triangulations the one closest to the sphere. A facet is
no deeper than `rho^2 kappa / 2`, with rho the radius of the smallest circle around it and kappa the largest principal
curvature. Lengths in mm.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.integrate import cumulative_simpson
from scipy.spatial import Delaunay, KDTree

from .caps import Cap

# How often facets that are too large are split. One or two rounds are enough; more would mean that none is.
_ROUNDS = 20
# Radii at which a profile is known.
_RADII = 1025

# Dunavant's rule of degree 4 on a triangle: a facet's distance from a sphere is a quadratic, its square a quartic.
NODES = np.array(
    [[1 - 2 * a if i == j else a for j in range(3)] for a in (0.445948490915965, 0.091576213509771) for i in range(3)]
)
WEIGHTS = np.repeat([0.223381589678011, 0.109951743655322], 3)


class Facets(NamedTuple):
    """A cap's facets, counter-clockwise in (x, y).

    Parameters
    ----------
    points
        `(x, y)` from the axis, the ring of the edge first, mm.
    sag
        Of the vertices, mm. They are lifted off the surface by the facets' mean depth, but for the ring's.
    facets
        As indices of points.
    ring
        How many points the edge has.
    """

    points: Float[np.ndarray, "point 2"]
    sag: Float[np.ndarray, " point"]
    facets: Int[np.ndarray, "facet 3"]
    ring: int


class _Maps(NamedTuple):
    """A profile at some radii: how far they are along it and in maps to the plane, and its curvatures."""

    radii: np.ndarray
    stretch: np.ndarray
    along: np.ndarray
    conformal: np.ndarray
    equal_area: np.ndarray
    mean_curvature: np.ndarray
    curvature: float


def facet_cap(cap: Cap, reach: float, chord: float) -> Facets:
    """Facets of a cap up to a distance from its axis.

    Vertices on the surface itself would leave every facet of a convex lens inside it: the part would be too thin by
    three quarters of the chord error. They are lifted by the mean depth of the facets, so that the surface is right on
    average (in thickness and volume), and no farther from the lens than before.

    Parameters
    ----------
    cap
        The lens.
    reach
        Where the facets end, mm.
    chord
        The largest distance between a facet and the surface, mm.

    Raises
    ------
    RuntimeError
        If no facets are found; those of rims that slope by 75 degrees and less are.
    """
    maps = _maps(cap, reach)
    radius = facet_circumradius(1 / maps.curvature, chord)
    inside, side = _hexagonal(maps, radius)
    # The edge is an arc in the plane, and on the surface it is as far from point to point as a facet is wide.
    count = max(6, math.ceil(2 * math.pi * reach / min(side, math.sqrt(8 * reach * chord))))
    step = 2 * math.pi / count
    angle = step * np.arange(count)
    # As large as the disc, so that walls are, too: its corners are outside the circle by less than its chords inside.
    ring = reach * math.sqrt(step / math.sin(step)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate([ring, inside if len(inside) else np.zeros((1, 2))])
    for _ in range(_ROUNDS):
        flat = _scaled(points, maps.radii, maps.conformal)
        facets = _delaunay(flat)
        vertices = np.column_stack([points, -cap.sag(np.minimum((points**2).sum(axis=1), reach**2))])
        more = _splits(flat, vertices[facets], facets, radius)
        more = _scaled(more, maps.conformal, maps.radii)
        more = more[np.hypot(*more.T) < reach * math.cos(math.pi / count)]
        crowded = {j for _, j in KDTree(more).query_pairs(side / 2)} if len(more) else set()
        if not len(more):
            return Facets(points, _lifted(cap, maps, vertices, facets, count, len(inside)), facets, count)
        points = np.concatenate([points, more[[i for i in range(len(more)) if i not in crowded]]])
    raise RuntimeError(f"facets within {chord} mm of {cap} were not found")


def facet_circumradius(radius: float, chord: float) -> float:
    """Circumradius of a triangle whose corners lie on a sphere and whose plane dips `chord` below it, mm."""
    return math.sqrt(2 * radius * chord - chord**2)


def largest_curvature(cap: Cap, reach: float) -> float:
    """The largest principal curvature up to a distance from the axis, 1/mm."""
    return _curvatures(cap, np.linspace(0, reach, 257))[1]


def estimated_facets(caps: list[Cap], reaches: list[float], chord: float) -> float:
    """About how many facets the lenses take: equilateral ones of `side^2 = 6 chord / kappa`, and a fifth for edges."""
    facet = [math.sqrt(3) / 4 * 6 / largest_curvature(*pair) * chord for pair in zip(caps, reaches, strict=True)]
    return 1.2 * sum(math.pi * reach**2 / area for reach, area in zip(reaches, facet, strict=True))


def _maps(cap, reach) -> _Maps:
    r = np.linspace(0, reach, _RADII)
    steep = cap.steepness(r**2)
    stretch = np.sqrt(1 + (r * steep) ** 2)
    integral = lambda values: cumulative_simpson(values, x=r, initial=0)
    # (stretch - 1) / r, without a division by zero on the axis.
    conformal = r * np.exp(integral(r * steep**2 / (1 + stretch)))
    return _Maps(r, stretch, integral(stretch), conformal, np.sqrt(2 * integral(r * stretch)), *_curvatures(cap, r))


def _curvatures(cap, r):
    """The mean curvature at radii from 0 on, and the largest principal one, 1/mm."""
    steep = cap.steepness(r**2)
    stretch = np.sqrt(1 + (r * steep) ** 2)
    meridian, parallel = np.gradient(r * steep, r, edge_order=2) / stretch**3, steep / stretch
    return (meridian + parallel) / 2, float(max(np.abs(meridian).max(), parallel.max()))


def _scaled(points, radii, scaled):
    """Points of the plane with other distances from the origin."""
    distance = np.hypot(*points.T)
    return points * (np.interp(distance, radii, scaled) / np.maximum(distance, 1e-300))[:, None]


def _hexagonal(maps: _Maps, radius):
    """A hexagonal lattice over a cap, seen from above: nearly equilateral facets of the largest size.

    It is laid out in the equal-area map, which at a radius stretches by the map's radius over it (`1 / cos(theta/2)` on
    a sphere, Lambert's projection). It fits to a little over half of the way to the rim, where neighbours begin to cut
    lenses off; what is too wide farther out is split.
    """
    limit, fits = maps.equal_area[-1], int(0.6 * _RADII)
    side = 0.98 * math.sqrt(3) * radius * maps.radii[fits] / maps.equal_area[fits]
    count = math.ceil(limit / side) + 1
    i, j = np.meshgrid(*[np.arange(-2 * count, 2 * count + 1)] * 2)
    lattice = side * np.stack([i + j / 2, math.sqrt(3) / 2 * j], axis=-1).reshape(-1, 2)
    distance = np.hypot(*lattice.T)
    room = maps.along[-1] - np.interp(distance, maps.equal_area, maps.along)
    return _scaled(lattice[(distance < limit) & (room > side / 2)], maps.equal_area, maps.radii), side


def _delaunay(flat):
    facets = Delaunay(flat).simplices
    a, b, c = (flat[facets[:, k]] for k in range(3))
    clockwise = _cross(b - a, c - a) < 0
    return np.where(clockwise[:, None], facets[:, ::-1], facets)


def _splits(flat, corners, facets, radius):
    """The middle, in the map, of each facet that is too wide: of its circle, or of its longest edge."""
    edges = np.roll(corners, -1, axis=1) - corners
    squared = (edges**2).sum(axis=2)
    obtuse = 2 * squared.max(axis=1) > squared.sum(axis=1)
    area2 = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    circle = np.sqrt(squared.prod(axis=1)) / (2 * np.maximum(area2, 1e-300))
    around = np.where(obtuse, np.sqrt(squared.max(axis=1)) / 2, circle)
    wide = np.flatnonzero(around > radius * (1 + 1e-6))
    longest = squared[wide].argmax(axis=1)
    a, b, c = (flat[facets[wide, (longest + k) % 3]] for k in range(3))
    # The circumcentre as seen from one corner.
    u, v = b - a, c - a
    lengths = ((u**2).sum(axis=1)[:, None] * v - (v**2).sum(axis=1)[:, None] * u) / (2 * _cross(u, v))[:, None]
    middle = a + np.stack([lengths[:, 1], -lengths[:, 0]], axis=1)
    return np.where(obtuse[wide, None], (a + b) / 2, middle)


def _lifted(cap, maps: _Maps, vertices, facets, ring, lattice):
    """Sags of vertices that are moved outward by the facets' mean depth: as that is, by the mean curvature."""
    outward = np.interp(np.hypot(*vertices[:, :2].T), maps.radii, maps.stretch * maps.mean_curvature)
    corners = vertices[facets]
    nodes = np.einsum("qk,fkx->fqx", NODES, corners)
    depth = -cap.sag((nodes[..., :2] ** 2).sum(axis=-1)) - nodes[..., 2]
    a, b, c = corners[..., :2].transpose(1, 0, 2)
    area = _cross(b - a, c - a)
    # Those of the lattice: what is beside the ring, or was split, is of other sizes, and mostly hidden by neighbours.
    regular = ((facets >= ring) & (facets < ring + lattice)).all(axis=1)
    share = area * regular if regular.any() else area
    outward *= share @ (depth @ WEIGHTS) / (share @ outward[facets].mean(axis=1))
    outward[:ring] = 0
    return -vertices[:, 2] - outward


def _cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
