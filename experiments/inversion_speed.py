"""Time the iterative methods at their defaults, and the parts of the full forward model, beside another checkout.

The capture has 5120 x 5120 pixels of letters and points at nine depths, as the package itself renders them. Each
checkout runs in processes of its own, which take turns; the first call of each method is timed apart, as it compiles.
Processor time varies less than time by the clock where other programs run. Volumes of both are compared.

    python -m experiments.inversion_speed [--before CHECKOUT] [--methods list-rl,richardson-lucy] [--out DIR]

Writes `inversion_speed.json` and `inversion_speed.md`; 20 minutes on two cores with all methods and two checkouts.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import Report, main, table
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.errors import InputError
from gs_jax.base.progress import Progress

METHODS = "list-rl,richardson-lucy,unrolled,fista,admm"
DEPTHS = np.linspace(18.0, 22.0, 9)
ROUNDS = 3
HERE = Path(__file__).parents[1]
_WORKER = "import sys, runpy; runpy.run_path(sys.argv[1], run_name='worker')"


def measure(call: Callable[[], Any], rounds: int) -> tuple[dict[str, float], Any]:
    """Seconds of the first call and of later ones, by the clock (median) and processors (least), and the result."""
    clock, processor, result = [], [], None
    for _ in range(1 + rounds):
        before = time.perf_counter(), time.process_time()
        result = call()
        clock.append(time.perf_counter() - before[0])
        processor.append(time.process_time() - before[1])
    seconds = float(np.median(clock[1:])), min(processor[1:])
    return {"first_s": clock[0], "clock_s": seconds[0], "processor_s": seconds[1]}, result


def scene(grid) -> np.ndarray:
    """A volume with bars of three widths at three depths, and points at the others."""
    volume, (rows, columns) = np.zeros(grid.volume_shape, np.float32), grid.shape
    for plane, width in ((1, 3), (4, 5), (7, 9)):
        for bar in range(5):
            first = columns // 4 + 2 * width * bar
            volume[plane, rows // 3 : rows // 2, first : first + width] = 1
    for plane in (0, 2, 6, 8):
        volume[plane, rows // 2 + 7 * plane, columns // 2 + 5 * plane] = 20
    return volume


def work(name: str, folder: Path, pixels: int) -> dict[str, Any]:
    """Time a method, or the parts of the model, in this process; the volume goes to the folder."""
    import jax

    import gs_jax as gs
    from gs_jax.reconstruction.inverse_problem import prepare_model
    from gs_jax.reconstruction.methods import METHODS as BY_NAME
    from gs_jax.reconstruction.pipeline import PIXELS_PER_VOXEL, reconstructor, voxel_grid

    sensor = gs.geomscope().sensor
    scope = gs.geomscope().replace(shape=(pixels, pixels), pixel_pitch_um=sensor.pixel_pitch_um).imager()
    grid = voxel_grid(scope, DEPTHS.tolist(), None, pixels=PIXELS_PER_VOXEL)
    if name == "model":
        began = time.perf_counter()
        model = prepare_model(scope, grid, "full", Progress())
        parts = {"tables": {"first_s": time.perf_counter() - began}}
        A = gs.ImagingOperator(model.imager, grid, model.optics)
        forward, adjoint = jax.jit(lambda A, x: A.mv(x)), jax.jit(lambda A, y: A.T.mv(y))
        volume = scene(grid)
        parts["forward"], image = measure(lambda: jax.block_until_ready(forward(A, volume)), ROUNDS)
        parts["adjoint"], _ = measure(lambda: jax.block_until_ready(adjoint(A, image)), ROUNDS)
        np.save(folder / "image.npy", np.kron(np.asarray(image), np.ones((model.binning, model.binning), np.float32)))
        return parts
    image = np.load(folder / "image.npy")
    light = np.maximum(image, 0) * (2000 / image.max())
    image = np.random.default_rng(0).poisson(light).astype(np.float32)
    image = np.pad(image, [(0, n - m) for n, m in zip(scope.sensor.shape, image.shape, strict=True)])
    began = time.perf_counter()
    invert = reconstructor(scope, grid, BY_NAME[name](20), progress=Progress())
    tables = time.perf_counter() - began
    seconds, volume = measure(lambda: invert(image, Progress()), 1)
    np.save(folder / "volume.npy", volume)
    return seconds | {"tables_s": tables, "memory_mib": peak_memory_mib()}


def peak_memory_mib() -> float:
    """The most memory that this process had."""
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform == "linux" else 1024**2)


def in_checkout(checkout: Path, name: str, folder: Path, pixels: int) -> dict[str, Any]:
    """`work` with the package of a checkout, in a process of its own."""
    environment = os.environ | {"PYTHONPATH": str(checkout), "GS_JAX_TASK": json.dumps([name, str(folder), pixels])}
    command = [sys.executable, "-c", _WORKER, str(Path(__file__))]
    done = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise InputError(f"{checkout}: {name} must run, got: {done.stderr.strip().splitlines()[-1]}")
    return json.loads(done.stdout.splitlines()[-1])


def run(checkouts: dict[str, Path], names: list[str], folder: Path, pixels: int, progress: Progress) -> list[dict]:
    """Results of each method, by checkout; the PSNR is of the volumes after the first checkout's."""
    results = []
    for name in progress.track(["model", *names], "Timing"):
        row, volumes = {"name": name}, []
        for label, checkout in checkouts.items():
            row[label] = in_checkout(checkout, name, folder, pixels)
            if name != "model":
                volumes.append(np.load(folder / "volume.npy"))
        if len(volumes) == 2:
            difference = np.sqrt(np.mean((volumes[1] - volumes[0]) ** 2))
            row["difference"] = float(difference / np.sqrt(np.mean(volumes[0] ** 2)))
        results.append(row)
    return results


