"""Change one thing of the paper's microscope at a time, and judge the volumes as `design_judge` does.

The changes are a narrower aperture, spots as sharp as a search makes them, conics with the curved side facing the
object, fewer lenses, and a smaller image. The numbers of the second, third and last are of searches for the least
`psf_width_um` with the others fixed.

    python -m experiments.design_changes [--rays 10000] [--records FILE]

Writes the records after each scene, from which the next run goes on, and then `design_changes.md`; about 20 minutes on
two cores.
"""

from pathlib import Path

import numpy as np

from experiments.common import Report, main, table
from experiments.design_judge import Judge, Settings, rows_of
from gs_jax import Design, geomscope
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.progress import Progress
from gs_jax.io.files import make_folder

CHANGES = {
    "narrow aperture": {"aperture_diameter_mm": 1.2},
    "sharp spots": {"aperture_diameter_mm": 0.574, "sensor_distance_mm": 5.801},
    "curved side": {
        "orientation": "curved",
        "aperture_diameter_mm": 1.2,
        "radius_of_curvature_mm": 2.056,
        "conic_constant": -0.224,
        "sensor_distance_mm": 5.303,
    },
    "smaller image": {"sensor_distance_mm": 3.8, "radius_of_curvature_mm": 1.578, "aperture_diameter_mm": 1.31},
}
# Factor of the pitch for fewer lenses: half as many.
SPREAD = 1.4


def fewer_lenses(design: Design) -> Design:
    """The layout spread by a factor, without the lenses that come to lie beyond the plate."""
    centers = SPREAD * np.array(design.array.centers_mm)
    assert design.array.size_mm is not None
    return design.replace(centers_mm=centers[(np.abs(centers) < np.array(design.array.size_mm) / 2).all(1)].tolist())


def report(rays: int, records: Path, progress: Progress) -> Report:
    start = geomscope()
    designs = {start.name: start, "fewer lenses": fewer_lenses(start)}
    designs |= {name: start.replace(**change) for name, change in CHANGES.items()}
    make_folder(records.parent)
    judge = Judge(records, Settings(rays=rays), start.imager())
    found = {name: judge.judge(name, design.imager(), range(1), progress) for name, design in designs.items()}
    columns, rows = rows_of(found, judge.settings)
    return Report({"design_changes.md": markdown_table(columns, rows)}, [table(columns, rows)])


if __name__ == "__main__":
    main(
        report,
        {
            "--rays": {"type": int, "default": Settings().rays},
            "--records": {"type": Path, "default": Path("out/design_changes/records.json")},
        },
    )
