"""Table 1: the paper's design parameters and performance, our values beside them, and reasons for differences.

Our values are computed for the same lens with the sensor at the printed 4 mm, and at 5.8 mm, where it is in focus.

    python -m experiments.table1 [--out DIR]
"""

import numpy as np
from scipy.optimize import root_scalar
from scipy.spatial import KDTree

from experiments.common import Report, main, tables_report
from gs_jax import Design, Progress, geomscope, objectives
from gs_jax.design.datasheets import datasheet
from gs_jax.microscope.layouts import nearest_neighbour_distances
from gs_jax.optics import aberrations, theory

COLUMNS = ("what", "paper", "printed: v = 4 mm", "focused: v = 5.8 mm", "why")
# Range of depths in the paper's simulations and experiments, mm.
DEPTHS = (18.0, 20.0, 30.0)


def run() -> dict[str, list[dict[str, str]]]:
    """Return the rows of the table, and the numbers of the conflicts that they name."""
    printed, focused = geomscope(sensor_distance_mm=4.0), geomscope(sensor_distance_mm=5.8)
    sheets = [datasheet(design, DEPTHS) for design in (printed, focused)]
    rows = [*_given(printed, focused), *_performance((printed, focused), sheets), *_depth_of_field(printed)]
    return {"table": [dict(zip(COLUMNS, row, strict=True)) for row in rows], "conflicts": _conflicts(printed)}


def _given(printed: Design, focused: Design) -> list[tuple[str, ...]]:
    centers = np.array(printed.array.centers_mm)
    distances = nearest_neighbour_distances(centers)
    pitch = f"{distances.mean():.2f} mm (SD {distances.std():.2f})"
    f = float(printed.imager().array.focal_length)
    same = lambda value: (value, value)
    size = "{:g} x {:g} mm".format(*printed.array.size_mm)
    return [
        ("working distance", "18-30 mm", *same("18-30 mm"), ""),
        ("sensor distance v", "~4 mm", "4.0 mm", "5.8 mm", "at 4 mm the image of 20 mm forms 2.0 mm behind the sensor"),
        ("lens array", "20 x 20 mm", *same(size), ""),
        ("number of lenses", "200", *same(str(len(centers))), "the authors' file of centres holds 213"),
        ("average pitch", "1.23 mm (SD 0.09)", *same(pitch), "the mean distance of nearest neighbours"),
        ("focal length", "~4.65 mm", *same(f"{f:.2f} mm"), "R / (n - 1)"),
        ("refractive index", "1.43", *same(f"{printed.lens.refractive_index}"), ""),
        ("radius of curvature", "2 mm", *same(f"{printed.lens.radius_of_curvature_mm:g} mm"), ""),
        ("pixel", "4.5 um", *same(f"{printed.sensor.pixel_pitch_um:g} um"), ""),
        ("wavelength", "500-530 nm", *same(f"{printed.imaging.wavelength_nm:g} nm"), ""),
        ("field of one lens, diameter", "~6 mm", *same(f"{2 * printed.imaging.field_radius_mm:g} mm"), "given"),
    ]


def _performance(designs: tuple[Design, ...], sheets: list[dict]) -> list[tuple[str, ...]]:
    def span(key, form, sheet):
        low, high = min(sheet[key]), max(sheet[key])
        return format(low, form) if np.isclose(low, high) else f"{low:{form}}-{high:{form}}"

    def object_blur(sheet):
        middle = sheet["depth_mm"].index(20.0)
        return f"{sheet['blur_um'][middle] / sheet['magnification'][middle] / 1000:.2f} mm"

    both = lambda key, form, unit="": tuple(f"{span(key, form, sheet)}{unit}" for sheet in sheets)
    field = [objectives.field_of_view(design.imager(), DEPTHS) for design in designs]
    return [
        ("lenses per point N_e", "15-20", *both("lenses_per_point", ".0f"), "density times A_e"),
        ("magnification", "0.10-0.15", *both("magnification", ".2f"), "v/z' gives 0.13-0.21 for the printed numbers"),
        ("lateral resolution", "~40 um", *both("lateral_resolution_um", ".0f", " um"), "Eq. 5: pixel / M, in focus"),
        ("axial resolution", "~300 um", *both("axial_resolution_um", ".0f", " um"), "Eq. 6"),
        (
            "field of view",
            "~23 x 23 mm",
            *(f"{float(w.min()):.0f} mm" for w in field),
            "sensor size; ours: seen at all",
        ),
        ("occupancy V", "~0.4", *both("occupancy", ".2f"), "Eq. 11; 0.4 takes N_e = 20 and M = 0.15"),
        (
            "numerical aperture",
            "~0.13",
            *(f"{sheet['numerical_aperture']:.2f}" for sheet in sheets),
            "area of the Voronoi cell; 0.13 takes the pitch for the diameter",
        ),
        ("blur at 20 mm, in the object", "-", *(object_blur(sheet) for sheet in sheets), "thin lens"),
    ]


