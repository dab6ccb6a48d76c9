"""Errors of molds for the paper's array: facets, and positions and shapes of the lenses.

The array and its mold are made for several chord errors, written as STL, read back and measured: volume, positions,
radii and conic constants of the lenses, and the wavefront error of the facets. The same follows for lenses that all
differ in radius, conic constant and aperture. Without the authors' centres the built-in layout is used.

    python -m experiments.mold_check [--out DIR]
"""

import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.common import Report, main, tables_report
from gs_jax import Design, Imager, Progress, geomscope, read_design
from gs_jax.mold.export import float32_mesh, read_mesh, write_mesh
from gs_jax.mold.lenslets import Part
from gs_jax.mold.measurement import measure_lenslets, summarize
from gs_jax.mold.solids import (
    MoldShape,
    array_solid,
    array_volume,
    cast_solid,
    engraving_tools,
    mold_bounds,
    mold_solid,
    mold_volume,
)

CENTERS = Path(__file__).parents[2] / "shared/data/oracle/dev/P1.toml"
CHORDS_UM = (0.2, 0.5, 1.0, 2.0, 5.0)


def run(design: Design, chords_um: Sequence[float] = CHORDS_UM, progress: Progress | None = None) -> list[dict]:
    """Return one record per chord error."""
    items = chords_um if progress is None else progress.track(chords_um, "Chord errors")
    return [measure(design.imager(), chord_um, design.name) for chord_um in items]


def differing(imager: Imager) -> Imager:
    """The same microscope with lenses that all differ: random radii, conic constants and apertures."""
    array, random = imager.array, np.random.default_rng(0)
    draw = lambda low, high: random.uniform(low, high, len(array.centers))
    numbers = {
        "radius_of_curvature": np.asarray(array.of_lenses("radius_of_curvature")) * draw(0.9, 1.1),
        "conic_constant": draw(-1.0, 0.0),
        "aperture_diameter": np.asarray(array.of_lenses("aperture_diameter")) * draw(0.6, 1.0),
    }
    return dataclasses.replace(imager, array=dataclasses.replace(array, **numbers))


def measure(imager: Imager, chord_um: float, label: str = "") -> dict:
    """Make the array and the mold at one chord error, write, read back and measure."""
    part, shape = Part(imager.array), MoldShape(label=label)
    array = array_solid(part, chord_um / 1000)
    mold = mold_solid(part, array, shape)
    meshes = []
    with tempfile.TemporaryDirectory() as folder:
        for solid in (array, mold):
            write_mesh(path := Path(folder) / "part.stl", float32_mesh(solid), "part")
            meshes.append(read_mesh(path))
    volumes = [mesh.solid().volume() for mesh in meshes]
    block = float(np.prod(np.diff(mold_bounds(part, shape), axis=0)))
    engraved = sum(tool.trim_by_plane([0, 0, -1], 0).volume() for tool in engraving_tools(part, shape))
    cast = cast_solid(part, array, shape).volume()
    numbers = summarize(measure_lenslets(meshes[1], part), imager)
    return {
        "chord_um": chord_um,
        "facets": len(meshes[0].facets),
        "array_volume_error": volumes[0] / array_volume(part) - 1,
        "mold_volume_error": volumes[1] / mold_volume(part, shape) - 1,
        "block_filled_error": (volumes[1] + volumes[0] + engraved) / block - 1,
        "cast_is_array_error": cast / array.volume() - 1,
        **numbers,
    }


COLUMNS = {
    "chord_um": ("chord error, um", "{:g}"),
    "facets": ("facets", "{:,}"),
    "array_volume_error": ("array's volume, off", "{:.1e}"),
    "mold_volume_error": ("mold's volume, off", "{:.1e}"),
    "block_filled_error": ("block filled, off", "{:.1e}"),
    "center_deviation_max_um": ("centres within, um", "{:.1e}"),
    "radius_deviation_max_percent": ("radii within, %", "{:.4f}"),
    "conic_deviation_max": ("conic constants within", "{:.1e}"),
    "surface_error_rms_um": ("surface, um RMS", "{:.4f}"),
    "wavefront_error_rms_waves": ("waves RMS", "{:.4f}"),
    "strehl_of_facets_median": ("Strehl ratio", "{:.3f}"),
}


def report(progress: Progress) -> Report:
    design = read_design(CENTERS) if CENTERS.exists() else geomscope()
    records = run(design, progress=progress)
    others = [
        measure(differing(design.imager()), chord_um) for chord_um in progress.track((0.5, 2.0), "Unequal lenses")
    ]
    titles, results = [title for title, _ in COLUMNS.values()], {"alike": records, "unequal": others}
    row = lambda record: [form.format(record[key]) for key, (_, form) in COLUMNS.items()]
    return tables_report("mold", results, *((titles, [row(record) for record in part]) for part in results.values()))


if __name__ == "__main__":
    main(report, folder="mold")
