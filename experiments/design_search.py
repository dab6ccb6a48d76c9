"""Search for lenses by the judge itself: the volumes that the unrolled inversion makes of ray-traced scenes.

Free are the sensor distance, the depth of the paraxial focus, the aperture, the conic constant and the pitch; each side
of the lenses may face the object. The refractive index, the plate and the pixels are the paper's; plate and sensor
distance are 7 mm at most. A design's score is the mean over four kinds of scenes of its PSNR above `geomscope`'s, for
the same exposure time, 3,000 electrons in its brightest pixel, as in `design_judge.py` but for a smaller field.
Starts are from a Sobol sequence, for both sides; from the best one CMA-ES (`cma`) goes on. A second table has
Spearman's correlations of terms of studies with these scores, as in `design_ranks.py`, and that of a Gaussian process
of the side and the five numbers, which predicts each design's score from the others'.

    python -m experiments.design_search [--starts 8] [--steps 3] [--records FILE] [--out DIR]

Writes the records after each scene, from which the next run goes on, and then `design_search.md`; about a minute and a
quarter of two cores for each design.
"""

from pathlib import Path

import cma
import jax
import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.stats import qmc

from experiments.common import Report, main, table
from experiments.design_judge import KINDS, Judge, Settings, mean_of
from experiments.design_ranks import BETTER, correlation, term_of
from gs_jax import Design, geomscope
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.errors import InputError
from gs_jax.base.progress import Progress
from gs_jax.io.files import make_folder

EXPOSURE = 3000
SETTINGS = Settings(field=1.6, sensor=7.0, exposures=(EXPOSURE,), methods=("unrolled",), rays=300)
SIDES = ("plano", "curved")
# Terms of studies whose ranks are compared: light, a volume's error, and the two that rank best in `design_ranks.py`.
OBJECTIVES = ("light_percent", "volume_error", "psf_width_um", "encircled_radius_um")
# Sensor distance, mm; paraxial focus, mm; aperture, mm; conic constant; pitch, of the paper's.
LOW, HIGH = np.array([3.0, 17.0, 0.5, -1.5, 0.85]), np.array([6.0, 32.0, 2.0, 0.5, 1.4])
NAMES = ("v, mm", "focus, mm", "D, mm", "k", "pitch")
# The first standard deviation of CMA-ES, in units of the bounds, and designs in a generation.
SPREAD, POPULATION, SEED = 0.15, 8, 1
# The paper's own numbers, but for the radius, which follows from the focus.
PAPER = np.array([5.8, 23.5, 2.0, 0.0, 1.0])


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


class Search:
    """Designs that were judged, with the gains in PSNR over `geomscope` for each kind of scene, dB."""

    def __init__(self, judge: Judge, progress: Progress):
        self.judge, self.progress = judge, progress
        # By name: the design, its numbers in units of the bounds after that of its side, and its gains.
        self.judged: dict[str, tuple[Design, np.ndarray, np.ndarray]] = {}
        self.reference = self.psnr_of(geomscope())

    def psnr_of(self, design: Design) -> np.ndarray:
        """PSNR of each kind of scene, dB."""
        records = self.judge.judge(design.name, design.imager(), range(1), self.progress)
        # The next design needs other programs; those of some fifty designs, kept, crashed the process.
        jax.clear_caches()
        return np.array([mean_of(records, kind, EXPOSURE, lambda r: r["unrolled"]["psnr_db"]) for kind in KINDS])

    def score(self, side: str, at: np.ndarray) -> float:
        """Mean gain of a design."""
        design = design_of(side, at)
        gains = self.psnr_of(design) - self.reference
        self.judged[design.name] = design, np.append(SIDES.index(side), (at - LOW) / (HIGH - LOW)), gains
        return float(gains.mean())

    def go_on(self, side: str, start: np.ndarray, steps: int) -> None:
        """Search by CMA-ES from a start, so many generations."""
        width = HIGH - LOW
        # A generator of its own: the global one is drawn from elsewhere, and a search that goes on would be another.
        normal = np.random.default_rng(SEED).standard_normal
        options = {"bounds": [0, 1], "popsize": POPULATION, "seed": SEED, "verbose": -9}
        options["randn"] = lambda *shape: normal(shape)
        strategy = cma.CMAEvolutionStrategy((start - LOW) / width, SPREAD, options)
        for _ in range(steps):
            units = strategy.ask()
            strategy.tell(units, [-self.score(side, LOW + unit * width) for unit in units])


