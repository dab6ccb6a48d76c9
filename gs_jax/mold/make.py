"""From a design to a file that can be printed, with its report: checks before it is written, measurements after."""

import math
import os
from dataclasses import asdict
from typing import Any

import manifold3d as m3
import numpy as np
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from ..base.progress import Progress
from ..design.design import Design, read_design
from ..io.files import atomic_write, check_output, write_figure, write_json, write_text
from ..io.provenance import KEY, Provenance
from ..lenses import MicrolensArray
from ..typing import PathLike
from .export import MESH_SUFFIXES, printable, read_mesh, write_mesh
from .lenslets import caps_of, part_centers, surface
from .manufacturability import Finding, check_design, check_solid, refuse_errors
from .measurement import quality, verify
from .solids import MoldShape, array_solid, array_volume, coarsest_chord, mold_solid, mold_volume, volume_tolerance

# What a part must keep of its design: far below what a calibration of the assembled microscope corrects.
CENTER_TOLERANCE = 1e-3
RADIUS_TOLERANCE = 1e-3
CONIC_TOLERANCE = 1e-2
# The Strehl ratio of what counts as a perfect surface, Marechal's criterion.
GOOD_STREHL = 0.8
# Of a part, by the side of the lenses that faces the object.
_FRAMES = {
    "plano": "x, y as the sensor's, z toward the object; plano face (object's side) at z = 0, lenses toward -z",
    "curved": "x as the sensor's, y against it, z toward the sensor: turned over about x; "
    "plano face (sensor's side) at z = 0, lenses toward -z",
}


