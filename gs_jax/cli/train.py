"""`gs-jax train`: weights of the networks."""

from functools import partial
from pathlib import Path
from typing import Any

import click

from ..base.errors import InputError
from ..base.progress import Progress
from ..base.workers import Workers
from ..io.files import check_output, checkpoint_path, side_file, write_json
from .command import PARTIAL, RESUMABLE, check_may_write, force_option, partial_outputs, provenance_of
from .light import LIGHT_OPTIONS, Light, check_beyond, sample_options
from .options import (
    CAPTURE_OPTIONS,
    DESIGN,
    UM,
    CaptureOptions,
    Depths,
    capture_options,
    given_options,
    worker_options,
)

# Steps of the weights that come with the package.
STEPS = {"paper": 2000, "multislice": 4000, "unrolled": 1400}
# At most, to fine-tune by captures.
FINE_STEPS = 60
_EVERY = 50
_STACKS, _CASES = 96, 128
_DEFAULTS = ", ".join(f"{steps} for {name}" for name, steps in STEPS.items())


@click.command("train", epilog="Example: gs-jax train --network unrolled -o weights.npz")
@click.option("--network", type=click.Choice(list(STEPS)), help="[default: multislice]")
@click.option(
    "--steps",
    type=click.IntRange(1, 10**7),
    help=f"Number of steps.  [default: {_DEFAULTS}; at most {FINE_STEPS} with --from-captures]",
)
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0)
@click.option("--resume", is_flag=True, help="Continue from the checkpoint beside WEIGHTS; same steps and seed.")
@click.option("-o", "--output", type=Path, required=True, help="WEIGHTS.npz.")
@click.option(
    "--from-captures",
    type=Path,
    help="Folder of 3 or more captures: train the unrolled networks on, by lenses predicted from the others, without "
    "ground truth. Needs --design and --depths.",
)
@click.option("--design", type=DESIGN, help="The microscope of the captures.")
@click.option("--depths", type=Depths(), help="START:STOP:STEP in mm of the volumes, as in `gs-jax reconstruct`.")
@click.option("--voxel-um", type=UM, help="Lateral voxel pitch.  [default: 4 pixels as seen at the middle depth]")
@click.option("--weights", type=Path, help="WEIGHTS.npz to begin with.  [default: ours]")
@sample_options
@worker_options
@capture_options
@force_option
def train_command(
    network: str | None,
    steps: int | None,
    seed: int,
    resume: bool,
    output: Path,
    workers: Workers,
    camera: CaptureOptions,
    light: Light,
    from_captures: Path | None,
    **mine: Any,
):
    """Train a network: for background suppression the paper's, or ours of seven slices; or for the unrolled inversion.

    Workers simulate the captures for training. Beside WEIGHTS.npz are written WEIGHTS.npz.json, the losses,
    WEIGHTS.npz.checkpoint, which remains after an interrupt, and for multislice the folder WEIGHTS-stacks of simulated
    captures (0.4 GB), which may be deleted.

    \b
    Fine-tune the unrolled inversion by your own captures, of several scenes of one kind:
    gs-jax train --from-captures run7 --design mine.toml --depths 18:22:0.5 -o tuned.npz

    First, one factor of all radii is fitted, as the focus may differ from the design's. It is 1 unless another lowers
    the error of prediction by 5 % or more. The design with these radii is written beside WEIGHTS.npz, as WEIGHTS.toml.
    """
    check_output(output, [".npz"])
    if from_captures:
        alone = () if network == "unrolled" else ("network",)
        if given := given_options((*alone, "resume", "workers", "scheduler")):
            raise InputError(f"--from-captures trains the unrolled networks in this process, got {given[0]}.")
        return _from_captures(from_captures, output, steps or FINE_STEPS, seed, camera, light, **mine)
    if given := given_options((*mine, *CAPTURE_OPTIONS, *LIGHT_OPTIONS)):
        raise InputError(f"{given[0]} must be used with --from-captures.")
    network = network or "multislice"
    if network == "paper" and (given := given_options(("workers", "scheduler"))):
        raise InputError(
            f"{given[0]} must be used with multislice or unrolled, got paper, which simulates no captures."
        )
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
    from ..reconstruction.networks import write_unrolled

    steps = steps or STEPS[network]
    checkpoint, history = checkpoint_path(output, resume=resume), side_file(output, ".json")
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


