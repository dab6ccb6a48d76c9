"""Figs. 3 and 5: width of a reconstructed point, at 20 mm and against depth, and resolution of two points.

Points at 20 mm (one alone, two 40 um apart laterally, two 300 um apart axially), and a point on the axis at each depth,
are imaged by the focused design and back-projected. Images come from our forward model with diffraction and, if DATA is
given, from an independent ray tracer. `BARS` has what the paper reports.

    python -m experiments.fig3_resolution [DATA] [--out DIR]

DATA holds `P1.toml`, `P1_a.tif`, `P1_b.tif`, `P1_c.tif` and `P1_i_*_c.tif`. Without it the built-in design is used.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.signal import peak_widths

from experiments.common import OPTIONAL_PATH, Report, design_of, main, table
from gs_jax import Design, Grid, Imager, Progress, backproject, read_capture
from gs_jax.simulation import simulate_points

SCENES = {
    "a": [[0.0, 0.0, 20.0, 1.0]],
    "b": [[-0.02, 0.0, 20.0, 1.0], [0.02, 0.0, 20.0, 1.0]],
    "c": [[0.0, 0.0, 19.85, 1.0], [0.0, 0.0, 20.15, 1.0]],
}
BARS = {"lateral_fwhm_um": 40, "axial_fwhm_um": 300, "lateral_dip": 0.85, "axial_dip": 0.85}
# Captures of a point on the axis, by depth.
ON_AXIS = {18.0: "i_18_c", 20.0: "a", 22.0: "i_22_c"}
DEPTHS = tuple(np.arange(17, 25.01, 0.5).tolist())


def around_the_axis(image: np.ndarray, imager: Imager, depth: float) -> tuple[np.ndarray, Grid]:
    """Back-project around the point `(0, 0, depth)`, with voxels of 2 um laterally and 20 um axially."""
    grid = Grid(depth + np.arange(-0.8, 0.801, 0.02), (101, 101), 0.002)
    return np.asarray(backproject(image, imager, grid)), grid


def through_peak(volume: np.ndarray, grid: Grid) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Coordinates (mm) and values along x, y and z through the brightest voxel, normalised to 1."""
    d, r, c = np.unravel_index(int(volume.argmax()), volume.shape)
    volume = volume / volume.max()
    x, y, z = (np.asarray(a, np.float64) for a in (grid.x, grid.y, grid.depths))
    return {"x": (x, volume[d, r, :]), "y": (y, volume[d, :, c]), "z": (z, volume[:, r, c])}


def fwhm(coordinate: np.ndarray, profile: np.ndarray) -> float:
    """Full width at half maximum, linear between samples; infinite if the profile does not fall to a half."""
    peak = int(profile.argmax())
    if max(profile[: peak + 1].min(), profile[peak:].min()) >= profile[peak] / 2:
        return float("inf")
    height_above_zero = (profile[[peak]], np.array([0]), np.array([len(profile) - 1]))
    _, _, left, right = peak_widths(profile, [peak], prominence_data=height_above_zero)
    return float(np.diff(np.interp([*left, *right], np.arange(len(profile)), coordinate))[0])


def dip(coordinate: np.ndarray, profile: np.ndarray) -> float:
    """Lowest value between the maxima on both sides of the middle, relative to the lower maximum; 1 without a dip."""
    middle = (coordinate[0] + coordinate[-1]) / 2
    left = int(np.where(coordinate < middle, profile, -np.inf).argmax())
    right = int(np.where(coordinate >= middle, profile, -np.inf).argmax())
    return float(profile[left : right + 1].min() / min(profile[left], profile[right]))


def run(design: Design, data: Path | None, *, progress: Progress) -> dict:
    """Return the profiles of each scene at 20 mm, and the four numbers, for every source of images."""
    imager, results = design.imager(), {}
    for source in ("gs_jax", "ray-traced") if data else ("gs_jax",):
        images = {name: _image(SCENES[name], data if source != "gs_jax" else None, name, imager) for name in SCENES}
        lines = {name: through_peak(*around_the_axis(image, imager, 20.0)) for name, image in images.items()}
        results[source] = {"profiles": lines} | {
            "lateral_fwhm_um": 1000 * max(fwhm(*lines["a"]["x"]), fwhm(*lines["a"]["y"])),
            "axial_fwhm_um": 1000 * fwhm(*lines["a"]["z"]),
            "lateral_dip": dip(*lines["b"]["x"]),
            "axial_dip": dip(*lines["c"]["z"]),
        }
    return results


