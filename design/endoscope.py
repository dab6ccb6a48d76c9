"""Write `endoscope-start.toml`, the initial design of the endoscope's study: `python design/endoscope.py`.

The file is in `experiments/designs`.
"""

from pathlib import Path

from gs_jax.design.design import ArrayTable, Design, ImagingTable, LensTable, SensorTable, write_design
from gs_jax.microscope.layouts import random_layout

STARTS = Path(__file__).parents[1] / "experiments" / "designs"
SIZE = (4.4, 4.4)


def main() -> None:
    """Write 60 lenses over a sensor of 5 mm, with a rough guess of the distances."""
    centers = random_layout(60, SIZE, diameter=None, seed=0).round(4).tolist()
    design = Design(
        name="endoscope-start",
        sensor=SensorTable(pixel_pitch_um=2.2, shape=(2272, 2272)),
        lens=LensTable(radius_of_curvature_mm=0.5, refractive_index=1.43, aperture_diameter_mm=0.3),
        array=ArrayTable(size_mm=SIZE, substrate_thickness_mm=0.5, centers_mm=tuple(map(tuple, centers))),
        imaging=ImagingTable(
            sensor_distance_mm=1.4, working_distance_mm=(5.0, 6.5), wavelength_nm=520.0, field_radius_mm=0.9
        ),
        provenance={"note": "a guess, to be optimised with design/studies/endoscope.toml"},
    )
    write_design(STARTS / "endoscope-start.toml", design)


if __name__ == "__main__":
    main()
