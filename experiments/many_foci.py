"""Whether lenses of several foci on one plate pay: the best of one, two and three kinds, by the same search.

What is minimised is the error of the best linear estimate of a volume (`gs_jax.codesign.linear_error`): transfer
functions of exact rays, light, shot and read noise at equal exposure, and parallax. Free are the sensor distance, the
radius of curvature and the aperture, up to what a mask leaves of the nearest neighbours; of several kinds also the
spread of their radii. Kinds are interleaved: each lens gets the kind that its neighbours have least of. Over 18 to 23
mm, and over a longer span, where one focus has to be a compromise. Each is done for several layouts of the same
statistics, the same for all numbers of kinds; gains are of pairs, with intervals by Student's t over the layouts. What
was found for the first layout is then judged by what it was not found by: letters at three depths of the span, imaged
by `experiments/ray_tracer.py` with the camera's noise, and reconstructed by Richardson-Lucy with the full model.

    python -m experiments.many_foci [--out DIR] [--layouts N]

Writes `many_foci.json` and `many_foci.png`; about a quarter of an hour on two cores.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy import stats
from scipy.optimize import minimize
from scipy.spatial import KDTree

from experiments import lens_scenes
from experiments.common import Report, main, table
from experiments.ray_tracer import traced
from gs_jax import Grid, Imager, RichardsonLucy, random_layout, reconstruct
from gs_jax.base.progress import Progress
from gs_jax.codesign.exposure_terms import places_of
from gs_jax.codesign.linear_error import lost_power
from gs_jax.designs.builtin import geomscope
from gs_jax.designs.microscope import Microscope
from gs_jax.simulation.phantoms import letters, rasterize

# Depths that are told apart, mm.
SPANS = {"18 to 23 mm": (18.0, 20.5, 23.0), "15 to 30 mm": (15.0, 18.0, 22.0, 30.0)}
KINDS = (1, 2, 3)
# Of the layout, mm: lenses, plate, pitch, and what a mask needs between apertures.
LENSES, PLATE, PITCH, WEB = 200, 17.1, 1.05, 0.1
CONIC = -0.7
# Bounds of v, R, D, mm, and of the spread: radii are `R (1 +- spread)`.
BOUNDS = ((2.0, 6.0), (1.0, 3.0), (0.2, 2.0), (0.0, 0.15))
START = (2.95, 1.34, 0.75, 0.03)
_STEPS = 60
# Of the letters: emitters, and electrons of all of an emitter's light, that brightest pixels have some thousands of.
_SAMPLES, _ELECTRONS = 200_000, 2e10
# Neighbours whose kinds a lens looks at.
_NEIGHBOURS = 6


def layout(seed: int, lenses: int) -> np.ndarray:
    """Centres at random, with the same density however many they are."""
    plate = PLATE * (lenses / LENSES) ** 0.5
    return np.asarray(random_layout(lenses, (plate, plate), pitch=PITCH, pitch_sd=0.08, seed=seed))


def interleaved(centers: np.ndarray, kinds: int) -> np.ndarray:
    """The kind of each lens: the one that its neighbours before it have least of, and then the rarest."""
    found = np.full(len(centers), -1)
    tree: Any = KDTree(centers)
    near = tree.query(centers, k=_NEIGHBOURS + 1)[1][:, 1:]
    for lens in np.lexsort((centers[:, 1], np.round(centers[:, 0] / PITCH))):
        others = np.bincount(found[near[lens]][found[near[lens]] >= 0], minlength=kinds)
        rare = np.bincount(found[found >= 0], minlength=kinds)
        found[lens] = np.lexsort((rare, others))[0]
    return found


def microscopes(parameters, base: Imager, centers: Sequence[np.ndarray], depths) -> list[Microscope]:
    """Of each kind, whose radii are evenly spread; `parameters` are v, R, D and the spread."""
    v, radius, diameter, spread = parameters
    offsets = np.linspace(-1, 1, len(centers)) if len(centers) > 1 else [0.0]
    where = lambda i: (
        i.array.centers,
        i.array.radius_of_curvature,
        i.array.aperture_diameter,
        i.array.conic_constant,
        i.sensor_distance,
    )
    field, one = jnp.asarray(float(base.field_radius)), jnp.asarray(1.0)
    made = []
    for offset, places in zip(offsets, centers, strict=True):
        numbers = (jnp.asarray(places), radius * (1 + spread * offset), diameter, jnp.asarray(CONIC), v)
        imager = eqx.tree_at(where, base, numbers)
        made.append(Microscope(imager, jnp.asarray(depths), diameter, field, 0.036 * one, one))
    return made


def base_imager(centers: np.ndarray) -> Imager:
    """Conics with their curved side to the object, on the paper's camera."""
    data = geomscope().model_dump()
    data["lens"] |= {"orientation": "curved", "conic_constant": CONIC, "aperture_diameter_mm": 0.8}
    data["array"] |= {"centers_mm": tuple(map(tuple, centers.tolist())), "size_mm": (PLATE, PLATE)}
    data["provenance"] = {}
    return type(geomscope()).model_validate(data).imager()


