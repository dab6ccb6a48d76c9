"""The benchmark's records as JSON, CSV, Markdown tables and a figure."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..base.machine import describe
from ..io.files import atomic_write, write_figure, write_json, write_text
from ..io.provenance import KEY, Provenance
from .method_benchmark import STEPS
from .pictures import line_of

COLUMNS = (
    *("method", "pairs", "seconds", "compile_seconds", "peak_mib", "psnr_db", "ssim", "mse", "f1", "seed"),
    "objective",
)
_STOP = f"Every solver takes {STEPS} steps, converged or not."
# Exponents of the time in the text on the paper's Fig. 9(A): linear, and below 0.5.
_PAPER = {"admm, dense": "1", "richardson-lucy, dense": "1", "backproject": "< 0.5"}
_PANELS = {
    "seconds": "time, s",
    "peak_mib": "memory, MiB",
    "psnr_db": "PSNR, dB",
    "ssim": "SSIM",
    "mse": "MSE",
    "f1": "F1 of the points",
}

Records = Sequence[dict[str, Any]]


def write_records(path: Path, records: Records, provenance: Provenance | None = None) -> None:
    """Write the records as JSON, with their provenance."""
    write_json(path, ({KEY: dict(provenance)} if provenance else {}) | {"records": records})


def write(records: Records, skipped: Records, folder: Path, provenance: Provenance | None = None) -> None:
    """Write `benchmark.json`, `.csv`, `.md` and `.png`, and `benchmark-notes.json`.

    Raises `InputError` if the folder cannot be written to.
    """
    write_records(folder / "benchmark.json", records, provenance)
    notes = {"machine": describe(), "slopes": time_exponents(records), "left_out": skipped}
    write_json(folder / "benchmark-notes.json", notes)
    with atomic_write(folder / "benchmark.csv") as path, path.open("w", encoding="utf-8", newline="") as file:
        columns: list[str] = list(COLUMNS)
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(records)
    write_text(folder / "benchmark.md", markdown(records, skipped), [".md"])
    write_figure(folder / "benchmark.png", picture(records))


def _values(records: Records, method: str, pairs: float, key: str) -> list[float]:
    return [r[key] for r in records if r["method"] == method and r["pairs"] == pairs and r[key] is not None]


def _unique(records: Records, key: str) -> list:
    return list(dict.fromkeys(r[key] for r in records))


def _mean_and_deviation(values: Sequence[float], form: str) -> str:
    if not values:
        return "-"
    mean = format(float(np.mean(values)), form)
    return mean if len(values) == 1 else f"{mean} +- {format(float(np.std(values, ddof=1)), form)}"


def time_exponents(records: Records) -> dict[str, float]:
    """Exponent of the time in pairs of each method, by linear regression of the logarithms from 1e6 to 2e9 pairs."""
    exponents = {}
    for name in dict.fromkeys(r["method"] for r in records if r["seconds"] > 0):
        rows = [r for r in records if r["method"] == name and r["pairs"] < 3e9]
        if len({r["pairs"] for r in rows}) > 1:
            logs = np.log([[r["pairs"], r["seconds"]] for r in rows])
            exponents[name] = float(np.polyfit(logs[:, 0], logs[:, 1], 1)[0])
    return exponents


def markdown(records: Records, skipped: Records) -> str:
    """Tables of time, memory and quality by pairs, exponents of time, and what was skipped."""
    methods, sizes = _unique(records, "method"), sorted(_unique(records, "pairs"))
    timed = [m for m in methods if any(r["seconds"] > 0 for r in records if r["method"] == m)]
    convex = [m for m in methods if any(r["objective"] is not None for r in records if r["method"] == m)]
    parts = [_STOP]
    for title, key, form, rows in (
        ("Time, s (the fastest of some warm calls)", "seconds", ".2g", timed),
        ("Compilation (of a dense method: the matrix too), s", "compile_seconds", ".2g", timed),
        ("Memory that is added at the peak, MiB (at the first size: the compiler too)", "peak_mib", ".0f", timed),
        ("PSNR, dB", "psnr_db", ".1f", methods),
        ("SSIM", "ssim", ".3f", methods),
        ("MSE", "mse", ".1e", methods),
        ("F1 of the peaks", "f1", ".2f", methods),
        ("Objective of least squares, over that of an empty volume", "objective", ".4f", convex),
    ):
        body = [[m, *(_mean_and_deviation(_values(records, m, p, key), form) for p in sizes)] for m in rows]
        parts += [f"**{title}**", markdown_table(["pairs", *(f"{p:.1e}" for p in sizes)], body)]
    rows = [[m, f"{exponent:.2f}", _PAPER.get(m, "-")] for m, exponent in time_exponents(records).items()]
    parts += ["**Exponent of time in pairs, 1e6 to 2e9**", markdown_table(["method", "found", "paper"], rows)]
    if skipped:
        rows = [[r["method"], f"{r['pairs']:.1e}", r["reason"]] for r in skipped]
        parts += ["**Left out**", markdown_table(["method", "pairs", "why"], rows)]
    return "\n\n".join(parts) + "\n"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    line = lambda cells: "| " + " | ".join(cells) + " |"
    return "\n".join([line(head), "|" + " --- |" * len(head), *map(line, rows)])


def picture(records: Records) -> Figure:
    """The panels of Fig. 9 and two more: means, with standard deviations as bars."""
    figure = Figure(figsize=(12, 8), dpi=100, layout="constrained")
    for axes, (key, label) in zip(figure.subplots(2, 3).flat, _PANELS.items(), strict=True):
        is_cost = key in ("seconds", "peak_mib")
        for method in _unique(records, "method"):
            if method == "zeros" and is_cost:
                continue
            pairs = sorted({r["pairs"] for r in records if r["method"] == method})
            values = [_values(records, method, p, key) for p in pairs]
            errors = None if is_cost else [np.std(v) for v in values]
            axes.errorbar(pairs, [np.mean(v) for v in values], errors, **line_of(method))
        axes.set(xscale="log", xlabel="pixel-voxel pairs", ylabel=label)
        if is_cost or key == "mse":
            axes.set_yscale("log")
        axes.grid(alpha=0.25)
    handles, labels = figure.axes[2].get_legend_handles_labels()
    figure.legend(handles, labels, title=_STOP, loc="outside lower center", ncols=5, fontsize=9)
    return figure
