"""The example pipeline of `gs-jax demo`: evaluates and optimises a microscope, images with it, and makes its mold."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from ..base.machine import release_memory, share_heaps
from ..base.progress import Progress
from ..base.typing import PathLike
from ..codesign.search import run_study
from ..codesign.search_report import as_records, write_outcome
from ..design.datasheets import datasheet, findings
from ..design.design import write_design
from ..design.start import geomscope
from ..detection.point_finder import find_points
from ..detection.unet import pretrained, suppress
from ..io.captures import write_capture
from ..io.files import make_folder, write_figure, write_json, write_text
from ..io.point_tables import write_points
from ..io.volumes import write_volume
from ..metrics import Localization, Quality, localization, quality
from ..microscope.geometry import Imager
from ..microscope.grid import Grid, Sensor
from ..microscope.layouts import nearest_neighbour_distances
from ..mold.make import make_mold
from ..reconstruction.pipeline import Reconstructor, reconstruct
from ..simulation import Camera, expose, letters, random_points, rasterize, simulate
from ..solvers.admm import ADMM
from ..solvers.richardson_lucy import RichardsonLucy
from ..solvers.unrolled import Unrolled
from .drawings import template
from .pictures import downsample, draw_image
from .report import write_report

# Finer than the voxels and no part of them; a pixel on the sensor at most, where it is divided in two.
_SCENE_MM = 0.0145
# Voxels of the words. Networks see planes between and beyond theirs; each step of a solver costs a hundred
# back-projections, so that solvers have the planes of the words.
_WORD_DEPTHS, _WORD_PLANES, _WORD_VOXEL_MM = np.arange(17.0, 23.01, 0.5), slice(2, 11, 4), 0.11
_STEPS, _LUCY_STEPS = 6, 16
# Voxels in which points are found.
_POINT_DEPTHS, _POINT_VOXEL_MM = np.arange(17.0, 23.01, 0.5), 0.0415
_POINTS = 60
_PEAK_ELECTRONS = 10_000
# Depth, text and centre of each word, and the height of its capitals, mm.
WORDS = ((18.0, "near", (-4.0, -5.0)), (20.0, "focus", (0.0, 0.0)), (22.0, "far", (4.0, 5.0)))
_WORD_HEIGHT = 2.5
# In the picture: part of the field with words, half of it, mm; pixels of the capture's middle; colours of the depths.
_SHOWN_MM, _MIDDLE, _COLOURS = 9.5, 900, ("#3d8bff", "#ffe45c", "#ff4538")
_TRUTH, _BEST = "truth", "unrolled inversion"
# Sentences of the page.
_NOTES = {
    "page": "By gs-jax demo, from simulated captures; report.md has the scores, the optimised design and the times.",
    "capture": "words.tif: three words at 18, 20 and 22 mm, simulated with noise.",
    "volume": f"words.ome.tif: the {_BEST}.",
    "points": "points-found.csv: found in points.tif, another capture.",
}


def run(folder: PathLike, progress: Progress | None = None) -> Path:
    """Run the pipeline and write a folder: designs, captures, volume, points, mold, pictures, reports.

    Returns
    -------
    Path
        Of the report in Markdown; `report.html` beside it is the report of the microscope.

    Raises
    ------
    InputError
        If the folder cannot be made or written to.
    """
    page = template("example_pipeline.md")
    folder, progress = make_folder(folder), progress or Progress()
    design, seconds = geomscope(), {}
    imager = design.imager()
    planes = Grid.over(imager.sensor, depths=_WORD_DEPTHS, pitch=_WORD_VOXEL_MM)
    grid = planes.at(planes.depths[_WORD_PLANES])
    solvers = {
        _BEST: Unrolled.pretrained(),
        f"ADMM, {_STEPS} steps": ADMM(_STEPS),
        f"Richardson-Lucy, {_LUCY_STEPS} steps": RichardsonLucy(_LUCY_STEPS, accelerate=True),
    }

    def solve(name: str, image: np.ndarray) -> np.ndarray:
        # Programs for wide voxels take longer to compile than all steps on so few.
        with _timed(seconds, name):
            solver = Reconstructor(imager, grid, solvers[name], wide=False, progress=progress)
            return solver(image, progress)

    def evaluate() -> dict[str, Any]:
        write_design(folder / "design.toml", design)
        with progress.step("Datasheet"), _timed(seconds, "design and metrics"):
            sheet = datasheet(design)
        write_json(folder / "metrics.json", sheet)
        return sheet

    def mold() -> dict[str, Any]:
        with _timed(seconds, "mold"):
            return make_mold(design, folder / "mold.stl", progress=progress)

    share_heaps()
    with ThreadPoolExecutor(1) as thread:
        # Beside the others, as it needs NumPy alone. Compiled programs are not safe to run at once.
        making = thread.submit(copy_context().run, mold)
        image = _image_words(folder, imager, seconds, progress)
        sheet = evaluate()
        targets = _optimise(folder, seconds, progress)
        views = _back_project(imager, planes, seconds, progress, image)
        found = {name: solve(name, image) for name in reversed(solvers)}
        points, score = _image_points(folder, imager, seconds, progress)
        with _timed(seconds, "report"):
            shown = {"image": image, "volume": found[_BEST], "grid": grid, "points": points, "notes": _NOTES}
            write_report(folder / "report.html", design, **shown, progress=progress)
        checks = making.result()
    truth = gaussian_filter(np.asarray(rasterize(words(_SCENE_MM), grid)), (0, 1, 1))
    volumes = {_TRUTH: truth} | views | found
    write_volume(folder / "words.ome.tif", volumes[_BEST], grid)
    scores = {"nothing (all zero)": quality(np.zeros_like(truth), truth)}
    scores |= {name: quality(volume, truth) for name, volume in volumes.items() if name != _TRUTH}
    with progress.step("Drawing"):
        write_figure(folder / "words.png", _draw_words(image, imager.sensor, volumes, scores, grid))
    context = {
        "distances": nearest_neighbour_distances(np.array(design.array.centers_mm)),
        "findings": findings(design, sheet),
        "targets": targets,
        "scores": scores,
        "points": score,
        "mold": checks,
        "seconds": seconds,
    }
    write_text(folder / "report.md", page.render(context), [".md"])
    return folder / "report.md"


def _optimise(folder: Path, seconds: dict, progress: Progress) -> list[dict]:
    """Optimise the design as the paper prints it, out of focus, for the targets of the paper."""
    write_text(folder / "study.toml", template("example_study.toml").render(), [".toml"])
    printed = geomscope(sensor_distance_mm=4.0)
    write_design(folder / "printed.toml", printed)
    with _timed(seconds, "optimisation"):
        outcome = run_study(printed, folder / "study.toml", progress=progress)
        write_outcome(folder / "optimized.toml", outcome, parent="printed.toml", source="study.toml")
    return as_records(outcome)


def words(pitch: float) -> Float[np.ndarray, "emitter 4"]:
    """Emitters `(x, y, z, intensity)` of the words, `pitch` apart, mm."""
    parts = [letters(word, depth=z, height=_WORD_HEIGHT, pitch=pitch) + (x, y, 0, 0) for z, word, (x, y) in WORDS]
    return np.concatenate(parts)


def _image_words(folder: Path, imager: Imager, seconds: dict, progress: Progress) -> np.ndarray:
    """Write and return a capture of words at three depths."""
    grid = Grid.over(imager.sensor, depths=[z for z, _, _ in WORDS], pitch=_SCENE_MM)
    with _timed(seconds, "simulating words"):
        light = simulate(np.asarray(rasterize(words(_SCENE_MM), grid)), imager, grid, progress=progress)
        return _expose(light, folder / "words.tif", seed=0)


def _back_project(
    imager: Imager, planes: Grid, seconds: dict, progress: Progress, image: np.ndarray
) -> dict[str, np.ndarray]:
    """The planes of the words in the back-projection, as it is and after a network."""
    with _timed(seconds, "back-projection"):
        plain = reconstruct(image, imager, planes, progress=progress)
    with progress.step("Suppressing the background"), _timed(seconds, "U-Net"):
        clean = suppress(plain, pretrained())
    return {"back-projection": plain[_WORD_PLANES], "back-projection + U-Net": clean[_WORD_PLANES]}


def _image_points(folder: Path, imager: Imager, seconds: dict, progress: Progress) -> tuple[np.ndarray, Localization]:
    """Write a capture of points and those that are found in it; return these and their score."""
    truth = random_points(_POINTS, (20.0, 20.0), (19.0, 21.0), seed=1)
    with _timed(seconds, "simulating points"):
        light = simulate(truth, imager, progress=progress)
        image = _expose(light, folder / "points.tif", seed=1)
    del light
    with _timed(seconds, "finding points"):
        grid = Grid.over(imager.sensor, depths=_POINT_DEPTHS, pitch=_POINT_VOXEL_MM)
        found = find_points(image, imager, grid, progress=progress)
    write_points(folder / "points-truth.csv", truth)
    write_points(folder / "points-found.csv", found)
    score = localization(found, truth)
    write_figure(folder / "points.png", _draw_points(found, truth, score))
    return found, score


def _expose(light: np.ndarray, path: Path, seed: int) -> np.ndarray:
    counts = np.asarray(expose(light, Camera(), jax.random.key(seed), peak_electrons=_PEAK_ELECTRONS))
    write_capture(path, counts)
    return counts


@contextmanager
def _timed(seconds: dict[str, float], step: str) -> Iterator[None]:
    seconds[step], started = 0.0, perf_counter()  # in the order in which they start
    yield
    seconds[step] = perf_counter() - started
    release_memory()


def _draw_words(
    image: np.ndarray, sensor: Sensor, volumes: dict[str, np.ndarray], scores: dict[str, Quality], grid: Grid
) -> Figure:
    """The capture and its middle, and maxima of volumes along z with a colour for each depth."""
    figure = Figure(figsize=(14, 7.4), dpi=100, layout="constrained")
    axes = figure.subplots(2, 4)
    middle = image[tuple(slice((n - _MIDDLE) // 2, (n + _MIDDLE) // 2) for n in image.shape)]
    captures = {
        f"capture, {image.size / 1e6:.0f} megapixels": (downsample(image, 1280), sensor),
        "middle of the capture": (middle, Sensor(middle.shape, sensor.pixel_pitch)),
    }
    for axis, (title, (pixels, area)) in zip(axes[:, 0], captures.items(), strict=True):
        low, high = np.percentile(pixels, (1, 99.8))
        draw_image(axis, pixels, area.extent, low=low, high=high, cmap="gray")
        axis.set_title(title, fontsize=13)
    z, colours = np.asarray(grid.depths), LinearSegmentedColormap.from_list("depths", _COLOURS)
    depth_range = Normalize(z.min(), z.max())
    rows, columns = (abs(np.asarray(along)) < _SHOWN_MM for along in (grid.y, grid.x))
    for axis, (name, volume) in zip((*axes[0, 1:], *axes[1, 1:]), volumes.items(), strict=True):
        # Back-projection has a pedestal, which is no object.
        light = (volume - np.median(volume, (1, 2), keepdims=True))[:, rows][..., columns]
        share = np.clip(light / max(np.percentile(light.max(0), 99.7), 1e-30), 0, 1)
        shown = (share[..., None] * np.array(colours(depth_range(z)))[:, None, None, :3]).max(0)
        draw_image(axis, shown, (-_SHOWN_MM, _SHOWN_MM, _SHOWN_MM, -_SHOWN_MM))
        axis.set_title(f"{name}\n{scores[name].psnr_db:.1f} dB PSNR" if name in scores else name, fontsize=13)
    bar = figure.colorbar(ScalarMappable(depth_range, colours), ax=axes[:, 3], ticks=[z for z, _, _ in WORDS])
    bar.set_label("depth z, mm", fontsize=13)
    bar.ax.tick_params(labelsize=12)
    return figure


def _draw_points(found: np.ndarray, truth: np.ndarray, score: Localization) -> Figure:
    """True and found points in the plane, and the errors of matched pairs."""
    figure = Figure(figsize=(10, 4.4), dpi=110, layout="constrained")
    plane, errors = figure.subplots(1, 2)
    plane.scatter(truth[:, 0], truth[:, 1], s=60, facecolors="none", edgecolors="0.4", label="true")
    dots = plane.scatter(found[:, 0], found[:, 1], s=12, c=found[:, 2], cmap="viridis", label="found")
    plane.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")
    plane.invert_yaxis()
    plane.legend(loc="upper left", bbox_to_anchor=(0, 1.12), ncols=2, frameon=False)
    figure.colorbar(dots, ax=plane, label="z, mm")
    error = 1000 * (found[score.pairs[:, 0], :3] - truth[score.pairs[:, 1], :3])
    errors.scatter(np.hypot(error[:, 0], error[:, 1]), error[:, 2], s=12)
    errors.axhline(0, color="0.7", lw=0.8)
    errors.set(xlabel="lateral error, um", ylabel="axial error, um", title=f"{len(error)} of {len(truth)} points")
    return figure
