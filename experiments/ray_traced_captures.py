"""Positions of points in plain back-projections of ray-traced captures.

An independent exact ray tracer made the captures with the paper's lens centres (sensor at 5.85 mm), including
aberrations, clipped apertures and noise; they use nothing of this package's model. Each is reconstructed with its
design file, uncalibrated, and the brightest voxels are compared with the truth.

    python experiments/ray_traced_captures.py DATA [--out DIR]

DATA holds `P1.toml`, `P1_*.tif` and the scenes' `*.json`.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float32
from matplotlib.figure import Figure
from rich.json import JSON
from scipy.ndimage import maximum_filter
from scipy.spatial import KDTree

from experiments.common import Report, main, points_of, table
from gs_jax import Grid, Imager
from gs_jax.base.progress import Progress
from gs_jax.design.design import read_design
from gs_jax.io.captures import read_capture
from gs_jax.reconstruction.pipeline import reconstruct

# A peak matches a point within this distance, mm: the paper's lateral and axial resolution.
LATERAL, AXIAL = 0.04, 0.3
SINGLE = ("a", *(f"i_{z}_{place}" for z in (18, 20, 22) for place in ("c", "px", "mx", "py", "my")))


def run(
    data: Path, *, singles=SINGLE, voxel_mm=0.02, step_mm=0.1, progress: Progress
) -> tuple[dict, Float32[np.ndarray, "y x"]]:
    """Return errors of the single points, and how many of the 120 points are peaks and how many peaks are points.

    Also returns the maximum over the depths of the reconstruction of the 120 points.
    """
    imager = read_design(data / "P1.toml").imager()
    rows = [{"scene": name, **_single(data, name, imager, voxel_mm, progress)} for name in singles]
    many, projection = _many(data, imager, voxel_mm, step_mm, progress)
    return {"single_points": rows, "many_points": many}, projection


def _single(data: Path, scene: str, imager: Imager, voxel_mm: float, progress: Progress) -> dict:
    ((x, y, z, _),) = points_of(data, scene)
    grid = Grid.over(imager.sensor, depths=z + np.arange(-0.5, 0.51, 0.05), pitch=voxel_mm)
    volume = reconstruct(read_capture(data / f"P1_{scene}.tif", imager.sensor.shape), imager, grid, progress=progress)
    dx, dy, dz = grid.to_mm(np.array(np.unravel_index(int(volume.argmax()), volume.shape))) - (x, y, z)
    return {"lateral_error_um": 1000 * np.hypot(dx, dy), "axial_error_um": 1000 * dz}


def _many(data: Path, imager: Imager, voxel_mm: float, step_mm: float, progress: Progress) -> tuple[dict, np.ndarray]:
    truth = points_of(data, "d")[:, :3]
    grid = Grid.over(imager.sensor, depths=np.arange(17.6, 22.41, step_mm), pitch=voxel_mm)
    volume = reconstruct(read_capture(data / "P1_d.tif", imager.sensor.shape), imager, grid, progress=progress)
    peaks, brightness = _peaks(volume, grid)
    scale = np.array([LATERAL, LATERAL, AXIAL])
    near = KDTree(truth / scale).query(peaks / scale)
    is_point = near[0] <= 1
    errors = np.array(
        [
            peaks[mine][brightness[mine].argmax()] - truth[point]
            for point in range(len(truth))
            if (mine := np.flatnonzero(is_point & (near[1] == point))).size
        ]
    )
    brightest = np.argsort(-brightness)[: len(truth)]
    result = {
        "points": len(truth),
        "points_that_are_peaks": len(errors),
        "points_among_as_many_brightest_peaks": int(is_point[brightest].sum()),
        "lateral_rmse_um": 1000 * float(np.sqrt((errors[:, :2] ** 2).sum(1).mean())),
        "axial_rmse_um": 1000 * float(np.sqrt((errors[:, 2] ** 2).mean())),
        "axial_bias_um": 1000 * float(errors[:, 2].mean()),
    }
    return result, volume.max(0)


def _peaks(volume: np.ndarray, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Local maxima `(x, y, z)`, mm, among the brightest 1e-4 of the voxels."""
    high = volume > np.quantile(volume[::3, ::7, ::7], 1 - 1e-4)
    voxels = np.argwhere(high & (maximum_filter(volume, size=5) == volume))
    return grid.to_mm(voxels), volume[tuple(voxels.T)]


def picture(projection: Float32[np.ndarray, "y x"], data: Path, voxel_mm: float = 0.02) -> Figure:
    """Plot the maximum over the depths for the 120 points, and the truth."""
    truth = points_of(data, "d")
    half = projection.shape[0] * voxel_mm / 2
    figure = Figure(figsize=(11, 5.4), dpi=90, layout="constrained")
    for axis, lim, title in zip(figure.subplots(1, 2), (half, 2.5), ("whole field", "its middle"), strict=True):
        top = np.percentile(projection, 99.95)
        axis.imshow(projection, cmap="magma", extent=(-half, half, half, -half), vmin=0.1 * top, vmax=top)
        axis.scatter(truth[:, 0], truth[:, 1], s=120 if lim < half else 20, facecolors="none", edgecolors="w", lw=0.6)
        axis.set(xlim=(-lim, lim), ylim=(lim, -lim), xlabel="x, mm", ylabel="y, mm")
        axis.set_title(f"120 points, maximum over 17.6 to 22.4 mm: {title}")
    return figure


def report(data: Path, progress: Progress) -> Report:
    result, projection = run(data, progress=progress)
    rows = [
        [row["scene"], f"{row['lateral_error_um']:.0f}", f"{row['axial_error_um']:+.0f}"]
        for row in result["single_points"]
    ]
    shown = table(("scene", "lateral error, um", "axial error, um"), rows, "Single points")
    files = {"points.png": picture(projection, data), "result.json": result}
    return Report(files, [shown, JSON.from_data(result["many_points"])])


if __name__ == "__main__":
    main(report, {"data": {"type": Path}})
