"""The HTML report of a design and of what was imaged with it, in one file."""

from collections.abc import Mapping
from importlib import import_module, resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Num

from ..base.errors import InputError, needs_extra
from ..base.progress import Progress
from ..design.datasheets import datasheet, findings
from ..design.design import Design, design_text
from ..geometry import Imager
from ..grid import Grid
from ..io.files import check_output, write_text
from ..io.provenance import Provenance
from ..io.volumes import SurfaceMaps, surface_mesh
from ..optics.raytrace import to_numpy
from ..typing import Image, PathLike, Points
from . import report_tables as tables
from .drawings import Psfs, count_lenses, draw_layout, draw_section, ideal_mtf, line_chart, mtf, simulate_psfs
from .pictures import color_table, make_slices, png_uri, scale_bar_html, slider_html, to_base64, to_uint8

PAPER = {
    "text": "F. Tian, J. Hu, W. Yang, “GEOMScope: Large Field-of-View 3D Lensless Microscopy with Low Computational "
    "Complexity”, Laser & Photonics Reviews 15, 2100072 (2021)",
    "doi": "10.1002/lpor.202100072",
}
# Points in the table, the brightest.
_LISTED_POINTS = 300


def write_report(
    path: PathLike,
    design: Design,
    *,
    volume: Num[Array | np.ndarray, "z y x"] | None = None,
    grid: Grid | None = None,
    surface: SurfaceMaps | None = None,
    points: Points | None = None,
    image: Image | None = None,
    tolerance: Mapping[str, Any] | None = None,
    notes: Mapping[str, str] | None = None,
    origins: Mapping[str, Mapping[str, Any]] | None = None,
    provenance: Provenance | None = None,
    progress: Progress | None = None,
) -> None:
    """Writes an HTML report of a design, and of what was imaged with it, atomically.

    The page needs no network and contains no path of this machine. It has less than 15 MB, whatever the volume's size.

    Parameters
    ----------
    path
        `.html`.
    design
        The microscope.
    volume, grid
        A reconstruction of shape `grid.volume_shape`, and the positions of its voxels.
    surface
        Sheets, as `read_surface` reads them.
    points
        `(x, y, z, intensity)`, mm.
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
        If a volume has no grid, or another shape than its grid.
    """
    path, progress = check_output(path, [".html"]), progress or Progress()
    with needs_extra("report"):
        import_module("jinja2")
    if volume is not None and (grid is None or volume.shape != grid.volume_shape):
        raise ValueError(f"`volume` must have the shape of `grid`, got {volume.shape}.")
    context: dict[str, Any] = {
        "design": design,
        "notes": dict.fromkeys(("page", "capture", "volume", "points"), "") | dict(notes or {}),
        "paper": PAPER,
        "colors": {name: color_table(name) for name in ("magma", "viridis")},
        "calibration": tables.calibration_rows(design),
        "calibration_summary": tables.calibration_summary(design),
        "tolerance": tables.tolerance_table(tolerance) if tolerance else None,
        "capture": None if image is None else tables.capture_view(np.asarray(image)),
        "volume": None,
        "surface": None,
        "points": None,
        **_origins(design, provenance, origins or {}),
        **_optics(design, progress),
    }
    with progress.step("Mold"):
        context |= _mold(design)
    with progress.step("Pictures"):
        if context["tolerance"]:
            labels: Any = {"x": "depth z, mm", "y": "width of a spot, um", "title": "Spots by depth"}
            context["tolerance_chart"] = line_chart(context["tolerance"].widths, **labels, marks=True)
        if volume is not None and grid is not None:
            volume = np.asarray(volume)
            context["volume"] = {
                "shape": volume.shape,
                "pitch_um": 1000 * grid.pitch,
                "depths": np.asarray(grid.depths, float),
                "slider": slider_html(make_slices(volume, grid, tables.SLICE_BYTES)),
                "projections": tables.make_projections(volume, grid),
                "bar": scale_bar_html(grid.shape[1] * grid.pitch),
                "extent": grid.extent,
            }
            context["views"]["volume"] = tables.voxel_view(volume, grid)
        if surface is not None:
            sheets, low, high = sheet_pictures(surface)
            shape, pitch = surface.depth.shape, 1000 * surface.grid.pitch
            context["surface"] = {"sheets": sheets, "low": low, "high": high, "shape": shape, "pitch_um": pitch}
            if view := surface_view(surface):
                context["views"]["surface"] = view
        if points is not None:
            points = np.asarray(points, float)
            listed = points[np.argsort(-points[:, 3], kind="stable")[:_LISTED_POINTS]]
            context["points"] = {"count": len(points), "listed": listed.tolist()}
            if len(points):
                context["views"]["points"] = tables.point_view(points, grid)
    write_text(path, render("report.html", context), [".html"])


