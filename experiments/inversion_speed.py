"""Time the iterative methods at their defaults, and the full forward model, beside another checkout.

The scene has bars of three widths and points at nine depths, and its capture 5120 x 5120 pixels, rendered by the first
checkout. Each checkout runs in processes of its own, one after the other; the first call of a method is timed apart, as
it compiles. Processor time varies less than time by the clock where other programs run. "Difference" is the RMS of that
of the two volumes, over the first one's.

    python -m experiments.inversion_speed [--before CHECKOUT] [--methods list-rl,richardson-lucy] [--out DIR]

Writes `inversion_speed.json` and `inversion_speed.md`; with two checkouts four minutes on two cores for the model and
Richardson-Lucy.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import Report, main, table
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.errors import InputError
from gs_jax.base.machine import status_mib
from gs_jax.base.progress import Progress

DEPTHS = np.linspace(18.0, 22.0, 9)
METHODS = ("list-rl", "richardson-lucy", "unrolled", "fista", "admm")
# `find_points`, `simulate`, and the network that suppresses haze.
OTHERS = "others"
# Later calls of the model; a method takes long, and gets one.
ROUNDS = 3
HERE = Path(__file__).parents[1]


def measure(call: Callable[[], Any], rounds: int) -> tuple[dict[str, float], Any]:
    """Seconds of the first call and of later ones, by the clock (median) and processors (least), and the result."""
    clock, processor, result = [], [], None
    for _ in range(1 + rounds):
        before = time.perf_counter(), time.process_time()
        result = call()
        clock.append(time.perf_counter() - before[0])
        processor.append(time.process_time() - before[1])
    return {"first_s": clock[0], "clock_s": float(np.median(clock[1:])), "processor_s": min(processor[1:])}, result


def scene(shape: tuple[int, int, int]) -> np.ndarray:
    """A volume with bars at three depths, and points at four others."""
    volume, (_, rows, columns) = np.zeros(shape, np.float32), shape
    for plane, width in ((1, 3), (4, 5), (7, 9)):
        for bar in range(5):
            first = columns // 4 + 2 * width * bar
            volume[plane, rows // 3 : rows // 2, first : first + width] = 1
    for plane in (0, 2, 6, 8):
        volume[plane, rows // 2 + 7 * plane, columns // 2 + 5 * plane] = 20
    return volume


def others(scope: Any) -> dict[str, Any]:
    """Time finding 100 points, imaging three planes, and five slices of the network."""
    import gs_jax as gs
    from gs_jax.reconstruction.pipeline import PIXELS_PER_VOXEL, voxel_grid

    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-8, 8, (100, 2)), rng.uniform(18, 22, 100), np.ones(100)])
    image = np.asarray(gs.simulate(points, scope))
    counts = rng.poisson(image * (2000 / image.max())).astype(np.float32)
    fine, three = voxel_grid(scope, DEPTHS.tolist()), voxel_grid(scope, [18.0, 20.0, 22.0], pixels=PIXELS_PER_VOXEL)
    planes = np.zeros(three.volume_shape, np.float32)
    planes[:, 100:200, 100:120] = 1
    slices = rng.random((5, 512, 512)).astype(np.float32)
    calls = {
        "find_points": lambda: gs.find_points(counts, scope, fine),
        "simulate": lambda: np.asarray(gs.simulate(planes, scope, three)),
        "suppress": lambda: gs.suppress(slices),
    }
    return {name: measure(call, ROUNDS)[0] for name, call in calls.items()}


def work(name: str, folder: Path, pixels: int) -> dict[str, Any]:
    """Time the model, which renders the capture, or a method, whose volume goes to the folder."""
    import equinox as eqx
    import jax

    import gs_jax as gs
    from gs_jax.reconstruction.inverse_problem import prepare_model
    from gs_jax.reconstruction.pipeline import METHODS as BY_NAME, PIXELS_PER_VOXEL, Reconstructor, voxel_grid

    scope = gs.geomscope().imager()
    scope = eqx.tree_at(lambda i: i.sensor, scope, gs.Sensor((pixels, pixels), scope.sensor.pixel_pitch))
    if name == OTHERS:
        return others(scope)
    grid = voxel_grid(scope, DEPTHS.tolist(), None, pixels=PIXELS_PER_VOXEL)
    if name == "model":
        began = time.perf_counter()
        model = prepare_model(scope, grid, "full", Progress())
        parts = {"tables": {"first_s": time.perf_counter() - began}}
        A, volume = gs.ImagingOperator(model.imager, grid, model.optics), scene(grid.volume_shape)
        forward, adjoint = jax.jit(lambda A, x: A.mv(x)), jax.jit(lambda A, y: A.T.mv(y))
        parts["forward"], image = measure(lambda: jax.block_until_ready(forward(A, volume)), ROUNDS)
        parts["adjoint"], _ = measure(lambda: jax.block_until_ready(adjoint(A, image)), ROUNDS)
        light = np.maximum(np.kron(np.asarray(image), np.ones((model.binning, model.binning))), 0)
        light = np.pad(light, [(0, pixels - n) for n in light.shape]) * (2000 / light.max())
        if not (file := folder / "image.npy").exists():
            np.save(file, np.random.default_rng(0).poisson(light).astype(np.float32))
        return parts
    image = np.load(folder / "image.npy")
    invert = Reconstructor(scope, grid, BY_NAME[name](20), progress=Progress())
    seconds, volume = measure(lambda: invert(image, Progress()), 1)
    np.save(folder / "volume.npy", volume)
    return {name: seconds | {"memory_mib": status_mib("VmHWM")}}


def in_checkout(checkout: Path, name: str, folder: Path, pixels: int) -> dict[str, Any]:
    """`work` with the package of a checkout, in a process of its own."""
    # By its path, as the other checkout may lack this file.
    code = "import runpy, sys; runpy.run_path(sys.argv[1], run_name='worker')"
    command = [sys.executable, "-c", code, __file__, name, str(folder), str(pixels)]
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    done = subprocess.run(command, cwd=checkout, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def run(checkouts: dict[str, Path], names: list[str], pixels: int, progress: Progress) -> list[dict[str, Any]]:
    """A row for each part of the model and each method: its name, what each checkout measured, and the difference."""
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for name in progress.track(["model", *names], "Timing"):
            found, volumes = {}, []
            for label, checkout in checkouts.items():
                found[label] = in_checkout(checkout, name, folder, pixels)
                volumes += [np.load(folder / "volume.npy")] if name in METHODS else []
            parts = next(iter(found.values()))
            rows += [{"name": part} | {label: each[part] for label, each in found.items()} for part in parts]
            if len(volumes) == 2:
                rows[-1]["difference"] = float(np.linalg.norm(volumes[1] - volumes[0]) / np.linalg.norm(volumes[0]))
    return rows


def cells(row: dict[str, Any], labels: list[str]) -> list[str]:
    """A line of the table."""
    number = lambda value, digits=2: "" if value is None else f"{value:.{digits}f}"
    each = [row[label] for label in labels]
    found = [row["name"]] + [number(one["first_s"]) for one in each]
    for key in ("clock_s", "processor_s"):
        values = [one.get(key) for one in each]
        found += [number(value) for value in values]
        if len(labels) == 2:
            found.append(number(None if None in values else values[0] / values[1]))
    return [*found, *(number(one.get("memory_mib"), 0) for one in each), number(row.get("difference"), 4)]


def report(before: Path | None, methods: str, pixels: int, progress: Progress) -> Report:
    names = methods.split(",")
    if unknown := [name for name in names if name not in (*METHODS, OTHERS)]:
        raise InputError(f"--methods must be of {', '.join((*METHODS, OTHERS))}, got {', '.join(unknown)}.")
    checkouts = ({"before": before.resolve()} if before else {}) | {"now": HERE}
    rows, labels = run(checkouts, names, pixels, progress), list(checkouts)
    ratio = ["ratio"] if before else []
    timed = [[*(f"{what}, s: {label}" for label in labels), *ratio] for what in ("later calls", "processors")]
    columns = ["", *(f"first call, s: {label}" for label in labels), *timed[0], *timed[1]]
    columns += [*(f"MiB: {label}" for label in labels), "difference"]
    lines = [cells(row, labels) for row in rows]
    files = {"inversion_speed.json": rows, "inversion_speed.md": markdown_table(columns, lines)}
    return Report(files, [table(columns, lines)])


if __name__ == "worker":
    print(json.dumps(work(sys.argv[2], Path(sys.argv[3]), int(sys.argv[4]))))
if __name__ == "__main__":
    main(
        report,
        {
            "--before": {"type": Path, "metavar": "CHECKOUT"},
            "--methods": {"default": ",".join(METHODS)},
            "--pixels": {"type": int, "default": 5120},
        },
    )
