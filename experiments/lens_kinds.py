"""Sharpness against light, for plano or curved side facing the object, spheres or conics.

The search of `design/studies/lens-kinds.toml` minimises the width of the spot for each share of the light. Optiland's
rays over the field and the diffraction PSF, which the search does not use, evaluate the designs.

    python -m experiments.lens_kinds [--out DIR]

Writes `lens_kinds.json`, `lens_kinds.md`, `lens_kinds.png` and the designs; about half an hour on two cores.
"""

import math
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter

from experiments.common import Report, half_light_radius, main, tables_report
from experiments.optics_check import optiland_rays
from gs_jax import Design, Progress, read_design, read_study
from gs_jax.codesign.parameters import new_design
from gs_jax.codesign.pareto import sweep_of, trade_off
from gs_jax.codesign.study import Study
from gs_jax.design.design import design_text
from gs_jax.microscope.geometry import envelope
from gs_jax.optics.apertures import clear_diameter
from gs_jax.optics.psf import diffraction_psf
from gs_jax.optics.pupil import pupil_quadrature

FOLDER = Path(__file__).parents[1] / "design"
# Orientation, and whether the conic constant is free.
KINDS = {
    "plano side, sphere": ("plano", False),
    "plano side, conic": ("plano", True),
    "curved side, sphere": ("curved", False),
    "curved side, conic": ("curved", True),
}
DEPTHS = (18.0, 19.0, 20.0, 21.0, 22.0, 23.0)
# Field heights relative to its radius: middles of rings of equal area, different from those of the search.
HEIGHTS = np.sqrt((np.arange(6) + 0.5) / 6)
# Width of the PSF's window in which its width is measured, mm on the sensor.
WINDOW = 0.6


def initial_design(kind: str, study: Study, design: Design) -> tuple[Design, Study]:
    """Initial design and study of a lens type."""
    orientation, conic = KINDS[kind]
    lens = design.lens.model_copy(update={"orientation": orientation, "conic_constant": 0.0})
    free = {name: bounds for name, bounds in study.free.items() if conic or name != "conic_constant"}
    return design.model_copy(update={"lens": lens}), study.model_copy(update={"free": free})


def width_by_optiland(design: Design, depth: float) -> float:
    """FWHM of a Gaussian with the variance of Optiland's rays over the field, in the object, um."""
    imager = design.imager()
    points, weights = map(np.asarray, pupil_quadrature(clear_diameter(imager.array) / 2, 12))
    square, total = 0.0, 0.0
    for height in HEIGHTS * imager.field_radius:
        landing, _, _ = optiland_rays(imager, depth, points, float(height))
        seen = float(envelope(height**2, imager.reduced_depth(depth), imager.field_radius))
        off = landing - weights @ landing
        square += seen * float(weights @ (off**2).sum(1)) / 2
        total += seen
    return 1000 * math.sqrt(8 * math.log(2) * square / total) / float(imager.magnification(depth))


def core_by_diffraction(design: Design, depth: float) -> float:
    """Diameter of the circle about the PSF's peak that holds half of its light, in the object, um."""
    imager = design.imager()
    size = 2 * round(WINDOW / imager.sensor.pixel_pitch / 2) + 1
    radius = clear_diameter(imager.array) / 2
    psf = np.asarray(diffraction_psf(imager, depth, size=size, radius=radius, samples=6))
    row, column = np.unravel_index(int(psf.argmax()), psf.shape)
    y, x = np.indices(psf.shape)
    half = half_light_radius(np.hypot(y - row, x - column).ravel(), psf.ravel())
    return 2000 * half * imager.sensor.pixel_pitch / float(imager.magnification(depth))


def judged(design: Design) -> dict[str, Any]:
    """Evaluate a design by independent rays and diffraction; lengths in the object."""
    widths = [width_by_optiland(design, depth) for depth in DEPTHS]
    cores = [core_by_diffraction(design, depth) for depth in DEPTHS]
    return {"optiland_width_um": widths, "half_light_um": cores}


def run(study: Study, start: Design, kinds=tuple(KINDS), *, progress: Progress) -> dict[str, list[dict[str, Any]]]:
    """Return for each lens type one record per share of the light, with its `design`."""
    results = {}
    for kind in kinds:
        design, question = initial_design(kind, study, start)
        front = trade_off(design, question, progress=progress)
        sweep = sweep_of(design, question)
        results[kind] = []
        for limits, point, values in zip(question.pareto[0].targets, front.points, front.values, strict=True):
            made = new_design(design, sweep.problem.imager, sweep.problem.at, point.values)
            record = {"light_percent_at_least": limits, "light_percent": float(values[1]), "feasible": point.feasible}
            record |= {"width_um": float(values[0]), "design": made} | judged(made)
            results[kind].append(record)
    return results


def curves(results: dict[str, list[dict[str, Any]]]) -> Figure:
    """Plot the width at the worst depth against light."""
    axes = (figure := Figure(figsize=(6.4, 4.4), dpi=110, layout="constrained")).subplots()
    for kind, rows in results.items():
        light = [row["light_percent"] for row in rows]
        axes.loglog(light, [max(row["optiland_width_um"]) for row in rows], "o-", label=kind)
    axes.set(xlabel="share of a point's light at 23 mm, %", ylabel="width at the worst of 18 to 23 mm, um")
    for axis, ticks in ((axes.xaxis, (0.02, 0.05, 0.1, 0.2, 0.4)), (axes.yaxis, (30, 50, 100, 200, 300, 500))):
        axis.set_major_locator(FixedLocator(ticks))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def report(progress: Progress) -> Report:
    with jax.enable_x64(True):
        study = read_study(FOLDER / "studies" / "lens-kinds.toml")
        results = run(study, read_design(FOLDER / "geomscope-optimized.toml"), progress=progress)
    columns = ("lens", "light, %", "v, mm", "R, mm", "D, mm", "k", "width, um", "by Optiland", "half of the light, um")
    rows = []
    for kind, records in results.items():
        for record in records:
            design: Design = record["design"]
            lens = design.lens
            numbers = (record["light_percent"], design.imaging.sensor_distance_mm, lens.radius_of_curvature_mm)
            numbers += (lens.aperture_diameter_mm, lens.conic_constant, record["width_um"])
            numbers += (max(record["optiland_width_um"]), max(record["half_light_um"]))
            rows.append([kind, *(f"{number:.3g}" for number in numbers)])
    plain = {
        kind: [{**row, "design": design_text(row["design"])} for row in records] for kind, records in results.items()
    }
    return tables_report("lens_kinds", plain, (columns, rows), png=curves(results))


if __name__ == "__main__":
    main(report)
