"""F1 score of `find_points` against the density of points.

Random points are imaged with all their light, and exposed with shot and read noise. The reference is the brightest
peaks of the back-projection, as many as there are points, a number that a user does not know. The simulation places
cores where `find_points` expects them, so the result is slightly optimistic; that of `fig4_suppression` is not.

With `--draws N` instead: so many captures of 20 and of 30 beads, in air and in water, whose intensities differ by a
factor of up to eight, by the 30 lenses in the middle of the design. False points are those without a true one within
0.1 mm laterally and 0.4 mm axially, or beside one that is already found; the command line marks all of them as
confident, as the design is in focus.

    python -m experiments.point_density [DESIGN.toml] [--draws N] [--out DIR]
"""

from collections.abc import Iterable
from pathlib import Path

import jax
import numpy as np

import gs_jax as gs
from experiments.common import OPTIONAL_PATH, Report, local_maxima, main, table
from gs_jax.detection.background import subtract_background
from gs_jax.projection.point_sources import full_imager_of_points
from gs_jax.simulation import random_points, simulate_points

# Numbers of points, and numbers of captures of each.
SCENES = {10: 3, 30: 2, 100: 1, 300: 1, 1000: 1, 3000: 1}
SIZE, DEPTHS = (20.0, 20.0), (18.0, 22.0)
# Draws: numbers of beads, their box, brightest to faintest, lenses, side of the sensor in pixels. In water the spots of
# near beads are wide.
BEADS, BOX, RATIO, LENSES, PIXELS = (20, 30), (3.0, 3.0), 8.0, 30, 1600
WATER = {"sample": {"refractive_index": 1.333, "surface_mm": 17.0}}
MEDIA: dict[str, tuple[dict, tuple[float, float]]] = {"air": ({}, (18.0, 22.0)), "water": (WATER, (17.4, 22.5))}


def run(
    design: gs.Design, scenes: dict[int, int] | None = None, *, voxel=0.03, step=0.25, progress: gs.Progress
) -> list:
    """Return the scores of both methods for each number of points, over all captures together."""
    imager = design.imager()
    grid = gs.Grid.over(imager.sensor, depths=np.arange(DEPTHS[0] - 1, DEPTHS[1] + 1.001, step), pitch=voxel)
    rows = []
    for count, seeds in (SCENES if scenes is None else scenes).items():
        detections = {"gs_jax": [], "brightest peaks": []}
        for seed in range(seeds):
            truth, capture = scene(count, seed, design, progress)
            detections["gs_jax"].append((gs.find_points(capture, imager, grid, progress=progress), truth))
            detections["brightest peaks"].append((brightest_peaks(capture, imager, grid, count, progress), truth))
        rows.append({"points": count, "captures": seeds} | {name: scores(pairs) for name, pairs in detections.items()})
    return rows


def scene(count: int, seed: int, design: gs.Design, progress: gs.Progress) -> tuple[np.ndarray, np.ndarray]:
    """Points, and a capture of them."""
    truth = random_points(count, SIZE, DEPTHS, seed=seed)
    truth[:, 3] = np.random.default_rng(seed).uniform(0.5, 1.5, count)
    image = simulate_points(truth, design.imager(), kind="full", progress=progress)
    return truth, np.asarray(gs.expose(image, gs.Camera(), jax.random.key(seed), peak_electrons=10_000))


