"""Cost of the forward model, and the difference between the paper's zones and the exact sum.

Cost: `gs_jax.forward` at full scale (5120^2 pixels, 213 lenses, 13 depths of 555^2 voxels, a PSF of 65 x 65 pixels at
each depth) and with more or fewer depths, lenses and pixels. In focus also the full model with cores of six rings or of
two, the adjoints, a step of Richardson-Lucy, and Eq. (2) by FFTs of whole images, interleaved. Zones: Eq. (2) takes the
envelope C at the centre of the zone that a voxel lies in, `gs_jax.forward` at the voxel; there is no other difference.
The zone of a lens is its Voronoi cell, so the difference follows from the envelope alone.

    python -m experiments.forward_model [--out DIR]

writes `forward.json` and `forward.png`; about four minutes on two cores.
"""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import KDTree

from experiments.backprojection_speed import Inputs, Job, inputs, timed
from experiments.common import Report, main, table
from experiments.true_image import TWO_RINGS
from gs_jax import Imager, ImagingOperator, RichardsonLucy, backproject_adjoint, forward
from gs_jax.base.machine import describe
from gs_jax.base.progress import Progress
from gs_jax.design.start import geomscope
from gs_jax.geometry import envelope
from gs_jax.optics.field_varying import field_varying_psf
from gs_jax.projection.convolution import with_margin

STUDY = {
    "depths": [Job(depths=n) for n in (1, 4, 13, 40)],
    "lenses": [Job(lenses=n) for n in (13, 53, 213, 850)],
    "pixels": [Job(pixels=n) for n in (640, 1280, 2560, 5120)],
}
# Sensor distance at which the full and the near model are compared.
FOCUSED = Job(sensor_distance_mm=5.8)
WHOLE = "near, by FFTs of whole images"
PSF_PIXELS = 65


def cost(job: Job, rounds: int = 3) -> dict[str, float]:
    """Warm median, compilation time, and memory that XLA allocates beside the arguments."""
    s: Inputs = inputs(job)
    return _in_turns({"near": (forward, (s.volume, s.imager, s.grid, _psf(job)))}, rounds)["near"]


def levels(job: Job, rounds: int = 3) -> dict[str, dict[str, float]]:
    """`cost` of the near model, the full model and the full model with two rings, and of adjoints and solver steps."""
    s: Inputs = inputs(job)
    full = lambda **options: field_varying_psf(s.imager, s.grid.depths, **options)
    geometry = s.imager, s.grid
    models = {
        WHOLE: (by_whole_images, _psf(job)),
        "near": (forward, _psf(job)),
        "full": (forward, full()),
        "two rings": (forward, full(rings=TWO_RINGS)),
    }
    calls = {}
    for name, (model, optics) in models.items():
        adjoint, step = _adjoint_and_step(model)
        calls[name] = jax.jit(model), (s.volume, *geometry, optics)
        calls[f"{name}, adjoint"] = adjoint, (s.image, *geometry, optics)
        calls[f"{name}, Richardson-Lucy step"] = step, (s.image, s.volume, *geometry, optics)
    return _in_turns(calls, rounds)


