"""The solvers on a real DiffuserCam image with a measured point spread function.

The data are those of Waller Lab's DiffuserCam tutorial (1200 x 1600 pixels). As in the tutorial, the mean of the PSF's
dark corner is subtracted from both images, pixels are averaged 4 x 4 (and once not at all), and the weight of total
variation is 1e-4 of the image's norm. Given the Python of an environment with LenslessPiCam, its ADMM runs on the same
data for as many steps, interleaved with ours.

    python experiments/diffusercam.py DATA [--peer PYTHON] [--out DIR]

writes `diffusercam.json` and `diffusercam.png`; about three minutes on two cores.
"""

import subprocess
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tifffile
from jaxtyping import Array, Float
from matplotlib.figure import Figure

from experiments.common import Report, main, table
from gs_jax.apps.method_benchmark import timed
from gs_jax.base.machine import describe
from gs_jax.base.progress import Progress
from gs_jax.projection.measured_psf import ConvolutionOperator
from gs_jax.solvers.admm import ConvolutionADMM, total_variation
from gs_jax.solvers.base import differences, solve
from gs_jax.solvers.fista import FISTA
from gs_jax.solvers.richardson_lucy import RichardsonLucy

TV = 1e-4
Image = Float[Array, "row column"]


def read(folder: Path, factor: int) -> tuple[np.ndarray, np.ndarray]:
    """Read PSF and image, subtract the background, average over squares, and normalise each."""
    raw = [tifffile.imread(folder / f"{name}.tif").astype(np.float32) for name in ("psf_sample", "rawdata_hand_sample")]
    dark = raw[0][5:15, 5:15].mean()
    rows, columns = (n // factor for n in raw[0].shape)
    small = [(a - dark).reshape(rows, factor, columns, factor).mean((1, 3)) for a in raw]
    psf, image = (a / np.linalg.norm(a) for a in small)
    return psf, image


def estimate(psf: Image, image: Image, *, method: str, steps: int) -> Array:
    """Reconstruct the scene by one method."""
    rows, columns = image.shape
    system = ConvolutionOperator(psf[None], (rows, columns))
    A = system
    if method == "ADMM":
        tv = TV / jnp.max(A.T.mv(image))  # in the unit of the solver
        return solve(system, image, ConvolutionADMM(steps, sparsity=0.0, tv=tv)).value
    solver = RichardsonLucy(steps, accelerate=True) if method == "Richardson-Lucy" else FISTA(steps, sparsity=0.0)
    return solve(A, image, solver).value


@jax.jit
def objective(psf: Image, image: Image, scene: Image) -> Float[Array, ""]:
    """Objective of ADMM: half the squared residual plus total variation."""
    rows, columns = image.shape
    residual = ConvolutionOperator(psf[None], (rows, columns)).mv(scene[None]) - image
    return jnp.vdot(residual, residual) / 2 + TV * total_variation(differences(scene[None], wrap=True), isotropic=False)


def ours(psf: np.ndarray, image: np.ndarray, method: str, steps: int):
    """Time a warm call, and the compilation."""
    run = jax.jit(partial(estimate, method=method, steps=steps))
    compile_s, call = timed(lambda: run.lower(jnp.asarray(psf), jnp.asarray(image)).compile())
    return compile_s, lambda: jax.block_until_ready(call(jnp.asarray(psf), jnp.asarray(image)))


def theirs(python: str, psf: np.ndarray, image: np.ndarray, steps: int) -> tuple[float, np.ndarray]:
    """Run LenslessPiCam; return its seconds per step and its scene."""
    with tempfile.TemporaryDirectory() as folder:
        given, results = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(given, psf=psf, image=image)
        script = str(Path(__file__).with_name("diffusercam_peer.py"))
        subprocess.run([python, script, str(given), str(results), str(steps)], check=True, capture_output=True)
        result = np.load(results)
        return float(result["seconds"]), result["scene"]


def run(
    folder: Path,
    *,
    factors: Sequence[int] = (4, 1),
    steps: int = 100,
    rounds: int = 3,
    peer: str | None,
    progress: Progress,
) -> tuple[dict, dict[str, np.ndarray]]:
    """Return the content of `diffusercam.json`, and the pictures by title. Full size takes a fifth of the steps."""
    rows, pictures = [], {}
    for factor in factors:
        psf, image = read(folder, factor)
        some = steps if factor > 1 else max(steps // 5, 1)
        if factor > 1:
            pictures["raw image"] = image
        for method in ("ADMM", "Richardson-Lucy", "FISTA"):
            with progress.step(f"{method}, 1/{factor}"):
                compile_s, call = ours(psf, image, method, some)
                spent, results = _rounds(call, peer if method == "ADMM" else None, psf, image, some, rounds)
            scene = np.asarray(results["gs_jax"][0])
            common = {"factor": factor, "pixels": image.size, "steps": some, "method": method}
            window = ConvolutionOperator(psf[None], image.shape).window
            for name, seconds in spent.items():
                x = scene if name == "gs_jax" else results[name]
                cost = float(objective(*map(jnp.asarray, (psf, image, x)))) if method != "Richardson-Lucy" else None
                times = {"ms_a_step": 1000 * float(np.median(seconds)), "fastest_ms_a_step": 1000 * min(seconds)}
                rows.append(common | {"code": name, **times, "final_cost": cost})
                if name == "gs_jax":
                    rows[-1]["compile_s"] = compile_s
                size = "full size" if factor == 1 else f"1/{factor}"
                pictures[f"{method}, {name}, {size}"] = x[window]
    return {"machine": describe(), "tv": TV, "rows": rows}, pictures


def _rounds(call, peer, psf, image, steps, count):
    """Seconds per step in each round, ours and theirs interleaved, and the results."""
    results = {"gs_jax": call()}
    seconds: dict[str, list[float]] = {"gs_jax": []}
    for _ in range(count):
        seconds["gs_jax"].append(timed(call)[0] / steps)
        if peer:
            spent, results["LenslessPiCam"] = theirs(peer, psf, image, steps)
            seconds.setdefault("LenslessPiCam", []).append(spent)
    return seconds, results


def picture(pictures: dict[str, np.ndarray]) -> Figure:
    """Plot the reconstructions, each from zero to its 99.9th percentile."""
    columns = min(5, len(pictures))
    rows = -(-len(pictures) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.7 * rows), dpi=90, layout="constrained")
    for axis in (axes := figure.subplots(rows, columns, squeeze=False)).flat[len(pictures) :]:
        axis.set_axis_off()
    for axis, (title, image) in zip(axes.flat, pictures.items(), strict=False):
        axis.imshow(image, cmap="gray", vmin=0, vmax=np.percentile(image, 99.9))
        axis.set(xticks=[], yticks=[])
        axis.set_title(title, fontsize=9)
    figure.supxlabel("Each from zero to its 99.9th percentile; full size is 1200 x 1600 pixels", fontsize=9)
    return figure


def report(data: Path, peer: str | None, progress: Progress) -> Report:
    results, pictures = run(data, peer=peer, progress=progress)
    rows = []
    for row in results["rows"]:
        cost = "" if row["final_cost"] is None else f"{row['final_cost']:.3e}"
        times = f"{row['ms_a_step']:.1f}", f"{row['fastest_ms_a_step']:.1f}"
        rows.append([str(row["factor"]), row["method"], row["code"], str(row["steps"]), *times, cost])
    shown = table(("factor", "method", "code", "steps", "ms a step", "fastest", "final cost"), rows)
    return Report({"diffusercam.json": results, "diffusercam.png": picture(pictures)}, [shown])


if __name__ == "__main__":
    peer = {"help": "Python of an environment with LenslessPiCam (its NumPy solver runs)."}
    main(report, {"data": {"type": Path}, "--peer": peer})
