"""What networks and operator contribute to learned inversion, on held-out simulated captures.

The training's generator makes the captures from another seed: 24 scenes by three random microscopes, sub-fields of
288 x 288 pixels, the same for every method. Gains are of PSNR over that of an empty volume, the mean over the scenes
with its 95 % interval by bootstrap. Captures have all light, misaligned microscopes and noise, on voxels half as
large. `fig9_benchmark.py` tests ray-traced captures.

- The operator: our U-Net after back-projection against the unrolled inversion, and list-RL without networks.
- The networks: the unrolled inversion with networks that leave every voxel unchanged.
- The last steps: the unrolled inversion without its conjugate gradients.
- Noise: for captures that show nothing, the standard deviation of the volume's image over that of the capture.

    python -m experiments.learned [--scenes N] [--weights FILE] [--out DIR]

FILE is the output of `gs-jax train --network unrolled`, used instead of the shipped weights. Writes `learned.json` and
`learned.md`; about fifteen minutes on two cores.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from experiments.common import Report, main, table
from gs_jax import Unrolled, psf_model, quality, reconstruct, suppress
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.apps.training import UNROLLED
from gs_jax.apps.training_data import CaptureSpec, Example, simulate_example
from gs_jax.base.errors import InputError
from gs_jax.base.progress import Progress
from gs_jax.detection.unet import pretrained
from gs_jax.projection.forward_model import forward
from gs_jax.reconstruction.networks import read_unrolled
from gs_jax.reconstruction.pipeline import METHODS, Method

# Different from the seed of the training.
SEED = 1
STEPS = 20
_DRAWS = 10_000


def methods(networks: Unrolled, progress: Progress) -> dict[str, Callable[[Example], np.ndarray]]:
    """Volumes of an example, by method."""
    without = dataclasses.replace(networks, last=0, steps=networks.steps - networks.last)
    by = lambda method: lambda e: solved(e, method, progress)
    cleaned = lambda name: lambda e: suppress(solved(e, METHODS["backproject"](1), progress), pretrained(name))
    return {
        "back-projection + the paper's U-Net": cleaned("paper"),
        "back-projection + our U-Net": cleaned("multislice"),
        f"list-RL, {networks.steps} steps": by(METHODS["list-rl"](networks.steps)),
        "FISTA": by(METHODS["fista"](STEPS)),
        "ADMM": by(METHODS["admm"](STEPS)),
        "unrolled, networks that change nothing": by(idle(networks)),
        "unrolled, no conjugate gradients": by(without),
        "unrolled": by(networks),
    }


def idle(networks: Unrolled) -> Unrolled:
    """Unrolled inversion with plain Richardson-Lucy steps in place of the networks."""
    zeros = jax.tree.map(jnp.zeros_like, networks.layers)
    return eqx.tree_at(lambda n: (n.layers, n.power), networks, (zeros, jnp.ones_like(networks.power)))


def solved(e: Example, method: Method, progress: Progress) -> np.ndarray:
    return reconstruct(e.image, e.imager, e.grid, method, progress=progress)


def gain(volume: np.ndarray, e: Example) -> float:
    """PSNR above that of an empty volume, dB."""
    return quality(volume, e.truth).psnr_db - quality(np.zeros_like(e.truth), e.truth).psnr_db


def imaged_noise(volume: np.ndarray, e: Example) -> float:
    """Standard deviation of the volume's image over that of the capture."""
    image = forward(volume, e.imager, e.grid, psf_model(e.imager, e.grid, "full"))
    return float(np.std(image) / np.std(e.image))


def run(networks: Unrolled, scenes: int, spec: CaptureSpec = UNROLLED, *, progress: Progress) -> dict[str, dict]:
    """Return `gains` of the scenes with an object, dB, and `noise` of the others, by method."""
    by_name = methods(networks, progress)
    results = {name: {"gains": [], "noise": []} for name in by_name}
    for number in progress.track(range(scenes), "Scenes"):
        e = simulate_example(SEED, number, spec)
        for name, method in by_name.items():
            volume = method(e)
            if e.truth.any():
                results[name]["gains"].append(gain(volume, e))
            else:
                results[name]["noise"].append(imaged_noise(volume, e))
    return results


def interval(values: list[float]) -> tuple[float, float]:
    """95 % interval of the mean, by bootstrap."""
    rng = np.random.default_rng(0)
    means = rng.choice(values, (_DRAWS, len(values))).mean(1)
    low, high = np.quantile(means, (0.025, 0.975))
    return float(low), float(high)


def report(scenes: int, weights: Path | None, progress: Progress) -> Report:
    if scenes < 1:
        raise InputError(f"--scenes: found {scenes}, allowed: 1 or more.")
    results = run(read_unrolled(weights) if weights else Unrolled.pretrained(), scenes, progress=progress)
    columns = ("method", "gain, dB", "95 %", "worst, dB", "noise imaged again, of its SD")
    rows = []
    for name, values in results.items():
        gains, low_high = values["gains"], "{:.1f} to {:.1f}".format(*interval(values["gains"]))
        noise = " ".join(f"{each:.2f}" for each in values["noise"])
        rows.append([name, f"{np.mean(gains):.1f}", low_high, f"{min(gains):.1f}", noise])
    text = "# Learned inversion, held-out simulated captures\n\n" + markdown_table(columns, rows) + "\n"
    return Report({"learned.json": results, "learned.md": text}, [table(columns, rows)])


if __name__ == "__main__":
    main(report, {"--scenes": {"type": int, "default": 24}, "--weights": {"type": Path}})
