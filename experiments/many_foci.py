"""Whether lenses of several foci on one plate pay: the best of one, two and three lens types, by the same search.

The search minimises the error of the best linear estimate of a volume (`volume_error`): transfer functions of exact
rays, light, shot and read noise at equal exposure, and parallax. Free are the sensor distance, and the radius of
curvature and aperture of each type, up to what a mask leaves of the nearest neighbours. Types are interleaved so that
neighbours differ (`types` of a study), and start from the result for one type, with their radii spread. The spans are
18 to 23 mm and a longer one, over which one focus is a compromise. Each search runs for several layouts of the same
statistics, the same for all numbers of types; gains are paired, with intervals by Student's t over the layouts. The
result for the first layout is then tested on a task that was not optimised: letters at three depths of the span, imaged
by `experiments/ray_tracer.py` with camera noise, and reconstructed by Richardson-Lucy with the full model.

    python -m experiments.many_foci [--out DIR] [--layouts N]

Writes `many_foci.json` and `many_foci.png`; about three quarters of an hour on a core.
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from scipy import stats
from scipy.ndimage import gaussian_filter

from experiments.common import Report, cropped, main, table
from experiments.ray_tracer import traced
from gs_jax import Grid, RichardsonLucy, quality, random_layout, reconstruct, run_study
from gs_jax.base.progress import Progress
from gs_jax.codesign.study import Study
from gs_jax.design.design import Design
from gs_jax.design.start import geomscope
from gs_jax.simulation.phantoms import letters, rasterize

# Ends of the depths, mm, and planes to be resolved.
SPANS = {"18 to 23 mm": ((18.0, 23.0), 3), "15 to 30 mm": ((15.0, 30.0), 4)}
KINDS = (1, 2, 3)
# Layout: lenses, plate, pitch, and width of the mask between apertures; mm.
LENSES, PLATE, PITCH, WEB = 200, 17.1, 1.05, 0.1
CONIC = -0.7
BOUNDS = {"sensor_distance_mm": (2.0, 6.0), "radius_of_curvature_mm": (1.0, 3.0), "aperture_diameter_mm": (0.2, 2.0)}
# Bounds of v, R and D, mm.
START = (2.95, 1.34, 0.75)
STEPS = 60
_OF_KINDS = ("radius_of_curvature", "aperture_diameter")
# Letters: number of emitters, and electrons of all light of an emitter; the brightest pixels have some thousands.
_SAMPLES, _ELECTRONS, _READ_NOISE, _RAYS = 200_000, 2e10, 2.0, 12
# Position and size of each depth's letter; voxels and width of the volume; pixels of the cropped sensor, and distance
# of the lenses from the axis; mm.
_PLACES, _HEIGHT = ((-1.2, -0.5), (0.0, 0.9), (1.2, -0.5)), 1.1
_VOXEL, _FIELD, _PIXELS, _REACH = 0.04, 4.4, 2560, 6.5


def start(seed: int, lenses: int) -> Design:
    """Random layout of conics with the curved side facing the object, on the paper's camera, with a fixed density."""
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
    """Study for the least error of volumes, with a mask between the apertures."""
    return Study.model_validate(
        {
            "depths_mm": span,
            "depth_count": planes,
            "types": kinds,
            "free": BOUNDS,
            "terms": [
                {"name": "volume_error", "minimise": 0.1},
                {"name": "min_wall_mm", "at_least": WEB, "weight": 30.0},
            ],
            "stages": [{"solver": "bfgs", "steps": steps}],
        }
    )


def best(design: Design, study: Study) -> dict:
    """Least error, dB, and its parameters."""
    end = run_study(design, study)
    return {"loss_db": 20 * float(np.log10(end.after[0].high)), "design": end.design}


def run(
    layouts: int, *, spans=SPANS, kinds=KINDS, lenses: int = LENSES, steps: int = STEPS, progress: Progress
) -> dict:
    """Return for each span and number of types the results for each layout, and gains over one type."""
    results: dict = {span: {k: [] for k in kinds} for span in spans}
    cases = [(span, seed, k) for span in spans for seed in range(layouts) for k in kinds]
    for span, seed, k in progress.track(cases, "Searches"):
        # Several types also start from the result for one type, so a local minimum alone cannot make them worse.
        starts = [start(seed, lenses), *(end["design"] for end in results[span][1][seed:])]
        ends, planes = spans[span]
        tried = [best(design, study_of(ends, planes, k, steps)) for design in starts]
        results[span][k].append(min(tried, key=lambda end: end["loss_db"]))
    gains = {
        span: {
            k: gain([row["loss_db"] for row in each[1]], [row["loss_db"] for row in each[k]]) for k in kinds if k > 1
        }
        for span, each in results.items()
    }
    return {"found": results, "gains_db": gains}


