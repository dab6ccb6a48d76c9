"""Benchmark of reconstruction methods: time, memory and quality against pixel-voxel pairs (the paper's Fig. 9).

One plane at 20 mm with as many voxels as the sensor has pixels, `n^2`, hence `n^4` pairs. The microscope is the middle
of the paper's, 5.76 mm wide, whatever `n`. A scene is ten particles as wide as a pixel seen through a lens, imaged as
points far finer than the voxels, with the diffraction PSF and noise, by no solver's operator. Each method runs in its
own process. "dense" methods keep the system matrix in memory, as the paper's ADMM and Richardson-Lucy do; the others
are matrix-free. Every solver takes the same number of steps, whose cost and progress differ: beside times stands the
objective that least-squares solvers reach, relative to that of an empty volume.
"""

import csv
import ctypes
import dataclasses
import gc
import math
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float, Float32
from matplotlib.figure import Figure
from skimage.feature import peak_local_max

from ..base.arrays import to_float32
from ..base.errors import InputError
from ..base.machine import available_memory, describe, status_mib
from ..base.progress import Progress
from ..base.typing import Volume
from ..design.start import geomscope
from ..detection.particles import find_clusters
from ..detection.point_finder import find_points
from ..detection.unet import pretrained, suppress
from ..io.files import atomic_write, write_figure, write_json, write_text
from ..io.provenance import KEY, Provenance
from ..metrics import localization, quality
from ..microscope.geometry import Imager
from ..microscope.grid import Grid, Sensor
from ..microscope.lenses import MicrolensArray
from ..optics.apertures import clear_diameter
from ..optics.psf import geometric_psf
from ..optics.theory import FWHM
from ..projection.operators import ImagingOperator
from ..reconstruction.inverse_problem import subtract_offset
from ..reconstruction.pipeline import BackProjection, PinholeRichardsonLucy, reconstruct
from ..simulation import Camera, electrons, expose, simulate_points
from ..solvers.admm import ADMM
from ..solvers.base import lambda_max, solve
from ..solvers.fista import FISTA
from ..solvers.richardson_lucy import RichardsonLucy
from .pictures import line_of

# 1e6 to 2e9 pairs as in the paper, then up to its full scale (5120^2 pixels times 4 million voxels: 1e14).
SIDES = (32, 56, 100, 212, 1024, 3200)
STEPS = 30
WIDTH, DEPTH, PARTICLES, PEAK_ELECTRONS = 5.76, 20.0, 10, 10_000.0
# Points along a side of a particle; part of the largest value that a peak exceeds (particles differ by a factor of 2).
_ACROSS, _PEAK = 6, 0.3
COSTS = ("seconds", "compile_seconds", "peak_mib")
COLUMNS = ("method", "pairs", *COSTS, "psnr_db", "ssim", "mse", "f1", "seed", "objective")
# Seconds: calls that take longer are not repeated; methods that would take longer are skipped.
_REPEAT, LIMIT = 1.0, 30.0
_REPEATS = 5

# Exponents of the time in the text on the paper's Fig. 9(A): linear, and below 0.5.
_PAPER = {"admm, dense": "1", "richardson-lucy, dense": "1", "backproject": "< 0.5"}
_STOP = f"Every solver takes {STEPS} steps, converged or not."
_PANELS = {
    "seconds": "time, s",
    "peak_mib": "memory, MiB",
    "psnr_db": "PSNR, dB",
    "ssim": "SSIM",
    "mse": "MSE",
    "f1": "F1 of the points",
}

Psf = Float32[np.ndarray, "1 tall wide"]
Records = Sequence[dict[str, Any]]


def make_microscope(side: int) -> tuple[Imager, Grid, Psf]:
    """The microscope with `side^2` pixels, its voxels, as many, and its PSF."""
    design, pitch = geomscope().imager(), WIDTH / side
    centers = np.asarray(design.centers)
    array = MicrolensArray(centers[(np.abs(centers) < WIDTH / 2 + 1.0).all(axis=1)])
    imager = dataclasses.replace(design, array=array, sensor=Sensor((side, side), pitch))
    # The rays' blur is 0.1 mm and more: in pixels, and a pixel for what is beside it.
    size = 2 * math.ceil(0.1 / pitch) + 3
    psf = geometric_psf(imager, DEPTH, size=size, radius=clear_diameter(imager.array) / 2)
    return to_float32(imager), to_float32(Grid([DEPTH], (side, side), pitch)), np.asarray(psf, np.float32)[None]


