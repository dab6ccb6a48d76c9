"""From a design to a file that can be printed, with its report: checks before it is written, measurements after."""

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..base.progress import Progress
from ..designs.design import Design
from ..io.disk import atomic_write, check_output, write_json, write_text
from .caps import facet_surface
from .checks import (
    Finding,
    array_volume,
    check_design,
    check_solid,
    mold_volume,
    plain,
    refuse_errors,
    volume_tolerance,
)
from .measurement import Verification, quality, verify
from .mesh_files import MESH_SUFFIXES, Mesh, printable, read_mesh, write_mesh
from .pictures import preview
from .solids import MoldShape, mold_solid, plate_thickness, solid_of

# What a part must keep of its design: far below what a calibration of the assembled microscope corrects.
CENTER_TOLERANCE = 1e-3
RADIUS_TOLERANCE = 1e-3
# The Strehl ratio of what counts as a perfect surface, Marechal's criterion.
GOOD_STREHL = 0.8


@dataclass(frozen=True)
class Order:
    """What to make of a design.

    Parameters
    ----------
    positive
        The array itself, rather than its mold.
    shape
        Of the mold. Its shrinkage is made up for in the array too.
    chord
        The largest distance between a facet and its sphere, mm.
    resolution
        The smallest feature that the printer makes, mm.
    """

    positive: bool = False
    shape: MoldShape = MoldShape()
    chord: float = 5e-4
    resolution: float = 0.025

    @property
    def part(self) -> str:
        return "array" if self.positive else "mold"


def make_part(
    design: Design, output: str | os.PathLike[str], order: Order = Order(), progress: Progress | None = None
) -> dict[str, Any]:
    """Writes the mold or the array of a design, and beside it a picture (.png) and a report (.json, .txt).

    The file is read back and its lenses are measured.

    Parameters
    ----------
    design
        The microscope.
    output
        `.stl` or `.3mf`.
    order
        What to make of it.
    progress
        Shows how far it is.

    Returns
    -------
    dict
        The report, as in the JSON file.

    Raises
    ------
    InputError
        If a file cannot be written, or the design cannot be made, before anything is written.
    RuntimeError
        If the solid, or what was read back, is not the design: a fault of the program.
    """
    progress = progress or Progress()
    path = check_output(output, MESH_SUFFIXES)
    beside = {suffix: check_output(path.with_suffix(suffix), [suffix]) for suffix in (".png", ".json", ".txt")}
    findings = check_design(design, order.shape, chord=order.chord, resolution=order.resolution)
    refuse_errors(findings, f"design {design.name!r}")
    imager = design.imager()
    array = imager.array
    surface = facet_surface(array, order.chord, progress)
    with progress.step("Building and checking the solid"):
        part = solid_of(surface, plate_thickness(array))
        solid = part.scale([order.shape.scale] * 3) if order.positive else mold_solid(array, part, order.shape)
        expected = _expected_volume(array, order)
        mesh = printable(solid)
        findings += check_solid(mesh, expected, order.part, volume_tolerance(array, order.chord))
        _stop_at_fault(findings)
    # A part that is not the design does not get its name.
    with progress.step("Writing and measuring"), atomic_write(path) as temporary:
        write_mesh(temporary, mesh, f"{design.name} {order.part}")
        found = verify(read_mesh(temporary), array, scale=order.shape.scale)
        measured = quality(found, imager)
        findings += judge(measured, chord=order.chord, radius=design.lens.radius_of_curvature_mm)
        _stop_at_fault(findings)
    report = _report(design, order, path, mesh, expected, findings, measured, found)
    with progress.step("Drawing"), atomic_write(beside[".png"]) as temporary:
        figure = preview(array, None if order.positive else order.shape, design.name)
        figure.savefig(temporary, format="png", dpi=110)
    write_json(beside[".json"], report)
    write_text(beside[".txt"], words(report), [".txt"])
    return report


def _expected_volume(array, order: Order) -> float:
    if order.positive:
        return order.shape.scale**3 * array_volume(array)
    return mold_volume(array, order.shape)


def _stop_at_fault(findings: list[Finding]) -> None:
    for finding in findings:
        if finding.level == "error":
            raise RuntimeError(f"{finding.check}: {finding.text}")


def judge(measured: dict[str, Any], *, chord: float, radius: float) -> list[Finding]:
    """What was measured, in words, against what a part must keep of its design; chord error and radius in mm."""
    missing = measured["lenses_not_measured"]
    center, larger = measured["center_deviation_max_um"], measured["radius_deviation_max_percent"]
    # Coarse facets have vertices that are lifted, by less than the chord error.
    kept = center <= 1000 * CENTER_TOLERANCE and larger <= 100 * max(RADIUS_TOLERANCE, chord / radius)
    text = f"read back, lenses are within {center:.2g} um of their places and {larger:.2g} % of their radius."
    findings = [Finding("lenses", "ok" if kept else "error", text)]
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


def _report(design, order: Order, path: Path, mesh: Mesh, expected, findings, measured, found: Verification):
    array = design.imager().array
    size = mesh.vertices.max(axis=0).astype(float) - mesh.vertices.min(axis=0)
    centers = np.asarray(array.centers, float)
    return {
        "design": design.name,
        "part": order.part,
        "file": path.name,
        "unit": "mm",
        "frame": "x, y as the sensor's, z toward the object; plano face at z = 0, lenses toward -z",
        "size_mm": size.round(6).tolist(),
        "facets": len(mesh.facets),
        "file_bytes": path.stat().st_size,
        "volume_mm3": mesh.solid().volume(),
        "analytic_volume_mm3": expected,
        "chord_um": 1000 * order.chord,
        "printer_resolution_um": 1000 * order.resolution,
        "shrinkage_percent": 100 * order.shape.shrinkage,
        "draft_deg": math.degrees(order.shape.draft),
        "checks": plain(findings),
        "verification": measured,
        "lens_center_deviation_um": (1000 * (found.center - centers)).tolist(),
        "lens_radius_mm": found.radius.tolist(),
        "lens_surface_error_rms_um": (1000 * found.surface_rms).tolist(),
    }


def words(report: dict[str, Any]) -> str:
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
