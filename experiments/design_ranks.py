"""Whether objectives rank designs as reconstructed scenes do: Spearman's correlations with a judge of reduced cost.

Designs are the shipped ones and random ones, in focus or nearly. The judge is that of `experiments/design_judge.py` on
a field of 1.2 mm and the middle 8 mm of the sensor, at 3,000 electrons. Its solver is Richardson-Lucy with a system
matrix of rays and diffraction of its own, which takes seconds where the full model takes minutes; a scene counts with
its best number of steps. The judge's own repeat is of other scenes and noise. In the better half of the designs focus
is no longer what tells them apart.

    python -m experiments.design_ranks [DESIGN.toml ...] [--records FILE] [--out DIR]

Writes the records after each design, from which the next run goes on, and then `design_ranks.md`; about half an hour of
a core. Designs that are given are judged beside the others, and do not count in the correlations.
"""

from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import scipy.sparse as sp
from scipy.stats import rankdata

from experiments.common import Report, design_file, designs_by_name, main, read_records, tables_report
from experiments.design_judge import (
    DESIGNS,
    IMAGES,
    READ_NOISE,
    VOXEL,
    Settings,
    device,
    diffraction_transfer,
    image_of,
    make_scene,
    mark,
)
from experiments.ray_tracer import bundles
from gs_jax import Design, Imager, Progress, geomscope, quality, random_layout, rasterize, read_design
from gs_jax.codesign.terms import TERMS
from gs_jax.io.files import make_folder, write_json
from gs_jax.microscope.layouts import hexagonal_layout
from gs_jax.objectives import Conditions
from gs_jax.reconstruction.inverse_problem import sum_pixels

RANDOM = tuple(f"random {seed}" for seed in range(40))
# Those for 18 to 23 mm that have a name; the last two are out of focus.
NAMED = (*DESIGNS, "geomscope-exposure", "geomscope-table1", "geomscope-targets")
SETTINGS = Settings(sensor=8.0, field=1.2, around=0, kinds=("letters", "beads", "texture"), exposures=(3000,), rays=200)
STEPS = (4, 12)
# Rays of a voxel to each lens, and voxels along a side that share them.
RAYS, SHARED = 120, 3
# Terms, and whether more is better. What depends on the layout alone, or is a limit, is left out.
BETTER = {
    "width_per_light_um": -1,
    "psf_width_um": -1,
    "encircled_radius_um": -1,
    "blur_um": -1,
    "light_percent": 1,
    "lateral_resolution_um": -1,
    "axial_resolution_um": -1,
    "lenses_per_point": 1,
    "occupancy": -1,
    "volume_error": -1,
}


def random_design(seed: int) -> Design:
    """A device that could be made, in focus or nearly."""
    rng = np.random.default_rng(seed)
    side, pitch = rng.choice(["plano", "curved"]), rng.uniform(1.0, 1.5)
    conic = rng.uniform(-1.2, 0.3) * rng.integers(0, 2)
    radius, thickness = rng.uniform(1.0, 2.2), 1 / 1.43
    focal = radius / 0.43
    # The paraxial image of 20.5 mm, and where the plate is.
    far, behind = (20.5, thickness) if side == "curved" else (20.5 + thickness, 0.0)
    distance = rng.uniform(0.8, 1.2) * focal * far / (far - focal) - behind
    diameter = min(np.exp(rng.uniform(np.log(0.3), np.log(1.9))), 1.5 * radius)
    width = 20.0 * pitch / 1.23
    if rng.integers(0, 4):
        centers = random_layout(
            200, (width, width), pitch=pitch, pitch_sd=rng.uniform(0.05, 0.1) * pitch, diameter=None, seed=seed
        )
    else:
        centers = hexagonal_layout((width, width), pitch=pitch)
    lens = {"orientation": str(side), "conic_constant": float(conic)}
    lens |= {"radius_of_curvature_mm": radius, "aperture_diameter_mm": float(diameter)}
    array = {"centers_mm": np.asarray(centers), "size_mm": (width, width)}
    design = geomscope().replace(**lens, **array, sensor_distance_mm=float(min(distance, 6.0)))
    return design.model_copy(update={"name": RANDOM[seed], "provenance": {}})


def binning_of(imager: Imager) -> int:
    """Pixels along a side that are summed: as wide as a voxel, as the package's solvers do."""
    width = float(imager.magnification(SETTINGS.depths).mean()) * VOXEL / float(imager.sensor.pixel_pitch)
    return max(1, int(width + 0.02))


