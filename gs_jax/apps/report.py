"""The HTML report of a design and of what was imaged with it, in one file."""

import json
import re
import shlex
from collections.abc import Iterable, Mapping
from itertools import chain, repeat, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Num
from matplotlib.figure import Figure
from rich.table import Table

from ..base.errors import InputError
from ..base.machine import describe
from ..base.progress import Progress
from ..base.typing import Image, PathLike, Points
from ..codesign.bound import bound_sheet, format_bound
from ..design.datasheets import TABLES, datasheet, findings, overview, summary, tables, violations
from ..design.design import Design, design_text, span_of
from ..io.files import check_output, read_text, write_text
from ..io.provenance import Provenance
from ..io.volumes import SurfaceMaps, surface_mesh
from ..microscope.geometry import Imager
from ..microscope.grid import Grid
from ..mold.lenslets import Part
from ..mold.solids import MoldShape, preview_solid
from ..optics.raytrace import to_numpy
from ..reconstruction.residual import format_deviation
from .drawings import (
    Psfs,
    count_lenses,
    draw_layout,
    draw_section,
    ideal_mtf,
    line_chart,
    mtf,
    simulate_psfs,
    spot_rows,
    template,
)
from .pictures import (
    block_maxima,
    color_table,
    display_range,
    downsample,
    figure_uri,
    png_uri,
    shade,
    to_base64,
    to_uint8,
    volume_html,
)
from .trace_pictures import draw_traces

SLICE_BYTES = 6_000_000  # of all slices, before compression
# Voxels in space, in all and along a side; points in space and in the table; pixels along a capture, and of its middle.
_MAX_VOXELS, _MAX_SIDE, _MAX_POINTS, _LISTED_POINTS, _MAX_CAPTURE, _MIDDLE = 60_000, 200, 5000, 300, 900, 500
_MAX_COLUMNS = 40_000  # of sheets in space


def write_report(
    path: PathLike,
    design: Design,
    *,
    volume: Num[Array | np.ndarray, "z y x"] | None = None,
    grid: Grid | None = None,
    deviation: Num[Array | np.ndarray, "z y x"] | None = None,
    surface: SurfaceMaps | None = None,
    points: Points | None = None,
    traces: Mapping[str, np.ndarray] | None = None,
    image: Image | None = None,
    tolerance: Mapping[str, Any] | None = None,
    notes: Mapping[str, str] | None = None,
    origins: Mapping[str, Mapping[str, Any]] | None = None,
    provenance: Provenance | None = None,
    progress: Progress | None = None,
) -> None:
    """Write an HTML report of a design, and of what was imaged with it, atomically.

    The page needs no network and contains no path of this machine. It has less than 15 MB, whatever the volume's size.

    Parameters
    ----------
    path
        `.html`.
    design
        The microscope.
    volume, grid
        A reconstruction of shape `grid.volume_shape`, and the positions of its voxels.
    deviation
        Standard deviation of each voxel of `volume`.
    surface
        Sheets, as `read_surface` reads them.
    points
        `(x, y, z, intensity)`, mm.
    traces
        Columns of a table of `gs-jax traces`.
    image
        The capture.
    tolerance
        The JSON of `gs-jax tolerance`.
    notes
        A sentence for the beginning of the page, "page", and for its sections "capture", "volume" and "points".
    origins
        Provenance of the inputs, by file name.
    provenance
        Of the page.
    progress
        Shows the steps; nothing by default.

    Raises
    ------
    InputError
        As `check_output`, for `.html`, before any work; if `tolerance` has other contents.
    ValueError
        If a volume has no grid, or another shape than its grid; if `deviation` has another shape than the volume.
    """
    path, progress = check_output(path, [".html"]), progress or Progress()
    page = template("report.html")
    if volume is not None and (grid is None or volume.shape != grid.volume_shape):
        raise ValueError(f"`volume` must have the shape of `grid`, got {volume.shape}.")
    if deviation is not None and (volume is None or deviation.shape != volume.shape):
        raise ValueError(f"`deviation` must have the shape of `volume`, got {deviation.shape}.")
    context = {
        "design": design,
        "notes": dict.fromkeys(("page", "capture", "volume", "points"), "") | dict(notes or {}),
        "colors": {name: color_table(name) for name in ("magma", "viridis")},
        "tolerance": tolerance and tolerance_section(tolerance),
        "limits": limits if isinstance(limits := design.provenance.get("limits"), dict) else {},
        **_calibration(design),
        **_origins(design, provenance, origins or {}),
        **_optics(design, progress),
    }
    views = {}
    with progress.step("Mold"):
        views["mold"], context["no_mold"] = _mold(design)
    with progress.step("Pictures"):
        context["capture"] = None if image is None else _capture(np.asarray(image))
        context["volume"] = context["surface"] = context["points"] = context["traces"] = None
        if volume is not None and grid is not None:
            volume = np.asarray(volume)
            context["volume"] = {
                "shape": volume.shape,
                "pitch_um": 1000 * grid.pitch,
                "depths": np.asarray(grid.depths, float),
                "html": volume_html(volume, grid, max_bytes=SLICE_BYTES),
            }
            views["volume"] = voxel_view(volume, grid)
            if deviation is not None:
                deviation = np.asarray(deviation)
                context["volume"]["deviation"] = figure_uri(_draw_deviation(volume, deviation, grid))
                context["volume"]["sure"] = format_deviation(volume, deviation)
        if surface is not None:
            context["surface"] = {"shape": surface.depth.shape, "pitch_um": 1000 * surface.grid.pitch}
            context["surface"]["picture"] = figure_uri(_draw_sheets(surface))
            views["surface"] = _surface_view(surface)
        if points is not None:
            brightest = np.asarray(points, float)[np.argsort(-np.asarray(points)[:, 3], kind="stable")]
            context["points"] = {"count": len(points), "listed": brightest[:_LISTED_POINTS].tolist()}
            views["points"] = _point_view(brightest[:_MAX_POINTS, :3], grid) if len(points) else None
        if traces is not None:
            regions, frames = (len(np.unique(traces[name])) for name in ("region", "frame"))
            context["traces"] = {"regions": regions, "frames": frames, "picture": figure_uri(draw_traces(traces))}
    context["views"] = {name: view for name, view in views.items() if view}
    write_text(path, page.render(context), [".html"])