def particle_width(imager: Imager) -> float:
    """Lateral resolution as a standard deviation, mm: pixel / M (Eq. 5)."""
    return imager.sensor.pixel_pitch / float(imager.magnification(DEPTH)) / FWHM


class Scene(NamedTuple):
    """Particles `(x, y, z, intensity)`, the same on the grid, and their image."""

    image: Float32[np.ndarray, "row column"]
    particles: Float[np.ndarray, "particle 4"]
    truth: Float32[np.ndarray, "1 y x"]


def simulate_scene(imager: Imager, grid: Grid, seed: int, progress: Progress | None = None) -> Scene:
    """Random particles, as wide as the microscope resolves, and their image with noise."""
    rng, width = np.random.default_rng(seed), particle_width(imager)
    places, brightness = rng.uniform(-0.3 * WIDTH, 0.3 * WIDTH, (PARTICLES, 2)), rng.uniform(0.5, 1, PARTICLES)
    particles = np.column_stack([places, np.full(PARTICLES, DEPTH), brightness])
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-2 * width, 2 * width, _ACROSS)]))
    weight = np.exp(-(x**2 + y**2) / (2 * width**2))
    offsets = np.column_stack([x, y, 0 * x, 0 * x])
    emitters = (particles[:, None] + offsets[None]) * np.stack([*3 * [np.ones_like(weight)], weight], axis=1)[None]
    # Diffraction is much finer than a coarse pixel, and would take a huge pupil there.
    kind = "diffraction" if imager.sensor.pixel_pitch < 0.02 else "geometric"
    # In JAX's own precision, as the PSFs are computed.
    imager = jax.tree.map(lambda leaf: leaf.astype(float) if eqx.is_inexact_array(leaf) else leaf, imager)
    image, camera = simulate_points(emitters.reshape(-1, 4), imager, kind=kind, progress=progress), Camera(gain=1.0)
    counts = expose(jnp.asarray(image), camera, jax.random.key(seed), peak_electrons=PEAK_ELECTRONS)
    return Scene(np.asarray(electrons(counts, camera)), particles, render_points(particles, grid, width))


def render_points(points: Float[np.ndarray, "point 4"], grid: Grid, width: float) -> Volume:
    """Points as Gaussians of standard deviation `width` in the nearest plane; their maximum is the intensity."""
    z = np.asarray(grid.depths)
    volume = np.zeros(grid.volume_shape, np.float32)
    for px, py, pz, intensity in points:
        across, along = (np.exp(-((np.asarray(a) - p) ** 2) / (2 * width**2)) for a, p in ((grid.x, px), (grid.y, py)))
        volume[np.abs(z - pz).argmin()] += (intensity * along[:, None] * across[None]).astype(np.float32)
    return volume


def find_peaks(volume: Float[Array | np.ndarray, "depth y x"], grid: Grid) -> Float[np.ndarray, "point 4"]:
    """Local maxima more than 2 voxels apart that exceed 0.3 of the largest value, above each plane's median.

    One rule for every method, which does not know the number of particles.
    """
    volume = np.asarray(volume, np.float32)
    volume = volume - np.median(volume, axis=(1, 2), keepdims=True)
    threshold = max(float(_PEAK * volume.max()), 0.0)
    peaks = peak_local_max(volume, min_distance=2, threshold_abs=threshold, exclude_border=False)
    return np.column_stack([grid.to_mm(peaks), volume[tuple(peaks.T)]])


