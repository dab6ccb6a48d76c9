"""The molded part of an array as numbers: its lenslets, their surface, and facets within a chordal tolerance.

All vertices lie in one plane. Heights are measured from the base, the flat plate between the lenslets, which is as far
below the vertices as the deepest rim. A lenslet with a higher rim stands on a wall with a draft angle. The surface is
the maximum of lenslets, walls and base: neighbours end where they intersect. Lengths in mm, angles in radians.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.integrate import cumulative_simpson
from scipy.spatial import Delaunay, KDTree

from ..microscope.lenses import EACH, MicrolensArray, sag, sag_slope_over_r

# Draft of the walls: lets a cast be peeled, and joins walls that touch into one body.
DRAFT = math.radians(5)
# Steeper rims neither print nor peel well, and their facets are not visible from above.
MAX_SLOPE = math.radians(75)
# The chordal tolerance of lenses of 40 um height and more, mm.
_CHORD = 4e-4
# Rounds that split large facets; one or two are enough.
_SPLIT_ROUNDS = 20
# Lenslets end where others hide them, rounded up to such a part of their own radius: alike ones share facets.
_RADII = 32
# Radii at which a profile is sampled: to map it, and to estimate its curvature.
_MAP_SAMPLES, _SAMPLES = 1025, 257

# Dunavant's quadrature of degree 4 on a triangle, exact for the squared distance of a facet from a sphere.
NODES = np.array(
    [[1 - 2 * a if i == j else a for j in range(3)] for a in (0.445948490915965, 0.091576213509771) for i in range(3)]
)
WEIGHTS = np.repeat([0.223381589678011, 0.109951743655322], 3)


@dataclass(frozen=True)
class Lenslet:
    """One lens of the part: vertex `(x, y)`, radius of the clear disc, radius of curvature, all in mm, and
    conic constant and aspheric terms as of `MicrolensArray`."""

    center: Float[np.ndarray, "2"]
    semi_aperture: float
    radius: float
    conic: float
    terms: tuple[float, ...] = ()

    def sag(self, squared: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Depth of the surface below its vertex at squared distances from the axis, mm."""
        return sag(np.asarray(squared, float), self.radius, self.conic, self.terms)

    def sag_slope_over_r(self, squared: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Slope divided by the distance from the axis, 1/mm."""
        return sag_slope_over_r(np.asarray(squared, float), self.radius, self.conic, self.terms)

    @cached_property
    def rim_sag(self) -> float:
        """Sag at the edge of the aperture, mm."""
        return float(self.sag(np.array([self.semi_aperture**2]))[0])

    @property
    def max_semi_aperture(self) -> float:
        """Largest manufacturable semi-aperture, mm: the slope is positive and at most `MAX_SLOPE` inside it."""
        if self._is_manufacturable(self.semi_aperture):
            return self.semi_aperture
        low, high = 0.0, self.semi_aperture
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if self._is_manufacturable(middle) else (low, middle)
        return low

    @property
    def max_slope(self) -> float:
        """Largest slope inside the aperture."""
        r = np.linspace(0, self.semi_aperture, _SAMPLES)
        return float((r * self.sag_slope_over_r(r**2)).max())

    def _is_manufacturable(self, semi_aperture) -> bool:
        squared = np.linspace(0, semi_aperture, _SAMPLES) ** 2
        if not ((1 + self.conic) * squared < self.radius**2).all():
            return False
        slope_over_r = self.sag_slope_over_r(squared)
        return bool((slope_over_r > 0).all() and (slope_over_r * np.sqrt(squared) <= math.tan(MAX_SLOPE)).all())


@dataclass(frozen=True)
class Part:
    """The molded part of an array, in its own frame.

    Parts have their lenslets toward -z. An array whose plano side faces the object keeps the design's x and y. One
    whose curved side faces the object is rotated about x, so that its y is reversed; a mirrored part would be wrong.
    """

    array: MicrolensArray

    @cached_property
    def size(self) -> tuple[float, float]:
        """`(x, y)` of the plate, mm, infinite if the array has none."""
        return self.array.plate

    @cached_property
    def centers(self) -> Float[np.ndarray, "lens 2"]:
        """Vertices `(x, y)` of the lenslets, mm."""
        return np.asarray(self.array.centers, float) * (1.0, 1.0 if self.array.orientation == "plano" else -1.0)

    @cached_property
    def lenslets(self) -> list[Lenslet]:
        """The lenslets, in the order of the array's lenses."""
        radius, diameter, conic = (np.asarray(self.array.of_lenses(name), float).tolist() for name in EACH)
        terms = tuple(np.asarray(self.array.aspheric_terms, float).tolist())
        return [
            Lenslet(center, d / 2, r, k, terms)
            for center, d, r, k in zip(self.centers, diameter, radius, conic, strict=True)
        ]

    @cached_property
    def height(self) -> float:
        """Height of the vertices above the base, mm: the largest rim sag."""
        return max(lenslet.rim_sag for lenslet in self.lenslets)

    @property
    def thickness(self) -> float:
        """Thickness from the plano face to the vertices, mm."""
        return float(self.array.substrate_thickness)

    @property
    def plate_thickness(self) -> float:
        """Thickness of the plate between the lenslets, mm."""
        return self.thickness - self.height

    @cached_property
    def lowest(self) -> float:
        """Height of the lowest lenslet, from its rim to its vertex, mm."""
        return min(lenslet.rim_sag for lenslet in self.lenslets)

    @property
    def max_chord(self) -> float:
        """The coarsest chordal tolerance, mm: a tenth of the lowest lenslet."""
        return 0.1 * self.lowest

    @property
    def default_chord(self) -> float:
        """The chordal tolerance by default, mm: 0.4 um, or a hundredth of the lowest lenslet."""
        return min(_CHORD, 0.01 * self.lowest)

    def surface(
        self, x: Float[np.ndarray, " x"], y: Float[np.ndarray, " y"]
    ) -> tuple[Float[np.ndarray, "y x"], Int[np.ndarray, "y x"]]:
        """Heights of the surface above the base on a grid, mm, and the lenslet there, as of `surface_height`."""
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        height, owner = surface_height(self.lenslets, points)
        return height.reshape(len(y), len(x)), owner.reshape(len(y), len(x))

    @cached_property
    def visible_radii(self) -> list[float]:
        """Upper bounds of the distances from each vertex at which the lenslet is not hidden by others, mm.

        The plate is cut into tiles. A lenslet is hidden in a tile if its height at the nearest point of the tile is
        below another lenslet's height at the farthest point.
        """
        step = math.sqrt(math.prod(self.size) / (400 * len(self.lenslets)))
        count = [math.ceil(side / step) for side in self.size]
        middles = [(np.arange(n) + 0.5) * (side / n) - side / 2 for n, side in zip(count, self.size, strict=True)]
        tiles = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, 2)
        half = math.hypot(*(side / n for n, side in zip(count, self.size, strict=True))) / 2
        lower_bound = np.zeros(len(tiles))
        neighbourhoods = list(_near(self.lenslets, tiles, self.height, half))
        for lenslet, (near, squared) in zip(self.lenslets, neighbourhoods, strict=True):
            far = np.sqrt(squared) + half
            near, far = near[far <= lenslet.semi_aperture], far[far <= lenslet.semi_aperture]
            lower_bound[near] = np.maximum(lower_bound[near], self.height - lenslet.sag(far**2))
        radii = []
        for lenslet, (near, squared) in zip(self.lenslets, neighbourhoods, strict=True):
            distance, edge = np.sqrt(squared), lenslet.semi_aperture
            visible = self.height - lenslet.sag(np.clip(distance - half, 0, edge) ** 2) >= lower_bound[near]
            radius = float((distance + half)[visible].max(initial=half))
            radii.append(edge * min(math.ceil(_RADII * radius / edge) / _RADII, 1))
        return radii

    def facet_count(self, chord: float) -> float:
        """Estimated number of facets: equilateral ones of `side^2 = 6 chord / kappa`, and 20 % for the edges."""
        count = 0.0
        for lenslet, radius in zip(self.lenslets, self.visible_radii, strict=True):
            curvature = _Profile(lenslet, radius, _SAMPLES).max_curvature
            count += math.pi * radius**2 / (math.sqrt(3) / 4 * 6 / curvature * chord)
        return 1.2 * count


