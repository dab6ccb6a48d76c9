"""Fig. 9 (B-D) on ray-traced images: every method with its defaults on whole captures.

Another group's tracer made three captures: points, letters and a USAF target. Our own tracer, which shares no code with
the package, made an inclined snowflake with the same lenses, and letters with other lenses, layout and depths. True
points, and points that a method detects, are rendered as wide as the microscope resolves (Eq. 5: a voxel), and match
within 0.1 mm laterally and 0.6 mm axially. F1 is that of the number of brightest peaks of a volume, or points, that
scores best: a threshold that no user has, and that favours the volumes. "Imaged again" is the difference between the
volume's image and the capture (`gs_jax.forward_residual`).

    python -m experiments.fig9_benchmark DATA [--out DIR] [--scenes letters,points] [--weights FILE]

DATA holds `P1.toml`, `P1_*.tif` and their truth, `*.json`; FILE is the output of `gs-jax train --network unrolled`.
Writes `captures.json`, `captures.md` and `captures.png`; about ten minutes a scene on two cores.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float32, Num
from matplotlib.figure import Figure

import gs_jax as gs
from experiments.common import Report, local_maxima, main, names_of, points_of, tables_report
from experiments.phantoms import snowflake
from experiments.ray_tracer import traced
from experiments.true_image import DEVICES, target, words
from gs_jax.apps.benchmark import render_points, timed
from gs_jax.apps.pictures import draw_image, label_of
from gs_jax.detection.particles import find_clusters
from gs_jax.detection.unet import pretrained
from gs_jax.optics.theory import FWHM
from gs_jax.reconstruction.networks import read_unrolled
from gs_jax.reconstruction.pipeline import METHODS, PIXELS_PER_VOXEL, voxel_grid
from gs_jax.simulation import letters

ITERATIVE = ("list-rl", "richardson-lucy", "fista", "admm")
STEPS = 20
# Peaks below this fraction of the largest value are ignored.
DARKEST = 0.01
# Rays from each emitter to each lens.
_RAYS = 8


class Scene(NamedTuple):
    image: Num[np.ndarray, "row column"]
    imager: gs.Imager
    grid: gs.Grid
    truth: Float32[np.ndarray, "depth y x"]
    points: np.ndarray | None = None  # (x, y, z, flux), if the scene is points


def _captured(data: Path, name: str, depths: np.ndarray, emitters: np.ndarray | None) -> Scene:
    """Load a capture of the other group's tracer, on the default voxels of iterative methods."""
    imager = gs.read_design(data / "P1.toml").imager()
    image = gs.read_capture(data / f"P1_{name}.tif", imager.sensor.shape)
    grid = voxel_grid(imager, list(depths), pixels=PIXELS_PER_VOXEL)
    if emitters is None:
        points = points_of(data, name)
        return Scene(image, imager, grid, render_points(points, grid, grid.pitch / FWHM), points)
    return Scene(image, imager, grid, np.asarray(gs.rasterize(emitters, grid), np.float32))


def _traced(imager: gs.Imager, depths: np.ndarray, emitters: np.ndarray) -> Scene:
    grid = voxel_grid(imager, list(depths), pixels=PIXELS_PER_VOXEL)
    light = traced(emitters, imager, _RAYS)
    image = np.asarray(gs.expose(light, gs.Camera(), jax.random.key(0), peak_electrons=10_000))
    return Scene(image, imager, grid, np.asarray(gs.rasterize(emitters, grid), np.float32))


def _points(data: Path) -> Scene:
    return _captured(data, "d", np.arange(17.6, 22.41, 0.6), None)


def _letters(data: Path) -> Scene:
    return _captured(data, "h", np.arange(18.0, 22.01, 0.5), words(data / "h.json"))


def _target(data: Path) -> Scene:
    return _captured(data, "f", np.arange(17.0, 20.01, 0.5), target(data / "f.json"))


def _snowflake(data: Path) -> Scene:
    flake = snowflake((18.0, 22.0), size=14.0, tilt=0.4, width=0.5, pitch=0.03)
    return _traced(gs.read_design(data / "P1.toml").imager(), np.arange(18.0, 22.01, 0.5), flake)


def _other_lenses(data: Path) -> Scene:
    device = DEVICES["R = 1.6"]
    places = zip("HTL", (12.5, 14.0, 15.5), ((-3.0, -2.4), (0.0, 2.4), (3.0, -1.2)), strict=True)
    emitters = [letters(a, depth=z, height=2.4, pitch=0.02) + np.array([*xy, 0, 0]) for a, z, xy in places]
    return _traced(device.imager(), np.arange(12.5, 15.51, 0.5), np.concatenate(emitters))


SCENES: dict[str, Callable[[Path], Scene]] = {
    "points": _points,
    "letters": _letters,
    "USAF target": _target,
    "snowflake": _snowflake,
    "letters of other lenses": _other_lenses,
}


# These scenes have +y upwards.
_UPWARD = ("letters",)


class View(NamedTuple):
    """Maxima over the depths, and their extent `(left, right, bottom, top)`, mm."""

    maxima: np.ndarray
    extent: tuple[float, float, float, float]


