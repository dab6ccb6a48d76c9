"""Errors of molds for the paper's array: facets, and positions and shapes of the lenses.

The array and its mold are made for several chord errors, written as STL, read back and measured: volume, positions,
radii and conic constants of the lenses, and the wavefront error of the facets. The same follows for lenses that all
differ in radius, conic constant and aperture. Without the authors' centres the built-in layout is used.

    python -m experiments.mold_check [--out DIR]
"""

import dataclasses
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.common import Report, main, table
from gs_jax import Imager
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.progress import Progress
from gs_jax.design.design import Design, read_design
from gs_jax.design.start import geomscope
from gs_jax.mold.export import Mesh, float32_mesh, read_mesh, write_mesh
from gs_jax.mold.lenslets import Part
from gs_jax.mold.make import draw_solid
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
    each = {
        "radius_of_curvature": np.asarray(array.of_lenses("radius_of_curvature")) * draw(0.9, 1.1),
        "conic_constant": draw(-1.0, 0.0),
        "aperture_diameter": np.asarray(array.of_lenses("aperture_diameter")) * draw(0.6, 1.0),
    }
    return dataclasses.replace(imager, array=dataclasses.replace(array, **each))


def measure(imager: Imager, chord_um: float, label: str = "") -> dict:
    """Make the array and the mold at one chord error, write, read back and measure."""
    part, shape = Part(imager.array), MoldShape(label=label)
    started = time.perf_counter()
    array = array_solid(part, chord_um / 1000)
    made = time.perf_counter() - started
    mold = mold_solid(part, array, shape)
    with tempfile.TemporaryDirectory() as folder:
        meshes = [_through_file(solid, Path(folder) / "part.stl") for solid in (array, mold)]
    volumes = [mesh.solid().volume() for mesh in meshes]
    block = float(np.prod(np.diff(mold_bounds(part, shape), axis=0)))
    engraved = sum(tool.trim_by_plane([0, 0, -1], 0).volume() for tool in engraving_tools(part, shape))
    cast = cast_solid(part, array, shape).volume()
    numbers = summarize(measure_lenslets(meshes[1], part), imager)
    return {
        "chord_um": chord_um,
        "facets": len(meshes[0].facets),
        "seconds": made,
        "array_volume_error": volumes[0] / array_volume(part) - 1,
        "mold_volume_error": volumes[1] / mold_volume(part, shape) - 1,
        "block_filled_error": (volumes[1] + volumes[0] + engraved) / block - 1,
        "cast_is_array_error": cast / array.volume() - 1,
        **numbers,
    }


def _through_file(solid, path: Path) -> Mesh:
    write_mesh(path, float32_mesh(solid), "part")
    return read_mesh(path)


def draw(design: Design, records: list[dict]) -> Figure:
    """Plot the mold, facets of a few lenses, and the errors of the facets."""
    part = Part(design.imager().array)
    figure = Figure(figsize=(15, 4.6), dpi=110, layout="constrained")
    view = figure.add_subplot(1, 3, 1, projection="3d")
    shape = MoldShape(label=design.name)
    draw_solid(view, mold_solid(part, array_solid(part, 4e-3), shape), from_below=False)
    view.set_title(f"mold of {len(part.centers)} lenses")
    _draw_facets(figure.add_subplot(1, 3, 2), part)
    axes = figure.add_subplot(1, 3, 3)
    _draw_cost(axes, records)
    return figure


def _draw_facets(axes, part: Part) -> None:
    mesh = float32_mesh(array_solid(part, 2e-3))
    x, y, z = mesh.vertices.T
    height = -part.plate_thickness - z
    corners = mesh.vertices[mesh.facets]
    shown = (np.abs(corners[..., :2]).max(axis=(1, 2)) < 2.2) & (corners[..., 2].max(axis=1) < 0)
    image = axes.tripcolor(x, y, mesh.facets[shown], 1000 * height, shading="gouraud", cmap="viridis")
    axes.triplot(x, y, mesh.facets[shown], color="white", linewidth=0.25)
    axes.set(xlim=(-1.8, 1.8), ylim=(1.8, -1.8), aspect="equal", xlabel="x, mm", ylabel="y, mm")
    axes.set_title("facets within 2 um of the lenses")
    axes.figure.colorbar(image, ax=axes, label="height over the plate, um", shrink=0.85)


def _draw_cost(axes, records: list[dict]) -> None:
    chord = [record["chord_um"] for record in records]
    strehl = [record["strehl_of_facets_median"] for record in records]
    axes.semilogx(chord, strehl, "o-")
    axes.axhline(0.8, color="gray", linewidth=0.8, linestyle="--")
    axes.set(xlabel="chord error, um", ylabel="Strehl ratio of the facets alone", ylim=(0, 1.02))
    axes.set_title("what facets cost")
    right = axes.twinx()
    right.semilogy(chord, [record["facets"] for record in records], "s--", color="C6")
    right.set_ylabel("facets", color="C6")
    axes.set_xticks(chord, [f"{value:g}" for value in chord])
    axes.set_xticks([], minor=True)


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


def rows(records: list[dict]) -> list[list[str]]:
    return [[form.format(record[key]) for key, (_, form) in COLUMNS.items()] for record in records]


def report(progress: Progress) -> Report:
    design = read_design(CENTERS) if CENTERS.exists() else geomscope()
    records = run(design, progress=progress)
    others = [
        measure(differing(design.imager()), chord_um) for chord_um in progress.track((0.5, 2.0), "Unequal lenses")
    ]
    titles, lines, unequal = [title for title, _ in COLUMNS.values()], rows(records), rows(others)
    text = "\n\n".join(markdown_table(titles, part) for part in (lines, unequal)) + "\n"
    data = {"mold.json": {"alike": records, "unequal": others}, "mold.md": text, "mold.png": draw(design, records)}
    return Report(data, [table(titles, lines), table(titles, unequal)])


if __name__ == "__main__":
    main(report, folder="mold")
