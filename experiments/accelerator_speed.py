"""Time back-projection, its adjoint and their gradients on a GPU or TPU, beside kernels written by hand in CUDA.

The problems are those of `backprojection_speed.py`, in float32. On NVIDIA GPUs with CuPy two kernels written by hand
(`cuda_kernels.py`) compute the same sums; results are compared before all are timed in interleaved rounds. "Of many" is
the time of a call where ten are started one after the other, so that the host prepares the next while the device
computes. "From the host" includes the transfer of a camera's uint16 image to the device.

    python -m experiments.accelerator_speed [--out DIR]

Writes `accelerator_speed.json` and `accelerator_speed.md`; a minute or two on an H200. `inversion_speed.py` times the
iterative methods there.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.backprojection_speed import CONTESTANTS, FULL, Inputs, Job, check, inputs
from experiments.common import Report, main, table
from experiments.cuda_kernels import cuda_kernels
from experiments.kernels import count_pairs, plain
from gs_jax import backproject
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.apps.method_benchmark import timed
from gs_jax.base.progress import Progress

OURS = tuple(name for name in CONTESTANTS if name.startswith("gs_jax"))
FROM_HOST = "gs_jax, uint16 image from the host"
# Each with the one of ours that computes the same.
BY_HAND = {"CUDA by hand": "gs_jax", "CUDA by hand, adjoint": "gs_jax, adjoint"}
ROUNDS, MANY = 9, 10


class Contestant(NamedTuple):
    """A call that starts the work, seconds to compile it, and MiB beside its arguments and results."""

    call: Callable[[], Any]
    compile_s: float = 0.0
    memory_mib: float = 0.0


def contestants(s: Inputs) -> dict[str, Contestant]:
    found = {name: _ours(name, s) for name in OURS}
    counts = (np.asarray(s.image) * 65535).astype(np.uint16)
    found[FROM_HOST] = Contestant(lambda: backproject(jax.device_put(counts), s.imager, s.grid))
    if by_hand := cuda_kernels(plain(s.imager, s.grid), np.asarray(s.image), np.asarray(s.volume)):
        found |= {name: Contestant(call) for name, call in zip(BY_HAND, by_hand, strict=True)}
    return found


def _ours(name: str, s: Inputs) -> Contestant:
    arguments = jax.device_put(CONTESTANTS[name].arguments(s))
    seconds, compiled = timed(lambda: jax.jit(CONTESTANTS[name].function).lower(*arguments).compile())
    return Contestant(lambda: compiled(*arguments), seconds, compiled.memory_analysis().temp_size_in_bytes / 2**20)


def race(job: Job, rounds: int = ROUNDS) -> dict[str, Any]:
    """Median seconds of a call alone and of a call of many, by contestant."""
    s, times = inputs(job), {}
    all_of_them = contestants(s)
    compared = [name for name in (*BY_HAND.values(), *BY_HAND) if name in all_of_them]
    compare(s, {name: as_numpy(all_of_them[name].call()) for name in compared})
    for _ in range(rounds):
        for name, one in all_of_them.items():
            alone, _ = timed(lambda one=one: jax.block_until_ready(one.call()))
            many, _ = timed(lambda one=one: jax.block_until_ready([one.call() for _ in range(MANY)]))
            times.setdefault(name, []).append((alone, many / MANY))
    measured = {}
    for name, each in times.items():
        alone, many = np.median(each, axis=0).tolist()
        one = all_of_them[name]
        measured[name] = {"alone_s": alone, "many_s": many, "compile_s": one.compile_s, "memory_mib": one.memory_mib}
    pairs = count_pairs(plain(s.imager, s.grid), s.imager.sensor.shape)
    return {"job": str(job), "pairs": pairs, "contestants": measured}


def compare(s: Inputs, results: dict[str, np.ndarray]) -> None:
    """Check that the kernels compute the same sums, and that the adjoint is the adjoint."""
    check(s, results)
    for theirs, ours in BY_HAND.items():
        if theirs in results:
            error = np.abs(results[ours] - results[theirs]).max() / results[ours].max()
            # Their coordinates are float32, some 1e-3 of a pixel, and the image is random.
            assert error < 5e-3, f"{theirs} differs from gs_jax by {error:.1e} of the maximum"


def as_numpy(array: Any) -> np.ndarray:
    """An array of JAX or CuPy in NumPy; CuPy does not convert by itself."""
    return array.get() if hasattr(array, "get") else np.asarray(array)


def rows_of(result: dict[str, Any]) -> list[list[str]]:
    each = result["contestants"]
    return [
        [
            name,
            f"{1e3 * one['alone_s']:.2f}",
            f"{1e3 * one['many_s']:.2f}",
            f"{one['many_s'] / each['gs_jax']['many_s']:.2f}",
            f"{result['pairs'] / one['many_s']:.2e}",
            f"{one['compile_s']:.1f}" if one["compile_s"] else "",
            f"{one['memory_mib']:.0f}" if one["compile_s"] else "",
        ]
        for name, one in each.items()
    ]


COLUMNS = ("", "alone, ms", "of many, ms", "relative", "pairs / s", "compile, s", "memory, MiB")


def report(progress: Progress) -> Report:
    results = [race(job) for job in progress.track(FULL, "Problems")]
    device = jax.devices()[0].device_kind
    parts = [
        f"**{r['job']}: {r['pairs'] / 1e6:.0f} million pairs**\n\n{markdown_table(COLUMNS, rows_of(r))}"
        for r in results
    ]
    text = f"# Back-projection on {device}\n\n" + "\n\n".join(parts) + "\n"
    shown = [table(COLUMNS, rows_of(r), r["job"]) for r in results]
    return Report({"accelerator_speed.json": {"device": device, "jobs": results}, "accelerator_speed.md": text}, shown)


if __name__ == "__main__":
    main(report)
