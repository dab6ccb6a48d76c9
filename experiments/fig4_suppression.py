"""Figs. 4A and 7: points and beads in 3-D, by plain back-projection, particle clustering and `find_points`.

120 points at 18 to 22 mm: the plain stack, the stack rendered from the points that `find_points` detects, and the
truth. Images come from our simulation (all light, shot and read noise) and, with DATA, from an independent ray tracer,
with haze and clipped apertures. Fig. 7: 5 um beads in a slab, which are balls filled with emitters, of different
brightness; `find_points` uses neither radius nor brightness.

    python -m experiments.fig4_suppression [DATA] [--out DIR]

DATA holds `P1.toml`, `P1_d.tif`, `d.json`. Without it the built-in design is used.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import maximum_filter
from skimage.measure import block_reduce

import gs_jax as gs
from experiments.common import OPTIONAL_PATH, Report, design_of, local_maxima, main, points_of, table
from experiments.phantoms import beads
from experiments.point_density import scene, scores as density_scores
from gs_jax.apps.benchmark import timed
from gs_jax.apps.pictures import draw_image, label_of
from gs_jax.detection.particles import find_clusters
from gs_jax.simulation import simulate_points

# Depths, mm.
SHOWN = (18.0, 20.0, 22.0)
# Width of a rendered point.
_POINT_MM = 0.6
# Fractions of the maximum. Peaks and clustering use the threshold that scores best against the truth.
THRESHOLDS = (0.08, 0.1, 0.12, 0.15, 0.2)
# Timed runs of the search after the first.
_ROUNDS = 3
# mm: depths and sides of the beads' slab, and spacing of emitters in a ball of 5 um.
SIZE, SLAB, APART = (20.0, 20.0), (18.75, 21.25), 0.002
# The plot of a capture shows the brightest of each square of so many pixels, because spots are one or two pixels wide.
BLOCK = 40


def run(design: gs.Design, data: Path | None, *, count=120, voxel=0.03, step=0.25, progress: gs.Progress) -> dict:
    """Return scores of every method on every source of images, and the planes to plot."""
    grid = gs.Grid.over(design.imager().sensor, depths=np.arange(17, 23.001, step), pitch=voxel)
    captures = {"simulated": scene(count, 0, design, progress)}
    if data is not None:
        truth = points_of(data, "d")
        captures["ray-traced"] = truth, gs.read_capture(data / "P1_d.tif", design.imager().sensor.shape)
    return {source: _compare(*both, design, grid, progress) for source, both in captures.items()}


def find_beads(design: gs.Design, data: Path | None, *, count=300, progress: gs.Progress) -> dict:
    """Return truth, capture, detected points and scores of beads, and of the ray-traced points."""
    imager = design.imager()
    scenes = {"beads, simulated": _beads(design, count, progress)}
    if data is not None:
        scenes["points, ray-traced"] = points_of(data, "d"), gs.read_capture(data / "P1_d.tif", imager.sensor.shape)
    grid = gs.Grid.over(imager.sensor, depths=np.arange(17, 23.001, 0.25), pitch=0.03)
    results = {}
    for name, (truth, capture) in scenes.items():
        detections = gs.find_points(capture, imager, grid, progress=progress)
        numbers = {"points": len(truth), "found": len(detections)} | density_scores([(detections, truth)])
        results[name] = {"truth": truth, "capture": capture, "found": detections, "scores": numbers}
        results[name]["extent"] = imager.sensor.extent
    return results


def _beads(design: gs.Design, count: int, progress: gs.Progress) -> tuple[np.ndarray, np.ndarray]:
    """Centres of the beads with their light, and a capture."""
    emitters = beads(count, SIZE, SLAB, pitch=APART)
    balls = emitters.reshape(count, -1, 4)
    balls[..., 3] *= np.random.default_rng(0).uniform(0.3, 1.7, (count, 1)) / balls[0, :, 3].sum()
    image = simulate_points(emitters, design.imager(), kind="full", progress=progress)
    capture = np.asarray(gs.expose(image, gs.Camera(), jax.random.key(0), peak_electrons=10_000))
    return np.column_stack([balls[..., :3].mean(1), balls[..., 3].sum(1)]), capture


def _compare(truth, capture, design, grid, progress) -> dict:
    imager = design.imager()
    volume = gs.reconstruct(capture, imager, grid, progress=progress)
    points = {
        "nothing": np.zeros((0, 4)),
        "threshold and peaks, the best": _best(lambda lowest: _peaks(volume, grid, lowest), truth),
        "the paper's clustering": find_clusters(volume, grid, noise_floor=0),
        "clustering, the best": _best(
            lambda lowest: find_clusters(volume, grid, thresholds=(lowest, 2 * lowest, 3 * lowest), noise_floor=0),
            truth,
        ),
    }
    search = lambda: gs.find_points(capture, imager, grid, progress=progress)
    (first, points["find_points"]), again = timed(search), [timed(search)[0] for _ in range(_ROUNDS)]
    expected = np.asarray(gs.rasterize(truth, grid))
    scores = {name: _scores(detections, truth, expected, grid) for name, detections in points.items()}
    scores["find_points"] |= {"first_s": first, "again_s": float(np.median(again))}
    scores["plain back-projection"] = gs.quality(volume, expected)._asdict()
    stacks = {"back-projection": volume, "find_points": np.asarray(gs.rasterize(points["find_points"], grid))}
    shown = [int(np.abs(np.asarray(grid.depths) - depth).argmin()) for depth in SHOWN]
    planes = {name: stack[shown] for name, stack in (stacks | {"truth": expected}).items()}
    return {"points": len(truth), "scores": scores, "planes": planes, "pitch": grid.pitch}


def _best(method: Callable[[float], np.ndarray], truth: np.ndarray) -> np.ndarray:
    return max(map(method, THRESHOLDS), key=lambda detections: gs.localization(detections, truth).f1)


def _peaks(volume: np.ndarray, grid: gs.Grid, threshold: float) -> np.ndarray:
    """Local maxima above a fraction of the highest value, above the median of each plane."""
    above = volume - np.median(volume, axis=(1, 2), keepdims=True)
    return local_maxima(above, grid, threshold_rel=threshold)


def _scores(detections, truth, expected, grid) -> dict:
    score, stack = gs.localization(detections, truth), gs.quality(np.asarray(gs.rasterize(detections, grid)), expected)
    a, b = detections[score.pairs[:, 0]], truth[score.pairs[:, 1]]
    ratio = a[:, 3] / b[:, 3]
    paired = len(ratio) > 0
    scores = {"found": len(detections)} | density_scores([(detections, truth)]) | stack._asdict()
    scores["axial_bias_um"] = 1000 * float((a[:, 2] - b[:, 2]).mean()) if paired else None
    # Standard deviation of the intensity ratio, relative to its mean.
    scores["intensity_sd"] = float(ratio.std() / ratio.mean()) if paired else None
    return scores


def picture(result: dict) -> Figure:
    """Plot depths in rows; the stack, the detected points and the truth in columns."""
    planes, pitch = result["planes"], result["pitch"]
    half = planes["truth"].shape[1] * pitch / 2
    figure = Figure(figsize=(9, 9.4), dpi=90, layout="constrained")
    wide = 2 * round(_POINT_MM / 2 / pitch) + 1
    extent = (-half, half, half, -half)
    for row, (depth, axes) in enumerate(zip(SHOWN, figure.subplots(3, 3), strict=True)):
        for axis, (name, stack) in zip(axes, planes.items(), strict=True):
            plane = stack[row] if name == "back-projection" else maximum_filter(stack[row], wide)
            draw_image(axis, plane, extent, low=float(np.median(plane)), high=float(np.quantile(plane, 0.9995)))
            if row == 0:
                axis.set_title(label_of(name))
        axes[0].set_ylabel(f"{depth:g} mm")
    figure.supxlabel(
        f"Each plane from its median to its 99.95th percentile; points and truth drawn {_POINT_MM} mm wide", fontsize=8
    )
    return figure


def picture_of_beads(results: dict) -> Figure:
    """Plot per scene the capture, and detected points (dots) and true points (rings) from the front and the side."""
    figure = Figure(figsize=(11.5, 3.6 * len(results)), dpi=80, layout="constrained")
    rows = figure.subplots(len(results), 3, squeeze=False)
    depths = np.concatenate([result["truth"][:, 2] for result in results.values()])
    shades: dict[str, Any] = {"cmap": "viridis", "vmin": depths.min(), "vmax": depths.max()}
    for axes, (name, result) in zip(rows, results.items(), strict=True):
        capture, detections, truth = result["capture"], result["found"], result["truth"]
        brightest = block_reduce(capture, BLOCK, np.max)
        high = float(np.quantile(brightest, 0.99))
        draw_image(axes[0], brightest, result["extent"], low=float(capture.min()), high=high)
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
    figure.supxlabel(f"Captures: the brightest of {BLOCK} x {BLOCK} pixels, to the 99th percentile", fontsize=8, x=0.2)
    return figure


def report(data: Path | None, progress: gs.Progress) -> Report:
    design = design_of(data)
    results, of_beads = run(design, data, progress=progress), find_beads(design, data, progress=progress)
    columns = ("found", "precision", "recall", "f1", "lateral_rmse_um", "axial_rmse_um", "psnr_db", "ssim")
    columns += ("first_s", "again_s")
    line = lambda scores: (f"{scores[column]:.4g}" if column in scores else "" for column in columns)
    shown = [
        table(
            ("", *columns),
            [[name, *line(scores)] for name, scores in result["scores"].items()],
            f"{result['points']} points, {source}",
        )
        for source, result in results.items()
    ]
    scores = {source: result["scores"] for source, result in results.items()}
    counted = {name: result["scores"] for name, result in of_beads.items()}
    columns = ("", "points", "found", "F1", "precision", "recall", "lateral, um", "axial, um")
    shown.append(table(columns, [[name, *(f"{x:.4g}" for x in row.values())] for name, row in counted.items()]))
    files = {"fig4.json": scores, "fig4.png": picture(list(results.values())[-1])}
    return Report(files | {"fig7.json": counted, "fig7.png": picture_of_beads(of_beads)}, shown)


if __name__ == "__main__":
    main(report, {"data": OPTIONAL_PATH})
