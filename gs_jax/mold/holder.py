"""The rig of a design: a holder that keeps the array at its distance from the sensor, and a target to calibrate by.

The plano face of the array lies on a ledge of the holder; a drop of silicone at the plate's edge keeps it. The holder's
shoulder stands on the camera's face, with shims between them: it is printed for a few, so that more or fewer correct
the print. The target is a cap over the holder's collar, whose flat shows how it is turned, with pinholes in its end.

The frame of all parts has x and y of the sensor, z toward the object, and z = 0 on the shoulder. Lengths in mm.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import manifold3d as m3
import numpy as np
from jaxtyping import Float

from ..base.errors import InputError
from ..design.conversion import AIR
from ..design.design import Design
from ..microscope.geometry import Imager
from ..microscope.layouts import half_size, in_mm
from .manufacturability import MIN_THICKNESS_MM, CheckResult
from .solids import require_valid

# Flange focal distance of C-mount cameras. Their thread: 1 inch, 32 turns an inch (UN 2B), whose crests leave `BORE`.
C_MOUNT, BORE = 17.526, 24.5
_MAJOR, _PITCH, _THREAD = 25.4, 25.4 / 32, 4.0
# Half the depth of the thread. A circle whose middle turns about the axis is one of rounded flanks, which are nowhere
# steeper than those of 60 degrees: less than 0.22.
_ECCENTRICITY, _SLICES = 0.2, 16
# Steel shims and foils that are sold everywhere, and the least stack that a holder is printed for.
SHIMS, LEAST_SHIMS = (0.5, 0.2, 0.1, 0.05, 0.025), 0.1
# Thickness of ledge and flange, height of the collar, and of the edge that guards the lenses.
LEDGE, _FLANGE, _COLLAR, _GUARD = 1.0, 2.0, 2.0, 0.5
# Width of the ledge, at most this part of the plate.
_LEDGE_WIDTH, _LEDGE_PART = 0.5, 0.05
# Least distance of the holder from the window, or from the sensor without one.
_FROM_WINDOW = 0.2
# Heights are multiples of this, which usual layers of printers divide.
_LAYER = 0.05
# Holes and heads of M3 screws; depth of the collar's flat, in walls.
_HOLE, _HEAD, _FLAT = 3.4, 5.5, 0.4
# The target's end, the wall about a pinhole, both at least, and the slope of the cone behind it, 30 degrees.
_END, _MEMBRANE, _CONE = 1.5, 0.1, math.tan(math.radians(30))
# Widest image of a pinhole whose middle `calibrate` finds as that of a sharp spot, pixels.
_WIDEST = 6
# Indices of layers that are gaps.
AIR_NAMES = (1, "air")
# Segments of circles and of pinholes.
_SEGMENTS, _PINHOLE_SEGMENTS = 128, 32


@dataclass(frozen=True)
class HolderShape:
    """The camera that a holder is for, and what is printed, mm.

    Parameters
    ----------
    flange
        Distance from the sensor to the camera's face on which the holder stands.
    bore
        Diameter of the opening in that face, if it is no C-mount thread.
    bolts
        Diameter of the circle of four M3 screws at 45 degrees about the opening; None without any.
    wall, clearance
        Thickness of walls, and gap between parts that fit into each other.
    pinhole
        Diameter of the target's pinholes.
    target
        Depth of the target from the array's front; None: the middle of the working distance.
    """

    flange: float = C_MOUNT
    bore: float | None = None
    bolts: float | None = None
    wall: float = 2.0
    clearance: float = 0.1
    pinhole: float = 0.1
    target: float | None = None


class Rig(NamedTuple):
    """Holder and target: solids and their volumes in closed form, places of pinholes `(x, y, z)` as `calibrate` reads
    them, numbers for a report, and what was checked."""

    holder: m3.Manifold
    target: m3.Manifold
    holder_volume: float
    target_volume: float
    places: Float[np.ndarray, "pinhole 3"]
    numbers: dict[str, Any]
    checks: list[CheckResult]


def shims_of(thickness: float) -> list[float]:
    """Standard shims that make up a thickness to half of the thinnest, thickest first, mm."""
    shims, left = [], round(thickness / SHIMS[-1]) * SHIMS[-1]
    for shim in SHIMS:
        while left > shim - 1e-9:
            shims.append(shim)
            left -= shim
    return shims


@dataclass(frozen=True)
class Holder:
    """Heights and radii of a holder, mm: from the shoulder, toward the object.

    Raises `InputError` if the array, the camera and the walls do not go together.
    """

    design: Design
    shape: HolderShape

    def __post_init__(self):
        for fault in self._faults():
            raise InputError(fault)

    @cached_property
    def imager(self) -> Imager:
        return self.design.imager(AIR)

    @cached_property
    def side(self) -> int:
        """The side of the ledge: 1 if it is on the object's side of the array, else -1."""
        return 1 if self.design.lens.orientation == "plano" else -1

    @cached_property
    def thickness(self) -> float:
        return float(self.design.array.substrate_thickness_mm)

    @cached_property
    def step(self) -> float:
        """Height of the plano face above the camera's face, as designed."""
        design = self.design.imaging.sensor_distance_mm + (self.thickness if self.side > 0 else 0.0)
        return design - self.shape.flange

    @cached_property
    def seat(self) -> float:
        """Height of the ledge, a whole number of layers below `step`."""
        return math.floor((self.step - LEAST_SHIMS) / _LAYER + 1e-6) * _LAYER

    @property
    def shims(self) -> float:
        return self.step - self.seat

    @property
    def sensor(self) -> float:
        """Height of the sensor, with the shims in place."""
        return -self.shims - self.shape.flange

    @property
    def front(self) -> float:
        """Height of the array's front, from which depths count."""
        return self.seat + (0.0 if self.side > 0 else self.thickness)

    @cached_property
    def plate(self) -> Float[np.ndarray, "2"]:
        """Half the sides of the plate."""
        return half_size(self.design.array.size_mm)

    @cached_property
    def pocket(self) -> Float[np.ndarray, "2"]:
        return self.plate + self.shape.clearance

    @cached_property
    def window(self) -> Float[np.ndarray, "2"]:
        """Half the sides of the opening in the ledge."""
        return self.plate - min(_LEDGE_WIDTH, _LEDGE_PART * 2 * float(self.plate.min()))

    @cached_property
    def levels(self) -> tuple[float, float]:
        """Lower and upper end of ledge and pocket."""
        ends = self.seat + self.side * LEDGE, self.seat - self.side * (self.thickness + _GUARD)
        return min(ends), max(ends)

    @cached_property
    def bottom(self) -> float:
        return min(self.levels[0], -_THREAD if self.shape.bore is None else 0.0)

    @cached_property
    def top(self) -> float:
        return max(self.levels[1], _FLANGE + _COLLAR)

    @property
    def barrel(self) -> float:
        """Radius of what is in the camera's opening."""
        return (self.shape.bore or BORE) / 2 - self.shape.clearance

    @cached_property
    def well(self) -> float:
        """Radius of the round hole on both sides of ledge and pocket: the array passes it."""
        needed = math.hypot(*self.pocket)
        return max(needed, self.barrel - self.shape.wall) if self.bottom < 0 else needed

    @property
    def collar(self) -> float:
        return self.well + self.shape.wall

    @property
    def rim(self) -> float:
        """Radius of the flange."""
        shape = self.shape
        inner = max(self.collar + shape.clearance, self._mouth) + shape.wall
        return max(inner, shape.bolts / 2 + _HEAD / 2 + 1.0) if shape.bolts else inner

    def _faults(self):
        shape, design, near = self.shape, self.design, self.design.imaging.working_distance_mm[0]
        if min(self.window) <= 0 or not np.isfinite(self.plate).all():
            yield f"`array.size_mm` must be positive and finite, got {in_mm(self.plate)}."
        if self.bottom < 0 and self.well > (most := self.barrel - shape.wall):
            text = (
                f"`array.size_mm` must be at most {2 * most:.4g} mm across its corners, with walls of {shape.wall:g} mm"
            )
            remedy = "for a wider one give --bore-mm and --bolts-mm of another camera"
            yield f"{text} in the camera's opening, got {2 * self.well:.4g} mm; {remedy}."
        if shape.bore is None and shape.clearance >= (most := 2 * _ECCENTRICITY):
            got = f"got {shape.clearance:g}"
            yield f"--clearance-mm must be below {most:g}, the depth of the C-mount thread, without --bore-mm, {got}."
        if shape.bolts is not None and shape.bolts < (least := 2 * max(self.cap, self._mouth) + _HEAD):
            yield f"--bolts-mm must be {least:.4g} or more, beside the target and the opening, got {shape.bolts:g}."
        edge = sum(layer.thickness_mm for layer in design.layers.sensor)
        if (left := self.bottom - self.sensor - edge) < _FROM_WINDOW:
            what = "the camera's window" if design.layers.sensor else "the sensor"
            short, v = f"{_FROM_WINDOW - left:.3g} mm more for the holder", design.imaging.sensor_distance_mm
            yield f"`imaging.sensor_distance_mm` must leave {short}, which ends {left:.3g} mm from {what}, got {v:g}."
        air = 0.0
        for layer in design.layers.object if self.side > 0 else ():
            if air < LEDGE and layer.refractive_index not in AIR_NAMES:
                text = f"`layers.object` must begin with {LEDGE:g} mm of air or more, for the holder's ledge"
                yield f"{text}, got {layer.name or 'a layer'} at {air:g} mm."
            air += layer.thickness_mm
        if (reach := self.top - self.front) >= near:
            remedy = "a camera whose face is nearer to its sensor has room (--flange-mm)"
            yield f"`imaging.working_distance_mm` must begin beyond the holder, {reach:.4g} mm, got {near:g}; {remedy}."
        if self.depth - (begin := float(self.imager.sample_surface)) < MIN_THICKNESS_MM or self.depth < reach - 1e-6:
            # The target is at whole layers from the flange.
            above = math.ceil((self.top - _FLANGE) / _LAYER - 1e-6) * _LAYER + _FLANGE - self.front
            least = max(begin + MIN_THICKNESS_MM, above)
            yield f"--target-mm must be {least:.4g} or more, beyond the holder and the filters, got {self.depth:g}."
        if shape.pinhole > (most := min(self.spread / 2, 1.0)):
            got = f"got {1000 * shape.pinhole:g} for pinholes {self.spread:g} mm apart"
            yield f"--pinhole-um must be at most {1000 * most:.4g}, {got}."

    @property
    def _mouth(self) -> float:
        return (self.shape.bore or _MAJOR) / 2

    # The target.

    @cached_property
    def depth(self) -> float:
        """Depth of the pinholes from the array's front, at whole layers from the flange."""
        near, far = self.design.imaging.working_distance_mm
        wanted = (near + far) / 2 if self.shape.target is None else self.shape.target
        height = round((self.front + wanted - _FLANGE) / _LAYER) * _LAYER
        return round(height + _FLANGE - self.front, 6)

    @property
    def reach(self) -> float:
        """Length of the target's tube, from the flange to the pinholes."""
        return self.front + self.depth - _FLANGE

    @property
    def cap(self) -> float:
        """Outer radius of the target."""
        return self.collar + self.shape.clearance + self.shape.wall

    @property
    def membrane(self) -> float:
        return max(_MEMBRANE, self.shape.pinhole)

    @property
    def cone(self) -> float:
        """By how much the radius of the cone behind a pinhole grows; cones do not touch."""
        return min((_END - self.membrane) * _CONE, 0.45 * (self.spread - self.shape.pinhole))

    @property
    def spread(self) -> float:
        """Distance of the outer pinholes from the axis: where lenses around see them on the sensor."""
        design = self.design
        rows, columns = design.sensor.shape
        sensor = min(rows, columns) * design.sensor.pixel_pitch_um / 2000
        return round(min(float(self.plate.min()) / 2, sensor / 2, design.imaging.field_radius_mm, self.collar / 2), 1)


