"""Training of a network by a recipe, with exact checkpoints; the recipes of the networks that come with the package.

Fine-tuning by one's own captures needs no truth: a network is as good as its volumes predict the light of lenses that
the reconstruction did not use (measurement splitting; Moran et al., "Noisier2Noise", arXiv:1910.11908, and Yaman et
al., Magn. Reson. Med. 84, 3172, 2020, for other instruments). The noise of a pixel is independent of its prediction,
whatever its distribution: in the mean it adds a constant, so that the best network is the best for captures without
noise, too.
"""

import dataclasses
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Float, Float32, PRNGKeyArray

from ..base.arrays import divide
from ..base.errors import InputError
from ..base.progress import Progress
from ..base.typing import Image, PathLike, Volume
from ..base.workers import Workers
from ..detection.unet import UNet, multislice_network, paper_network
from ..io.files import atomic_write, check_input, decoding
from ..microscope.geometry import Imager
from ..microscope.grid import Grid
from ..projection.forward_model import Optics
from ..projection.operators import ImagingOperator
from ..reconstruction.inverse_problem import (
    InverseProblem,
    lens_type_geometries,
    prepare_data,
    prepare_model,
    subtract_offset,
)
from ..reconstruction.residual import kept_pixels_of_folds
from ..solvers.base import Operator, run_solver
from ..solvers.unrolled import State as UnrolledState, Unrolled, initialize_unrolled
from .training_data import (
    Batch,
    CaptureSpec,
    Stack,
    sample_paper_batch,
    sample_patches,
    simulate_example,
    simulate_groups,
    trace_optics,
)

# Captures of the unrolled networks: pixels are sums of 4 x 4, voxels as wide as those by default.
UNROLLED = CaptureSpec(288, 0.018, 0.064, 7, binning=4)
# Errors are relative to the truth's mean square plus this share of the start's; and the least error that counts.
_START_SHARE, _LEAST_ERROR = 0.2, 0.01
# Steps before the networks, and conjugate gradients after them, in use.
_FIRST, _LAST = 20, 10


class Recipe(NamedTuple):
    """How a network is made (from a key) and trained: optimizer (of a number of steps), batch, and loss."""

    network: Callable[[PRNGKeyArray], Any]
    optimizer: Callable[[int], optax.GradientTransformation]
    batch: Callable[[np.random.Generator], Any]
    loss: Callable[[Any, Any], Float[Array, ""]]


class State(eqx.Module):
    """Everything that decides how a training goes on; `losses` of steps to come are NaN."""

    network: Any
    optimizer: optax.OptState
    losses: Float32[np.ndarray, " step"]
    seed: np.ndarray
    step: np.ndarray


def init(recipe: Recipe, *, steps: int, seed: int) -> State:
    """The state before the first of `steps` steps."""
    network: Any = recipe.network(jax.random.key(seed))  # optax does not know that modules are trees
    memory = recipe.optimizer(steps).init(network)
    return State(network, memory, np.full(steps, np.nan, np.float32), np.array(seed), np.array(0))


def train(recipe: Recipe, state: State, *, callback: Callable[[State], bool | None] = lambda state: None) -> State:
    """Train to the last step, and call `callback` with the state after every step; where it returns true, end there.

    A batch depends on the seed and the step only, so that a training that goes on from a checkpoint ends with the same
    weights as one without interruption.
    """
    steps = len(state.losses)
    for number in range(int(state.step), steps):
        batch = recipe.batch(np.random.default_rng([int(state.seed), 1, number]))
        network, memory, value = _step(recipe, steps, state.network, state.optimizer, batch)
        losses = state.losses.copy()
        losses[number] = value
        state = State(network, memory, losses, state.seed, np.array(number + 1))
        if callback(state):
            break
    return state


@eqx.filter_jit
def _step(recipe: Recipe, steps: int, network: Any, memory: optax.OptState, batch: Any) -> tuple[Any, Any, Any]:
    value, gradient = jax.value_and_grad(recipe.loss)(network, batch)
    with jax.numpy_dtype_promotion("standard"):  # optax counts steps with integers
        updates, memory = recipe.optimizer(steps).update(gradient, memory, network)
    return optax.apply_updates(network, updates), memory, value


def write_checkpoint(path: PathLike, state: State) -> None:
    """Write a state exactly, as a whole or not at all."""
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        eqx.tree_serialise_leaves(file, state)


