"""The microlens array and its negative mold as solids, and their analytic volumes.

Both use the frame of the part: the plano face is z = 0 and the vertices are at z = -t, with t the thickness of the
plate that the optics uses. Between lenses the part is thinner by the largest rim sag. If the plano side faces the
object, x and y are the sensor's and z points toward the object. If the curved side does, the part is rotated about x:
y is reversed and z points toward the sensor. The frame is right-handed.

The mold opens toward +z: pour, cover with a glass plate, cure, peel. Lengths in mm, angles in radians.
"""

import math
from dataclasses import dataclass

import manifold3d as m3
import numpy as np
from jaxtyping import Float
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath

from ..base.errors import InputError
from ..base.progress import Progress
from ..microscope.layouts import ROUNDING, cell_edges, half_size, in_mm, nearest_neighbour_distances
from .lenslets import DRAFT, Lenslet, Part, tessellate

ENGRAVING_DEPTH = 0.4
MIN_LENS_DISTANCE = 1e-3
# More facets take gigabytes of memory and of disk.
MAX_FACETS = 5_000_000
# Relative; facets within 0.5 um of the lenses reach 1e-5.
VOLUME_TOLERANCE = 1e-4
# Cutting tools extend this far beyond the solid, so that no two faces coincide.
_OVERCUT = 1.0
# Lower walls are omitted: ten times the resolution of float32 on a 20 mm plate.
_MIN_WALL_HEIGHT = 1e-5
# Samples per side of the plate in the volume of unequal lenses.
_VOLUME_SAMPLES = 1400
# Facets of a solid that is only drawn.
_PREVIEW_FACETS = 20_000


