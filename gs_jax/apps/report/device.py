"""The microscope as drawings: cut open, to scale; and its layout with how many lenses see each point. SVG."""

from html import escape
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ...design.design import Design
from ...geometry import Imager
from ...layouts.cells import cell_edges
from ...mold.caps import cap_sag, caps_of, surface
from ...pictures.style import round_length

# Points across a section; of a map of lenses per point, in all of the layout's outlines; points of a map at a time.
_PROFILE, _MAP, _OUTLINE, _TOGETHER = 801, 121, 12_000, 2000
# Pixels of a screen across a section, and its letters.
_SCREEN, _LETTERS = 900, 15
# How far beside the cut a lens may be whose chief ray is drawn, in pitches.
_BESIDE = 0.6


def section(design: Design) -> str:
    """The device cut open along its axis, through the lens nearest to it, objects at the left, to scale.

    Chief rays are those of a point on the axis in the middle of the working distance, through lenses near the cut.
    """
    imager, plano = design.imager(), design.lens.orientation == "plano"
    (near, far), v = design.imaging.working_distance_mm, design.imaging.sensor_distance_mm
    width, thickness = design.array.size_mm[0], design.array.substrate_thickness_mm
    sensor = design.sensor.shape[1] * design.sensor.pixel_pitch_um / 1000
    middle = (design.sensor.origin_mm or (0.0, 0.0))[0]
    vertex, end = (thickness if plano else 0.0), thickness + v
    half = max(width / 2, abs(middle) + sensor / 2)
    margin = 0.05 * (far + end)
    letter = _LETTERS * (far + end + 2 * margin) / _SCREEN
    left, top, across = -far - margin, -half - 2.2 * letter, far + end + 2 * margin
    spans = [
        (-far, -near, f"objects at z = {near:g} to {far:g} mm"),
        (0.0, thickness, f"plate, {thickness:g} mm"),
        (thickness, end, f"sensor at v = {v:g} mm"),
    ]
    height = 2 * half + (3.6 + 2.2 * len(spans)) * letter
    said = f"{design.name} cut open, to scale: objects, {len(design.array.centers_mm)} lenses on a plate, sensor"
    lines = [
        f'<svg class="drawing" viewBox="{left:.5g} {top:.5g} {across:.5g} {height:.5g}" role="img" '
        f'aria-label="{escape(said)}" style="font-size:{letter:.4g}px">',
        f'<rect class="object" x="{-far:.5g}" y="{-half:.5g}" width="{far - near:.5g}" height="{2 * half:.5g}"/>',
        f'<path class="centre" d="M{left:.5g} 0H{left + across:.5g}"/>',
        *_chief_rays(imager, (near + far) / 2, vertex, end, 0.3 * letter),
        f'<polygon class="glass" points="{_glass(design, imager, plano, thickness, width)}"/>',
        f'<path class="sensor" d="M{end:.5g} {middle - sensor / 2:.5g}v{sensor:.5g}"/>',
        f'<text x="{-far:.5g}" y="{-half - 0.6 * letter:.5g}">objects</text>',
        f'<text x="{end:.5g}" y="{-half - 0.6 * letter:.5g}" text-anchor="middle">sensor</text>',
    ]
    for number, (start, stop, text) in enumerate(spans):
        lines.append(_dimension(start, stop, text, half + (1.4 + 2.2 * number) * letter, letter, left + across))
    bar = round_length(across / 8)
    at = half + (1.4 + 2.2 * 1) * letter
    lines.append(_dimension(-far, bar - far, f"{bar:g} mm", at, letter, left + across))
    return "".join(lines) + "</svg>"


def _glass(design: Design, imager: Imager, plano: bool, thickness: float, width: float) -> str:
    """Corners of the plate with the lenses' profile through the lens nearest to the middle, in the drawing."""
    x = np.linspace(-width / 2, width / 2, _PROFILE)
    fall = np.zeros_like(x)
    if design.lens.focal_length_mm is None:
        caps = caps_of(imager.array)
        y = min((cap.center for cap in caps), key=lambda center: float(np.hypot(*center)))[1]
        fall = cap_sag(imager.array) - surface(caps, np.column_stack([x, np.full_like(x, y)]))[0]
    curved = thickness - fall if plano else fall
    flat = 0.0 if plano else thickness
    return " ".join(
        [
            *(f"{z:.4f},{at:.4f}" for z, at in zip(curved, x, strict=True)),
            f"{flat:.4f},{width / 2:.4f} {flat:.4f},{-width / 2:.4f}",
        ]
    )


def _chief_rays(imager: Imager, depth: float, vertex: float, end: float, dot: float) -> list[str]:
    centers = np.asarray(imager.centers, float)
    landing = np.asarray(imager.project(np.array([[0.0, 0.0, depth]])), float)[:, 0]
    pitch = np.sqrt(np.prod(imager.array.size) / len(centers))
    near = (np.hypot(*centers.T) <= imager.field_radius) & (np.abs(centers[:, 1]) <= _BESIDE * pitch)
    rays = "".join(
        f"M{-depth:.4g} 0L{vertex:.4g} {center[0]:.4g}L{end:.4g} {place[0]:.4g}"
        for center, place in zip(centers[near], landing[near], strict=True)
    )
    return [f'<path class="ray" d="{rays}"/>', f'<circle class="source" cx="{-depth:.4g}" cy="0" r="{dot:.4g}"/>']


