"""Time, memory and quality of the forward models, the iterative methods at their defaults, and three other functions.

The scene is ray-traced: with DATA another group's captures of 5120 x 5120 pixels, of letters at nine depths and, for
`find_points`, of points; without it letters of another device, by our tracer. Each line runs in a process of its own;
the first call is timed apart, as it compiles. "dB" is the PSNR above that of an empty volume (`gs_jax.quality`).

    python -m experiments.inversion_speed [DATA] [--methods list-rl,richardson-lucy] [--beside CHECKOUT] [--out DIR]

With `--beside` each line also runs in a second process with the package of CHECKOUT, in turns, and "faster" is the
ratio of their times. On a GPU or TPU the tables of `backprojection_speed` come first, and "launches" are kernels and
copies in a call. Writes `inversion_speed.json` and `inversion_speed.md`; about five minutes on two cores.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np

import gs_jax as gs
from experiments.common import OPTIONAL_PATH, Report, main, names_of, tables_report

HERE = Path(__file__).parents[1]
METHODS = ("list-rl", "richardson-lucy", "unrolled", "fista", "admm")
# Others: `find_points`, `simulate`, and the network that suppresses haze.
NAMES = ("near", "full", *METHODS, "others")
# Later calls; a method takes long, and gets one, unless it is compared.
ROUNDS = 3
COLUMNS = {
    "first_s": ("first call, s", ".1f"),
    "clock_s": ("later calls, s", ".2f"),
    "processor_s": ("processors, s", ".2f"),
    "faster": ("faster", ".2f"),
    "memory_mib": ("MiB", ".0f"),
    "db": ("dB", ".2f"),
    "launches": ("launches", ".0f"),
}


@contextmanager
def process(checkout: Path, name: str, data: str) -> Iterator[Callable[[], Any]]:
    """Start a process with the package of a checkout; yields a function that asks `serve`."""
    command = [sys.executable, "-P", str(Path(__file__).with_name("timed_calls.py")), name, data]
    # Several processes share a GPU.
    environment = os.environ | {"PYTHONPATH": str(checkout), "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=environment, **pipes) as worker:
        answers: Any = worker.stdout

        def ask() -> Any:
            print(file=worker.stdin, flush=True)
            return json.loads(answers.readline())

        yield ask


def run(names: list[str], data: str, beside: Path | None, progress: gs.Progress) -> dict[str, dict[str, float]]:
    """Seconds, memory and quality by what is timed."""
    results, checkouts = {}, {"": HERE} if beside is None else {", before": beside, ", now": HERE}
    for name in progress.track(names, "Timing"):
        rounds = 1 if name in METHODS and beside is None else ROUNDS
        with ExitStack() as stack:
            asks = {label: stack.enter_context(process(path, name, data)) for label, path in checkouts.items()}
            taken = [{label: ask() for label, ask in asks.items()} for _ in range(1 + rounds)]
        for key in taken[0][next(iter(checkouts))]:
            for label in checkouts:
                first, *later = [round_of[label][key] for round_of in taken]
                clock = {"first_s": first["clock_s"], "clock_s": float(np.median([row["clock_s"] for row in later]))}
                results[key + label] = later[-1] | clock | {"processor_s": min(row["processor_s"] for row in later)}
            if beside is not None:
                before, now = (results[key + label] for label in checkouts)
                now["faster"] = before["clock_s"] / now["clock_s"]
    return results


def report(data: Path | None, methods: list[str], beside: Path | None, progress: gs.Progress) -> Report:
    if beside is not None and not (beside / "gs_jax").is_dir():
        raise gs.InputError(f"--beside must be a checkout, got {beside}.")
    of_projections = Report({})
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    if jax.default_backend() != "cpu":
        from experiments import backprojection_speed

        of_projections = backprojection_speed.report(progress)
    results = run(methods, str(data.resolve()) if data else "", beside and beside.resolve(), progress)
    keys = [key for key in COLUMNS if any(key in row for row in results.values())]
    cell = lambda row, key: format(row[key], COLUMNS[key][1]) if key in row else ""
    rows = [[name, *(cell(row, key) for key in keys)] for name, row in results.items()]
    columns = (jax.devices()[0].device_kind, *(COLUMNS[key][0] for key in keys))
    files, shown = tables_report("inversion_speed", results, (columns, rows))
    return Report(of_projections.files | files, [*of_projections.shown, *shown])


if __name__ == "__main__":
    methods = {"type": names_of(NAMES), "default": NAMES}
    main(report, {"data": OPTIONAL_PATH, "--methods": methods, "--beside": {"type": Path, "metavar": "CHECKOUT"}})
