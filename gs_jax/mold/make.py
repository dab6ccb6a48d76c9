"""From a design to a printable file with a picture and a report: checked before it is written, measured after."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import manifold3d as m3
import numpy as np
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..base.errors import InputError
from ..base.progress import Progress
from ..base.typing import PathLike
from ..design.conversion import AIR
from ..design.design import Design
from ..io.files import atomic_write, check_output, side_file, write_figure, write_json, write_text
from ..io.provenance import KEY, Provenance
from .export import MESH_SUFFIXES, check_mesh_reader, float32_mesh, read_mesh, write_mesh
from .lenslets import Part
from .manufacturability import CheckResult, check_design, check_solid, open_design, raise_first_error
from .measurement import measure_lenslets, summarize
from .solids import MoldShape, array_solid, array_volume, mold_solid, mold_volume, preview_solid, volume_tolerance

# Deviations from the design that are accepted, mm, relative, absolute: far below what calibration corrects.
CENTER_TOLERANCE, RADIUS_TOLERANCE, CONIC_TOLERANCE = 1e-3, 1e-3, 1e-2
# Strehl ratio of a surface that counts as perfect, Marechal's criterion.
GOOD_STREHL = 0.8
# Frames of parts, by the side of the lenses that faces the object.
_FRAMES = {
    "plano": "x, y as the sensor's, z toward the object; plano face (object's side) at z = 0, lenses toward -z",
    "curved": "x as the sensor's, y against it, z toward the sensor: turned over about x; "
    "plano face (sensor's side) at z = 0, lenses toward -z",
}
# Pixels of the height map in the picture, and the color of solids.
_MAP_PIXELS, _COLOR = 700, (0.78, 0.86, 0.95)


def make_mold(
    design: Design | PathLike,
    path: PathLike,
    *,
    positive: bool = False,
    shape: MoldShape = MoldShape(),
    chord: float | None = None,
    resolution: float = 0.025,
    layer: float | None = None,
    provenance: Provenance | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Writes the mold of a design, or the array, for printing, with a picture and a report.

    *File.*

    The file is read back and its lenses are measured.

    Parameters
    ----------
    design
        The microscope, or its file.
    path
        `.stl` or `.3mf`.
    positive
        Writes the array instead of its mold.
    shape
        Body of the mold. Its shrinkage also enlarges the array.
    chord
        Chordal tolerance: the largest distance between a facet and the lens surface, mm. By default 0.4 um, or a
        hundredth of the height of the lowest lens if that is less.
    resolution
        Smallest feature that the printer makes, mm.
    layer
        Thickness of the printer's layers, mm, if it prints layers.
    provenance
        Metadata for 3MF and the report.
    progress
        Shows the steps; nothing by default.

    Returns
    -------
    dict
        The report, as in the JSON file.

    Raises
    ------
    InputError
        If a file cannot be read or written, or the design cannot be manufactured, before anything is written.
    RuntimeError
        If the solid, or the file that was read back, deviates from the design: an error of the program.

    Examples
    --------
    >>> from pathlib import Path
    >>> design = gs.geomscope().replace(centers_mm=[(-0.5, 0.1), (0.6, 0.0)], size_mm=(3.0, 3.0))
    >>> report = gs.make_mold(design, "mold.stl", chord=0.002)
    >>> sorted(path.name for path in Path().glob("mold.*"))
    ['mold.stl', 'mold.stl.json', 'mold.stl.png', 'mold.stl.txt']
    """
    progress = progress or Progress()
    path = check_output(path, MESH_SUFFIXES)
    check_mesh_reader(path)
    picture, record, text = (check_output(beside, [beside.suffix]) for beside in side_files(path))
    design, source = open_design(design)
    imager = design.imager(AIR)
    part = Part(imager.array)
    chord = part.default_chord if chord is None else chord
    checks = check_design(design, shape, chord=chord, resolution=resolution, layer=layer)
    raise_first_error(checks, InputError, source)
    name = "array" if positive else "mold"
    solid = array_solid(part, chord, progress=progress)
    with progress.step("Building and checking the solid"):
        solid = solid.scale([shape.scale] * 3) if positive else mold_solid(part, solid, shape)
        volume = shape.scale**3 * array_volume(part) if positive else mold_volume(part, shape)
        mesh = float32_mesh(solid)
        checks += check_solid(mesh, volume, name, volume_tolerance(part, chord))
        raise_first_error(checks, RuntimeError)
    # The temporary file gets its name only if it passes.
    with progress.step("Writing and measuring"), atomic_write(path) as temporary:
        write_mesh(temporary, mesh, f"{design.name} {name}", provenance)
        lenses = measure_lenslets(read_mesh(temporary), part, scale=shape.scale)
        summary = summarize(lenses, imager)
        if not summary["lenses_measured"]:
            text = f"the chord error must be finer, got {1000 * chord:g} um, which leaves each lens too few facets"
            raise InputError(f"{source}: {text} to be measured (--chord-um).")
        checks += check_measurement(summary, chord=chord, radius=min(lenslet.radius for lenslet in part.lenslets))
        raise_first_error(checks, RuntimeError)
    report = {
        "design": design.name,
        "part": name,
        "file": path.name,
        "unit": "mm",
        "frame": _FRAMES[part.array.orientation],
        "size_mm": np.ptp(mesh.vertices.astype(float), axis=0).round(6).tolist(),
        "facets": len(mesh.facets),
        "file_bytes": path.stat().st_size,
        "volume_mm3": mesh.solid().volume(),
        "analytic_volume_mm3": volume,
        "chord_um": 1000 * chord,
        "printer_resolution_um": 1000 * resolution,
        "shrinkage_percent": 100 * shape.shrinkage,
        "draft_deg": math.degrees(shape.draft),
        "checks": [asdict(check) for check in checks],
        "verification": summary,
        "lens_center_deviation_um": (1000 * (lenses.center - part.centers)).tolist(),
        "lens_radius_mm": lenses.radius.tolist(),
        "lens_conic_constant": lenses.conic.tolist(),
        "lens_surface_error_rms_um": (1000 * lenses.surface_rms).tolist(),
    }
    with progress.step("Drawing"):
        write_figure(picture, draw_preview(part, None if positive else shape, design.name))
    write_json(record, report | ({KEY: dict(provenance)} if provenance else {}))
    write_text(text, report_text(report), [".txt"])
    return report


