"""The surface of an array of spherical caps on a plate, as facets whose distance from the spheres is bounded.

A lens of radius of curvature R and aperture D is the part of a sphere above the plate's plane: its height over the
plane at the distance r from its axis is `h(r) = sqrt(R^2 - r^2) - sqrt(R^2 - D^2/4)`, zero at the rim and beyond. The
surface is the maximum over the lenses. The vertices of a lens lie on one sphere, so its facets are the upper side of
their convex hull: of all triangulations the one closest to the sphere. Host code; lengths in mm.
"""

import math
from dataclasses import dataclass

import manifold3d
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, KDTree

from ..base.progress import Progress
from ..layouts.cells import cross
from ..lenses import MicrolensArray
from .outlines import Plan, draw_plan

# How often facets that are too large are split. One or two rounds are enough; more would mean that none is.
_ROUNDS = 20
# The largest chord error in heights of a lens: with fewer facets it is no lens.
COARSEST = 0.1
# More take gigabytes of memory and of disk.
MAX_FACETS = 5_000_000


@dataclass(frozen=True)
class Surface:
    """Facets over the plate, counter-clockwise in (x, y), with heights over the plate's plane.

    Parameters
    ----------
    vertices
        `(x, y, height)`, mm.
    facets
        Of the lenses, then of the plate between them, as indices of vertices.
    lens
        The lens of each facet, -1 for the plate.
    lift
        How far outside the sphere the lenses' vertices are, mm (`facet_surface`).
    """

    vertices: Float[np.ndarray, "vertex 3"]
    facets: Int[np.ndarray, "facet 3"]
    lens: Int[np.ndarray, " facet"]
    lift: float


def cap_sag(array: MicrolensArray) -> float:
    """Height of a whole lens over the plate's plane, `R - sqrt(R^2 - D^2/4)`, mm."""
    radius, reach = float(array.radius_of_curvature), float(array.aperture_diameter) / 2
    return radius - math.sqrt(radius**2 - reach**2)


