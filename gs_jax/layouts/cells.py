"""How a layout covers its plate: distances of neighbours, holes, Voronoi cells. Host code; lengths in mm.

Reflect the centres at the four edges, and the Voronoi cells of the originals become their cells within the
plate, with the plate's corners and the crossings of cells and edges among the vertices. All that is exact here
rests on this.
"""

import math
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import Delaunay, KDTree, Voronoi

from ..base.errors import InputError

Number = float | int
# Of a place in single precision: a lens on the plate's edge is on the plate.
ROUNDING = 1e-6


def nearest_neighbour_distances(centers: Float[np.ndarray, "lens 2"]) -> Float[np.ndarray, " lens"]:
    """Distance of each centre from the nearest other one, mm; infinite for a single centre.

    Their mean is the array's pitch.
    """
    return KDTree(centers).query(centers, k=2)[0][:, 1]


def coverage(centers: Float[np.ndarray, "lens 2"], size: Sequence[Number], *, diameter: Number) -> float:
    """The fraction of the plate's area that lies in a disc of this diameter (mm) about a centre; exact.

    The sum over the lenses of the area that a disc and its lens's Voronoi cell share.

    Raises
    ------
    InputError
        If the diameter is not positive or a centre lies outside the plate.
    """
    check_positive("diameter", diameter)
    edges = cell_edges(centers, size)
    height, radius = edges.height, diameter / 2
    half_chord = np.sqrt(np.maximum(radius**2 - height**2, 0))

    def wedge(t):  # what the disc shares with the triangle from its centre to the edge's line, from the foot to t
        inner = np.clip(t, -half_chord, half_chord)
        return height * inner / 2 + radius**2 / 2 * (np.arctan2(t, height) - np.arctan2(inner, height))

    area = wedge(edges.high) - wedge(edges.low)
    return min(1.0, float(area.sum() / math.prod(size)))


def largest_hole(centers: Float[np.ndarray, "lens 2"], size: Sequence[Number]) -> float:
    """The largest distance of a point of the plate from the nearest centre, mm; exact.

    Discs of this radius about the centres just cover the plate. The farthest point is a vertex of a Voronoi
    cell, where a cell meets an edge of the plate, or a corner.

    Raises
    ------
    InputError
        If a centre lies outside the plate.
    """
    _check_inside(centers, half := half_size(size))
    vertices, _, _ = gaps(centers, half)
    return float(KDTree(centers).query(vertices)[0].max())


def gaps(centers, half, reach=math.inf):
    """Vertices of the Voronoi cells within the plate, the lenses around each, and its distance from them."""
    points, owners = _reflected(centers, half, reach)
    triangles = Delaunay(points)
    # Qhull finds triangles as facets of the points lifted to a paraboloid; a normal's foot is a circumcentre.
    vertices = -triangles.equations[:, :2] / (2 * triangles.paraboloid_scale * triangles.equations[:, 2:3])
    inside = (np.abs(vertices) <= half * (1 + 1e-6)).all(axis=1)
    vertices, lenses = np.clip(vertices[inside], -half, half), owners[triangles.simplices[inside]]
    return vertices, lenses, np.hypot(*(vertices - centers[lenses[:, 0]]).T)


def _reflected(centers, half, reach=math.inf):
    """Centres, then their reflections at each edge within reach; and which centre each one is of."""
    # A centre on an edge would coincide with its reflection.
    inner = np.clip(centers, -half * (1 - 1e-8), half * (1 - 1e-8))
    points, owners = [inner], [np.arange(len(centers))]
    for axis, side in product((0, 1), (-1, 1)):
        near = np.flatnonzero(half[axis] - side * inner[:, axis] < reach)
        images = inner[near]
        images[:, axis] = 2 * side * half[axis] - images[:, axis]
        points.append(images)
        owners.append(near)
    return np.concatenate(points), np.concatenate(owners)


class Edges(NamedTuple):
    """Edges of Voronoi cells, each once for every cell: their lens, and where they are as seen from its centre, mm.

    `start`, `end`: points. `height`: distance of the edge's line. `low`, `high`: the ends along it, from the foot.
    `beyond`: the lens on its other side; for the plate's sides at -x, +x, -y and +y the count of lenses plus 0 to 3.
    """

    lens: Int[np.ndarray, " edge"]
    start: Float[np.ndarray, "edge 2"]
    end: Float[np.ndarray, "edge 2"]
    height: Float[np.ndarray, " edge"]
    low: Float[np.ndarray, " edge"]
    high: Float[np.ndarray, " edge"]
    beyond: Int[np.ndarray, " edge"]


def cell_edges(centers, size) -> Edges:
    """Edges of the cells within the plate."""
    _check_inside(centers, half := half_size(size))
    points, _ = _reflected(centers, half)
    diagram = Voronoi(points)
    lens, beyond = diagram.ridge_points.ravel(), diagram.ridge_points[:, ::-1].ravel()
    # Reflections follow the lenses, side by side.
    beyond = np.where(beyond < len(centers), beyond, len(centers) + beyond // len(centers) - 1)
    vertices = np.repeat(diagram.ridge_vertices, 2, axis=0)
    ends = diagram.vertices[vertices]
    kept = (lens < len(centers)) & (ends[:, 0] != ends[:, 1]).any(axis=1)
    lens, beyond, ends = lens[kept], beyond[kept], ends[kept] - points[lens[kept], None]
    start, end = ends[:, 0], ends[:, 1]
    along = (end - start) / np.hypot(*(end - start).T)[:, None]
    height, low, high = np.abs(cross(start, along)), (start * along).sum(axis=1), (end * along).sum(axis=1)
    return Edges(lens, start, end, height, low, high, beyond)


def cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def check_positive(name, value):
    if not 0 < value < math.inf:
        raise InputError(f"`{name}` must be positive and finite, mm, got {value}.")


def _check_inside(centers, half):
    outside = (np.abs(centers) > half * (1 + ROUNDING)).any(axis=1) | ~np.isfinite(centers).all(axis=1)
    if outside.any() or len(centers) == 0:
        raise InputError(
            f"`centers` must be one or more points on a plate of {in_mm(half)}, got {outside.sum()} outside."
        )


def half_size(size) -> Float[np.ndarray, "2"]:
    """Half the plate's size, mm."""
    if len(size) != 2 or not all(0 < length < math.inf for length in size):
        raise InputError(f"`size` must be two positive lengths, mm, got {tuple(size)}.")
    return np.array(size, float) / 2


def in_mm(half) -> str:
    return f"{2 * half[0]:.4g} x {2 * half[1]:.4g} mm"