def side_files(path: PathLike) -> list[Path]:
    """The picture, the report for programs and the one for people beside a mold."""
    return [side_file(path, suffix) for suffix in (".png", ".json", ".txt")]


def check_measurement(summary: dict[str, Any], *, chord: float, radius: float) -> list[CheckResult]:
    """Checks a summary of measured lenses against the tolerances; chordal tolerance and smallest radius in mm."""
    center, radius_error = summary["center_deviation_max_um"], summary["radius_deviation_max_percent"]
    conic_error, conics = summary["conic_deviation_max"], summary["lenses_conic_measured"]
    # Coarse facets have offset vertices, which changes the radius, and the conic constant of an asphere.
    passed = center <= 1000 * CENTER_TOLERANCE and radius_error <= 100 * max(RADIUS_TOLERANCE, 5 * chord / radius)
    text = f"read back, lenses are within {center:.2g} um of their places and {radius_error:.2g} % of their radius"
    if conics:
        uncertainty = summary["conic_uncertainty_max"]
        passed = passed and conic_error <= max(CONIC_TOLERANCE, 10 * chord / radius) + 3 * uncertainty
        text += f", conic constants of {conics} within {conic_error:.2g} (uncertain by {uncertainty:.1g} and less)"
    checks = [CheckResult("lenses", "ok" if passed else "error", f"{text}.")]
    if missing := summary["lenses_not_measured"]:
        text = f"{len(missing)} lenses have too few facets to be measured: {', '.join(map(str, missing[:10]))}."
        checks.append(CheckResult("lenses not measured", "warning", text))
    strehl = summary["strehl_of_facets_median"]
    text = f"facets alone leave a Strehl ratio of {strehl:.2f} ({summary['wavefront_error_rms_waves']:.3f} waves RMS)"
    if strehl >= GOOD_STREHL:
        return [*checks, CheckResult("facets' wavefront", "ok", f"{text}.")]
    # The error is proportional to the chordal tolerance, the logarithm of the Strehl ratio to its square.
    needed = 1000 * chord * math.sqrt(math.log(GOOD_STREHL) / math.log(max(strehl, 1e-300)))
    advice = f"{GOOD_STREHL} takes a chord error of {needed:.2g} um, or a polished mold"
    return [*checks, CheckResult("facets' wavefront", "warning", f"{text}; {advice}.")]


