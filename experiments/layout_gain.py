"""Gain of optimised lens layouts over the best of 200 random ones and over hexagonal ones.

The prescription, the plate, the number of lenses and their minimum spacing are fixed; only the centres move. The object
fills most of the plate, and sub-images overlap. For each of five seeds, 200 Poisson-disc layouts are scored by the
end-to-end loss (`experiments.end_to_end.reconstruction_loss`), and the best one is the competitor. From there Adam
follows the gradient of the same loss, with other scenes at each step. Controls with as many lenses: the best of 200
layouts in even rows over the whole plate, each lens displaced a little, as the optima suggest; and hexagonal lattices
at the minimum spacing and spread as wide as the plate allows, which are not optimised. All are scored by PSNR on 30
held-out scenes that the loss's model did not render (`experiments.layout_scenes`). The reconstruction is the same for
all: normalised back-projection less its local background (`experiments.end_to_end.reconstruct`), and as a second
method, for which nothing was optimised, ten steps of Richardson-Lucy on the same pixel-voxel lists.

    python -m experiments.layout_gain [--out DIR] [--seeds N]

writes `layout_gain.json` and `layout_gain.png`; half an hour on two cores.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from scipy import stats

from experiments.common import Report, main, table
from experiments.layout_scenes import METHODS, Centers, Study, judge, loss, overlap, psf_of
from gs_jax.base.progress import Progress
from gs_jax.layouts import hexagonal_layout, nearest_neighbour_distances, poisson_disc_layout
from gs_jax.optics.psf import diffraction_psf, gaussian_psf
from gs_jax.optics.theory import occupancy

NAMES = ("best", "ours", "rows", "hexagonal", "spread")
PAIRS = (*((name, "best") for name in NAMES[1:]), *(("ours", name) for name in NAMES[2:]))


def candidates(study: Study, seed: int) -> Float[np.ndarray, "layout lens 2"]:
    """Random layouts with equal numbers of lenses, the most frequent number."""
    draw = lambda n: poisson_disc_layout(study.plate, min_distance=study.distance, seed=int(n))
    layouts = lambda rng: map(draw, rng.integers(2**31, size=10**5))
    first = layouts(np.random.default_rng(0))
    number = int(stats.mode([len(next(first)) for _ in range(200)]).mode)
    results = (layout for layout in layouts(np.random.default_rng(1000 + seed)) if len(layout) == number)
    return np.stack([next(results) for _ in range(study.candidates)])


def hexagonal(study: Study, seed: int, count: int, pitch: float) -> Float[np.ndarray, "lens 2"]:
    """Control: the lenses nearest to the axis of a lattice that is rotated and shifted at random.

    Raises
    ------
    ValueError
        If they do not fit on the plate.
    """
    rng = np.random.default_rng(2000 + seed)
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    # Wider by a millionth, so that rounding does not violate the minimum spacing.
    lattice = hexagonal_layout((20.0, 20.0), pitch=pitch * (1 + 1e-6)) @ turn + rng.uniform(-0.5, 0.5, 2) * pitch
    on_plate = lattice[(np.abs(lattice) <= np.array(study.plate) / 2).all(1)]
    if len(on_plate) < count:
        raise ValueError(f"There is room for {len(on_plate)} lenses at a pitch of {pitch} mm, not for {count}.")
    return on_plate[np.argsort(np.hypot(*on_plate.T))[:count]]


def spread(study: Study, seed: int, count: int) -> Float[np.ndarray, "lens 2"]:
    """Control: the hexagonal lattice at the widest pitch, in steps of 1 %, at which all lenses fit."""
    for share in np.arange(1.2, 1.0, -0.01):
        try:
            return hexagonal(study, seed, count, study.distance * share)
        except ValueError:
            continue
    return hexagonal(study, seed, count, study.distance)


def rows(study: Study, seed: int, count: int) -> Float[np.ndarray, "layout lens 2"]:
    """Strongest control: even rows from edge to edge of the plate, every lens displaced at random by `study.jitter`."""
    rng, (width, height) = np.random.default_rng(3000 + seed), study.plate
    number = round((count * height / width) ** 0.5)
    lenses = np.diff(np.round(np.linspace(0, count, number + 1)).astype(int))
    heights = np.linspace(-height / 2, height / 2, number)
    row = lambda n, y: np.column_stack([np.linspace(-width / 2, width / 2, n), np.full(n, y)])
    even = np.concatenate([row(n, y) for n, y in zip(lenses, heights, strict=True)])
    return np.stack([apart(even + rng.normal(0, study.jitter, even.shape), study) for _ in range(study.candidates)])


def too_near(centers: Centers, distance: float) -> Float[Array, ""]:
    """Sum of squared deficits of pair distances below 1.005 times the minimum spacing, mm^2."""
    first, second = np.triu_indices(len(centers), 1)
    squared = jnp.sum((centers[first] - centers[second]) ** 2, axis=1)
    return jnp.sum(jnp.maximum(1.005 * distance - jnp.sqrt(squared + 1e-12), 0) ** 2)


_push = jax.jit(jax.grad(too_near))


def apart(centers: Centers, study: Study) -> Float[np.ndarray, "lens 2"]:
    """Move centres until every pair keeps the minimum spacing, on the plate."""
    centers, half = np.array(centers, np.float64), np.array(study.plate) / 2
    for _ in range(1000):
        centers = np.clip(centers, -half, half)
        if nearest_neighbour_distances(centers).min() >= study.distance:
            return centers
        centers -= 0.2 * np.asarray(_push(jnp.asarray(centers), study.distance), np.float64)
    raise RuntimeError(f"Lenses came nearer than {study.distance} mm, and there is no room to part them.")


def optimise(
    start: Centers, psfs: Array, study: Study, seed: int, progress: Progress
) -> tuple[Float[np.ndarray, "lens 2"], list[float]]:
    """Run Adam on the end-to-end loss of new scenes, with the minimum spacing first as a penalty and then exactly.

    Returns the centres, and the loss at each step.
    """
    half = jnp.array([study.plate]) / 2
    solver = optax.adam(optax.cosine_decay_schedule(study.rate, study.steps))

    @jax.jit
    def step(centers, memory, key):
        objective = lambda c: loss(c, key, psfs, study) + 100 * too_near(c, study.distance)
        value, slope = jax.value_and_grad(objective)(centers)
        with jax.numpy_dtype_promotion("standard"):  # Optax multiplies floats with the integer that counts its steps
            change, memory = solver.update(slope, memory)
        return jnp.clip(centers + change, -half, half), memory, value

    centers, losses = jnp.asarray(start), []
    memory = solver.init(centers)
    for key in progress.track(list(jax.random.split(jax.random.key(seed), study.steps)), f"Seed {seed}: optimising"):
        centers, memory, value = step(centers, memory, key)
        losses.append(float(value))
    return apart(centers, study), losses


def best_of(
    layouts: Float[np.ndarray, "layout lens 2"], score: Callable[[Centers], float], progress: Progress
) -> tuple[Float[np.ndarray, "lens 2"], list[float]]:
    """The layout with the smallest loss, and the losses of all."""
    losses = [score(layout) for layout in progress.track(layouts, "Scoring layouts")]
    return layouts[int(np.argmin(losses))], losses


def run(study: Study = Study(), seeds: int = 5, *, progress: Progress) -> dict:
    """Everything that `layout_gain.json` holds; units are in the keys."""
    fine_psfs, psfs = psf_of(diffraction_psf, study, study.fine_grid()), psf_of(gaussian_psf, study, study.grid())
    records = []
    for seed in range(seeds):
        layouts, keys = candidates(study, seed), jax.random.split(jax.random.key(10_000 + seed), study.scored_on)
        score = lambda c, keys=keys: float(np.mean([loss(jnp.asarray(c), key, psfs, study) for key in keys]))
        best, losses = best_of(layouts, score, progress)
        even, even_losses = best_of(rows(study, seed, layouts.shape[1]), score, progress)
        ours, descent = optimise(best, psfs, study, seed, progress)
        lattices = hexagonal(study, seed, layouts.shape[1], study.distance), spread(study, seed, layouts.shape[1])
        chosen: dict[str, Centers] = dict(zip(NAMES, (best, ours, even, *lattices), strict=True))
        scores, empty = judge(chosen, study, fine_psfs, progress)
        row = {"seed": seed, "random_loss_db": losses, "ours_loss_db": score(ours), "descent_db": descent}
        row |= {"rows_loss_db": even_losses, "hexagonal_loss_db": [score(c) for c in lattices]}
        least = {name: float(nearest_neighbour_distances(np.asarray(c)).min()) for name, c in chosen.items()}
        row |= {"scores": scores, "empty_psnr_db": empty, "least_distance_mm": least}
        row |= {"lenses_per_lit_pixel": {name: overlap(c, study) for name, c in chosen.items()}}
        row |= {"centers_mm": {name: np.asarray(c).tolist() for name, c in chosen.items()}}
        records.append(row)
    lenses = len(records[0]["centers_mm"]["ours"])
    per_point = float(lenses / np.prod(study.plate) * np.pi * study.field_radius**2)
    magnification = study.imager(np.zeros((1, 2))).magnification(study.middle)
    return {
        "study": study._asdict(),
        "lenses": lenses,
        "lenses_per_point": per_point,
        "occupancy": float(occupancy(per_point, magnification)),
        "gains_db": gains(records) if seeds > 1 else {},
        "seeds": records,
    }


def gains(rows: list[dict]) -> dict[str, dict[str, float | list[float]]]:
    """Gains in PSNR by both methods: over the best of the random layouts, and of ours over the controls."""
    results = {}
    for method in METHODS:
        psnr = {name: [row["scores"][name][f"{method}_psnr_db"] for row in rows] for name in NAMES}
        for one, other in PAIRS:
            results[f"{method}: {one} over {other}"] = gain(psnr[one], psnr[other])
    return results


def gain(ours: list[list[float]], others: list[list[float]]) -> dict[str, float | list[float]]:
    """Mean gain, and its 95 % interval by Student's t over the seeds' means.

    The scenes are the same for every layout, so pairs differ by their layouts only.
    """
    means = np.mean(np.subtract(ours, others), axis=1)
    half = stats.t.ppf(0.975, len(means) - 1) * means.std(ddof=1) / len(means) ** 0.5
    return {
        "mean": float(means.mean()),
        "interval": [float(means.mean() + s * half) for s in (-1, 1)],
        "of_seeds": means.tolist(),
    }


def picture(results: dict) -> Figure:
    """Plot losses of the random layouts, the controls and the optimised layout; and one seed's layouts."""
    figure = Figure(figsize=(17, 3.8), dpi=100, layout="constrained")
    left, *right = figure.subplots(1, 6, width_ratios=(1.6, 1, 1, 1, 1, 1))
    colors = "C0", "C2", "C1", "#009e73", "C4"
    titles = "best of the random", "optimised", "best of uneven rows", "hexagonal", "hexagonal, spread"
    for row in results["seeds"]:
        random, at = row["random_loss_db"], row["seed"]
        left.plot(random, np.full(len(random), at), "|", color="0.5")
        losses = min(random), row["ours_loss_db"], min(row["rows_loss_db"]), *row["hexagonal_loss_db"]
        for x, color, marker, title in zip(losses, colors, "oDshH", titles, strict=True):
            left.plot(x, at, marker, color=color, label=title)
    left.set(
        xlabel="loss of the search, dB (better to the left)",
        ylabel="seed",
        yticks=[row["seed"] for row in results["seeds"]],
    )
    left.set_ylim(-0.5, len(results["seeds"]) + 0.8)  # room for the legend
    left.legend(*[x[:5] for x in left.get_legend_handles_labels()], loc="upper center", ncols=2, fontsize=8)
    half, row = results["study"]["field"] / 2, results["seeds"][0]
    for axes, name, color, title in zip(right, NAMES, colors, titles, strict=True):
        score = np.mean(row["scores"][name]["backproject_psnr_db"])
        axes.plot(*np.transpose(row["centers_mm"][name]), "o", color=color)
        axes.plot(*np.array([(-1, -1, 1, 1, -1), (-1, 1, 1, -1, -1)]) * half, "k:")
        x, y = (side / 2 for side in results["study"]["plate"])
        axes.set(xlabel="x, mm", ylabel="y, mm", title=f"{title}\nPSNR {score:.2f} dB", aspect="equal")
        axes.set(xlim=(-1.05 * x, 1.05 * x), ylim=(-1.05 * y, 1.05 * y))
    said = "Layouts of the first seed, lenses as dots, the object dotted; PSNR of back-projection, mean over the scenes"
    figure.supxlabel(said, fontsize=9, x=0.65)
    return figure


def report(seeds: int, progress: Progress) -> Report:
    results = run(seeds=seeds, progress=progress)
    rows = []
    for row in results["seeds"]:
        losses = row["random_loss_db"]
        numbers = [min(losses), row["ours_loss_db"], min(row["rows_loss_db"]), *row["hexagonal_loss_db"]]
        numbers += [np.mean(row["scores"][name]["backproject_psnr_db"]) for name in NAMES]
        spread = f"{np.mean(losses):.2f} +- {np.std(losses):.2f}"
        rows.append([str(row["seed"]), spread, *(f"{x:.2f}" for x in numbers)])
    columns = "seed", "random: loss, dB", *(f"{name}, dB" for name in NAMES), *(f"{n}: PSNR, dB" for n in NAMES)
    files = {"layout_gain.json": results, "layout_gain.png": picture(results)}
    return Report(files, [table(columns, rows), str(results["gains_db"])])


if __name__ == "__main__":
    main(report, {"--seeds": {"type": int, "default": 5}})
