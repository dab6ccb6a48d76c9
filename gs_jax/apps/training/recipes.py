"""How the networks that come with the package are trained: the paper's, the one of seven slices, and the unrolled."""

import dataclasses
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Float, Float32

from ...base.progress import Progress
from ...base.workers import Workers
from ...detection.unet import UNet, multislice_network, paper_network
from ...reconstruction.inverse_problem import InverseProblem, lens_type_geometries, subtract_offset
from ...solvers.unrolled import State, Unrolled, initialize_unrolled
from ...typing import Volume
from .simulated_captures import SCENES, Kind, example, tables
from .training_loop import Recipe
from .training_slices import Batch, Stack, paper_batch, patches

# What the unrolled networks see: pixels are sums of 4 x 4, voxels as wide as those by default.
UNROLLED = Kind(288, 0.018, 0.064, 7, binning=4)
# Of an empty scene errors are relative to this much of the start's squares.
_OF_THE_START = 0.2
# Steps before the networks, and conjugate gradients after them, once they are trained.
_FIRST, _LAST = 20, 10


class Case(NamedTuple):
    """A capture above its offset, with the mean 1, what inverts it, what it shows, and where the networks begin."""

    light: Float32[np.ndarray, "row column"]
    system: InverseProblem
    truth: Volume
    start: State


def paper_recipe() -> Recipe:
    """The paper's: RMSprop and mean squared error on synthetic polygons. It prints no rate."""
    return Recipe(paper_network, lambda steps: optax.rmsprop(3e-4), paper_batch, slices_loss)


def multislice_recipe(stacks: list[Stack]) -> Recipe:
    """Ours: Adam, its rate falling as a cosine, and mean squared error on simulated stacks."""
    offsets = eqx.filter_eval_shape(multislice_network, jax.random.key(0)).offsets
    return Recipe(multislice_network, partial(_adam, 1e-3), lambda rng: patches(stacks, offsets, rng), slices_loss)


def unrolled_recipe(cases: list[Case]) -> Recipe:
    """Adam and relative squared error through all steps, and so through the operators and their exact adjoints."""
    batch = lambda rng: cases[rng.integers(len(cases))]
    return Recipe(lambda key: initialize_unrolled(key=key), partial(_adam, 2e-3), batch, unrolled_loss)


def slices_loss(network: UNet, batch: Batch) -> Float[Array, ""]:
    """Mean squared error over the voxels of a batch, weighted."""
    error = jax.vmap(network)(jnp.asarray(batch.slices)) - jnp.asarray(batch.truth)
    return jnp.mean(jnp.asarray(batch.weight) * jnp.mean(error**2, axis=(1, 2)))


def unrolled_loss(network: Unrolled, case: Case) -> Float[Array, ""]:
    """Squared error of the volume, relative to what it should be, and to a part of what the networks started from."""
    truth, light, operator = jnp.asarray(case.truth), jnp.asarray(case.light), case.system.operator

    # Not `step`, which would keep what the gradient needs of its other kinds of step, too.
    def network_step(state, _):
        lucy, cost, _ = network.network_step(operator, light, state)
        return state._replace(lucy=lucy, number=state.number + 1), cost

    found = network.estimate(lax.scan(network_step, case.start, length=network.power.size)[0])
    start = network.estimate(case.start)
    return jnp.mean((found - truth) ** 2) / (jnp.mean(truth**2) + _OF_THE_START * jnp.mean(start**2))


def finished(network: Unrolled) -> Unrolled:
    """Trained networks as they are used: with more steps before them, and conjugate gradients after them.

    On simulated captures ten of these gain 1.3 dB, and more than twelve no more. Of ray-traced letters, which are whole
    captures, 20 steps before the networks give 14.5 dB above an empty volume; with the 15 of training it is 3 dB less.
    """
    return dataclasses.replace(network, first=_FIRST, last=_LAST, steps=_FIRST + network.power.size + _LAST)


def unrolled_cases(
    count: int, seed: int, progress: Progress | None = None, kind: Kind = UNROLLED, workers: Workers | None = None
) -> list[Case]:
    """The first examples of a seed, with the tables of their microscopes as they are known; by workers, if any."""
    groups = [range(first, min(first + SCENES, count)) for first in range(0, count, SCENES)]
    stream, found = (workers or Workers()).stream_of(partial(_simulator, seed, kind)), {}
    with (progress or Progress()).counter("Simulating captures", len(groups)) as advance:
        for group, result in stream(groups):
            found[group.start] = result()
            advance()
    return [case for start in sorted(found) for case in found[start]]


def _simulator(seed: int, kind: Kind):
    """From the numbers of what one microscope images to its cases."""
    networks = initialize_unrolled(key=jax.random.key(0))

    def simulate(numbers):
        cases, optics = [], None
        for number in numbers:
            image, imager, grid, truth = example(seed, number, kind)
            optics = optics or tables(imager, np.asarray(grid.depths, np.float64), kind)
            light = subtract_offset(image)
            unit = np.float32(max(float(np.abs(light).mean()), 1e-30))
            system = InverseProblem(imager, grid, optics, lens_type_geometries(imager, grid))
            cases.append(Case(light / unit, system, truth / unit, _started(networks, system, light / unit)))
        return cases

    return simulate


@eqx.filter_jit
def _started(networks, system, light):
    """After the steps that have no networks, which training leaves as they are."""
    step = lambda state, _: networks.step(system.operator, light, state)[:2]
    return lax.scan(step, networks.init(system.operator, light), length=networks.first)[0]


def _adam(rate: float, steps: int) -> optax.GradientTransformation:
    schedule = optax.warmup_cosine_decay_schedule(0, rate, min(100, steps // 10), steps)
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
