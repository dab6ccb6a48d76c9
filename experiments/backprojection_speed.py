"""Time back-projection against hand-written kernels at full scale, and its growth with problem size.

The paper takes 18 s for an image of 5120^2 pixels, 13 depths of 555^2 voxels and 213 lenses (MATLAB, nearest pixel,
8 threads). Here `gs_jax` runs the same problem against the paper's loop and per-lens patches in parallel numba, and a
NumPy port. All compute the same sum (bilinear, float32) on all cores; results are compared before they are timed in
interleaved rounds. Compilation is timed separately.

    python experiments/backprojection_speed.py [--out DIR]

writes `speed.json`, `speed.md` and `speed.png`; about six minutes on two cores.
"""

import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments.common import Report, main, table
from experiments.kernels import count_pairs, lens_patches, numpy_patches, paper_loop, plain
from gs_jax import Grid, Imager, MicrolensArray, Sensor, backproject, backproject_adjoint
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.apps.method_benchmark import peak_mib, timed
from gs_jax.base.arrays import to_float32
from gs_jax.base.machine import describe, status_mib
from gs_jax.base.progress import Progress
from gs_jax.layouts import random_layout

PAPER_S = 18.0
FIELD_MM = 5120 * 0.0045


class Job(NamedTuple):
    """Problem size; the sensor and the grid cover the same 23 mm for any number of pixels and voxels."""

    voxels: int = 555  # along a side
    pixels: int = 5120  # along a side
    lenses: int = 213
    depths: int = 13
    sensor_distance_mm: float = 4.0

    def shapes(self):
        return self[:-1]

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
    centers = (
        random_layout(213, plate, pitch=1.23, pitch_sd=0.09, seed=0)
        if job.lenses == 213
        else random_layout(job.lenses, plate, diameter=None, seed=0)
    )
    sensor = Sensor((job.pixels, job.pixels), FIELD_MM / job.pixels)
    imager = Imager(MicrolensArray(centers), sensor, job.sensor_distance_mm, field_radius=3.0)
    grid = Grid(np.linspace(18, 24, job.depths), (job.voxels, job.voxels), FIELD_MM / job.voxels)
    random = lambda *shape: jnp.asarray(rng.random(shape, dtype=np.float32))
    return Inputs(random(*sensor.shape), random(job.depths, *grid.shape), to_float32(imager), to_float32(grid))


def bilinear_form(centers, sensor_distance, s: Inputs):
    """Scalar function of the geometry, whose gradient costs about as much as that of a design objective."""
    moved = eqx.tree_at(lambda i: (i.array.centers, i.sensor_distance), s.imager, (centers, sensor_distance))
    return jnp.vdot(backproject(s.image, moved, s.grid), s.volume)


def hessian_vector_product(centers, sensor_distance, s: Inputs):
    """Hessian-vector product of the sum of a volume's squares, by centres and sensor distance."""
    here, along = (centers, sensor_distance), (jnp.ones_like(centers), jnp.ones_like(sensor_distance))

    def squares(centers, sensor_distance):
        moved = eqx.tree_at(lambda i: (i.array.centers, i.sensor_distance), s.imager, (centers, sensor_distance))
        return jnp.vdot(backproject(s.image, moved, s.grid) ** 2, s.volume)

    return jax.jvp(jax.grad(squares, (0, 1)), here, along)[1]


class Contestant(NamedTuple):
    function: Callable
    arguments: Callable[[Inputs], tuple]


