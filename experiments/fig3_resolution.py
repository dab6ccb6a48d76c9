"""Fig. 3: width of a reconstructed point at 20 mm, and resolution of two points.

Points at 20 mm (one alone, two 40 um apart laterally, two 300 um apart axially) are imaged by the focused design
and back-projected. Images come from our forward model with diffraction and, if DATA is given, from an independent ray
tracer. The paper reports about 40 um and 300 um FWHM, and both pairs resolved, the lateral one with a dip to about
85 %.

    python -m experiments.fig3_resolution [DATA] [--out DIR]

DATA holds `P1.toml` and `P1_a.tif`, `P1_b.tif`, `P1_c.tif`. Without it the built-in design is used.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.common import OPTIONAL_PATH, Report, design_of, main, table
from experiments.profiles import around_the_axis, dip, fwhm, through_peak
from gs_jax.base.progress import Progress
from gs_jax.design.design import Design
from gs_jax.io.captures import read_capture
from gs_jax.simulation.synthetic import simulate_points

SCENES = {
    "a": [[0.0, 0.0, 20.0, 1.0]],
    "b": [[-0.02, 0.0, 20.0, 1.0], [0.02, 0.0, 20.0, 1.0]],
    "c": [[0.0, 0.0, 19.85, 1.0], [0.0, 0.0, 20.15, 1.0]],
}
BARS = {"lateral_fwhm_um": 40, "axial_fwhm_um": 300, "lateral_dip": 0.85, "axial_dip": 0.85}


def run(design: Design, data: Path | None, *, progress: Progress) -> dict:
    """Return the profiles of each scene, and the four numbers, for every source of images."""
    imager = design.imager()
    images = {"gs_jax": lambda name: _simulated(SCENES[name], imager, progress)}
    if data is not None:
        images["ray-traced"] = lambda name: _captured(data / f"P1_{name}.tif", imager)
    results = {}
    for source, image in images.items():
        lines = {name: through_peak(*around_the_axis(image(name), imager, 20.0)) for name in SCENES}
        results[source] = {"profiles": lines} | {
            "lateral_fwhm_um": 1000 * max(fwhm(*lines["a"]["x"]), fwhm(*lines["a"]["y"])),
            "axial_fwhm_um": 1000 * fwhm(*lines["a"]["z"]),
            "lateral_dip": dip(*lines["b"]["x"]),
            "axial_dip": dip(*lines["c"]["z"]),
        }
    return results


def _simulated(points, imager, progress):
    return simulate_points(np.array(points), imager, progress=progress)


def _captured(path, imager):
    return read_capture(path, imager.sensor.shape).astype(np.float32) - 16


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
        axes.set(
            title=title,
            xlabel="x, um" if axis == "x" else "z, mm",
            ylabel="back-projection, of its peak",
            ylim=(0, 1.05),
        )
    figure.axes[0].legend()
    return figure


def numbers(results: dict) -> dict:
    """Results without the profiles."""
    return {source: {key: result[key] for key in BARS} for source, result in results.items()}


def report(data: Path | None, progress: Progress) -> Report:
    results = run(design_of(data), data, progress=progress)
    rows = [[key, f"{bar:g}", *(f"{result[key]:.3g}" for result in results.values())] for key, bar in BARS.items()]
    shown = table(("", "at most", *results), rows, "Resolution of back-projection at 20 mm")
    return Report({"fig3.json": numbers(results), "fig3.png": picture(results)}, [shown])


if __name__ == "__main__":
    main(report, {"data": OPTIONAL_PATH})
