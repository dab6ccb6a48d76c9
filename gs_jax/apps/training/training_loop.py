"""Training of a network by a recipe, with checkpoints from which it goes on exactly."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
import optax
from jaxtyping import Array, Float, Float32, PRNGKeyArray

from ...base.errors import InputError
from ...io.files import atomic_write, check_input, decoding
from ...typing import PathLike


class Recipe(NamedTuple):
    """How a network is made and trained.

    Parameters
    ----------
    network
        Makes it from a key.
    optimizer
        Makes it for a number of steps.
    batch
        Draws one with a generator of random numbers.
    loss
        Of a network and a batch.
    """

    network: Callable[[PRNGKeyArray], Any]
    optimizer: Callable[[int], optax.GradientTransformation]
    batch: Callable[[np.random.Generator], Any]
    loss: Callable[[Any, Any], Float[Array, ""]]


class State(eqx.Module):
    """Where a training is: everything that decides how it goes on.

    Parameters
    ----------
    network, optimizer
        The weights, and what the optimizer remembers.
    losses
        One a step; those of steps to come are NaN.
    seed, step
        Which training it is, and the steps that are done.
    """

    network: Any
    optimizer: optax.OptState
    losses: Float32[np.ndarray, " step"]
    seed: np.ndarray
    step: np.ndarray


def start(recipe: Recipe, *, steps: int, seed: int) -> State:
    """A training of `steps` steps before the first."""
    network: Any = recipe.network(jax.random.key(seed))  # optax does not know that modules are trees
    memory = recipe.optimizer(steps).init(network)
    return State(network, memory, np.full(steps, np.nan, np.float32), np.array(seed), np.array(0))


def train(recipe: Recipe, state: State, *, each: Callable[[State], None] = lambda state: None) -> State:
    """The rest of a training. `each` is called with the state after every step.

    The batch of a step follows from the seed and the step alone, so that a training that goes on from a checkpoint
    ends with the weights that it would have had without the interruption.
    """
    steps = len(state.losses)
    for number in range(int(state.step), steps):
        batch = recipe.batch(np.random.default_rng([int(state.seed), 1, number]))
        network, memory, value = _step(recipe, steps, state.network, state.optimizer, batch)
        losses = state.losses.copy()
        losses[number] = value
        state = State(network, memory, losses, state.seed, np.array(number + 1))
        each(state)
    return state


@eqx.filter_jit
def _step(recipe: Recipe, steps: int, network: Any, memory: optax.OptState, batch: Any) -> tuple[Any, Any, Any]:
    value, gradient = jax.value_and_grad(recipe.loss)(network, batch)
    with jax.numpy_dtype_promotion("standard"):  # optax counts steps with integers
        updates, memory = recipe.optimizer(steps).update(gradient, memory, network)
    return optax.apply_updates(network, updates), memory, value


def write_checkpoint(path: PathLike, state: State) -> None:
    """Writes a state, exactly, whole or not at all."""
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        eqx.tree_serialise_leaves(file, state)


def read_checkpoint(path: PathLike, recipe: Recipe, *, steps: int, seed: int) -> State:
    """The state in a file of `write_checkpoint`, of the same recipe, number of steps and seed.

    Raises
    ------
    InputError
        If the file cannot be read or is of another training. Nothing in it is ever executed.
    """
    expected = start(recipe, steps=steps, seed=seed)
    kind = f"checkpoint of this network and of {steps} steps"
    with decoding(check_input(path), kind), open(path, "rb") as file:
        state = eqx.tree_deserialise_leaves(file, expected)
    if int(state.seed) != seed:
        raise InputError(f"{path}: found a training of seed {int(state.seed)}, allowed: of the seed given, {seed}.")
    return state
