"""Drawings of the report as SVG: line charts, the microscope in section, its layout; PSFs and MTFs to be charted.

Charts and layouts take under a millisecond, so that `gs-jax explore` draws them at each move of a slider.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int
from matplotlib.path import Path as MatplotlibPath
from matplotlib.ticker import LogLocator, MaxNLocator

from ..base.errors import needs_extra
from ..design.conversion import default_sample
from ..design.design import Design
from ..microscope.geometry import Imager
from ..microscope.layouts import cell_edges, on_sensor, plate_corners
from ..microscope.media import layers_in_front
from ..mold.lenslets import Part
from ..optics import theory
from ..optics.psf import least_samples, spot_image
from ..optics.raytrace import to_numpy
from .device_model import lenses_that_see
from .pictures import png_uri, round_length, to_uint8

# Left, right, top and bottom of a chart's axes in its 440 x 290 pixels, and line styles to tell lines without colours.
_FRAME, _DASHES = (56, 428, 12, 246), ("", "7 4", "2 3", "9 3 2 3", "4 4", "1 4", "12 4")
# Points of a section; pixels along a map of lens counts, evaluated in batches; corners of all outlines of a layout.
_SECTION_POINTS, _MAP_PIXELS, _BATCH, _OUTLINE_POINTS = 801, 121, 2000, 12_000
# Lenses in a section are at most this far from it, in pitches.
_SECTION_WIDTH = 0.6
# Least and most pixels of a PSF window, its half width in radii of 80 % of the light, and samples per pixel at most.
_WINDOW, _WINDOW_RADII, _MAX_SAMPLES = (25, 65), 2.6, 12
# Length of the transform that gives MTFs, in pixels: zeros around the window make smooth curves.
_PADDED = 512
# Depths at which PSFs are shown at most, and shares of the field radius.
_PSF_DEPTHS, FIELDS = 5, (0.0, 0.5, 1.0)

Numbers = Sequence[float | None] | np.ndarray


def template(name: str) -> Any:
    """A template of the folder `templates`, by jinja2."""
    with needs_extra("report"):
        import_module("jinja2")
    return _environment().get_template(name)


@cache
def _environment() -> Any:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("gs_jax", "apps/templates"),
        autoescape=jinja2.select_autoescape(["html"]),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    environment.filters["number"] = lambda value: f"{value:.4g}" if np.isfinite(value) else "-"
    return environment


def _macros() -> Any:
    return template("drawings.html").module


def line_chart(
    lines: Mapping[str, tuple[Numbers, Numbers]],
    *,
    x: str,
    y: str,
    title: str,
    log: bool = False,
    marks: bool = False,
    bounds: tuple[float, float] | None = None,
) -> str:
    """A line chart as SVG with a legend.

    `lines` has values along x and y by the name of the line; None and values that are not finite are left out. `title`
    is the alternative text, `log` is for the y axis, and `marks` draws a dot at each point. `bounds` are the limits of
    the y axis, by default those of the lines, from 0 unless the axis is logarithmic.
    """
    data = {name: _finite(line, log) for name, line in lines.items()}
    points = np.concatenate(list(data.values()), axis=1)
    if not points.size:
        return _macros().line_chart(title, x, y, [], [], {}, marks, _DASHES, _FRAME)
    (first, last), (low, high) = _limits(points[0], False), bounds or _limits(points[1], log)
    if not log and bounds is None:
        low = min(low, 0.0)
    left, right, top, bottom = _FRAME
    scale = np.log10 if log else np.asarray
    to_x = lambda value: left + (right - left) * (np.asarray(value) - first) / (last - first)
    to_y = lambda value: bottom + (top - bottom) * (scale(value) - scale(low)) / (scale(high) - scale(low))
    curves = {n: np.column_stack([to_x(u), to_y(np.clip(v, low, high))]).tolist() for n, (u, v) in data.items()}
    x_ticks = [(tick, float(to_x(tick))) for tick in _ticks(first, last, False)]
    y_ticks = [(tick, float(to_y(tick))) for tick in _ticks(low, high, log)]
    return _macros().line_chart(title, x, y, x_ticks, y_ticks, curves, marks, _DASHES, _FRAME)


def _finite(line, log: bool) -> np.ndarray:
    both = np.array([[np.nan if value is None else float(value) for value in values] for values in line], float)
    return both[:, np.isfinite(both).all(0) & ((both[1] > 0) | (not log))]


def _limits(values: np.ndarray, log: bool) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    if low == high:
        return (low / 2, high * 2) if log else (low - (abs(low) or 1.0) / 10, high + (abs(high) or 1.0) / 10)
    return (low / 1.15, high * 1.15) if log else (low, high + (high - low) * 0.04)


def _ticks(low: float, high: float, log: bool) -> list[float]:
    locator = LogLocator(subs=(1.0,) if high / low > 300 else (1.0, 2.0, 5.0)) if log else MaxNLocator(6)
    slack = 1e-9 * (high - low)
    return [float(f"{x:.12g}") for x in locator.tick_values(low, high) if low - slack <= x <= high + slack]


def draw_section(design: Design) -> str:
    """The microscope in section through the lens nearest to the axis, to scale, as SVG, with the layers and the sample.

    Chief rays start at a point on the axis in the middle of the working distance.
    """
    imager, plano = to_numpy(design.imager()), design.lens.orientation == "plano"
    near, far = design.imaging.working_distance_mm
    width, thickness = design.array.size_mm[0], design.array.substrate_thickness_mm
    end = thickness + design.imaging.sensor_distance_mm
    middle = (design.sensor.origin_mm or (0.0, 0.0))[0]
    half_sensor = design.sensor.shape[1] * design.sensor.pixel_pitch_um / 2000
    title = f"{design.name} cut open, to scale: objects, {len(design.array.centers_mm)} lenses on a plate, sensor"
    return _macros().section(
        title,
        near,
        far,
        thickness,
        end,
        half=max(width / 2, abs(middle) + half_sensor),
        sensor=(middle - half_sensor, middle + half_sensor),
        glass=_glass(design, imager, plano, thickness, width),
        rays=_chief_rays(imager, (near + far) / 2, thickness if plano else 0.0, end),
        layers=_layers(design, imager, end, far),
        bar=round_length(1.1 * (far + end) / 8),
    )


def _glass(design: Design, imager: Imager, plano: bool, thickness: float, width: float) -> str:
    x = np.linspace(-width / 2, width / 2, _SECTION_POINTS)
    depth = np.zeros_like(x)
    if design.lens.focal_length_mm is None:
        part = Part(imager.array)
        y = part.centers[np.hypot(*part.centers.T).argmin(), 1:]
        depth = part.height - part.surface(x, y)[0][0]
    curved, flat = (thickness - depth, 0.0) if plano else (depth, thickness)
    corners = [*zip(curved, x, strict=True), (flat, width / 2), (flat, -width / 2)]
    return " ".join(f"{z:.4f},{at:.4f}" for z, at in corners)


class _Face(NamedTuple):
    """A plane face: its distance from where counting begins, and the reduced distance, mm."""

    at: float
    reduced: float


def _faces(slabs: Sequence[tuple[Any, Any]]) -> list[_Face]:
    thickness, index = np.array(slabs, float).reshape(-1, 2).T
    edges = (np.concatenate([[0.0], np.cumsum(size)]).tolist() for size in (thickness, thickness / index))
    return list(map(_Face, *edges))


def _slabs(imager: Imager) -> tuple[list[tuple[Any, Any]], list[tuple[Any, Any]]]:
    """Thickness and index of all layers: from the array's front to the object's medium, and from the sensor."""
    return layers_in_front(imager.filters, imager.sample), [] if imager.windows is None else imager.windows.slabs


def _layers(design: Design, imager: Imager, end: float, far: float) -> list[tuple[float, float, str]]:
    """Begin and end of each layer that is not air, along the drawing, and its label."""
    front, behind = _slabs(imager)
    on_array, cover = design.layers.object, default_sample(design).layers
    gap = [""] * (len(front) - len(on_array) - len(cover))
    names = [*(layer.name for layer in on_array), *gap, *(layer.name for layer in cover)]
    # From the array's front to the left, and from the sensor to the left.
    sides = ((front, names, 0.0), (behind, [layer.name for layer in design.layers.sensor], end))
    layers = [
        (start - beyond.at, start - face.at, _label(name or "layer", index, thickness), float(index))
        for slabs, labels, start in sides
        for (thickness, index), name, (face, beyond) in zip(slabs, labels, pairwise(_faces(slabs)), strict=True)
    ]
    begins = _faces(front)[-1].at
    if imager.sample is not None and begins < far:
        index = imager.sample.refractive_index
        layers.append((-far, -begins, _label("sample", index), float(index)))
    return [(start, stop, label) for start, stop, label, index in layers if index > 1]


def _label(name: str, index: Any, thickness: Any = None) -> str:
    size = "" if thickness is None else f"{float(thickness):.4g} mm, "
    return f"{name}, {size}n = {float(index):.4g}"


def _chief_rays(imager: Imager, depth: float, vertex: float, end: float) -> str:
    """Paths of chief rays, with the bends at layers to first order; without layers straight on both sides."""
    front, behind = (_faces(slabs) if slabs else [] for slabs in _slabs(imager))
    plate, v, z = (
        float(x)
        for x in (imager.array.reduced_thickness_front, imager.reduced_sensor_distance, imager.reduced_depth(depth))
    )
    centers, landing = imager.centers, imager.project(np.array([[0.0, 0.0, depth]]))[:, 0]
    pitch = np.sqrt(np.prod(imager.array.plate) / len(centers))
    near = (np.hypot(*centers.T) <= imager.field_radius) & (np.abs(centers[:, 1]) <= _SECTION_WIDTH * pitch)

    def path(center, spot):
        before = [(-face.at, center * (1 - (face.reduced + plate) / z)) for face in reversed(front) if face.at < depth]
        after = [(end - face.at, spot + (center - spot) * face.reduced / v) for face in reversed(behind[1:])]
        points = [(-depth, 0.0), *before, (vertex, center), *after, (end, spot)]
        return "M" + "L".join(f"{x:.4g} {y:.4g}" for x, y in points)

    return "".join(path(*each) for each in zip(centers[near, 0], landing[near, 0], strict=True))


def plate_and_sensor(imager: Imager) -> tuple[float, float, float, float]:
    """Box around plate and sensor, `(left, top, right, bottom)`, mm."""
    left, right, bottom, top = imager.sensor.extent
    corners = np.vstack([plate_corners(imager), [(left, top), (right, bottom)]])
    return (*corners.min(0).tolist(), *corners.max(0).tolist())


class LensCounts(NamedTuple):
    """Number of lenses within the field radius of each point of a plane, and the mean above the plate.

    `box`: `(left, top, right, bottom)` of these points, mm.
    """

    lenses: Int[np.ndarray, "row column"]
    box: tuple[float, float, float, float]
    mean: float


def count_lenses(imager: Imager, depth: float) -> LensCounts:
    """Count lenses within the field radius whose chief ray lands on the sensor, at a depth over plate and sensor."""
    left, top, right, bottom = box = plate_and_sensor(imager)
    step = max(right - left, bottom - top) / _MAP_PIXELS
    columns, rows = (max(round(length / step), 1) for length in (right - left, bottom - top))
    x = left + (np.arange(columns) + 0.5) * (right - left) / columns
    y = top + (np.arange(rows) + 0.5) * (bottom - top) / rows
    points = np.stack([*np.meshgrid(x, y), np.full((rows, columns), depth)], -1).reshape(-1, 3)
    batches = range(0, len(points), _BATCH)
    counts = np.concatenate([lenses_that_see(imager, points[at : at + _BATCH]).sum(0) for at in batches])
    over_plate = MatplotlibPath(plate_corners(imager)).contains_points(points[:, :2])
    return LensCounts(counts.reshape(rows, columns), box, float(counts[over_plate].mean()))


def draw_layout(imager: Imager, picture: str, box: tuple[float, float, float, float], what: str) -> str:
    """Clear apertures of the lenses, plate and sensor over a picture, as SVG.

    `picture` is a data URI of the plane within `box`, `(left, top, right, bottom)`, mm; `what` says what it shows.
    """
    title, bar = f"Layout of {len(imager.array.centers)} lenses over {what}", round_length((box[2] - box[0]) / 5)
    plate = " ".join(f"{x:.4f},{y:.4f}" for x, y in plate_corners(imager))
    return _macros().layout(title, picture, box, _outlines(imager), plate, imager.sensor.extent, bar)


def _outlines(imager: Imager) -> str:
    """Discs cut at the edges of their Voronoi cells, where calibration places them on the sensor."""
    array = imager.array
    centers = np.asarray(array.centers, float)
    angles = np.linspace(0, 2 * np.pi, int(np.clip(_OUTLINE_POINTS // len(centers), 6, 48)), endpoint=False)
    direction = np.column_stack([np.cos(angles), np.sin(angles)])
    radius = np.repeat(np.asarray(array.of_lenses("aperture_diameter"), float)[:, None] / 2, len(angles), 1)
    edges = cell_edges(centers, array.plate)
    along = (edges.end - edges.start) / np.hypot(*(edges.end - edges.start).T)[:, None]
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    normal *= np.sign((normal * edges.start).sum(1))[:, None]
    cos = normal @ direction.T
    np.minimum.at(radius, edges.lens, np.where(cos > 1e-9, edges.height[:, None] / np.maximum(cos, 1e-9), np.inf))
    corners = centers[:, None] + radius[..., None] * direction[None]
    corners = on_sensor(imager, corners.reshape(-1, 2)).reshape(corners.shape)
    return "".join("M" + "L".join(f"{x:.3f} {y:.3f}" for x, y in each) + "Z" for each in corners)


class Psfs(NamedTuple):
    """PSFs on the sensor at depths and field heights, mm; the sum of each is the share of the light in its window."""

    light: Float[np.ndarray, "depth field row column"]
    depths: Float[np.ndarray, " depth"]
    heights: Float[np.ndarray, " field"]


def simulate_psfs(imager: Imager, depths: Float[np.ndarray, " depth"], diameter: float, radius: float) -> Psfs:
    """PSFs at up to five of the depths, mm, and over the field; of lenses that differ, those of the first.

    By diffraction, or by rays where they are wide. `diameter` is that of the clear aperture, and `radius` contains
    80 % of the light on the sensor, mm.
    """
    if not imager.array.alike:
        imager = eqx.tree_at(lambda i: i.array, imager, imager.array.lens(0))
    heights, pixel = np.array(FIELDS) * imager.field_radius, imager.sensor.pixel_pitch
    chosen = np.linspace(depths.min(), depths.max(), min(_PSF_DEPTHS, len(depths)))
    samples = int(np.clip(np.ceil(1.3 * least_samples(imager, diameter)), 2, _MAX_SAMPLES))
    size = 2 * int(np.clip(_WINDOW_RADII * radius / pixel, *_WINDOW) // 2) + 1
    options = {"size": size, "radius": diameter / 2, "samples": samples}
    light = np.array([[spot_image(imager, depth, height, **options) for height in heights] for depth in chosen])
    return Psfs(light, chosen, heights)


def spot_rows(psfs: Psfs) -> list[tuple[float, list[tuple[str, float]]]]:
    """A row per field height: pictures of spots by depth, as the square root, and the light in their windows, %."""

    def cell(light: Float[np.ndarray, "row column"]) -> tuple[str, float]:
        light = np.nan_to_num(light)
        root = np.sqrt(np.maximum(light, 0) / max(light.max(), 1e-30))
        return png_uri(to_uint8(root, 0.0, 1.0), "magma"), 100 * float(light.sum())

    by_field = zip(psfs.heights, psfs.light.swapaxes(0, 1), strict=True)
    return [(height, [cell(light) for light in by_depth]) for height, by_depth in by_field]


def mtf(
    light: Float[np.ndarray, "row column"], pixel: float, magnification: float
) -> tuple[Float[np.ndarray, " frequency"], Float[np.ndarray, " frequency"]]:
    """Frequencies in the object up to the pixels' limit, 1/mm, and the modulation transfer, mean of x and y.

    Light outside the window counts as uniform: the curve drops by its share at the first frequency.
    """
    x, y = (np.abs(np.fft.rfft(light.sum(axis), _PADDED)) for axis in (0, 1))
    values = (x + y) / 2
    values[0] = 1.0
    return np.fft.rfftfreq(_PADDED, pixel) * magnification, values


def ideal_mtf(frequency: Float[np.ndarray, " frequency"], imager: Imager, depth: float, diameter: float) -> np.ndarray:
    """Modulation transfer of a focused round lens without aberrations, and of square pixels."""
    on_sensor = frequency / float(to_numpy(imager).magnification(depth))
    values = np.asarray(_ideal_mtf(on_sensor, imager.wavelength, imager.reduced_sensor_distance, diameter))
    return values * np.abs(np.sinc(on_sensor * imager.sensor.pixel_pitch))


@jax.jit
def _ideal_mtf(frequency, wavelength, distance, diameter):
    return theory.ideal_mtf(frequency, theory.cutoff_frequency(wavelength, distance, diameter))