def loss_of(parts: Sequence[np.ndarray], base: Imager, depths):
    """Lost power in dB and its gradient, by parameters in shares of their bounds."""
    low, high = np.transpose(BOUNDS)

    def loss(shares):
        kinds = microscopes(low + shares * (high - low), base, parts, depths)
        return 10 * jnp.log10(jnp.mean(lost_power(kinds, places_of(kinds[0]))))

    return jax.jit(jax.value_and_grad(loss))


def best(centers: np.ndarray, kinds: int, depths, starts: Sequence[Sequence[float]]) -> dict:
    """The least error, dB, and where."""
    low, high = np.transpose(BOUNDS)
    base, which = base_imager(centers), interleaved(centers, kinds)
    loss = loss_of([centers[which == k] for k in range(kinds)], base, depths)
    widest = float(KDTree(centers).query(centers, k=2)[0][:, 1].min()) - WEB
    limits = [(0.0, 1.0), (0.0, 1.0), (0.0, (widest - low[2]) / (high[2] - low[2])), (0.0, 1.0 if kinds > 1 else 0.0)]
    found = []
    for start in starts:
        shares = np.clip((np.array(start) - low) / (high - low), 0, np.array(limits)[:, 1])
        both = lambda x: tuple(np.asarray(part, np.float64) for part in loss(jnp.asarray(x)))
        found.append(minimize(both, shares, jac=True, bounds=limits, method="L-BFGS-B", options={"maxiter": _STEPS}))
    end = min(found, key=lambda each: each.fun)
    v, radius, diameter, spread = (low + end.x * (high - low)).tolist()
    return {"loss_db": float(end.fun), "v": v, "R": radius, "D": diameter, "spread": spread if kinds > 1 else 0.0}


def run(layouts: int, *, spans=SPANS, kinds=KINDS, lenses: int = LENSES, progress: Progress) -> dict:
    """For each span and number of kinds what was found for each layout, and gains over one kind."""
    found: dict = {span: {k: [] for k in kinds} for span in spans}
    cases = [(span, seed, k) for span in spans for seed in range(layouts) for k in kinds]
    for span, seed, k in progress.track(cases, "Searches"):
        centers = layout(seed, lenses)
        # The best of one kind is a start of several: they cannot be worse by a local minimum alone.
        alike = found[span][1]
        starts = [START] if len(alike) <= seed else [START, [*(alike[seed][key] for key in "vRD"), 0.03]]
        found[span][k].append(best(centers, k, spans[span], starts))
    gains = {
        span: {
            k: gain([row["loss_db"] for row in each[1]], [row["loss_db"] for row in each[k]]) for k in kinds if k > 1
        }
        for span, each in found.items()
    }
    return {"found": found, "gains_db": gains}


def judged(end: dict, kinds: int, depths, *, samples: int = _SAMPLES, progress: Progress) -> dict[str, float]:
    """PSNR, dB, of letters that our tracer images with what was found for the first layout; as in `lens_scenes`."""
    imager, near = imager_of(end, kinds), (depths[0], depths[len(depths) // 2], depths[-1])
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


def imager_of(end: dict, kinds: int) -> Imager:
    """What a search found for the first layout: the middle of the sensor, and the lenses near it."""
    centers = layout(0, LENSES)
    offsets = np.linspace(-1, 1, kinds)[interleaved(centers, kinds)] if kinds > 1 else 0.0
    base = base_imager(centers)
    numbers = {"radius_of_curvature": end["R"] * (1 + end["spread"] * offsets), "aperture_diameter": end["D"]}
    array = dataclasses.replace(base.array, **numbers)
    return lens_scenes.cropped(dataclasses.replace(base, array=array, sensor_distance=end["v"]))


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


def report(layouts: int, progress: Progress) -> Report:
    with jax.enable_x64(True):
        found = run(layouts, progress=progress)
    found["letters"] = {
        span: {k: judged(each[k][0], k, SPANS[span], progress=progress) for k in KINDS}
        for span, each in found["found"].items()
    }
    rows = []
    for span, each in found["found"].items():
        for k, ends in each.items():
            mean = lambda key, ends=ends: f"{np.mean([end[key] for end in ends]):.3g}"
            more = found["gains_db"][span].get(k)
            said = "" if more is None else f"{more['mean']:.2f} [{more['interval'][0]:.2f}, {more['interval'][1]:.2f}]"
            rows.append([span, str(k), *(mean(key) for key in ("loss_db", "v", "R", "D", "spread")), said])
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
    return Report({"many_foci.json": found, "many_foci.png": picture(found)}, [table(columns, rows)])


if __name__ == "__main__":
    main(report, {"--layouts": {"type": int, "default": 4}})