def _depth_of_field(design: Design) -> list[tuple[str, ...]]:
    """Depth of field at 20 mm. Eqs. 7 and 8 do not use the sensor distance, and the paper leaves the diameter open."""
    rows = []
    for what, diameter in _diameters(design).items():
        lens = _lens(design, diameter)
        results = ", ".join(
            _depths_of_field(lens, circle_of_confusion) for circle_of_confusion in (0.009, 0.018, 0.036)
        )
        rows.append((f"depth of field at 20 mm, {what}", "~5 mm", results, results, "by confusion: Eq. 8 (Eq. 7)"))
    return rows


def _depths_of_field(lens: tuple[float, float, float], circle_of_confusion: float) -> str:
    f, z, f_number = lens
    exact = theory.depth_of_field(f, f_number, z, circle_of_confusion)
    printed = theory.approximate_depth_of_field(f, f_number, z, circle_of_confusion)
    return f"{1000 * circle_of_confusion:g} um: {exact:.2f} ({printed:.2f}) mm"


def _diameters(design: Design) -> dict[str, float]:
    sheet = datasheet(design, [20.0])
    clear, pitch = sheet["focal_length_mm"] / sheet["f_number"], sheet["pitch_mm"]
    return {
        "D = 2 mm as printed": float(design.imager().array.aperture_diameter),
        f"D = {clear:.2f} mm, clear": clear,
        f"D = {pitch:.2f} mm, pitch": pitch,
    }


def _lens(design: Design, diameter: float) -> tuple[float, float, float]:
    """Focal length, depth and F-number for the formulas, without the plate."""
    f = float(design.imager().array.focal_length)
    return f, 20.0, f / diameter


def _conflicts(design: Design) -> list[dict[str, str]]:
    """Values that the paper's numbers would need."""
    facts = []
    for what, diameter in _diameters(design).items():
        needed = _confusion_for(5.0, _lens(design, diameter))
        value = f"{1000 * needed:.0f} um, {needed / 0.0045:.1f} pixels"
        facts.append((f"confusion for a depth of field of 5 mm by Eq. 7, {what}", value))
    f, z, _ = _lens(design, 1.0)
    image = float(theory.focus_distance(f, z))
    pupil = datasheet(design, [z])["numerical_aperture"] * f
    wave = aberrations.linear_rms(aberrations.seidel(f, 1.43, pupil, z, 0.0, image)) / 520e-6
    facts += [
        ("thin-lens image of 20 mm (plate left out)", f"{image:.2f} mm"),
        ("depth at which v = 4 mm magnifies 0.15", f"{4 / 0.15:.0f} mm"),
        ("wavefront error at the paraxial image", f"{float(wave):.1f} waves RMS: Eq. 9 holds below 0.1"),
        ("lenses within 3 mm of a point, counted", _counted(design)),
    ]
    return [dict(zip(("what", "value"), fact, strict=True)) for fact in facts]


def _confusion_for(depth_of_field: float, lens: tuple[float, float, float]) -> float:
    f, z, f_number = lens
    excess = lambda c: float(theory.approximate_depth_of_field(f, f_number, z, c)) - depth_of_field
    return root_scalar(excess, bracket=(1e-3, 0.1)).root


def _counted(design: Design) -> str:
    """Counted lenses per point, away from the edge, where each point has its whole field."""
    side = np.linspace(-7, 7, 57)
    points = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    tree, radius = KDTree(np.array(design.array.centers_mm)), design.imaging.field_radius_mm
    counts = tree.query_ball_point(points, radius, return_length=True)
    return f"{counts.min()}-{counts.max()}, mean {counts.mean():.1f}"


def report(progress: Progress) -> Report:
    with progress.step("Datasheets"):
        results = run()
    tables = ((list(rows[0]), [list(row.values()) for row in rows]) for rows in results.values())
    return tables_report("table1", results, *tables)


if __name__ == "__main__":
    main(report)
