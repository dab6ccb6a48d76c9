"""Sharpness of the optimised design at every depth, against the paper's design in focus.

The prescription (v, R, D and the pitch) was optimised for the width of exact rays' spots. Here a point on the axis is
imaged with the diffraction PSF on the sensor's pixels, and back-projected on voxels much finer than the spot. This PSF
is the one on the lens axis; spots off the axis are evaluated separately, by the same diffraction integral.

    python -m experiments.prescription [--out DIR]
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from matplotlib.figure import Figure

from experiments.common import Report, main, table
from experiments.profiles import fwhm
from gs_jax import Grid, Imager, Sensor, backproject
from gs_jax.base.progress import Progress
from gs_jax.design.design import Design, read_design
from gs_jax.optics.apertures import clear_diameter
from gs_jax.optics.psf import diffraction_psf
from gs_jax.simulation.synthetic import simulate_points

FOLDER = Path(__file__).parents[1] / "design"
DESIGNS = ("geomscope", "geomscope-optimized")
DEPTHS = (18.0, 20.0, 23.0)
# Field heights at which a lens is evaluated, mm.
FIELDS = (0.0, 1.5, 2.5)
# Voxel and half width of the reconstruction, mm, and frequency of lines of 40 um, cycles/mm.
VOXEL, HALF, LINES = 0.004, 0.4, 12.5
# Pixels of the sensor and of the PSF's window, for 3 mm of lenses and a blur of 0.7 mm.
PIXELS, WINDOW = 2048, 161


def run(names: Sequence[str] = DESIGNS, depths: Sequence[float] = DEPTHS, *, progress: Progress) -> dict[str, Any]:
    """Return for each design one record per depth; lengths in um, in the object."""
    results: dict[str, Any] = {}
    for name in names:
        design = read_design(FOLDER / f"{name}.toml")
        imager = _cropped(design.imager())
        results[name] = [_at(design, imager, z, progress) for z in progress.track(depths, name)]
    return results


def _cropped(imager: Imager) -> Imager:
    """The middle of the sensor, which holds all light of a point on the axis."""
    return eqx.tree_at(lambda i: i.sensor, imager, Sensor((PIXELS, PIXELS), imager.sensor.pixel_pitch))


def _at(design: Design, imager: Imager, depth: float, progress: Progress) -> dict[str, float]:
    image = simulate_points(np.array([[0, 0, depth, 1.0]]), imager, progress=progress)
    side = 2 * round(HALF / VOXEL) + 1
    grid = Grid([depth], (side, side), VOXEL)
    spot = np.asarray(backproject(image, imager, grid), np.float64)[0]
    axis = np.asarray(grid.x, np.float64)
    row, column = np.unravel_index(int(spot.argmax()), spot.shape)
    results = {
        "depth_mm": depth,
        "fwhm_um": 500 * (fwhm(axis, spot[row]) + fwhm(axis, spot[:, column])),
        "half_of_light_um": 1000 * encircled(spot, VOXEL, 0.5),
        "most_of_light_um": 1000 * encircled(spot, VOXEL, 0.8),
        "contrast_of_40_um_lines": contrast(spot, axis),
    }
    return results | {f"most_of_light_field_{h:g}_mm_um": _unit(imager, depth, h) for h in FIELDS}


def _unit(imager: Imager, depth: float, height: float) -> float:
    """Radius of 80 % of one lens's light, in the object, um."""
    radius = clear_diameter(imager.array) / 2
    sharp = float(2 * radius * imager.sensor.pixel_pitch / (imager.wavelength * imager.sensor_distance))
    options: dict[str, Any] = dict(size=WINDOW, field=(height, 0.0), radius=radius)
    pixels = diffraction_psf(imager, depth, samples=int(np.ceil(sharp)), **options)
    pitch = imager.sensor.pixel_pitch / float(imager.magnification(depth))
    return 1000 * encircled(np.asarray(pixels, np.float64), pitch, 0.8)


def encircled(spot: np.ndarray, pitch: float, share: float) -> float:
    """Radius about the centroid that holds a share of the light."""
    row, column = np.indices(spot.shape)
    total = spot.sum()
    middle = (spot * row).sum() / total, (spot * column).sum() / total
    radius = np.hypot(row - middle[0], column - middle[1]).ravel()
    order = np.argsort(radius)
    return float(np.interp(share, np.cumsum(spot.ravel()[order]) / total, radius[order])) * pitch


def contrast(spot: np.ndarray, axis: np.ndarray) -> float:
    """Modulation of lines as wide as their gaps, at their fundamental frequency, along x."""
    return float(np.abs(spot.sum(0) @ np.exp(2j * np.pi * LINES * axis)) / spot.sum())


def picture(results: dict[str, Any]) -> Figure:
    """Plot widths and contrast against depth, one colour per design."""
    figure = Figure(figsize=(12, 3.8), dpi=110, layout="constrained")
    panels = {
        "fwhm_um": "full width at half maximum, um",
        "most_of_light_um": "radius of 80 % of the light, um",
        "contrast_of_40_um_lines": "contrast of 40 um lines",
    }
    for axes, (key, label) in zip(figure.subplots(1, 3), panels.items(), strict=True):
        for number, (name, records) in enumerate(results.items()):
            depths = [record["depth_mm"] for record in records]
            axes.plot(depths, [record[key] for record in records], "o-", color=f"C{number}", label=name)
        axes.set(xlabel="depth, mm", ylabel=label, ylim=(0, None))
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.suptitle("Back-projected point on the axis, diffraction PSF", fontsize=10)
    return figure


def report(progress: Progress) -> Report:
    results = run(progress=progress)
    shown = [
        table(records[0], [[f"{value:.3g}" for value in record.values()] for record in records], name)
        for name, records in results.items()
    ]
    return Report({"prescription.json": results, "prescription.png": picture(results)}, shown)


if __name__ == "__main__":
    main(report)
