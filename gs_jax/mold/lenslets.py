"""The lenses of an array as the part has them: one a cap of its own, of any profile that falls from vertex to rim.

All vertices lie in one plane, and heights are over the land, the plane between the lenses. The land is at the deepest
rim's sag: what is alike ends in it. A lens whose rim is higher stands on a wall, with a draft so that a cast can be
peeled and that walls which touch are one body. The surface is the highest of caps, walls and land: lenses end where
they meet, or at their discs. Lengths in mm, angles in radians.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.integrate import cumulative_simpson
from scipy.spatial import Delaunay, KDTree

from ..lenses import MicrolensArray, sag, sag_slope_over_r

# Of walls, from the axis: usual for what is to come off a mold.
DRAFT = math.radians(5)
# Steeper rims are neither printed nor peeled well, and hide their facets from above.
STEEPEST = math.radians(75)


@dataclass(frozen=True)
class Cap:
    """One lens.

    Parameters
    ----------
    center
        Its vertex `(x, y)` in the part's frame, mm.
    reach
        Radius of its disc, mm.
    radius, conic, terms
        Of `MicrolensArray`'s surface: radius of curvature, conic constant, A_4, A_6, ....
    """

    center: Float[np.ndarray, "2"]
    reach: float
    radius: float
    conic: float
    terms: tuple[float, ...] = ()

    def sag(self, squared: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """How far the surface is below its vertex at a squared distance from the axis, mm."""
        return sag(np.asarray(squared, float), self.radius, self.conic, self.terms)

    def sag_slope_over_r(self, squared: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Slope over the distance from the axis, 1/mm."""
        return sag_slope_over_r(np.asarray(squared, float), self.radius, self.conic, self.terms)

    @property
    def rim(self) -> float:
        """Sag of the rim, mm."""
        return float(self.sag(np.array([self.reach**2]))[0])

    @property
    def widest(self) -> float:
        """Radius up to which the disc could be made, mm: the surface falls, by no more than `STEEPEST`."""
        low, high = 0.0, self.reach
        if self._is_made(high):
            return high
        # What is wrong somewhere is wrong at the first such place: profiles are asked at many.
        radii = np.linspace(low, high, 1025)
        first = next(i for i, r in enumerate(radii) if not self._is_made(r))
        low, high = (radii[first - 1], radii[first]) if first else (0.0, 0.0)
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if self._is_made(middle) else (low, middle)
        return float(low)

    def _is_made(self, reach) -> bool:
        squared = np.linspace(0, reach, 257) ** 2
        if not ((1 + self.conic) * squared < self.radius**2).all():
            return False
        steep = self.sag_slope_over_r(squared)
        return bool((steep > 0).all() and (steep * np.sqrt(squared) <= math.tan(STEEPEST)).all())


def caps_of(array: MicrolensArray) -> list[Cap]:
    """The lenses of an array, in the part's frame.

    That is the design's if the plano side faces the object: x and y as the sensor's. A part lies with its lenses
    toward -z, so one whose curved side faces the object has been turned over, about x: its y runs against the
    sensor's. A part that was not turned but had its lenses on the other face would be mirrored.
    """
    count = len(array.centers)
    numbers = (array.aperture_diameter, array.radius_of_curvature, array.conic_constant)
    diameter, radius, conic = (np.broadcast_to(np.asarray(x, float), count).tolist() for x in numbers)
    terms = tuple(np.asarray(array.aspheric_terms, float).tolist())
    return [
        Cap(center, d / 2, r, k, terms)
        for center, d, r, k in zip(part_centers(array), diameter, radius, conic, strict=True)
    ]


def part_centers(array: MicrolensArray) -> Float[np.ndarray, "lens 2"]:
    """The lens vertices in the part's frame, mm."""
    return np.asarray(array.centers, float) * (1.0, 1.0 if array.orientation == "plano" else -1.0)


