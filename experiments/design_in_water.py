"""What a filter, a window and a sample in water cost a design: `geomscope-exposure`, and its search again with them.

A filter of 2 mm (1.52) on the array, a window of 0.55 mm (1.51) 0.6 mm above the sensor, and a cover slip of 0.17 mm
(1.523) on water (1.333), which begins at 17.5 mm. Rows: the design in air; the same lenses with the layers; the result
of the same study, which starts from `geomscope` with the layers. Depths are 18, 20.5 and 23 mm.

    python -m experiments.design_in_water [--out DIR]

Writes `water.json` and `water.md`; about two minutes of processor time.
"""

import numpy as np

from experiments.common import DESIGNS, Report, design_file, main, table
from gs_jax import Design, objectives, read_design, read_study, run_study
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.progress import Progress
from gs_jax.codesign.terms import TERMS
from gs_jax.design.datasheets import datasheet
from gs_jax.objectives import Conditions

DEPTHS = (18.0, 20.5, 23.0)
LAYERS = {
    "object": [{"name": "filter", "thickness_mm": 2.0, "refractive_index": 1.52}],
    "sensor": [{"thickness_mm": 0.6}, {"name": "window", "thickness_mm": 0.55, "refractive_index": 1.51}],
}
WATER = {
    "refractive_index": 1.333,
    "surface_mm": 17.5,
    "layers": [{"name": "cover slip", "thickness_mm": 0.17, "refractive_index": 1.523}],
}


def run(progress: Progress) -> dict[str, dict]:
    """The numbers of each design."""
    air = read_design(design_file("geomscope-exposure"))
    start = read_design(design_file("geomscope")).replace(name="geomscope-water", layers=LAYERS, sample=WATER)
    study = read_study(DESIGNS / "studies" / "geomscope-exposure.toml")
    found = run_study(start, study.model_copy(update={"name": "geomscope-exposure-water"}), progress=progress).design
    designs = {
        "in air": air,
        "the same lenses, with the layers": air.replace(layers=LAYERS, sample=WATER),
        "searched again": found,
    }
    return {name: _numbers(design, study.exposure) for name, design in designs.items()}


def _numbers(design: Design, exposure: float) -> dict:
    imager, at = design.imager(), Conditions(DEPTHS, exposure=exposure)
    sheet = datasheet(design, list(DEPTHS))
    return {
        "sensor_distance_mm": design.imaging.sensor_distance_mm,
        "conic_constant": design.lens.conic_constant,
        "volume_error": float(TERMS["volume_error"].function(imager, at)),
        "spot_width_um": sheet["spot_width_um"],
        "axial_resolution_um": sheet["axial_resolution_um"],
        "light_percent": (100 * np.asarray(objectives.light(imager, DEPTHS))).tolist(),
        "thickness_mm": float(objectives.thickness(imager)),
    }


def report(progress: Progress) -> Report:
    results = run(progress)
    columns = ("", *results)
    rows = [
        [label, *(" / ".join(f"{x:{form}}" for x in np.ravel(row[name])) for row in results.values())]
        for label, name, form in (
            ("sensor distance v, mm", "sensor_distance_mm", ".3f"),
            ("conic constant", "conic_constant", ".3f"),
            ("error of volumes, of the scene's energy", "volume_error", ".4f"),
            ("2.355 times the RMS width of the spot, um", "spot_width_um", ".0f"),
            ("axial resolution, Eq. 6, um", "axial_resolution_um", ".0f"),
            ("light used, %", "light_percent", ".3f"),
            ("from the filter's face to the sensor, mm", "thickness_mm", ".2f"),
        )
    ]
    text = "# A design in water\n\n" + markdown_table(columns, rows) + "\n"
    return Report({"water.json": results, "water.md": text}, [table(columns, rows)])


if __name__ == "__main__":
    main(report)