def read_checkpoint(path: PathLike, recipe: Recipe, *, steps: int, seed: int) -> State:
    """Read a state of the same recipe, number of steps and seed; nothing in the file is executed.

    Raises
    ------
    InputError
        If the file cannot be read or is of another training.
    """
    expected = init(recipe, steps=steps, seed=seed)
    description = f"checkpoint of this network and of {steps} steps"
    with decoding(check_input(path), description), open(path, "rb") as file:
        state = eqx.tree_deserialise_leaves(file, expected)
    if int(state.seed) != seed:
        raise InputError(f"{path}: the seed of the training must be {seed}, as given, got {int(state.seed)}.")
    return state


def paper_recipe() -> Recipe:
    """The paper's: RMSprop and mean squared error on synthetic polygons; the paper gives no rate."""
    return Recipe(paper_network, lambda steps: optax.rmsprop(3e-4), sample_paper_batch, slices_loss)


def multislice_recipe(stacks: list[Stack]) -> Recipe:
    """Adam with a cosine schedule, and mean squared error on simulated stacks."""
    offsets = eqx.filter_eval_shape(multislice_network, jax.random.key(0)).offsets
    batch = lambda rng: sample_patches(stacks, offsets, rng)
    return Recipe(multislice_network, partial(_adam, 1e-3), batch, slices_loss)


def unrolled_recipe(examples: "list[UnrolledExample]") -> Recipe:
    """Adam, and the logarithm of the squared error; its gradient passes the operators and their exact adjoints."""
    batch = lambda rng: examples[rng.integers(len(examples))]
    return Recipe(lambda key: initialize_unrolled(key=key), partial(_adam, 2e-3), batch, unrolled_loss)


def _adam(rate: float, steps: int) -> optax.GradientTransformation:
    schedule = optax.warmup_cosine_decay_schedule(0, rate, min(100, steps // 10), steps)
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))


def slices_loss(network: UNet, batch: Batch) -> Float[Array, ""]:
    """Weighted mean squared error over the voxels of a batch."""
    error = jax.vmap(network)(jnp.asarray(batch.slices)) - jnp.asarray(batch.truth)
    return jnp.mean(jnp.asarray(batch.weight) * jnp.mean(error**2, axis=(1, 2)))


class UnrolledExample(NamedTuple):
    """A capture above its offset, with the mean 1, its inverse problem, the truth, and the networks' first state."""

    light: Float32[np.ndarray, "row column"]
    system: InverseProblem
    truth: Volume
    start: UnrolledState


def unrolled_loss(network: Unrolled, example: UnrolledExample) -> Float[Array, ""]:
    """Common logarithm of the volume's squared error, relative to the truth's mean square and a share of the start's.

    The error itself is small for sparse scenes, which would count less than dense ones.
    """
    truth = jnp.asarray(example.truth)
    volume = unroll(network, example.system, jnp.asarray(example.light), example.start)
    start = network.estimate(example.start)
    error = jnp.mean((volume - truth) ** 2) / (jnp.mean(truth**2) + _START_SHARE * jnp.mean(start**2))
    return jnp.log10(error + _LEAST_ERROR)


def unroll(
    network: Unrolled, operator: Operator, light: Float[Array, "row column"], start: UnrolledState
) -> Float[Array, "depth y x"]:
    """Volume after the steps with networks."""

    def network_step(state, _):
        state, cost, _ = network.network_step(operator, light, state)
        return state, cost

    return network.estimate(lax.scan(network_step, start, length=network.power.size)[0])


def with_fixed_steps(network: Unrolled) -> Unrolled:
    """A trained network as it is used: with more steps before it, and conjugate gradients after it.

    On simulated captures ten of these gain 1.3 dB, and more than twelve no more. On ray-traced letters, which are whole
    captures, 20 steps before the networks give 14.5 dB above an empty volume; the 15 of training 3 dB less.
    """
    return dataclasses.replace(network, first=_FIRST, last=_LAST, steps=_FIRST + network.power.size + _LAST)


def simulate_unrolled_examples(
    count: int,
    seed: int,
    progress: Progress | None = None,
    spec: CaptureSpec = UNROLLED,
    workers: Workers | None = None,
) -> list[UnrolledExample]:
    """Simulate the first examples of a seed, by workers if there are any."""
    examples = {}
    for group in simulate_groups(partial(_simulator, seed, spec), range(count), progress, workers):
        examples |= group
    return [examples[number] for number in range(count)]