def score(volume: Float[Array | np.ndarray, "depth y x"], scene: Scene, grid: Grid, width: float) -> dict[str, Any]:
    """PSNR, SSIM and MSE, and F1 of the peaks within a particle's full width of a particle."""
    q = quality(volume, scene.truth)
    f1 = localization(find_peaks(volume, grid), scene.particles, lateral=FWHM * width).f1
    return {"psnr_db": q.psnr_db, "ssim": q.ssim, "mse": q.mse, "f1": f1}


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds that a call took, and its result."""
    start = time.perf_counter()
    result = call()
    return time.perf_counter() - start, result


def peak_mib(call: Callable[[], Any]) -> tuple[float, Any]:
    """The largest resident memory that a call adds to a fresh process, MiB, and its result; NaN but on Linux."""
    if sys.platform != "linux":
        return float("nan"), call()
    gc.collect()
    # Freed memory that the allocator keeps would hide what the call takes.
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # resets the peak
    except OSError:
        return float("nan"), call()
    before = status_mib("VmRSS")
    result = call()
    return status_mib("VmHWM") - before, result


class Method(NamedTuple):
    """A method whose `make(imager, grid, psf)` returns `image -> volume`.

    `growth` is the exponent of its time in pairs, `minimises` the solver whose objective it lowers.
    """

    make: Callable[[Imager, Grid, Psf], Callable[[Any], Any]]
    growth: float = 0.5
    dense: bool = False
    minimises: FISTA | ADMM | None = None


# Without acceleration, as the paper's comparison.
_PLAIN = {
    "backproject": BackProjection(),
    "list-rl": PinholeRichardsonLucy(STEPS),
    "richardson-lucy": RichardsonLucy(STEPS),
    "fista": FISTA(STEPS),
    "admm": ADMM(STEPS),
}


def _matrix_free(name: str):
    method = _PLAIN[name]

    def make(imager: Imager, grid: Grid, psf: Psf):
        # Pixel-voxel lists have no PSF.
        optics = None if isinstance(method, PinholeRichardsonLucy) else psf
        return lambda image: reconstruct(image, imager, grid, method, optics=optics)

    return make


def _dense(solver: RichardsonLucy | ADMM):
    """The solver with the system matrix in memory, whose making counts as compilation."""

    def make(imager: Imager, grid: Grid, psf: Psf):
        shape = grid.volume_shape
        size, pixels = math.prod(shape), math.prod(imager.sensor.shape)

        @jax.jit
        def column(voxel):
            volume = jnp.zeros(size, jnp.float32).at[voxel].set(1).reshape(shape)
            return ImagingOperator(imager, grid, jnp.asarray(psf)).mv(volume).ravel()

        matrix = np.empty((size, pixels), np.float32)
        for voxel in range(size):
            matrix[voxel] = column(voxel)
        matrix = jnp.asarray(matrix)
        voxels = jax.ShapeDtypeStruct((size,), jnp.float32)

        def invert(matrix, image):
            # XLA is many times slower on processors with `matrix.T @ x`, which `MatrixLinearOperator` computes.
            operator = lx.FunctionLinearOperator(lambda x: x @ matrix, voxels)
            return solve(operator, image, solver).value

        call = jax.jit(invert).lower(matrix, jax.ShapeDtypeStruct((pixels,), jnp.float32)).compile()
        return lambda image: call(matrix, image.ravel()).reshape(shape)

    return make


def _after_backprojection(finish: Callable[[Any, Imager, Grid], Any]):
    def make(imager: Imager, grid: Grid, psf: Psf):
        first = _matrix_free("backproject")(imager, grid, psf)
        return lambda image: finish(first(image), imager, grid)

    return make


def _points(imager: Imager, grid: Grid, psf: Psf):
    return lambda image: render_points(find_points(image, imager, grid), grid, particle_width(imager))


def _clusters(volume, imager: Imager, grid: Grid) -> Volume:
    return render_points(find_clusters(volume, grid), grid, particle_width(imager))


METHODS = {
    "backproject": Method(_matrix_free("backproject")),
    "backproject + points": Method(_points),
    "backproject + clusters": Method(_after_backprojection(_clusters)),
    "backproject + unet": Method(_after_backprojection(lambda volume, imager, grid: suppress(volume, pretrained()))),
    "list-rl": Method(_matrix_free("list-rl")),
    "richardson-lucy": Method(_matrix_free("richardson-lucy")),
    "fista": Method(_matrix_free("fista"), minimises=FISTA(STEPS)),
    "admm": Method(_matrix_free("admm"), minimises=ADMM(STEPS)),
    "richardson-lucy, dense": Method(_dense(RichardsonLucy(STEPS)), 1.0, True),
    "admm, dense": Method(_dense(ADMM(STEPS)), 1.0, True, ADMM(STEPS)),
}


def relative_objective(volume, image, operator: ImagingOperator, solver: FISTA | ADMM) -> float:
    """The objective of a solver without total variation, over that of an empty volume."""
    light = jnp.asarray(subtract_offset(image))

    @jax.jit
    def ratio(volume):
        residual = operator.mv(volume) - light
        weight = solver.sparsity * lambda_max(operator.T.mv(light))
        return (jnp.vdot(residual, residual) / 2 + weight * jnp.sum(volume)) / (jnp.vdot(light, light) / 2)

    return float(ratio(jnp.asarray(volume)))


def measure(name: str, side: int, scenes: Sequence[Scene]) -> list[dict[str, Any]]:
    """A record of each scene; run in a process of its own."""
    method, (imager, grid, psf) = METHODS[name], make_microscope(side)

    def work():
        compile_seconds, call = timed(lambda: method.make(imager, grid, psf))
        run = lambda image: timed(lambda: jax.block_until_ready(call(image)))
        results, first = [], []
        for scene in scenes:
            image = jnp.asarray(scene.image)
            # Some methods compile for each number of points that an image shows.
            first.append(run(image)[0])
            seconds, volume = run(image)
            more = [run(image)[0] for _ in range(_REPEATS - 1)] if seconds < _REPEAT else []
            results.append((min(seconds, *more, first[-1]), np.asarray(volume)))
        return compile_seconds + first[0] - results[0][0], results

    peak, (compile_seconds, results) = peak_mib(work)
    operator, width = ImagingOperator(imager, grid, jnp.asarray(psf)), particle_width(imager)
    reached = lambda volume, image: method.minimises and relative_objective(volume, image, operator, method.minimises)
    return [
        {"method": name, "pairs": float(side) ** 4, "seconds": seconds, "compile_seconds": compile_seconds}
        | {"peak_mib": peak, **score(volume, scene, grid, width), "objective": reached(volume, scene.image)}
        for (seconds, volume), scene in zip(results, scenes, strict=True)
    ]


def skip_reason(name: str, side: int, last: dict[str, Any] | None, limit: float) -> str | None:
    """Why a method is skipped at a size, for memory or time; None if it is not."""
    method, pairs = METHODS[name], float(side) ** 4
    # The matrix, and its copy while it is made.
    if method.dense and 8 * pairs > (memory := available_memory() / 4):
        return f"two copies of the matrix take {8 * pairs / 2**30:.3g} GiB, more than {memory / 2**30:.3g} GiB"
    if last and (forecast := last["seconds"] * (pairs / last["pairs"]) ** method.growth) > limit:
        return f"would take {forecast:.3g} s an image, more than {limit:g} s"
    return None


def run(
    sides: Sequence[int] = SIDES,
    *,
    methods: Sequence[str] = tuple(METHODS),
    seeds: Sequence[int] = (0, 1, 2),
    limit: float = LIMIT,
    callback: Callable[[Records], object] = lambda records: None,
    progress: Progress | None = None,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Run all methods at all sizes; the records, and what was skipped: `method`, `pairs`, `reason`.

    Parameters
    ----------
    sides
        Pixels, and voxels, along a side, ascending.
    methods
        Keys of `METHODS`.
    seeds
        One scene each; above 1e10 pairs only the first.
    limit
        Seconds per image: a method is skipped at a size where it would take longer, by its time at the last.
    callback
        Called with the records so far after each method at each size.
    """
    progress = progress or Progress()
    records, skipped, scenes = [], [], {}
    numbered = lambda rows: [row | {"seed": seed} for row, seed in zip(rows, seeds, strict=False)]
    for side in progress.track(sides, "Images"):
        imager, grid, _ = make_microscope(side)
        scenes[side] = [simulate_scene(imager, grid, seed) for seed in (seeds if side**4 < 1e10 else seeds[:1])]
        common = {"method": "zeros", "pairs": float(side) ** 4, "objective": None} | dict.fromkeys(COSTS, 0.0)
        width = particle_width(imager)
        records += numbered(common | score(np.zeros_like(s.truth), s, grid, width) for s in scenes[side])
    for name in progress.track(methods, "Methods"):
        last = None
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            for side in progress.track(sides, name):
                reason = skip_reason(name, side, last, limit)
                if reason is None:
                    try:
                        new = pool.submit(measure, name, side, scenes[side]).result()
                        last = new[0]
                        records += numbered(new)
                        callback(records)
                        continue
                    except BrokenProcessPool:
                        reason = "the process was ended, for want of memory"
                    except InputError as error:  # missing weights
                        reason = str(error)
                skipped.append({"method": name, "pairs": float(side) ** 4, "reason": reason})
    return records, skipped


