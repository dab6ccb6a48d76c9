"""The plan of an array of spherical caps: where each cap ends and the flat plate between them begins.

The surface is the maximum of the caps and the plate (lenses of one radius meet at the edges of their Voronoi cells), so
a cap's outline is its cell within its disc. Neighbours are given the same points along their common edge: what is
built on these outlines has no cracks. Host code; lengths in mm.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ..layouts.cells import cell_edges, half_size
from ..lenses import MicrolensArray

# Points of the plan that are closer than this are one point: ten times what float32 can tell apart on a 20 mm plate,
# and a fiftieth of the finest facet that is worth printing.
WELD = 1e-5

# Rings differ in length.
Ring = Int[np.ndarray, " _"]


@dataclass(frozen=True)
class Outline:
    """What one lens's Voronoi cell is made of, as indices of the plan's points, counter-clockwise in (x, y).

    Parameters
    ----------
    cap
        The edge of the lens.
    flats
        Polygons of the plate beside it, each a list of rings: the edge, then a hole if the whole disc is one.
    """

    cap: Ring
    flats: list[list[Ring]]


@dataclass(frozen=True)
class Plan:
    """The outlines of all lenses and the points `(x, y)` that they share; `on_plate` marks the points outside caps."""

    points: Float[np.ndarray, "point 2"]
    on_plate: np.ndarray
    outlines: list[Outline]


@dataclass(frozen=True)
class _Edge:
    """One edge of a cell: its two ends, and the points at which a cap touches it, from `start` to `end`."""

    start: int
    end: int
    contact: list[int]


class _Points:
    """Points that are added to as the plan is drawn."""

    def __init__(self, points):
        self.rows = list(points)

    def add(self, points) -> list[int]:
        first = len(self.rows)
        self.rows.extend(points)
        return list(range(first, len(self.rows)))


def draw_plan(array: MicrolensArray, chord: float) -> Plan:
    """The plan of the array's surface, with points so close along each edge that chords stay within `chord`.

    Parameters
    ----------
    array
        Lenses on a plate of finite size.
    chord
        The largest distance between the edge and its chords, mm.

    Raises
    ------
    InputError
        If a lens lies outside the plate, or the plate is infinite.
    """
    centers = np.asarray(array.centers, float)
    lens, ends = _welded_edges(centers, array.size)
    points = _Points(ends.points)
    shared: dict[tuple[int, int], list[int]] = {}
    outlines = []
    of_lens = np.split(ends.pairs, np.searchsorted(lens, np.arange(1, len(centers))))
    draw = _Pen(points, float(array.radius_of_curvature), float(array.aperture_diameter) / 2, chord)
    for center, pairs in zip(centers, of_lens, strict=True):
        edges = []
        for a, b in _around(ends.points, pairs):
            key = (min(a, b), max(a, b))
            if key not in shared:
                shared[key] = draw.contact(center, *key)
            contact = shared[key]
            edges.append(_Edge(a, b, contact if a < b else contact[::-1]))
        outlines.append(draw.outline(center, edges))
    on_plate = np.zeros(len(points.rows), bool)
    for outline in outlines:
        for polygon in outline.flats:
            on_plate[np.concatenate(polygon)] = True
    return Plan(np.array(points.rows), on_plate, outlines)


@dataclass(frozen=True)
class _Ends:
    points: np.ndarray
    pairs: np.ndarray


def _welded_edges(centers, size) -> tuple[np.ndarray, _Ends]:
    """The cells' edges, sorted by lens, as pairs of points that all cells share."""
    lens, start, end, *_ = cell_edges(centers, size)
    order = np.argsort(lens, kind="stable")
    lens, start, end = lens[order], start[order], end[order]
    everywhere = np.concatenate([centers[lens] + start, centers[lens] + end])
    # The plate's sides are flat: what is on them is exactly on them.
    half = half_size(size)
    near_side = np.abs(np.abs(everywhere) - half) < WELD
    everywhere = np.where(near_side, np.sign(everywhere) * half, everywhere)
    close = KDTree(everywhere).query_pairs(WELD, output_type="ndarray")
    graph = coo_array((np.ones(len(close)), close.T), shape=(len(everywhere),) * 2)
    _, label = connected_components(graph, directed=False)
    _, first = np.unique(label, return_index=True)
    pairs = label.reshape(2, -1).T
    kept = pairs[:, 0] != pairs[:, 1]
    return lens[kept], _Ends(everywhere[first], pairs[kept])


