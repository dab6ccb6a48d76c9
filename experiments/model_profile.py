"""Show where the time of the full forward model and its adjoint goes, part by part.

The microscope is the built-in one: 5120 x 5120 pixels, binned to 1280 x 1280, and nine depths. Each part runs alone, as
XLA compiles it alone, so the parts need not add up to the whole. "Clock" is the median and "processor" the least time
of several calls; "memory" is what XLA plans beside arguments and results. A pair is a voxel and a lens that sees it.

    python -m experiments.model_profile [--out DIR]

Writes `model_profile.json` and `model_profile.md`; two minutes on two cores.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import gs_jax as gs
from experiments.common import Report, main, table
from experiments.inversion_speed import DEPTHS, measure
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.progress import Progress
from gs_jax.optics.field_varying import FieldVaryingPsf
from gs_jax.optics.psf_core import ring_edges
from gs_jax.projection import field_varying_model, stray_light
from gs_jax.reconstruction.inverse_problem import prepare_model
from gs_jax.reconstruction.pipeline import PIXELS_PER_VOXEL, voxel_grid

COLUMNS = ["part", "work", "clock, ms", "processor, ms", "memory, MiB"]


def timed(function: Callable, *arguments, rounds: int) -> tuple[dict[str, float], Any]:
    """Milliseconds of a compiled function, MiB that XLA plans for it, and its result."""
    compiled = jax.jit(function).lower(*arguments).compile()
    seconds, result = measure(lambda: jax.block_until_ready(compiled(*arguments)), rounds)
    assert (plan := compiled.memory_analysis()) is not None
    times = {"clock": 1000 * seconds["clock_s"], "processor": 1000 * seconds["processor_s"]}
    return times | {"memory": plan.temp_size_in_bytes / 2**20}, result


def with_rings(optics: FieldVaryingPsf, count: int) -> FieldVaryingPsf:
    """The inner rings of the field alone, at least one more than those on the sensor's pixels."""
    some = {"distortion": optics.distortion[:, :count], "light": optics.light[:, :count]}
    wide = optics.wide_kernels[:, : count - optics.kernels.shape[1]]
    return dataclasses.replace(optics, **some, wide_kernels=wide, rings=optics.rings[:count])


def run(pixels: int = 5120, depths: np.ndarray = DEPTHS, rounds: int = 7) -> list[dict[str, Any]]:
    """A row for each part: its name, the work that it does, its times and its memory."""
    scope = gs.geomscope().imager()
    scope = eqx.tree_at(lambda i: i.sensor, scope, gs.Sensor((pixels, pixels), scope.sensor.pixel_pitch))
    grid = voxel_grid(scope, depths.tolist(), None, pixels=PIXELS_PER_VOXEL)
    model = prepare_model(scope, grid, "full", Progress())
    imager, optics = model.imager, model.optics
    assert isinstance(optics, FieldVaryingPsf)
    volume = jnp.asarray(np.random.default_rng(0).random(grid.volume_shape), jnp.float32)
    rows = []

    def part(name: str, work: str, function: Callable, *arguments):
        numbers, result = timed(function, *arguments, rounds=rounds)
        rows.append({"name": name, "work": work} | numbers)
        return result

    def both_ways(name: str, work: str, function: Callable, x, *arguments):
        image = part(name, work, function, x, *arguments)
        back = lambda image, *arguments: jax.linear_transpose(lambda x: function(x, *arguments), x)(image)[0]
        part(f"{name}: adjoint", work, back, image, *arguments)
        return image

    model_of = lambda x, imager, optics: field_varying_model.full_image(x, imager, grid, optics)
    cores_of = lambda x, imager, optics: field_varying_model._cores_image(x, imager, grid, optics)
    both_ways("model", "", model_of, volume, imager, optics)
    both_ways("cores", _pairs(imager, grid, optics, slice(None)), cores_of, volume, imager, optics)
    work = _pairs(imager, grid, optics, slice(2))
    part("cores: two inner rings", work, cores_of, volume, imager, with_rings(optics, 2))
    points = dataclasses.replace(optics, kernels=jnp.ones_like(optics.kernels[..., :1, :1]))
    part("cores without the inner ring's convolutions", "", cores_of, volume, imager, points)
    to_nodes = lambda x: stray_light.to_nodes(x, grid, optics.stray_light.grid)
    nodes = part("stray light: volume to nodes", "", to_nodes, volume)
    image_of = lambda x, imager, light: stray_light.stray_light_image(x, imager, light, grid.depths, grid.origin)
    both_ways("stray light", "", image_of, nodes, imager, optics.stray_light)
    _stages(part, rows, nodes, imager, optics.stray_light)
    return rows


