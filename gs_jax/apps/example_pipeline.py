"""The example pipeline of `gs-jax demo`: evaluates and optimises a microscope, images with it, and makes its mold."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from time import perf_counter

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from ..base.errors import needs_extra
from ..base.progress import Progress
from ..codesign.search import run_study
from ..codesign.search_report import as_records, write_outcome
from ..design.datasheets import datasheet, findings
from ..design.design import Design, write_design
from ..design.start import geomscope
from ..detection.point_finder import find_points
from ..detection.unet import pretrained, suppress
from ..grid import Grid, Sensor
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
from .report import write_report

_SCENE_MM = 0.016  # finer than the voxels and no multiple of them
_DEPTHS = np.arange(17.0, 23.01, 0.5)
_VOXEL_MM = 0.0415
_POINTS = 60
_PEAK_ELECTRONS = 10_000
# Richardson-Lucy uses every second plane and few steps: each costs a hundred back-projections.
_COARSE, _STEPS = slice(None, None, 2), 8
# Depth, text and centre of each word, and the height of its capitals, mm.
WORDS = ((18.0, "near", (-4.0, -5.0)), (20.0, "focus", (0.0, 0.0)), (22.0, "far", (4.0, 5.0)))
_WORD_HEIGHT = 2.5
# Sentences of the page.
_NOTES = {
    "page": "By gs-jax demo, from simulated captures; report.md has the scores, the optimised design and the times.",
    "capture": "words.tif: three words at 18, 20 and 22 mm, simulated with noise.",
    "volume": "words.ome.tif: back-projection, then the network that suppresses the background.",
    "points": "points-found.csv: found in points.tif, another capture.",
}


def run(folder: PathLike, progress: Progress | None = None) -> Path:
    """Runs the pipeline and writes a folder: designs, captures, volume, points, mold, pictures, reports.

    Returns
    -------
    Path
        Of the report in Markdown; `report.html` beside it is the report of the microscope.

    Raises
    ------
    InputError
        If the folder cannot be made or written to.
    """
    with needs_extra("report"):
        import jinja2
    folder, progress = make_folder(folder), progress or Progress()
    seconds: dict[str, float] = {}
    with progress.step("Laying out the lenses"), _timed(seconds, "design and metrics"):
        design = geomscope()
        write_design(folder / "design.toml", design)
        sheet = datasheet(design)
        write_json(folder / "metrics.json", sheet)
    with _timed(seconds, "optimisation"):
        targets = _optimise(folder, progress)
    scores, shown = _image_words(folder, design, seconds, progress)
    points, score = _image_points(folder, design, seconds, progress)
    with _timed(seconds, "mold"):
        mold = make_mold(design, folder / "mold.stl", progress=progress)
    with _timed(seconds, "report"):
        write_report(folder / "report.html", design, **shown, points=points, notes=_NOTES, progress=progress)
    context = {
        "distances": nearest_neighbour_distances(np.array(design.array.centers_mm)),
        "findings": findings(design, sheet),
        "targets": targets,
        "scores": scores,
        "points": score,
        "mold": mold,
        "seconds": seconds,
    }
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True, keep_trailing_newline=True)
    text = environment.from_string(_template("example_pipeline.md")).render(context)
    write_text(folder / "report.md", text, [".md"])
    return folder / "report.md"


def _template(name: str) -> str:
    return (resources.files("gs_jax") / "apps" / "templates" / name).read_text("utf-8")


def _optimise(folder: Path, progress: Progress) -> list[dict]:
    """Optimises the design as the paper prints it, out of focus, for the targets of the paper."""
    write_text(folder / "study.toml", _template("example_study.toml"), [".toml"])
    printed = geomscope(sensor_distance_mm=4.0)
    write_design(folder / "printed.toml", printed)
    outcome = run_study(printed, folder / "study.toml", progress=progress)
    write_outcome(folder / "optimized.toml", outcome, parent="printed.toml", source="study.toml")
    return as_records(outcome)


def words(pitch: float) -> Float[np.ndarray, "emitter 4"]:
    """Emitters `(x, y, z, intensity)` of the words, `pitch` apart, mm."""
    parts = [letters(word, depth=z, height=_WORD_HEIGHT, pitch=pitch) + (x, y, 0, 0) for z, word, (x, y) in WORDS]
    return np.concatenate(parts)


def _image_words(folder: Path, design: Design, seconds: dict, progress: Progress) -> tuple[dict[str, Quality], dict]:
    """Reconstructs words at three depths in three ways; returns scores, and what the page shows."""
    imager, depths = design.imager(), [z for z, _, _ in WORDS]
    scene_grid = Grid.over(imager.sensor, depths=depths, pitch=_SCENE_MM)
    emitters = words(_SCENE_MM)
    scene = np.asarray(rasterize(emitters, scene_grid))
    grid = Grid.over(imager.sensor, depths=_DEPTHS, pitch=_VOXEL_MM)
    coarse = grid.at(grid.depths[_COARSE])
    with _timed(seconds, "simulating words"):
        light = simulate(scene, imager, scene_grid, progress=progress)
        image = _expose(light, folder / "words.tif", seed=0)
    with _timed(seconds, "back-projection, compiled first"):
        plain = reconstruct(image, imager, grid, progress=progress)
    with progress.step("Suppressing the background"), _timed(seconds, "U-Net"):
        clean = suppress(plain, pretrained())
        write_volume(folder / "words.ome.tif", clean, grid)
    with _timed(seconds, "Richardson-Lucy"):
        iterated = reconstruct(image, imager, coarse, RichardsonLucy(_STEPS, accelerate=True), progress=progress)
    # Blurred by a voxel, so that shifts by parts of a voxel are not counted as errors.
    truth = gaussian_filter(np.asarray(rasterize(emitters, coarse)), (0, 1, 1))
    volumes = {
        "back-projection": plain[_COARSE],
        "back-projection + U-Net": clean[_COARSE],
        f"Richardson-Lucy, {_STEPS} steps": iterated,
    }
    scores = {"nothing (all zero)": quality(np.zeros_like(truth), truth)}
    scores |= {name: quality(volume, truth) for name, volume in volumes.items()}
    planes = [int(np.abs(np.asarray(coarse.depths) - z).argmin()) for z in depths]
    with progress.step("Drawing"):
        shown = {name: volume[planes] for name, volume in ({"truth": truth} | volumes).items()}
        write_figure(folder / "words.png", _draw_words(image, depths, shown, imager.sensor))
    return scores, {"image": image, "volume": clean, "grid": grid}


def _image_points(folder: Path, design: Design, seconds: dict, progress: Progress) -> tuple[np.ndarray, Localization]:
    imager = design.imager()
    truth = random_points(_POINTS, (20.0, 20.0), (18.0, 22.0), seed=1)
    with _timed(seconds, "simulating points"):
        light = simulate(truth, imager, progress=progress)
        image = _expose(light, folder / "points.tif", seed=1)
    with _timed(seconds, "finding points"):
        grid = Grid.over(imager.sensor, depths=_DEPTHS, pitch=_VOXEL_MM)
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
    started = perf_counter()
    yield
    seconds[step] = perf_counter() - started


def _draw_words(image: np.ndarray, depths: list[float], volumes: dict[str, np.ndarray], sensor: Sensor) -> Figure:
    """The capture and its middle, and beside them a row per volume and a column per depth."""
    count = len(depths)
    figure = Figure(figsize=(3.1 * (count + 1) + 0.8, 2.9 * len(volumes)), dpi=110, layout="constrained")
    left, right = np.ravel(np.asarray(figure.subfigures(1, 2, width_ratios=(1.25, count))))
    step = max(1, image.shape[0] // 1024)
    crop = image[tuple(slice(n // 2 - 400, n // 2 + 400) for n in image.shape)]
    captures = (image[::step, ::step], sensor, "capture"), (crop, Sensor(crop.shape, sensor.pixel_pitch), "its middle")
    for axes, (part, area, title) in zip(left.subplots(2, 1), captures, strict=True):
        axes.imshow(part, cmap="gray", extent=area.extent, vmax=np.percentile(part, 99.8))
        axes.set(title=title, xlabel="x, mm", ylabel="y, mm")
    grid = right.subplots(len(volumes), count, sharex=True, sharey=True, squeeze=False)
    for row, (name, volume) in zip(grid, volumes.items(), strict=True):
        for axes, depth, plane in zip(row, depths, volume, strict=True):
            # Back-projection has a pedestal, which is no object.
            low, high = np.percentile(plane, (50, 99.9))
            axes.imshow(plane, cmap="magma", extent=sensor.extent, vmin=low, vmax=max(high, low + 1e-9))
            axes.set_title(f"{name}, {depth:g} mm")
        row[0].set_ylabel("y, mm")
    for axes in grid[-1]:
        axes.set_xlabel("x, mm")
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