def surface_height(
    lenslets: Sequence[Lenslet], points: Float[np.ndarray, "point 2"], margin: float = 0.0
) -> tuple[Float[np.ndarray, " point"], Int[np.ndarray, " point"]]:
    """Height of the surface above the base at points `(x, y)`, mm, and the index of the lenslet there.

    The index is -1 on walls and base, and where the lenslet is not more than `margin`, mm, above everything else.
    """
    top = max(lenslet.rim_sag for lenslet in lenslets)
    height, second, owner = np.zeros(len(points)), np.zeros(len(points)), np.full(len(points), -1)
    for number, (lenslet, (near, squared)) in enumerate(zip(lenslets, _near(lenslets, points, top), strict=True)):
        edge = lenslet.semi_aperture
        beyond = np.sqrt(np.maximum(squared, edge**2)) - edge
        own = top - lenslet.sag(np.minimum(squared, edge**2)) - beyond / math.tan(DRAFT)
        higher = own > height[near]
        second[near] = np.maximum(second[near], np.minimum(own, height[near]))
        height[near[higher]] = own[higher]
        owner[near[higher]] = np.where(beyond[higher] > 0, -1, number)
    return height, np.where(height - second > margin, owner, -1) if margin else owner


def _near(lenslets, points, top, margin=0.0):
    """Yields for each lenslet the indices of points within its wall, and their squared distances from its axis."""
    order = np.argsort(points[:, 0], kind="stable")
    x = points[order, 0]
    for lenslet in lenslets:
        extent = lenslet.semi_aperture + (top - lenslet.rim_sag) * math.tan(DRAFT) + margin
        first, last = np.searchsorted(x, lenslet.center[0] + np.array([-extent, extent]))
        near = order[first:last]
        squared = ((points[near] - lenslet.center) ** 2).sum(axis=1)
        yield near[squared < extent**2], squared[squared < extent**2]


