"""Radii and the unrolled inversion's weights by a microscope's own captures, without a truth, if it is not as designed.

`ray_tracer.py` images words between 18 and 23 mm by lenses whose radii are 2 % larger than the design says, on an array
that is tilted by 0.3 degrees, which the design does not know: 512 x 512 pixels of 9 um, 3000 electrons. Five captures
are those of `gs-jax train --from-captures`, which fits one factor of all radii and then trains on; the truth of three
others, which it never sees, scores what it began and ended with: PSNR in dB above an empty volume, both blurred by a
voxel, with each emitter on its nearest plane and shared by two. For comparison, the shipped weights with the device's
true radii and tilt, and the factor that is found by captures of a device as designed.

    python -m experiments.own_captures [--design geomscope] [--steps 40] [--out DIR]

Writes `own_captures.md` and `own_captures.json`; about fifteen minutes on two cores.
"""

import dataclasses
import time

import numpy as np

from experiments.common import Report, main, table
from experiments.surfaces import DEPTHS, PITCH, STEP, VOXEL, Emitters, capture, device, gain, noisy
from gs_jax import Grid, Imager, Unrolled, rasterize
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.apps.training.from_captures import fine_tune
from gs_jax.base.progress import Progress
from gs_jax.reconstruction.pipeline import reconstructor
from gs_jax.reconstruction.radius_fit import fit_radius
from gs_jax.simulation.phantoms import letters

PIXELS, ELECTRONS, TRAINED, SCORED = 512, 3000, 5, 3
# Of the radii, and slopes of 0.3 degrees along a diagonal.
LARGER, SLOPE = 1.02, np.tan(np.radians(0.3)) / np.sqrt(2)
FITS = {"trials": "2 % larger", "as_designed": "as designed"}


def as_made(known: Imager, larger: float = LARGER, slope: float = SLOPE) -> Imager:
    """The device as it is, not as it is known."""
    array = dataclasses.replace(known.array, radius_of_curvature=known.array.radius_of_curvature * larger)
    return dataclasses.replace(known, array=array, tilt=(slope, slope))


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
        volume_of = reconstructor(imager, grid, networks, progress=progress)
        gains[name] = [[gain(volume_of(each, progress), truth) for truth in both] for each, both in unseen]
    control = fit_radius(traced(known), known, grid, start, progress=progress)
    factors = {"factor": radius.factor, "trials": radius.trials, "as_designed": control.trials}
    return {"gains_db": gains, "seconds": seconds, "loss": found.losses, "held_out": found.held_out} | factors


def report(design: str, steps: int, progress: Progress) -> Report:
    results = run(design, steps, progress=progress)
    columns = ("device", "nearest plane, dB", "mean", "shared by two, dB", "mean")
    rows = []
    for name, found in results["gains_db"].items():
        nearest, shared = np.array(found).T
        each = lambda values: (", ".join(f"{v:.1f}" for v in values), f"{np.mean(values):.2f}")
        rows.append([name, *each(nearest), *each(shared)])
    errors = {name: (dict(results[name])[1.0], *min((e, f) for f, e in results[name])) for name in FITS}
    words = [f"{FITS[name]}: {best:.3f} at {at:.4f}, {one:.3f} at 1" for name, (one, best, at) in errors.items()]
    said = f"Error of prediction by the factor of the radii. {'; '.join(words)}. {results['factor']:.4f} is used."
    text = f"# Trained on by one's own captures\n\n{markdown_table(columns, rows)}\n\n{said}\n"
    return Report({"own_captures.json": results, "own_captures.md": text}, [table(columns, rows), said])


if __name__ == "__main__":
    main(report, {"--design": {"default": "geomscope"}, "--steps": {"type": int, "default": 40}})
