"""Volumes by three lens designs: scenes at three depths, imaged with equal exposure.

Letters, beads and snowflakes at 18.5, 20.5 and 22.5 mm are imaged by `experiments/ray_tracer.py`, which shares no code
with `gs_jax`, on the sensor's own pixels. Photon and read noise are those of one exposure time for all designs, so
small apertures have more noise. Volumes are reconstructed by Richardson-Lucy with the full model, and scored after the
best gain against the scene on the voxels, both unblurred and with both blurred laterally by one voxel (standard
deviation), which forgives errors finer than that.

    python -m experiments.lens_scenes [--out DIR]

Writes `lens_scenes.json`, `lens_scenes.md` and `lens_scenes.png`; about twenty minutes on two cores.
"""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from experiments.common import Report, design_file, main, table
from experiments.ray_tracer import traced
from gs_jax import Grid, Imager, RichardsonLucy, Sensor, reconstruct
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.base.progress import Progress
from gs_jax.design.design import read_design
from gs_jax.lenses import EACH
from gs_jax.metrics import quality
from gs_jax.simulation.phantoms import letters, random_points, rasterize, snowflake

DESIGNS = ("geomscope", "geomscope-optimized", "geomscope-asphere")
DEPTHS = (18.5, 20.5, 22.5)
# Position and size of each depth's part of a scene, mm.
PLACES, HEIGHT = ((-1.2, -0.5), (0.0, 0.9), (1.2, -0.5)), 1.1
# Pixels of the cropped sensor, distance of the lenses from the axis, and voxels and width of the volume, mm. Voxels are
# as wide as the target resolution of the designs; narrower than a pixel in the object, they would fit noise.
PIXELS, REACH, VOXEL, FIELD = 2560, 6.5, 0.04, 4.4
# Sampled emitters of a scene, and rays from each to each lens.
SAMPLES, RAYS = 60_000, 12
# Electrons of the brightest pixel of `geomscope`'s capture (the exposures), and of read noise.
EXPOSURES, READ_NOISE = (20_000, 1_000), 2.0
STEPS = 20


def cropped(imager: Imager, pixels: int = PIXELS, reach: float = REACH) -> Imager:
    """The middle of a sensor, and the lenses near it."""
    centers = np.asarray(imager.array.centers)
    near = np.hypot(*centers.T) < reach
    own = {name: value[near] for name in EACH if (value := np.asarray(getattr(imager.array, name))).ndim}
    array = dataclasses.replace(imager.array, centers=centers[near], **own)
    sensor = Sensor((pixels, pixels), imager.sensor.pixel_pitch)
    return eqx.tree_at(lambda i: (i.array, i.sensor), imager, (array, sensor))


def scenes() -> dict[str, np.ndarray]:
    """Dense emitters `(x, y, z, intensity)` of each scene."""
    at = lambda part, xy: part + np.array([*xy, 0.0, 0.0])
    places = list(zip(DEPTHS, PLACES, strict=True))
    words = [at(letters(a, depth=z, height=HEIGHT, pitch=0.008), xy) for a, (z, xy) in zip("GSJ", places, strict=True)]
    flakes = [at(snowflake((z, z), 1.7, width=0.12, pitch=0.01), xy) for z, xy in places]
    middles = [random_points(15, (FIELD - 0.6, FIELD - 0.6), (z, z + 1e-6), seed=k) for k, z in enumerate(DEPTHS)]
    # A bead is a disc, 60 um wide.
    r, turn = 0.03 * np.sqrt((np.arange(60) + 0.5) / 60), np.arange(60) * np.pi * (3 - 5**0.5)
    disc = np.stack([r * np.cos(turn), r * np.sin(turn), 0 * r, 0 * r], -1)
    beads = (np.concatenate(middles)[:, None] + disc).reshape(-1, 4)
    beads[:, 2] = np.repeat(DEPTHS, 15 * 60)
    return {"letters": np.concatenate(words), "beads": beads, "snowflakes": np.concatenate(flakes)}


def sampled(emitters: np.ndarray, count: int, blur: float = 0.004) -> np.ndarray:
    """Draw emitters in proportion to their brightness, each with a small displacement, so that they form no lattice.

    They are drawn evenly along rows of the scene. Random draws would put their own unevenness into all images of a
    scene, which would limit the volumes.
    """
    rng = np.random.default_rng(0)
    rows = emitters[np.lexsort((emitters[:, 0], emitters[:, 1], emitters[:, 2]))]
    share = np.cumsum(rows[:, 3]) / rows[:, 3].sum()
    some = rows[np.minimum(np.searchsorted(share, (np.arange(count) + 0.5) / count), len(rows) - 1)]
    some[:, :2] += rng.uniform(-blur, blur, (count, 2))
    some[:, 3] = 1 / count
    return some


