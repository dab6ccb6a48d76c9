"""The demonstration: a microscope is judged, improved and used, and its mold is made."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from ..base.progress import Progress
from ..codesign.search import run_study
from ..codesign.search_report import as_records, write_outcome
from ..design.builtin import geomscope
from ..design.datasheets import datasheet
from ..design.design import Design, write_design
from ..design.diagnostics import findings
from ..detection.locate import find_points
from ..detection.unet import pretrained, suppress
from ..geometry import Sensor
from ..grid import Grid
from ..io.captures import write_capture
from ..io.files import make_folder, write_figure, write_json, write_text
from ..io.point_tables import write_points
from ..io.volumes import write_volume
from ..layouts import nearest_neighbour_distances
from ..metrics import Localization, Quality, localization, quality
from ..mold.make import make_mold
from ..reconstruction.pipeline import reconstruct
from ..simulation.phantoms import letters, random_points, rasterize
from ..simulation.synthetic import Camera, expose, simulate
from ..solvers.richardson_lucy import RichardsonLucy
from ..typing import PathLike
from .report.page import write_report

_SCENE_MM = 0.016  # finer than the voxels and no multiple of them
_DEPTHS = np.arange(17.0, 23.01, 0.5)
_VOXEL_MM = 0.0415
_POINTS = 60
_PEAK_ELECTRONS = 10_000
# Richardson-Lucy has every second plane and few steps: each costs a hundred back-projections.
_COARSE, _STEPS = slice(None, None, 2), 8


class Views(NamedTuple):
    """A capture, and of each volume the planes at some depths (mm), the truth's first."""

    image: np.ndarray
    depths: list[float]
    volumes: dict[str, np.ndarray]


def run(folder: PathLike, progress: Progress | None = None) -> Path:
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
    write_text(folder / "study.toml", template("example_study.toml"), [".toml"])
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


# What the page says of its parts.
NOTES = {
    "page": "What gs-jax demo made, on captures that it simulated; report.md has the scores, the optimised design and "
    "the times.",
    "capture": "words.tif: three words at 18, 20 and 22 mm, simulated with noise.",
    "volume": "words.ome.tif: back-projection, then the network that suppresses the background.",
    "points": "points-found.csv: found in points.tif, another capture.",
}


def views_picture(views: Views, design: Design) -> Figure:
    """The capture and its middle; and beside them a row for each volume, a column for each depth."""
    count = len(views.depths)
    figure = Figure(figsize=(3.1 * (count + 1) + 0.8, 2.9 * len(views.volumes)), dpi=110, layout="constrained")
    halves: Any = figure.subfigures(1, 2, width_ratios=(1.25, count))
    sensor = design.imager().sensor
    _captures(halves[0].subplots(2, 1), views.image, sensor)
    axes = halves[1].subplots(len(views.volumes), count, sharex=True, sharey=True, squeeze=False)
    for row, (name, volume) in zip(axes, views.volumes.items(), strict=True):
        for axis, depth, plane in zip(row, views.depths, volume, strict=True):
            # Back-projection has a pedestal, which is not an object.
            low = np.percentile(plane, 50)
            axis.imshow(
                plane, cmap="magma", extent=sensor.extent, vmin=low, vmax=max(np.percentile(plane, 99.9), low + 1e-9)
            )
            axis.set_title(f"{name}, {depth:g} mm", fontsize=9)
        row[0].set_ylabel("y, mm")
    for axis in axes[-1]:
        axis.set_xlabel("x, mm")
    return figure


