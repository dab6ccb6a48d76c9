"""The microlens array as a solid, and the negative mold to cast it in.

Both are in the part's frame: the plano face is z = 0, the vertices of the lenses are at z = -t. The optics counts the
plate's thickness t to the vertices, and so does the part: between lenses it is thinner, by the deepest rim's sag.
If the plano side faces the object that is the design's frame, x and y as the sensor's and z toward the object. If the
curved side does, the part has been turned over about x: y runs against the sensor's, z points toward the sensor. The
frame is right-handed, as it is for a camera whose ordinary pictures are not mirrored; a part that is mirrored would be
another design.

The mold holds the array as it lies, lenses down, and opens upward, toward +z: pour, cover with a glass plate, cure,
peel. Lengths in mm, angles in radians.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import manifold3d as m3
import numpy as np
from jaxtyping import Float
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath

from ..base.errors import InputError
from ..base.progress import Progress
from ..layouts import ROUNDING, cell_edges, half_size, in_mm, nearest_neighbour_distances
from ..lenses import MicrolensArray
from .lenslets import DRAFT, Cap, cap_sag, caps_of, estimated_facets, facet_cap, surface, visible_reaches

# How far a tool that cuts reaches beyond what it cuts: no two faces coincide.
_BEYOND = 1.0
# Depth of what is engraved in the rim.
ENGRAVED = 0.4
CLOSEST = 1e-3
# The largest chord error in heights of a lens: with fewer facets it is no lens.
COARSEST = 0.1
# More take gigabytes of memory and of disk.
MAX_FACETS = 5_000_000
# A wall that is lower is none, mm: ten times what float32 can tell apart on a 20 mm plate.
_LOWEST_WALL = 1e-5


@dataclass(frozen=True)
class MoldShape:
    """What is around the array in its mold.

    Parameters
    ----------
    wall, floor
        Thickness of the walls, and of the floor below the lenses, mm.
    headroom
        How much higher the walls are than the array's plano face, mm: 0 to cast flush with the rim.
    draft
        Angle of the walls' inner faces from the vertical, radians. The cast part's sides have it too.
    shrinkage
        Fraction by which the cast material shrinks; the cavity is larger by `1 / (1 - shrinkage)`.
    marks
        Crosses in three corners of the rim, for alignment; as in a QR code, the corner without (+x, +y) tells which
        way round and which side up it is.
    label
        Text to engrave in the rim, in so far as the font has it.

    Raises
    ------
    ValueError
        If a length, the angle or the shrinkage is out of its range.
    """

    wall: float = 4.0
    floor: float = 2.0
    headroom: float = 0.0
    draft: float = 0.0
    shrinkage: float = 0.0
    marks: bool = True
    label: str = ""

    def __post_init__(self):
        for name in ("wall", "floor"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"`{name}` must be positive and finite, mm, got {getattr(self, name)}.")
        if not 0 <= self.headroom < math.inf:
            raise ValueError(f"`headroom` must be zero or more and finite, mm, got {self.headroom}.")
        if not 0 <= self.draft < math.pi / 4:
            raise ValueError(f"`draft` must be from 0 to below pi/4 radians, got {self.draft}.")
        if not 0 <= self.shrinkage < 0.5:
            raise ValueError(f"`shrinkage` must be a fraction from 0 to below 0.5, got {self.shrinkage}.")

    @property
    def scale(self) -> float:
        """Size of the cavity in that of the cast part after it has shrunk."""
        return 1 / (1 - self.shrinkage)


def plate_thickness(array: MicrolensArray) -> float:
    """Thickness of the array between its lenses: the optics' plate up to the vertices, less the deepest sag, mm."""
    return float(array.substrate_thickness) - cap_sag(array)