def run(names=DESIGNS, *, samples: int = SAMPLES, rays: int = RAYS, progress: Progress, **sizes: Any) -> dict[str, Any]:
    """Return for each scene the truth, and for each design and exposure scores and the volume."""
    count = round(FIELD / VOXEL) | 1
    grid = Grid(DEPTHS, (count, count), VOXEL)
    imagers = {name: cropped(read_design(design_file(name)).imager(), **sizes) for name in names}
    results: dict[str, Any] = {}
    for scene, emitters in scenes().items():
        truth = np.asarray(rasterize(emitters, grid), np.float32)
        some = sampled(emitters, samples)
        each = progress.track(imagers.items(), f"Tracing {scene}")
        clean = {name: traced(some, imager, rays) for name, imager in each}
        results[scene] = {"truth": truth, "empty": scores(np.zeros_like(truth), truth)}
        for exposure in EXPOSURES:
            time = exposure / clean[names[0]].max()
            for name, imager in imagers.items():
                rng = np.random.default_rng(exposure)
                image = rng.poisson(time * clean[name]) + rng.normal(0, READ_NOISE, clean[name].shape)
                volume = reconstruct(image.astype(np.float32), imager, grid, RichardsonLucy(STEPS), progress=progress)
                record = scores(np.asarray(volume), truth) | {"electrons": float(time * clean[name].sum())}
                results[scene][f"{name}, {exposure}"] = record | {"volume": quality(volume, truth).gain * volume}
    return results


def scores(volume: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """PSNR and SSIM unblurred, and PSNR with both blurred laterally by a voxel."""
    as_it_is, blurred = quality(volume, truth), quality(*(gaussian_filter(x, (0, 1, 1)) for x in (volume, truth)))
    return {"psnr_db": as_it_is.psnr_db, "ssim": as_it_is.ssim, "blurred_psnr_db": blurred.psnr_db}


def pictures(results: dict[str, Any], names=DESIGNS) -> Figure:
    """Plot maxima over the depths of the truth and of each volume at the longer exposure, on one scale per scene."""
    figure = Figure(figsize=(2.6 * (len(names) + 1), 2.8 * len(results)), dpi=100, layout="constrained")
    axes = figure.subplots(len(results), len(names) + 1, squeeze=False)
    for row, parts in zip(axes, results.values(), strict=True):
        shown = {"truth": parts["truth"]} | {name: parts[f"{name}, {EXPOSURES[0]}"]["volume"] for name in names}
        for axis, (name, volume) in zip(row, shown.items(), strict=True):
            extent = (-FIELD / 2, FIELD / 2, FIELD / 2, -FIELD / 2)
            axis.imshow(volume.max(0), cmap="gray", vmin=0, vmax=parts["truth"].max(), extent=extent)
            psnr = "" if name == "truth" else f", {parts[f'{name}, {EXPOSURES[0]}']['psnr_db']:.1f} dB"
            axis.set_title(f"{name}{psnr}", fontsize=8)
            axis.tick_params(labelsize=7)
    for axis in axes[-1]:
        axis.set_xlabel("x, mm", fontsize=8)
    for axis, scene in zip(axes[:, 0], results, strict=True):
        axis.set_ylabel(f"{scene}\ny, mm", fontsize=8)
    return figure


def _cell(record: dict[str, float]) -> str:
    return f"{record['psnr_db']:.1f} / {record['blurred_psnr_db']:.1f}"


def report(progress: Progress) -> Report:
    results = run(progress=progress)
    columns = ("scene", "exposure, electrons", *DESIGNS, "empty")
    rows = []
    for scene, parts in results.items():
        for exposure in EXPOSURES:
            cells = [_cell(parts[f"{name}, {exposure}"]) for name in DESIGNS]
            rows.append([scene, f"{exposure}", *cells, _cell(parts["empty"])])
    numbers = {
        scene: {
            key: {k: v for k, v in part.items() if k != "volume"} if isinstance(part, dict) else part
            for key, part in parts.items()
            if key != "truth"
        }
        for scene, parts in results.items()
    }
    files = {"lens_scenes.json": numbers, "lens_scenes.md": markdown_table(columns, rows)}
    return Report(files | {"lens_scenes.png": pictures(results)}, [table(columns, rows)])


if __name__ == "__main__":
    main(report)
