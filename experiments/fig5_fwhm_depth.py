"""Fig. 5: width of a reconstructed point against depth.

A point on the axis is imaged by our forward model at each depth, and back-projected; with DATA also the
ray-traced captures at 18, 20 and 22 mm. The paper reports widths that are stable over about 5 mm around 20 mm, at
457 nm and with a sensor distance of about 4 mm.

    python -m experiments.fig5_fwhm_depth [DATA] [--out DIR]

DATA holds `P1.toml` and `P1_i_18_c.tif`, `P1_a.tif`, `P1_i_22_c.tif`. Without it the built-in design is used.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.common import OPTIONAL_PATH, Report, design_of, main, table
from experiments.profiles import around_the_axis, fwhm, through_peak
from gs_jax import Imager
from gs_jax.base.progress import Progress
from gs_jax.design.design import Design
from gs_jax.io.captures import read_capture
from gs_jax.simulation.synthetic import simulate_points

CAPTURES = {18.0: "P1_i_18_c.tif", 20.0: "P1_a.tif", 22.0: "P1_i_22_c.tif"}
DEPTHS = tuple(np.arange(17, 25.01, 0.5).tolist())


def run(design: Design, data: Path | None, *, depths: Sequence[float] = DEPTHS, progress: Progress) -> dict:
    """Return widths (um) against depth, and the depth ranges within the paper's 40 and 300 um."""
    imager = design.imager()
    images = {z: _simulated(z, imager, progress) for z in progress.track(depths, "Depths")}
    results = {"gs_jax": [_widths(image, imager, z) for z, image in images.items()]}
    if data is not None:
        read = lambda name: read_capture(data / name, imager.sensor.shape).astype(np.float32) - 16
        results["ray-traced"] = [_widths(read(name), imager, z) for z, name in CAPTURES.items()]
    return results


def _simulated(depth, imager, progress):
    return simulate_points(np.array([[0, 0, depth, 1.0]]), imager, progress=progress)


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
    """Plot lateral and axial width against depth."""
    figure = Figure(figsize=(9, 3.6), dpi=100, layout="constrained")
    for axes, key, bar in zip(figure.subplots(1, 2), ("lateral_fwhm_um", "axial_fwhm_um"), (40, 300), strict=True):
        for (source, rows), style in zip(results.items(), ("o-", "s"), strict=False):
            axes.plot([row["depth_mm"] for row in rows], [row[key] for row in rows], style, label=source)
        axes.axhline(bar, color="gray", ls=":", label="the paper's design")
        axes.set(xlabel="depth, mm", ylabel=f"{key.split('_')[0]} FWHM, um", ylim=(0, 2 * bar))
    figure.axes[0].legend()
    return figure


def report(data: Path | None, progress: Progress) -> Report:
    results = run(design_of(data), data, progress=progress)
    shown = [
        table([key.replace("_", " ") for key in rows[0]], [[f"{x:.4g}" for x in row.values()] for row in rows], source)
        for source, rows in results.items()
    ]
    return Report({"fig5.json": results, "fig5.png": picture(results)}, shown)


if __name__ == "__main__":
    main(report, {"data": OPTIONAL_PATH})