def _pairs(imager, grid, optics, rings) -> str:
    """Pairs of voxels and lenses within these rings, all depths."""
    inner, outer = ring_edges(imager, optics.rings)[rings][0][0], ring_edges(imager, optics.rings)[rings][-1][1]
    y, x = np.meshgrid(np.asarray(grid.y), np.asarray(grid.x), indexing="ij")
    distance = [np.hypot(x - a, y - b) for a, b in np.asarray(imager.centers)]
    count = len(grid.depths) * sum(((d >= inner) & (d < outer)).sum() for d in distance)
    return f"{count / 1e6:.0f}e6 pairs"


def _stages(part, rows, nodes, imager, light) -> None:
    """Time the stages of `stray_light_image` for one depth and one group of lenses, and scale by how often they run."""
    first, polar = len(rows), light.grid
    groups = [jnp.asarray(each) for each in stray_light._lens_groups(imager, light, nodes.dtype)]
    centers, excess = (each[0] for each in groups)
    lenses, depths, calls = len(centers), len(nodes), len(groups[0])
    to_polar, to_pixels = light.to_polar, light.to_pixels
    side = to_polar.side
    plane = jnp.pad(nodes[0], side + 1 + stray_light._SPARE)
    places = stray_light._window_places(centers, jnp.zeros(2, nodes.dtype), polar.step, plane.shape, side)
    read = lambda plane, places: stray_light.interpolate_windows(stray_light.Windows(plane.shape, side), places, plane)
    windows = part("- windows about lenses", "", read, plane, places)
    resample = lambda x: stray_light.times_table((), to_polar, x.reshape(-1, lenses))
    around = part("- to polar nodes", "", resample, windows)
    fourier = lambda x: jnp.fft.rfft(x.reshape(polar.angles, polar.fields, -1), axis=0)
    spectrum = part("- Fourier transform over the angle", "", fourier, around)
    table = light.table[0].reshape(*light.table.shape[1:3], -1).astype(nodes.dtype)
    parts = jnp.concatenate([spectrum.real, spectrum.imag], -1)
    both = jnp.concatenate([parts, parts * jnp.tile(excess, 2)[None, None]], 1)
    flops = 2e-9 * table.size * both.shape[-1] * depths * calls
    spots = part("- products over the radius", f"{flops:.1f} GFLOP", jnp.matmul, table, both)
    last = len(rows)
    inverse = lambda x: jnp.fft.irfft(jax.lax.complex(*jnp.split(x, 2, -1)), polar.angles, axis=0).reshape(-1, lenses)
    around = part("- inverse transform", "", inverse, spots)
    part("- to pixels", "", lambda x: stray_light.times_table((), to_pixels, x), around)
    for number, row in enumerate(rows[first:], first):
        for key in ("clock", "processor"):
            row[key] *= calls * (depths if number < last else 1)


def report(progress: Progress) -> Report:
    rows = run()
    lines = [[r["name"], r["work"], *(f"{r[k]:.0f}" for k in ("clock", "processor", "memory"))] for r in rows]
    files = {"model_profile.json": rows, "model_profile.md": markdown_table(COLUMNS, lines)}
    return Report(files, [table(COLUMNS, lines)])


if __name__ == "__main__":
    main(report)
