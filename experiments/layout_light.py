"""Whether the ranking of layouts changes with the full model.

Co-design evaluates layouts with the near model: one PSF for all lenses, within the field radius, which has a tenth of
the light. Here a small microscope with several layouts of equally many lenses images random scenes with the near and
with the full model, with noise, and list-RL inverts each with the model that made it. Scenes lie on voxels half as
large, between the reconstructed planes. The score is the PSNR above that of an empty volume.

    python -m experiments.layout_light [--out DIR]

writes `layout_light.json` and `layout_light.md`; about six minutes on two cores.
"""

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common import Report, main, table
from gs_jax import (
    Camera,
    Grid,
    Imager,
    MicrolensArray,
    PinholeRichardsonLucy,
    Sensor,
    expose,
    forward,
    quality,
    reconstruct,
)
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.apps.training_data import (
    FIELD_RADIUS,
    SCENE_PLANES,
    CaptureSpec,
    random_scene,
    resample_scene,
    trace_optics,
)
from gs_jax.base.arrays import to_float32
from gs_jax.base.progress import Progress
from gs_jax.layouts import hexagonal_layout, poisson_disc_layout, random_layout, square_layout
from gs_jax.projection.forward_model import psf_model
from gs_jax.simulation.synthetic import electrons

SPEC = CaptureSpec(288, 0.018, 0.064, 7, binning=4)
DEPTHS = 20.0 + 0.5 * (np.arange(SPEC.planes) - SPEC.planes // 2)
LENSES, DISTANCE, STEPS = 20, 5.8, 12
LEVELS = ("near", "full")
_ELECTRONS = 5000 * SPEC.binning**2


def layouts() -> dict[str, np.ndarray]:
    """Layouts with equally many lenses, those nearest to the middle of a pattern; mm."""
    side, wide = 1.05 * SPEC.side, 2 * SPEC.side
    rng = np.random.default_rng(0)
    rows = np.repeat(np.cumsum([0, 0.9, 1.5, 1.0, 1.6, 0.9, 1.5]), 7)
    uneven = np.column_stack([np.tile(1.25 * np.arange(7), 7) + np.repeat(rng.uniform(0, 1.25, 7), 7), rows])
    made = {f"random, {seed}": random_layout(LENSES, (side, side), diameter=None, seed=seed) for seed in range(3)}
    made |= {
        "Poisson-disc": poisson_disc_layout((wide, wide), min_distance=1.05, seed=0),
        "hexagonal": hexagonal_layout((wide, wide), pitch=1.3),
        "square": square_layout((wide, wide), pitch=1.2),
        "uneven rows": uneven - uneven.mean(0),
    }
    nearest = lambda centers: centers[np.argsort(np.abs(centers).max(1), kind="stable")[:LENSES]]
    return {name: nearest(np.asarray(centers)) for name, centers in made.items()}


def run(names: list[str] | None = None, *, scenes: int = 6, steps: int = STEPS, progress: Progress) -> dict:
    """Return scores in dB by level and layout, one per scene; and Spearman's correlation of the two rankings."""
    chosen = {name: centers for name, centers in layouts().items() if names is None or name in names}
    gains = {level: {} for level in LEVELS}
    for name, centers in progress.track(chosen.items(), "Layouts"):
        for level in LEVELS:
            gains[level][name] = _gains(centers, level, scenes, steps)
    ranks = [np.argsort(np.argsort([np.mean(gain) for gain in gains[level].values()])) for level in LEVELS]
    return {"gain_db": gains, "rank_correlation": float(np.corrcoef(ranks[0], ranks[1])[0, 1])}


def _gains(centers: np.ndarray, level: str, scenes: int, steps: int) -> list[float]:
    sensor = Sensor((SPEC.pixels, SPEC.pixels), SPEC.pixel)
    imager = Imager(MicrolensArray(centers), sensor, DISTANCE, FIELD_RADIUS)
    between = np.linspace(DEPTHS[0] - 0.2, DEPTHS[-1] + 0.2, SCENE_PLANES)
    single = to_float32(imager)
    grid = to_float32(Grid.over(sensor, depths=DEPTHS, pitch=SPEC.pitch))
    fine = to_float32(Grid(between, tuple(2 * n for n in grid.shape), SPEC.pitch / 2))

    def optics(grid: Grid, depths: np.ndarray):
        return trace_optics(imager, depths, SPEC) if level == "full" else psf_model(single, grid, "near")

    of_scene, of_volume = optics(fine, between), optics(grid, np.asarray(DEPTHS))
    results = []
    for number in range(scenes):
        scene = random_scene(fine.shape, np.random.default_rng(number))
        image = jnp.maximum(forward(scene, single, fine, of_scene), 0)
        camera = Camera(gain=10.0 * SPEC.binning**2, read_noise=2.0 * SPEC.binning)
        counts = expose(image, camera, jax.random.key(number), peak_electrons=_ELECTRONS)
        light = np.asarray(electrons(counts, camera), np.float32)
        volume = reconstruct(light, single, grid, PinholeRichardsonLucy(steps, accelerate=True), optics=of_volume)
        truth = resample_scene(scene, between, DEPTHS)
        results.append(quality(volume, truth).psnr_db - quality(np.zeros_like(truth), truth).psnr_db)
    return results


def report(progress: Progress) -> Report:
    results = run(progress=progress)
    columns = ("layout", *(f"gain over empty, {level}, dB" for level in LEVELS))
    rows = [[name, *(f"{np.mean(results['gain_db'][level][name]):.2f}" for level in LEVELS)] for name in layouts()]
    text = markdown_table(columns, rows) + f"\nSpearman's rank correlation: {results['rank_correlation']:.2f}\n"
    return Report({"layout_light.json": results, "layout_light.md": text}, [table(columns, rows), text])


if __name__ == "__main__":
    main(report)