def report_text(report: dict[str, Any]) -> str:
    """The report as plain text."""
    size = " x ".join(f"{side:.4g}" for side in report["size_mm"])
    lines = [
        f"{report['design']}: {report['part']}, {report['file']}",
        f"{size} mm, {report['facets']:,} facets, {report['file_bytes'] / 1e6:.3g} MB, in mm.",
        f"Frame: {report['frame']}.",
        "",
        *(f"[{check['level']}] {check['check']}: {check['text']}" for check in report["checks"]),
    ]
    return "\n".join(lines) + "\n"


def draw_preview(part: Part, shape: MoldShape | None, name: str) -> Figure:
    """A height map of the lenses, and the mold of a shape, or the array if it is None, in perspective."""
    figure = Figure(figsize=(12, 5.6), dpi=110, layout="constrained")
    x, y = (np.linspace(-side / 2, side / 2, _MAP_PIXELS) for side in part.size)
    height, _ = part.surface(x, y)
    shaded = LightSource(azdeg=315, altdeg=50).hillshade(height, dx=x[1] - x[0], dy=y[1] - y[0])
    # In the frame of the part, but with the y of the design.
    from_sensor = part.array.orientation == "plano"
    bottom = y[-1] if from_sensor else y[0]
    axes = figure.add_subplot(1, 2, 1)
    image = axes.imshow(1000 * height, cmap="viridis", extent=(x[0], x[-1], bottom, -bottom), vmin=0)
    axes.imshow(shaded, cmap="gray", extent=(x[0], x[-1], bottom, -bottom), alpha=0.45)
    what = "array" if shape is None else "cavity of the mold, before shrinkage"
    axes.set(title=f"{what}, seen from the {'sensor' if from_sensor else 'object'}", xlabel="x, mm", ylabel="y, mm")
    figure.colorbar(image, ax=axes, label="height over the plate, um", shrink=0.85)
    view = figure.add_subplot(1, 2, 2, projection="3d")
    draw_solid(view, preview_solid(part, shape), from_below=shape is None)
    printable = "".join(c for c in name if " " <= c <= "~").replace("$", r"\$")
    figure.suptitle(f"{printable}: {'array' if shape is None else 'negative mold'}, {len(part.centers)} lenses")
    return figure


def draw_solid(axes, solid: m3.Manifold, *, from_below: bool) -> None:
    """Draws a solid to scale on axes of `projection="3d"`, seen from above or below."""
    # Matplotlib sorts facets by depth, which needs facets of similar size.
    extent = float(np.ptp(np.reshape(solid.bounding_box(), (2, 3)), axis=0).max())
    mesh = solid.refine_to_length(extent / 30).to_mesh64()
    vertices = mesh.vert_properties[:, :3]
    # Light from the upper left of the picture; otherwise cavities look like bumps.
    light = LightSource(azdeg=180, altdeg=-19) if from_below else LightSource(azdeg=270, altdeg=54)
    axes.plot_trisurf(*vertices.T, triangles=mesh.tri_verts, color=_COLOR, lightsource=light, linewidth=0.3)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]), xlabel="x, mm", ylabel="y, mm")
    axes.set_zticks([low[2], high[2]], [f"{low[2]:.3g}", f"z = {high[2]:.3g} mm"])
    axes.set_box_aspect(high - low, zoom=1.0)
    axes.tick_params(axis="z", pad=14)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5))
    axes.view_init(elev=-40 if from_below else 40, azim=-60)
    axes.set_title("from below: lenses look toward -z" if from_below else "open toward +z, as it is printed")
