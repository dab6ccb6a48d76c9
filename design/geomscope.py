"""Write `geomscope.toml` (in focus) and `geomscope-table1.toml` (as printed): `python design/geomscope.py`.

The second is in `experiments/designs`.
"""

from pathlib import Path

from gs_jax.design.design import write_design
from gs_jax.design.start import geomscope

HERE = Path(__file__).parent
STARTS = HERE.parent / "experiments" / "designs"


def main() -> None:
    """Write both designs, which differ in the sensor distance only."""
    paper = "Tian, Hu, Yang: GEOMScope, Table 1; layout: gs_jax.random_layout, seed 0"
    for folder, name, distance, note in (
        (HERE, "geomscope", 5.8, "sensor where traced rays from 20 mm are sharpest"),
        (STARTS, "geomscope-table1", 4.0, "sensor distance as printed: a point at 20 mm is out of focus"),
    ):
        design = geomscope(sensor_distance_mm=distance)
        design = design.model_copy(update={"name": name, "provenance": {"source": paper, "note": note}})
        write_design(folder / f"{name}.toml", design)


if __name__ == "__main__":
    main()