def _optics(design: Design, progress: Progress) -> dict[str, Any]:
    """Sections of the device, the datasheet, spots, contrast and layout."""
    with progress.step("Datasheet"):
        sheet = datasheet(design)
        remarks, faults = findings(design, sheet), violations(design, sheet)
        bound = format_bound(bound_sheet(design.imager(), sheet["depth_mm"]), len(sheet["depth_mm"]))
    imager, depths = design.imager(), np.array(sheet["depth_mm"])
    middle = float(depths[len(depths) // 2])
    with progress.step("Drawing"):
        counts = count_lenses(imager, middle)
        count_map = png_uri(to_uint8(counts.lenses, 0.0, max(float(counts.lenses.max()), 1.0)), "viridis")
        layout = draw_layout(imager, count_map, counts.box, "the number of lenses within the field radius")
        section = draw_section(design)
    with progress.step("Spots"):
        diameter = sheet["focal_length_mm"] / sheet["f_number"]
        radius = np.max(np.array(sheet["spot_radius_um"]) * sheet["magnification"]) / 1000
        psfs = simulate_psfs(imager, depths, diameter, float(radius))
    widths = {
        "FWHM on the axis": (depths, sheet["fwhm_um"]),
        "RMS width": (depths, sheet["rms_width_um"]),
        "half-light radius": (depths, sheet["half_light_radius_um"]),
        "predicted (Eq. 5)": (depths, sheet["lateral_resolution_um"]),
        "axial, predicted (Eq. 6)": (depths, sheet["axial_resolution_um"]),
    }
    return {
        "sheet": sheet,
        "tables": [
            _cells(*both, faults) for both in zip(tables(sheet), chain(TABLES.values(), repeat(())), strict=False)
        ],
        "violations": remarks,
        "device": [summary(design, sheet), *overview(design, sheet), bound],
        "keys": _device_rows(design),
        "section": section,
        "layout": layout,
        "seen": {"depth": middle, "most": int(counts.lenses.max()), "mean": counts.mean},
        "count_bar": png_uri(np.arange(256, dtype=np.uint8)[None], "viridis"),
        "widths": line_chart(
            widths, x="depth z, mm", y="in the object, um", title="Resolution by depth", log=True, marks=True
        ),
        "psfs": {"depths": psfs.depths, "rows": spot_rows(psfs)},
        "window": {"pixels": psfs.light.shape[-1], "um": 1000 * psfs.light.shape[-1] * imager.sensor.pixel_pitch},
        **_mtf_charts(psfs, imager, diameter),
    }


def _device_rows(design: Design) -> list[tuple[str, str]]:
    """Keys of the design file and their values; of a value per lens, and of the working distance, the span."""
    listed = {"centers_mm", "aspheric_terms", "spectrum_nm"}
    of_lens, of_array, of_sensor, of_imaging = (
        table.model_dump(exclude_defaults=True, exclude=listed)
        for table in (design.lens, design.array, design.sensor, design.imaging)
    )
    rows = {"lenses": len(design.array.centers_mm)}
    rows |= {key: value if isinstance(value, str) else span_of(value) for key, value in (of_lens | of_imaging).items()}
    sizes = of_array | of_sensor
    rows |= {key: " x ".join(map(str, value)) if isinstance(value, tuple) else value for key, value in sizes.items()}
    return [(key.replace("_", " "), str(value)) for key, value in rows.items()]


def _cells(table: Table, keys: Iterable[str], faults: Mapping[str, list[str]]) -> dict[str, Any]:
    """Title, heads and rows of a table for the terminal; a cell is its text and what it violates."""
    heads = [str(column.header).replace("-\n", "").replace("\n", " ") for column in table.columns]
    columns = zip_longest(table.columns, ("depth_mm", *keys))
    marked = [zip(column.cells, faults.get(key) or repeat(""), strict=False) for column, key in columns]
    return {"title": table.title, "heads": heads, "rows": list(zip(*marked, strict=True))}


def _mtf_charts(psfs: Psfs, imager: Imager, diameter: float) -> dict[str, str]:
    def curve(i: int, j: int):
        magnification = float(to_numpy(imager).magnification(psfs.depths[i]))
        return mtf(psfs.light[i, j], imager.sensor.pixel_pitch, magnification)

    def chart(curves, title: str) -> str:
        return line_chart(curves, x="frequency in the object, 1/mm", y="contrast", title=title, bounds=(0.0, 1.0))

    by_depth = {f"{z:.4g} mm": curve(i, 0) for i, z in enumerate(psfs.depths)}
    middle = float(psfs.depths[len(psfs.depths) // 2])
    frequency = next(iter(by_depth.values()))[0]
    by_depth[f"ideal, {middle:.4g} mm"] = (frequency, ideal_mtf(frequency, imager, middle, diameter))
    sharpest = int(np.argmax(psfs.light.max((2, 3))[:, 0]))
    by_field = {f"{h:.3g} mm off axis": curve(sharpest, j) for j, h in enumerate(psfs.heights)}
    return {
        "mtf_depth": chart(by_depth, "On the axis, by depth"),
        "mtf_field": chart(by_field, f"Over the field, at {psfs.depths[sharpest]:.4g} mm"),
    }


def _calibration(design: Design) -> dict[str, Any]:
    """Names, values and standard deviations from `gs-jax calibrate`, and its fit in a line; empty without them."""
    record = design.provenance
    values, deviations = (record.get(key, {}) for key in ("calibrated_values", "standard_deviations"))
    rows = []
    if isinstance(values, dict) and isinstance(deviations, dict):
        rows = [(name, value, deviations.get(name, "")) for name, value in values.items()]
    spots = f"{record.get('calibrated_spots')} spots of {record.get('calibrated_captures', '?')} captures"
    summary = f"{spots}, {record.get('calibrated_rms_pixels', '?')} pixels RMS"
    summary += ", mirrored." if record.get("mirrored") else "."
    return {"calibration": rows, "calibration_summary": summary if "calibrated_spots" in record else ""}


def read_tolerance(path: PathLike) -> dict[str, Any]:
    """Read the JSON of `gs-jax tolerance -o`; `InputError` for other contents."""
    try:
        numbers = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON: {str(error):.200}.") from error
    tolerance_section(numbers, str(path))
    return numbers


def tolerance_section(numbers: Mapping[str, Any], name: str = "tolerance") -> dict[str, Any]:
    """The yield as a sentence, a row per tolerance, and a chart of spot widths, from the JSON of `gs-jax tolerance`.

    Raises `InputError` for other contents, with the `name` of the file.
    """
    try:
        depths, devices, without = numbers["depth_mm"], numbers["drawn"], numbers.get("yield_without", {})
        rows = [
            (name, *("-" if x is None else f"{x:.3g}" for x in changes.values()))
            + (f"{100 * without[name]:.3g}" if name in without else "",)
            for name, changes in numbers["over_depths"].items()
        ]
        widths = {
            "as designed": (depths, numbers["nominal"]["spot_width_um"]),
            "devices, median": (depths, devices["spot_width_um"]["p50"]),
            "5 %": (depths, devices["spot_width_um"]["p5"]),
            "95 %": (depths, devices["spot_width_um"]["p95"]),
            "target": (depths, numbers["targets"]["max_width_um"]),
        }
        summary = f"{100 * numbers['yield']:.3g} % of {devices['devices']} devices keep all targets."
        chart = line_chart(widths, x="depth z, mm", y="width of a spot, um", title="Spots by depth", marks=True)
        return {"summary": summary, "rows": rows, "chart": chart}
    except KeyError as error:
        raise InputError(f"{name}: must be what `gs-jax tolerance -o` writes, got no {error}.") from error
    except (TypeError, AttributeError, ValueError) as error:
        raise InputError(f"{name}: must be what `gs-jax tolerance -o` writes, got {error!r:.80}.") from error


# An absolute path, with its last component as the group.
_ABSOLUTE = re.compile(r"""(?<![^\s='"(\[,])(?:file://)?(?:[A-Za-z]:)?[\\/](?:[^\s'"=,]*[\\/])?([^\s'"\\/=,]+)""")


def strip_folders(text: str) -> str:
    """Replace absolute paths in a text, or in a command of `gs-jax`, by the names of the files."""
    try:
        words = shlex.split(text) if text.startswith("gs-jax ") else []
    except ValueError:
        words = []
    return _ABSOLUTE.sub(r"\1", shlex.join(map(_strip_folder, words)) if words else text)


def _strip_folder(word: str) -> str:
    option, equals, value = word.partition("=")
    if option.startswith("-") and equals:
        return f"{option}={_strip_folder(value)}"
    return re.split(r"[\\/]", word.rstrip("\\/"))[-1] if re.match(r"(?:[A-Za-z]:)?[\\/]", word) else word


def _origins(design: Design, provenance: Provenance | None, origins: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Provenance without folders, and without the text of designs; versions of the software that writes the page."""
    own = {key: value for key, value in design.provenance.items() if not key.startswith("calibrated_")}
    by_name = {"this page": provenance or {}, "the design": own}
    by_name |= {Path(name).name: origin for name, origin in origins.items()}

    def text(value) -> str:
        return strip_folders(value if isinstance(value, str) else json.dumps(value, ensure_ascii=False))

    rows = {
        name: [(str(key), text(value)) for key, value in origin.items() if key != "design"]
        for name, origin in by_name.items()
    }
    machine = describe()
    return {
        "versions": [(name, machine[name]) for name in ("gs-jax", "python", "jax", "system")],
        "origins": {name: values for name, values in rows.items() if values},
        "design_text": strip_folders(design_text(design)),
    }


def _capture(image: Num[np.ndarray, "row column"]) -> dict[str, Any]:
    """Pictures of the whole, each pixel a mean of `step` x `step`, and of its middle."""
    low, high = (float(v) for v in np.percentile(image, (0.5, 99.8)))
    middle = image[tuple(slice(max((n - _MIDDLE) // 2, 0), (n + _MIDDLE) // 2) for n in image.shape)]
    whole, crop = (png_uri(to_uint8(pixels, low, high)) for pixels in (downsample(image, _MAX_CAPTURE), middle))
    return {"whole": whole, "middle": crop, "step": -(-max(image.shape) // _MAX_CAPTURE), "shape": image.shape}


def _draw_sheets(maps: SurfaceMaps) -> Figure:
    """Brightness and depth of each sheet, mm, and the median standard deviation of its depths; dark ones are blank."""
    count, lit = len(maps.depth), maps.depth[np.isfinite(maps.depth)]
    low, high = np.percentile(lit, (0.5, 99.5)) if lit.size else (0.0, 0.0)
    figure = Figure(figsize=(9, 3.8 * count), layout="constrained")
    rows = figure.subplots(count, 2, squeeze=False, sharex=True, sharey=True)
    for number, (row, *sheet) in enumerate(zip(rows, maps.brightness, maps.depth, maps.depth_sd, strict=True), 1):
        name, (brightness, depth, sd) = f" of sheet {number}" if count > 1 else "", sheet
        row[0].imshow(brightness, "gray", vmin=0, vmax=np.percentile(brightness, 99.5), extent=maps.grid.extent)
        image = row[1].imshow(depth, "viridis", vmin=low, vmax=high, extent=maps.grid.extent)
        figure.colorbar(image, ax=row[1], label="z, mm")
        error = f", SD {np.nanmedian(sd):.2g} mm at the median" if np.isfinite(sd).any() else ""
        for axes, title in zip(row, ("brightness", "depth"), strict=True):
            axes.set(title=title + name + (error if title == "depth" else ""), xlabel="x, mm", ylabel="y, mm")
    return figure


def _draw_deviation(volume: np.ndarray, deviation: np.ndarray, grid: Grid) -> Figure:
    """Brightness and standard deviation of the brightest voxel of each column, on one scale."""
    deepest = volume.argmax(0)[None]
    maps = [np.take_along_axis(part, deepest, 0)[0] for part in (volume, deviation)]
    high = max(float(np.percentile(maps[0], 99.8)), 1e-12)
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    both = figure.subplots(1, 2)
    for axes, part, title in zip(both, maps, ("brightness", "standard deviation"), strict=True):
        axes.imshow(part, "viridis", vmin=0, vmax=high, extent=grid.extent)
        axes.set(title=title, xlabel="x, mm", ylabel="y, mm")
    figure.colorbar(both[0].images[0], ax=both, label="value of a voxel")
    return figure


def voxel_view(volume: Float[np.ndarray, "depth row column"], grid: Grid) -> dict[str, Any]:
    """The brightest voxels for the browser: indices of voxels, and brightness from 1 to 255."""
    step = [-(-n // _MAX_SIDE) for n in volume.shape]
    values = shade(block_maxima(volume, step), *display_range(volume))
    # Of voxels that are equally bright, a random selection.
    rank = values.ravel() + np.random.default_rng(0).random(values.size, np.float32)
    kept = np.argsort(-rank)[: min(_MAX_VOXELS, np.count_nonzero(values))]
    z, y, x = np.unravel_index(np.sort(kept), values.shape)
    middles = np.minimum(np.arange(values.shape[0]) * step[0] + (step[0] - 1) // 2, len(grid.depths) - 1)
    left, _, _, top = grid.extent
    pitch_x, pitch_y = grid.pitch * step[2], grid.pitch * step[1]
    return {
        "kind": "cloud",
        "count": len(kept),
        "voxels": to_base64(np.column_stack([x, y, z, values[z, y, x]]).astype(np.uint8)),
        "pitch": [pitch_x, pitch_y],
        "first": [left + pitch_x / 2, top + pitch_y / 2],
        "depths": np.asarray(grid.depths, float)[middles].tolist(),
        "box": _box(grid),
    }


def _box(grid: Grid) -> list[list[float]]:
    left, right, bottom, top = grid.extent
    z = np.asarray(grid.depths, float)
    return [[left, top, float(z.min())], [right, bottom, float(z.max())]]


def _point_view(points: Float[np.ndarray, "point 3"], grid: Grid | None) -> dict[str, Any]:
    """Points for the browser."""
    box = _box(grid) if grid is not None else [points.min(0).tolist(), points.max(0).tolist()]
    return {"kind": "points", "count": len(points), "places": to_base64(points.astype(np.float32)), "box": box}


def _surface_view(maps: SurfaceMaps) -> dict[str, Any] | None:
    """Sheets for the browser, with the brightness of each vertex from 0 to 255; None if all is dark."""
    step = int(np.ceil(np.sqrt(maps.depth.size / _MAX_COLUMNS)))
    first = np.s_[:, step // 2 :: step, step // 2 :: step]
    brightness, depth = maps.brightness[first], maps.depth[first]
    grid = Grid(maps.grid.depths, depth.shape[1:], maps.grid.pitch * step, maps.grid.origin)
    vertices, light, faces = surface_mesh(brightness, depth, grid)
    return _mesh_view(vertices, faces) | {"light": to_base64(to_uint8(light, 0.0, 1.0))} if len(faces) else None


def _mold(design: Design) -> tuple[dict[str, Any] | None, str]:
    """The mold for the browser, or why there is none."""
    if design.lens.focal_length_mm is not None:
        return None, "an ideal lens has no surface."
    try:
        mesh = preview_solid(Part(design.imager().array), MoldShape()).to_mesh64()
    except (InputError, ValueError) as error:
        return None, str(error)
    return _mesh_view(mesh.vert_properties[:, :3], mesh.tri_verts), ""


def _mesh_view(vertices: np.ndarray, facets: np.ndarray) -> dict[str, Any]:
    """A mesh for the browser: vertices as fractions of its box, and facets."""
    low, high = vertices.min(0).astype(float), vertices.max(0).astype(float)
    fractions = np.round((vertices - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    return {
        "kind": "mesh",
        "count": len(facets),
        "corners": to_base64(fractions),
        "facets": to_base64(facets.astype(np.uint32)),
        "box": [low.tolist(), high.tolist()],
    }