def cap_height(array: MicrolensArray, points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
    """Height of the surface over the plate's plane at points `(x, y)`, mm. Lenses are equal: the nearest is highest."""
    distance, _ = KDTree(np.asarray(array.centers, float)).query(points)
    radius, reach = float(array.radius_of_curvature), float(array.aperture_diameter) / 2
    return np.sqrt(radius**2 - np.minimum(distance, reach) ** 2) - math.sqrt(radius**2 - reach**2)


def facet_surface(array: MicrolensArray, chord: float, progress: Progress | None = None) -> Surface:
    """The array's surface as facets.

    Vertices on the sphere itself would leave every facet inside it: the part would be too thin by three quarters of the
    chord error. They are lifted by the mean depth of the facets, so that the surface is right on average (in thickness
    and volume), and no farther from the sphere than before.

    Parameters
    ----------
    array
        Lenses on a plate of finite size.
    chord
        The largest distance between a facet and its sphere, mm.
    progress
        Shows how many lenses are done.

    Returns
    -------
    Surface
        Without cracks: neighbours share the vertices of their common edge.

    Raises
    ------
    InputError
        If a lens lies outside the plate, or the plate is infinite.
    ValueError
        If `chord` is not positive and at most a tenth of the height of a lens, or takes millions of facets.
    RuntimeError
        If no facets are found for a lens; rims that slope by 75 degrees and less have them.
    """
    coarsest = cap_sag(array) * COARSEST
    if not 0 < chord <= coarsest:
        raise ValueError(f"`chord` must be positive and at most {coarsest:.4g} mm, got {chord}.")
    if (count := estimated_facets(array, chord)) > MAX_FACETS:
        raise ValueError(f"`chord` of {chord} mm takes about {count:.2g} facets, allowed: up to {MAX_FACETS:.2g}.")
    plan = draw_plan(array, chord)
    centers, radius = np.asarray(array.centers, float), float(array.radius_of_curvature)
    inside = _hexagonal(radius, float(array.aperture_diameter) / 2, chord)
    points, facets, owners, first = [plan.points], [], [], len(plan.points)
    lenses = list(zip(centers, plan.outlines, strict=True))
    for i, (center, outline) in enumerate((progress or Progress()).track(lenses, "Tessellating")):
        ring = plan.points[outline.cap] - center
        added, cap = _facet_cap(ring, inside, radius, chord)
        index = np.concatenate([outline.cap, np.arange(first, first + len(added))])
        points.append(added + center)
        facets.append(index[cap])
        owners.append(np.full(len(cap), i))
        first += len(added)
    plan_points, lens = np.concatenate(points), np.concatenate(owners)
    lens_facets = np.concatenate(facets)
    lift = _mean_depth(plan_points, lens_facets, centers[lens], radius)
    height = _heights(array, plan, plan_points, lens_facets, lens, radius + lift)
    flat = [_facet_flat(plan.points, polygon) for outline in plan.outlines for polygon in outline.flats]
    plate = np.concatenate([np.zeros((0, 3), int), *flat])
    return Surface(
        vertices=np.column_stack([plan_points, height]),
        facets=np.concatenate([lens_facets, plate]),
        lens=np.concatenate([lens, np.full(len(plate), -1)]),
        lift=lift,
    )


def estimated_facets(array: MicrolensArray, chord: float) -> float:
    """About how many facets the lenses take: equilateral ones of `side^2 = 6 R chord`, and a fifth for the edges."""
    discs = len(array.centers) * math.pi / 4 * float(array.aperture_diameter) ** 2
    facet = math.sqrt(3) / 4 * 6 * float(array.radius_of_curvature) * chord
    return 1.2 * min(math.prod(array.size), discs) / facet


def _heights(array, plan: Plan, points, facets, lens, radius):
    """Of each vertex over the plate's plane; the plate's own vertices, the lenses' rims among them, lie in it."""
    owner = np.zeros(len(points), int)
    owner[facets] = lens[:, None]
    squared = ((points - np.asarray(array.centers, float)[owner]) ** 2).sum(axis=1)
    reach = float(array.aperture_diameter) / 2
    height = np.sqrt(np.maximum(radius**2 - squared, 0)) - math.sqrt(float(array.radius_of_curvature) ** 2 - reach**2)
    height[: len(plan.points)][plan.on_plate] = 0
    return height


def _hexagonal(radius, reach, chord):
    """A hexagonal lattice over a cap, seen from above: nearly equilateral facets of the largest size.

    The lattice is laid out in Lambert's equal-area projection, which stretches by no more than `1 / cos(theta/2)` at
    the polar angle `theta`. A facet's depth is `rho^2 / (2 R)` for its circumradius `rho`.
    """
    theta = math.asin(min(reach / radius, 1.0))
    side = 0.98 * math.sqrt(3) * facet_circumradius(radius, chord) * math.cos(theta / 2)
    limit = 2 * radius * math.sin(theta / 2)
    count = math.ceil(limit / side) + 1
    i, j = np.meshgrid(*[np.arange(-2 * count, 2 * count + 1)] * 2)
    lattice = side * np.stack([i + j / 2, math.sqrt(3) / 2 * j], axis=-1).reshape(-1, 2)
    q = (lattice**2).sum(axis=1) / radius**2
    lattice = lattice[q * radius**2 < limit**2] * np.sqrt(1 - q[q * radius**2 < limit**2] / 4)[:, None]
    polar = np.arcsin(np.hypot(*lattice.T) / radius)
    return lattice[polar * radius < theta * radius - side / 2], side


def facet_circumradius(radius: float, chord: float) -> float:
    """Circumradius of a triangle whose corners lie on a sphere and whose plane dips `chord` below it, mm."""
    return math.sqrt(2 * radius * chord - chord**2)


def _facet_cap(ring, lattice, radius, chord):
    """Points to add within a convex ring, and facets over both; all seen from the lens's axis."""
    points, side = lattice
    start, along = ring, np.roll(ring, -1, axis=0) - ring
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
    reach = (normal * start).sum(axis=1)
    # Foreshortened: what is steep seems close to the edge.
    cos = np.sqrt(1 - (points**2).sum(axis=1) / radius**2)
    room = (reach - points @ normal.T).min(axis=1)
    added = points[room > side / 2 * cos]
    if not len(added):
        added = ring.mean(axis=0, keepdims=True)
    for _ in range(_ROUNDS):
        vertices = _on_sphere(np.concatenate([ring, added]), radius)
        facets = _upper_hull(vertices, len(ring))
        more = _splits(vertices, facets, radius, chord, side)
        more = more[(more @ normal.T < reach).all(axis=1)]
        if not len(more):
            return added, facets
        added = np.concatenate([added, more])
    raise RuntimeError(f"facets within {chord} mm of a sphere of radius {radius} mm were not found")


def _on_sphere(points, radius):
    return np.column_stack([points, np.sqrt(np.maximum(radius**2 - (points**2).sum(axis=1), 0))])


def _upper_hull(vertices, ring):
    """Facets over the ring of the first vertices, counter-clockwise seen from above."""
    hull = ConvexHull(vertices)
    facets = hull.simplices[hull.equations[:, 2] > 1e-9]
    a, b, c = (vertices[facets[:, k], :2] for k in range(3))
    clockwise = cross(b - a, c - a) < 0
    facets = np.where(clockwise[:, None], facets[:, ::-1], facets)
    # Rounding error may leave a facet standing over an edge of the ring, outside it.
    n = len(vertices)
    edge = np.arange(ring) * n + np.roll(np.arange(ring), -1)
    while True:
        forward = facets * n + np.roll(facets, -1, axis=1)
        backward = np.roll(facets, -1, axis=1) * n + facets
        outer = ~np.isin(forward, backward)
        wrong = (outer & ~np.isin(forward, edge)).any(axis=1)
        if not wrong.any():
            return facets
        facets = facets[~wrong]


def _splits(vertices, facets, radius, chord, side):
    """Points on the sphere over the middle of each facet that dips too far: of its circle, or of its longest edge."""
    corners = vertices[facets]
    edges = np.roll(corners, -1, axis=1) - corners
    squared = (edges**2).sum(axis=2)
    longest = squared.argmax(axis=1)
    obtuse = 2 * squared.max(axis=1) > squared.sum(axis=1)
    normal = np.cross(edges[:, 0], edges[:, 1])
    area2 = np.linalg.norm(normal, axis=1)
    circle = np.sqrt(squared.prod(axis=1)) / (2 * np.maximum(area2, 1e-300))
    reach = np.where(obtuse, np.sqrt(squared.max(axis=1)) / 2, circle)
    wrong = reach > facet_circumradius(radius, chord) * (1 + 1e-6)
    rows = np.flatnonzero(wrong)
    middle = corners[rows, longest[rows]] + edges[rows, longest[rows]] / 2
    direction = np.where(obtuse[rows, None], middle, normal[rows])
    points = radius * direction[:, :2] / np.linalg.norm(direction, axis=1)[:, None]
    crowded = {j for _, j in KDTree(points).query_pairs(side / 2)} if len(points) else set()
    return points[[i for i in range(len(points)) if i not in crowded]]


def _mean_depth(points, facets, centers, radius):
    """Of the facets below the sphere that their corners lie on, over the area of the plan.

    `|x|^2` has the mean `3/4 g^2 + R^2/4` over a triangle with its corners at `|x| = R` and its centroid at `|x| = g`.
    """
    corners = _on_sphere((points[facets] - centers[:, None]).reshape(-1, 2), radius).reshape(-1, 3, 3)
    centroid = (corners.mean(axis=1) ** 2).sum(axis=1)
    a, b, c = corners[..., :2].transpose(1, 0, 2)
    area = cross(b - a, c - a)
    return float((area * 3 * (radius**2 - centroid)).sum() / (area.sum() * 8 * radius))


def _facet_flat(points, polygon):
    index = np.concatenate(polygon)
    return index[manifold3d.triangulate([points[ring] for ring in polygon])]