def _simulator(seed: int, spec: CaptureSpec):
    networks = initialize_unrolled(key=jax.random.key(0))

    def simulate(numbers: list[int]) -> dict[int, UnrolledExample]:
        examples, optics = {}, None
        for number in numbers:
            image, imager, grid, truth = simulate_example(seed, number, spec)
            # Of the calibrated microscope, which all of these numbers have in common.
            optics = optics or trace_optics(imager, np.asarray(grid.depths, np.float64), spec)
            light, unit = in_unit_of_mean(subtract_offset(image))
            system = InverseProblem(imager, grid, optics, lens_type_geometries(imager, grid))
            start = run_fixed_steps(networks, system, light)
            examples[number] = UnrolledExample(light, system, truth / unit, start)
        return examples

    return simulate


def in_unit_of_mean(light: Float32[np.ndarray, "row column"]) -> tuple[Float32[np.ndarray, "row column"], np.float32]:
    """Light relative to its mean absolute value, and that mean."""
    unit = np.float32(max(float(np.abs(light).mean()), 1e-30))
    return light / unit, unit


@eqx.filter_jit
def run_fixed_steps(
    networks: Unrolled, system: InverseProblem, light: Float[Array | np.ndarray, "row column"]
) -> UnrolledState:
    """The state after the steps without networks, which training does not change."""
    step = lambda state, _: networks.step(system, light, state)[:2]
    return lax.scan(step, networks.init(system, light), length=networks.first)[0]


# Captures at the least, and the share of them that is held out.
_LEAST, _HELD_OUT = 3, 4
_FOLDS = 4
# Steps between two looks at the captures held out, and looks without improvement after which the training ends.
_EVERY, _PATIENCE = 10, 3
# Rates of the networks' weights, and of the powers, of which each step has one.
_RATE, _POWER_RATE = 1e-3, 1e-2


class SplitCapture(NamedTuple):
    """A capture above its offset, with the mean 1, its inverse problem without a fold, and the state to begin with."""

    light: Float32[np.ndarray, "row column"]
    system: InverseProblem
    start: UnrolledState


class FineTuned(NamedTuple):
    """Networks, and squared errors of prediction, relative to the light.

    `losses` are those of each step, `held_out` those of the captures held out, `(step, loss)`, from before the first
    step on, both after the steps with networks. `before` and `after` are those of the captures held out after all
    steps, by the networks that it began with and by those that it returns, for lenses that are left out only here:
    those of `held_out` chose the networks.
    """

    networks: Unrolled
    losses: list[float]
    held_out: list[tuple[int, float]]
    before: float
    after: float


def fine_tune(
    images: Sequence[Image],
    imager: Imager,
    grid: Grid,
    networks: Unrolled,
    *,
    optics: Optics | str = "full",
    steps: int = 60,
    seed: int = 0,
    on_better: Callable[[Unrolled], None] = lambda networks: None,
    progress: Progress | None = None,
) -> FineTuned:
    """Train networks on, by captures of one microscope; every fourth of them decides when to stop.

    These also decide whether the conjugate gradients after the networks are left out, and whether the result is better
    at all: if not, the networks that it began with are returned.

    Parameters
    ----------
    images
        3 captures or more, of different scenes of one kind.
    imager, grid
        The microscope as it is known, and the voxels that are wanted.
    networks
        Those to begin with.
    optics
        As for `reconstruct`.
    steps, seed
        Most steps, and seed of their order.
    on_better
        Is called with networks that are better for the captures held out, after the steps with networks.
    progress
        Shows progress.

    Raises
    ------
    InputError
        If there are fewer than 3 captures, or fewer than 4 lenses.
    """
    check_number(images)
    progress = progress or Progress()
    trained, held_out, scored = _split(images, imager, grid, networks, optics, seed, progress)
    loss = eqx.filter_jit(prediction_loss)

    def mean_loss(networks: Unrolled) -> float:
        return float(np.mean([loss(networks, capture) for capture in held_out]))

    def error(networks: Unrolled, captures: list[SplitCapture]) -> float:
        """After all steps, also those without networks."""
        return float(np.mean([_error_of_all_steps(networks, capture, progress) for capture in captures]))

    recipe = Recipe(lambda key: networks, _optimizer, lambda rng: trained[rng.integers(len(trained))], prediction_loss)
    history, best = [(0, mean_loss(networks))], networks
    with progress.counter("Training", steps) as advance:

        def callback(state: State) -> bool:
            nonlocal best
            advance()
            if int(state.step) % _EVERY and int(state.step) < steps:
                return False
            value = mean_loss(state.network)
            if value < min(value for _, value in history):
                best = state.network
                on_better(best)
            history.append((int(state.step), value))
            return int(np.argmin([value for _, value in history])) < len(history) - _PATIENCE

        state = train(recipe, init(recipe, steps=steps, seed=seed), callback=callback)
    without = dataclasses.replace(best, last=0, steps=best.first + best.power.size)
    # Networks that did not change are scored once.
    tried = {id(candidate): candidate for candidate in (networks, best, without)}.values()
    chosen = min(tried, key=lambda candidate: error(candidate, held_out))
    before = error(networks, scored)
    after = before if chosen is networks else error(chosen, scored)
    return FineTuned(chosen, state.losses[: int(state.step)].tolist(), history, before, after)