@dataclass(frozen=True)
class MoldShape:
    """The body of a mold around its array.

    Parameters
    ----------
    wall, floor
        Thickness of the walls, and of the floor below the lenses, mm.
    headroom
        Height of the walls above the plano face of the array, mm; 0 to cast flush with the rim.
    draft
        Angle of the walls' inner faces from the vertical, radians. The sides of the cast have it too.
    shrinkage
        Fraction by which the cast material shrinks; the cavity is larger by `1 / (1 - shrinkage)`.
    marks
        Alignment crosses in three corners of the rim. The corner without one, (+x, +y), shows the orientation.
    label
        Text engraved in the rim; characters that are not printable ASCII are left out.

    Raises
    ------
    ValueError
        If a length, the angle or the shrinkage is out of range.
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
        for name, limit in {"headroom": math.inf, "draft": math.pi / 4, "shrinkage": 0.5}.items():
            if not 0 <= getattr(self, name) < limit:
                raise ValueError(f"`{name}` must be at least 0 and below {limit:.4g}, got {getattr(self, name)}.")

    @property
    def scale(self) -> float:
        """Size of the cavity relative to the cast after shrinking."""
        return 1 / (1 - self.shrinkage)


def array_solid(part: Part, chord: float = 5e-4, *, progress: Progress | None = None) -> m3.Manifold:
    """The array as a solid: the union of a plate with straight sides and one body per lens.

    `chord` is the chordal tolerance, the largest distance between a facet and the lens surface, mm.

    Raises `InputError` if a lens lies outside the plate, or the plate is infinite; `ValueError` if lenses coincide,
    rims are too steep, the plate is too thin, or `chord` is not positive, too coarse, or so fine that it takes more
    than `MAX_FACETS`.
    """
    check_part(part)
    if not 0 < chord <= part.max_chord:
        raise ValueError(f"`chord` must be positive and at most {part.max_chord:.4g} mm, got {chord}.")
    if (count := part.facet_count(chord)) > MAX_FACETS:
        raise ValueError(f"`chord` of {chord} mm takes about {count:.2g} facets, more than {MAX_FACETS:.2g}.")
    bottom, (x, y) = -part.plate_thickness, part.size
    pairs = list(zip(part.lenslets, part.visible_radii, strict=True))
    bodies, alike = [], {}
    for lenslet, radius in (progress or Progress()).track(pairs, "Tessellating"):
        shape = lenslet.semi_aperture, lenslet.radius, lenslet.conic, lenslet.terms
        if (*shape, radius) not in alike:
            alike[*shape, radius] = _lenslet_body(lenslet, radius, chord, part.height, -bottom / 2)
        bodies.append(alike[*shape, radius].translate([*lenslet.center.tolist(), 0.0]))
    plate, column = (_box([-x / 2, -y / 2, bottom], [x / 2, y / 2, top]) for top in (0, part.height + _OVERCUT))
    lenses = m3.Manifold.batch_boolean(bodies, m3.OpType.Add) ^ column
    # Built with lenses up; mirroring also reverses the facets of a solid.
    return require_valid((lenses + plate).mirror([0, 0, 1]).translate([0, 0, bottom]))


def preview_solid(part: Part, shape: MoldShape | None) -> m3.Manifold:
    """The mold, or the array if `shape` is None, with few facets, to draw it."""
    # Equilateral facets of a sphere are `side^2 / (6 R)` deep.
    smallest = min(lenslet.radius for lenslet in part.lenslets)
    chord = math.prod(part.size) / (_PREVIEW_FACETS * 1.5 * math.sqrt(3) * smallest)
    solid = array_solid(part, min(chord, part.max_chord))
    return solid if shape is None else mold_solid(part, solid, shape)


def _box(low, high) -> m3.Manifold:
    return m3.Manifold.cube(np.subtract(high, low).tolist()).translate([*low])


def _lenslet_body(lenslet: Lenslet, radius, chord, top, depth) -> m3.Manifold:
    """A lenslet about its axis, up to a radius, on a wall that reaches `depth` below the base."""
    points, sag, facets, count = tessellate(lenslet, radius, chord)
    height = top - sag
    if height[:count].max() < _MIN_WALL_HEIGHT:
        height[:count] = 0
    foot = points[:count] * (1 + (height[0] + depth) * math.tan(DRAFT) / math.hypot(*points[0]))
    vertices = np.concatenate([np.column_stack([points, height]), np.column_stack([foot, np.full(count, -depth)])])
    upper = np.arange(count)
    lower, next_upper = len(points) + upper, np.roll(upper, -1)
    next_lower = len(points) + next_upper
    wall = [np.stack([upper, lower, next_lower], axis=1), np.stack([upper, next_lower, next_upper], axis=1)]
    floor = np.stack([np.full(count - 2, lower[0]), lower[2:], lower[1:-1]], axis=1)
    mesh = m3.Mesh64(vertices, np.concatenate([facets, *wall, floor]).astype(np.uint64))
    return require_valid(m3.Manifold(mesh))


def check_part(part: Part) -> None:
    """Raises `ValueError` for an array that has no solid, and `InputError` for lenses outside the plate."""
    half = half_size(part.size)
    if not np.isfinite(part.centers).all():
        raise ValueError("`centers` must be finite.")
    if outside := int((np.abs(part.centers) > half * (1 + ROUNDING)).any(axis=1).sum()):
        raise InputError(f"`centers` must be points on a plate of {in_mm(half)}, got {outside} outside.")
    if fault := aperture_fault(part):
        raise ValueError(f"`aperture_diameter` {fault}.")
    if not part.plate_thickness > 0:
        allowed = f"more than the lenses' sag, {part.height:.4g} mm"
        raise ValueError(f"`substrate_thickness` must be {allowed}, got {part.thickness:g} mm.")
    # Arrays in float32 may be slightly closer than the limit.
    if (closest := nearest_neighbour_distances(part.centers).min()) < 0.99 * MIN_LENS_DISTANCE:
        raise ValueError(f"`centers` must be {MIN_LENS_DISTANCE} mm apart or more, got {closest:.3g} mm.")


def aperture_fault(part: Part) -> str:
    """Says which aperture is too wide to be manufactured; empty if none is."""
    for number, lenslet in enumerate(part.lenslets, 1):
        if not 0 < lenslet.semi_aperture or lenslet.max_semi_aperture < lenslet.semi_aperture:
            which = f" for lens {number}" if len({other.semi_aperture for other in part.lenslets}) > 1 else ""
            limit = f"{2 * lenslet.max_semi_aperture:.4g} mm{which}, got {2 * lenslet.semi_aperture:g}"
            return f"must be positive and at most {limit}"
    return ""


def require_valid(solid: m3.Manifold) -> m3.Manifold:
    """Return a solid; `RuntimeError` if it encloses nothing."""
    if solid.status() != m3.Error.NoError or solid.is_empty():
        raise RuntimeError(f"the surface encloses no solid: {solid.status().name}")
    return solid


def cast_solid(part: Part, solid: m3.Manifold, shape: MoldShape) -> m3.Manifold:
    """What fills the mold of `solid` up to its rim, before it shrinks."""
    cavity = solid.scale([shape.scale] * 3)
    return cavity if shape.draft == shape.headroom == 0 else cavity + _opening(part, shape, shape.headroom)


def _opening(part: Part, shape: MoldShape, top: float) -> m3.Manifold:
    """The space between the walls, from the base up to a height."""
    half, bottom = np.array(part.size) / 2 * shape.scale, -part.plate_thickness * shape.scale
    flare = (top - bottom) * math.tan(shape.draft)
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    rings = [np.column_stack([signs * (half + wider), np.full(4, z)]) for wider, z in ((0, bottom), (flare, top))]
    return m3.Manifold.hull_points(np.concatenate(rings))


def mold_bounds(part: Part, shape: MoldShape) -> Float[np.ndarray, "2 3"]:
    """Lowest and highest corner of the mold, mm."""
    flare = (part.plate_thickness * shape.scale + shape.headroom) * math.tan(shape.draft)
    x, y = np.array(part.size) / 2 * shape.scale + flare + shape.wall
    return np.array([[-x, -y, -part.thickness * shape.scale - shape.floor], [x, y, shape.headroom]])


def mold_solid(part: Part, solid: m3.Manifold, shape: MoldShape = MoldShape()) -> m3.Manifold:
    """The negative mold: a block less the cavity of `solid`, which is `array_solid(part)`, marks and label."""
    opening = _opening(part, shape, shape.headroom + _OVERCUT)
    tools = [solid.scale([shape.scale] * 3), opening, *engraving_tools(part, shape)]
    return require_valid(m3.Manifold.batch_boolean([_box(*mold_bounds(part, shape)), *tools], m3.OpType.Subtract))


def engraving_tools(part: Part, shape: MoldShape) -> list[m3.Manifold]:
    """Tools that cut the marks and the label into the rim."""
    low, high = mold_bounds(part, shape)
    middle = high[:2] - shape.wall / 2
    plans = alignment_marks(part, shape) if shape.marks else []
    text = _label_outline(shape.label, height=0.4 * shape.wall, width=2 * (middle[0] - shape.wall))
    if not text.is_empty():
        plans.append(text.translate([0.0, -middle[1]]))
    depth = min(ENGRAVING_DEPTH, (high[2] - low[2]) / 4)
    return [plan.extrude(depth + _OVERCUT).translate([0, 0, high[2] - depth]) for plan in plans]


def alignment_marks(part: Part, shape: MoldShape) -> list[m3.CrossSection]:
    """The crosses in the rim of the mold, in (x, y)."""
    x, y = mold_bounds(part, shape)[1, :2] - shape.wall / 2
    bar = m3.CrossSection.square([0.6 * shape.wall, 0.1 * shape.wall], center=True)
    return [(bar + bar.rotate(90)).translate(at) for at in ([-x, -y], [x, -y], [-x, y])]


def _label_outline(label: str, *, height: float, width: float) -> m3.CrossSection:
    drawable = "".join(c for c in label if " " <= c <= "~")
    if not drawable.strip() or width <= 0:
        return m3.CrossSection()
    path = TextPath((0, 0), drawable.replace("$", r"\$"), size=10, prop=FontProperties(family="DejaVu Sans"))
    text = m3.CrossSection([np.array(ring, float)[:-1] for ring in path.to_polygons()], m3.FillRule.NonZero)
    x0, y0, x1, y1 = text.bounds()
    size = min(height / 10, width / (x1 - x0))
    return text.translate([-(x0 + x1) / 2, -(y0 + y1) / 2]).scale([size, size])


def lenslets_volume(part: Part) -> float:
    """Volume of the lenses above the base, mm^3, by quadrature.

    Raises `InputError` if a lens lies outside the plate, or the plate is infinite.
    """
    if part.array.alike:
        return _equal_lenslets_volume(part)
    # Gauss's rule of two nodes in each cell of a grid; errors where a lens or wall ends in a cell nearly cancel, 1e-7.
    count, offset = _VOLUME_SAMPLES // 2, np.array([-1, 1]) / (2 * math.sqrt(3))
    nodes = (np.arange(count)[:, None] + 0.5 + offset).ravel() / count - 0.5
    x, y = (nodes * side for side in part.size)
    return float(part.surface(x, y)[0].mean() * math.prod(part.size))


def _equal_lenslets_volume(part: Part) -> float:
    """Sum over the sectors of Voronoi cells, the borders of equal lenslets.

    In the direction `phi` a lenslet ends at `r = min(D/2, d / cos(phi))`, with `d` the distance of the cell's edge, and
    contributes `int h r dr`, a constant at the rim. At the edge of the cell the substitution `r = d cosh(u)`,
    `dphi = du / cosh(u)` keeps the integrand smooth where the edge passes close to the vertex.
    """
    x, weights = np.polynomial.legendre.leggauss(64)
    lenslet, edges = part.lenslets[0], cell_edges(part.centers, part.size)
    radius = lenslet.semi_aperture

    def radial_integral(r2):
        return r2 / 4 * ((lenslet.rim_sag - lenslet.sag(r2[..., None] * (1 + x) / 2)) @ weights)

    # An edge through the vertex spans no sector.
    off, *ends = (values[edges.height > 1e-12] for values in (edges.height, edges.low, edges.high))
    half = np.sqrt(np.maximum(radius**2 - off**2, 0))
    inside = [np.clip(t, -half, half) for t in ends]
    rim_angle = (
        np.arctan2(ends[1], off) - np.arctan2(ends[0], off) - np.arctan2(inside[1], off) + np.arctan2(inside[0], off)
    )
    low, high = (np.arcsinh(t / off)[:, None] for t in inside)
    cosh = np.cosh((high + low) / 2 + (high - low) / 2 * x)
    at_rim = radial_integral(np.array(radius**2)) * rim_angle
    integrand = radial_integral(np.minimum(off[:, None] * cosh, radius) ** 2) / cosh
    return float((at_rim + (high - low)[:, 0] / 2 * (integrand @ weights)).sum())


def array_volume(part: Part) -> float:
    """Volume of the array: plate and lenses, mm^3."""
    return math.prod(part.size) * part.plate_thickness + lenslets_volume(part)


def mold_volume(part: Part, shape: MoldShape) -> float:
    """Volume of the mold: the block less lenses, opening, marks and label, mm^3."""
    block = math.prod(np.diff(mold_bounds(part, shape), axis=0)[0])
    tools = engraving_tools(part, shape)
    engraved = sum(tool.trim_by_plane([0, 0, -1], -shape.headroom).volume() for tool in tools)
    # In closed form, not by the solid that is subtracted: a prismatoid, which widens by the draft.
    depth = part.plate_thickness * shape.scale + shape.headroom
    flare = depth * math.tan(shape.draft)
    areas = [math.prod(side * shape.scale + wider for side in part.size) for wider in (0.0, flare, 2 * flare)]
    opening = depth * (areas[0] + 4 * areas[1] + areas[2]) / 6
    return block - shape.scale**3 * lenslets_volume(part) - opening - engraved


def volume_tolerance(part: Part, chord: float) -> float:
    """Relative tolerance of a volume: at least `VOLUME_TOLERANCE`, more for coarse facets.

    Facets are unbiased except at rims, where a quarter of the chordal tolerance bounds them; walls are within it.
    """
    walls = sum(2 * math.pi * lenslet.semi_aperture * (part.height - lenslet.rim_sag) for lenslet in part.lenslets)
    return max(VOLUME_TOLERANCE, chord * (math.prod(part.size) / 4 + walls) / array_volume(part))