def system(imager: Imager) -> sp.csr_matrix:
    """Adjoint of the imaging of voxels, `(voxel, pixel)`; a voxel is a pyramid two voxels wide, as in `rasterize`."""
    grid, pixel = SETTINGS.grid, float(imager.sensor.pixel_pitch) * binning_of(imager)
    side = imager.sensor.shape[0] // binning_of(imager)
    x, y = np.asarray(grid.x, float), np.asarray(grid.y, float)
    tiles = [range(first, min(first + SHARED, len(x))) for first in range(0, len(x), SHARED)]
    rng, shape = np.random.default_rng(1), grid.volume_shape
    places = [(x[list(b)].mean(), y[list(a)].mean(), z) for z in np.asarray(grid.depths) for a in tiles for b in tiles]
    landed, magnification = bundles(np.array(places), imager, RAYS)
    count = landed.shape[1] * RAYS
    columns = np.zeros((np.prod(shape), count), np.int32)
    values = np.zeros(columns.shape, np.float32)
    for number, (depth, a, b) in enumerate(product(range(shape[0]), tiles, tiles)):
        land = landed[number].reshape(-1, 3)
        for row, column in product(a, b):
            away = np.array([x[column], y[row]]) - places[number][:2]
            within = VOXEL * (rng.random((2, count, 2)).sum(0) - 1)
            at = land[:, :2] - magnification[number] * (away + within)
            pixels = np.floor(at / pixel + side / 2).astype(np.int32)
            inside = ((pixels >= 0) & (pixels < side)).all(1)
            voxel = np.ravel_multi_index((depth, row, column), shape)
            columns[voxel] = np.where(inside, pixels[:, 1] * side + pixels[:, 0], 0)
            values[voxel] = np.where(inside, land[:, 2], 0)
    starts = np.arange(len(columns) + 1) * count
    return sp.csr_matrix((values.ravel(), columns.ravel(), starts), (len(columns), side * side))


def richardson_lucy(
    adjoint: sp.csr_matrix, transfer: np.ndarray, images: np.ndarray, noise: float
) -> dict[int, np.ndarray]:
    """Volumes `(voxel, image)` after each number of steps; Gaussian noise counts as light that is known.

    `transfer` is that of diffraction, at the frequencies of `rfft2`.
    """

    def diffracted(columns):
        square = columns.reshape(transfer.shape[0], -1, columns.shape[1])
        spectra = np.fft.rfft2(square, axes=(0, 1)) * transfer[..., None]
        return np.fft.irfft2(spectra, square.shape[:2], axes=(0, 1)).reshape(columns.shape).astype(np.float32)

    seen = adjoint @ np.ones((len(images), 1), np.float32)
    seen = np.maximum(seen, 0.1 * seen.mean())
    x = np.ones((len(seen), images.shape[1]), np.float32) * images.sum(0) / seen.sum()
    volumes = {}
    for number in range(1, max(STEPS) + 1):
        ratio = np.maximum(images + noise, 0) / (np.maximum(diffracted(adjoint.T @ x), 0) + noise)
        x = x * np.maximum(adjoint @ diffracted(ratio.astype(np.float32)), 0) / seen
        if number in STEPS:
            volumes[number] = x
    return volumes


def judged(imager: Imager, brightest: Callable[[str, int], float], draws=(0, 1)) -> dict[str, list[float]]:
    """PSNR of each kind of scene, one for each draw, with the best number of steps."""
    small, grid, side = device(imager, SETTINGS), SETTINGS.grid, binning_of(imager)
    adjoint, cases, images, truths = system(small), [], [], []
    for draw in draws:
        for kind in SETTINGS.kinds:
            scene = make_scene(kind, draw, SETTINGS)
            clean = image_of(scene, small, SETTINGS) * (SETTINGS.exposures[0] / brightest(kind, draw))
            rng = np.random.default_rng(draw)
            image = rng.poisson(clean) + rng.normal(0, READ_NOISE, clean.shape)
            cases.append(kind)
            images.append(sum_pixels(image, side).ravel().astype(np.float32))
            truths.append(np.asarray(rasterize(scene.emitters, grid), np.float32))
    rows = small.sensor.shape[0] // side
    transfer = diffraction_transfer(small, (rows, rows), side * float(small.sensor.pixel_pitch))
    volumes_by_steps = richardson_lucy(adjoint, transfer, np.stack(images, 1), (side * READ_NOISE) ** 2)
    records: dict[str, list[float]] = {kind: [] for kind in SETTINGS.kinds}
    for number, (kind, truth) in enumerate(zip(cases, truths, strict=True)):
        volumes = (x[:, number].reshape(grid.volume_shape) for x in volumes_by_steps.values())
        records[kind].append(max(quality(volume, truth).psnr_db for volume in volumes))
    return records


