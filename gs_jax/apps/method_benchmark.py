"""Benchmark of reconstruction methods: time, memory and quality against pixel-voxel pairs (the paper's Fig. 9).

One plane at 20 mm with as many voxels as the sensor has pixels, `n^2`, hence `n^4` pairs. The microscope is the middle
of the paper's, 5.76 mm wide, whatever `n`. A scene is ten particles as wide as a pixel seen through a lens, imaged as
points far finer than the voxels, with the diffraction PSF and noise, by no solver's operator. Each method runs in its
own process. "dense" methods keep the system matrix in memory, as the paper's ADMM and Richardson-Lucy do; the others
are matrix-free. Every solver takes the same number of steps, whose cost and progress differ: beside times stands the
objective that least-squares solvers reach, relative to that of an empty volume.
"""

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
from skimage.feature import peak_local_max

from ..base.arrays import to_float32
from ..base.errors import InputError
from ..base.machine import available_memory, status_mib
from ..base.progress import Progress
from ..design.start import geomscope
from ..detection.clusters import find_clusters
from ..detection.point_finder import find_points
from ..detection.unet import pretrained, suppress
from ..geometry import Imager
from ..grid import Grid, Sensor
from ..lenses import MicrolensArray
from ..metrics import localization, quality
from ..optics.apertures import clear_diameter
from ..optics.psf import geometric_psf
from ..optics.theory import FWHM
from ..projection.operators import ImagingOperator
from ..reconstruction.inverse_problem import subtract_offset
from ..reconstruction.pipeline import BackProjection, PinholeRichardsonLucy, reconstruct
from ..simulation.synthetic import Camera, electrons, expose, simulate_points
from ..solvers.admm import ADMM
from ..solvers.base import lambda_max, solve
from ..solvers.fista import FISTA
from ..solvers.richardson_lucy import RichardsonLucy
from ..typing import Volume

# 1e6 to 2e9 pairs as in the paper, then up to its full scale (5120^2 pixels times 4 million voxels: 1e14).
SIDES = (32, 56, 100, 212, 1024, 3200)
STEPS = 30
WIDTH, DEPTH, PARTICLES, PEAK_ELECTRONS = 5.76, 20.0, 10, 10_000.0
# Points along a side of a particle; part of the largest value that a peak exceeds (particles differ by a factor of 2).
_ACROSS, _PEAK = 6, 0.3
COSTS = ("seconds", "compile_seconds", "peak_mib")
# Seconds: calls that take longer are not repeated; methods that would take longer are skipped.
_REPEAT, LIMIT = 1.0, 30.0
_REPEATS = 5

Psf = Float32[np.ndarray, "1 tall wide"]


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
    # Pixel-voxel lists have no PSF.
    optics = lambda psf: None if isinstance(method, PinholeRichardsonLucy) else psf
    return lambda imager, grid, psf: lambda image: reconstruct(image, imager, grid, method, optics=optics(psf))


def _dense(solver: RichardsonLucy | ADMM):
    """The solver with the system matrix in memory, whose making counts as compilation."""

    def make(imager: Imager, grid: Grid, psf: Psf):
        shape = grid.volume_shape
        size, pixels = math.prod(shape), math.prod(imager.sensor.shape)
        unit = lambda voxel: jnp.zeros(size, jnp.float32).at[voxel].set(1).reshape(shape)
        column = jax.jit(lambda voxel: ImagingOperator(imager, grid, jnp.asarray(psf)).mv(unit(voxel)).ravel())
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


def _points(imager: Imager, grid: Grid, psf: Psf):
    return lambda image: render_points(find_points(image, imager, grid), grid, particle_width(imager))


def _clusters(imager: Imager, grid: Grid, psf: Psf):
    first, width = _matrix_free("backproject")(imager, grid, psf), particle_width(imager)
    return lambda image: render_points(find_clusters(first(image), grid), grid, width)


def _network(imager: Imager, grid: Grid, psf: Psf):
    first, network = _matrix_free("backproject")(imager, grid, psf), pretrained()
    return lambda image: suppress(first(image), network)


METHODS = {
    "backproject": Method(_matrix_free("backproject")),
    "backproject + points": Method(_points),
    "backproject + clusters": Method(_clusters),
    "backproject + unet": Method(_network),
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
    callback: Callable[[list[dict[str, Any]]], object] = lambda records: None,
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
