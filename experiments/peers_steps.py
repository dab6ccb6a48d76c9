"""A step of Richardson-Lucy, FISTA and ADMM on one plane and PSF: time and memory, ours, scico's and LenslessPiCam's.

The plane is DiffuserCam's hand, at a quarter of its size and in full, as in `peers_deconvolution.py`, with total
variation in ADMM alone. Each code and method runs in a process of its own, the codes in turn, in several rounds; ratios
are of the same round, medians over rounds. Objectives are of the scene after the last step, for all by the same lines
of NumPy. scico and LenslessPiCam have no Richardson-Lucy: its step is written in their operators.

    python -m experiments.peers_steps DATA [--scico PYTHON] [--lensless PYTHON] [--rounds 3] [--out DIR]

DATA holds the folder `diffusercam`; PYTHON are those of environments with the peers. Writes `peers_steps.json` and
`peers_steps.md`; about five minutes on two cores.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.common import Report, main, table
from experiments.peers_deconvolution import plane, run
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.machine import describe
from gs_jax.base.progress import Progress

METHODS = ("Richardson-Lucy", "FISTA", "ADMM")
CODES = ("gs_jax", "scico", "LenslessPiCam")
# Reductions of the plane's sides, and steps.
STEPS = {4: 60, 1: 12}
COLUMNS = ("pixels", "method", "code", "ms a step", "over ours", "processor, ms", "memory, MiB", "objective")


def rows_of(rounds: Sequence[dict[str, dict]]) -> list[dict]:
    """Medians of the steps of each code and method, and over rounds; ratios to ours within a round."""
    rows = []
    for name in rounds[0]:
        code, method = name.split(maxsplit=1)
        results = [found[name] for found in rounds]
        seconds = [_median_step(result["seconds"]) for result in results]
        ours = [_median_step(found[f"gs_jax {method}"]["seconds"]) for found in rounds]
        rows.append(
            {
                "method": method,
                "code": code,
                "versions": str(results[0]["versions"]),
                "seconds_a_step": float(np.median(seconds)),
                "rounds_seconds_a_step": seconds,
                "over_ours": float(np.median(np.divide(seconds, ours))),
                "processor_seconds_a_step": float(np.median([_median_step(r["processor_seconds"]) for r in results])),
                "peak_mib": float(np.median([r["peak_mib"] for r in results])),
                "objective": float(results[0]["objectives"][-1]),
            }
        )
    return rows


def _median_step(sums: np.ndarray) -> float:
    return float(np.median(np.diff(sums, prepend=0)))


def cells_of(pixels: str, row: dict) -> list[str]:
    times = [f"{1000 * row[name]:.3g}" for name in ("seconds_a_step", "processor_seconds_a_step")]
    rest = (f"{row['peak_mib']:.0f}", f"{row['objective']:.3g}")
    return [pixels, row["method"], row["code"], times[0], f"{row['over_ours']:.2f}", times[1], *rest]


def report(data: Path, scico: str | None, lensless: str | None, rounds: int, progress: Progress) -> Report:
    pythons = {"gs_jax": sys.executable, "scico": scico, "LenslessPiCam": lensless}
    given = {code: python for code, python in pythons.items() if python}
    found = {}
    for factor, count in STEPS.items():
        problem = plane(data / "diffusercam", factor)
        each: list[dict[str, dict]] = [{} for _ in range(rounds)]
        for results in each:
            for method in METHODS:
                posed = problem if method == "ADMM" else problem | {"tv": 0.0}
                results |= run(posed, given, {f"{code} {method}": count for code in CODES}, progress)
        found["{} x {}".format(*np.shape(problem["image"]))] = rows_of(each)
    cells = [cells_of(pixels, row) for pixels, rows in found.items() for row in rows]
    steps = dict(zip(found, STEPS.values(), strict=True))
    numbers = {"machine": describe(), "steps": steps, "rows": found}
    return Report(
        {"peers_steps.json": numbers, "peers_steps.md": markdown_table(COLUMNS, cells)}, [table(COLUMNS, cells)]
    )


if __name__ == "__main__":
    interpreter = {"help": "Python of an environment with this peer."}
    arguments = {"data": {"type": Path}, "--scico": interpreter, "--lensless": interpreter}
    main(report, arguments | {"--rounds": {"type": int, "default": 3, "help": "Rounds [3]."}})
