"""The demonstration: a microscope is judged, improved and used, and its mold is made."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter

import jax
import numpy as np
from scipy.ndimage import gaussian_filter

from ...base.progress import Progress
from ...codesign.outcome import as_records, write_outcome
from ...codesign.search import run_study
from ...design.builtin import geomscope
from ...design.design import Design, write_design
from ...design.problems import findings
from ...design.sheet import datasheet
from ...detection.locate import find_points
from ...detection.unet import pretrained, suppress
from ...grid import Grid
from ...io.captures import write_capture
from ...io.files import make_folder, write_figure, write_json, write_text
from ...io.point_tables import write_points
from ...io.volumes import write_volume
from ...metrics import localization, quality
from ...mold.make import make_mold
from ...reconstruction.pipeline import reconstruct
from ...simulation.camera import Camera, expose
from ...simulation.phantoms import random_points, rasterize
from ...simulation.scene import simulate
from ...solvers.richardson_lucy import RichardsonLucy
from ..report.page import write_report
from .report import NOTES, Views, points_picture, report_text, template, views_picture
from .scene import WORDS, words

_SCENE_MM = 0.016  # finer than the voxels and no multiple of them
_DEPTHS = np.arange(17.0, 23.01, 0.5)
_VOXEL_MM = 0.0415
_POINTS = 60
_PEAK_ELECTRONS = 10_000
# Richardson-Lucy has every second plane and few steps: each costs a hundred back-projections.
_COARSE, _STEPS = slice(None, None, 2), 8


def run(folder: str | os.PathLike[str], progress: Progress | None = None) -> Path:
    """Run the pipeline and write a folder: designs, captures, volume, points, mold, pictures, reports.

    Returns
    -------
    Path
        Of the report, in Markdown. `report.html` beside it shows the microscope and what it showed.

    Raises
    ------
    InputError
        If the folder cannot be made or written to.
    """
    folder, progress = make_folder(folder), progress or Progress()
    seconds: dict[str, float] = {}
    with progress.step("Laying out the lenses"), _timed(seconds, "design and metrics"):
        design = geomscope()
        write_design(folder / "design.toml", design)
        sheet = datasheet(design)
        write_json(folder / "metrics.json", sheet)
    with _timed(seconds, "optimisation"):
        targets = _optimise(folder, progress)
    scores, views, shown = _words(folder, design, seconds, progress)
    with progress.step("Drawing"):
        write_figure(folder / "words.png", views_picture(views, design))
    found, score = _points(folder, design, seconds, progress)
    with _timed(seconds, "mold"):
        mold = make_mold(design, folder / "mold.stl", progress=progress)
    with _timed(seconds, "report"):
        write_report(folder / "report.html", design, **shown, points=found, notes=NOTES, progress=progress)
    text = report_text(design, findings(design, sheet), targets, scores, score, mold, seconds)
    write_text(folder / "report.md", text, [".md"])
    return folder / "report.md"


def _optimise(folder: Path, progress: Progress) -> list[dict]:
    """From the design as the paper prints it, out of focus, to one that meets the paper's targets."""
    write_text(folder / "study.toml", template("study.toml"), [".toml"])
    printed = geomscope(sensor_distance_mm=4.0)
    write_design(folder / "printed.toml", printed)
    outcome = run_study(printed, folder / "study.toml", progress=progress)
    write_outcome(folder / "optimized.toml", outcome, parent="printed.toml", source="study.toml")
    return as_records(outcome)


def _words(folder: Path, design: Design, seconds: dict, progress: Progress) -> tuple[dict, Views, dict]:
    """Three words at three depths: reconstructed in three ways, each against the truth; and what the page shows."""
    imager = design.imager()
    scene_grid = Grid.over(imager.sensor, depths=[z for z, _, _ in WORDS], pitch=_SCENE_MM)
    emitters = words(_SCENE_MM)
    scene = np.asarray(rasterize(emitters, scene_grid))
    grid = Grid.over(imager.sensor, depths=_DEPTHS, pitch=_VOXEL_MM)
    coarse = grid.at(grid.depths[_COARSE])
    with _timed(seconds, "simulating words"):
        light = simulate(scene, imager, scene_grid, progress=progress)
        image = _exposed(light, folder / "words.tif", seed=0)
    with _timed(seconds, "back-projection, compiled first"):
        plain = reconstruct(image, imager, grid, progress=progress)
    with progress.step("Suppressing the background"), _timed(seconds, "U-Net"):
        clean = suppress(plain, pretrained())
        write_volume(folder / "words.ome.tif", clean, grid)
    with _timed(seconds, "Richardson-Lucy"):
        iterated = reconstruct(image, imager, coarse, RichardsonLucy(_STEPS, accelerate=True), progress=progress)
    # A voxel's blur, so that a shift by part of a voxel is not counted as an error.
    truth = gaussian_filter(np.asarray(rasterize(emitters, coarse)), (0, 1, 1))
    volumes = {
        "nothing (all zero)": np.zeros_like(truth),
        "back-projection": plain[_COARSE],
        "back-projection + U-Net": clean[_COARSE],
        f"Richardson-Lucy, {_STEPS} steps": iterated,
    }
    scores = {name: quality(volume, truth) for name, volume in volumes.items()}
    planes = [int(np.abs(np.asarray(coarse.depths) - z).argmin()) for z, _, _ in WORDS]
    shown = {"truth": truth} | dict(list(volumes.items())[1:])
    views = Views(image, [z for z, _, _ in WORDS], {name: v[planes] for name, v in shown.items()})
    return scores, views, {"image": image, "volume": clean, "grid": grid}


def _points(folder: Path, design: Design, seconds: dict, progress: Progress):
    """Points at random, found by what the lenses agree on."""
    imager = design.imager()
    truth = random_points(_POINTS, (20.0, 20.0), (18.0, 22.0), seed=1)
    with _timed(seconds, "simulating points"):
        light = simulate(truth, imager, progress=progress)
        image = _exposed(light, folder / "points.tif", seed=1)
    with _timed(seconds, "finding points"):
        grid = Grid.over(imager.sensor, depths=_DEPTHS, pitch=_VOXEL_MM)
        found = find_points(image, imager, grid, progress=progress)
    write_points(folder / "points-truth.csv", truth)
    write_points(folder / "points-found.csv", found)
    score = localization(found, truth)
    write_figure(folder / "points.png", points_picture(found, truth, score))
    return found, score


def _exposed(light: np.ndarray, path: Path, seed: int) -> np.ndarray:
    counts = np.asarray(expose(light, Camera(), jax.random.key(seed), peak_electrons=_PEAK_ELECTRONS))
    write_capture(path, counts)
    return counts


@contextmanager
def _timed(seconds: dict[str, float], what: str) -> Iterator[None]:
    started = perf_counter()
    yield
    seconds[what] = perf_counter() - started