def make_rig(design: Design, shape: HolderShape = HolderShape()) -> Rig:
    """Holder and target of a design, with what is worth knowing about them.

    *Host.*

    Raises `InputError` if the array, the camera and the walls do not go together, before anything is built.
    """
    rig = Holder(design, shape)
    holder, holder_volume = _holder(rig)
    places = np.array([(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)]) * rig.spread
    target, target_volume = _target(rig, places)
    at = np.column_stack([places, np.full(len(places), rig.depth)])
    return Rig(holder, target, holder_volume, target_volume, at, _numbers(rig), _checks(rig))


def _holder(rig: Holder) -> tuple[m3.Manifold, float]:
    shape, (lower, upper) = rig.shape, rig.levels
    pocket = m3.CrossSection.square((2 * rig.pocket).tolist(), center=True)
    body = [(_disc(rig.rim), 0.0, _FLANGE), (_flattened(rig, 0.0), _FLANGE, rig.top)]
    begin = -_THREAD if shape.bore is None else 0.0
    if rig.bottom < begin:
        body.append((_disc(rig.barrel), rig.bottom, begin))
    cuts = [(pocket, *sorted((rig.seat, rig.seat - rig.side * (rig.thickness + _GUARD))))]
    cuts += [(_disc(rig.well), *ends) for ends in ((rig.bottom, lower), (upper, rig.top)) if ends[1] - ends[0] > 1e-6]
    if shape.bolts:
        hole = _disc(_HOLE / 2)
        at = shape.bolts / math.sqrt(8)
        cuts += [(hole.translate((x, y)), 0.0, _FLANGE) for x in (-at, at) for y in (-at, at)]
    volume = sum(plan.area() * (high - low) for plan, low, high in body)
    volume -= sum(plan.area() * (high - low) for plan, low, high in cuts)
    solids = [_extruded(*piece) for piece in body]
    if shape.bore is None:
        thread, its_volume = _thread(_MAJOR / 2 - shape.clearance)
        solids.append(thread)
        volume += its_volume
    # The ledge opens from the plate outward.
    wider = rig.pocket / rig.window
    ledge = m3.CrossSection.square((2 * rig.window).tolist(), center=True).extrude(LEDGE, scale_top=tuple(wider))
    ledge = (ledge if rig.side > 0 else ledge.mirror([0, 0, 1])).translate([0, 0, rig.seat])
    areas = [4 * float(np.prod(rig.window * (1 + part * (wider - 1)))) for part in (0.0, 0.5, 1.0)]
    volume -= LEDGE * (areas[0] + 4 * areas[1] + areas[2]) / 6
    tools = [ledge, *(_extruded(*cut) for cut in cuts)]
    solid = m3.Manifold.batch_boolean(solids, m3.OpType.Add)
    return require_valid(m3.Manifold.batch_boolean([solid, *tools], m3.OpType.Subtract)), volume