def array_solid(array: MicrolensArray, chord: float = 5e-4, *, progress: Progress | None = None) -> m3.Manifold:
    """The array as a solid: the plate with its lenses, plano behind, straight sides.

    Each lens is a body of its own, down into the plate; the part is their union.

    Parameters
    ----------
    array
        Lenses on a plate of finite size, thicker than the lenses' sag.
    chord
        The largest distance between a facet and its lens's surface, mm.
    progress
        Shows how many lenses are done.

    Raises
    ------
    InputError
        If a lens lies outside the plate, or the plate is infinite.
    ValueError
        If two lenses are at one place, their rims are too steep, the plate is not thicker than their sag, or `chord` is
        not positive and at most a tenth of the height of a lens, or takes millions of facets.
    """
    check_array(array)
    caps, thickness = caps_of(array), plate_thickness(array)
    coarsest, reaches = coarsest_chord(caps), visible_reaches(caps, array.size)
    if not 0 < chord <= coarsest:
        raise ValueError(f"`chord` must be positive and at most {coarsest:.4g} mm, got {chord}.")
    if (count := estimated_facets(caps, reaches, chord)) > MAX_FACETS:
        raise ValueError(f"`chord` of {chord} mm takes about {count:.2g} facets, allowed: up to {MAX_FACETS:.2g}.")
    # Heights over the land, lenses up.
    land, (x, y) = cap_sag(array), array.size
    pairs = list(zip(caps, reaches, strict=True))
    bodies = [
        _body(cap, reach, chord, land, thickness / 2)
        for cap, reach in (progress or Progress()).track(pairs, "Tessellating")
    ]
    box = lambda low, high: m3.Manifold.cube([x, y, high - low]).translate([-x / 2, -y / 2, low])
    lenses = m3.Manifold.batch_boolean(bodies, m3.OpType.Add) ^ box(-thickness, land + _BEYOND)
    # Lenses down: mirrored, which turns a solid's facets too.
    return checked((lenses + box(-thickness, 0)).mirror([0, 0, 1]).translate([0, 0, -thickness]))


def coarsest_chord(caps: list[Cap]) -> float:
    """The largest chord error that leaves every lens one, mm."""
    return COARSEST * min(cap.rim for cap in caps)


def _body(cap: Cap, reach, chord, land, deep) -> m3.Manifold:
    """A lens and what carries it: from its rim, or where others hide it, a wall with a draft down into the plate."""
    points, sag, facets, count = facet_cap(cap, reach, chord)
    height = land - sag
    if height[:count].max() < _LOWEST_WALL:
        height[:count] = 0
    foot = points[:count] * (1 + (height[0] + deep) * math.tan(DRAFT) / math.hypot(*points[0]))
    vertices = np.concatenate([np.column_stack([points, height]), np.column_stack([foot, np.full(count, -deep)])])
    top = np.arange(count)
    after, under, bottom = np.roll(top, -1), len(points), len(points) + top
    wall = [np.stack([top, bottom, under + after], axis=1), np.stack([top, under + after, after], axis=1)]
    floor = np.stack([np.full(count - 2, under), bottom[2:], bottom[1:-1]], axis=1)
    mesh = m3.Mesh64(vertices, np.concatenate([facets, *wall, floor]).astype(np.uint64))
    return checked(m3.Manifold(mesh)).translate([*cap.center.tolist(), 0.0])


def check_array(array: MicrolensArray) -> None:
    """`ValueError` for an array that has no solid; `InputError` if it has lenses outside its plate."""
    centers, half = np.asarray(array.centers, float), half_size(array.size)
    if not np.isfinite(centers).all():
        raise ValueError("`centers` must be finite.")
    if outside := int((np.abs(centers) > half * (1 + ROUNDING)).any(axis=1).sum()):
        raise InputError(f"`centers` must be points on a plate of {in_mm(half)}, got {outside} outside.")
    if fault := too_wide(caps_of(array)):
        raise ValueError(f"`aperture_diameter` must be positive and at most {fault.allowed}, got {fault.found}.")
    if not plate_thickness(array) > 0:
        allowed = f"more than the lenses' sag, {cap_sag(array):.4g} mm"
        raise ValueError(f"`substrate_thickness` must be {allowed}, got {float(array.substrate_thickness):g} mm.")
    # An array of JAX's float32 is exact to a little less than the limit.
    if len(centers) > 1 and (closest := nearest_neighbour_distances(centers).min()) < 0.99 * CLOSEST:
        raise ValueError(f"`centers` must be {CLOSEST} mm apart or more, got two lenses {closest:.3g} mm apart.")


class Fault(NamedTuple):
    """What was found, and what is allowed, in words."""

    found: str
    allowed: str


def too_wide(caps: list[Cap]) -> Fault | None:
    """The first lens that is too wide to be made, if there is one: its aperture's diameter."""
    for number, cap in enumerate(caps, 1):
        if not 0 < cap.reach or cap.widest < cap.reach:
            which = f" for lens {number}" if len({cap.reach for cap in caps}) > 1 else ""
            return Fault(f"{2 * cap.reach:g}", f"{2 * cap.widest:.4g} mm{which}")
    return None