def cap_sag(array: MicrolensArray) -> float:
    """Height of the vertices over the land, mm: the deepest rim's sag, `R - sqrt(R^2 - D^2/4)` of spheres alike."""
    return max(cap.rim for cap in caps_of(array))


def surface(
    caps: list[Cap], points: Float[np.ndarray, "point 2"], margin: float = 0.0
) -> tuple[Float[np.ndarray, " point"], Int[np.ndarray, " point"]]:
    """Height of the surface over the land at points `(x, y)`, mm, and whose lens it is.

    That is -1 of walls and land, and where the lens is not higher than anything else by more than the margin, mm.
    """
    land = max(cap.rim for cap in caps)
    height, second, owner = np.zeros(len(points)), np.zeros(len(points)), np.full(len(points), -1)
    for number, (cap, (here, squared)) in enumerate(zip(caps, _around(caps, points, land), strict=True)):
        beyond = np.sqrt(np.maximum(squared, cap.reach**2)) - cap.reach
        its = land - cap.sag(np.minimum(squared, cap.reach**2)) - beyond / math.tan(DRAFT)
        higher = its > height[here]
        second[here] = np.maximum(second[here], np.minimum(its, height[here]))
        height[here[higher]] = its[higher]
        owner[here[higher]] = np.where(beyond[higher] > 0, -1, number)
    return height, np.where(height - second > margin, owner, -1) if margin else owner


def visible_reaches(caps: list[Cap], size: tuple[float, float]) -> list[float]:
    """How far from its vertex each lens may be seen, mm: up to its disc, or less if others hide the rest of it.

    The plate is cut into tiles. Over a tile a lens is no higher than at the tile's nearest point, and some lens is as
    high as at its farthest point: a lens that is lower than that is not seen there.
    """
    land = max(cap.rim for cap in caps)
    step = math.sqrt(math.prod(size) / (400 * len(caps)))
    count = [math.ceil(side / step) for side in size]
    middles = [(np.arange(n) + 0.5) * (side / n) - side / 2 for n, side in zip(count, size, strict=True)]
    tiles = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, 2)
    half = math.hypot(*(side / n for n, side in zip(count, size, strict=True))) / 2
    least = np.zeros(len(tiles))
    near = list(_around(caps, tiles, land, half))
    for cap, (here, squared) in zip(caps, near, strict=True):
        far = np.sqrt(squared) + half
        here, far = here[far <= cap.reach], far[far <= cap.reach]
        least[here] = np.maximum(least[here], land - cap.sag(far**2))
    reaches = []
    for cap, (here, squared) in zip(caps, near, strict=True):
        distance = np.sqrt(squared)
        highest = land - cap.sag(np.clip(distance - half, 0, cap.reach) ** 2)
        reaches.append(min(cap.reach, float((distance + half)[highest >= least[here]].max(initial=half))))
    return reaches


def _around(caps, points, land, margin=0.0):
    """For each lens the points on or near its cap and wall, and their squared distances from its axis."""
    order = np.argsort(points[:, 0], kind="stable")
    x = points[order, 0]
    for cap in caps:
        reach = cap.reach + (land - cap.rim) * math.tan(DRAFT) + margin
        first, last = np.searchsorted(x, cap.center[0] + np.array([-reach, reach]))
        here = order[first:last]
        squared = ((points[here] - cap.center) ** 2).sum(axis=1)
        yield here[squared < reach**2], squared[squared < reach**2]


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
    steep = cap.sag_slope_over_r(r**2)
    stretch = np.sqrt(1 + (r * steep) ** 2)
    integral = lambda values: cumulative_simpson(values, x=r, initial=0)
    # (stretch - 1) / r, without a division by zero on the axis.
    conformal = r * np.exp(integral(r * steep**2 / (1 + stretch)))
    return _Maps(r, stretch, integral(stretch), conformal, np.sqrt(2 * integral(r * stretch)), *_curvatures(cap, r))


def _curvatures(cap, r):
    """The mean curvature at radii from 0 on, and the largest principal one, 1/mm."""
    steep = cap.sag_slope_over_r(r**2)
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
