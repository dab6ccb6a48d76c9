"""Eqs. (1) and (3): the scale of the pattern of a point's images against depth.

The images of a point at depth z are the layout of the lenses scaled by `s_z = (z' + v) / z'`, and each lens magnifies
by `M_z = s_z - 1`; z' is the reduced depth. The script measures s_z with the layout alone: it matches the spots in
captures of a point on the axis, by an independent ray tracer, with the lenses, and fits a line through spot positions
against lens positions. The paper says that s_z is constant over the field and "scales linearly with depth".

    python -m experiments.depth_scaling [DATA] [--out DIR]

DATA holds `P1.toml` and `P1_i_*_c.tif`; without it only captures of our own tracer, of the built-in design, are used.
Writes `depth_scaling.json` and `depth_scaling.png`; about a minute on two cores.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import KDTree

from experiments.common import OPTIONAL_PATH, Report, design_of, main, points_of, table
from experiments.ray_tracer import traced
from gs_jax import Imager
from gs_jax.base.progress import Progress
from gs_jax.calibration.spots import find_spots
from gs_jax.design.design import Design
from gs_jax.io.captures import read_capture

DEPTHS = (18.0, 19.0, 20.0, 21.0, 22.0, 23.0, 24.0, 26.0)
# A spot matches a lens within this distance of its position at a scale of 1.3, mm: half of the smallest pitch.
_ROUGHLY, _NEAR = 1.3, 0.45


def run(
    design: Design, data: Path | None, *, depths: Sequence[float] = DEPTHS, rays: int = 20_000, progress: Progress
) -> dict[str, list[dict]]:
    """Return the scale by source and depth, its value by Eq. (1), and the residuals of the line."""
    imager = design.imager()
    point = lambda depth: np.array([[0.0, 0.0, depth, 1e6]])
    results = {
        "our tracer": [
            measured(traced(point(depth), imager, rays), imager, depth) for depth in progress.track(depths, "Tracing")
        ]
    }
    if data is not None:
        captured = lambda name: read_capture(data / f"P1_{name}.tif", imager.sensor.shape).astype(np.float64)
        names = sorted(path.stem.removeprefix("P1_") for path in data.glob("P1_i_*_c.tif"))
        results["another group's"] = [measured(captured(n), imager, float(points_of(data, n)[0, 2])) for n in names]
    return results


def measured(image: np.ndarray, imager: Imager, depth: float) -> dict:
    """Measure the scale in a capture of a point on the axis."""
    seen, scale = imager.field_radius, _ROUGHLY
    centers = np.asarray(imager.centers, np.float64)
    centers = centers[np.hypot(*centers.T) < float(seen)]
    spots = np.asarray(imager.sensor.to_mm(find_spots(image, 2 * len(centers))))
    tree: Any = KDTree(spots)
    # Match twice; the second time with the positions predicted by the first fit.
    for reach in (_NEAR, _NEAR / 10):
        distance, nearest = tree.query(scale * centers)
        sure = distance < reach
        scale = float((centers[sure] * spots[nearest[sure]]).sum() / (centers[sure] ** 2).sum())
    off = spots[nearest[sure]] - scale * centers[sure]
    by_eq1 = 1 + float(imager.magnification(depth))
    row = {"depth_mm": depth, "spots": int(sure.sum()), "s_z": scale, "by_eq_1": by_eq1}
    thin = 1 + float(imager.sensor_distance) / depth
    return row | {"plate_left_out": thin, "rms_um": 1000 * float(np.sqrt((off**2).sum(1).mean()))}


def picture(results: dict[str, list[dict]]) -> Figure:
    """Plot the scale against depth, and its difference from Eq. (1)."""
    figure = Figure(figsize=(9.5, 3.8), dpi=100, layout="constrained")
    left, right = figure.subplots(1, 2)
    ours = next(iter(results.values()))
    column = lambda rows, key: np.array([row[key] for row in rows])
    depths = column(ours, "depth_mm")
    left.plot(depths, column(ours, "by_eq_1"), "-", color="black", label="Eq. (1), the plate as air")
    left.plot(depths, column(ours, "plate_left_out"), ":", color="black", label="Eq. (1), the plate left out")
    line = np.polynomial.Polynomial.fit(depths, column(ours, "by_eq_1"), 1)(depths)
    right.plot(depths, 1000 * (line - column(ours, "by_eq_1")), "--", color="0.5", label='a line ("scales linearly")')
    for (source, rows), marker in zip(results.items(), "os", strict=False):
        left.plot(column(rows, "depth_mm"), column(rows, "s_z"), marker, label=f"measured, {source}")
        error = 1000 * (column(rows, "s_z") - column(rows, "by_eq_1"))
        right.plot(column(rows, "depth_mm"), error, marker + "-", label=f"measured, {source}")
    right.axhline(0, color="black", lw=0.8)
    left.set(xlabel="depth, mm", ylabel="scale $s_z$")
    right.set(xlabel="depth, mm", ylabel="scale less Eq. (1), thousandths")
    left.legend()
    right.legend()
    return figure


def report(data: Path | None, progress: Progress) -> Report:
    results = run(design_of(data), data, progress=progress)
    columns = ("captures", "depth, mm", "spots", "s_z", "by Eq. (1)", "without the plate", "off the line, um RMS")
    rows = [[source, *(f"{x:.5g}" for x in row.values())] for source, each in results.items() for row in each]
    return Report({"depth_scaling.json": results, "depth_scaling.png": picture(results)}, [table(columns, rows)])


if __name__ == "__main__":
    main(report, {"data": OPTIONAL_PATH})
