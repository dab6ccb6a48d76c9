"""Quality against time: scenes of five kinds at three exposures, through the whole device, by each method and steps.

Beads, letters with bars, tilted sheets and texture are those of `design_judge`, twice as wide; blobs are 24 Gaussian
ones of 0.12 to 0.35 mm and two vessels. All lie within 12 mm by 12 mm by 3.6 mm before the paper's lenses and are
ray-traced through all of them onto the whole sensor, in pixels of 20 um. Voxels have 80 um, which the command takes by
default, and 13 planes. "dB" is above an empty volume, for a truth that is blurred by half a voxel. Seconds are of a
processor, of one call, without tables and compilation.

    python -m experiments.front [--kinds blobs,texture] [--exposures 40000,1200] [--draws 3] [--records FILE]

An exposure is the number of electrons in the brightest pixel. Writes the records after each image, from which the next
run goes on, then `front.json`, `front.md` and `front.png`; an hour and a half of a core for all.
"""

import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

import gs_jax as gs
from experiments.common import Report, main, names_of, read_records, tables_report
from experiments.design_judge import KINDS as JUDGED, Settings, make_scene
from experiments.ray_tracer import traced
from gs_jax.io.files import make_folder, write_json
from gs_jax.reconstruction.pipeline import METHODS

KINDS = ("blobs", *JUDGED)
EXPOSURES = (40_000, 6_000, 1_200)
# Steps of each method; the unrolled has its own.
STEPS = {"list-rl": (20,), "richardson-lucy": (5, 10, 20), "unrolled": (20,)}
RUNS = [(name, steps) for name, all_steps in STEPS.items() for steps in all_steps]
GRID = gs.Grid(18.2 + 0.3 * np.arange(13), (193, 193), 0.08)
SENSOR, RAYS, TILE = gs.Sensor((1024, 1024), 0.02), 60, 0.2
# Half of the scene's width, mm, and the width of the truth's blur, voxels.
HALF, BLUR = 6.0, 0.5


def blobs(draw: int) -> np.ndarray:
    """Emitters `(x, y, z, intensity)` of blobs and vessels."""
    rng, parts = np.random.default_rng(draw), []
    for width in rng.uniform(0.12, 0.35, 24):
        middle = np.append(rng.uniform(0.7 - HALF, HALF - 0.7, 2), rng.uniform(18.3 + 1.2 * width, 21.7 - 1.2 * width))
        offset = rng.normal(0, width, (8_000, 3))
        light = np.full(len(offset), rng.uniform(0.5, 1.5) * width**3 / len(offset) * (2 * np.pi) ** 1.5)
        parts.append(np.column_stack([middle + offset, light]))
    for phase in rng.uniform(0, 2 * np.pi, 2):
        along = np.repeat(np.linspace(-1, 1, 3_000), 4)
        across = 0.8 * np.sin(3 * along + phase)
        x = (HALF - 1) * along * np.cos(phase) + across * np.sin(phase)
        y = (HALF - 1) * along * np.sin(phase) - across * np.cos(phase)
        place = np.column_stack([x, y, 20 + 1.3 * np.sin(2 * along + 2 * phase)])
        light = np.full(len(place), 2 * (HALF - 1) * np.pi * 0.08**2 / len(place))
        parts.append(np.column_stack([place + rng.normal(0, 0.08, place.shape), light]))
    emitters = np.concatenate(parts)
    return emitters[np.abs(emitters[:, 2] - 20) < 1.7]


def emitters_of(kind: str, draw: int) -> np.ndarray:
    """Emitters `(x, y, z, intensity)` of a scene of a kind."""
    if kind == "blobs":
        return blobs(draw)
    return make_scene(kind, draw, Settings(span=(18.1, 21.9), field=HALF)).emitters * (2, 2, 1, 1)


