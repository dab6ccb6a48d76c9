"""`gs-jax optimize`: a better design."""

from pathlib import Path

import click

from ..base.errors import InputError
from ..base.progress import Progress
from ..base.workers import Workers
from .files import check_may_write, force_option, provenance_of
from .interrupt import RESUMABLE, kept
from .options import DESIGN, worker_options


@click.command(
    "optimize",
    epilog="Example: gs-jax optimize design/geomscope-table1.toml --study study.toml -o new.toml",
)
@click.argument("design", type=DESIGN)
@click.option("--study", type=Path, required=True, help="STUDY.toml: what is free, what is wanted, which solvers.")
@click.option("--resume", is_flag=True, help="Go on from the checkpoint that an interrupted run left beside NEW.toml.")
@click.option("-o", "--output", type=Path, required=True, help="NEW.toml; numbers and a picture go beside it.")
@worker_options
@force_option
def command(design: Path, study: Path, resume: bool, output: Path, force: bool, workers: Workers):
    """Search for a better microscope than that of the file DESIGN, and show before and after.

    Beside NEW.toml are written NEW.json (the terms, every start and step) and NEW.png (layout and history). Workers run
    the starts of the study's first stage.
    """
    import jax
    from rich.console import Console

    from ..codesign import search
    from ..codesign.checkpoint import checkpoint_path
    from ..codesign.outcome import before_and_after, check_outputs, write_outcome

    check_outputs(output)
    beside = (output.with_suffix(suffix) for suffix in (".json", ".png"))
    check_may_write(output, *beside, inputs=(design, study), force=force)
    # Searches end within a billionth of the minimum; single precision stops far from it.
    jax.config.update("jax_enable_x64", True)
    checkpoint = checkpoint_path(output)
    if resume and not checkpoint.exists():
        raise InputError(f"--resume: found no checkpoint {checkpoint}, allowed: after an interrupted run alone.")
    kept[checkpoint] = RESUMABLE
    with Progress() as progress, workers:
        how = {"progress": progress, "checkpoint": checkpoint, "resume": resume, "workers": workers}
        outcome = search.run_study(design, study, **how)
    write_outcome(output, outcome, parent=design, source=study, provenance=provenance_of(design, study))
    checkpoint.unlink(missing_ok=True)
    Console().print(before_and_after(outcome))
    for end in outcome.log.ends:
        click.echo(f"stage {end['stage'] + 1}, start {end['start']}: {end['reason']} ({end['steps']} steps)")
    click.echo(f"{output}: {outcome.design.name}, from {outcome.parent.name} in {outcome.seconds:.0f} s")