def _target(rig: Holder, places: np.ndarray) -> tuple[m3.Manifold, float]:
    end, radius = _FLANGE + rig.reach, rig.shape.pinhole / 2
    cap, hollow = _disc(rig.cap), _flattened(rig, rig.shape.clearance)
    hole = m3.Manifold.cylinder(rig.membrane, radius, radius, _PINHOLE_SEGMENTS)
    cone = m3.Manifold.cylinder(_END - rig.membrane, radius, radius + rig.cone, _PINHOLE_SEGMENTS)
    tool = (hole + cone.translate([0, 0, rig.membrane])).translate([0, 0, end])
    tools = [tool.translate([x, y, 0]) for x, y in places.tolist()]
    body = _extruded(cap, _FLANGE, end + _END) - _extruded(hollow, _FLANGE, end)
    solid = m3.Manifold.batch_boolean([body, *tools], m3.OpType.Subtract)
    wide = radius + rig.cone
    cone_volume = (_END - rig.membrane) * (radius**2 + radius * wide + wide**2) / 3
    each = _polygon_area(_PINHOLE_SEGMENTS) * (rig.membrane * radius**2 + cone_volume)
    volume = cap.area() * (rig.reach + _END) - hollow.area() * rig.reach - len(places) * each
    return require_valid(solid), volume


