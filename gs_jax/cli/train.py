"""`gs-jax train`: weights of the networks."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import click

from ..base.errors import InputError
from ..base.progress import Progress
from ..io.files import check_output, checkpoint_path, side_file, write_json
from .commands import (
    PARTIAL,
    RESUMABLE,
    OptionGroup,
    check_outputs,
    command,
    given_options,
    partial_outputs,
    provenance_of,
)
from .options import (
    CAPTURE_OPTIONS,
    LIGHT_OPTIONS,
    CaptureOptions,
    DepthList,
    DesignPath,
    Light,
    Seed,
    Um,
    WorkerOptions,
)

# Steps of the weights that come with the package; and at most, to fine-tune by captures.
STEPS = {"paper": 2000, "multislice": 4000, "unrolled": 1400}
FINE_STEPS = 60
_EVERY = 50
_STACKS, _CASES = 96, 128


@dataclass
class FineTuning(OptionGroup):
    """The microscope and the volumes of captures from which networks are trained, and the weights to begin with.

    Options:
        design: The microscope of the captures.
        depths: START:STOP:STEP in mm of the volumes, as in `gs-jax reconstruct`.
        voxel_um: Lateral voxel pitch. [default: 4 pixels as seen at the middle depth]
        weights: WEIGHTS.npz to begin with. [default: ours]
    """

    design: DesignPath | None = None
    depths: DepthList | None = None
    voxel_um: Um | None = None
    weights: Path | None = None
    force: bool = False


@command("train", "Example: gs-jax train --network unrolled -o weights.npz")
def train_command(
    *,
    network: Annotated[str, click.Choice(list(STEPS))] | None = None,
    steps: Annotated[int, click.IntRange(1, 10**7)] | None = None,
    seed: Seed = 0,
    resume: bool = False,
    output: Path,
    from_captures: Path | None = None,
    tuning: FineTuning,
    light: Light,
    workers: WorkerOptions,
    camera: CaptureOptions,
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

    Options:
        network: The network to train. [default: multislice]
        steps: Number of steps. [default: 2000 for paper, 4000 for multislice, 1400 for unrolled; at most 60 with
            --from-captures]
        seed: Seed of the examples.
        resume: Continue from the checkpoint beside WEIGHTS; same steps and seed.
        output: WEIGHTS.npz.
        from_captures: Folder of 3 or more captures: train the unrolled networks on, by lenses predicted from the
            others, without ground truth. Needs --design and --depths.
    """
    check_output(output, [".npz"])
    if from_captures:
        alone = () if network == "unrolled" else ("network",)
        if given := given_options((*alone, "resume", "workers", "scheduler")):
            raise InputError(f"--from-captures trains the unrolled networks in this process, got {given[0]}.")
        return _from_captures(from_captures, output, steps or FINE_STEPS, seed, camera, light, tuning)
    if given := given_options((*vars(tuning), *CAPTURE_OPTIONS, *LIGHT_OPTIONS)):
        raise InputError(f"{given[0]} must be used with --from-captures.")
    network = network or "multislice"
    if network == "paper" and (given := given_options(("workers", "scheduler"))):
        raise InputError(
            f"{given[0]} must be used with multislice or unrolled, got paper, which simulates no captures."
        )
    import numpy as np

    from ..apps.training import (
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
    from ..apps.training_data import simulate_stacks
    from ..detection.unet import write_weights
    from ..reconstruction.networks import write_unrolled

    steps = steps or STEPS[network]
    checkpoint, history = checkpoint_path(output, resume=resume), side_file(output, ".json")
    check_outputs(output, [".npz"], history)
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
    tuning: FineTuning,
) -> None:
    import numpy as np

    from ..apps.training import check_number, fine_tune
    from ..design.design import write_design
    from ..io.recordings import capture_files
    from ..microscope.geometry import check_beyond
    from ..reconstruction.networks import read_unrolled, write_unrolled
    from ..reconstruction.pipeline import PIXELS_PER_VOXEL, voxel_grid
    from ..reconstruction.radius_fit import fit_radius
    from ..solvers.unrolled import Unrolled

    design, depths, weights = tuning.design, tuning.depths, tuning.weights
    if design is None or depths is None:
        raise InputError("--from-captures must be used with --design and --depths.")
    files = capture_files(folder)
    if files is None:
        raise InputError(f"--from-captures must be a folder of captures, got {folder}.")
    check_number(files)
    history, scaled = side_file(output, ".json"), output.with_suffix(".toml")
    if scaled.exists() and design.exists() and scaled.samefile(design):
        raise InputError(
            f"-o must have another name than {design}: the fitted design is written beside WEIGHTS, got {output}."
        )
    inputs = (design, weights, *camera.files)
    check_outputs(output, [".npz"], history, scaled, inputs=(*files, *inputs), force=tuning.force)
    microscope = light.read_design(design)
    imager = camera.imager(microscope.imager())
    check_beyond(imager, depths, "--depths")
    grid = voxel_grid(imager, depths, tuning.voxel_um and tuning.voxel_um / 1000, pixels=PIXELS_PER_VOXEL)
    start = read_unrolled(weights) if weights else Unrolled.pretrained()
    record = camera.recorded(provenance_of(folder, *inputs))
    with Progress() as progress:
        images = [camera.read(file) for file in files]
        radius = fit_radius(images, imager, grid, start, progress=progress)
        record |= {"radius_factor": f"{radius.factor:.6g}"}
        lengths = {key: getattr(microscope.lens, key) for key in ("radius_of_curvature_mm", "focal_length_mm")}
        lengths = {key: np.round(radius.factor * np.array(value), 6) for key, value in lengths.items() if value}
        microscope = microscope.replace(**lengths, provenance={**microscope.provenance, **record})
        provenance = provenance_of(folder, *inputs, design=microscope)

        def keep(networks):
            write_design(scaled, microscope)
            write_unrolled(output, networks, provenance)
            partial_outputs.update({scaled: PARTIAL, output: PARTIAL})

        options = {"steps": steps, "seed": seed, "on_better": keep, "progress": progress}
        tuned = fine_tune(images, radius.imager, grid, start, **options)
        keep(tuned.networks)
        held_out = [{"step": step, "loss": loss} for step, loss in tuned.held_out]
        numbers = {"loss": tuned.losses, "held_out": held_out, "before": tuned.before, "after": tuned.after}
        trials = [{"factor": factor, "rms_error": error} for factor, error in radius.trials]
        write_json(history, {"seed": seed, "radius_factor": radius.factor, "radius_trials": trials} | numbers)
    camera.print_corrections()
    errors = dict(radius.trials)
    text = f"radii {radius.factor - 1:+.1%}, by an error of {errors[radius.factor]:.1%} of lenses left out"
    click.echo(f"{scaled}: {text} ({errors[1.0]:.1%} with the radii of {design}, RMS)")
    click.echo(
        f"{output}: {len(files)} captures, {len(tuned.losses)} steps; of captures held out, lenses that were not used "
        f"in the choice are predicted with an error of {tuned.before**0.5:.1%} before, {tuned.after**0.5:.1%} after "
        "(RMS)"
    )
