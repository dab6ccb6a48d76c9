"""Reconstruction time and quality against the number of pixel-voxel pairs: the paper's Fig. 9.

One plane at 20 mm with as many voxels as the sensor has pixels, `n^2`, hence `n^4` pairs. The microscope is a middle
piece of the paper's, 5.76 mm wide, whatever `n`. A scene is ten particles as wide as a pixel seen through a lens. Its
image is that of points far finer than the voxels, with the diffraction PSF and noise: no operator that a solver uses
rendered it. Each method runs in its own process. "dense" stands for the system matrix in memory, as the paper's ADMM
and Richardson-Lucy keep it; the others are matrix-free.

Every solver takes the same number of steps and stops for nothing else. A step does not cost the same everywhere, nor
come as near to the minimum: times stand beside what the solvers of least squares reached, their objective over that of
an empty volume.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np

from ..base.errors import InputError
from ..base.machine import available_memory
from ..base.progress import Progress
from ..detection.clusters import find_clusters
from ..detection.point_finder import find_points
from ..detection.unet import pretrained, suppress
from ..projection.operators import ImagingOperator
from ..reconstruction.inverse_problem import subtract_offset
from ..reconstruction.methods import BackProjection, PinholeRichardsonLucy
from ..reconstruction.pipeline import reconstruct
from ..solvers.admm import ADMM
from ..solvers.base import lambda_max, solve
from ..solvers.fista import FISTA
from ..solvers.richardson_lucy import RichardsonLucy
from .benchmark_measure import peak_mib, timed
from .benchmark_scenes import Bench, Case, bench, case, scores, spots

# 1e6 to 2e9 pairs as in the paper, then on to its full scale (5120^2 pixels times 4 million voxels: 1e14).
SIDES = (32, 56, 100, 212, 1024, 3200)
STEPS = 30
COSTS = ("seconds", "compile_seconds", "peak_mib")
# A call that took longer than this is not repeated; one that would take longer than the limit is left out, seconds.
_REPEAT, LIMIT = 1.0, 30.0
_REPEATS = 5


class Method(NamedTuple):
    """`make(bench)` returns `image -> volume`; `growth` is the exponent of its time, in pairs, for a forecast.

    `minimises` is the solver whose objective it lowers, if it is least squares.
    """

    make: Callable[[Bench], Callable[[Any], Any]]
    growth: float = 0.5
    dense: bool = False
    minimises: FISTA | ADMM | None = None


# Every step as the paper's comparison has it, without acceleration.
_PLAIN = {
    "backproject": BackProjection(),
    "list-rl": PinholeRichardsonLucy(STEPS),
    "richardson-lucy": RichardsonLucy(STEPS),
    "fista": FISTA(STEPS),
    "admm": ADMM(STEPS),
}


def _reconstructed(name: str):
    method = _PLAIN[name]
    # Pixel-voxel lists have no PSF.
    of = lambda bench: None if isinstance(method, PinholeRichardsonLucy) else bench.psf
    return lambda bench: lambda image: reconstruct(image, bench.imager, bench.grid, method, optics=of(bench))


def _dense(solver: RichardsonLucy | ADMM):
    """The same solver with the system matrix in memory; making it is counted with compilation."""

    def make(bench: Bench):
        imager, grid, psf, _ = bench
        shape = grid.volume_shape
        size, pixels = math.prod(shape), math.prod(imager.sensor.shape)
        unit = lambda voxel: jnp.zeros(size, jnp.float32).at[voxel].set(1).reshape(shape)
        column = jax.jit(lambda voxel: ImagingOperator(imager, grid, jnp.asarray(psf)).mv(unit(voxel)).ravel())
        matrix = np.empty((size, pixels), np.float32)
        for voxel in range(size):
            matrix[voxel] = column(voxel)
        matrix = jnp.asarray(matrix)
        voxels = jax.ShapeDtypeStruct((size,), jnp.float32)

        def explain(matrix, image):
            # On processors XLA is many times slower with `matrix.T @ x`, which is what `MatrixLinearOperator` takes.
            operator = lx.FunctionLinearOperator(lambda x: x @ matrix, voxels)
            return solve(operator, image, solver).x

        call = jax.jit(explain).lower(matrix, jax.ShapeDtypeStruct((pixels,), jnp.float32)).compile()
        return lambda image: call(matrix, image.ravel()).reshape(shape)

    return make


def _located(bench: Bench):
    def run(image):
        points = find_points(image, bench.imager, bench.grid)
        return spots(points, bench.grid, bench.width)

    return run


def _clustered(bench: Bench):
    first = _reconstructed("backproject")(bench)

    def run(image):
        points = find_clusters(first(image), bench.grid)
        return spots(points, bench.grid, bench.width)

    return run


def _network(bench: Bench):
    first, network = _reconstructed("backproject")(bench), pretrained()
    return lambda image: suppress(first(image), network)


METHODS = {
    "backproject": Method(_reconstructed("backproject")),
    "backproject + points": Method(_located),
    "backproject + clusters": Method(_clustered),
    "backproject + unet": Method(_network),
    "list-rl": Method(_reconstructed("list-rl")),
    "richardson-lucy": Method(_reconstructed("richardson-lucy")),
    "fista": Method(_reconstructed("fista"), minimises=FISTA(STEPS)),
    "admm": Method(_reconstructed("admm"), minimises=ADMM(STEPS)),
    "richardson-lucy, dense": Method(_dense(RichardsonLucy(STEPS)), 1.0, True),
    "admm, dense": Method(_dense(ADMM(STEPS)), 1.0, True, ADMM(STEPS)),
}


def objective(volume, image, bench: Bench, solver: FISTA | ADMM) -> float:
    """What a solver without total variation minimises, over that of an empty volume."""
    A = ImagingOperator(bench.imager, bench.grid, jnp.asarray(bench.psf))
    light = jnp.asarray(subtract_offset(image))

    @jax.jit
    def part(volume):
        residual = A.mv(volume) - light
        weight = solver.sparsity * lambda_max(A.T.mv(light))
        return (jnp.vdot(residual, residual) / 2 + weight * jnp.sum(volume)) / (jnp.vdot(light, light) / 2)

    return float(part(jnp.asarray(volume)))


def measure(name: str, side: int, cases: Sequence[Case]) -> list[dict[str, Any]]:
    """A record for each case; run in a process of its own."""
    at = bench(side)
    images = [jnp.asarray(c.image) for c in cases]

    def work():
        compile_s, call = timed(lambda: METHODS[name].make(at))
        run = lambda image: timed(lambda: jax.block_until_ready(call(image)))
        found, first = [], []
        for image in images:
            # Some compile in the first call with an image, for as many points as it shows.
            first.append(run(image)[0])
            seconds, volume = run(image)
            more = [run(image)[0] for _ in range(_REPEATS - 1)] if seconds < _REPEAT else []
            found.append((min(seconds, *more, first[-1]), np.asarray(volume)))
        return compile_s + first[0] - found[0][0], found

    peak, (compile_s, found) = peak_mib(work)
    return [
        {"method": name, "pairs": float(side) ** 4, "seconds": seconds, "compile_seconds": compile_s, "peak_mib": peak}
        | scores(volume, c, at)
        | {"objective": objective(volume, c.image, at, solver) if (solver := METHODS[name].minimises) else None}
        for (seconds, volume), c in zip(found, cases, strict=True)
    ]


def obstacle(name: str, side: int, last: dict[str, Any] | None, limit: float) -> str | None:
    """Why a method is not run at a size: too much memory, or time; None if nothing is in its way."""
    method, pairs = METHODS[name], float(side) ** 4
    # The matrix, and its copy while it is made.
    if method.dense and 8 * pairs > (room := available_memory() / 4):
        return f"two copies of the matrix take {8 * pairs / 2**30:.3g} GiB, allowed: {room / 2**30:.3g} GiB"
    if last and (forecast := last["seconds"] * (pairs / last["pairs"]) ** method.growth) > limit:
        return f"would take {forecast:.3g} s an image, allowed: {limit:g} s"
    return None


def run(
    sides: Sequence[int] = SIDES,
    *,
    methods: Sequence[str] = tuple(METHODS),
    seeds: Sequence[int] = (0, 1, 2),
    limit: float = LIMIT,
    each: Callable[[list[dict[str, Any]]], object] = lambda records: None,
    progress: Progress | None = None,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The records of all methods and sizes, and what was left out: `method`, `pairs`, `reason`.

    Parameters
    ----------
    sides
        Pixels, and voxels, along a side, ascending.
    methods
        Keys of `METHODS`.
    seeds
        One scene each; above 1e10 pairs only the first.
    limit
        A method is not run at a size where an image would take longer, by its time at the last, seconds.
    each
        Called with the records so far after each method at each size.
    """
    progress = progress or Progress()
    records, left_out = [], []
    cases = {}
    for side in progress.track(sides, "Images"):
        at = bench(side)
        cases[side] = [case(at, seed) for seed in (seeds if side**4 < 1e10 else seeds[:1])]
        dark = [scores(np.zeros_like(c.truth), c, at) for c in cases[side]]
        nothing = {"method": "zeros", "pairs": float(side) ** 4, "objective": None} | dict.fromkeys(COSTS, 0.0)
        records += [nothing | found | {"seed": seed} for found, seed in zip(dark, seeds, strict=False)]
    for name in progress.track(methods, "Methods"):
        last = None
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            for side in progress.track(sides, name):
                reason = obstacle(name, side, last, limit)
                if reason is None:
                    try:
                        found = pool.submit(measure, name, side, cases[side]).result()
                        last = found[0]
                        records += [record | {"seed": seed} for record, seed in zip(found, seeds, strict=False)]
                        each(records)
                        continue
                    except BrokenProcessPool:
                        reason = "the process was ended, for want of memory"
                    except InputError as error:  # weights that are not there
                        reason = str(error)
                left_out.append({"method": name, "pairs": float(side) ** 4, "reason": reason})
    return records, left_out


def slopes(records: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Exponent of the time in pairs: of each method, a line through its logarithms from 1e6 to 2e9 pairs."""
    found = {}
    for name in dict.fromkeys(r["method"] for r in records if r["seconds"] > 0):
        mine = [r for r in records if r["method"] == name and r["pairs"] < 3e9]
        if len({r["pairs"] for r in mine}) > 1:
            logs = np.log([[r["pairs"], r["seconds"]] for r in mine])
            found[name] = float(np.polyfit(logs[:, 0], logs[:, 1], 1)[0])
    return found