def draws(design: gs.Design, number: int, beads: Iterable[int] = BEADS, *, progress: gs.Progress) -> list[dict]:
    """Return the scores of this number of captures for each medium and number of beads."""
    rows = []
    for medium, (keys, depths) in MEDIA.items():
        imager = middle_of(design, keys).imager()
        grid = gs.Grid.over(imager.sensor, depths=[depths[0] - 0.2, depths[1] + 0.2], pitch=0.03)
        corners = np.array(
            [[sign * BOX[0] / 2, sign * BOX[1] / 2, z] for z in np.linspace(*depths, 50) for sign in (-1, 1)]
        )
        image_of = full_imager_of_points(corners, imager, progress)
        for count in beads:
            pairs = []
            for seed in progress.track(range(number), f"{count} beads in {medium}"):
                rng = np.random.default_rng([seed, count])
                truth = random_points(count, BOX, depths, seed=seed)
                truth[:, 3] = RATIO ** rng.uniform(0, 1, count)
                counts = gs.expose(image_of(truth), gs.Camera(), jax.random.key(seed), peak_electrons=10_000)
                # Without the warning of blur, which would be traced for each.
                pairs.append((gs.find_points(subtract_background(np.asarray(counts)), imager, grid), truth))
            row = {"medium": medium, "beads": count, "draws": number, **scores(pairs)}
            rows.append(row | {"false": round(sum(len(found) for found, _ in pairs) * (1 - row["precision"]))})
    return rows


def middle_of(design: gs.Design, keys: dict) -> gs.Design:
    """The lenses in the middle of a design over a smaller sensor, with other values of some keys."""
    centers = np.array(design.array.centers_mm)
    centers = centers[np.argsort(np.abs(centers).max(1), kind="stable")[:LENSES]]
    side = 2 * np.abs(centers).max() + 1.2
    return design.replace(centers_mm=centers, size_mm=(side, side), shape=(PIXELS, PIXELS), **keys)


def brightest_peaks(
    capture: np.ndarray, imager: gs.Imager, grid: gs.Grid, count: int, progress: gs.Progress
) -> np.ndarray:
    """The highest local maxima of the plain back-projection, `(x, y, z, value)`."""
    volume = gs.reconstruct(capture, imager, grid, progress=progress)
    return local_maxima(volume, grid, min_distance=1, num_peaks=count)


def scores(pairs: list[tuple[np.ndarray, np.ndarray]]) -> dict:
    """Scores over several captures, whose points are placed side by side beyond the matching distance."""
    apart = [np.array([1000.0 * number, 0, 0, 0]) for number in range(len(pairs))]
    detections, truth = (np.concatenate([pair[i] + a for pair, a in zip(pairs, apart, strict=True)]) for i in (0, 1))
    score = gs.localization(detections, truth)
    return {
        "f1": score.f1,
        "precision": score.precision,
        "recall": score.recall,
        "lateral_rmse_um": 1000 * score.lateral_rmse,
        "axial_rmse_um": 1000 * score.axial_rmse,
    }


def of_draws(design: gs.Design, number: int, progress: gs.Progress) -> Report:
    """The report of draws of beads."""
    results = draws(design, number, progress=progress)
    columns = ("medium", "beads", "draws", "true", "recall", "false", "lateral, um", "axial, um")
    cells = lambda r: [
        *(str(x) for x in (r["medium"], r["beads"], r["draws"], r["beads"] * r["draws"])),
        *(f"{r['recall']:.4f}", str(r["false"]), f"{r['lateral_rmse_um']:.1f}", f"{r['axial_rmse_um']:.0f}"),
    ]
    return Report({"draws.json": results}, [table(columns, map(cells, results))])


def report(design: Path | None, draws: int | None, progress: gs.Progress) -> Report:
    imaged = gs.read_design(design) if design else gs.geomscope()
    if draws:
        return of_draws(imaged, draws, progress)
    results = run(imaged, progress=progress)
    columns = ("points", "captures", "F1", "precision", "recall", "lateral, um", "axial, um", "F1 of peaks")
    numbers = lambda row: (f"{n:.3f}" for n in (*row["gs_jax"].values(), row["brightest peaks"]["f1"]))
    shown = table(columns, [[str(row["points"]), str(row["captures"]), *numbers(row)] for row in results])
    return Report({"point_density.json": results}, [shown])


if __name__ == "__main__":
    main(report, {"design": OPTIONAL_PATH, "--draws": {"type": int}})
