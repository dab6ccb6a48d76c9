"""Fig. 7: fluorescent beads in a slab, from the capture to points in 3-D.

The paper embeds 5 um beads in a slab about 2.5 mm thick. Ours are balls filled with emitters, of different brightness,
imaged with all their light and with shot and read noise; the reconstruction uses neither radius nor brightness. With
DATA, the 120 points of an independent ray tracer are processed the same way.

    python -m experiments.fig7_beads [DATA] [--out DIR]

DATA holds `P1.toml`, `P1_d.tif`, `d.json`. Without it the built-in design is used.
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from skimage.measure import block_reduce

from experiments.common import OPTIONAL_PATH, Report, design_of, main, points_of, table
from experiments.phantoms import beads
from experiments.point_density import scores
from gs_jax import Grid
from gs_jax.apps.pictures import draw_image
from gs_jax.base.progress import Progress
from gs_jax.design.design import Design
from gs_jax.detection.point_finder import find_points
from gs_jax.io.captures import read_capture
from gs_jax.simulation.synthetic import Camera, expose, simulate_points

# mm: depths and sides of the slab, and spacing of emitters in a ball of 5 um.
SIZE, SLAB, APART = (20.0, 20.0), (18.75, 21.25), 0.002
# The plot shows the brightest of each square of so many pixels, because spots are one or two pixels wide.
SHOWN = 40


def run(design: Design, data: Path | None, *, count=300, progress: Progress) -> dict:
    """Return truth, capture, detected points and scores of each scene."""
    scenes = {"beads, simulated": _beads(design, count, progress)}
    if data is not None:
        truth = points_of(data, "d")
        scenes["points, ray-traced"] = truth, read_capture(data / "P1_d.tif", design.imager().sensor.shape)
    grid = Grid.over(design.imager().sensor, depths=np.arange(17, 23.001, 0.25), pitch=0.03)
    results = {}
    for name, (truth, capture) in scenes.items():
        detections = find_points(capture, design.imager(), grid, progress=progress)
        score = {"points": len(truth), "found": len(detections)} | scores([(detections, truth)])
        results[name] = {"truth": truth, "capture": capture, "found": detections, "scores": score}
        results[name]["extent"] = design.imager().sensor.extent
    return results


def _beads(design: Design, count: int, progress: Progress) -> tuple[np.ndarray, np.ndarray]:
    """Centres of the beads with their light, and a capture."""
    emitters = beads(count, SIZE, SLAB, pitch=APART)
    each = emitters.reshape(count, -1, 4)
    each[..., 3] *= np.random.default_rng(0).uniform(0.3, 1.7, (count, 1)) / each[0, :, 3].sum()
    image = simulate_points(emitters, design.imager(), kind="full", progress=progress)
    capture = np.asarray(expose(image, Camera(), jax.random.key(0), peak_electrons=10_000))
    return np.column_stack([each[..., :3].mean(1), each[..., 3].sum(1)]), capture


def picture(results: dict) -> Figure:
    """Plot per scene the capture, and detected points (dots) and true points (rings) from the front and the side."""
    figure = Figure(figsize=(11.5, 3.6 * len(results)), dpi=80, layout="constrained")
    rows = figure.subplots(len(results), 3, squeeze=False)
    depths = np.concatenate([result["truth"][:, 2] for result in results.values()])
    shades: dict[str, Any] = {"cmap": "viridis", "vmin": depths.min(), "vmax": depths.max()}
    for axes, (name, result) in zip(rows, results.items(), strict=True):
        capture, detections, truth = result["capture"], result["found"], result["truth"]
        brightest = block_reduce(capture, SHOWN, np.max)
        draw_image(
            axes[0], brightest, result["extent"], low=float(capture.min()), high=float(np.quantile(brightest, 0.99))
        )
        axes[0].set_title(f"{name}: capture")
        for axis, (i, j) in zip(axes[1:], ((0, 1), (0, 2)), strict=True):
            rings = dict(facecolors="none", edgecolors="tab:gray", lw=0.7)
            axis.scatter(truth[:, i], truth[:, j], s=40, label="truth", **rings)
            axis.scatter(detections[:, i], detections[:, j], s=7, c=detections[:, 2], label="found", **shades)
            axis.set(xlabel="x, mm", ylabel="xyz"[j] + ", mm")
            axis.invert_yaxis()
        axes[1].set_aspect("equal")
        axes[1].set_title(f"{len(detections)} found of {len(truth)}, F1 {result['scores']['f1']:.3f}")
    figure.colorbar(rows[0, 2].collections[1], ax=rows[:, 2], label="depth, mm")
    handles, labels = rows[0, 2].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower right", ncols=2)
    figure.supxlabel("Captures: the brightest pixel of each 40 x 40, up to the 99th percentile", fontsize=8, x=0.2)
    return figure


def report(data: Path | None, progress: Progress) -> Report:
    results = run(design_of(data), data, progress=progress)
    scores = {name: result["scores"] for name, result in results.items()}
    columns = ("", "points", "found", "F1", "precision", "recall", "lateral, um", "axial, um")
    shown = table(columns, [[name, *(f"{x:.4g}" for x in score.values())] for name, score in scores.items()])
    return Report({"fig7.json": scores, "fig7.png": picture(results)}, [shown])


if __name__ == "__main__":
    main(report, {"data": OPTIONAL_PATH})