def make_mold(
    design: Design | PathLike,
    path: PathLike,
    *,
    positive: bool = False,
    shape: MoldShape = MoldShape(),
    chord: float = 4e-4,
    resolution: float = 0.025,
    layer: float | None = None,
    provenance: Provenance | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Writes the mold of a design, or the array, to print; and a picture and a report beside it.

    *File.*

    The file is read back and its lenses are measured.

    Parameters
    ----------
    design
        The microscope, or its file.
    path
        `.stl` or `.3mf`.
    positive
        The array itself, rather than its mold.
    shape
        Of the mold. Its shrinkage is made up for in the array too.
    chord
        The largest distance between a facet and its lens, mm.
    resolution
        The smallest feature that the printer makes, mm.
    layer
        Thickness of its layers, mm, if it prints any.
    provenance
        Where it comes from, for 3MF and the report.
    progress
        Shows how far it is; nothing by default.

    Returns
    -------
    dict
        The report, as in the JSON file.

    Raises
    ------
    InputError
        If a file cannot be read or written, or the design cannot be made, before anything is written.
    RuntimeError
        If the solid, or what was read back, is not the design: a fault of the program.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gs_jax as gs
    >>> design = gs.geomscope()
    >>> few = design.array.model_copy(update={"centers_mm": ((-0.5, 0.1), (0.6, 0.0)), "size_mm": (3.0, 3.0)})
    >>> report = gs.make_mold(design.model_copy(update={"array": few}), "mold.stl", chord=0.002)
    >>> sorted(path.name for path in Path().glob("mold.*"))
    ['mold.json', 'mold.png', 'mold.stl', 'mold.txt']
    """
    progress = progress or Progress()
    path = check_output(path, MESH_SUFFIXES)
    picture, record, text = (check_output(path.with_suffix(suffix), [suffix]) for suffix in (".png", ".json", ".txt"))
    source = f"design {design.name!r}" if isinstance(design, Design) else os.fspath(design)
    design = design if isinstance(design, Design) else read_design(design)
    findings = check_design(design, shape, chord=chord, resolution=resolution, layer=layer)
    refuse_errors(findings, source)
    imager = design.imager()
    array = imager.array
    part = array_solid(array, chord, progress=progress)
    with progress.step("Building and checking the solid"):
        solid = part.scale([shape.scale] * 3) if positive else mold_solid(array, part, shape)
        volume = shape.scale**3 * array_volume(array) if positive else mold_volume(array, shape)
        mesh = printable(solid)
        name = "array" if positive else "mold"
        findings += check_solid(mesh, volume, name, volume_tolerance(array, chord))
        _stop_at_fault(findings)
    # A part that is not the design does not get its name.
    with progress.step("Writing and measuring"), atomic_write(path) as temporary:
        write_mesh(temporary, mesh, f"{design.name} {name}", provenance)
        lenses = verify(read_mesh(temporary), array, scale=shape.scale)
        measured = quality(lenses, imager)
        findings += judge(measured, chord=chord, radius=min(cap.radius for cap in caps_of(array)))
        _stop_at_fault(findings)
    report = {
        "design": design.name,
        "part": name,
        "file": path.name,
        "unit": "mm",
        "frame": _FRAMES[array.orientation],
        "size_mm": np.ptp(mesh.vertices.astype(float), axis=0).round(6).tolist(),
        "facets": len(mesh.facets),
        "file_bytes": path.stat().st_size,
        "volume_mm3": mesh.solid().volume(),
        "analytic_volume_mm3": volume,
        "chord_um": 1000 * chord,
        "printer_resolution_um": 1000 * resolution,
        "shrinkage_percent": 100 * shape.shrinkage,
        "draft_deg": math.degrees(shape.draft),
        "checks": [asdict(finding) for finding in findings],
        "verification": measured,
        "lens_center_deviation_um": (1000 * (lenses.center - part_centers(array))).tolist(),
        "lens_radius_mm": lenses.radius.tolist(),
        "lens_conic_constant": lenses.conic.tolist(),
        "lens_surface_error_rms_um": (1000 * lenses.surface_rms).tolist(),
    }
    with progress.step("Drawing"):
        write_figure(picture, preview(array, None if positive else shape, design.name))
    write_json(record, report | ({KEY: dict(provenance)} if provenance else {}))
    write_text(text, report_text(report), [".txt"])
    return report


def _stop_at_fault(findings: list[Finding]) -> None:
    for finding in findings:
        if finding.level == "error":
            raise RuntimeError(f"{finding.check}: {finding.text}")


def judge(measured: dict[str, Any], *, chord: float, radius: float) -> list[Finding]:
    """What was measured, in words, against what a part must keep of its design; chord error and radius in mm."""
    missing = measured["lenses_not_measured"]
    center, larger = measured["center_deviation_max_um"], measured["radius_deviation_max_percent"]
    bent, certain = measured["conic_deviation_max"], measured["lenses_conic_measured"]
    # Coarse facets have vertices that are lifted, by less than the chord error: what was an asphere is another one.
    kept = center <= 1000 * CENTER_TOLERANCE and larger <= 100 * max(RADIUS_TOLERANCE, 5 * chord / radius)
    text = f"read back, lenses are within {center:.2g} um of their places and {larger:.2g} % of their radius"
    if certain:
        uncertain = measured["conic_uncertainty_max"]
        kept = kept and bent <= max(CONIC_TOLERANCE, 10 * chord / radius) + 3 * uncertain
        text += f", conic constants of {certain} within {bent:.2g} (uncertain by {uncertain:.1g} and less)"
    findings = [Finding("lenses", "ok" if kept else "error", f"{text}.")]
    if missing:
        text = f"{len(missing)} lenses have too few facets to be measured: {', '.join(map(str, missing[:10]))}."
        findings.append(Finding("lenses not measured", "warning", text))
    strehl = measured["strehl_of_facets_median"]
    text = f"facets alone leave a Strehl ratio of {strehl:.2f} ({measured['wavefront_error_rms_waves']:.3f} waves RMS)"
    if strehl >= GOOD_STREHL:
        return [*findings, Finding("facets' wavefront", "ok", f"{text}.")]
    # The error is proportional to the chord error, the logarithm of the Strehl ratio to its square.
    needed = 1000 * chord * math.sqrt(math.log(GOOD_STREHL) / math.log(max(strehl, 1e-300)))
    advice = f"{GOOD_STREHL} takes a chord error of {needed:.2g} um, or a polished mold"
    return [*findings, Finding("facets' wavefront", "warning", f"{text}; {advice}.")]


def report_text(report: dict[str, Any]) -> str:
    """A report to read."""
    title = f"{report['design']}: {report['part']}, {report['file']}"
    size = " x ".join(f"{side:.4g}" for side in report["size_mm"])
    lines = [
        title,
        f"{size} mm, {report['facets']:,} facets, {report['file_bytes'] / 1e6:.3g} MB, in mm.",
        f"Frame: {report['frame']}.",
        "",
        *(f"[{finding['level']}] {finding['check']}: {finding['text']}" for finding in report["checks"]),
    ]
    return "\n".join(lines) + "\n"


# Facets that a perspective view draws: more cannot be told apart.
_FACETS = 20_000
_PIXELS = 700


def preview(array: MicrolensArray, shape: MoldShape | None, name: str) -> Figure:
    """The picture.

    Parameters
    ----------
    array
        Lenses on a plate of finite size.
    shape
        Of the mold, or None to show the array itself.
    name
        Of the design.
    """
    figure = Figure(figsize=(12, 5.6), dpi=110, layout="constrained")
    heights = figure.add_subplot(1, 2, 1)
    _draw_heights(figure, heights, array, "array" if shape is None else "cavity of the mold, before shrinkage")
    view = figure.add_subplot(1, 2, 2, projection="3d")
    draw_solid(view, coarse_solid(array, shape), from_below=shape is None)
    figure.suptitle(f"{_printable(name)}: {'array' if shape is None else 'negative mold'}, {len(array.centers)} lenses")
    return figure


def _draw_heights(figure, axes, array, what):
    x, y = (np.linspace(-side / 2, side / 2, _PIXELS) for side in array.size)
    caps = caps_of(array)
    height = surface(caps, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))[0].reshape(_PIXELS, _PIXELS)
    shaded = LightSource(azdeg=315, altdeg=50).hillshade(height, dx=x[1] - x[0], dy=y[1] - y[0])
    # A part that has been turned over is drawn as it lies, with the design's y.
    from_sensor = array.orientation == "plano"
    bottom = array.size[1] / 2 if from_sensor else -array.size[1] / 2
    extent = (-array.size[0] / 2, array.size[0] / 2, bottom, -bottom)
    image = axes.imshow(1000 * height, cmap="viridis", extent=extent, vmin=0)
    axes.imshow(shaded, cmap="gray", extent=extent, alpha=0.45)
    seen = "the sensor" if from_sensor else "the object"
    axes.set(title=f"{what}, seen from {seen}", xlabel="x, mm", ylabel="y, mm")
    figure.colorbar(image, ax=axes, label="height over the plate, um", shrink=0.85)


def coarse_solid(array: MicrolensArray, shape: MoldShape | None) -> m3.Manifold:
    """The mold of a shape, or the array, in no more facets than a picture shows."""
    caps = caps_of(array)
    # Equilateral facets of a sphere: a depth of `side^2 / (6 R)` below it.
    chord = math.prod(array.size) / (_FACETS * 1.5 * math.sqrt(3) * min(cap.radius for cap in caps))
    part = array_solid(array, min(chord, coarsest_chord(caps)))
    return part if shape is None else mold_solid(array, part, shape)


def draw_solid(axes, solid: m3.Manifold, *, from_below: bool) -> None:
    """Draws a solid on axes of `projection="3d"`, to scale, seen from above or below."""
    # The painter's algorithm wants facets of like size.
    box = np.reshape(solid.bounding_box(), (2, 3))
    mesh = solid.refine_to_length(float(np.ptp(box, axis=0).max()) / 30).to_mesh64()
    corners = mesh.vert_properties[:, :3][mesh.tri_verts.astype(int)]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    # From the upper left of the picture, where eyes expect it: else cavities look like bumps.
    toward = np.array([0.0, -0.94, -0.33] if from_below else [-0.58, 0.0, 0.81])
    light = 0.25 + 0.75 * np.clip(normal @ toward, 0, 1)
    color = np.column_stack([light[:, None] * np.array([[0.78, 0.86, 0.95]]), np.ones(len(light))])
    axes.add_collection3d(Poly3DCollection(corners, facecolors=color, edgecolors=color, linewidths=0.3))
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set(xlabel="x, mm", ylabel="y, mm")
    axes.set_zticks([low[2], high[2]], [f"{low[2]:.3g}", f"z = {high[2]:.3g} mm"])
    axes.set_box_aspect(high - low, zoom=1.0)
    axes.tick_params(axis="z", pad=14)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5))
    axes.view_init(elev=-40 if from_below else 40, azim=-60)
    axes.set_title("from below: lenses look toward -z" if from_below else "open toward +z, as it is printed")


def _printable(name: str) -> str:
    return "".join(c for c in name if " " <= c <= "~").replace("$", r"\$")
