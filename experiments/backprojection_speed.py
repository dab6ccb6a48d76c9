"""Time back-projection, its adjoint and gradients against hand-written kernels at full scale, and growth with size.

The paper takes 18 s for an image of 5120^2 pixels, 13 depths of 555^2 voxels and 213 lenses (MATLAB, nearest pixel,
8 threads). On a processor `gs_jax` runs the same problem against the paper's loop and per-lens patches in parallel
numba, which compute the same sum (bilinear, float32) on all cores. On a GPU or TPU it runs by kernels of Warp, where
that is installed, against XLA's forms: "of many" is the time of a call where ten are started one after the other, and
"from the host" includes the transfer of a camera's uint16 image. Results are compared before they are timed in
interleaved rounds.

    python -m experiments.backprojection_speed [--out DIR]

Writes `speed.json`, `speed.md` and, on a processor, `speed.png`; about six minutes on two cores, two on an H200.
"""

import os
import re
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import nullcontext
from functools import cache, partial
from multiprocessing import get_context
from typing import Any, NamedTuple
from unittest.mock import patch

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import SingleDeviceSharding
from matplotlib.figure import Figure

from experiments.common import Report, main, table
from experiments.kernels import count_pairs, lens_patches, paper_loop, plain
from gs_jax import Grid, Imager, MicrolensArray, Progress, Sensor, backproject, backproject_adjoint, random_layout
from gs_jax.apps.benchmark import markdown_table, peak_mib, timed
from gs_jax.base.arrays import to_float32
from gs_jax.base.machine import copy_to, describe, status_mib
from gs_jax.projection import cuda

FIELD_MM = 5120 * 0.0045


class Job(NamedTuple):
    """Problem size; the sensor and the grid cover the same 23 mm for any number of pixels and voxels."""

    voxels: int = 555  # along a side
    pixels: int = 5120  # along a side
    lenses: int = 213
    depths: int = 13
    sensor_distance_mm: float = 4.0

    def __str__(self):
        return (
            f"{self.depths} x {self.voxels}^2 voxels, {self.pixels}^2 pixels, {self.lenses} lenses, "
            f"v = {self.sensor_distance_mm} mm"
        )


FULL = (Job(), Job(voxels=1024), Job(sensor_distance_mm=5.8))
STUDY = {
    "voxels": [Job(voxels=n) for n in (64, 128, 256, 555, 1024)],
    "pixels": [Job(pixels=n) for n in (640, 1280, 2560, 5120)],
    "lenses": [Job(lenses=n) for n in (13, 53, 213, 850)],
    "depths": [Job(depths=n) for n in (1, 4, 13, 40)],
}


class Inputs(NamedTuple):
    image: jax.Array
    volume: jax.Array
    imager: Imager
    grid: Grid


def inputs(job: Job) -> Inputs:
    """Return a random image and volume, and the paper's microscope with a random layout."""
    rng = np.random.default_rng(0)
    plate = (20.0, 20.0)
    paper = dict(pitch=1.23, pitch_sd=0.09) if job.lenses == 213 else dict(diameter=None)
    centers = random_layout(job.lenses, plate, seed=0, **paper)
    sensor = Sensor((job.pixels, job.pixels), FIELD_MM / job.pixels)
    imager = Imager(MicrolensArray(centers), sensor, job.sensor_distance_mm, field_radius=3.0)
    grid = Grid(np.linspace(18, 24, job.depths), (job.voxels, job.voxels), FIELD_MM / job.voxels)
    random = lambda *shape: jax.device_put(rng.random(shape, dtype=np.float32))
    return Inputs(random(*sensor.shape), random(job.depths, *grid.shape), to_float32(imager), to_float32(grid))


def bilinear_form(centers, sensor_distance, s: Inputs, power: int = 1):
    """Scalar function of the geometry, whose gradient costs about as much as that of a design objective."""
    moved = eqx.tree_at(lambda i: (i.array.centers, i.sensor_distance), s.imager, (centers, sensor_distance))
    return jnp.vdot(backproject(s.image, moved, s.grid) ** power, s.volume)


def hessian_vector_product(centers, sensor_distance, s: Inputs):
    """Hessian-vector product of the sum of a volume's squares, by centres and sensor distance."""
    here, along = (centers, sensor_distance), (jnp.ones_like(centers), jnp.ones_like(sensor_distance))

    def squares(centers, sensor_distance):
        return bilinear_form(centers, sensor_distance, s, power=2)

    return jax.jvp(jax.grad(squares, (0, 1)), here, along)[1]


class Contestant(NamedTuple):
    function: Callable
    arguments: Callable[[Inputs], tuple]


def _ours(s: Inputs) -> tuple:
    return s.image, s.imager, s.grid


def _whole(s: Inputs) -> tuple:
    return s.imager.array.centers, s.imager.sensor_distance, s


