"""The calls that `inversion_speed` times, by the package and the scenes of any checkout: imports are few, therefore."""

import json
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np

import gs_jax as gs
from experiments.fig9_benchmark import SCENES, STEPS, Scene
from gs_jax.base.machine import status_mib
from gs_jax.reconstruction.inverse_problem import prepare_model
from gs_jax.reconstruction.pipeline import METHODS, voxel_grid


def calls_of(name: str, scene: Scene) -> dict[str, Callable[[], Any]]:
    """The calls of a name of `inversion_speed`: of a model its tables, the image of the truth, and the adjoint."""
    quiet, (image, imager, grid, truth, _) = gs.Progress(), scene
    if name == "others":
        fine, slices = voxel_grid(imager, np.asarray(grid.depths).tolist()), np.ones((5, 512, 512), np.float32)
        return {
            "find_points": lambda: gs.find_points(image, imager, fine),
            "simulate": lambda: np.asarray(gs.simulate(truth, imager, grid)),
            "suppress": lambda: gs.suppress(slices),
        }
    if name in METHODS:
        invert = gs.Reconstructor(imager, grid, METHODS[name](STEPS), progress=quiet)
        return {name: lambda: invert(image, quiet)}

    @cache
    def operator() -> gs.ImagingOperator:
        model = prepare_model(imager, grid, name, quiet)
        return gs.ImagingOperator(model.imager, grid, model.optics)

    forward, adjoint = jax.jit(lambda A, x: A.mv(x)), jax.jit(lambda A, y: A.T.mv(y))
    ones = lambda A: np.ones(A.out_structure().shape, np.float32)
    return {
        f"{name} model: tables": operator,
        f"{name} model": lambda: jax.block_until_ready(forward(operator(), truth)),
        f"{name} model, adjoint": lambda: jax.block_until_ready(adjoint(operator(), ones(operator()))),
    }


def measure(name: str, call: Callable[[], Any], scene: Scene) -> dict[str, float]:
    """Seconds of a call, and memory and quality of a method's."""
    before = time.perf_counter(), time.process_time()
    result = call()
    row = {"clock_s": time.perf_counter() - before[0], "processor_s": time.process_time() - before[1]}
    if name not in METHODS:
        return row
    stats = jax.devices()[0].memory_stats() or {}
    mib = stats["peak_bytes_in_use"] / 2**20 if stats else status_mib("VmHWM")
    gain = gs.quality(result, scene.truth).psnr_db - gs.quality(0 * result, scene.truth).psnr_db
    return row | {"memory_mib": mib, "db": gain}


def launches(call: Callable[[], Any], device: str = "/device:", line: str = "Stream") -> int:
    """Kernels and copies that an accelerator ran in a call, by JAX's profiler."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            call()
        (file,) = Path(folder).rglob("*.xplane.pb")
        planes = jax.profiler.ProfileData.from_file(str(file)).planes
        lines = [one for plane in planes if plane.name.startswith(device) for one in plane.lines]
        return sum(len(list(one.events)) for one in lines if one.name.startswith(line))


def serve(name: str, data: str) -> None:
    """Answer each line of the standard input by what `measure` returns for each call, and its launches."""
    answers, counts = sys.stdout, {}
    with redirect_stdout(sys.stderr):
        of_data = "points" if name == "others" else "letters"
        scene = SCENES[of_data if data else "letters of other lenses"](Path(data))
        calls = calls_of(name, scene)
        for _ in sys.stdin:
            rows = {key: measure(name, call, scene) for key, call in calls.items()}
            if jax.default_backend() != "cpu":
                counts = counts or {key: {"launches": launches(call)} for key, call in calls.items()}
            print(json.dumps({key: row | counts.get(key, {}) for key, row in rows.items()}), file=answers, flush=True)


if __name__ == "__main__":
    serve(*sys.argv[1:])