def checked(solid: m3.Manifold) -> m3.Manifold:
    """The solid itself, if it is one; `RuntimeError` otherwise, a fault of the program."""
    if solid.status() != m3.Error.NoError or solid.is_empty():
        raise RuntimeError(f"the surface encloses no solid: {solid.status().name}")
    return solid


def cast_solid(array: MicrolensArray, part: m3.Manifold, shape: MoldShape) -> m3.Manifold:
    """What fills the mold up to its rim, before it shrinks: the array, enlarged, with the sides of the walls."""
    cavity = part.scale([shape.scale] * 3)
    if shape.draft == 0 and shape.headroom == 0:
        return cavity
    return cavity + _within_walls(array, shape, shape.headroom)


def _within_walls(array, shape, top):
    """What the walls enclose from the plate's plane up to a height."""
    half, bottom = np.array(array.size) / 2 * shape.scale, -plate_thickness(array) * shape.scale
    flare = (top - bottom) * math.tan(shape.draft)
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    rings = [np.column_stack([signs * (half + wider), np.full(4, z)]) for wider, z in ((0, bottom), (flare, top))]
    return m3.Manifold.hull_points(np.concatenate(rings))


def mold_block(array: MicrolensArray, shape: MoldShape) -> Float[np.ndarray, "2 3"]:
    """Lowest and highest corner of the mold, mm."""
    deep = float(array.substrate_thickness) * shape.scale
    opening = np.array(array.size) / 2 * shape.scale
    opening = opening + (plate_thickness(array) * shape.scale + shape.headroom) * math.tan(shape.draft)
    high = np.array([*(opening + shape.wall), shape.headroom])
    return np.stack([[-high[0], -high[1], -deep - shape.floor], high])


def mold_solid(array: MicrolensArray, part: m3.Manifold, shape: MoldShape = MoldShape()) -> m3.Manifold:
    """The negative mold of an array: a block, less the cavity that the array fills.

    Parameters
    ----------
    array
        Lenses on a plate of finite size.
    part
        Its solid, `array_solid(array)`.
    shape
        What is around it.
    """
    low, high = mold_block(array, shape)
    block = m3.Manifold.cube((high - low).tolist()).translate(low.tolist())
    open_above = _within_walls(array, shape, shape.headroom + _BEYOND)
    tools = [part.scale([shape.scale] * 3), open_above, *engravings(array, shape)]
    return checked(block - m3.Manifold.batch_boolean(tools, m3.OpType.Add))


def engravings(array: MicrolensArray, shape: MoldShape) -> list[m3.Manifold]:
    """The tools that cut the marks and the label into the rim."""
    low, high = mold_block(array, shape)
    middle = high[:2] - shape.wall / 2
    plans = mark_plans(array, shape) if shape.marks else []
    text = _text(shape.label, height=0.4 * shape.wall, width=2 * (middle[0] - shape.wall))
    if not text.is_empty():
        plans.append(text.translate([0.0, -middle[1]]))
    depth = min(ENGRAVED, (high[2] - low[2]) / 4)
    return [plan.extrude(depth + _BEYOND).translate([0, 0, high[2] - depth]) for plan in plans]


def mark_plans(array: MicrolensArray, shape: MoldShape) -> list[m3.CrossSection]:
    """The crosses in the mold's rim, seen from above."""
    middle, arm = mold_block(array, shape)[1, :2] - shape.wall / 2, 0.6 * shape.wall
    bar = m3.CrossSection.square([arm, arm / 6], center=True)
    cross = bar + bar.rotate(90)
    return [cross.translate([sx * middle[0], sy * middle[1]]) for sx, sy in ((-1, -1), (1, -1), (-1, 1))]


def _text(label: str, *, height: float, width: float) -> m3.CrossSection:
    """The label's outlines about the origin, at most so high and wide; empty without a letter that can be drawn."""
    drawable = "".join(c for c in label if " " <= c <= "~")
    if not drawable.strip() or width <= 0:
        return m3.CrossSection()
    path = TextPath((0, 0), drawable.replace("$", r"\$"), size=10, prop=FontProperties(family="DejaVu Sans"))
    outlines = [np.array(ring, float)[:-1] for ring in path.to_polygons()]
    text = m3.CrossSection(outlines, m3.FillRule.NonZero)
    x0, y0, x1, y1 = text.bounds()
    size = min(height / 10, width / (x1 - x0))
    return text.translate([-(x0 + x1) / 2, -(y0 + y1) / 2]).scale([size, size])