class Tessellation(NamedTuple):
    """Facets of a lenslet, counter-clockwise in (x, y), as indices of points.

    Points are relative to the axis, mm; the first `num_edge` lie on the edge. `sag` is theirs, see `tessellate`.
    """

    points: Float[np.ndarray, "point 2"]
    sag: Float[np.ndarray, " point"]
    facets: Int[np.ndarray, "facet 3"]
    num_edge: int


class _Profile:
    """The surface of a lenslet at some radii: curvatures, 1/mm, arc length, and maps to the plane."""

    def __init__(self, lenslet: Lenslet, radius: float, samples: int = _MAP_SAMPLES):
        r = self.radii = np.linspace(0, radius, samples)
        self._slope_over_r = slope_over_r = lenslet.sag_slope_over_r(r**2)
        stretch = self.stretch = np.sqrt(1 + (r * slope_over_r) ** 2)
        meridional = np.gradient(r * slope_over_r, r, edge_order=2) / stretch**3
        sagittal = slope_over_r / stretch
        self.mean_curvature = (meridional + sagittal) / 2
        self.max_curvature = float(max(np.abs(meridional).max(), sagittal.max()))

    def _integral(self, values):
        return cumulative_simpson(values, x=self.radii, initial=0)

    @cached_property
    def arc_length(self):
        return self._integral(self.stretch)

    @cached_property
    def conformal(self):
        # (stretch - 1) / r, without a division by zero on the axis.
        return self.radii * np.exp(self._integral(self.radii * self._slope_over_r**2 / (1 + self.stretch)))

    @cached_property
    def equal_area(self):
        return np.sqrt(2 * self._integral(self.radii * self.stretch))