_ours = lambda s: (s.image, s.imager, s.grid)
_whole = lambda s: (s.imager.array.centers, s.imager.sensor_distance, s)
_by_hand = lambda s: (np.asarray(s.image), plain(s.imager, s.grid))
CONTESTANTS = {
    "gs_jax": Contestant(backproject, _ours),
    "numba, the paper's loop": Contestant(paper_loop, _by_hand),
    "numba, lens patches": Contestant(lens_patches, _by_hand),
    "NumPy": Contestant(numpy_patches, _by_hand),
    "gs_jax, nearest pixel": Contestant(jax.jit(partial(backproject, method="nearest")), _ours),
    "gs_jax, normalize": Contestant(jax.jit(partial(backproject, normalize=True)), _ours),
    "gs_jax, uint16 image": Contestant(backproject, lambda s: (_as_uint16(s.image), s.imager, s.grid)),
    "gs_jax, adjoint": Contestant(backproject_adjoint, lambda s: (s.volume, s.imager, s.grid)),
    "gs_jax, gradient": Contestant(jax.jit(jax.grad(bilinear_form, argnums=(0, 1))), _whole),
    "gs_jax, value and gradient": Contestant(jax.jit(jax.value_and_grad(bilinear_form, argnums=(0, 1))), _whole),
    "gs_jax, Hessian-vector product": Contestant(jax.jit(hessian_vector_product), _whole),
}
SAME_RESULT = ("gs_jax", "numba, the paper's loop", "numba, lens patches", "NumPy")
IN_STUDY = ("gs_jax", "gs_jax, adjoint", "numba, lens patches")


def _as_uint16(image):
    return (image * 65535).astype(jnp.uint16)


def prepared(name: str, arguments: tuple) -> tuple[Callable[[], Any], float]:
    """Compile a contestant; return a function that runs it, and the compilation time in seconds."""
    function = CONTESTANTS[name].function
    if lower := getattr(function, "lower", None):
        seconds, compiled = timed(lambda: lower(*arguments).compile())
        return lambda: jax.block_until_ready(compiled(*arguments)), seconds
    call = lambda: function(*arguments)
    if function is numpy_patches:
        return call, 0.0
    return call, max(0.0, timed(call)[0] - timed(call)[0])  # numba compiles once for all sizes, in the first call


def race(job: Job, names: Iterable[str], rounds: int, compile_s: dict) -> dict:
    """Time the contestants in interleaved rounds, so that other load on the machine affects all equally."""
    s = inputs(job)
    calls, results, compiled_s = {}, {}, {}
    for name in names:
        calls[name], seconds = prepared(name, CONTESTANTS[name].arguments(s))
        once_for = name if name.startswith("numba") else (name, *job.shapes())  # JAX compiles for each size
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
            "processor_ratio": min(processor[name]) / min(processor["gs_jax"]),
        }
        for name, t in times.items()
    }
    return {"job": str(job), **job._asdict(), "pairs": pairs, "contestants": measured}


def check(s: Inputs, results: Mapping[str, Any]) -> None:
    """Check that all implementations compute the same sum, and that the adjoint is the adjoint of it."""
    ours = results["gs_jax"]
    for name in set(SAME_RESULT) & set(results):
        error = np.abs(np.asarray(results[name]) - np.asarray(ours)).max() / np.asarray(ours).max()
        assert error < 1e-5, f"{name} differs from gs_jax by {error:.1e} of the maximum"
    if "gs_jax, adjoint" in results:
        double = lambda a: np.asarray(a, np.float64)
        back = np.vdot(double(ours), double(s.volume))
        forth = np.vdot(double(s.image), double(results["gs_jax, adjoint"]))
        assert abs(back - forth) < 1e-5 * abs(back), f"not adjoint: {back} and {forth}"


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
    outcome["bars"] = [bar for job in outcome["jobs"] for bar in bars(job)]
    return outcome


def amount(axis: str, result: dict) -> int:
    """Total number of voxels or pixels, not along a side."""
    n = result[axis]
    return {"voxels": n * n * result["depths"], "pixels": n * n}.get(axis, n)


def slope(axis: str, results: Sequence[dict], name: str) -> float:
    """Exponent of the cost between the two largest sizes."""
    (x0, t0), (x1, t1) = ((amount(axis, r), r["contestants"][name]["median_s"]) for r in results[-2:])
    return float(np.log(t1 / t0) / np.log(x1 / x0))