def report(starts: int, steps: int, records: Path, progress: Progress) -> Report:
    if starts < 1 or steps < 0:
        raise InputError(f"--starts must be 1 or more and --steps 0 or more, got {starts} and {steps}.")
    make_folder(records.parent)
    search = Search(Judge(records, SETTINGS, geomscope().imager()), progress)
    points = [PAPER, *qmc.scale(qmc.Sobol(len(LOW), rng=SEED).random(starts), LOW, HIGH)]
    scores = {(side, number): search.score(side, at) for side in SIDES for number, at in enumerate(points)}
    side, number = max(scores, key=lambda start: scores[start])
    search.go_on(side, points[number], steps)
    best = sorted(search.judged.items(), key=lambda item: -item[1][2].mean())
    rows = [[*name.split(), *(f"{gain:+.1f}" for gain in gains)] for name, (_, _, gains) in best]
    columns = ("side", *NAMES, *(f"{kind}, dB" for kind in KINDS))
    designs, numbers, all_gains = zip(*(judged for _, judged in best), strict=True)
    ranked = ranks(list(designs), np.array(numbers), np.array(all_gains), progress)
    tables = (markdown_table(columns, rows), markdown_table(*ranked))
    return Report({"design_search.md": "\n\n".join(tables)}, [table(columns, rows[:12]), table(*ranked)])


def ranks(
    designs: list[Design], numbers: np.ndarray, gains: np.ndarray, progress: Progress
) -> tuple[tuple[str, ...], list[list[str]]]:
    """Spearman's correlations of terms of studies with the mean gain, and with those of sparse and dense scenes."""
    # Terms are evaluated in float64; the judge before them, as users reconstruct, in float32.
    jax.config.update("jax_enable_x64", True)
    judges = (gains.mean(1), gains[:, :2].mean(1), gains[:, 2:].mean(1))
    cell = lambda a, b: "{:.2f} ({:.2f} to {:.2f})".format(*correlation(a, b))
    rows = [["Gaussian process, each design left out", *(cell(predicted(numbers, by), by) for by in judges)]]
    imagers = [design.imager() for design in designs]
    for name in progress.track(OBJECTIVES, "Terms"):
        values = BETTER[name] * np.array([term_of(name, imager) for imager in imagers])
        rows.append([f"`{name}`", *(cell(values, by) for by in judges)])
    return ("objective", f"{len(designs)} designs", "letters, beads", "tilted sheets, texture"), rows


def predicted(numbers: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Predict each value from the others by a Gaussian process of the numbers, with the likeliest widths."""
    count, columns = numbers.shape
    apart = (numbers[:, None] - numbers) ** 2

    def covariance(logs):
        return np.exp(logs[-2] - (apart * np.exp(-2 * logs[:columns])).sum(-1) / 2) + np.exp(logs[-1]) * np.eye(count)

    def unlikely(logs):
        lower = np.linalg.cholesky(covariance(logs))
        white = solve_triangular(lower, values - values.mean(), lower=True)
        return white @ white / 2 + np.log(np.diag(lower)).sum()

    bounds = [(-3, 3)] * columns + [(-2, 6), (-6, 3)]
    starts = (np.append(np.full(columns, width), [3, 0]) for width in (-1, 0, 1))
    fits = [minimize(unlikely, start, method="L-BFGS-B", bounds=bounds) for start in starts]
    inverse = np.linalg.inv(covariance(min(fits, key=lambda fit: fit.fun).x))
    return values - inverse @ (values - values.mean()) / np.diag(inverse)


if __name__ == "__main__":
    main(
        report,
        {
            "--starts": {"type": int, "default": 8},
            "--steps": {"type": int, "default": 3},
            "--records": {"type": Path, "default": Path("out/design_search/records.json")},
        },
    )
