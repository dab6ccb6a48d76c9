"""Traces of blinking beads in ray-traced captures: demixed from the pixels, and means of voxels, against the truth.

The middle of the design images beads that blink, in their own stray light, with shot and read noise. Their places are
those that `find_points` finds in the mean of the captures. The light of each in each capture, by least squares of the
images that the model makes of the beads, is compared with the true one by its correlation over time; so are means of
the voxels about each bead in the back-projection of each capture, above the background about them.

    python -m experiments.traces [DESIGN.toml] [--out DIR]
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.sparse import csr_array, vstack
from scipy.spatial import KDTree

import gs_jax as gs
from experiments.common import OPTIONAL_PATH, Report, main, tables_report
from experiments.ray_tracer import traced
from gs_jax.apps.trace_pictures import draw_traces
from gs_jax.reconstruction.demixing import demix, image_regions, prepare_demixing
from gs_jax.reconstruction.traces import RegionSignals, SummaryVolumes, regions_of_points, traces_table
from gs_jax.simulation import random_points

# A quarter of the lenses, the pixels that they need, and the sides of the boxes of the beads, mm.
LENSES, PIXELS, SIZES, DEPTHS = 50, 2300, (5.0, 1.2), (18.5, 21.5)
# Beads, the dimmest of which is at least this part as bright as the brightest, frames, and rays from a bead to a lens.
BEADS, LEAST, FRAMES, RAYS = 40, 0.1, 24, 4000
# Voxels, mm, and half axes of the regions about the beads, mm.
VOXEL, STEP, RADIUS = 0.04, 0.5, (0.06, 0.5)
# Electrons of the brightest pixel, a count, the counts of a dark pixel, and of read noise. Exposures of the weights.
ELECTRONS, GAIN, OFFSET, READ_NOISE, REFERENCES = 10_000, 10.0, 16.0, 2.0, 8
# A bead is found if a point is as near as this, laterally and axially, mm.
NEAR = (0.1, 0.4)


class Scene(NamedTuple):
    """Beads, their light in each frame, and the counts of the captures."""

    imager: gs.Imager
    beads: np.ndarray
    light: np.ndarray
    captures: np.ndarray


def middle_of(design: gs.Design, lenses: int, pixels: int) -> gs.Imager:
    """The lenses in the middle of a design, over a smaller sensor."""
    centers = np.array(design.array.centers_mm)
    centers = centers[np.argsort(np.abs(centers).max(1), kind="stable")[:lenses]]
    side = 2 * np.abs(centers).max() + 1.2
    return design.replace(centers_mm=centers, size_mm=(side, side), shape=(pixels, pixels)).imager()


def scene(imager: gs.Imager, size: float, count: int, frames: int, rays: int, progress: gs.Progress) -> Scene:
    """Beads that are lit in four of ten frames, as bright as chance wants."""
    rng, beads = np.random.default_rng(1), random_points(count, (size, size), DEPTHS, seed=1)
    light = rng.lognormal(0, 0.3, (frames, count)) * (rng.random((frames, count)) < 0.4) * rng.uniform(LEAST, 1, count)
    tracing = progress.track(beads, "Tracing beads")
    images = vstack([csr_array(traced(bead[None], imager, rays).reshape(1, -1)) for bead in tracing]).tocsr()
    clean = np.stack([images.T @ row for row in light])
    clean *= ELECTRONS / clean.max()
    captures = [np.round((rng.poisson(one) + rng.normal(0, READ_NOISE, one.shape)) / GAIN + OFFSET) for one in clean]
    captures = np.clip(captures, 0, None).astype(np.uint16).reshape(frames, *imager.sensor.shape)
    return Scene(imager, beads, light, captures)


def run(
    design: gs.Design,
    size: float,
    *,
    lenses=LENSES,
    pixels=PIXELS,
    beads=BEADS,
    frames=FRAMES,
    rays=RAYS,
    progress: gs.Progress,
) -> tuple[dict[str, Any], Figure]:
    """Return the correlations of each bead that is found, and a picture of its regions and signals."""
    return measured(scene(middle_of(design, lenses, pixels), size, beads, frames, rays, progress), size, progress)


def measured(made: Scene, size: float, progress: gs.Progress) -> tuple[dict[str, Any], Figure]:
    """`run`, of a scene."""
    frames = len(made.captures)
    depths = np.arange(DEPTHS[0], DEPTHS[1] + STEP / 2, STEP)
    grid = gs.Grid(depths, 2 * (round(size / VOXEL) + 21,), VOXEL)
    mean = made.captures.mean(0, dtype=np.float32)
    points = gs.find_points(mean, made.imager, grid, progress=progress)
    away, bead = KDTree(made.beads[:, :3] / (NEAR[0], NEAR[0], NEAR[1])).query(
        points[:, :3] / (NEAR[0], NEAR[0], NEAR[1])
    )
    near = np.asarray(away) < 1
    points, bead, false = points[near], np.asarray(bead)[near], int(np.sum(~near))
    truth = made.light[:, bead]
    images = image_regions([np.array([[*point[:3], 1.0]]) for point in points], made.imager, progress=progress)
    system = prepare_demixing(images, made.captures[:: -(-frames // REFERENCES)])
    labels = regions_of_points(points, grid, RADIUS)
    signals, over_time, rows = RegionSignals(labels), SummaryVolumes(grid.volume_shape), []
    for capture in progress.track(made.captures, "Measuring"):
        volume = np.asarray(gs.reconstruct(capture, made.imager, grid))
        over_time.add(volume)
        rows.append((*demix(capture, system), *signals(volume)))
    light, error, means, backgrounds = (np.array(part) for part in zip(*rows, strict=True))
    by_voxels = means - backgrounds
    found = {name: _correlations(part, truth) for name, part in (("demixed", light), ("voxels", by_voxels))}
    # Of what is left beside the scale of each trace.
    gain = (light * truth).sum(0) / (truth**2).sum(0)
    share = (light - gain * truth)[truth > 0] / error[truth > 0]
    numbers = {"lenses": len(made.imager.array.centers), "pixels": made.captures.shape[-1], "frames": frames}
    numbers |= {"beads": len(made.beads), "false_points": false}
    numbers |= {"found": len(np.unique(bead)), "used_pixels": len(images.pixels)} | found
    numbers |= {"of_standard_error": float(share.std()), "gain_spread": float(gain.std() / gain.mean())}
    dark = np.full(light.shape, np.nan)
    parts = {"demixed": light / light.max(0), "dff": dark}
    table = traces_table(np.arange(1, len(points) + 1), np.arange(frames), points[None, :, :3], parts)
    return numbers, draw_traces(table, over_time.deviation.max(0), labels.max(0), grid)


def _correlations(found: np.ndarray, truth: np.ndarray) -> list[float]:
    return [float(np.corrcoef(a, b)[0, 1]) for a, b in zip(found.T, truth.T, strict=True)]


def report(design: Path | None, progress: gs.Progress) -> Report:
    """Run at full size, and tabulate."""
    rows, numbers, figure = [], {}, None
    for size in SIZES:
        numbers[size], figure = run(gs.read_design(design) if design else gs.geomscope(), size, progress=progress)
        rows += rows_of(size, numbers[size])
    columns = [
        "box, mm",
        "found",
        "false",
        "traces",
        "least correlation",
        "median",
        "0.98 or more",
        "errors / standard errors",
    ]
    pictures: dict[str, Any] = {"png": figure} if figure else {}
    return tables_report("traces", numbers, (columns, rows), title="Traces", **pictures)


def rows_of(size: float, numbers: dict[str, Any]) -> list[list[str]]:
    """Rows of the table of one box."""
    rows = []
    for name, title in (("demixed", "demixed"), ("voxels", "means of voxels")):
        values = np.array(numbers[name])
        parts = [f"{size:g}", f"{numbers['found']}", f"{numbers['false_points']}", title]
        share = f"{numbers['of_standard_error']:.2f}" if name == "demixed" else ""
        rows.append([*parts, f"{values.min():.4f}", f"{np.median(values):.4f}", f"{np.sum(values >= 0.98)}", share])
    return rows


if __name__ == "__main__":
    main(report, {"design": OPTIONAL_PATH})