# Of a solid's volume against the analytic one. Facets within 0.5 um of the lenses come within 1e-5.
VOLUME_TOLERANCE = 1e-4
# Places at which lenses that differ are integrated, a side of the plate.
_PLACES = 1400


def caps_volume(array: MicrolensArray) -> float:
    """Volume of the lenses over the land, mm^3.

    Raises
    ------
    InputError
        If a lens lies outside the plate, or the plate is infinite.
    """
    caps = caps_of(array)
    if array.alike:
        return _alike_volume(caps[0], np.asarray(array.centers, float), array.size)
    return _surface_volume(caps, array.size)


def _alike_volume(cap: Cap, centers, size, nodes: int = 64) -> float:
    """By quadrature over the sectors of the lenses' Voronoi cells, where lenses that are alike end.

    In the direction `phi` a cap ends at `r = min(D/2, d / cos(phi))`, with `d` the distance of the cell's edge, and
    holds `int h r dr`. What ends at the rim is a constant. For what ends at the edge, `r = d cosh(u)` and
    `dphi = du / cosh(u)`: smooth even where the edge passes by the vertex.
    """
    x, weights = np.polynomial.legendre.leggauss(nodes)

    def held(r2):
        inner = r2[..., None] * (1 + x) / 2
        return r2 / 4 * ((cap.rim - cap.sag(inner)) @ weights)

    edges = cell_edges(centers, size)
    # An edge through the vertex has no sector.
    off, *ends = (x[edges.height > 1e-12] for x in (edges.height, edges.low, edges.high))
    half = np.sqrt(np.maximum(cap.reach**2 - off**2, 0))
    within = [np.clip(t, -half, half) for t in ends]
    at_rim = (
        np.arctan2(ends[1], off) - np.arctan2(ends[0], off) - np.arctan2(within[1], off) + np.arctan2(within[0], off)
    )
    low, high = (np.arcsinh(t / off)[:, None] for t in within)
    cosh = np.cosh((high + low) / 2 + (high - low) / 2 * x)
    at_edge = (high - low)[:, 0] / 2 * ((held(np.minimum(off[:, None] * cosh, cap.reach) ** 2) / cosh) @ weights)
    return float((held(np.array(cap.reach**2)) * at_rim + at_edge).sum())


def _surface_volume(caps: list[Cap], size) -> float:
    """By Gauss's rule of two nodes in each of the cells of a grid: where a lens or a wall ends in one, errors of either
    sign, some 1e-7 of the whole together."""
    half = np.array([-1, 1]) / (2 * math.sqrt(3))
    x, y = (((np.arange(_PLACES // 2)[:, None] + 0.5 + half).ravel() / (_PLACES // 2) - 0.5) * side for side in size)
    height, _ = surface(caps, np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2))
    return float(height.mean() * math.prod(size))


def array_volume(array: MicrolensArray) -> float:
    """Volume of the array: plate and lenses, mm^3."""
    return math.prod(array.size) * plate_thickness(array) + caps_volume(array)


def mold_volume(array: MicrolensArray, shape: MoldShape) -> float:
    """Volume of the mold: the block, less lenses, what the walls enclose, and engraved marks and label, mm^3."""
    low, high = mold_block(array, shape)
    deep = plate_thickness(array) * shape.scale + shape.headroom
    flare = deep * math.tan(shape.draft)
    areas = [math.prod(side * shape.scale + wider for side in array.size) for wider in (0.0, flare, 2 * flare)]
    enclosed = deep * (areas[0] + 4 * areas[1] + areas[2]) / 6
    above = m3.Manifold.cube([*(high - low)[:2], 1e3]).translate([*low[:2], high[2]])
    engraved = sum((tool - above).volume() for tool in engravings(array, shape))
    return math.prod(high - low) - shape.scale**3 * caps_volume(array) - enclosed - engraved


def volume_tolerance(array: MicrolensArray, chord: float) -> float:
    """How far a volume may be from the analytic one, as a fraction: coarse facets cannot do as well as fine ones.

    Facets are right on average but for their rims: a quarter of the chord error over the plate is more than they miss.
    Walls are as far off as their circles' chords, and less.
    """
    caps, land = caps_of(array), cap_sag(array)
    walls = sum(2 * math.pi * cap.reach * (land - cap.rim) for cap in caps)
    return max(VOLUME_TOLERANCE, chord * (math.prod(array.size) / 4 + walls) / array_volume(array))