def tessellate(lenslet: Lenslet, radius: float, chord: float) -> Tessellation:
    """Tessellates a lenslet up to a distance from its axis, within a chordal tolerance, both in mm.

    A surface of revolution maps conformally to the plane by `ln q = int sqrt(1 + s'^2) / r dr`, so the Delaunay
    triangulation of the mapped points is that of the surface; for a sphere this is the stereographic projection and
    yields the convex hull. A facet with circumradius rho is at most `rho^2 kappa / 2` deep, with kappa the largest
    principal curvature. Interior vertices are moved outward by the mean depth of the facets, so that thickness and
    volume are unbiased.

    Raises `RuntimeError` if the facets do not converge; they do for slopes up to `MAX_SLOPE`.
    """
    profile = _Profile(lenslet, radius)
    circumradius = math.sqrt(2 * (1 / profile.max_curvature) * chord - chord**2)
    inner, side = _hexagonal_points(profile, circumradius)
    # Bound both the chordal error of the edge in the plane and its spacing on the surface.
    count = max(6, math.ceil(2 * math.pi * radius / min(side, math.sqrt(8 * radius * chord))))
    step = 2 * math.pi / count
    angle = step * np.arange(count)
    # The polygon has the area of the disc.
    edge = radius * math.sqrt(step / math.sin(step)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate([edge, inner if len(inner) else np.zeros((1, 2))])
    for _ in range(_SPLIT_ROUNDS):
        flat = _rescale(points, profile.radii, profile.conformal)
        facets = _delaunay(flat)
        vertices = np.column_stack([points, -lenslet.sag(np.minimum((points**2).sum(axis=1), radius**2))])
        added = _rescale(_split_points(flat, vertices, facets, circumradius), profile.conformal, profile.radii)
        added = added[np.hypot(*added.T) < radius * math.cos(math.pi / count)]
        if not len(added):
            sag = _offset_sag(lenslet, profile, vertices, facets, count, len(inner))
            return Tessellation(points, sag, facets, count)
        crowded = {j for _, j in KDTree(added).query_pairs(side / 2)}
        points = np.concatenate([points, added[[i for i in range(len(added)) if i not in crowded]]])
    raise RuntimeError(f"the tessellation of {lenslet} did not converge within {chord} mm")


def _rescale(points, radii, mapped_radii):
    distance = np.hypot(*points.T)
    return points * (np.interp(distance, radii, mapped_radii) / np.maximum(distance, 1e-300))[:, None]


def _hexagonal_points(profile: _Profile, circumradius):
    """A hexagonal lattice in the equal-area map, as points `(x, y)`, and its spacing."""
    # The map stretches more toward the rim. The spacing fits at 60 % of the way, where neighbours begin to cut
    # lenslets off; facets that are too large farther out are split.
    limit, fit = profile.equal_area[-1], int(0.6 * _MAP_SAMPLES)
    side = 0.98 * math.sqrt(3) * circumradius * profile.radii[fit] / profile.equal_area[fit]
    count = math.ceil(limit / side) + 1
    i, j = np.meshgrid(*[np.arange(-2 * count, 2 * count + 1)] * 2)
    lattice = side * np.stack([i + j / 2, math.sqrt(3) / 2 * j], axis=-1).reshape(-1, 2)
    distance = np.hypot(*lattice.T)
    from_edge = profile.arc_length[-1] - np.interp(distance, profile.equal_area, profile.arc_length)
    return _rescale(lattice[(distance < limit) & (from_edge > side / 2)], profile.equal_area, profile.radii), side


def _delaunay(flat):
    facets = Delaunay(flat).simplices
    a, b, c = (flat[facets[:, k]] for k in range(3))
    clockwise = _cross(b - a, c - a) < 0
    return np.where(clockwise[:, None], facets[:, ::-1], facets)


def _split_points(flat, vertices, facets, max_circumradius):
    """Points in the map that split large facets: circumcentres, or middles of the longest edges of obtuse facets."""
    corners = vertices[facets]
    edges = np.roll(corners, -1, axis=1) - corners
    squared = (edges**2).sum(axis=2)
    obtuse = 2 * squared.max(axis=1) > squared.sum(axis=1)
    area2 = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    circumradius = np.sqrt(squared.prod(axis=1)) / (2 * np.maximum(area2, 1e-300))
    enclosing = np.where(obtuse, np.sqrt(squared.max(axis=1)) / 2, circumradius)
    large = np.flatnonzero(enclosing > max_circumradius * (1 + 1e-6))
    longest = squared[large].argmax(axis=1)
    a, b, c = (flat[facets[large, (longest + k) % 3]] for k in range(3))
    u, v = b - a, c - a
    normal = ((u**2).sum(axis=1)[:, None] * v - (v**2).sum(axis=1)[:, None] * u) / (2 * _cross(u, v))[:, None]
    circumcentre = a + np.stack([normal[:, 1], -normal[:, 0]], axis=1)
    return np.where(obtuse[large, None], (a + b) / 2, circumcentre)


def _offset_sag(lenslet, profile: _Profile, vertices, facets, num_edge, num_lattice):
    """Sags of vertices moved outward by the mean depth of the facets, in proportion to the mean curvature."""
    outward = np.interp(np.hypot(*vertices[:, :2].T), profile.radii, profile.stretch * profile.mean_curvature)
    corners = vertices[facets]
    nodes = np.einsum("qk,fkx->fqx", NODES, corners)
    depth = -lenslet.sag((nodes[..., :2] ** 2).sum(axis=-1)) - nodes[..., 2]
    a, b, c = corners[..., :2].transpose(1, 0, 2)
    area = _cross(b - a, c - a)
    # Facets at the edge and split ones have other sizes, and are mostly hidden by neighbours: the lattice decides.
    regular = ((facets >= num_edge) & (facets < num_edge + num_lattice)).all(axis=1)
    weight = area * regular if regular.any() else area
    outward *= weight @ (depth @ WEIGHTS) / (weight @ outward[facets].mean(axis=1))
    outward[:num_edge] = 0
    return -vertices[:, 2] - outward


def _cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
