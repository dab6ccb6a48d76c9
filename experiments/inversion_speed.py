"""Time and memory of the forward models, the iterative methods at their defaults, and three other functions.

The scene has bars of three widths and points at nine depths, and its capture 5120 x 5120 pixels, rendered by the full
model. Each line runs in a process of its own; the first call is timed apart, as it compiles.

    python -m experiments.inversion_speed [--methods list-rl,richardson-lucy] [--pixels 5120] [--out DIR]

Writes `inversion_speed.json` and `inversion_speed.md`; about four minutes on two cores.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

import gs_jax as gs
from experiments.backprojection_speed import in_new_process
from experiments.common import Report, main, names_of, tables_report
from gs_jax.base.machine import status_mib
from gs_jax.reconstruction.inverse_problem import prepare_model
from gs_jax.reconstruction.pipeline import METHODS, PIXELS_PER_VOXEL, voxel_grid

DEPTHS = np.linspace(18.0, 22.0, 9).tolist()
MODELS = ("near", "full")
# `find_points`, `simulate`, and the network that suppresses haze.
OTHERS = "others"
NAMES = (*MODELS, "list-rl", "richardson-lucy", "unrolled", "fista", "admm", OTHERS)
# Later calls of the models; a method takes long, and gets one.
ROUNDS = 3
COLUMNS = {
    "first_s": ("first call, s", ".1f"),
    "clock_s": ("later calls, s", ".2f"),
    "processor_s": ("processors, s", ".2f"),
    "memory_mib": ("MiB", ".0f"),
}


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


def imager_of(pixels: int) -> gs.Imager:
    """The built-in microscope with so many pixels in each direction."""
    scope = gs.geomscope().imager()
    return eqx.tree_at(lambda i: i.sensor, scope, gs.Sensor((pixels, pixels), scope.sensor.pixel_pitch))


def of_model(name: str, capture: Path, pixels: int) -> dict[str, Any]:
    """Time a forward model and its adjoint; the full model renders the capture."""
    scope = imager_of(pixels)
    grid = voxel_grid(scope, DEPTHS, None, pixels=PIXELS_PER_VOXEL)
    began = time.perf_counter()
    model = prepare_model(scope, grid, name, gs.Progress())
    results: dict[str, Any] = {f"{name} model: tables": {"first_s": time.perf_counter() - began}}
    A, volume = gs.ImagingOperator(model.imager, grid, model.optics), scene(grid.volume_shape)
    forward, adjoint = jax.jit(lambda A, x: A.mv(x)), jax.jit(lambda A, y: A.T.mv(y))
    results[f"{name} model"], image = measure(lambda: jax.block_until_ready(forward(A, volume)), ROUNDS)
    results[f"{name} model, adjoint"], _ = measure(lambda: jax.block_until_ready(adjoint(A, image)), ROUNDS)
    if name == "full":
        light = np.maximum(np.kron(np.asarray(image), np.ones((model.binning, model.binning))), 0)
        light = np.pad(light, [(0, pixels - n) for n in light.shape]) * (2000 / light.max())
        np.save(capture, np.random.default_rng(0).poisson(light).astype(np.float32))
    return results


def of_method(name: str, capture: Path, pixels: int) -> dict[str, Any]:
    """Time a method on the capture."""
    scope, image = imager_of(pixels), np.load(capture)
    grid = voxel_grid(scope, DEPTHS, None, pixels=PIXELS_PER_VOXEL)
    invert = gs.Reconstructor(scope, grid, METHODS[name](20), progress=gs.Progress())
    seconds, _ = measure(lambda: invert(image, gs.Progress()), 1)
    return {name: seconds | {"memory_mib": status_mib("VmHWM")}}


def of_others(name: str, capture: Path, pixels: int) -> dict[str, Any]:
    """Time finding 100 points, imaging three planes, and five slices of the network."""
    scope, rng = imager_of(pixels), np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-8, 8, (100, 2)), rng.uniform(18, 22, 100), np.ones(100)])
    image = np.asarray(gs.simulate(points, scope))
    counts = rng.poisson(image * (2000 / image.max())).astype(np.float32)
    fine, three = voxel_grid(scope, DEPTHS), voxel_grid(scope, [18.0, 20.0, 22.0], pixels=PIXELS_PER_VOXEL)
    planes = np.zeros(three.volume_shape, np.float32)
    planes[:, 100:200, 100:120] = 1
    slices = rng.random((5, 512, 512)).astype(np.float32)
    calls = {
        "find_points": lambda: gs.find_points(counts, scope, fine),
        "simulate": lambda: np.asarray(gs.simulate(planes, scope, three)),
        "suppress": lambda: gs.suppress(slices),
    }
    return {name: measure(call, ROUNDS)[0] for name, call in calls.items()}


def run(names: list[str], pixels: int, progress: gs.Progress) -> dict[str, dict[str, float]]:
    """Seconds and memory by what is timed."""
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        # Methods need the full model's capture.
        for name in progress.track(sorted({"full", *names}, key=NAMES.index), "Timing"):
            work = of_model if name in MODELS else of_others if name == OTHERS else of_method
            results |= in_new_process(work, name, Path(folder) / "image.npy", pixels)
    return results


def report(methods: list[str], pixels: int, progress: gs.Progress) -> Report:
    results = run(methods, pixels, progress)
    cell = lambda row, key: format(row[key], COLUMNS[key][1]) if key in row else ""
    rows = [[name, *(cell(row, key) for key in COLUMNS)] for name, row in results.items()]
    columns = ("", *(title for title, _ in COLUMNS.values()))
    return tables_report("inversion_speed", results, (columns, rows))


if __name__ == "__main__":
    methods = {"type": names_of(NAMES), "default": NAMES}
    main(report, {"--methods": methods, "--pixels": {"type": int, "default": 5120}})