def _by_hand(s: Inputs) -> tuple:
    return np.asarray(s.image), plain(s.imager, s.grid)


def _as_uint16(image):
    return (image * 65535).astype(jnp.uint16)


CONTESTANTS = {
    "gs_jax": Contestant(backproject, _ours),
    "numba, the paper's loop": Contestant(paper_loop, _by_hand),
    "numba, lens patches": Contestant(lens_patches, _by_hand),
    "gs_jax, nearest pixel": Contestant(jax.jit(partial(backproject, method="nearest")), _ours),
    "gs_jax, normalize": Contestant(jax.jit(partial(backproject, normalize=True)), _ours),
    "gs_jax, uint16 image": Contestant(backproject, lambda s: (_as_uint16(s.image), s.imager, s.grid)),
    "gs_jax, adjoint": Contestant(backproject_adjoint, lambda s: (s.volume, s.imager, s.grid)),
    "gs_jax, gradient": Contestant(jax.jit(jax.grad(bilinear_form, argnums=(0, 1))), _whole),
    "gs_jax, value and gradient": Contestant(jax.jit(jax.value_and_grad(bilinear_form, argnums=(0, 1))), _whole),
    "gs_jax, Hessian-vector product": Contestant(jax.jit(hessian_vector_product), _whole),
}
OURS = tuple(name for name in CONTESTANTS if name.startswith("gs_jax"))
FROM_HOST = ("gs_jax, uint16 image from the host", "the same, copied ahead", "the same, from page-locked memory")
# What `gs_jax.projection.cuda` may run without Warp: back-projection and its adjoint by XLA.
FORMS = {
    "gs_jax, XLA": ("gs_jax", {"_load": lambda: None}),
    "gs_jax, adjoint, XLA's scatter-add": ("gs_jax, adjoint", {"_load": lambda: None, "SCATTERS": True}),
    "gs_jax, adjoint, XLA's gathers": ("gs_jax, adjoint", {"_load": lambda: None, "SCATTERS": False}),
}
SAME_RESULT = ("gs_jax", "numba, the paper's loop", "numba, lens patches")
IN_STUDY = ("gs_jax", "gs_jax, adjoint", "numba, lens patches")


def prepared(name: str, arguments: tuple) -> tuple[Callable[[], Any], float]:
    """Compile a contestant; return a function that runs it, and the compilation time in seconds."""
    function = CONTESTANTS[name].function
    if lower := getattr(function, "lower", None):
        seconds, compiled = timed(lambda: lower(*arguments).compile())
        return lambda: jax.block_until_ready(compiled(*arguments)), seconds
    call = lambda: function(*arguments)
    return call, max(0.0, timed(call)[0] - timed(call)[0])  # numba compiles once for all sizes, in the first call


def race(job: Job, names: Iterable[str], rounds: int, compile_s: dict) -> dict:
    """Time the contestants in interleaved rounds, so that other load on the machine affects all equally."""
    s = inputs(job)
    calls, results, compiled_s = {}, {}, {}
    for name in names:
        calls[name], seconds = prepared(name, CONTESTANTS[name].arguments(s))
        once_for = name if name.startswith("numba") else (name, *job[:-1])  # JAX compiles for each size
        compiled_s[name] = compile_s.setdefault(once_for, seconds)
        results[name] = calls[name]()  # warm-up
    check(s, results)
    results.clear()
    times, processor = {name: [] for name in calls}, {name: [] for name in calls}
    for number in range(rounds):
        for name, call in calls.items():
            if number < 3 or np.median(times[name]) < 1:  # three rounds are enough for slow contestants
                call()  # warm caches and mapped pages again after the previous contestant
                before = time.process_time()
                times[name].append(timed(call)[0])
                processor[name].append(time.process_time() - before)
                time.sleep(0.02)  # lets idle worker threads of the previous contestant go to sleep
    pairs = count_pairs(plain(s.imager, s.grid), s.imager.sensor.shape)
    measured = {
        name: {
            "median_s": float(np.median(t)),
            "min_s": min(t),
            # Least processor time of all cores together, which varies least on a loaded machine.
            "processor_s": min(processor[name]),
            "rounds": len(t),
            "compile_s": compiled_s[name],
            "pairs_per_s": pairs / float(np.median(t)),
            # Ratios are taken within a round, which reduces the effect of other load.
            "ratio": float(np.median([a / b for a, b in zip(t, times["gs_jax"], strict=False)])),
        }
        for name, t in times.items()
    }
    return {"job": str(job), **job._asdict(), "pairs": pairs, "contestants": measured}


