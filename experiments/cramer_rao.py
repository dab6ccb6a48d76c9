"""The Cramer-Rao bound of `gs_jax.codesign.fisher` against maximum likelihood on noisy images of a single point.

Two layouts of 23 lenses: Poisson discs, and the same after gradient descent on the bound in z (minimum spacing and
plate fixed). For each layout and several brightnesses the script draws 500 noisy images of a point at random subpixel
positions (Poisson light and background, Gaussian read noise), and estimates x, y, z and brightness by Fisher scoring on
the likelihood. If the bound is right, the ratio of the error to the bound is 1, and the better layout is better by the
ratio of the bounds.

    python -m experiments.cramer_rao [--out DIR]

writes `cramer_rao.json` and `cramer_rao.png`; about two minutes on two cores.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray
from matplotlib.figure import Figure

from experiments.common import Report, main, table
from gs_jax import Imager, MicrolensArray, Sensor
from gs_jax.base.progress import Progress
from gs_jax.codesign.fisher import PRIOR, cramer_rao, localization_bound, mean_images, windows
from gs_jax.layouts import nearest_neighbour_distances, poisson_disc_layout
from gs_jax.simulation.synthetic import poisson

PLATE, DISTANCE, DEPTH = (5.0, 5.0), 1.0, 20.0
SIZE = 15
OPTIONS: dict[str, Any] = dict(spot=0.008, background=5.0, read_noise=2.0, size=SIZE)
STEPS = 12


def imager(centers: Float[Array | np.ndarray, "lens 2"]) -> Imager:
    return Imager(MicrolensArray(centers), Sensor((1400, 1400), 0.0045), 5.8, 2.5)


def improved(centers: Float[np.ndarray, "lens 2"], steps: int) -> Float[np.ndarray, "lens 2"]:
    """Centres that lower the bound in z of points near the axis, with the minimum spacing kept."""
    points = np.array([(x, y, DEPTH) for x in (-0.3, 0, 0.3) for y in (-0.3, 0, 0.3)])
    first, second = np.triu_indices(len(centers), 1)
    half, solver = jnp.array([PLATE]) / 2, optax.adam(0.03)

    def objective(c):
        near = DISTANCE - jnp.sqrt(jnp.sum((c[first] - c[second]) ** 2, axis=1))
        return jnp.log(localization_bound(imager(c), points, photons=1000.0, **OPTIONS)[2]) + 30 * jnp.sum(
            jnp.maximum(near + 0.02, 0) ** 2
        )

    @jax.jit
    def step(c, state):
        slope = jax.grad(objective)(c)
        with jax.numpy_dtype_promotion("standard"):  # Optax multiplies floats with the integer that counts its steps
            change, state = solver.update(slope, state)
        return jnp.clip(c + change, -half, half), state

    c, best = jnp.asarray(centers), centers
    state = solver.init(c)
    for _ in range(steps):
        c, state = step(c, state)
        if nearest_neighbour_distances(np.asarray(c)).min() >= DISTANCE:
            best = np.asarray(c)
    return best


@partial(jax.jit, static_argnames="draws")
def errors(
    camera: Imager, key: PRNGKeyArray, *, photons: Float[Array, ""], draws: int
) -> tuple[Float[Array, "draw 3"], Float[Array, "draw 3"]]:
    """Errors of maximum likelihood in x, y, z, and the bound at each point, mm."""
    variance = OPTIONS["read_noise"] ** 2

    def one(key):
        place, light, read, start = jax.random.split(key, 4)
        # One pixel in the object, so that images take every subpixel phase.
        pixel = camera.sensor.pixel_pitch / camera.magnification(DEPTH)
        lateral = pixel * jax.random.uniform(place, (2,), minval=-0.5, maxval=0.5)
        truth = jnp.concatenate([lateral, jnp.array([DEPTH, 0.0])])
        corners, on_sensor = windows(truth[:3], camera, SIZE)
        images = lambda p: (
            mean_images(p, camera, photons=photons, spot=OPTIONS["spot"], corners=corners, size=SIZE)
            + OPTIONS["background"]
        )
        data = poisson(light, images(truth)) + jnp.sqrt(variance) * jax.random.normal(read, on_sensor.shape)

        def scoring(p, _):
            mean, slopes = images(p), jax.jacfwd(images)(p)
            weight = on_sensor / (mean + variance)
            information = jnp.einsum("lrci,lrcj,lrc->ij", slopes, slopes, weight) + jnp.diag(jnp.array(PRIOR) ** -2)
            score = jnp.einsum("lrci,lrc->i", slopes, weight * (data - mean))
            unit = jnp.diag(information) ** -0.5
            step = unit * jnp.linalg.solve(unit[:, None] * information * unit[None], unit * score)
            return p + jnp.clip(step, -0.1, 0.1), None

        # Starts near the truth, within ten pixels of depth and one pixel: global search is not tested here.
        beside = jnp.array([pixel, pixel, 0.05, 0.2]) * jax.random.normal(start, (4,)) / 2
        results, _ = jax.lax.scan(scoring, truth + beside, length=STEPS)
        bound = cramer_rao(truth[None, :3], camera, photons=photons, **OPTIONS)[0]
        return (results - truth)[:3], bound

    return jax.lax.map(one, jax.random.split(key, draws), batch_size=50)


def run(
    photons: Sequence[float] = (100, 300, 1000, 3000, 10_000),
    draws: int = 500,
    steps: int = 150,
    *,
    progress: Progress,
) -> dict:
    """Return the content of `cramer_rao.json`; units are in the keys."""
    before = next(
        c for c in (poisson_disc_layout(PLATE, min_distance=DISTANCE, seed=s) for s in range(1000)) if len(c) == 23
    )
    layouts = {"random": before, "improved": improved(before, steps)}
    rows = []
    for (name, centers), count in progress.track([(x, n) for x in layouts.items() for n in photons], "Locating"):
        wrong, bound = errors(imager(centers), jax.random.key(1), photons=jnp.array(float(count)), draws=draws)
        rms = lambda x: np.sqrt(np.mean(np.asarray(x) ** 2, axis=0))
        results = {"bound_um": 1000 * rms(bound), "error_um": 1000 * rms(wrong), "ratio": rms(wrong) / rms(bound)}
        rows.append({"layout": name, "photons": count} | {key: value.tolist() for key, value in results.items()})
    return {
        "draws": draws,
        "rows": rows,
        "centers_mm": {name: centers.tolist() for name, centers in layouts.items()},
        "least_distance_mm": {name: float(nearest_neighbour_distances(c).min()) for name, c in layouts.items()},
    }


def picture(results: dict) -> Figure:
    """Plot errors and bounds in x and z against photons, and the layouts."""
    figure = Figure(figsize=(11, 3.6), dpi=100, layout="constrained")
    *plots, right = figure.subplots(1, 3, width_ratios=(1.2, 1.2, 1))
    for color, name in zip(("C0", "C3"), results["centers_mm"], strict=True):
        rows = [row for row in results["rows"] if row["layout"] == name]
        for axes, axis, label in zip(plots, (0, 2), "xz", strict=True):
            photons = [row["photons"] for row in rows]
            axes.loglog(photons, [row["bound_um"][axis] for row in rows], color=color, label=f"{name}, bound")
            axes.loglog(photons, [row["error_um"][axis] for row in rows], "o", color=color, label=f"{name}, found")
            axes.set(xlabel="photons of a lens on its axis", ylabel=f"error in {label}, RMS, um")
            axes.grid(which="both", alpha=0.25)
        right.plot(*np.transpose(results["centers_mm"][name]), "o", color=color, label=name, fillstyle="none")
    plots[0].legend()
    right.set(xlabel="x, mm", ylabel="y, mm", aspect="equal", xlim=(-2.7, 2.7), ylim=(-2.7, 2.7))
    return figure


def report(progress: Progress) -> Report:
    # The second derivatives of a bright point's likelihood span more than the range of float32.
    jax.config.update("jax_enable_x64", True)
    results = run(progress=progress)
    triple = lambda row, key: " ".join(f"{x:.3g}" for x in row[key])
    rows = [
        [row["layout"], str(row["photons"]), *(triple(row, key) for key in ("bound_um", "error_um", "ratio"))]
        for row in results["rows"]
    ]
    shown = table(("layout", "photons", "bound x, y, z, um", "error x, y, z, um", "ratio x, y, z"), rows)
    return Report({"cramer_rao.json": results, "cramer_rao.png": picture(results)}, [shown])


if __name__ == "__main__":
    main(report)
