"""Light between the planes of a volume: finer planes, fewer, and voxels that are linear from plane to plane.

The ray-traced scenes of `volume_limits.py` are reconstructed by the unrolled inversion on planes 0.125 to 1 mm apart,
and by voxels whose light is linear from plane to plane: they are imaged on planes 0.125 to 0.5 mm apart, with fewer
unknowns. All volumes are brought to planes 0.5 mm apart, finer ones by linear shares, and scored as there.

    python -m experiments.between_planes [--design geomscope] [--draws 3] [--out DIR]

Writes `between_planes.json` and `between_planes.md`; about ten minutes on two cores.
"""

import time
from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float

from experiments.common import Report, main, table
from experiments.ray_tracer import traced
from experiments.surfaces import DEPTHS, STEP, VOXEL, device, noisy
from experiments.volume_limits import ELECTRONS, KINDS, PIXELS, RAYS, TILE, cell, gain, scene
from gs_jax import Grid, Imager, rasterize
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.progress import Progress
from gs_jax.projection.operators import as_matrix, no_structure, transpose
from gs_jax.reconstruction.inverse_problem import (
    BackOperator,
    InverseProblem,
    lens_type_geometries,
    num_detrend_modes,
    prepare_data,
    prepare_model,
)
from gs_jax.solvers.base import run_solver
from gs_jax.solvers.richardson_lucy import hat_functions
from gs_jax.solvers.unrolled import Unrolled

# Steps from plane to plane, and from one plane to the next on which voxels are imaged, mm.
PLANES = ((0.5, 0.5), (0.25, 0.25), (0.125, 0.125), (0.5, 0.25), (0.5, 0.125), (1.0, 1.0), (1.0, 0.5))


def count(step: float) -> int:
    """Number of planes so far apart, mm."""
    return round((DEPTHS[1] - DEPTHS[0]) / step) + 1


def shares(step: float, fine: float) -> Float[np.ndarray, "depth plane"]:
    """Linear shares of planes `step` apart in those `fine` apart; the sum of each row is 1."""
    return np.asarray(hat_functions(count(fine), count(step), np.float32))


def spread(step: float, fine: float) -> Float[np.ndarray, "depth plane"]:
    """Light of planes `step` apart on those `fine` apart, linear from plane to plane; the sum of each column is 1."""
    return shares(step, fine) / shares(step, fine).sum(0)


def on_planes(volume: np.ndarray, step: float) -> np.ndarray:
    """The light of planes `step` apart on those that are scored, in linear shares."""
    if step > STEP:
        return np.tensordot(spread(step, STEP), volume, 1)
    return np.tensordot(shares(STEP, step).T, volume, 1)


class Slabs(lx.AbstractLinearOperator):
    """The image of planes whose light is spread over finer ones."""

    fine: InverseProblem
    shares: Float[Array | np.ndarray, "depth plane"]
    transpose, as_matrix = transpose, as_matrix

    def mv(self, vector):
        return self.fine.mv(jnp.tensordot(jnp.asarray(self.shares), vector, 1))

    def in_structure(self):
        full = self.fine.in_structure()
        return jax.ShapeDtypeStruct((self.shares.shape[1], *full.shape[1:]), full.dtype)

    def out_structure(self):
        return self.fine.out_structure()


no_structure(Slabs)


class Spread(eqx.Module):
    """Slabs with the back-projection of their planes."""

    slabs: Slabs
    T: BackOperator
    least_squares: Slabs

    def mv(self, vector):
        return self.slabs.mv(vector)

    def in_structure(self):
        return self.slabs.in_structure()

    def out_structure(self):
        return self.slabs.out_structure()


class Methods:
    """Volumes by the unrolled inversion, on the planes that are scored, for each of `PLANES`."""

    def __init__(self, imager: Imager, progress: Progress):
        depths = lambda step: np.linspace(*DEPTHS, count(step))
        grids = {step: Grid.over(imager.sensor, depths=depths(step), pitch=VOXEL) for pair in PLANES for step in pair}
        models = {step: prepare_model(imager, grid, "full", progress) for step, grid in grids.items()}
        self.model, self.progress, self.operators = next(iter(models.values())), progress, {}
        binned = self.model.imager
        for step, fine in PLANES:
            modes = num_detrend_modes(binned, models[fine].optics)
            problem = lambda *options, fine=fine: InverseProblem(binned, grids[fine], models[fine].optics, *options)
            views = lens_type_geometries(imager, grids[step])
            if step == fine:
                self.operators[step, fine] = problem(views, modes)
                continue
            # Back-projection is that of the planes themselves.
            plain = InverseProblem(binned, grids[step], models[step].optics, views)
            slabs, detrended = (Slabs(problem(None, some), spread(step, fine)) for some in (0, modes))
            self.operators[step, fine] = Spread(slabs, plain.T, detrended)

    def run(self, image: np.ndarray, step: float, fine: float) -> np.ndarray:
        light, _ = prepare_data(image, self.model)
        state = run_solver(Unrolled.pretrained(), light, self.operators[step, fine], self.progress).state
        volume = np.asarray(Unrolled.pretrained().estimate(state))
        return on_planes(np.tensordot(spread(step, fine), volume, 1) if fine < step else volume, fine)


def run(imager: Imager, draws: int, progress: Progress) -> list[dict]:
    """Records of each scene and pair of steps."""
    methods, records = Methods(imager, progress), []
    scored = Grid.over(imager.sensor, depths=np.linspace(*DEPTHS, count(STEP)), pitch=VOXEL)
    for draw, kind in progress.track(list(product(range(draws), KINDS)), "Scenes"):
        emitters = scene(kind, draw)
        truth = np.asarray(rasterize(emitters, scored), np.float32)
        image = noisy(traced(emitters, imager, RAYS, TILE), ELECTRONS)
        for step, fine in PLANES:
            began = time.process_time()
            volume = methods.run(image, step, fine)
            took = time.process_time() - began
            record = {"kind": kind, "draw": draw, "step": step, "fine": fine, "seconds": took}
            records.append(record | {"db": gain(volume, truth)})
    return records


def shown(design: str, records: list[dict]) -> Report:
    """The table."""
    rows = []
    for step, fine in PLANES:
        of = lambda key, at=(step, fine): np.array([r[key] for r in records if (r["step"], r["fine"]) == at])
        name = f"{step:g}" + (f", linear over {round(step / fine)}" if fine < step else "")
        row = [name, str(count(step)), cell(of("db")), cell(of("db") - of("db", PLANES[0]))]
        rows.append([*row, f"{np.median(of('seconds')):.1f}"])
    columns = ("steps, mm", "planes", "dB", "more than 0.5 mm", "processor time, s")
    text = f"# Light between planes by {design}\n\n{markdown_table(columns, rows)}\n"
    return Report({"between_planes.json": records, "between_planes.md": text}, [table(columns, rows)])


def report(design: str, draws: int, progress: Progress) -> Report:
    return shown(design, run(device(design, PIXELS), draws, progress))


if __name__ == "__main__":
    main(report, {"--design": {"default": "geomscope"}, "--draws": {"type": int, "default": 3}})
