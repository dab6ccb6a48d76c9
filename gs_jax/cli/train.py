"""`gs-jax train`: weights of the networks."""

from functools import partial
from pathlib import Path

import click

from ..base.errors import InputError
from ..base.machine import Workers
from ..base.progress import Progress
from ..io.files import check_output, write_json
from .options import worker_options
from .outputs import RESUMABLE, check_may_write, partial_outputs, provenance_of

# Steps of the weights that come with the package.
STEPS = {"paper": 2000, "multislice": 4000, "unrolled": 1200}
_EVERY = 50
_STACKS, _CASES = 96, 112
_DEFAULTS = ", ".join(f"{steps} for {name}" for name, steps in STEPS.items())


@click.command("train", epilog="Example: gs-jax train --network unrolled -o weights.npz")
@click.option("--network", type=click.Choice(list(STEPS)), default="multislice")
@click.option("--steps", type=click.IntRange(1, 10**7), help=f"Number of steps.  [default: {_DEFAULTS}]")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0)
@click.option("--resume", is_flag=True, help="Continue from the checkpoint beside WEIGHTS; same steps and seed.")
@click.option("-o", "--output", type=Path, required=True, help="WEIGHTS.npz.")
@worker_options
def train_command(network: str, steps: int | None, seed: int, resume: bool, output: Path, workers: Workers):
    """Train a network: for background suppression the paper's, or ours of seven slices; or for the unrolled inversion.

    Workers simulate the captures for training. Beside WEIGHTS.npz are written WEIGHTS.json, the losses,
    WEIGHTS.checkpoint, which remains after an interrupt, and for multislice the folder WEIGHTS-stacks of simulated
    captures (0.4 GB), which may be deleted.
    """
    import numpy as np

    from ..apps.training.training_loop import (
        init,
        multislice_recipe,
        paper_recipe,
        read_checkpoint,
        simulate_unrolled_examples,
        train as run,
        unrolled_recipe,
        with_fixed_steps,
        write_checkpoint,
    )
    from ..apps.training.training_slices import simulate_stacks
    from ..detection.unet import write_weights
    from ..solvers.unrolled import write_unrolled

    check_output(output, [".npz"])
    steps = steps or STEPS[network]
    checkpoint, history = output.with_suffix(".checkpoint"), output.with_suffix(".json")
    check_output(history, [".json"])
    check_may_write(output, history, inputs=())
    partial_outputs[checkpoint] = RESUMABLE
    if resume and not checkpoint.exists():
        raise InputError(f"--resume must be used after an interrupted run, got no checkpoint {checkpoint}.")
    with Progress() as progress:
        if network == "paper":
            recipe = paper_recipe()
        elif network == "multislice":
            folder = output.with_name(f"{output.stem}-stacks")
            with workers:
                recipe = multislice_recipe(simulate_stacks(folder, _STACKS, seed, progress, workers=workers))
        else:
            with workers:
                recipe = unrolled_recipe(simulate_unrolled_examples(_CASES, seed, progress, workers=workers))
        begin = partial(read_checkpoint, checkpoint) if resume else init
        state = begin(recipe, steps=steps, seed=seed)
        with progress.counter("Training", steps - int(state.step)) as advance:

            def callback(state):
                done = int(state.step)
                if done % _EVERY == 0 or done in (1, steps):
                    write_checkpoint(checkpoint, state)
                    write_json(history, {"seed": seed, "steps": steps, "loss": state.losses[:done]})
                advance()

            state = run(recipe, state, callback=callback)
    if network == "unrolled":
        write_unrolled(output, with_fixed_steps(state.network), provenance_of())
    else:
        write_weights(output, state.network, provenance_of())
    click.echo(f"{output}: {network}, {steps} steps, loss {np.mean(state.losses[-_EVERY:]):.4f}")