def judged(
    design: Design, span: tuple[float, float], *, samples: int = _SAMPLES, progress: Progress
) -> dict[str, float]:
    """PSNR, dB, of ray-traced letters with the result for the first layout, unblurred and blurred by a voxel."""
    imager, near = cropped(design.imager(), _PIXELS, _REACH), (span[0], sum(span) / 2, span[1])
    parts = zip("GSJ", near, _PLACES, strict=True)
    words = [letters(a, depth=z, height=_HEIGHT, pitch=0.008) + [*xy, 0, 0] for a, z, xy in parts]
    emitters = np.concatenate(words)
    side = round(_FIELD / _VOXEL) | 1
    grid = Grid(near, (side, side), _VOXEL)
    truth = np.asarray(rasterize(emitters, grid), np.float32)
    clean = traced(sampled(emitters, samples), imager, _RAYS)
    rng = np.random.default_rng(0)
    # Equal exposure for all: images are in shares of an emitter's light.
    image = rng.poisson(_ELECTRONS * clean) + rng.normal(0, _READ_NOISE, clean.shape)
    volume = np.asarray(reconstruct(image.astype(np.float32), imager, grid, RichardsonLucy(20), progress=progress))
    blurred = (gaussian_filter(part, (0, 1, 1)) for part in (volume, truth))
    return {"psnr_db": quality(volume, truth).psnr_db, "blurred_psnr_db": quality(*blurred).psnr_db}


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


def gain(alike: Sequence[float], several: Sequence[float]) -> dict:
    """Reduction of the error in dB, with its 95 % interval over the layouts."""
    less = np.subtract(alike, several)
    half = stats.t.ppf(0.975, len(less) - 1) * less.std(ddof=1) / len(less) ** 0.5 if len(less) > 1 else np.nan
    return {"mean": float(less.mean()), "interval": [float(less.mean() - half), float(less.mean() + half)]}


def picture(results: dict) -> Figure:
    """Plot the error against the number of types, one line per layout."""
    figure = Figure(figsize=(4.2 * len(results["found"]), 3.6), dpi=100, layout="constrained")
    for axes, (span, each) in zip(
        figure.subplots(1, len(results["found"]), squeeze=False).flat, results["found"].items(), strict=True
    ):
        for rows in zip(*each.values(), strict=True):
            axes.plot(list(each), [row["loss_db"] for row in rows], "o-", color="C0", alpha=0.6)
        axes.set(
            title=f"objects at {span}", xlabel="kinds of lenses", ylabel="error of the volume, dB", xticks=list(each)
        )
    return figure


def numbers_of(end: dict) -> dict[str, Any]:
    """Result of a search, for a file."""
    lens = end["design"].lens
    ends = {name: sorted(set(np.ravel(getattr(lens, f"{name}_mm")).tolist())) for name in _OF_KINDS}
    return {"loss_db": end["loss_db"], "sensor_distance": end["design"].imaging.sensor_distance_mm} | ends


def report(layouts: int, progress: Progress) -> Report:
    with jax.enable_x64(True):
        results = run(layouts, progress=progress)
    results["letters"] = {
        span: {k: judged(each[k][0]["design"], SPANS[span][0], progress=progress) for k in KINDS}
        for span, each in results["found"].items()
    }
    figure, rows = picture(results), []
    for span, each in results["found"].items():
        for k, ends in each.items():
            each[k] = numbers = [numbers_of(end) for end in ends]
            radii = np.array([[least, most] for least, *_, most in (2 * end["radius_of_curvature"] for end in numbers)])
            means = [
                np.mean([np.mean(end[key]) for end in numbers]) for key in ("loss_db", "sensor_distance", *_OF_KINDS)
            ]
            means.append(np.mean(np.diff(radii) / radii.sum(1, keepdims=True)))
            more = results["gains_db"][span].get(k)
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
    return Report({"many_foci.json": results, "many_foci.png": figure}, [table(columns, rows)])


if __name__ == "__main__":
    main(report, {"--layouts": {"type": int, "default": 4}})