def _around(points, pairs):
    """A convex cell's edges counter-clockwise, each from its start to its end."""
    a, b = points[pairs[:, 0]], points[pairs[:, 1]]
    middle = (a + b).mean(axis=0) / 2
    a, b = a - middle, b - middle
    backward = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] < 0
    pairs = np.where(backward[:, None], pairs[:, ::-1], pairs)
    order = np.argsort(np.arctan2(*((a + b) / 2).T[::-1]))
    return pairs[order].tolist()


@dataclass(frozen=True)
class _Pen:
    """Draws the outlines of caps of one curvature `radius` and one disc, of radius `reach`."""

    points: _Points
    radius: float
    reach: float
    chord: float

    def contact(self, center, a, b) -> list[int]:
        """Points of the edge from `a` to `b` that lie in the disc about `center`, a few along it; none if none does.

        On an edge between two lenses both see the same: it is equally far from both.
        """
        p, q = self.points.rows[a], self.points.rows[b]
        length = math.dist(p, q)
        along = (q - p) / length
        foot = float(along @ (center - p))
        off = abs(float(along[0] * (center - p)[1] - along[1] * (center - p)[0]))
        if off > self.reach + WELD:
            return []
        half = math.sqrt(max(self.reach**2 - off**2, 0.0))
        low, high = foot - half, foot + half
        if high < -WELD or low > length + WELD:
            return []
        low, high = (min(max(t, 0.0), length) for t in (low, high))
        if high - low < WELD:
            return self._at((low + high) / 2, length, (a, b), p + (low + high) / 2 * along)
        first = self._at(low, length, (a, b), p + low * along)
        last = self._at(high, length, (a, b), p + high * along)
        if first == last:
            return first
        # The edge is an arc on the sphere; equal steps along it.
        arc = math.sqrt(self.radius**2 - off**2)
        start, stop = (math.asin(max(-1.0, min(1.0, (t - foot) / arc))) for t in (low, high))
        steps = _steps((stop - start) * arc, arc, self.chord)
        t = foot + arc * np.sin(np.linspace(start, stop, steps + 1)[1:-1])
        return first + self.points.add(p + t[:, None] * along) + last

    def _at(self, t, length, ends, point) -> list[int]:
        if t < WELD:
            return [ends[0]]
        return [ends[1]] if t > length - WELD else self.points.add([point])

    def outline(self, center, edges: list[_Edge]) -> Outline:
        """The cap and the flats of one cell, from the edges that the disc touches and the arcs between them."""
        touched = [k for k, edge in enumerate(edges) if edge.contact]
        if not touched:
            circle = self.points.add(self._arc(center, 0.0, 2 * math.pi, closed=True))
            return Outline(np.array(circle), [[np.array([edge.start for edge in edges]), np.array(circle[::-1])]])
        cap, flats = [], []
        for k, following in zip(touched, touched[1:] + touched[:1], strict=True):
            leave, enter = edges[k].contact[-1], edges[following].contact[0]
            cap += edges[k].contact
            if leave == enter and len(touched) > 1:
                continue
            between = [
                edges[i % len(edges)].end for i in range(k, following if following > k else following + len(edges))
            ]
            arc = self._between(center, leave, enter, adjacent=len(between) == 1)
            cap += arc
            flat = _distinct([leave, *between, enter, *arc[::-1]])
            if len(flat) > 2:
                flats.append([np.array(flat)])
        return Outline(np.array(_distinct(cap)), flats)

    def _between(self, center, leave, enter, *, adjacent) -> list[int]:
        """New points of the rim from where it leaves an edge to where it meets the next."""
        start, stop = (math.atan2(*(self.points.rows[i] - center)[::-1]) for i in (leave, enter))
        sweep = (stop - start) % (2 * math.pi)
        near = math.dist(self.points.rows[leave], self.points.rows[enter]) < 10 * WELD
        if leave == enter:
            sweep = 2 * math.pi
        elif adjacent and near:
            # Both round the same corner of the cell: nothing is between, whatever the sign of the rounding error.
            return []
        return self.points.add(self._arc(center, start, sweep, closed=False))

    def _arc(self, center, start, sweep, *, closed):
        steps = _steps(sweep * self.reach, self.reach, self.chord)
        angles = start + np.linspace(0, sweep, steps + 1)[0 if closed else 1 : -1]
        return center + self.reach * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _steps(length: float, radius: float, chord: float) -> int:
    """How many chords an arc of this length and radius takes: `chord = s^2 / (8 radius)`."""
    return max(1, math.ceil(length / math.sqrt(8 * radius * chord)))


def _distinct(ring: list[int]) -> list[int]:
    """Without points that follow themselves."""
    return [point for point, before in zip(ring, ring[-1:] + ring[:-1], strict=True) if point != before]