def write_records(path: Path, records: Records, provenance: Provenance | None = None) -> None:
    """Write the records as JSON, with their provenance."""
    write_json(path, ({KEY: dict(provenance)} if provenance else {}) | {"records": records})


def write(records: Records, skipped: Records, folder: Path, provenance: Provenance | None = None) -> None:
    """Write `benchmark.json`, `.csv`, `.md` and `.png`, and `benchmark-notes.json`.

    Raises `InputError` if the folder cannot be written to.
    """
    write_records(folder / "benchmark.json", records, provenance)
    notes = {"machine": describe(), "slopes": time_exponents(records), "left_out": skipped}
    write_json(folder / "benchmark-notes.json", notes)
    with atomic_write(folder / "benchmark.csv") as path, path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list[str](COLUMNS))
        writer.writeheader()
        writer.writerows(records)
    write_text(folder / "benchmark.md", markdown(records, skipped), [".md"])
    write_figure(folder / "benchmark.png", picture(records))


def _by_method(records: Records, key: str) -> dict[str, dict[float, list[float]]]:
    """Values of a key that are known, by method and pairs."""
    values: dict[str, dict[float, list[float]]] = {}
    for record in records:
        if record[key] is not None:
            values.setdefault(record["method"], {}).setdefault(record["pairs"], []).append(record[key])
    return values


