"""The page: what a microscope is, what it promises and what it showed, in one file."""

from collections.abc import Mapping
from importlib import resources
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Num

from ...base.errors import InputError
from ...base.progress import Progress
from ...design.datasheets import datasheet
from ...design.design import Design, design_text
from ...design.diagnostics import findings
from ...geometry import Imager
from ...grid import Grid
from ...io.files import check_output, write_text
from ...io.provenance import Provenance
from ...pictures.volume_pictures import in_range, palette, png, slices, slider
from ...typing import Image, PathLike, Points
from . import drawings, report_tables, views
from .drawings import line_chart

PAPER = {
    "text": "F. Tian, J. Hu, W. Yang, “GEOMScope: Large Field-of-View 3D Lensless Microscopy with Low Computational "
    "Complexity”, Laser & Photonics Reviews 15, 2100072 (2021)",
    "doi": "10.1002/lpor.202100072",
}


def write_report(
    path: PathLike,
    design: Design,
    *,
    volume: Num[Array | np.ndarray, "z y x"] | None = None,
    grid: Grid | None = None,
    points: Points | None = None,
    image: Image | None = None,
    tolerance: Mapping[str, Any] | None = None,
    notes: Mapping[str, str] | None = None,
    origins: Mapping[str, Mapping[str, Any]] | None = None,
    provenance: Provenance | None = None,
    progress: Progress | None = None,
) -> None:
    """Writes a page of HTML that shows a design, and what was imaged with it; whole or not at all.

    The page needs no network and has no path of this machine. It has less than 15 MB, however large the volume is.

    Parameters
    ----------
    path
        `.html`.
    design
        The microscope.
    volume, grid
        What was reconstructed, `grid.volume_shape`, and where its voxels are.
    points
        `(x, y, z, intensity)`, mm.
    image
        The capture.
    tolerance
        Numbers of `gs-jax tolerance`, as in its JSON file.
    notes
        A sentence for the page's beginning, "page", and for its parts "capture", "volume" and "points".
    origins
        By a file's name, where it comes from.
    provenance
        Where the page comes from.
    progress
        Shows how far it is; nothing by default.

    Raises
    ------
    InputError
        As `check_output`, for `.html`, before any work; if `tolerance` is none.
    ValueError
        If there is a volume without its grid, or it is not of the grid's shape.
    """
    path, progress = check_output(path, [".html"]), progress or Progress()
    if volume is not None and (grid is None or volume.shape != grid.volume_shape):
        raise ValueError(f"`volume` must have the shape of `grid`, got {volume.shape}.")
    tolerances = report_tables.tolerance_facts(tolerance) if tolerance else None
    said = dict.fromkeys(("page", "capture", "volume", "points"), "") | dict(notes or {})
    context: dict[str, Any] = {"design": design, "notes": said, "paper": PAPER}
    context["colours"] = {name: palette(name) for name in ("magma", "viridis")}
    context |= _made_of(design, provenance, origins or {})
    context |= _optics(design, progress)
    with progress.step("Mold"):
        context |= _mold(design)
    with progress.step("Pictures"):
        context["tolerance"] = tolerances
        if tolerances:
            context["tolerance_chart"] = line_chart(
                tolerances.widths,
                x="depth z, mm",
                y="width of a spot, um",
                title="Spots by depth",
                marks=True,
            )
        if image is not None:
            whole, middle, step = views.capture_pictures(np.asarray(image))
            context["capture"] = {"whole": whole, "middle": middle, "step": step, "shape": image.shape}
        if volume is not None and grid is not None:
            _add_volume(context, np.asarray(volume), grid)
        if points is not None:
            _add_points(context, np.asarray(points, float), grid)
    write_text(path, render("report.html", context), [".html"])


def render(name: str, context: Mapping[str, Any], folder: str = "report") -> str:
    """A template of a folder of `gs_jax`, with this page's style sheet and its own script inside."""
    import jinja2

    made = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    made.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    inside = {"style": _asset("report", "page.css"), "script": _asset(folder, name.replace(".html", ".js"))}
    return made.from_string(_asset(folder, name)).render({**inside, **context})


def _asset(folder: str, name: str) -> str:
    return (resources.files("gs_jax") / "apps" / folder / name).read_text("utf-8")


