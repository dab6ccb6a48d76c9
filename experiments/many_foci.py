"""Whether lenses of several foci on one plate pay: the best of one, two and three kinds, by the same search.

What is minimised is the error of the best linear estimate of a volume (`gs_jax.codesign.linear_error`): transfer
functions of exact rays, light, shot and read noise at equal exposure, and parallax. Free are the sensor distance, the
radius of curvature and the aperture of each kind, up to what a mask leaves of the nearest neighbours. Kinds are
interleave so that neighbours differ (`kinds` of a study), and start from what one kind came to, their radii spread.
Over 18 to 23 mm, and over a longer span, where one focus has to be a compromise. Each is done for several layouts of
the same statistics, the same for all numbers of kinds; gains are of pairs, with intervals by Student's t over the
layouts. What was found for the first layout is then judged by what it was not found by: letters at three depths of the
span, imaged by `experiments/ray_tracer.py` with the camera's noise, and reconstructed by Richardson-Lucy with the full
model.

    python -m experiments.many_foci [--out DIR] [--layouts N]

Writes `many_foci.json` and `many_foci.png`; three quarters of an hour on a core, by what a part of it took.
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from experiments import lens_scenes
from experiments.common import Report, main, table
from experiments.ray_tracer import traced
from gs_jax import Grid, RichardsonLucy, random_layout, reconstruct, run_study
from gs_jax.base.progress import Progress
from gs_jax.codesign.study import Study
from gs_jax.design.builtin import geomscope
from gs_jax.design.design import Design
from gs_jax.simulation.phantoms import letters, rasterize

# Ends of the depths, mm, and planes that are told apart.
SPANS = {"18 to 23 mm": ((18.0, 23.0), 3), "15 to 30 mm": ((15.0, 30.0), 4)}
KINDS = (1, 2, 3)
# Of the layout, mm: lenses, plate, pitch, and what a mask needs between apertures.
LENSES, PLATE, PITCH, WEB = 200, 17.1, 1.05, 0.1
CONIC = -0.7
BOUNDS = {"sensor_distance_mm": (2.0, 6.0), "radius_of_curvature_mm": (1.0, 3.0), "aperture_diameter_mm": (0.2, 2.0)}
# Of v, R and D, mm.
START = (2.95, 1.34, 0.75)
STEPS = 60
_OF_KINDS = ("radius_of_curvature", "aperture_diameter")
# Of the letters: emitters, and electrons of all of an emitter's light, that brightest pixels have some thousands of.
_SAMPLES, _ELECTRONS = 200_000, 2e10


def start(seed: int, lenses: int) -> Design:
    """Conics with their curved side to the object, at random on the paper's camera, as dense however many they are."""
    side = PLATE * (lenses / LENSES) ** 0.5
    centers = np.asarray(random_layout(lenses, (side, side), pitch=PITCH, pitch_sd=0.08, seed=seed))
    v, radius, diameter = START
    data = geomscope().model_dump()
    data["lens"] |= {"orientation": "curved", "conic_constant": CONIC}
    data["lens"] |= {"radius_of_curvature_mm": radius, "aperture_diameter_mm": diameter}
    data["array"] |= {"centers_mm": tuple(map(tuple, centers.tolist())), "size_mm": (side, side)}
    data["imaging"] |= {"sensor_distance_mm": v}
    return Design.model_validate(data | {"provenance": {}})


def study_of(span: tuple[float, float], planes: int, kinds: int, steps: int) -> Study:
    """The least error of volumes, with a mask between the apertures."""
    return Study.model_validate(
        {
            "depths_mm": span,
            "depth_count": planes,
            "kinds": kinds,
            "free": BOUNDS,
            "terms": [
                {"name": "volume_error", "minimise": 0.1},
                {"name": "web_mm", "at_least": WEB, "weight": 30.0},
            ],
            "stages": [{"solver": "bfgs", "steps": steps}],
        }
    )


def best(design: Design, study: Study) -> dict:
    """The least error, dB, and where."""
    end = run_study(design, study)
    return {"loss_db": 20 * float(np.log10(end.after[0].high)), "design": end.design}


def run(
    layouts: int, *, spans=SPANS, kinds=KINDS, lenses: int = LENSES, steps: int = STEPS, progress: Progress
) -> dict:
    """For each span and number of kinds what was found for each layout, and gains over one kind."""
    found: dict = {span: {k: [] for k in kinds} for span in spans}
    cases = [(span, seed, k) for span in spans for seed in range(layouts) for k in kinds]
    for span, seed, k in progress.track(cases, "Searches"):
        # Several also start where one ended: they cannot be worse by a local minimum alone.
        starts = [start(seed, lenses), *(end["design"] for end in found[span][1][seed:])]
        ends, planes = spans[span]
        tried = [best(design, study_of(ends, planes, k, steps)) for design in starts]
        found[span][k].append(min(tried, key=lambda end: end["loss_db"]))
    gains = {
        span: {
            k: gain([row["loss_db"] for row in each[1]], [row["loss_db"] for row in each[k]]) for k in kinds if k > 1
        }
        for span, each in found.items()
    }
    return {"found": found, "gains_db": gains}