def check(s: Inputs, results: Mapping[str, Any]) -> None:
    """Check that all implementations compute the same sum, and that the adjoint is the adjoint of it."""
    results = {name: np.asarray(result) for name, result in results.items()}
    pairs = [(name, "gs_jax") for name in SAME_RESULT] + [(name, ours) for name, (ours, _) in FORMS.items()]
    for theirs, ours in pairs:
        if theirs in results:
            error = np.abs(results[theirs] - results[ours]).max() / results[ours].max()
            assert error < 1e-5, f"{theirs} differs from gs_jax by {error:.1e} of the maximum"
    if "gs_jax, adjoint" in results:
        back = np.vdot(results["gs_jax"].astype(float), np.asarray(s.volume, float))
        forth = np.vdot(np.asarray(s.image, float), results["gs_jax, adjoint"].astype(float))
        assert abs(back - forth) < 1e-5 * abs(back), f"not adjoint: {back} and {forth}"


def on_accelerator(job: Job, rounds: int = 9, many: int = 10) -> dict:
    """Median seconds of a call alone and of a call of many, by contestant, and memory beside arguments and results."""
    s, calls, compiled = inputs(job), {}, {}
    for name, (of, form) in ({name: (name, {}) for name in OURS} | FORMS).items():
        arguments, function = jax.device_put(CONTESTANTS[of].arguments(s)), CONTESTANTS[of].function
        with patch.multiple(cuda, **form) if form else nullcontext():
            # A new function, which is lowered anew.
            lowered = jax.jit(lambda *arguments, function=function: function(*arguments)).lower(*arguments)
        seconds, program = timed(lowered.compile)
        calls[name] = partial(program, *arguments)
        memory = program.memory_analysis().temp_size_in_bytes / 2**20
        # Fusions and calls of libraries, those of a loop once.
        kernels = len(re.findall(r" (?:fusion|custom-call|fft|sort)\(", program.as_text()))
        compiled[name] = {"compile_s": seconds, "memory_mib": memory, "kernels": kernels}
    counts, device, reader = np.asarray(_as_uint16(s.image)), jax.devices()[0], ThreadPoolExecutor(1)
    ahead = deque(reader.submit(copy_to, device, counts) for _ in range(2))
    there, lock = (SingleDeviceSharding(device, memory_kind=kind) for kind in (None, "pinned_host"))
    locked = jax.device_put(counts, lock)

    def copied_ahead():
        ahead.append(reader.submit(copy_to, device, counts))
        return ahead.popleft().result()

    sources = (lambda: jax.device_put(counts)), copied_ahead, (lambda: jax.device_put(locked, there))
    for name, source in zip(FROM_HOST, sources, strict=True):
        calls[name] = lambda source=source: backproject(source(), s.imager, s.grid)
    check(s, {name: calls[name]() for name in ("gs_jax", "gs_jax, adjoint", *FORMS)})
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            alone, _ = timed(lambda call=call: jax.block_until_ready(call()))
            all_of_them, _ = timed(lambda call=call: jax.block_until_ready([call() for _ in range(many)]))
            times[name].append((alone, all_of_them / many))
    pairs, medians = count_pairs(plain(s.imager, s.grid), s.imager.sensor.shape), {}
    for name, seconds in times.items():
        alone, of_many = np.median(seconds, axis=0).tolist()
        medians[name] = {"alone_s": alone, "many_s": of_many, "pairs_per_s": pairs / of_many}
        medians[name] |= compiled.get(name, {})
    for row in medians.values():
        row["ratio"] = row["many_s"] / medians["gs_jax"]["many_s"]
    return {"job": str(job), "pairs": pairs, "contestants": medians}


def memory(name: str, job: Job) -> dict[str, float]:
    """Memory that a contestant adds to a new process that has imported everything and made the inputs.

    Peak resident set while it compiles and runs twice, minus the resident set before: output, temporaries, code
    and compiler; and the peak of the whole process. Linux only; `ru_maxrss` does not work, because a child process
    inherits its parent's value.
    """
    s = inputs(job)
    arguments = jax.block_until_ready(CONTESTANTS[name].arguments(s))

    def work():
        call, _ = prepared(name, arguments)
        result = call()
        del result
        call()

    extra, _ = peak_mib(work)
    return {"extra_mib": extra, "process_mib": status_mib("VmHWM")}