def _from_captures(
    folder: Path,
    output: Path,
    steps: int,
    seed: int,
    camera: CaptureOptions,
    light: Light,
    *,
    design: Path | None,
    depths: list[float] | None,
    voxel_um: float | None,
    weights: Path | None,
    force: bool,
) -> None:
    import numpy as np

    from ..apps.training.from_captures import check_number, fine_tune
    from ..design.design import design_text, read_design, write_design
    from ..io.recordings import capture_files
    from ..reconstruction.networks import read_unrolled, write_unrolled
    from ..reconstruction.pipeline import PIXELS_PER_VOXEL, voxel_grid
    from ..reconstruction.radius_fit import fit_radius
    from ..solvers.unrolled import Unrolled

    if design is None or depths is None:
        raise InputError("--from-captures must be used with --design and --depths.")
    files = capture_files(folder)
    if files is None:
        raise InputError(f"--from-captures must be a folder of captures, got {folder}.")
    check_number(files)
    history, made = side_file(output, ".json"), output.with_suffix(".toml")
    if made.exists() and design.exists() and made.samefile(design):
        raise InputError(
            f"-o must have another name than {design}: the fitted design is written beside WEIGHTS, got {output}."
        )
    check_may_write(output, history, made, inputs=(*files, design, weights, *camera.files), force=force)
    microscope = light.design(read_design(design))
    imager = camera.imager(microscope.imager())
    check_beyond(imager, depths, "--depths")
    grid = voxel_grid(imager, depths, voxel_um and voxel_um / 1000, pixels=PIXELS_PER_VOXEL)
    start = read_unrolled(weights) if weights else Unrolled.pretrained()
    record = camera.recorded(provenance_of(folder, design, weights, *camera.files))
    with Progress() as progress:
        images = [camera.read(file) for file in files]
        radius = fit_radius(images, imager, grid, start, progress=progress)
        record |= {"radius_factor": f"{radius.factor:.6g}"}
        scaled = lambda value: None if value is None else np.round(radius.factor * np.array(value), 6)
        microscope = microscope.replace(
            radius_of_curvature_mm=scaled(microscope.lens.radius_of_curvature_mm),
            focal_length_mm=scaled(microscope.lens.focal_length_mm),
            provenance={**microscope.provenance, **record},
        )
        provenance = provenance_of(folder, design, weights, *camera.files, design=design_text(microscope))

        def keep(networks):
            write_design(made, microscope)
            write_unrolled(output, networks, provenance)
            partial_outputs.update({made: PARTIAL, output: PARTIAL})

        how = {"steps": steps, "seed": seed, "on_better": keep, "progress": progress}
        found = fine_tune(images, radius.imager, grid, start, **how)
        keep(found.networks)
        held_out = [{"step": step, "loss": loss} for step, loss in found.held_out]
        numbers = {"loss": found.losses, "held_out": held_out, "before": found.before, "after": found.after}
        trials = [{"factor": factor, "rms_error": error} for factor, error in radius.trials]
        write_json(history, {"seed": seed, "radius_factor": radius.factor, "radius_trials": trials} | numbers)
    camera.print_corrections()
    errors = dict(radius.trials)
    words = f"radii {radius.factor - 1:+.1%}, by an error of {errors[radius.factor]:.1%} of lenses left out"
    click.echo(f"{made}: {words} ({errors[1.0]:.1%} with the radii of {design}, RMS)")
    error = f"{found.before**0.5:.1%} before, {found.after**0.5:.1%} after (RMS)"
    words = f"{len(files)} captures, {len(found.losses)} steps"
    click.echo(
        f"{output}: {words}; of captures held out, lenses that were not used in the choice are predicted with an "
        f"error of {error}"
    )
