"""Interrupt every command at random moments: exit status, delay, and files left behind.

Each run starts in a new folder with copies of its inputs. It should end within two seconds with exit status 130, or
have finished; its inputs should be unchanged, and no unfinished file should remain.

    python -m experiments.interrupts [--rounds N] [--out DIR]

Writes `interrupts.json` and `interrupts.md`; about ten seconds a run on two cores, 200 runs by default.
"""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from experiments.common import Report, main, table
from gs_jax import geomscope, write_capture, write_design
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.progress import Progress

# Seconds within which a command must end, and the longest delay before the interrupt.
SOON, LATEST = 2.0, 12.0
POINTS = "x_mm,y_mm,z_mm,intensity\n0.1,0.2,20,1\n1.1,-0.2,19,1\n"
COMMANDS = {
    "reconstruct": "capture.tif design.toml --depths 18:22:0.25 -o volume.ome.tif",
    "reconstruct, zarr": "capture.tif design.toml --depths 18:22:0.25 -o volume.zarr",
    "reconstruct, points": "capture.tif design.toml --depths 18:22:1 --suppress points -o v.ome.tif --points p.csv",
    "reconstruct, list-rl": "capture.tif design.toml --depths 18:22:1 --method list-rl -o volume.ome.tif",
    "reconstruct, unrolled": "capture.tif design.toml --depths 18:22:1 --method unrolled -o volume.ome.tif",
    "simulate": "points.csv design.toml -o new.tif",
    "deconvolve": "capture.tif capture.tif -o scene.tif --steps 1000",
    "metrics": "design.toml --json sheet.json",
    "layout": "--count 2000 --size-mm 60 60 --pitch-mm 1.2 -o centers.csv",
    "optimize": "design.toml --study design/studies/geomscope-optimized.toml -o new.toml",
    "pareto": "design/studies/geomscope-sharpness.toml --out front",
    "benchmark": "--out benchmark",
    "mold": "design.toml -o mold.stl",
    "mask": "design/geomscope-optimized.toml -o mask.dxf",
    "train": "--network unrolled -o weights.npz",
    "train, paper": "--network paper -o weights.npz",
    "demo": "--out demo",
    "info": "design.toml",
}


def interrupted(arguments: list[str], folder: Path, wait: float) -> dict:
    """Run a command once, and interrupt it after some seconds."""
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    # A process group of its own, so that the signal reaches no other process.
    process = subprocess.Popen(
        [sys.executable, "-m", "gs_jax", *arguments],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        process.communicate(timeout=wait)
        took, signalled = 0.0, False
    except subprocess.TimeoutExpired:
        began, signalled = time.monotonic(), True
        process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=20)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
        took = time.monotonic() - began
    lost = [str(path) for path, data in before.items() if not path.exists() or path.read_bytes() != data]
    left = [path.name for path in folder.rglob("*") if path.name.startswith(".gs-jax-")]
    status = process.wait()
    # Before Python runs the package's code, the signal itself ends the process.
    ended = (0, 130, -signal.SIGINT) if signalled else (0,)
    good = not lost and not left and status in ended and took <= SOON
    return {"after_s": wait, "status": status, "took_s": took, "lost": lost, "left": left, "good": good}


def run(commands: dict[str, str], rounds: int, *, progress: Progress, latest: float = LATEST) -> dict[str, list[dict]]:
    """Run `rounds` commands in total; return the results by command."""
    rng, results = np.random.default_rng(0), {name: [] for name in commands}
    with tempfile.TemporaryDirectory() as place:
        inputs = Path(place) / "inputs"
        inputs.mkdir()
        design = geomscope(sensor_distance_mm=5.8)
        write_design(inputs / "design.toml", design)
        light = rng.integers(0, 2000, design.sensor.shape).astype(np.uint16)
        write_capture(inputs / "capture.tif", light)
        (inputs / "points.csv").write_text(POINTS)
        shutil.copytree(Path(__file__).parents[1] / "design", inputs / "design")
        for number in progress.track(range(rounds), "Interrupting"):
            name = list(commands)[number % len(commands)]
            folder = Path(place) / "run"
            shutil.copytree(inputs, folder)
            arguments = [name.partition(",")[0], *commands[name].split()]
            results[name].append(interrupted(arguments, folder, float(rng.uniform(0.05, latest))))
            shutil.rmtree(folder)
    return results


def report(rounds: int, progress: Progress) -> Report:
    results = run(COMMANDS, rounds, progress=progress)
    columns = ("command", "runs", "interrupted", "as wanted", "longest, s", "other")
    rows = []
    for name, runs in results.items():
        ended = [each for each in runs if each["took_s"] > 0]
        bad = "; ".join(f"status {each['status']} after {each['took_s']:.1f} s" for each in runs if not each["good"])
        longest = max((each["took_s"] for each in ended), default=0.0)
        good = sum(each["good"] for each in runs)
        rows.append([name, str(len(runs)), str(len(ended)), str(good), f"{longest:.1f}", bad])
    text = "# Interrupts\n\n" + markdown_table(columns, rows) + "\n"
    return Report({"interrupts.json": results, "interrupts.md": text}, [table(columns, rows)])


if __name__ == "__main__":
    main(report, {"--rounds": {"type": int, "default": 200}})
