"""Fine-tuning of the unrolled networks by one's own captures, without a truth: lenses are predicted from the others.

A network is as good as its volumes predict the light of lenses that the reconstruction did not use (measurement
splitting; Moran et al., "Noisier2Noise", arXiv:1910.11908, and Yaman et al., Magn. Reson. Med. 84, 3172, 2020, for
other instruments). The noise of a pixel is independent of its prediction, whatever its distribution: in the mean it
adds a constant, so that the best network is the best for captures without noise, too.
"""

import dataclasses
from collections.abc import Callable, Hashable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Float32

from ..base.arrays import divide
from ..base.errors import InputError
from ..base.progress import Progress
from ..geometry import Imager
from ..grid import Grid
from ..projection.forward_model import Optics
from ..projection.operators import ImagingOperator
from ..reconstruction.inverse_problem import (
    InverseProblem,
    lens_type_geometries,
    prepare_data,
    prepare_model,
)
from ..reconstruction.residual import kept_pixels_of_folds
from ..solvers.base import run_solver
from ..solvers.unrolled import State as UnrolledState, Unrolled
from ..typing import Image
from .training import Recipe, State, in_unit_of_mean, init, run_fixed_steps, train, unroll

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
