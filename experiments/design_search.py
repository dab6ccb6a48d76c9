"""Search for lenses by the judge itself: the volumes that the unrolled inversion makes of ray-traced scenes.

Free are the sensor distance, the depth of the paraxial focus, the aperture, the conic constant and the pitch; each side
of the lenses may face the object. The refractive index, the plate and the pixels are the paper's; plate and sensor
distance are 7 mm at most. A design's score is the mean over four kinds of scenes of its PSNR above `geomscope`'s, for
the same exposure time, 3,000 electrons in its brightest pixel, as in `design_judge.py` but for a smaller field.
Searches start from a Sobol sequence; from the best start of each side CMA-ES (`cma`) goes on.

    python -m experiments.design_search [--starts 8] [--steps 3] [--records FILE] [--out DIR]

Needs `pip install cma`. Writes the records after each design, from which the next run goes on, and then
`design_search.md`, and the best design of each side; a minute of two cores for each design.
"""

import json
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc

from experiments.common import Report, main, table
from experiments.design_judge import KINDS, Methods, Settings, device, image_of, judged, scene
from gs_jax import Design, geomscope, write_design
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.progress import Progress
from gs_jax.io.files import make_folder, write_json

EXPOSURE = 3000
SETTINGS = Settings(field=1.6, sensor=7.0, exposures=(EXPOSURE,), methods=("unrolled",), rays=300)
SIDES = ("plano", "curved")
# Sensor distance, mm; paraxial focus, mm; aperture, mm; conic constant; pitch, of the paper's.
LOW, HIGH = np.array([3.0, 17.0, 0.5, -1.5, 0.85]), np.array([6.0, 32.0, 2.0, 0.5, 1.4])
NAMES = ("v, mm", "focus, mm", "D, mm", "k", "pitch")
# Of CMA-ES, in units of the bounds; designs in a generation.
SPREAD, POPULATION, SEED = 0.15, 8, 1
WORKERS = 2


def design_of(side: str, at: np.ndarray) -> Design:
    """The paper's microscope with these numbers."""
    distance, focus, aperture, conic, pitch = np.clip(at, LOW, HIGH)
    start = geomscope()
    index = float(start.imager().array.refractive_index)
    thickness = start.array.substrate_thickness_mm / index
    front, behind = (focus, distance + thickness) if side == "curved" else (focus + thickness, distance)
    radius = (index - 1) / (1 / front + 1 / behind)
    centers = pitch * np.array(start.array.centers_mm)
    inside = (np.abs(centers) < np.array(start.array.size_mm) / 2).all(1)
    return start.replace(
        name=f"{side} {' '.join(f'{x:.3f}' for x in (distance, focus, aperture, conic, pitch))}",
        sensor_distance_mm=float(distance),
        radius_of_curvature_mm=float(radius),
        aperture_diameter_mm=float(min(aperture, 1.8 * radius)),
        conic_constant=float(conic),
        orientation=side,
        centers_mm=centers[inside].tolist(),
    )


def psnr_of(design: Design, brightest: dict[str, float]) -> dict[str, float]:
    """PSNR of each kind of scene, dB; `brightest` pixels are those of the paper's lenses."""
    small = device(design.imager(), SETTINGS)
    methods, found = Methods(small, SETTINGS), {}
    for kind in KINDS:
        one = scene(kind, 0, SETTINGS)
        clean = image_of(one, small, SETTINGS)
        found[kind] = judged(small, one, clean, brightest[kind], methods)[str(EXPOSURE)]["unrolled"]["psnr_db"]
    return found


def brightest_of(design: Design) -> dict[str, float]:
    """Brightest pixel of each kind of scene."""
    small = device(design.imager(), SETTINGS)
    return {kind: float(image_of(scene(kind, 0, SETTINGS), small, SETTINGS).max()) for kind in KINDS}


class Tried:
    """Designs with their PSNR, kept in a file; a search that is started again finds its first designs there."""

    def __init__(self, file: Path, pool: Executor, progress: Progress):
        self.file, self.pool, self.progress = file, pool, progress
        self.kept: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {"designs": {}}
        if "brightest" not in self.kept:
            self.kept["brightest"] = brightest_of(geomscope())

    def gains(self, designs: list[Design]) -> np.ndarray:
        """Gains over `geomscope`, means over the kinds of scenes, dB."""
        records = self.kept["designs"]
        new = [design for design in designs if design.name not in records]
        found = self.pool.map(psnr_of, new, [self.kept["brightest"]] * len(new))
        for design, psnr in zip(self.progress.track(new, "Designs"), found, strict=True):
            records[design.name] = psnr
            write_json(self.file, self.kept)
        return np.array([np.mean(list(self.gain(design.name).values())) for design in designs])

    def gain(self, name: str) -> dict[str, float]:
        """Gain over `geomscope` for each kind of scene, dB."""
        records = self.kept["designs"]
        return {kind: records[name][kind] - records["geomscope"][kind] for kind in KINDS}


def search(side: str, start: np.ndarray, steps: int, gains: Callable[[list[Design]], np.ndarray]) -> np.ndarray:
    """CMA-ES from a start, so many generations; the best numbers that it tried."""
    # Imported here, as tests of this file's designs do without it.
    import cma

    to_unit = lambda at: (at - LOW) / (HIGH - LOW)
    options = {"bounds": [0, 1], "popsize": POPULATION, "seed": SEED, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(to_unit(start), SPREAD, options)
    for _ in range(steps):
        units = strategy.ask()
        strategy.tell(units, list(-gains([design_of(side, LOW + unit * (HIGH - LOW)) for unit in units])))
    return LOW + strategy.result.xbest * (HIGH - LOW) if steps else start


def report(starts: int, steps: int, records: Path, progress: Progress) -> Report:
    make_folder(records.parent)
    with ProcessPoolExecutor(WORKERS, get_context("spawn")) as pool:
        tried, first = Tried(records, pool, progress), geomscope()
        tried.gains([first])
        points = qmc.scale(qmc.Sobol(len(LOW), rng=SEED).random(starts), LOW, HIGH)
        # The paper's own numbers, and its lenses turned over, are starts, too.
        own = np.array([5.8, 23.5, 2.0, 0.0, 1.0])
        cases = [(side, at) for side in SIDES for at in (own, *points)]
        gains = tried.gains([design_of(side, at) for side, at in cases])
        best = {}
        for side in SIDES:
            mine = [n for n, case in enumerate(cases) if case[0] == side]
            start = cases[max(mine, key=lambda n: gains[n])][1]
            best[side] = design_of(side, search(side, start, steps, tried.gains))
        names = sorted(tried.kept["designs"], key=lambda name: -np.mean(list(tried.gain(name).values())))
    rows = [[*name.split(), *(f"{tried.gain(name)[kind]:+.1f}" for kind in KINDS)] for name in names if " " in name]
    columns = ("side", *NAMES, *(f"{kind}, dB" for kind in KINDS))
    for side, design in best.items():
        write_design(records.parent / f"best-{side}.toml", design)
    return Report({"design_search.md": markdown_table(columns, rows)}, [table(columns, rows[:12])])


if __name__ == "__main__":
    main(
        report,
        {
            "--starts": {"type": int, "default": 8},
            "--steps": {"type": int, "default": 3},
            "--records": {"type": Path, "default": Path("out/design_search/records.json")},
        },
    )
