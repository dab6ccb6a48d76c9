"""Line charts as SVG, in the colours of the page that they stand in.

Colours and fonts are the page's style sheet's, so that a chart is dark on a dark page and black on paper.
"""

from collections.abc import Mapping, Sequence
from html import escape
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from matplotlib.ticker import LogLocator, MaxNLocator

from ...design.design import Design
from ...geometry import Imager
from ...layouts import cell_edges
from ...mold.lenslets import lenslet_height, lenslets_of, surface_height
from ...optics.psf import diffraction_psf, window_fraction
from ...pictures.style import round_length

# Of the picture, pixels of a desktop's screen, which a phone shows nearly as large; room for numbers and labels.
_WIDTH, _HEIGHT = 440, 290
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 12, 12, 44
# Line styles: those that colours alone would leave to good eyes.
_DASHES = ("", "7 4", "2 3", "9 3 2 3", "4 4", "1 4", "12 4")

Numbers = Sequence[float | None] | np.ndarray
Line = tuple[Numbers, Numbers]


def line_chart(
    lines: Mapping[str, Line],
    *,
    x: str,
    y: str,
    title: str,
    log: bool = False,
    marks: bool = False,
    bounds: tuple[float, float] | None = None,
) -> str:
    """The chart.

    Parameters
    ----------
    lines
        By name, places along x and y; what is None or not finite is left out.
    x, y
        Labels of the axes.
    title
        For those who cannot see it.
    log
        The axis y is logarithmic.
    marks
        A dot at each place.
    bounds
        Of the axis y; what the lines need by default, from 0 on unless it is logarithmic.
    """
    drawn = {name: _finite(line, log) for name, line in lines.items()}
    places = np.concatenate(list(drawn.values()), axis=1)
    if not places.size:
        return f'<p class="note">{escape(title)}: no finite number to draw.</p>'
    (left, right), (low, high) = _limits(places[0], False), bounds or _limits(places[1], log)
    if not log and bounds is None:
        low = min(low, 0.0)
    scale = np.log10 if log else np.asarray
    across = lambda v: _LEFT + (_WIDTH - _LEFT - _RIGHT) * (np.asarray(v) - left) / (right - left)
    span = float(scale(high) - scale(low))
    up = lambda v: _TOP + (_HEIGHT - _TOP - _BOTTOM) * (1 - (scale(v) - float(scale(low))) / span)
    parts = [f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(title)}">']
    for tick in _ticks(left, right, False):
        at = float(across(tick))
        parts.append(f'<path class="grid" d="M{at:.1f} {_TOP}V{_HEIGHT - _BOTTOM}"/>')
        parts.append(f'<text x="{at:.1f}" y="{_HEIGHT - _BOTTOM + 16}" text-anchor="middle">{tick:g}</text>')
    for tick in _ticks(low, high, log):
        at = float(up(tick))
        parts.append(f'<path class="grid" d="M{_LEFT} {at:.1f}H{_WIDTH - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{tick:g}</text>')
    parts.append(f'<path class="axis" d="M{_LEFT} {_TOP}V{_HEIGHT - _BOTTOM}H{_WIDTH - _RIGHT}"/>')
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    parts.append(f'<text x="{middle:.0f}" y="{_HEIGHT - 8}" text-anchor="middle">{escape(x)}</text>')
    turned = f"translate(13 {(_TOP + _HEIGHT - _BOTTOM) / 2:.0f}) rotate(-90)"
    parts.append(f'<text transform="{turned}" text-anchor="middle">{escape(y)}</text>')
    for number, (line_x, line_y) in enumerate(drawn.values()):
        inside = np.clip(line_y, low, high)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across(line_x), up(inside), strict=True))
        kind = f'class="line c{number % 7}" stroke-dasharray="{_DASHES[number % len(_DASHES)]}"'
        parts.append(f'<polyline {kind} points="{points}"/>')
        if marks:
            dots = "".join(
                f'<circle class="dot c{number % 7}" cx="{a:.1f}" cy="{b:.1f}" r="3"/>'
                for a, b in zip(across(line_x), up(inside), strict=True)
            )
            parts.append(dots)
    return "".join(parts) + "</svg>" + _legend(list(lines))


def _legend(names: list[str]) -> str:
    entry = (
        '<li><svg class="key" viewBox="0 0 30 8" aria-hidden="true"><path class="line c{kind}" '
        'stroke-dasharray="{dash}" d="M0 4H30"/></svg>{name}</li>'
    )
    items = [entry.format(kind=i % 7, dash=_DASHES[i % len(_DASHES)], name=escape(n)) for i, n in enumerate(names)]
    return f'<ul class="legend">{"".join(items)}</ul>'


def _finite(line: Line, log: bool) -> np.ndarray:
    both = np.array([[np.nan if v is None else float(v) for v in values] for values in line], float)
    kept = np.isfinite(both).all(0) & ((both[1] > 0) | (not log))
    return both[:, kept]


def _limits(values: np.ndarray, log: bool) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    if low == high:
        return (low / 2, high * 2) if log else (low - (abs(low) or 1.0) / 10, high + (abs(high) or 1.0) / 10)
    return (low / 1.15, high * 1.15) if log else (low, high + (high - low) * 0.04)