def _dimension(start: float, stop: float, text: str, at: float, letter: float, right: float) -> str:
    """A length with its name below, which stays in the drawing."""
    tick = 0.3 * letter
    ends = "".join(f"M{z:.5g} {at - tick:.5g}v{2 * tick:.5g}" for z in (start, stop))
    half = 0.28 * letter * len(text)
    middle = min((start + stop) / 2, right - half - tick)
    line = f'<path class="dimension" d="M{start:.5g} {at:.5g}H{stop:.5g}{ends}"/>'
    return f'{line}<text x="{middle:.5g}" y="{at + 1.2 * letter:.5g}" text-anchor="middle">{escape(text)}</text>'


class Seen(NamedTuple):
    """How many lenses see each point of a plane, `[row, column]`, over `(left, top, right, bottom)`, mm."""

    lenses: Int[np.ndarray, "row column"]
    box: tuple[float, float, float, float]


def lenses_seen(imager: Imager, depth: float) -> Seen:
    """Lenses within the field radius whose chief ray lands on the sensor, over the plate and the sensor, at a depth."""
    x_left, x_right, y_bottom, y_top = imager.sensor.extent
    half_x, half_y = (side / 2 for side in imager.array.size)
    box = (min(x_left, -half_x), min(y_top, -half_y), max(x_right, half_x), max(y_bottom, half_y))
    step = max(box[2] - box[0], box[3] - box[1]) / _MAP
    columns, rows = (max(round((high - low) / step), 1) for low, high in ((box[0], box[2]), (box[1], box[3])))
    x = box[0] + (np.arange(columns) + 0.5) * (box[2] - box[0]) / columns
    y = box[1] + (np.arange(rows) + 0.5) * (box[3] - box[1]) / rows
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    centers, count = np.asarray(imager.centers, float), np.empty(len(points), int)
    for start in range(0, len(points), _TOGETHER):
        some = points[np.minimum(np.arange(start, start + _TOGETHER), len(points) - 1)]
        landing = np.asarray(imager.project(np.column_stack([some, np.full(len(some), depth)])), float)
        on = (landing[..., 0] >= x_left) & (landing[..., 0] <= x_right)
        on &= (landing[..., 1] >= y_top) & (landing[..., 1] <= y_bottom)
        on &= ((centers[:, None] - some[None]) ** 2).sum(-1) <= imager.field_radius**2
        count[start : start + _TOGETHER] = on.sum(0)[: len(points) - start]
    return Seen(count.reshape(rows, columns), box)


def layout(imager: Imager, picture: str, box: tuple[float, float, float, float], over: str) -> str:
    """Lenses as their clear apertures over a picture of a plane; plate and sensor outlined.

    `picture` is a data URI of what is within `box`, `(left, top, right, bottom)`, mm; `over` says what it is.
    """
    left, top, right, bottom = box
    width, height = right - left, bottom - top
    letter = max(width, height) / 34
    x0, x1, y1, y0 = imager.sensor.extent
    plate_x, plate_y = imager.array.size
    said = f"Layout of {len(imager.array.centers)} lenses over {over}"
    seen = f"{left - letter:.5g} {top - letter:.5g} {width + 2 * letter:.5g} {height + 3.6 * letter:.5g}"
    bar = round_length(width / 5)
    return "".join(
        [
            f'<svg class="layout" viewBox="{seen}" role="img" aria-label="{escape(said)}" '
            f'style="font-size:{letter:.4g}px">',
            f'<image x="{left:.5g}" y="{top:.5g}" width="{width:.5g}" height="{height:.5g}" '
            f'preserveAspectRatio="none" href="{picture}"/>',
            f'<path class="lenses" d="{_outlines(imager)}"/>',
            f'<rect class="plate" x="{-plate_x / 2:.5g}" y="{-plate_y / 2:.5g}" '
            f'width="{plate_x:.5g}" height="{plate_y:.5g}"/>',
            f'<rect class="pixels" x="{x0:.5g}" y="{y0:.5g}" width="{x1 - x0:.5g}" height="{y1 - y0:.5g}"/>',
            _dimension(left, left + bar, f"{bar:g} mm", bottom + 0.8 * letter, letter, right),
            "</svg>",
        ]
    )


def _outlines(imager: Imager) -> str:
    """Clear apertures: discs cut half-way to their neighbours."""
    array = imager.array
    centers, turned = np.asarray(array.centers, float), np.asarray(imager.centers, float)
    count = len(centers)
    angles = np.linspace(0, 2 * np.pi, max(6, min(48, _OUTLINE // count)), endpoint=False)
    direction = np.column_stack([np.cos(angles), np.sin(angles)])
    radius = np.repeat(np.broadcast_to(np.asarray(array.aperture_diameter, float) / 2, count)[:, None], len(angles), 1)
    edges = cell_edges(centers, array.size)
    along = (edges.end - edges.start) / np.hypot(*(edges.end - edges.start).T)[:, None]
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    normal *= np.sign((normal * edges.start).sum(1))[:, None]
    cos = normal @ direction.T
    np.minimum.at(radius, edges.lens, np.where(cos > 1e-9, edges.height[:, None] / np.maximum(cos, 1e-9), np.inf))
    # Drawn where calibration has it on the sensor.
    turn = float(imager.rotation)
    direction = direction @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    corners = turned[:, None] + radius[..., None] * direction[None]
    return "".join("M" + "L".join(f"{x:.3f} {y:.3f}" for x, y in each) + "Z" for each in corners)