def _disc(radius: float) -> m3.CrossSection:
    return m3.CrossSection.circle(radius, _SEGMENTS)


def _polygon_area(segments: int) -> float:
    """Area of a regular polygon in the unit circle."""
    return segments / 2 * math.sin(2 * math.pi / segments)


def _flattened(rig: Holder, wider: float) -> m3.CrossSection:
    """The collar's outline with its flat toward +x, or that of the target, which is wider."""
    radius = rig.collar + wider
    flat = radius - _FLAT * rig.shape.wall
    return _disc(radius) - m3.CrossSection.square([radius, 2 * radius]).translate((flat, -radius))


def _extruded(plan: m3.CrossSection, low: float, high: float) -> m3.Manifold:
    return plan.extrude(high - low).translate([0, 0, low])


def _thread(largest: float) -> tuple[m3.Manifold, float]:
    """A right-handed C-mount thread of this largest radius below the shoulder, and its volume.

    It is a stack of slices of one shape: a circle whose middle goes round the axis once a pitch.
    """
    count = round(_SLICES * _THREAD / _PITCH)
    heights = np.linspace(-_THREAD, 0, count + 1)
    turn, around = 2 * math.pi * heights / _PITCH, 2 * math.pi * np.arange(_SEGMENTS) / _SEGMENTS
    radius = largest - _ECCENTRICITY
    circle, middles = (np.stack([np.cos(angle), np.sin(angle)], -1) for angle in (around, turn))
    rings = radius * circle + _ECCENTRICITY * middles[:, None]
    levels = np.broadcast_to(heights[:, None, None], (*rings.shape[:2], 1))
    vertices = np.concatenate([rings, levels], -1).reshape(-1, 3)
    lower = _SEGMENTS * np.arange(count)[:, None] + np.arange(_SEGMENTS)
    following = np.roll(lower, -1, axis=1)
    upper, above = lower + _SEGMENTS, following + _SEGMENTS
    walls = [np.stack(corners, -1).reshape(-1, 3) for corners in ((lower, following, above), (lower, above, upper))]
    fan = np.arange(1, _SEGMENTS - 1)
    bottom = np.stack([np.zeros_like(fan), fan + 1, fan], -1)
    top = count * _SEGMENTS + np.stack([np.zeros_like(fan), fan, fan + 1], -1)
    mesh = m3.Mesh64(vertices, np.concatenate([*walls, bottom, top]).astype(np.uint64))
    return require_valid(m3.Manifold(mesh)), _THREAD * _polygon_area(_SEGMENTS) * radius**2