def bars(result: dict) -> list[dict]:
    """Targets at full scale, and the measured values."""
    of = lambda name, key: result["contestants"].get(name, {}).get(key, float("nan"))
    ratios = lambda name: np.array([of(name, "ratio"), of(name, "processor_ratio")])
    volume_mib = result["depths"] * result["voxels"] ** 2 * 4 / 2**20
    image_mib = result["pixels"] ** 2 * 4 / 2**20
    rows = [
        ("time of the paper's loop in numba, in ours", ratios("numba, the paper's loop"), ">=", 5),
        ("our time, in that of numba lens patches", 1 / ratios("numba, lens patches"), "<=", 1.05),
        ("the paper's 18 s, in ours", (PAPER_S / of("gs_jax", "median_s"), None), ">=", 100),
        ("back-projection, ms (video rate)", (1e3 * of("gs_jax", "median_s"), None), "<=", 33),
        ("adjoint, in back-projections", ratios("gs_jax, adjoint"), "<=", 1.5),
        ("value and gradient by centres and v, in back-projections", ratios("gs_jax, value and gradient"), "<=", 3),
        (
            "memory with the image, MiB",
            (image_mib + of("gs_jax", "extra_mib"), None),
            "<=",
            image_mib + 3 * volume_mib + 300 * 1e6 / 2**20,
        ),
    ]
    return [
        {
            "job": result["job"],
            "what": what,
            "found": float(outcome),
            "by_processor": None if processor is None else float(processor),
            "sign": sign,
            "bar": bar,
            "met": bool(outcome >= bar if sign == ">=" else outcome <= bar),
        }
        for what, (outcome, processor), sign, bar in rows
        if not np.isnan(outcome)  # memory is measured for the first problem only
    ]


COLUMNS = ("", "median, ms", "fastest, ms", "processor, ms", "in ours", "compile, s", "pairs / s", "memory, MiB")


def job_rows(result: dict) -> list[list[str]]:
    pretty = lambda value, form: "" if value is None else format(value, form)
    return [
        [
            name,
            f"{1e3 * m['median_s']:.1f}",
            f"{1e3 * m['min_s']:.1f}",
            f"{1e3 * m['processor_s']:.1f}",
            f"{m['ratio']:.2f}",
            f"{m['compile_s']:.1f}",
            f"{m['pairs_per_s']:.2e}",
            pretty(m.get("extra_mib"), ".0f"),
        ]
        for name, m in result["contestants"].items()
    ]


def bar_rows(outcome: dict) -> list[list[str]]:
    return [
        [
            b["job"],
            b["what"],
            f"{b['found']:.3g}",
            "" if b["by_processor"] is None else f"{b['by_processor']:.3g}",
            f"{b['sign']} {b['bar']:.3g}",
            "yes" if b["met"] else "NO",
        ]
        for b in outcome
    ]


def tables(outcome: dict) -> list[tuple[str, Sequence[str], list[list[str]]]]:
    """Title, columns and rows of every table."""
    jobs = [(f"{r['job']}: {r['pairs']:.3g} pairs", COLUMNS, job_rows(r)) for r in outcome["jobs"]]
    slopes = [[axis, *(f"{s[name]:.2f}" for name in IN_STUDY)] for axis, s in outcome["slopes"].items()]
    return [
        *jobs,
        ("Against the bars", ("", "", "found", "in processor time", "bar", "met"), bar_rows(outcome["bars"])),
        ("Exponent of the cost between the two largest sizes", ("in", *IN_STUDY), slopes),
    ]


def markdown(outcome: dict) -> str:
    machine = ", ".join(f"{key} {value}" for key, value in outcome["machine"].items())
    parts = [
        "# Speed of back-projection",
        f"{machine}.",
        "Warm medians. Processor: of all cores together, at least. In ours: the median of the ratio to gs_jax in the "
        "same round. A pair is a voxel and a lens that sees it. Memory: what a fresh process that has the inputs adds "
        "at its peak while it compiles and runs.",
    ]
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
    files = {"speed.json": outcome, "speed.md": markdown(outcome), "speed.png": picture(outcome["study"])}
    return Report(files, [table(columns, rows, title) for title, columns, rows in tables(outcome)])


if __name__ == "__main__":
    main(report)