def check_number(captures: Sequence) -> None:
    """Raise `InputError` if there are too few captures to train with."""
    if len(captures) < _LEAST:
        raise InputError(f"there must be {_LEAST} captures or more, of different scenes, got {len(captures)}.")


def prediction_loss(networks: Unrolled, capture: SplitCapture) -> Float[Array, ""]:
    """Squared error of the pixels predicted after the steps with networks."""
    light = jnp.asarray(capture.system.kept) * jnp.asarray(capture.light)
    return _squared_error(unroll(networks, capture.system, light, capture.start), capture)


def _error_of_all_steps(networks: Unrolled, capture: SplitCapture, progress: Progress) -> float:
    run = run_solver(networks, capture.system.kept * capture.light, capture.system, progress)
    return float(_squared_error(networks.estimate(run.state), capture))


@eqx.filter_jit
def _squared_error(volume, capture):
    """Squared error of the predicted pixels, relative to their light; the gain is that of the pixels used."""
    system, kept, light = capture.system, jnp.asarray(capture.system.kept), jnp.asarray(capture.light)
    whole: InverseProblem = dataclasses.replace(system, kept=None)
    A = ImagingOperator(whole.imager, whole.grid, whole.optics)
    shown = whole.detrend(A.mv(jnp.asarray(volume, light.dtype)))
    light = whole.detrend(light)
    gain = divide(jnp.vdot(kept * shown, light), jnp.vdot(kept * shown, shown))
    left_out = 1 - kept
    return jnp.sum(left_out * (light - gain * shown) ** 2) / jnp.sum(left_out * light**2)


def _optimizer(steps: int) -> optax.GradientTransformation:
    rate = lambda first: optax.adam(optax.cosine_decay_schedule(first, steps))
    adam: dict[Hashable, optax.GradientTransformation] = {"power": rate(_POWER_RATE), "layers": rate(_RATE)}

    def kinds(networks):
        names = jax.tree.map(lambda _: "layers", networks)
        return eqx.tree_at(lambda n: n.power, names, "power")

    return optax.chain(optax.clip_by_global_norm(1.0), optax.multi_transform(adam, kinds))


def _split(images, imager, grid, networks, optics, seed, progress) -> tuple[list[SplitCapture], ...]:
    """Captures without each of the folds, to train with; those held out without one of them, and without another.

    The first fold of those held out chooses the networks, so that its error is too small; the second only scores them.
    """
    model = prepare_model(imager, grid, optics, progress)
    model = dataclasses.replace(model, back_projections=lens_type_geometries(imager, grid))
    folds = kept_pixels_of_folds(model.imager, _FOLDS)
    order = np.random.default_rng(seed).permutation(len(images))
    trained, held_out, scored = [], [], []
    for place, number in enumerate(progress.track(order, "First steps")):
        light, background = prepare_data(images[number], model)
        light, _ = in_unit_of_mean(light - background)
        is_held_out = place % _HELD_OUT == 0
        for kept in [folds[place // _HELD_OUT % _FOLDS]] if is_held_out else folds:
            system = dataclasses.replace(model, kept=kept)
            start = run_fixed_steps(networks, system, kept * light)
            (held_out if is_held_out else trained).append(SplitCapture(light, system, start))
        if is_held_out:
            kept = folds[(place // _HELD_OUT + 1) % _FOLDS]
            # All steps are run for the score: it has no use for a start.
            scored.append(held_out[-1]._replace(system=dataclasses.replace(held_out[-1].system, kept=kept)))
    return trained, held_out, scored
