"""Reconstruct finer voxels than are wanted, and bring them to the wanted ones.

Letters, beads and tilted sheets of `design_judge`, on voxels of 40 um, and the scenes of `volume_limits`, on voxels of
80 um, are ray-traced through the paper's lenses. They are reconstructed on voxels of these widths and finer ones, which
are shared linearly by the wanted voxels before they are scored as there. A last column has voxels of which the pixels
are not binned, so that they leave gaps between their images.

    python -m experiments.voxel_width [--draws 1] [--out DIR]

Writes `voxel_width.json` and `voxel_width.md`; about ten minutes on two cores.
"""

import time
from collections.abc import Callable, Iterator
from itertools import product
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from experiments import design_judge, surfaces, volume_limits
from experiments.common import Report, main, table
from experiments.design_judge import finer, shared
from experiments.ray_tracer import traced
from gs_jax import Grid, Imager, geomscope, quality, rasterize, reconstruct
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.progress import Progress
from gs_jax.reconstruction import inverse_problem
from gs_jax.reconstruction.pipeline import METHODS

# Widths of voxels, relative to the wanted ones, and how far apart they may be on the sensor, in binned pixels. Those of
# width 0.75 are 1.8 to 1.9 pixels apart, for which the package bins 2 x 2.
APART = inverse_problem._FARTHEST
CASES = ((1.0, APART), (0.75, APART), (0.5, APART), (0.75, np.inf))
NAMES = ("unrolled", "list-rl", "richardson-lucy")
ITERATIONS, ELECTRONS = 20, 3000


class Capture(NamedTuple):
    """An image of a scene, the voxels that are wanted, the truth on these, and its score of a volume, dB."""

    kind: str
    imager: Imager
    image: np.ndarray
    grid: Grid
    truth: np.ndarray
    score: Callable[[np.ndarray, np.ndarray], float]


def captures(draws: int) -> Iterator[Capture]:
    """Scenes of both experiments."""
    settings = design_judge.Settings()
    imager = design_judge.device(geomscope().imager(), settings)
    for draw, kind in product(range(draws), ("letters", "beads", "tilted sheets")):
        one = design_judge.scene(kind, draw, settings)
        image = surfaces.noisy(design_judge.image_of(one, imager, settings), ELECTRONS)
        truth = np.asarray(rasterize(one.emitters, settings.grid), np.float32)
        yield Capture(kind, imager, image, settings.grid, truth, lambda v, t: quality(v, t).psnr_db)
    imager = surfaces.device("geomscope", volume_limits.PIXELS)
    depths = np.arange(surfaces.DEPTHS[0], surfaces.DEPTHS[1] + 0.01, surfaces.STEP)
    grid = Grid.over(imager.sensor, depths=depths, pitch=surfaces.VOXEL)
    for draw, kind in product(range(draws), volume_limits.KINDS):
        emitters = volume_limits.scene(kind, draw)
        clean = traced(emitters, imager, volume_limits.RAYS, volume_limits.TILE)
        image = surfaces.noisy(clean, volume_limits.ELECTRONS)
        truth = np.asarray(rasterize(emitters, grid), np.float32)
        yield Capture(kind, imager, image, grid, truth, volume_limits.gain)


def run(draws: int, progress: Progress) -> list[dict[str, Any]]:
    """A record of each scene, width and method."""
    records = []
    for capture in progress.track(list(captures(draws)), "Scenes"):
        for (width, farthest), name in product(CASES, NAMES):
            fine, began = finer(capture.grid, width), time.process_time()
            with patch.object(inverse_problem, "_FARTHEST", farthest):
                volume = reconstruct(capture.image, capture.imager, fine, METHODS[name](ITERATIONS))
            record = {"kind": capture.kind, "width": width, "farthest": farthest, "method": name}
            record["seconds"] = time.process_time() - began
            score = capture.score(shared(volume, fine, capture.grid), capture.truth)
            records.append(record | {"db": float(score)})
    return records


def report(draws: int, progress: Progress) -> Report:
    records = run(draws, progress)
    mean = lambda **wanted: np.mean([r["db"] for r in records if wanted.items() <= r.items()])
    rows = []
    for kind, name in product(dict.fromkeys(r["kind"] for r in records), NAMES):
        first, *others = (mean(kind=kind, method=name, width=width, farthest=most) for width, most in CASES)
        rows.append([kind, name, f"{first:.1f}", *(f"{other - first:+.1f}" for other in others)])
    names = [f"width {width:g}" + (", no pixels binned" if most > APART else "") for width, most in CASES[1:]]
    columns = ("scene", "method", "dB", *names)
    files = {"voxel_width.json": records, "voxel_width.md": markdown_table(columns, rows)}
    return Report(files, [table(columns, rows)])


if __name__ == "__main__":
    main(report, {"--draws": {"type": int, "default": 1}})