def rows_of(results: list[dict], labels: list[str]) -> list[list[str]]:
    number = lambda value: "" if value is None else f"{value:.2f}"
    rows = []
    for result in results:
        parts = result[labels[0]] if result["name"] == "model" else {"": result[labels[0]]}
        for part in parts:
            each = [(result[label][part] if part else result[label]) for label in labels]
            clock, processor = ([one.get(key) for one in each] for key in ("clock_s", "processor_s"))
            ratio = lambda pair: number(pair[0] / pair[1]) if len(pair) == 2 and None not in pair else ""
            rows.append(
                [part or result["name"]]
                + [number(one["first_s"]) for one in each]
                + [number(value) for value in (*clock, *processor)]
                + [ratio(clock), ratio(processor)]
                + ["/".join(f"{one['memory_mib']:.0f}" for one in each if "memory_mib" in one)]
                + [f"{result['difference']:.4f}" if "difference" in result else ""]
            )
    return rows


def report(before: Path | None, methods: str, pixels: int, progress: Progress) -> Report:
    import tempfile

    checkouts = ({"before": before.resolve()} if before else {}) | {"now": HERE}
    with tempfile.TemporaryDirectory() as folder:
        results = run(checkouts, methods.split(","), Path(folder), pixels, progress)
    labels = list(checkouts)
    columns = ["", *(f"{label}, {what}, s" for what in ("first", "clock", "processor") for label in labels)]
    columns += ["clock, ratio", "processor, ratio", "memory, MiB", "difference of volumes"]
    rows = rows_of(results, labels)
    text = f"# Inversion of {pixels} x {pixels} pixels, nine depths\n\n{markdown_table(columns, rows)}\n"
    return Report({"inversion_speed.json": results, "inversion_speed.md": text}, [table(columns, rows)])


if __name__ == "worker":
    name, folder, pixels = json.loads(os.environ["GS_JAX_TASK"])
    print(json.dumps(work(name, Path(folder), pixels)))
if __name__ == "__main__":
    main(
        report,
        {
            "--before": {"type": Path, "metavar": "CHECKOUT"},
            "--methods": {"default": METHODS},
            "--pixels": {"type": int, "default": 5120},
        },
    )
