"""Figs. 4 and 8: background suppression by networks, for a snowflake, letters and a resolution target.

Captures are back-projected and then cleaned by the paper's network, which sees one slice at a time, and by ours, which
sees seven. Neither saw these scenes or this layout in training. Two captures come from an independent ray tracer (if
DATA is given), two from points that are finer than any voxel, with all light, and all have camera noise. The truth is
the scene on the voxels, blurred laterally by one voxel, so that sub-voxel shifts do not matter.

    python -m experiments.fig8_snowflake [DATA] [--out DIR]

DATA holds `P1.toml`, `P1_h.tif`, `P1_f.tif` and their scenes `h.json`, `f.json`. Without it the built-in design and
only the simulated captures are used.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from rich.json import JSON
from scipy.ndimage import gaussian_filter

import gs_jax as gs
from experiments import true_image
from experiments.common import OPTIONAL_PATH, Report, design_of, main, table
from experiments.phantoms import snowflake
from gs_jax.apps.example_pipeline import words
from gs_jax.apps.pictures import draw_image, label_of
from gs_jax.detection.unet import pretrained
from gs_jax.simulation import electrons, simulate_points

DEPTHS = tuple(np.arange(17.0, 23.01, 0.5))
VOXEL_MM = 0.04
# Spacing of emitters, fine enough to leave no dots in the image and no pattern in the truth.
EMITTERS_MM = 0.03
PEAK_ELECTRONS = 10_000
# Half the side of the square in which the resolution target is scored.
_TARGET_MM = 2.8
METHODS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "all zero": np.zeros_like,
    "back-projection": lambda volume: volume,
    "paper's network": lambda volume: gs.suppress(volume, pretrained("paper")),
    "our network": lambda volume: gs.suppress(volume, pretrained("multislice")),
}

NETWORKS = "paper's network", "our network"


def run(design: gs.Design, data: Path | None, *, voxel_mm: float = VOXEL_MM, progress: gs.Progress) -> dict:
    """Return per scene the truth, volumes and scores by method, and the response to noise."""
    imager = design.imager()
    grid = gs.Grid.over(imager.sensor, depths=DEPTHS, pitch=voxel_mm)
    flake = snowflake((18.0, 22.0), size=14.0, tilt=0.4, width=0.5, pitch=EMITTERS_MM)
    captures = {}
    for name, emitters in (("snowflake, simulated", flake), ("letters, simulated", words(EMITTERS_MM))):
        light = simulate_points(emitters, imager, kind="full", progress=progress)
        counts = gs.expose(np.maximum(light, 0), gs.Camera(), jax.random.key(0), peak_electrons=PEAK_ELECTRONS)
        captures[name] = np.asarray(counts), emitters
    if data:
        for name, scene, emitters_of in (("letters", "h", true_image.words), ("USAF target", "f", true_image.target)):
            image = gs.read_capture(data / f"P1_{scene}.tif", imager.sensor.shape)
            captures[f"{name}, ray-traced"] = image, emitters_of(data / f"{scene}.json")
    scenes = {}
    for name, (counts, emitters) in captures.items():
        truth = gaussian_filter(np.asarray(gs.rasterize(emitters, grid), np.float32), (0, 1, 1))
        # The target is small; reconstruct only its part of the field.
        half = round(_TARGET_MM / voxel_mm) if "USAF" in name else max(grid.shape)
        part = slice(None), *(slice(max(n // 2 - half, 0), n // 2 + half + 1) for n in grid.shape)
        volume = _back_projected(counts, imager, grid, progress)[part]
        volumes = {method: function(volume) for method, function in METHODS.items()}
        scores = {method: gs.quality(cleaned, truth[part])._asdict() for method, cleaned in volumes.items()}
        scenes[name] = {"truth": truth[part], "volumes": volumes, "scores": scores}
    return {"scenes": scenes, "noise": _of_noise(imager, grid, progress)}


def _back_projected(counts: np.ndarray, imager: gs.Imager, grid: gs.Grid, progress: gs.Progress) -> np.ndarray:
    return gs.reconstruct(electrons(counts, gs.Camera()), imager, grid, progress=progress)


def _of_noise(imager: gs.Imager, grid: gs.Grid, progress: gs.Progress) -> dict:
    """Largest output of the networks for captures without an object, in standard deviations of the volume.

    The captures are dark with read noise, and uniformly lit with shot noise.
    """
    results = {name: {} for name in ("dark", "evenly lit")}
    for name, image in zip(results, (np.zeros, np.ones), strict=True):
        counts = gs.expose(image(imager.sensor.shape, np.float32), gs.Camera(), jax.random.key(1), peak_electrons=100)
        volume = _back_projected(np.asarray(counts), imager, grid, progress)
        for method in NETWORKS:
            made = METHODS[method](volume)
            results[name][method] = {
                "largest_by_sd": float(made.max() / volume.std()),
                "rms_by_rms": float(np.sqrt(np.mean(made**2) / np.mean(volume**2))),
            }
    return results


def picture(scene: dict, shown: tuple[float, ...] = (18.0, 20.0, 22.0), *, upward: bool = False) -> Figure:
    """Plot planes of the truth and of each method's volume, from zero to its 99.99th percentile."""
    columns = {"truth": scene["truth"]} | {
        k: v for k, v in scene["volumes"].items() if k in ("back-projection", *NETWORKS)
    }
    rows, cols = np.nonzero(gaussian_filter(scene["truth"].max(0), 10) > 1e-3 * scene["truth"].max())
    crop = slice(rows.min(), rows.max() + 1), slice(cols.min(), cols.max() + 1)
    half = VOXEL_MM * (np.array(scene["truth"].shape[1:]) - 1) / 2
    left, right = VOXEL_MM * np.array([crop[1].start - 0.5, crop[1].stop - 0.5]) - half[1]
    top, bottom = VOXEL_MM * np.array([crop[0].start - 0.5, crop[0].stop - 0.5]) - half[0]
    extent = (left, right, bottom, top)
    figure = Figure(figsize=(3.1 * len(columns), 3.1 * len(shown)), dpi=90, layout="constrained")
    for line, depth in zip(figure.subplots(len(shown), len(columns), squeeze=False), shown, strict=True):
        for axes, (name, volume) in zip(line, columns.items(), strict=True):
            plane = volume[int(np.argmin(np.abs(np.array(DEPTHS) - depth)))][crop]
            draw_image(axes, plane, extent, high=float(np.quantile(volume, 0.9999)), upward=upward)
            if depth == shown[0]:
                axes.set_title(label_of(name))
        line[0].set_ylabel(f"{depth:g} mm")
    drawn = ", +y upwards, as the scene was drawn" if upward else ""
    figure.supxlabel(f"Each volume from zero to its 99.99th percentile{drawn}", fontsize=8)
    return figure


def report(data: Path | None, progress: gs.Progress) -> Report:
    results = run(design_of(data), data, progress=progress)
    scores = {name: scene["scores"] for name, scene in results["scenes"].items()}
    files: dict[str, Any] = {"fig8.json": results | {"scenes": scores}}
    tables = []
    for name, scene in results["scenes"].items():
        shown = (18.0,) if "USAF" in name else (18.0, 20.0, 22.0)
        files[f"{name.replace(', ', '_').replace(' ', '_')}.png"] = picture(scene, shown, upward="ray-traced" in name)
        base = scene["scores"]["back-projection"]["mse"]
        rows = [
            [method, f"{s['psnr_db']:.2f}", f"{s['ssim']:.4f}", f"{s['mse']:.3g}", f"{s['mse'] / base:.3f}"]
            for method, s in scene["scores"].items()
        ]
        tables.append(table(("method", "PSNR, dB", "SSIM", "MSE", "MSE, of back-projection's"), rows, name))
    return Report(files, [*tables, JSON.from_data(results["noise"])])


if __name__ == "__main__":
    main(report, {"data": OPTIONAL_PATH})