def _captures(axes, image: np.ndarray, sensor: Sensor) -> None:
    step = max(1, image.shape[0] // 1024)
    zoom = image[tuple(slice(n // 2 - 400, n // 2 + 400) for n in image.shape)]
    middle = Sensor(zoom.shape, sensor.pixel_pitch)
    shown = ((image[::step, ::step], sensor, "capture"), (zoom, middle, "its middle"))
    for axis, (part, seen, title) in zip(axes, shown, strict=True):
        axis.imshow(part, cmap="gray", extent=seen.extent, vmax=np.percentile(part, 99.8))
        axis.set(title=title, xlabel="x, mm", ylabel="y, mm")


def points_picture(found: np.ndarray, truth: np.ndarray, score: Localization) -> Figure:
    """True and found points in the plane, and the errors of the pairs."""
    figure = Figure(figsize=(10, 4.4), dpi=110, layout="constrained")
    plane, errors = figure.subplots(1, 2)
    plane.scatter(truth[:, 0], truth[:, 1], s=60, facecolors="none", edgecolors="0.4", label="true")
    drawn = plane.scatter(found[:, 0], found[:, 1], s=12, c=found[:, 2], cmap="viridis", label="found")
    plane.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")
    plane.invert_yaxis()
    plane.legend(loc="upper left", bbox_to_anchor=(0, 1.12), ncols=2, frameon=False)
    figure.colorbar(drawn, ax=plane, label="z, mm")
    gap = found[score.pairs[:, 0], :3] - truth[score.pairs[:, 1], :3]
    errors.scatter(1000 * np.hypot(gap[:, 0], gap[:, 1]), 1000 * gap[:, 2], s=12)
    errors.axhline(0, color="0.7", lw=0.8)
    errors.set(xlabel="lateral error, um", ylabel="axial error, um", title=f"{len(gap)} of {len(truth)} points")
    return figure


def report_text(
    design: Design,
    sentences: list[str],
    targets: list[dict[str, Any]],
    scores: dict[str, Quality],
    points: Localization,
    part: dict[str, Any],
    seconds: dict[str, float],
) -> str:
    """The summary, in Markdown."""
    distances = nearest_neighbour_distances(np.array(design.array.centers_mm))
    marks = {True: "yes", False: "NO", None: ""}
    span = lambda ends: " to ".join(dict.fromkeys("inf" if x is None else f"{x:.3g}" for x in ends))
    aim = lambda t: f"{t['kind'].replace('_', ' ')} {t['target']:g} {t['unit']}".rstrip()
    rows = lambda cells: "\n".join(f"| {' | '.join(row)} |" for row in cells)
    return template("example_pipeline.md").format(
        lenses=len(distances),
        pitch=distances.mean(),
        pitch_sd=distances.std(),
        points=points,
        lateral_um=1000 * points.lateral_rmse,
        axial_um=1000 * points.axial_rmse,
        part=part,
        megabytes=part["file_bytes"] / 1e6,
        said="\n".join(f"- {sentence}" for sentence in sentences),
        checks="\n".join(f"- {check['text']}" for check in part["checks"]),
        wanted=rows(
            [t["meaning"], aim(t), span(t["before"]), span(t["after"]), marks[t["met_after"]]] for t in targets
        ),
        volumes=rows([name, f"{q.psnr_db:.1f}", f"{q.ssim:.3f}", f"{q.mse:.3g}"] for name, q in scores.items()),
        times=rows([what, f"{time:.1f}"] for what, time in seconds.items()),
    )


def template(name: str) -> str:
    """The text of a file that lies beside this one."""
    return (resources.files("gs_jax") / "apps" / name).read_text("utf-8")


# What is written at which depth (mm), and where its middle is (mm).
WORDS = ((18.0, "near", (-4.0, -5.0)), (20.0, "focus", (0.0, 0.0)), (22.0, "far", (4.0, 5.0)))
_HEIGHT_MM = 2.5


def words(pitch: float) -> Float[np.ndarray, "emitter 4"]:
    """Emitters `(x, y, z, intensity)` of the words, `pitch` apart, mm."""
    each = [letters(word, depth=z, height=_HEIGHT_MM, pitch=pitch) + (x, y, 0, 0) for z, word, (x, y) in WORDS]
    return np.concatenate(each)