def render(name: str, context: Mapping[str, Any]) -> str:
    """Render a template of `gs_jax/apps/templates` with the style sheet of the report and its own script."""
    with needs_extra("report"):
        import jinja2

    read = lambda name: resources.files("gs_jax").joinpath("apps", "templates", name).read_text("utf-8")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    embedded = {"style": read("page.css"), "script": read(name.replace(".html", ".js"))}
    return environment.from_string(read(name)).render({**embedded, **context})


def _origins(design: Design, provenance: Provenance | None, origins: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    own = {key: value for key, value in design.provenance.items() if not key.startswith("calibrated_")}
    by_name = {"this page": provenance or {}, "the design": own}
    by_name |= {Path(name).name: origin for name, origin in origins.items()}
    rows = {name: tables.provenance_rows(origin) for name, origin in by_name.items()}
    return {
        "versions": tables.versions(),
        "origins": {name: each for name, each in rows.items() if each},
        "design_text": tables.strip_folders(design_text(design)),
    }


def _optics(design: Design, progress: Progress) -> dict[str, Any]:
    with progress.step("Datasheet"):
        sheet = datasheet(design)
        violations = findings(design, sheet)
    imager, depths = design.imager(), np.array(sheet["depth_mm"])
    middle = float(depths[len(depths) // 2])
    with progress.step("Drawing"):
        counts = count_lenses(imager, middle)
        count_map = png_uri(to_uint8(counts.lenses, 0.0, max(float(counts.lenses.max()), 1.0)), "viridis")
        layout = draw_layout(imager, count_map, counts.box, "the number of lenses that see each point")
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
    labels: Any = {"x": "depth z, mm", "y": "in the object, um", "title": "Resolution by depth"}
    return {
        "sheet": sheet,
        "sheet_rows": tables.datasheet_rows(design, sheet),
        "violations": violations,
        "device": tables.device_rows(design, sheet),
        "section": section,
        "layout": layout,
        "seen": {"depth": middle, "most": int(counts.lenses.max()), "mean": counts.mean},
        "count_bar": png_uri(np.arange(256, dtype=np.uint8)[None], "viridis"),
        "widths": line_chart(widths, **labels, log=True, marks=True),
        "psfs": _psf_pictures(psfs, imager),
        **_mtf_charts(psfs, imager, diameter),
    }


def _psf_pictures(psfs: Psfs, imager: Imager) -> dict[str, Any]:
    peaks = psfs.images.max((2, 3), keepdims=True)
    root = to_uint8(np.sqrt(psfs.images / np.where(peaks > 0, peaks, 1)), 0.0, 1.0)
    rows = [
        [(png_uri(root[i, j], "magma"), 100 * float(psfs.caught[i, j])) for i in range(len(psfs.depths))]
        for j in range(len(psfs.heights))
    ]
    size = root.shape[-1]
    width = 1000 * size * imager.sensor.pixel_pitch
    return {"depths": psfs.depths, "rows": list(zip(psfs.heights, rows, strict=True)), "size": size, "width_um": width}


def _mtf_charts(psfs: Psfs, imager: Imager, diameter: float) -> dict[str, str]:
    def curve(i: int, j: int):
        magnification = float(to_numpy(imager).magnification(psfs.depths[i]))
        return mtf(psfs.images[i, j], float(psfs.caught[i, j]), imager.sensor.pixel_pitch, magnification)

    def chart(curves, title: str) -> str:
        return line_chart(curves, x="frequency in the object, 1/mm", y="contrast", title=title, bounds=(0.0, 1.0))

    by_depth = {f"{z:.4g} mm": curve(i, 0) for i, z in enumerate(psfs.depths)}
    middle = float(psfs.depths[len(psfs.depths) // 2])
    frequency = next(iter(by_depth.values()))[0]
    by_depth[f"ideal, {middle:.4g} mm"] = (frequency, ideal_mtf(frequency, imager, middle, diameter))
    sharpest = int(np.argmax((psfs.images.max((2, 3)) * psfs.caught)[:, 0]))
    by_field = {f"{h:.3g} mm off axis": curve(sharpest, j) for j, h in enumerate(psfs.heights)}
    return {
        "mtf_depth": chart(by_depth, "On the axis, by depth"),
        "mtf_field": chart(by_field, f"Over the field, at {psfs.depths[sharpest]:.4g} mm"),
    }


def _mold(design: Design) -> dict[str, Any]:
    if design.lens.focal_length_mm is not None:
        return {"views": {}, "no_mold": "an ideal lens has no surface."}
    try:
        return {"views": {"mold": tables.mold_view(design.imager().array)}, "no_mold": ""}
    except (InputError, ValueError) as error:
        return {"views": {}, "no_mold": str(error)}


# Pixels along a picture, and columns of sheets in space.
_MAX_PIXELS, _MAX_COLUMNS = 720, 40_000


def surface_view(maps: SurfaceMaps) -> dict[str, Any] | None:
    """Sheets for the browser, with the brightness of each vertex from 0 to 255; None if all is dark."""
    step = int(np.ceil(np.sqrt(maps.depth.size / _MAX_COLUMNS)))
    first = np.s_[:, step // 2 :: step, step // 2 :: step]
    brightness, depth = maps.brightness[first], maps.depth[first]
    grid = Grid(maps.grid.depths, depth.shape[1:], maps.grid.pitch * step, maps.grid.origin)
    vertices, light, faces = surface_mesh(brightness, depth, grid)
    return tables.mesh_view(vertices, faces) | {"light": to_base64(to_uint8(light, 0.0, 1.0))} if len(faces) else None


class SheetPictures(NamedTuple):
    """Pictures of a sheet, transparent where it is dark, and the median standard deviation of its depth, mm."""

    brightness: str
    depth: str
    sd: float


def sheet_pictures(maps: SurfaceMaps) -> tuple[list[SheetPictures], float, float]:
    """Pictures of each sheet, and the depths of the first and the last colour, mm."""
    lit = np.isfinite(maps.depth)
    low, high = np.percentile(maps.depth[lit], (0.5, 99.5)) if lit.any() else (0.0, 0.0)
    pictures = []
    for brightness, depth, sd in zip(maps.brightness, maps.depth, maps.depth_sd, strict=True):
        # 0 is left for the dark.
        colours = np.maximum(to_uint8(np.nan_to_num(depth, nan=low), low, high), 1) * np.isfinite(depth)
        small = max(-(-max(depth.shape) // _MAX_PIXELS), 1)
        light = to_uint8(brightness, 0.0, float(np.percentile(brightness, 99.5)))
        depth_picture = png_uri(colours.astype(np.uint8)[::small, ::small], "viridis", transparent=0)
        known = sd[np.isfinite(sd)]
        middle = float(np.median(known)) if known.size else 0.0
        pictures.append(SheetPictures(png_uri(light[::small, ::small]), depth_picture, middle))
    return pictures, float(low), float(high)
