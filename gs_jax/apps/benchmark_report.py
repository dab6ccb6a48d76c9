"""The benchmark's records as files: JSON, CSV, Markdown tables and a picture."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..base.machine import describe
from ..io.files import atomic_write, write_figure, write_json, write_text
from ..io.provenance import KEY, Provenance
from ..pictures.style import line_of
from .method_benchmark import STEPS, slopes

COLUMNS = (
    *("method", "pairs", "seconds", "compile_seconds", "peak_mib", "psnr_db", "ssim", "mse", "f1", "seed"),
    "objective",
)
# The stopping rule, and so what the times are of.
_STOP = f"Every solver takes {STEPS} steps, converged or not."
# The paper's Fig. 9(A), in words of its text: linear, and below 0.5.
_PAPER = {"admm, dense": 1.0, "richardson-lucy, dense": 1.0, "backproject": 0.5}
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
    """The records as JSON, and where they come from; `InputError` if it cannot be written."""
    write_json(path, ({KEY: dict(provenance)} if provenance else {}) | {"records": records})


def write(records: Records, left_out: Records, folder: Path, provenance: Provenance | None = None) -> None:
    """The records as `benchmark.json`, `.csv`, `.md` and `.png`; the rest in `benchmark-notes.json`.

    Raises
    ------
    InputError
        If the folder cannot be written to.
    """
    write_records(folder / "benchmark.json", records, provenance)
    notes = {"machine": describe(), "slopes": slopes(records), "left_out": left_out}
    write_json(folder / "benchmark-notes.json", notes)
    with atomic_write(folder / "benchmark.csv") as path, path.open("w", encoding="utf-8", newline="") as file:
        columns: list[str] = list(COLUMNS)
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(records)
    write_text(folder / "benchmark.md", markdown(records, left_out), [".md"])
    write_figure(folder / "benchmark.png", picture(records))


def _of(records: Records, method: str, pairs: float, key: str) -> list[float]:
    return [r[key] for r in records if r["method"] == method and r["pairs"] == pairs and r[key] is not None]


def _unique(records: Records, key: str) -> list:
    return list(dict.fromkeys(r[key] for r in records))


def spread(values: Sequence[float], form: str) -> str:
    """Mean and, of several, standard deviation."""
    if not values:
        return "-"
    middle = format(float(np.mean(values)), form)
    return middle if len(values) == 1 else f"{middle} +- {format(float(np.std(values, ddof=1)), form)}"


def markdown(records: Records, left_out: Records) -> str:
    """The stopping rule; time, memory and quality against pairs, exponents of time, what was left out and why."""
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
        body = [[m, *(spread(_of(records, m, p, key), form) for p in sizes)] for m in rows]
        parts += [f"**{title}**", markdown_table(["pairs", *(f"{p:.1e}" for p in sizes)], body)]
    found = slopes(records)
    limit = lambda m: {1.0: "1", 0.5: "< 0.5"}.get(_PAPER.get(m, 0.0), "-")
    parts += ["**Exponent of time in pairs, 1e6 to 2e9**"]
    parts += [markdown_table(["method", "found", "paper"], [[m, f"{s:.2f}", limit(m)] for m, s in found.items()])]
    if left_out:
        rows = [[r["method"], f"{r['pairs']:.1e}", r["reason"]] for r in left_out]
        parts += ["**Left out**", markdown_table(["method", "pairs", "why"], rows)]
    return "\n\n".join(parts) + "\n"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """In Markdown."""
    line = lambda cells: "| " + " | ".join(cells) + " |"
    return "\n".join([line(head), "|" + " --- |" * len(head), *map(line, rows)])


def picture(records: Records) -> Figure:
    """The panels of Fig. 9 and two more; lines through the means, bars for the standard deviation."""
    figure = Figure(figsize=(12, 8), dpi=100, layout="constrained")
    for axes, (key, label) in zip(figure.subplots(2, 3).flat, _PANELS.items(), strict=True):
        for method in _unique(records, "method"):
            if method == "zeros" and key in ("seconds", "peak_mib"):
                continue
            pairs = sorted({r["pairs"] for r in records if r["method"] == method})
            values = [_of(records, method, p, key) for p in pairs]
            errors = [np.std(v) for v in values] if key not in ("seconds", "peak_mib") else None
            axes.errorbar(pairs, [np.mean(v) for v in values], errors, **line_of(method))
        axes.set(xscale="log", xlabel="pixel-voxel pairs", ylabel=label)
        if key in ("seconds", "peak_mib", "mse"):
            axes.set_yscale("log")
        axes.grid(alpha=0.25)
    handles, labels = figure.axes[2].get_legend_handles_labels()
    figure.legend(handles, labels, title=_STOP, loc="outside lower center", ncols=5, fontsize=9)
    return figure