def _made_of(design: Design, provenance: Provenance | None, origins: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    own = {key: value for key, value in design.provenance.items() if not key.startswith("calibrated_")}
    tables = {"this page": report_tables.origin_rows(provenance or {}), "the design": report_tables.origin_rows(own)}
    tables |= {report_tables.name_of(name): report_tables.origin_rows(found) for name, found in origins.items()}
    return {
        "versions": report_tables.versions(),
        "origins": {name: rows for name, rows in tables.items() if rows},
        "text_of_design": report_tables.without_folders(design_text(design)),
        "calibration": report_tables.calibration_rows(design),
        "calibration_summary": report_tables.calibration_summary(design),
        "capture": None,
        "volume": None,
        "points": None,
        "tolerance": None,
    }


def _optics(design: Design, progress: Progress) -> dict[str, Any]:
    """What the design promises and does."""
    with progress.step("Datasheet"):
        sheet = datasheet(design)
        said = findings(design, sheet)
    imager, depths = design.imager(), np.array(sheet["depth_mm"])
    middle = float(depths[len(depths) // 2])
    with progress.step("Drawing"):
        seen = drawings.lenses_seen(imager, middle)
        drawn = {"section": drawings.section(design), "layout": _layout(imager, seen)}
    with progress.step("Spots"):
        diameter = sheet["focal_length_mm"] / sheet["f_number"]
        radius = np.max(np.array(sheet["spot_radius_um"]) * sheet["magnification"]) / 1000
        found = drawings.spots_of(imager, depths, diameter, float(radius))
    width = {
        "spot, exact rays": (depths, sheet["spot_width_um"]),
        "promised (Eq. 5)": (depths, sheet["lateral_resolution_um"]),
        "radius of 80 %": (depths, sheet["spot_radius_um"]),
        "axial, promised (Eq. 6)": (depths, sheet["axial_resolution_um"]),
    }
    return {
        "sheet": sheet,
        "sheet_rows": report_tables.sheet_rows(design, sheet),
        "findings": said,
        "device": report_tables.device_facts(design, sheet),
        "section": drawn["section"],
        "layout": drawn["layout"],
        "seen": {"depth": middle, "most": int(seen.lenses.max()), "mean": float(_over_plate(seen, design).mean())},
        "count_bar": png(np.tile(np.arange(256, dtype=np.uint8), (1, 1)), "viridis"),
        "widths": line_chart(
            width, x="depth z, mm", y="in the object, um", title="Resolution by depth", log=True, marks=True
        ),
        "spots": _spot_pictures(found, imager),
        "mtf_depth": _contrast_by_depth(found, imager, diameter),
        "mtf_field": _contrast_by_field(found, imager),
    }


def _layout(imager: Imager, seen: drawings.Seen) -> str:
    picture = png(in_range(seen.lenses, 0.0, max(float(seen.lenses.max()), 1.0)), "viridis")
    return drawings.layout(imager, picture, seen.box, "the number of lenses that see each point")


def _over_plate(seen: drawings.Seen, design: Design) -> np.ndarray:
    """Counts where the plate is."""
    left, top, right, bottom = seen.box
    rows, columns = seen.lenses.shape
    x = left + (np.arange(columns) + 0.5) * (right - left) / columns
    y = top + (np.arange(rows) + 0.5) * (bottom - top) / rows
    half_x, half_y = (side / 2 for side in design.array.size_mm)
    return seen.lenses[np.ix_(np.abs(y) <= half_y, np.abs(x) <= half_x)]


def _spot_pictures(found: drawings.Spots, imager: Imager) -> dict[str, Any]:
    root = np.sqrt(found.images / found.images.max((2, 3), keepdims=True))
    cells = [
        [
            {"picture": png(in_range(root[i, j], 0.0, 1.0), "magma"), "caught": 100 * float(found.caught[i, j])}
            for i in range(len(found.depths))
        ]
        for j in range(len(found.heights))
    ]
    size = found.images.shape[-1]
    return {
        "depths": [f"{z:.4g}" for z in found.depths],
        "heights": [f"{h:.3g}" for h in found.heights],
        "cells": cells,
        "size": size,
        "wide_um": 1000 * size * imager.sensor.pixel_pitch,
    }


def _contrast_by_depth(found: drawings.Spots, imager: Imager, diameter: float) -> str:
    lines = {f"{z:.4g} mm": _contrast(found, imager, i, 0) for i, z in enumerate(found.depths)}
    middle = float(found.depths[len(found.depths) // 2])
    frequency = lines[next(iter(lines))].frequency
    lines[f"perfect, {middle:.4g} mm"] = drawings.perfect(frequency, imager, middle, diameter)
    return _contrast_chart(lines, "On the axis, by depth")


def _contrast_by_field(found: drawings.Spots, imager: Imager) -> str:
    # Where it is sharpest.
    best = int(np.argmax((found.images.max((2, 3)) * found.caught)[:, 0]))
    lines = {f"{h:.3g} mm beside the axis": _contrast(found, imager, best, j) for j, h in enumerate(found.heights)}
    return _contrast_chart(lines, f"Over the field, at {found.depths[best]:.4g} mm")


def _contrast(found: drawings.Spots, imager: Imager, depth: int, height: int) -> drawings.Contrast:
    magnification = float(imager.magnification(jnp.asarray(found.depths[depth])))
    image, caught = found.images[depth, height], float(found.caught[depth, height])
    return drawings.contrast(image, caught, imager.sensor.pixel_pitch, magnification)


def _contrast_chart(lines: dict[str, drawings.Contrast], title: str) -> str:
    return line_chart(
        {name: (line.frequency, line.contrast) for name, line in lines.items()},
        x="frequency in the object, 1/mm",
        y="contrast",
        title=title,
        bounds=(0.0, 1.0),
    )


def _mold(design: Design) -> dict[str, Any]:
    """The mold to turn, or why there is none."""
    if design.lens.focal_length_mm is not None:
        return {"turned": {}, "no_mold": "an ideal lens has no surface."}
    try:
        return {"turned": {"mold": views.part(design.imager().array)}, "no_mold": ""}
    except (InputError, ValueError) as error:
        return {"turned": {}, "no_mold": str(error)}


def _add_volume(context: dict[str, Any], volume: np.ndarray, grid: Grid) -> None:
    depths, pitch = np.asarray(grid.depths, float), grid.pitch
    context["volume"] = {
        "slider": slider(slices(volume, grid, views.SLICE_BYTES)),
        "projections": views.projections(volume, grid),
        "said": f"{' x '.join(map(str, volume.shape))} voxels (z, y, x), {1000 * pitch:.4g} um laterally, "
        f"{len(depths)} depth{'s' * (len(depths) != 1)} from {depths.min():g} to {depths.max():g} mm",
    }
    context["turned"]["volume"] = views.cloud(volume, grid)


def _add_points(context: dict[str, Any], points: np.ndarray, grid: Grid | None) -> None:
    order = np.argsort(-points[:, 3], kind="stable")[: views.LISTED]
    context["points"] = {"count": len(points), "listed": points[order].tolist(), "most": views.LISTED}
    if len(points):
        context["turned"]["points"] = views.scatter(points, grid)