def run(
    kinds: list[str], exposures: list[int], draws: int, records: Path, progress: gs.Progress
) -> list[dict[str, Any]]:
    """A row for each method, number of steps, kind, exposure and draw."""
    imager = eqx.tree_at(lambda i: i.sensor, gs.geomscope().imager(), SENSOR)
    settings = [*map(list, RUNS), [*GRID.volume_shape, GRID.pitch, *SENSOR.shape, RAYS, TILE, BLUR]]
    kept = read_records(records, "settings", settings, {"rows": {}})
    methods: dict[str, Any] = {}
    for draw, kind in progress.track([(draw, kind) for draw in range(draws) for kind in kinds], "Scenes"):
        if all(f"{kind} {draw} {exposure}" in kept["rows"] for exposure in exposures):
            continue
        emitters = emitters_of(kind, draw)
        light, truth = traced(emitters, imager, RAYS, TILE), _blurred(gs.rasterize(emitters, GRID))
        for exposure in exposures:
            image = gs.expose(light, gs.Camera(), jax.random.key(draw), peak_electrons=exposure)
            rows = []
            for name, steps in RUNS:
                if name not in methods:
                    methods[name] = gs.Reconstructor(imager, GRID, METHODS[name](1), progress=progress)
                    methods[name](np.asarray(image))
                invert = methods[name].by(METHODS[name](steps))
                start = time.process_time()
                volume = invert(np.asarray(image))
                row = {"kind": kind, "exposure": exposure, "draw": draw, "method": name, "steps": steps}
                rows.append(row | {"s": time.process_time() - start, "db": _gain(volume, truth)})
            kept["rows"][f"{kind} {draw} {exposure}"] = rows
            write_json(records, kept)
    wanted = [f"{kind} {draw} {exposure}" for kind in kinds for exposure in exposures for draw in range(draws)]
    return [row for key in wanted for row in kept["rows"][key]]


def _blurred(volume: Any) -> np.ndarray:
    return gaussian_filter(np.asarray(volume, np.float64), (0, BLUR, BLUR))


def _gain(volume: np.ndarray, truth: np.ndarray) -> float:
    return gs.quality(volume, truth).psnr_db - gs.quality(0 * truth, truth).psnr_db


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Plot quality against time: a column for each kind, a row for each exposure."""
    kinds, exposures = (list(dict.fromkeys(row[key] for row in rows)) for key in ("kind", "exposure"))
    figure = Figure(figsize=(2.6 * len(kinds), 0.5 + 2.2 * len(exposures)), dpi=100, layout="constrained")
    grid = figure.subplots(len(exposures), len(kinds), squeeze=False, sharex=True, sharey="col")
    for line, exposure in zip(grid, exposures, strict=True):
        for axes, kind in zip(line, kinds, strict=True):
            for name in STEPS:
                some = [row for row in rows if (row["method"], row["kind"], row["exposure"]) == (name, kind, exposure)]
                means = [
                    [np.mean([row[key] for row in some if row["steps"] == n]) for n in STEPS[name]]
                    for key in ("s", "db")
                ]
                axes.plot(*means, "o-", label=name)
            axes.set_title(f"{kind}, {exposure} e")
    for axes in grid[-1]:
        axes.set_xlabel("processor time, s")
    for axes in grid[:, 0]:
        axes.set_ylabel("dB above empty")
    grid[0, 0].set_xlim(0, 1.1 * max(row["s"] for row in rows))
    grid[0, -1].legend(fontsize=7, loc="upper left")
    return figure


def report(kinds: list[str], exposures: list[int], draws: int, records: Path, progress: gs.Progress) -> Report:
    if draws < 1 or min(exposures) < 1:
        raise gs.InputError(f"--draws and --exposures must be 1 or more, got {draws} and {exposures}.")
    make_folder(records.parent)
    rows = run(kinds, exposures, draws, records, progress)
    keys = list(dict.fromkeys((row["kind"], row["exposure"]) for row in rows))
    lines = []
    for name, steps in RUNS:
        of_method = [row for row in rows if (row["method"], row["steps"]) == (name, steps)]
        cells = []
        for key in keys:
            db = [row["db"] for row in of_method if (row["kind"], row["exposure"]) == key]
            spread = f" ± {np.std(db, ddof=1) / len(db) ** 0.5:.1f}" if len(db) > 1 else ""
            cells.append(f"{np.mean(db):.1f}{spread}")
        lines.append([name, str(steps), f"{np.median([row['s'] for row in of_method]):.0f}", *cells])
    columns = ("method", "steps", "s", *(f"{kind}, {exposure}" for kind, exposure in keys))
    files, shown = tables_report("front", rows, (columns, lines))
    return Report(files | {"front.png": picture(rows)}, shown)


if __name__ == "__main__":
    whole = lambda text: [int(part) for part in text.split(",")]
    main(
        report,
        {
            "--kinds": {"type": names_of(KINDS), "default": KINDS},
            "--exposures": {"type": whole, "default": EXPOSURES},
            "--draws": {"type": int, "default": 3},
            "--records": {"type": Path, "default": Path("out/front/records.json")},
        },
    )
