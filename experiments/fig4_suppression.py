"""Fig. 4A: points in 3-D by plain back-projection, particle clustering and `find_points`.

120 points at 18 to 22 mm are reconstructed and shown at three depths: the plain stack, the stack rendered from the
points that `find_points` detects, and the truth. The table compares methods: an empty volume, the peaks above a
threshold (scikit-image), the paper's particle clustering, and `find_points`. Images come from our simulation (all
light, shot and read noise) and, if DATA is given, from an independent ray tracer, with haze and clipped apertures.

    python -m experiments.fig4_suppression [DATA] [--out DIR]

DATA holds `P1.toml`, `P1_d.tif`, `d.json`. Without it the built-in design is used.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import maximum_filter

from experiments.common import OPTIONAL_PATH, Report, design_of, main, points_of, table
from experiments.point_density import scene
from experiments.profiles import local_maxima
from gs_jax import Grid
from gs_jax.apps.method_benchmark import timed
from gs_jax.apps.pictures import draw_image, label_of
from gs_jax.base.progress import Progress
from gs_jax.design.design import Design
from gs_jax.detection.clusters import find_clusters
from gs_jax.detection.point_finder import find_points
from gs_jax.io.captures import read_capture
from gs_jax.metrics import localization, quality
from gs_jax.reconstruction.pipeline import reconstruct
from gs_jax.simulation.phantoms import rasterize

SHOWN = (18.0, 20.0, 22.0)  # mm
# Width of a rendered point.
_POINT_MM = 0.6
# Fractions of the maximum. Peaks and clustering use the threshold that scores best against the truth.
THRESHOLDS = (0.08, 0.1, 0.12, 0.15, 0.2)
# Timed runs of the search after the first.
_ROUNDS = 3


def run(design: Design, data: Path | None, *, count=120, voxel=0.03, step=0.25, progress: Progress) -> dict:
    """Return scores of every method on every source of images, and the planes to plot."""
    grid = Grid.over(design.imager().sensor, depths=np.arange(17, 23.001, step), pitch=voxel)
    captures = {"simulated": scene(count, 0, design, progress)}
    if data is not None:
        truth = points_of(data, "d")
        captures["ray-traced"] = truth, read_capture(data / "P1_d.tif", design.imager().sensor.shape)
    return {source: _compare(*both, design, grid, progress) for source, both in captures.items()}


def _compare(truth, capture, design, grid, progress) -> dict:
    imager = design.imager()
    volume = reconstruct(capture, imager, grid, progress=progress)
    points = {
        "nothing": np.zeros((0, 4)),
        "threshold and peaks, the best": _best(lambda lowest: _peaks(volume, grid, lowest), truth),
        "the paper's clustering": find_clusters(volume, grid, noise_floor=0),
        "clustering, the best": _best(
            lambda lowest: find_clusters(volume, grid, thresholds=(lowest, 2 * lowest, 3 * lowest), noise_floor=0),
            truth,
        ),
    }
    search = lambda: find_points(capture, imager, grid, progress=progress)
    (first, points["find_points"]), again = timed(search), [timed(search)[0] for _ in range(_ROUNDS)]
    expected = np.asarray(rasterize(truth, grid))
    scores = {name: _scores(detections, truth, expected, grid) for name, detections in points.items()}
    scores["find_points"] |= {"first_s": first, "again_s": float(np.median(again))}
    scores["plain back-projection"] = quality(volume, expected)._asdict()
    stacks = {"back-projection": volume, "find_points": np.asarray(rasterize(points["find_points"], grid))}
    shown = [int(np.abs(np.asarray(grid.depths) - depth).argmin()) for depth in SHOWN]
    planes = {name: stack[shown] for name, stack in (stacks | {"truth": expected}).items()}
    return {"points": len(truth), "scores": scores, "planes": planes, "pitch": grid.pitch}


def _best(method: Callable[[float], np.ndarray], truth: np.ndarray) -> np.ndarray:
    return max(map(method, THRESHOLDS), key=lambda detections: localization(detections, truth).f1)


def _peaks(volume: np.ndarray, grid: Grid, threshold: float) -> np.ndarray:
    """Local maxima above a fraction of the highest value, above the median of each plane."""
    above = volume - np.median(volume, axis=(1, 2), keepdims=True)
    return local_maxima(above, grid, threshold_rel=threshold)


def _scores(detections, truth, expected, grid) -> dict:
    score = localization(detections, truth)
    stack = quality(np.asarray(rasterize(detections, grid)), expected)
    a, b = detections[score.pairs[:, 0]], truth[score.pairs[:, 1]]
    ratio = a[:, 3] / b[:, 3]
    paired = len(ratio) > 0
    return {
        "found": len(detections),
        "precision": score.precision,
        "recall": score.recall,
        "f1": score.f1,
        "lateral_rmse_um": 1000 * score.lateral_rmse,
        "axial_rmse_um": 1000 * score.axial_rmse,
        "axial_bias_um": 1000 * float((a[:, 2] - b[:, 2]).mean()) if paired else None,
        # Standard deviation of the intensity ratio, relative to its mean.
        "intensity_sd": float(ratio.std() / ratio.mean()) if paired else None,
    } | stack._asdict()


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


def report(data: Path | None, progress: Progress) -> Report:
    results = run(design_of(data), data, progress=progress)
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
    return Report({"fig4.json": scores, "fig4.png": picture(list(results.values())[-1])}, shown)


if __name__ == "__main__":
    main(report, {"data": OPTIONAL_PATH})
