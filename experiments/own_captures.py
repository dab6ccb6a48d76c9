"""Focus and weights fitted to a microscope's own captures, without a truth, if it is not as designed.

`ray_tracer.py` images words between 18 and 23 mm by lenses whose radii are 2 % larger than the design says, on an array
that is tilted by 0.3 degrees, which the design does not know: 512 x 512 pixels of 9 um, 3000 electrons. Five captures
are those of `gs-jax train --from-captures`, which fits one factor of all radii and then trains on; the truth of three
others, which it never sees, scores what it began and ended with: PSNR in dB above an empty volume, both blurred by a
voxel, with each emitter on its nearest plane and shared by two. For comparison, the shipped weights with the device's
true radii and tilt.

Factors are also fitted to captures of a device as designed; and to letters, a target and points of DATA, by another ray
tracer, with a design that has their radii, and 0.98 of them.

    python -m experiments.own_captures [DATA] [--design geomscope] [--steps 40] [--out DIR]

Writes `own_captures.md` and `own_captures.json`; about ten minutes on two cores, with DATA thirty.
"""

import dataclasses
import time
from pathlib import Path

import numpy as np

from experiments.common import OPTIONAL_PATH, Report, main, table
from experiments.surfaces import DEPTHS, PITCH, STEP, VOXEL, Emitters, capture, device, gain, noisy
from gs_jax import Grid, Imager, Unrolled, rasterize, read_capture, read_design
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.apps.fine_tuning import fine_tune
from gs_jax.base.progress import Progress
from gs_jax.reconstruction.pipeline import PIXELS_PER_VOXEL, Reconstructor, voxel_grid
from gs_jax.reconstruction.radius_fit import RadiusFit, fit_radius, with_radii
from gs_jax.simulation.phantoms import letters

PIXELS, ELECTRONS, TRAINED, SCORED = 512, 3000, 5, 3
# Of the radii, and slopes of 0.3 degrees along a diagonal.
LARGER, SLOPE = 1.02, np.tan(np.radians(0.3)) / np.sqrt(2)
# Scenes of DATA, their depths, and the radii that its design is given, relative to the true ones.
SCENES, PLANES, GIVEN = "hfd", np.arange(18, 22.1, 0.5), (0.98, 1.0)


def as_made(known: Imager, larger: float = LARGER, slope: float = SLOPE) -> Imager:
    """The device as it is, not as it is known."""
    return dataclasses.replace(with_radii(known, larger), tilt=(slope, slope))


def words(seed: int, width: float) -> Emitters:
    """Six words of two letters at random places and depths."""
    rng, parts = np.random.default_rng(seed), []
    for _ in range(6):
        depth, height = rng.uniform(*DEPTHS), rng.uniform(0.5, 1.0)
        word = letters("".join(rng.choice(list("ABCDEFGHKMNPRSTXZ"), 2)), depth=depth, height=height, pitch=0.01)
        word[:, :2] += rng.uniform(-0.3 * width, 0.3 * width, 2)
        word[:, 3] *= rng.uniform(0.5, 1.5) / word[:, 3].sum()
        parts.append(word)
    return np.concatenate(parts)


def truths(emitters: Emitters, grid: Grid) -> list[np.ndarray]:
    """The scene with each emitter on its nearest plane, and shared by two."""
    planes, nearest = np.asarray(grid.depths), emitters.copy()
    nearest[:, 2] = planes[np.abs(emitters[:, 2:3] - planes).argmin(1)]
    return [np.asarray(rasterize(some, grid), np.float32) for some in (nearest, emitters)]


def run(design: str, steps: int, *, pixels: int = PIXELS, trained=TRAINED, scored=SCORED, progress: Progress) -> dict:
    """Gains of each scored scene, `(nearest, shared)`, by each pair of weights and device; factors of the radii."""
    known = device(design, pixels)
    made, width = as_made(known), pixels * PITCH
    grid = Grid.over(known.sensor, depths=np.arange(DEPTHS[0], DEPTHS[1] + 0.01, STEP), pitch=VOXEL)
    image = lambda seed, imager: noisy(capture(words(seed, width), imager), ELECTRONS)
    traced = lambda imager: [image(seed, imager) for seed in progress.track(range(trained), "Tracing")]
    images, start = traced(made), Unrolled.pretrained()
    began = time.monotonic()
    radius = fit_radius(images, known, grid, start, progress=progress)
    found = fine_tune(images, radius.imager, grid, start, steps=steps, progress=progress)
    seconds, gains = time.monotonic() - began, {}
    unseen = [(image(seed, made), truths(words(seed, width), grid)) for seed in range(100, 100 + scored)]
    for name, imager, networks in (
        ("as designed", known, start),
        ("radii fitted", radius.imager, start),
        ("and weights trained on", radius.imager, found.networks),
        ("radii and tilt known", made, start),
    ):
        volume_of = Reconstructor(imager, grid, networks, progress=progress)
        gains[name] = [[gain(volume_of(each, progress), truth) for truth in both] for each, both in unseen]
    control = fit_radius(traced(known), known, grid, start, progress=progress)
    fits = [fitted(design, LARGER, radius), fitted(design, 1.0, control)]
    return {"gains_db": gains, "seconds": seconds, "loss": found.losses, "held_out": found.held_out, "fits": fits}


def of_another_tracer(data: Path, progress: Progress) -> list[dict]:
    """Fits to whole captures, with a design of wrong radii and of right ones."""
    true, fits = read_design(data / "P1.toml").imager(), []
    images = [read_capture(data / f"P1_{scene}.tif", true.sensor.shape) for scene in SCENES]
    for given in GIVEN:
        known = with_radii(true, given)
        grid = voxel_grid(known, PLANES.tolist(), pixels=PIXELS_PER_VOXEL)
        found = fit_radius(images, known, grid, Unrolled.pretrained(), progress=progress)
        fits.append(fitted("another ray tracer's", 1 / given, found))
    return fits


def fitted(lenses: str, true: float, fit: RadiusFit) -> dict:
    """The true factor, the one with the smallest error and the one that is taken, and errors."""
    best, error = min(fit.trials, key=lambda trial: trial[1])
    errors = {"error": error, "as_known": dict(fit.trials)[1.0], "trials": fit.trials}
    return {"lenses": lenses, "true": true, "best": best, "taken": fit.factor} | errors


def report(data: Path | None, design: str, steps: int, progress: Progress) -> Report:
    results = run(design, steps, progress=progress)
    results["fits"] += of_another_tracer(data, progress) if data else []
    columns = ("device", "nearest plane, dB", "mean", "shared by two, dB", "mean")
    rows = []
    for name, found in results["gains_db"].items():
        nearest, shared = np.array(found).T
        each = lambda values: (", ".join(f"{v:.1f}" for v in values), f"{np.mean(values):.2f}")
        rows.append([name, *each(nearest), *each(shared)])
    names = ("lenses", "true factor", "best factor", "taken", "error there", "as known")
    fits = [
        [fit["lenses"], *(f"{fit[key]:.3f}" for key in ("true", "best", "taken", "error", "as_known"))]
        for fit in results["fits"]
    ]
    text = f"# Own captures\n\n{markdown_table(columns, rows)}\n\n{markdown_table(names, fits)}\n"
    tables = [table(columns, rows), table(names, fits)]
    return Report({"own_captures.json": results, "own_captures.md": text}, tables)


if __name__ == "__main__":
    arguments = {"--design": {"default": "geomscope"}, "--steps": {"type": int, "default": 40}}
    main(report, {"data": OPTIONAL_PATH} | arguments)