def time_exponents(records: Records) -> dict[str, float]:
    """Exponent of the time in pairs of each method, by linear regression of the logarithms from 1e6 to 2e9 pairs."""
    exponents = {}
    for name, seconds in _by_method([r for r in records if r["seconds"] > 0 and r["pairs"] < 3e9], "seconds").items():
        if len(seconds) > 1:
            pairs, times = np.log([(pairs, value) for pairs, values in seconds.items() for value in values]).T
            exponents[name] = float(np.polyfit(pairs, times, 1)[0])
    return exponents


def markdown(records: Records, skipped: Records) -> str:
    """Tables of time, memory and quality by pairs, exponents of time, and what was skipped."""
    sizes = sorted({record["pairs"] for record in records})
    measured = [record for record in records if record["seconds"] > 0]

    def cell(values: Sequence[float], form: str) -> str:
        if not values:
            return "-"
        mean = format(float(np.mean(values)), form)
        return mean if len(values) == 1 else f"{mean} +- {format(float(np.std(values, ddof=1)), form)}"

    parts = [_STOP]
    for title, key, form, some in (
        ("Time, s (the fastest of some warm calls)", "seconds", ".2g", measured),
        ("Compilation (of a dense method: the matrix too), s", "compile_seconds", ".2g", measured),
        ("Memory that is added at the peak, MiB (at the first size: the compiler too)", "peak_mib", ".0f", measured),
        ("PSNR, dB", "psnr_db", ".1f", records),
        ("SSIM", "ssim", ".3f", records),
        ("MSE", "mse", ".1e", records),
        ("F1 of the peaks", "f1", ".2f", records),
        ("Objective of least squares, over that of an empty volume", "objective", ".4f", records),
    ):
        rows = _by_method(some, key).items()
        body = [[name, *(cell(values.get(size, []), form) for size in sizes)] for name, values in rows]
        parts += [f"**{title}**", markdown_table(["pairs", *(f"{size:.1e}" for size in sizes)], body)]
    rows = [[name, f"{exponent:.2f}", _PAPER.get(name, "-")] for name, exponent in time_exponents(records).items()]
    parts += ["**Exponent of time in pairs, 1e6 to 2e9**", markdown_table(["method", "measured", "paper"], rows)]
    if skipped:
        rows = [[row["method"], f"{row['pairs']:.1e}", row["reason"]] for row in skipped]
        parts += ["**Left out**", markdown_table(["method", "pairs", "why"], rows)]
    return "\n\n".join(parts) + "\n"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def picture(records: Records) -> Figure:
    """The panels of Fig. 9 and two more: means, with standard deviations as bars."""
    figure = Figure(figsize=(12, 8), dpi=100, layout="constrained")
    for axes, (key, label) in zip(figure.subplots(2, 3).flat, _PANELS.items(), strict=True):
        is_cost = key in COSTS
        for method, by_pairs in _by_method(records, key).items():
            if method == "zeros" and is_cost:
                continue
            pairs, values = zip(*sorted(by_pairs.items()), strict=True)
            errors = None if is_cost else [np.std(some) for some in values]
            axes.errorbar(pairs, [np.mean(some) for some in values], errors, **line_of(method))
        axes.set(xscale="log", xlabel="pixel-voxel pairs", ylabel=label)
        if is_cost or key == "mse":
            axes.set_yscale("log")
        axes.grid(alpha=0.25)
    handles, labels = figure.axes[2].get_legend_handles_labels()
    figure.legend(handles, labels, title=_STOP, loc="outside lower center", ncols=5, fontsize=9)
    return figure