def over_depth(design: Design, data: Path | None, depths: Sequence[float] = DEPTHS, *, progress: Progress) -> dict:
    """Return widths (um) against depth, for every source of images."""
    imager = design.imager()
    image = lambda depth, data: _image([[0, 0, depth, 1.0]], data, ON_AXIS.get(depth, ""), imager)
    results = {"gs_jax": [_widths(image(z, None), imager, z) for z in progress.track(depths, "Depths")]}
    if data is not None:
        results["ray-traced"] = [_widths(image(z, data), imager, z) for z in ON_AXIS]
    return results


def _image(points: list, data: Path | None, name: str, imager: Imager) -> np.ndarray:
    """Image of points by our model, or their capture in a folder."""
    if data is None:
        return np.asarray(simulate_points(np.array(points), imager))
    return read_capture(data / f"P1_{name}.tif", imager.sensor.shape).astype(np.float32) - 16


def _widths(image: np.ndarray, imager: Imager, depth: float) -> dict[str, float]:
    volume, grid = around_the_axis(image, imager, depth)
    lines = through_peak(volume, grid)
    return {
        "depth_mm": depth,
        "lateral_fwhm_um": 500 * (fwhm(*lines["x"]) + fwhm(*lines["y"])),
        "axial_fwhm_um": 1000 * fwhm(*lines["z"]),
        "axial_error_um": 1000 * (float(grid.depths[int(volume.max((1, 2)).argmax())]) - depth),
    }


def picture(results: dict) -> Figure:
    """Plot the profiles of all sources."""
    panels = (("a", "x", "one point, laterally"), ("a", "z", "one point, axially"))
    panels += (("b", "x", "two points 40 um apart"), ("c", "z", "two points 300 um apart"))
    figure = Figure(figsize=(9, 6), dpi=100, layout="constrained")
    for axes, (scene, axis, title) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        for (source, result), style in zip(results.items(), ("-", "--"), strict=False):
            coordinate, profile = result["profiles"][scene][axis]
            axes.plot(coordinate * (1000 if axis == "x" else 1), profile, style, label=source)
        axes.axhline(0.5 if scene == "a" else 0.85, color="gray", lw=0.8, ls=":")
        axes.set(title=title, xlabel="x, um" if axis == "x" else "z, mm", ylim=(0, 1.05))
        axes.set_ylabel("back-projection, of its peak")
    figure.axes[0].legend()
    return figure


def picture_over_depth(results: dict) -> Figure:
    """Plot lateral and axial width against depth."""
    figure = Figure(figsize=(9, 3.6), dpi=100, layout="constrained")
    for axes, key in zip(figure.subplots(1, 2), ("lateral_fwhm_um", "axial_fwhm_um"), strict=True):
        for (source, rows), style in zip(results.items(), ("o-", "s"), strict=False):
            axes.plot([row["depth_mm"] for row in rows], [row[key] for row in rows], style, label=source)
        axes.axhline(BARS[key], color="gray", ls=":", label="the paper's design")
        axes.set(xlabel="depth, mm", ylabel=f"{key.split('_')[0]} FWHM, um", ylim=(0, 2 * BARS[key]))
    figure.axes[0].legend()
    return figure


def report(data: Path | None, progress: Progress) -> Report:
    design = design_of(data)
    results, widths = run(design, data, progress=progress), over_depth(design, data, progress=progress)
    rows = [[key, f"{bar:g}", *(f"{result[key]:.3g}" for result in results.values())] for key, bar in BARS.items()]
    shown = [table(("", "at most", *results), rows, "Resolution of back-projection at 20 mm")]
    for source, lines in widths.items():
        columns = [key.replace("_", " ") for key in lines[0]]
        shown.append(table(columns, [[f"{x:.4g}" for x in row.values()] for row in lines], source))
    numbers = {source: {key: result[key] for key in BARS} for source, result in results.items()}
    files = {"fig3.json": numbers, "fig5.json": widths}
    return Report(files | {"fig3.png": picture(results), "fig5.png": picture_over_depth(widths)}, shown)


if __name__ == "__main__":
    main(report, {"data": OPTIONAL_PATH})
