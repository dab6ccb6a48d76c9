"""Quality against time: scenes of five kinds at several exposures, through the whole device, by each method and steps.

Beads, letters with bars, tilted sheets and texture are those of `design_judge`; blobs are 24 Gaussian ones of 0.12 to
0.35 mm and two vessels. All lie within 10 mm by 10 mm by 3.6 mm before the paper's lenses and are ray-traced through
all of them onto the whole sensor, of pixels of 10 um. "dB" is above an empty volume, for a truth that is blurred by a voxel, and in
brackets after the same blur of the volume. Seconds are those of all processors in one call, without tables and
compilation.

    python -m experiments.front [--kinds blobs,texture] [--exposures 10000,300] [--draws 3] [--out DIR]

Writes `front.json`, `front.md` and `front.png`; two hours on two cores for all kinds, exposures and one draw.
"""

import time
from typing import Any

import equinox as eqx
import jax
import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

import gs_jax as gs
from experiments.common import Report, main, names_of, tables_report
from experiments.design_judge import KINDS as JUDGED, Settings, make_scene
from experiments.ray_tracer import traced
from gs_jax.reconstruction.pipeline import METHODS

KINDS = ("blobs", *JUDGED)
EXPOSURES = (10_000, 1_500, 300)
# Steps of each method; the unrolled has its own.
STEPS = {"list-rl": (20,), "richardson-lucy": (5, 10, 20, 40), "unrolled": (20,)}
RUNS = [(name, steps) for name, all_steps in STEPS.items() for steps in all_steps]
# 13 planes, 0.3 mm apart, of 40 um voxels.
GRID = gs.Grid(18.2 + 0.3 * np.arange(13), (253, 253), 0.04)
SENSOR, RAYS = gs.Sensor((2048, 2048), 0.01), 60


def blobs(draw: int) -> np.ndarray:
    """Emitters `(x, y, z, intensity)` of blobs and vessels."""
    rng, parts = np.random.default_rng(draw), []
    for width in rng.uniform(0.12, 0.35, 24):
        middle = np.append(rng.uniform(-3.6, 3.6, 2), rng.uniform(18.3 + 1.2 * width, 21.7 - 1.2 * width))
        offset = rng.normal(0, width, (8_000, 3))
        light = np.full(len(offset), rng.uniform(0.5, 1.5) * width**3 / len(offset) * (2 * np.pi) ** 1.5)
        parts.append(np.column_stack([middle + offset, light]))
    for phase in rng.uniform(0, 2 * np.pi, 2):
        along = np.repeat(np.linspace(-1, 1, 3_000), 4)
        across = 0.8 * np.sin(3 * along + phase)
        x = 4 * along * np.cos(phase) + across * np.sin(phase)
        y = 4 * along * np.sin(phase) - across * np.cos(phase)
        place = np.column_stack([x, y, 20 + 1.3 * np.sin(2 * along + 2 * phase)])
        light = np.full(len(place), 8 * np.pi * 0.08**2 / len(place))
        parts.append(np.column_stack([place + rng.normal(0, 0.08, place.shape), light]))
    emitters = np.concatenate(parts)
    return emitters[np.abs(emitters[:, 2] - 20) < 1.7]


def emitters_of(kind: str, draw: int) -> np.ndarray:
    settings = Settings(span=(18.1, 21.9), field=5.0)
    return blobs(draw) if kind == "blobs" else make_scene(kind, draw, settings).emitters


def run(kinds: list[str], exposures: list[int], draws: int, progress: gs.Progress) -> list[dict[str, Any]]:
    """A row for each method, number of steps, kind, exposure and draw."""
    imager = eqx.tree_at(lambda i: i.sensor, gs.geomscope().imager(), SENSOR)
    methods = {name: gs.Reconstructor(imager, GRID, METHODS[name](20), progress=progress) for name in STEPS}
    rows, compiled = [], set()
    for kind, draw in progress.track([(kind, draw) for kind in kinds for draw in range(draws)], "Scenes"):
        emitters = emitters_of(kind, draw)
        light = traced(emitters, imager, RAYS, tile=0.1)
        truth = _blurred(gs.rasterize(emitters, GRID))
        for exposure in exposures:
            counts = gs.expose(light, gs.Camera(), jax.random.key(draw), peak_electrons=exposure)
            for name, steps in RUNS:
                invert = methods[name] if name == "unrolled" else methods[name].by(METHODS[name](steps))
                if name not in compiled:
                    # Other numbers of steps run the same programs.
                    compiled.add(name)
                    invert(np.asarray(counts))
                start = time.process_time()
                volume = invert(np.asarray(counts))
                seconds = time.process_time() - start
                row = {"kind": kind, "exposure": exposure, "draw": draw, "method": name, "steps": steps}
                rows.append(
                    row | {"s": seconds, "db": _gain(volume, truth), "blurred_db": _gain(_blurred(volume), truth)}
                )
    return rows


def _blurred(volume: Any) -> np.ndarray:
    return gaussian_filter(np.asarray(volume, np.float64), (0, 1, 1))


def _gain(volume: np.ndarray, truth: np.ndarray) -> float:
    return gs.quality(volume, truth).psnr_db - gs.quality(0 * truth, truth).psnr_db


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Plot quality against time for each kind, at the first exposure."""
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    figure = Figure(figsize=(2.6 * len(kinds), 2.8), dpi=100, layout="constrained")
    for axes, kind in zip(figure.subplots(1, len(kinds), squeeze=False)[0], kinds, strict=True):
        for name in STEPS:
            some = [row for row in rows if (row["kind"], row["method"]) == (kind, name)]
            some = [row for row in some if row["exposure"] == rows[0]["exposure"]]
            means = [
                [np.mean([row[key] for row in some if row["steps"] == n]) for n in STEPS[name]] for key in ("s", "db")
            ]
            axes.plot(*means, "o-", label=name)
        axes.set(title=kind, xlabel="processor time, s", xscale="log")
    figure.axes[0].set_ylabel("dB above an empty volume")
    figure.axes[0].legend(fontsize=7)
    return figure


def report(kinds: list[str], exposures: list[int], draws: int, progress: gs.Progress) -> Report:
    rows = run(kinds, exposures, draws, progress)
    keys = dict.fromkeys((row["kind"], row["exposure"]) for row in rows)
    lines = []
    for name, steps in RUNS:
        of_method = [row for row in rows if (row["method"], row["steps"]) == (name, steps)]
        cells = []
        for key in keys:
            some = [row for row in of_method if (row["kind"], row["exposure"]) == key]
            db, blurred_db = ([row[k] for row in some] for k in ("db", "blurred_db"))
            spread = f" ± {np.std(db, ddof=1) / len(db) ** 0.5:.1f}" if len(db) > 1 else ""
            cells.append(f"{np.mean(db):.1f}{spread} ({np.mean(blurred_db):.1f})")
        lines.append([name, str(steps), f"{np.median([row['s'] for row in of_method]):.0f}", *cells])
    columns = ("method", "steps", "processor s", *(f"{kind}, {exposure}" for kind, exposure in keys))
    files, shown = tables_report("front", rows, (columns, lines))
    return Report(files | {"front.png": picture(rows)}, shown)


if __name__ == "__main__":
    whole = lambda text: [int(part) for part in text.split(",")]
    main(
        report,
        {
            "--kinds": {"type": names_of(KINDS), "default": KINDS},
            "--exposures": {"type": whole, "default": EXPOSURES},
            "--draws": {"type": int, "default": 1},
        },
    )
