"""The lenses of an array as the part has them: one a cap of its own, of any profile that falls from vertex to rim.

All vertices lie in one plane, and heights are over the land, the plane between the lenses. The land is at the deepest
rim's sag: what is alike ends in it. A lens whose rim is higher stands on a wall, with a draft so that a cast can be
peeled and that walls which touch are one body. The surface is the highest of caps, walls and land: lenses end where
they meet, or at their discs. Lengths in mm, angles in radians.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ..lenses import MicrolensArray, sag, steepness

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

    def steepness(self, squared: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Slope over the distance from the axis, 1/mm."""
        return steepness(np.asarray(squared, float), self.radius, self.conic, self.terms)

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
        steep = self.steepness(squared)
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