def by_whole_images(volume, imager, grid, psf):
    """`forward` by adding the spectra of whole images, which needs one inverse transform."""
    size, (rows, columns) = psf.shape[-1], imager.sensor.shape
    padded = rows + size - 1, columns + size - 1
    wide = with_margin(imager, size)

    def add_depth(spectrum, plane):
        depth, voxels, kernel = plane
        sharp = backproject_adjoint(voxels[None], wide, grid.at(depth))[1:-1, 1:-1]
        of_kernel = jnp.fft.fft(jnp.fft.rfft(kernel, padded[1], axis=1), padded[0], axis=0)
        return spectrum + jnp.fft.rfft2(sharp, padded) * of_kernel, None

    dark = jnp.zeros((padded[0], padded[1] // 2 + 1), jnp.complex64)
    spectrum = jax.lax.scan(jax.checkpoint(add_depth), dark, (grid.depths, volume, psf))[0]
    return jnp.fft.irfft2(spectrum, padded)[size - 1 :, size - 1 :]


def _adjoint_and_step(model):
    def operator(imager, grid, optics):
        if model is forward:
            return ImagingOperator(imager, grid, optics)
        volume = jax.ShapeDtypeStruct(grid.volume_shape, imager.sensor_distance.dtype)
        return lx.FunctionLinearOperator(lambda volume: model(volume, imager, grid, optics), volume)

    def step(image, volume, *system):
        solver, A = RichardsonLucy(), operator(*system)
        state = jax.eval_shape(lambda: solver.init(A, image))
        return solver.step(A, image, state._replace(x=volume, sensitivity=volume))

    return jax.jit(lambda image, *system: operator(*system).T.mv(image)), jax.jit(step)


def _psf(job: Job) -> jax.Array:
    return jnp.full((job.depths, PSF_PIXELS, PSF_PIXELS), PSF_PIXELS**-2.0, jnp.float32)


def _in_turns(calls, rounds):
    results, ready = {}, {}
    for name, (function, arguments) in calls.items():
        compile_s, compiled = timed(lambda f=function, a=arguments: f.lower(*a).compile())
        ready[name] = lambda c=compiled, a=arguments: jax.block_until_ready(c(*a))
        ready[name]()
        memory = compiled.memory_analysis()
        mib = (memory.temp_size_in_bytes + memory.output_size_in_bytes) / 2**20
        results[name] = {"median_s": [], "compile_s": compile_s, "mib": mib}
    for _ in range(rounds):
        for name, call in ready.items():
            results[name]["median_s"].append(timed(call)[0])
    median = lambda values: {"median_s": float(np.median(values))}
    return {
        name: numbers | {"rounds_s": numbers["median_s"]} | median(numbers["median_s"])
        for name, numbers in results.items()
    }


def bars(results: Mapping[str, Mapping]) -> list[list[str]]:
    """Compare Eq. (2) by tiles and by whole images with its targets, in interleaved rounds."""
    rows = []
    for what in ("", ", adjoint", ", Richardson-Lucy step"):
        before, now = (results[model + what]["rounds_s"] for model in (WHOLE, "near"))
        ratio, bar = float(np.median(np.array(before) / np.array(now))), None if what else 2
        met = "" if bar is None else "yes" if ratio >= bar else "NO"
        rows.append(
            [f"near{what}: time by FFTs of whole images, in ours", f"{ratio:.2f}", f">= {bar}" if bar else "", met]
        )
    return rows


def zone_departure(imager: Imager, depth: float, size: tuple[float, float], points: int = 20_000) -> dict[str, float]:
    """Share of a point's light that zones assign to wrong lenses, sum |C_zone - C| / sum C, over random points."""
    rng = np.random.default_rng(0)
    centers = np.asarray(imager.centers)
    place = rng.uniform(-0.5, 0.5, (points, 2)) * size
    zone = KDTree(centers).query(place)[1]
    # ApertureProfile' centroids, by the points themselves.
    middle = np.stack([np.bincount(zone, q, len(centers)) for q in place.T], -1) / np.bincount(zone)[:, None]
    reduced = imager.reduced_depth(depth)
    light = lambda q: np.asarray(envelope(_squared(q, centers), reduced, imager.field_radius))
    exact = light(place)
    departure = np.abs(light(middle[zone]) - exact).sum(1) / exact.sum(1)
    return {"depth_mm": depth, "mean": float(departure.mean()), "worst": float(departure.max())}


def _squared(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return ((a[:, None] - b[None]) ** 2).sum(-1)


def run(study: Mapping[str, Sequence[Job]] = STUDY, focused: Job = FOCUSED, *, progress: Progress) -> dict:
    """Return the content of `forward.json`; units are in the keys."""
    jobs = dict.fromkeys(job for axis in study.values() for job in axis)
    costs = {job: cost(job) for job in progress.track(list(jobs), "Forward model")}
    design = geomscope()
    return {
        "machine": describe(),
        "cost": {axis: [job._asdict() | costs[job] for job in jobs] for axis, jobs in study.items()},
        "levels": levels(focused),
        "zones": zone_departure(design.imager(), 20.0, design.array.size_mm),
    }


def picture(results: dict) -> Figure:
    """Plot time against each size, with the other sizes at full scale."""
    figure = Figure(figsize=(10, 3.2), dpi=100, layout="constrained")
    for axes, (axis, rows) in zip(figure.subplots(1, 3, sharey=True), results["cost"].items(), strict=True):
        axes.loglog([row[axis] for row in rows], [row["median_s"] for row in rows], "o-")
        axes.set_xlabel("pixels along a side" if axis == "pixels" else axis)
        axes.grid(which="both", alpha=0.25)
    figure.axes[0].set_ylabel("time, s")
    return figure


def report(progress: Progress) -> Report:
    results = run(progress=progress)
    numbers = lambda row: (f"{row['median_s']:.2f}", f"{row['compile_s']:.1f}", f"{row['mib']:.0f}")
    shown = [
        table((axis, "time, s", "compile, s", "memory, MiB"), [[str(row[axis]), *numbers(row)] for row in rows])
        for axis, rows in results["cost"].items()
    ]
    columns = ("model", "time, s", "compile, s", "memory, MiB")
    shown.append(table(columns, [[name, *numbers(row)] for name, row in results["levels"].items()]))
    shown.append(table(("", "found", "bar", "met"), bars(results["levels"]), "Against the bars"))
    return Report({"forward.json": results, "forward.png": picture(results)}, [*shown, str(results["zones"])])


if __name__ == "__main__":
    main(report)