def judged(
    design: Design, span: tuple[float, float], *, samples: int = _SAMPLES, progress: Progress
) -> dict[str, float]:
    """PSNR, dB, of letters that our tracer images with what was found for the first layout; as in `lens_scenes`."""
    imager, near = lens_scenes.cropped(design.imager()), (span[0], sum(span) / 2, span[1])
    parts = zip("GSJ", near, lens_scenes.PLACES, strict=True)
    words = [letters(a, depth=z, height=lens_scenes.HEIGHT, pitch=0.008) + [*xy, 0, 0] for a, z, xy in parts]
    emitters = np.concatenate(words)
    side = round(lens_scenes.FIELD / lens_scenes.VOXEL) | 1
    grid = Grid(near, (side, side), lens_scenes.VOXEL)
    truth = np.asarray(rasterize(emitters, grid), np.float32)
    clean = traced(lens_scenes.sampled(emitters, samples), imager, lens_scenes.RAYS)
    rng = np.random.default_rng(0)
    # The same time for all: light is in shares of what an emitter sends out.
    image = rng.poisson(_ELECTRONS * clean) + rng.normal(0, lens_scenes.READ_NOISE, clean.shape)
    volume = reconstruct(image.astype(np.float32), imager, grid, RichardsonLucy(lens_scenes.STEPS), progress=progress)
    return lens_scenes.scores(np.asarray(volume), truth)


def gain(alike: Sequence[float], several: Sequence[float]) -> dict:
    """By how many dB the error is less, with its 95 % interval over the layouts."""
    less = np.subtract(alike, several)
    half = stats.t.ppf(0.975, len(less) - 1) * less.std(ddof=1) / len(less) ** 0.5 if len(less) > 1 else np.nan
    return {"mean": float(less.mean()), "interval": [float(less.mean() - half), float(less.mean() + half)]}


def picture(found: dict) -> Figure:
    """Error against the number of kinds, a line for each layout."""
    figure = Figure(figsize=(4.2 * len(found["found"]), 3.6), dpi=100, layout="constrained")
    for axes, (span, each) in zip(
        figure.subplots(1, len(found["found"]), squeeze=False).flat, found["found"].items(), strict=True
    ):
        for rows in zip(*each.values(), strict=True):
            axes.plot(list(each), [row["loss_db"] for row in rows], "o-", color="C0", alpha=0.6)
        axes.set(
            title=f"objects at {span}", xlabel="kinds of lenses", ylabel="error of the volume, dB", xticks=list(each)
        )
    return figure


def numbers_of(end: dict) -> dict[str, Any]:
    """Of what a search found, for a file."""
    lens = end["design"].lens
    ends = {name: sorted(set(np.ravel(getattr(lens, f"{name}_mm")).tolist())) for name in _OF_KINDS}
    return {"loss_db": end["loss_db"], "sensor_distance": end["design"].imaging.sensor_distance_mm} | ends


def report(layouts: int, progress: Progress) -> Report:
    with jax.enable_x64(True):
        found = run(layouts, progress=progress)
    found["letters"] = {
        span: {k: judged(each[k][0]["design"], SPANS[span][0], progress=progress) for k in KINDS}
        for span, each in found["found"].items()
    }
    figure, rows = picture(found), []
    for span, each in found["found"].items():
        for k, ends in each.items():
            each[k] = numbers = [numbers_of(end) for end in ends]
            radii = np.array([[least, most] for least, *_, most in (2 * end["radius_of_curvature"] for end in numbers)])
            means = [
                np.mean([np.mean(end[key]) for end in numbers]) for key in ("loss_db", "sensor_distance", *_OF_KINDS)
            ]
            means.append(np.mean(np.diff(radii) / radii.sum(1, keepdims=True)))
            more = found["gains_db"][span].get(k)
            said = "" if more is None else f"{more['mean']:.2f} [{more['interval'][0]:.2f}, {more['interval'][1]:.2f}]"
            rows.append([span, str(k), *(f"{mean:.3g}" for mean in means), said])
    columns = (
        "depths",
        "kinds",
        "error, dB",
        "v, mm",
        "R, mm",
        "D, mm",
        "spread of R",
        "gain over one kind, dB [95 %]",
    )
    return Report({"many_foci.json": found, "many_foci.png": figure}, [table(columns, rows)])


if __name__ == "__main__":
    main(report, {"--layouts": {"type": int, "default": 4}})