class Result(NamedTuple):
    """A volume, and the points `(x, y, z, intensity)` it was rendered from, if any."""

    volume: np.ndarray
    points: np.ndarray | None = None


def methods(s: Scene, networks: gs.Unrolled, steps: int, progress: gs.Progress) -> dict[str, Callable[[], Result]]:
    """Every method as a function without arguments, by name."""
    by = lambda method: gs.reconstruct(s.image, s.imager, s.grid, method, progress=progress)
    solve = lambda name: by(METHODS[name](steps))
    of = lambda points: Result(render_points(points, s.grid, float(s.grid.pitch) / FWHM), points)
    return {
        "zeros": lambda: Result(np.zeros_like(s.truth)),
        "backproject": lambda: Result(solve("backproject")),
        "backproject + points": lambda: of(gs.find_points(s.image, s.imager, s.grid, progress=progress)),
        "backproject + clusters": lambda: of(find_clusters(solve("backproject"), s.grid)),
        "backproject + paper's U-Net": lambda: Result(gs.suppress(solve("backproject"), pretrained("paper"))),
        "backproject + our U-Net": lambda: Result(gs.suppress(solve("backproject"), pretrained())),
        "unrolled": lambda: Result(by(networks)),
        "surface": lambda: Result(by(gs.Surface())),
        **{name: (lambda name=name: Result(solve(name))) for name in ITERATIVE},
        "truth": lambda: Result(s.truth),
    }


def best_f1(result: Result, s: Scene) -> float | None:
    """F1 of the number of brightest points that scores best."""
    if s.points is None:
        return None
    results = result.points
    if results is None:
        results = local_maxima(result.volume, s.grid, min_distance=1, threshold_rel=DARKEST)
    results = results[np.argsort(-results[:, 3], kind="stable")]
    numbers = np.unique(np.geomspace(1, max(len(results), 1), 100).round().astype(int))
    return max(gs.localization(results[:n], s.points, axial=0.6).f1 for n in numbers)


def run(
    data: Path,
    networks: gs.Unrolled,
    scenes: Sequence[str] = tuple(SCENES),
    *,
    steps: int = STEPS,
    progress: gs.Progress,
) -> tuple[dict, dict[tuple[str, str], View]]:
    """Return the content of `captures.json`, and maxima over the depths by scene and method."""
    rows, pictures = [], {}
    for name in scenes:
        s = SCENES[name](data)
        for method, call in progress.track(methods(s, networks, steps, progress).items(), name):
            seconds, result = timed(call)
            q = gs.quality(result.volume, s.truth)
            scores = {"psnr_db": q.psnr_db, "ssim": q.ssim, "mse": q.mse, "f1": best_f1(result, s)}
            again = gs.forward_residual(result.volume, s.image, s.imager, s.grid, progress=progress).error
            rows.append({"scene": name, "method": method, "seconds": seconds} | scores | {"reprojection": again})
            pictures[name, method] = View(result.volume.max(0), s.grid.extent)
    return {"rows": rows}, pictures


def rows_of(results: dict) -> tuple[tuple[str, ...], list[list[str]]]:
    """Columns and rows of the table."""
    head = ("scene", "method", "s, with compilation", "PSNR, dB", "SSIM", "MSE", "F1", "imaged again")
    pretty = lambda value, form: "-" if value is None else format(value, form)
    forms = {"seconds": ".1f", "psnr_db": ".2f", "ssim": ".3f", "mse": ".2e", "f1": ".2f", "reprojection": ".3f"}
    rows = [[r["scene"], r["method"], *(pretty(r[key], form) for key, form in forms.items())] for r in results["rows"]]
    return head, rows


def picture(pictures: dict[tuple[str, str], View]) -> Figure:
    """Plot maxima over the depths, each up to its 99.9th percentile."""
    columns = 4
    rows = -(-len(pictures) // columns)
    figure = Figure(figsize=(12, 3.2 * rows), dpi=66, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat[len(pictures) :]:
        axis.set_axis_off()
    for axis, ((scene, method), view) in zip(axes.flat, pictures.items(), strict=False):
        draw_image(
            axis, view.maxima, view.extent, high=float(np.percentile(view.maxima, 99.9)), upward=scene in _UPWARD
        )
        axis.set_title(f"{scene}: {label_of(method)}", fontsize=11)
    said = "Maxima over the depths, each from zero to its 99.9th percentile"
    drawn = "; +y upwards, as the scene was drawn" if any(scene in _UPWARD for scene, _ in pictures) else ""
    figure.supxlabel(said + drawn, fontsize=10)
    return figure


def report(data: Path, scenes: list[str], weights: Path | None, progress: gs.Progress) -> Report:
    networks = read_unrolled(weights) if weights else gs.Unrolled.pretrained()
    results, pictures = run(data, networks, scenes, progress=progress)
    return tables_report("captures", results, rows_of(results), png=picture(pictures))


if __name__ == "__main__":
    scenes = {"type": names_of(SCENES), "default": list(SCENES)}
    main(report, {"data": {"type": Path}, "--scenes": scenes, "--weights": {"type": Path}}, folder="fig9")
