"""Two variants of the network of seven slices, at equal size, data and training.

- Spread: an eighth channel, the spread over the lenses of what back-projection sums in the wanted slice. All lenses see
  real light; one lens sees a ghost.
- Gated: the network weighs the slice by 0 to 2 instead of drawing a new one.

Each variant is trained on the same simulated captures in the same order, and tested on those of another seed: PSNR over
that of an empty volume, the mean over the scenes, and the mean difference from the shipped network with its 95 %
interval by bootstrap. The training is shorter than that of the shipped weights, on captures of coarser pixels.

    python -m experiments.two_step_variants [--steps N] [--stacks N] [--held-out N] [--out DIR]

Writes `variants.json` and `variants.md`; about a quarter of an hour on two cores.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from experiments.common import Report, main, table
from experiments.learned import interval
from gs_jax import backproject, quality
from gs_jax.apps.benchmark_report import markdown_table
from gs_jax.apps.training import Recipe, init, slices_loss, train
from gs_jax.apps.training_data import CaptureSpec, simulate_example
from gs_jax.apps.training_slices import PLANES, Batch
from gs_jax.base.progress import Progress
from gs_jax.detection.unet import UNet, multislice_network, standardize
from gs_jax.optics.psf_core import core_distortion

SPEC = CaptureSpec(640, 0.009, 0.04, PLANES)
SIZE, COUNT = 96, 8
# As in `gs_jax.apps.training_slices`: smallest norm to which errors are relative.
_GHOSTS, _LEAST_ENERGY = 0.05, 1e-3


class Stack(NamedTuple):
    """A back-projected volume and the spread over its lenses, each normalised, with the truth and its slope."""

    volume: np.ndarray
    spread: np.ndarray
    truth: np.ndarray


class Gated(eqx.Module):
    """Network that weighs the wanted slice."""

    network: UNet

    def __call__(self, slices: Float[Array, "channel y x"]) -> Float[Array, "y x"]:
        return 2 * jax.nn.sigmoid(self.network(slices)) * slices[self.network.offsets.index(0)]


def stack(seed: int, number: int, spec: CaptureSpec = SPEC) -> Stack:
    image, imager, grid, truth = simulate_example(seed, number, spec)
    on_cores = partial(backproject, imager=imager, grid=grid, distortion=core_distortion(imager, grid.depths))
    mean = lambda image: np.asarray(on_cores(image, normalize=True))
    volume, unit = standardize(np.asarray(on_cores(image)))
    level = np.float32(image.mean())
    variance = mean((image - level) ** 2) - mean(image - level) ** 2
    spread, spread_unit = standardize(np.sqrt(np.maximum(variance, 0)))
    largest = max(float(truth.max()), 1e-30)
    truth = truth / largest
    power = float(truth.var())
    slope = float(np.mean((truth - truth.mean()) * volume)) / power if power > 0 else 0.0
    scaled = (volume / unit, spread / max(spread_unit, 1e-30), max(slope, 0.0) / unit * truth)
    return Stack(*(part.astype(np.float32) for part in scaled))


def channels(one: Stack, depth: int, place: tuple[slice, slice], spread: bool) -> np.ndarray:
    """Input of a network for a part of a slice."""
    depths = np.clip(depth + np.arange(-3, 4), 0, len(one.volume) - 1)
    beside = [one.spread[depth][place]] if spread else []
    return np.stack([*one.volume[depths][:, *place], *beside])


def batch(stacks: list[Stack], spread: bool, rng: np.random.Generator) -> Batch:
    """Random patches, the same for each variant; three in four are the best of eight by content."""
    slices, truths = [], []
    for number in range(COUNT):
        one = stacks[rng.integers(len(stacks))]
        limits = [len(one.volume), *(n - SIZE + 1 for n in one.volume.shape[1:])]
        places = [(d, (slice(r, r + SIZE), slice(c, c + SIZE))) for d, r, c in rng.integers(0, limits, (8, 3))]
        light = lambda place, one=one: one.truth[place[0]][place[1]].max()
        depth, place = max(places, key=light) if number % 4 else places[0]
        slices.append(channels(one, depth, place, spread))
        truths.append(one.truth[depth][place])
    seen, truth = np.stack(slices), np.stack(truths)
    energy = np.mean(truth**2, (1, 2)) + _GHOSTS * np.mean(seen[:, :7] ** 2, (1, 2, 3)) + _LEAST_ENERGY
    return Batch(seen, truth, (1 / energy).astype(np.float32))


def _wider(key) -> UNet:
    """The network with one more channel, whose number belongs to no slice."""
    like = eqx.filter_eval_shape(multislice_network, key)
    return UNet((*like.offsets, max(like.offsets) + 1), like.widths, standardized=True, key=key)


def variants(stacks: list[Stack]) -> dict[str, tuple[Recipe, bool]]:
    """Networks, and whether they see the spread, by name."""

    def recipe(network, spread) -> tuple[Recipe, bool]:
        optimizer = lambda steps: optax.adam(optax.warmup_cosine_decay_schedule(0, 1e-3, min(100, steps), steps + 1))
        return Recipe(network, optimizer, partial(batch, stacks, spread), slices_loss), spread

    return {
        "as it is": recipe(multislice_network, False),
        "spread": recipe(_wider, True),
        "gated": recipe(lambda key: Gated(multislice_network(key)), False),
    }


def cleaned(network: Any, one: Stack, spread: bool) -> np.ndarray:
    """Clean a volume whose rows and columns are multiples of the network's downsampling."""
    apply = eqx.filter_jit(lambda network, slices: jnp.maximum(network(slices), 0))
    whole = slice(None), slice(None)
    return np.stack([np.asarray(apply(network, channels(one, d, whole, spread))) for d in range(len(one.volume))])