def _numbers(rig: Holder) -> dict[str, Any]:
    shims = shims_of(rig.shims)
    return {
        "sensor_distance_mm": rig.design.imaging.sensor_distance_mm,
        "flange_mm": rig.shape.flange,
        "step_mm": rig.step,
        "printed_step_mm": rig.seat,
        "shims_mm": shims,
        "shims_rest_um": 1000 * (rig.shims - sum(shims)),
        "target_depth_mm": rig.depth,
        "target_tube_mm": rig.reach,
        "pinhole_um": 1000 * rig.shape.pinhole,
        "opening_mm": (2 * rig.window).tolist(),
    }


def _checks(rig: Holder) -> list[CheckResult]:
    shims, pixel = shims_of(rig.shims), rig.imager.sensor.pixel_pitch
    # Longitudinal magnification: what a change of the sensor distance moves in the object.
    magnification = float(rig.imager.magnification(rig.depth))
    stack, rest = " + ".join(f"{1000 * shim:g}" for shim in shims), 1000 * (rig.shims - sum(shims))
    if rig.seat > 0:
        where, needed = "above", f"{rig.step:.3f} mm less the measured height"
    else:
        where, needed = "below", f"the measured depth less {-rig.step:.3f} mm"
    text = (
        f"{stack} um (rest {rest:+.1f} um) under the shoulder; its ledge is printed {abs(rig.seat):.4g} mm {where} that"
    )
    moved = f"25 um move the depth in focus by {0.025 / magnification**2:.2g} mm"
    checks = [CheckResult("shims", "ok", f"{text}. Measure it: shims are {needed}; {moved}.")]
    seen, lenses = int(_whole_views(rig).sum()), len(rig.design.array.centers_mm)
    text = f"{seen} of {lenses} lenses see all of their field through the holder"
    checks.append(CheckResult("view", "ok" if seen == lenses else "warning", f"{text}."))
    width = magnification * rig.shape.pinhole / pixel
    text = f"{1000 * rig.shape.pinhole:g} um at {rig.depth:g} mm are {width:.2g} pixels on the sensor"
    advice = (
        f"calibrate finds spots up to {_WIDEST}: give it --binning {math.ceil(width / _WIDEST)}, or drill finer ones"
    )
    wide = width > _WIDEST
    checks.append(CheckResult("pinholes", "warning" if wide else "ok", f"{text}{f'; {advice}' if wide else ''}."))
    return checks


def _whole_views(rig: Holder) -> np.ndarray:
    """Whether the chief rays of each lens pass the holder from all of its field at the nearest depth."""
    centers, imaging = np.array(rig.design.array.centers_mm), rig.design.imaging
    slope = imaging.field_radius_mm / imaging.working_distance_mm[0]
    seen = np.hypot(*centers.T) + slope * (rig.top - rig.front) <= rig.well
    if rig.side > 0:
        for half, distance in ((rig.window, 0.0), (rig.pocket, LEDGE)):
            seen &= (np.abs(centers) + slope * distance <= half).all(1)
    return seen