def term_of(name: str, imager: Imager) -> float:
    """A term's worst value over its entries."""
    at = Conditions(np.linspace(*SETTINGS.span, 3))
    values = np.ravel(eqx.filter_jit(TERMS[name].function)(imager, at))
    return float(values.min() if BETTER[name] > 0 else values.max())


def correlation(a: np.ndarray, b: np.ndarray) -> tuple[float, float, float]:
    """Spearman's correlation, and its 95 % interval by a bootstrap over designs."""
    rng = np.random.default_rng(0)
    drawn = [spearman(a[i], b[i]) for i in rng.integers(0, len(a), (2000, len(a)))]
    low, high = np.nanquantile(drawn, (0.025, 0.975))
    return spearman(a, b), float(low), float(high)


def spearman(a: np.ndarray, b: np.ndarray) -> float:
    """Correlation of ranks."""
    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])


def report(designs: list[Path], records: Path, progress: Progress) -> Report:
    jax.config.update("jax_enable_x64", True)
    # Refuse what is wrong before random designs are made.
    given = designs_by_name(designs, (*NAMED, *RANDOM))
    kept = read_records(records, "images", IMAGES[SETTINGS.images], {"bright": {}, "found": {}})
    make_folder(records.parent)
    named = {name: read_design(design_file(name)) for name in NAMED}
    ranked = named | {name: random_design(seed) for seed, name in enumerate(RANDOM)}
    reference = device(named[NAMED[0]].imager(), SETTINGS)

    def brightest(kind: str, draw: int) -> float:
        if (key := f"{kind} {draw}") not in kept["bright"]:
            kept["bright"][key] = float(image_of(make_scene(kind, draw, SETTINGS), reference, SETTINGS).max())
        return kept["bright"][key]

    imagers = {name: design.imager() for name, design in (ranked | given).items()}
    by_name = {name: kept["found"].setdefault(mark(name, imager), {}) for name, imager in imagers.items()}
    for name, imager in progress.track(list(imagers.items()), "Designs"):
        if "psnr_db" not in by_name[name]:
            by_name[name]["psnr_db"] = judged(imager, brightest)
            write_json(records, kept)
    for term, name in progress.track(list(product(BETTER, ranked)), "Terms"):
        values = by_name[name].setdefault("terms", {})
        if term not in values:
            values[term] = term_of(term, imagers[name])
            write_json(records, kept)
    return shown(*({name: by_name[name] for name in names} for names in (ranked, (*named, *given))))


def mean_psnr(records: dict[str, Any]) -> np.ndarray:
    """Mean PSNR over the kinds of scenes `(design, draw)`, dB."""
    return np.array([np.mean(list(r["psnr_db"].values()), axis=0) for r in records.values()])


def shown(by_name: dict[str, Any], named: dict[str, Any]) -> Report:
    """Tables of correlations with the judge, and of the judge's means of designs that have a name."""
    means = mean_psnr(by_name)
    judge = means.mean(1)
    better = np.argsort(-judge)[: len(judge) // 2]
    cell = lambda a, b: "{:.2f} ({:.2f} to {:.2f})".format(*correlation(a, b))
    both = lambda a, b: (cell(a, b), cell(a[better], b[better]))
    values = {name: sign * np.array([r["terms"][name] for r in by_name.values()]) for name, sign in BETTER.items()}
    names = sorted(BETTER, key=lambda name: -spearman(judge, values[name]))
    rows = [["the judge's repeat", *both(means[:, 0], means[:, 1])]]
    rows += [[f"`{name}`", *both(judge, values[name])] for name in names]
    columns = ("objective", f"all {len(judge)} designs", "the better half")
    means = [[name, f"{psnr:.1f}"] for name, psnr in zip(named, mean_psnr(named).mean(1), strict=True)]
    of_named = ("design", "the judge's mean PSNR, dB"), means
    return tables_report("design_ranks", by_name, (columns, rows), of_named)


if __name__ == "__main__":
    records = {"type": Path, "default": Path("out/design_ranks/records.json")}
    main(report, {"designs": {"type": Path, "nargs": "*"}, "--records": records})