def _ticks(low: float, high: float, log: bool) -> list[float]:
    if log and high / low > 300:
        found = LogLocator(subs=(1.0,)).tick_values(low, high)
    elif log:
        found = LogLocator(subs=(1.0, 2.0, 5.0)).tick_values(low, high)
    else:
        found = MaxNLocator(6).tick_values(low, high)
    slack = 1e-9 * (high - low)
    return [float(f"{tick:.12g}") for tick in found if low - slack <= tick <= high + slack]


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
        caps = lenslets_of(imager.array)
        y = min((cap.center for cap in caps), key=lambda center: float(np.hypot(*center)))[1]
        fall = lenslet_height(imager.array) - surface_height(caps, np.column_stack([x, np.full_like(x, y)]))[0]
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
    pitch = np.sqrt(np.prod(imager.array.plate) / len(centers))
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
    half_x, half_y = (side / 2 for side in imager.array.plate)
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
    plate_x, plate_y = imager.array.plate
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
    edges = cell_edges(centers, array.plate)
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


# Pixels of a window, and how many radii of 80 % of the light it is wide; samples in a pixel; of a modulation transfer
# function, with the zeros about the window that make the curve smooth.
_WINDOW, _WIDE, _MOST_SAMPLES, _PADDED = (25, 65), 2.6, 12, 512
# Share of the field radius, and depths that are shown at most.
FIELDS = (0.0, 0.5, 1.0)
_DEPTHS = 5


class Spots(NamedTuple):
    """Spots on the sensor, `[depth, field, row, column]`, each with the sum 1.

    `caught` is the share of the light through the lens that falls into the window; depths and heights are mm.
    """

    images: Float[np.ndarray, "depth field row column"]
    caught: Float[np.ndarray, "depth field"]
    depths: Float[np.ndarray, " depth"]
    heights: Float[np.ndarray, " field"]


def one_lens(imager: Imager, index: int = 0) -> Imager:
    """The same with one type of lens, where they differ."""
    return imager if imager.array.alike else eqx.tree_at(lambda i: i.array, imager, imager.array.lens(index))


def spots_of(imager: Imager, depths: Float[np.ndarray, " depth"], diameter: float, radius: float) -> Spots:
    """Spots at a few depths over those given, mm, and over the field, by diffraction.

    `diameter` is that of the clear aperture, `radius` holds most of a spot's light on the sensor, mm.
    """
    imager, heights = one_lens(imager), np.array(FIELDS) * imager.field_radius
    chosen = np.linspace(depths.min(), depths.max(), min(_DEPTHS, len(depths)))
    # What falls outside of `samples / s` windows is folded back (`diffraction_psf`).
    s = diameter * imager.sensor.pixel_pitch / (float(imager.wavelength) * float(imager.reduced_sensor_distance))
    samples = int(np.clip(np.ceil(1.3 * s), 2, _MOST_SAMPLES))
    size = 2 * int(np.clip(_WIDE * radius / imager.sensor.pixel_pitch, *_WINDOW) // 2) + 1
    axis = {"radius": jnp.asarray(diameter / 2), "samples": samples}
    images, caught = np.empty((len(chosen), len(heights), size, size)), np.empty((len(chosen), len(heights)))
    for row, depth in enumerate(chosen):
        for column, height in enumerate(heights):
            given = {"field": (jnp.asarray(height), jnp.asarray(0.0)), "size": size, **axis}
            images[row, column] = diffraction_psf(imager, jnp.asarray(depth), **given)
            caught[row, column] = window_fraction(imager, jnp.asarray(depth), **given)
    return Spots(images, caught, chosen, heights)


class Contrast(NamedTuple):
    """A modulation transfer function: contrast at frequencies in the object, 1/mm; mean over x and y."""

    frequency: Float[np.ndarray, " frequency"]
    contrast: Float[np.ndarray, " frequency"]


def contrast(image: Float[np.ndarray, "row column"], caught: float, pixel: float, magnification: float) -> Contrast:
    """Of a spot on pixels, mm, up to the frequency that these resolve.

    Light beside the window is counted as evenly spread, so that between zero and the first frequency of the window the
    curve falls by it.
    """
    across = np.abs(np.fft.rfft(image.sum(0), _PADDED))
    along = np.abs(np.fft.rfft(image.sum(1), _PADDED))
    frequency = np.fft.rfftfreq(_PADDED, pixel) * magnification
    values = caught * (across + along) / 2
    values[0] = 1.0
    return Contrast(frequency, values)


def perfect(frequency: Float[np.ndarray, " frequency"], imager: Imager, depth: float, diameter: float) -> Contrast:
    """That of a lens without errors in focus, round, of this diameter, mm, and of square pixels."""
    v, magnification = float(imager.reduced_sensor_distance), float(imager.magnification(depth))
    on_sensor = frequency / magnification
    share = np.clip(on_sensor * float(imager.wavelength) * v / diameter, 0, 1)
    lens = 2 / np.pi * (np.arccos(share) - share * np.sqrt(1 - share**2))
    return Contrast(frequency, lens * np.abs(np.sinc(on_sensor * imager.sensor.pixel_pitch)))
