"""Fig. 9 (B-D) on images that no model of ours rendered: every method with its defaults on ray-traced captures.

`gs-jax benchmark` compares times and, on simulated particles, quality. Here every method does what the command line
does with a whole capture (exact refraction, aberrations, clipped lenses, noise, a camera's offset): 120 points between
18 and 22 mm, and letters in three of nine planes. Iterative methods take 20 steps with all of the light in their model;
back-projection and what follows it get the same voxels, four pixels wide. The truth of the points, and the points that
a method finds, are as wide as the microscope resolves (Eq. 5: a voxel); zeros are the floor, the truth itself is the
ceiling. F1 is that of as many of the brightest peaks of a volume, or points found, as scores best: a threshold that no
user has, and that favours the volumes.

    python -m experiments.fig9_benchmark DATA [--out DIR]

DATA holds `P1.toml`, `P1_d.tif`, `P1_h.tif` and their truth, `d.json` and `h.json`. Points match within 0.1 mm
laterally and 0.6 mm axially: the voxels are coarse. Writes `captures.json`, `captures.md` and `captures.png`; about
QQ minutes on two cores.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Num
from matplotlib.figure import Figure

from experiments.common import Report, main, points_of
from experiments.profiles import local_maxima
from experiments.true_image import strokes
from gs_jax import Grid, Imager
from gs_jax.base.progress import Progress
from gs_jax.benchmark.measure import timed
from gs_jax.benchmark.report import markdown_table
from gs_jax.benchmark.scenes import spots
from gs_jax.designs.design import read_design
from gs_jax.io.captures import read_capture
from gs_jax.metrics import localization, quality
from gs_jax.optics.theory import FWHM
from gs_jax.reconstruction.methods import METHODS
from gs_jax.reconstruction.pipeline import COARSE, reconstruct, voxel_grid
from gs_jax.simulation.phantoms import rasterize
from gs_jax.suppression.clustering import find_clusters
from gs_jax.suppression.locate import find_points
from gs_jax.suppression.unet import pretrained, suppress

ITERATIVE = ("list-rl", "richardson-lucy", "fista", "admm")
STEPS = 20
# Of the largest value: what is darker is no peak.
DARKEST = 0.01
DEPTHS = {"d": np.arange(17.6, 22.41, 0.6), "h": np.arange(18.0, 22.01, 0.5)}


class Scene(NamedTuple):
    image: Num[np.ndarray, "row column"]
    imager: Imager
    grid: Grid
    truth: Float32[np.ndarray, "depth y x"]
    points: np.ndarray | None  # (x, y, z, flux), if the scene is points


def read(data: Path, name: str) -> Scene:
    """A capture, the voxels that iterative methods have by default, and the truth on them."""
    imager = read_design(data / "P1.toml").imager()
    image = read_capture(data / f"P1_{name}.tif", imager.sensor.shape)
    grid = voxel_grid(imager, list(DEPTHS[name]), pixels=COARSE)
    if name == "d":
        points = points_of(data, "d")
        return Scene(image, imager, grid, spots(points, grid, grid.pitch / FWHM), points)
    words = json.loads((data / "h.json").read_text())["planes"]
    emitters = np.concatenate([strokes(word) for word in words])
    return Scene(image, imager, grid, np.asarray(rasterize(emitters, grid), np.float32), None)


class Result(NamedTuple):
    """A volume, and the points `(x, y, z, intensity)` that it was made of, if it was."""

    volume: np.ndarray
    points: np.ndarray | None = None


def methods(s: Scene, steps: int, progress: Progress) -> dict[str, Callable[[], Result]]:
    """Every method, as a call without arguments."""
    solve = lambda name: reconstruct(s.image, s.imager, s.grid, METHODS[name](steps), progress=progress)
    of = lambda points: Result(spots(points, s.grid, float(s.grid.pitch) / FWHM), points)
    return {
        "zeros": lambda: Result(np.zeros_like(s.truth)),
        "backproject": lambda: Result(solve("backproject")),
        "backproject + points": lambda: of(find_points(s.image, s.imager, s.grid, progress=progress)),
        "backproject + clusters": lambda: of(find_clusters(solve("backproject"), s.grid)),
        "backproject + unet": lambda: Result(suppress(solve("backproject"), pretrained())),
        **{name: (lambda name=name: Result(solve(name))) for name in ITERATIVE},
        "truth": lambda: Result(s.truth),
    }


def best_f1(result: Result, s: Scene) -> float | None:
    """F1 of the number of brightest points that scores best."""
    if s.points is None:
        return None
    found = result.points
    if found is None:
        found = local_maxima(result.volume, s.grid, min_distance=1, threshold_rel=DARKEST)
    found = found[np.argsort(-found[:, 3], kind="stable")]
    numbers = np.unique(np.geomspace(1, max(len(found), 1), 100).round().astype(int))
    return max(localization(found[:n], s.points, axial=0.6).f1 for n in numbers)


def run(
    data: Path, scenes: Sequence[str] = ("d", "h"), *, steps: int = STEPS, progress: Progress
) -> tuple[dict, dict[str, np.ndarray]]:
    """What `captures.json` holds, and maxima over the depths by title."""
    rows, pictures = [], {}
    for name in scenes:
        s = read(data, name)
        for method, call in progress.track(methods(s, steps, progress).items(), f"Scene {name}"):
            seconds, result = timed(call)
            q = quality(result.volume, s.truth)
            scores = {"psnr_db": q.psnr_db, "ssim": q.ssim, "mse": q.mse, "f1": best_f1(result, s)}
            rows.append({"scene": name, "method": method, "seconds": seconds} | scores)
            pictures[f"{name}: {method}"] = result.volume.max(0)
    return {"rows": rows}, pictures


def markdown(found: dict) -> str:
    head = ("scene", "method", "s, with compilation", "PSNR, dB", "SSIM", "MSE", "F1")
    pretty = lambda value, form: "-" if value is None else format(value, form)
    forms = {"seconds": ".1f", "psnr_db": ".2f", "ssim": ".3f", "mse": ".2e", "f1": ".2f"}
    rows = [[r["scene"], r["method"], *(pretty(r[key], form) for key, form in forms.items())] for r in found["rows"]]
    return markdown_table(head, rows) + "\n"


def picture(pictures: dict[str, np.ndarray], half_mm: float) -> Figure:
    """Maxima over the depths, each up to its 99.9th percentile."""
    columns = 4
    rows = -(-len(pictures) // columns)
    figure = Figure(figsize=(12, 3.1 * rows), dpi=80, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat[len(pictures) :]:
        axis.set_axis_off()
    for axis, (title, image) in zip(axes.flat, pictures.items(), strict=False):
        top = np.percentile(image, 99.9)
        axis.imshow(image, cmap="magma", vmin=0, vmax=top or None, extent=(-half_mm, half_mm, half_mm, -half_mm))
        axis.set_title(title, fontsize=9)
        axis.tick_params(labelsize=7)
    figure.supxlabel("x, mm", fontsize=9)
    figure.supylabel("y, mm", fontsize=9)
    return figure


def report(data: Path, progress: Progress) -> Report:
    found, pictures = run(data, progress=progress)
    text = markdown(found)
    files = {"captures.json": found, "captures.md": text, "captures.png": picture(pictures, 5120 * 0.0045 / 2)}
    return Report(files, [text])


if __name__ == "__main__":
    main(report, {"data": {"type": Path}}, folder="fig9")