def in_new_process(function: Callable, *arguments):
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def run(
    jobs: Sequence[Job] = FULL,
    study: Mapping[str, Sequence[Job]] = STUDY,
    *,
    names: Sequence[str] = tuple(CONTESTANTS),
    rounds: int = 9,
    memory_of: Sequence[str] = tuple(CONTESTANTS) if sys.platform == "linux" else (),
    progress: Progress,
) -> dict:
    """Return the content of `speed.json`; units are in the keys."""
    if (device := jax.devices()[0]).platform != "cpu":
        tracked = progress.track(jobs, device.device_kind)
        return {"machine": {"device": device.device_kind}, "jobs": [on_accelerator(job, rounds) for job in tracked]}
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    outcome: dict[str, Any] = {"machine": describe() | {"load average before": f"{load:.1f}"}}
    compile_s = {}
    once = cache(lambda job: race(job, IN_STUDY, max(3, rounds - 2), compile_s))
    outcome["jobs"] = [race(job, names, rounds, compile_s) for job in progress.track(jobs, "Full scale")]
    for name in progress.track(memory_of, "Memory"):
        outcome["jobs"][0]["contestants"][name] |= in_new_process(memory, name, jobs[0])
    outcome["study"] = {axis: [once(job) for job in progress.track(study[axis], f"More {axis}")] for axis in study}
    outcome["slopes"] = {
        axis: {name: slope(axis, results, name) for name in IN_STUDY} for axis, results in outcome["study"].items()
    }
    return outcome


def amount(axis: str, result: dict) -> int:
    """Total number of voxels or pixels, not along a side."""
    n = result[axis]
    return {"voxels": n * n * result["depths"], "pixels": n * n}.get(axis, n)


def slope(axis: str, results: Sequence[dict], name: str) -> float:
    """Exponent of the cost between the two largest sizes."""
    (x0, t0), (x1, t1) = ((amount(axis, r), r["contestants"][name]["median_s"]) for r in results[-2:])
    return float(np.log(t1 / t0) / np.log(x1 / x0))


# Heading, factor and format of each measured value.
COLUMNS = {
    "median_s": ("median, ms", 1e3, ".1f"),
    "min_s": ("fastest, ms", 1e3, ".1f"),
    "processor_s": ("processor, ms", 1e3, ".1f"),
    "alone_s": ("alone, ms", 1e3, ".2f"),
    "many_s": ("of many, ms", 1e3, ".2f"),
    "ratio": ("relative", 1, ".2f"),
    "compile_s": ("compile, s", 1, ".1f"),
    "pairs_per_s": ("pairs / s", 1, ".2e"),
    "extra_mib": ("memory, MiB", 1, ".0f"),
    "memory_mib": ("memory, MiB", 1, ".0f"),
    "kernels": ("kernels", 1, ".0f"),
}


def tables(outcome: dict) -> list[tuple[str, Sequence[str], list[list[str]]]]:
    """Title, columns and rows of every table."""
    made = []
    for job in outcome["jobs"]:
        results = job["contestants"]
        keys = [key for key in COLUMNS if key in results["gs_jax"]]
        cell = lambda value, key: "" if value is None else format(COLUMNS[key][1] * value, COLUMNS[key][2])
        rows = [[name, *(cell(row.get(key), key) for key in keys)] for name, row in results.items()]
        made.append((f"{job['job']}: {job['pairs']:.3g} pairs", ("", *(COLUMNS[key][0] for key in keys)), rows))
    if "slopes" in outcome:
        slopes = [[axis, *(f"{s[name]:.2f}" for name in IN_STUDY)] for axis, s in outcome["slopes"].items()]
        made.append(("Exponent of the cost between the two largest sizes", ("in", *IN_STUDY), slopes))
    return made


def markdown(outcome: dict) -> str:
    machine = ", ".join(f"{key} {value}" for key, value in outcome["machine"].items())
    parts = [f"# Speed of back-projection\n\n{machine}."]
    parts += [f"## {title}\n\n{markdown_table(columns, rows)}" for title, columns, rows in tables(outcome)]
    return "\n\n".join(parts) + "\n"


def picture(study: Mapping[str, Sequence[dict]]) -> Figure:
    """Plot the cost against each size, with the other sizes at full scale."""
    figure = Figure(figsize=(8, 6.4), dpi=110, layout="constrained")
    for axes, (axis, results) in zip(figure.subplots(2, 2, sharey=True).flat, study.items(), strict=False):
        x = [amount(axis, result) for result in results]
        for name, style in zip(IN_STUDY, ("o-", "s--", "^:"), strict=True):
            axes.loglog(x, [1e3 * r["contestants"][name]["median_s"] for r in results], style, label=name)
        axes.set_xlabel({"voxels": "voxels, all depths", "pixels": "pixels of the image"}.get(axis, axis))
        axes.grid(which="both", alpha=0.25)
    figure.axes[0].legend()
    for axes in figure.axes[::2]:
        axes.set_ylabel("time, ms")
    return figure


def report(progress: Progress, **sizes: Any) -> Report:
    outcome = run(progress=progress, **sizes)
    files = {"speed.json": outcome, "speed.md": markdown(outcome)}
    if "study" in outcome:
        files["speed.png"] = picture(outcome["study"])
    return Report(files, [table(columns, rows, title) for title, columns, rows in tables(outcome)])


if __name__ == "__main__":
    main(report)