def _cut(one: Stack, multiple: int) -> Stack:
    rows, columns = (n // multiple * multiple for n in one.volume.shape[1:])
    return Stack(*(part[:, :rows, :columns] for part in one))


def run(
    steps: int, count: int, held_out: int, spec: CaptureSpec = SPEC, *, progress: Progress
) -> dict[str, list[float]]:
    """Return gains over an empty volume for the held-out scenes that show something, dB, by variant."""
    stacks = [stack(0, number, spec) for number in progress.track(range(count), "Simulating captures")]
    judged = [_cut(stack(1, number, spec), 8) for number in progress.track(range(held_out), "Simulating others")]
    results = {}
    for name, (recipe, spread) in progress.track(variants(stacks).items(), "Variants"):
        with progress.counter(f"Training: {name}", steps) as advance:
            state = train(recipe, init(recipe, steps=steps, seed=0), callback=lambda state: advance())  # noqa: B023
        gain = lambda one, network=state.network, spread=spread: (
            quality(cleaned(network, one, spread), one.truth).psnr_db
            - quality(np.zeros_like(one.truth), one.truth).psnr_db
        )
        results[name] = [gain(one) for one in judged if one.truth.any()]
    return results


def report(steps: int, stacks: int, held_out: int, progress: Progress) -> Report:
    results = run(steps, stacks, held_out, progress=progress)
    first = np.array(next(iter(results.values())))
    rows = []
    for name, gains in results.items():
        off = np.array(gains) - first
        low, high = interval(list(off))
        rows.append([name, f"{np.mean(gains):.2f}", f"{off.mean():+.2f}", f"{low:+.2f} to {high:+.2f}"])
    columns = ("network", "gain, dB", "over the first, dB", "95 %")
    text = "# Variants of the two-step network\n\n" + markdown_table(columns, rows) + "\n"
    return Report({"variants.json": results, "variants.md": text}, [table(columns, rows)])


if __name__ == "__main__":
    main(
        report,
        {
            "--steps": {"type": int, "default": 600},
            "--stacks": {"type": int, "default": 40},
            "--held-out": {"type": int, "default": 24},
        },
    )
