"""`gs-jax optimize` and `gs-jax pareto`: searches for better designs."""

from pathlib import Path

import click

from ..base.errors import InputError
from ..base.progress import Progress
from ..base.workers import Workers
from ..io.files import check_output, checkpoint_path, make_folder, write_json
from .command import PARTIAL, RESUMABLE, check_may_write, force_option, partial_outputs, provenance_of
from .options import DESIGN, terms_option, worker_options


@click.command("optimize", epilog="Example: gs-jax optimize design/geomscope.toml --study study.toml -o new.toml")
@click.argument("design", type=DESIGN)
@click.option("--study", type=Path, required=True, help="STUDY.toml: free parameters, goals and solvers.")
@terms_option
@click.option("--resume", is_flag=True, help="Continue from the checkpoint of an interrupted run beside NEW.toml.")
@click.option("-o", "--output", type=Path, required=True, help="NEW.toml; numbers and a picture are written beside it.")
@worker_options
@force_option
def optimize_command(
    design: Path, study: Path, terms: Path | None, resume: bool, output: Path, force: bool, workers: Workers
):
    """Search for a better microscope than that of the file DESIGN, and compare both.

    NEW.toml.json (the terms, every start and step) and NEW.toml.png (layout and history) are written beside it. Workers
    run the starts of the study's first stage.
    """
    import jax
    from rich.console import Console

    from ..codesign import search
    from ..codesign.search_report import before_and_after, check_outputs, side_files, write_outcome
    from ..codesign.terms import add_terms

    check_outputs(output)
    check_may_write(output, *side_files(output), inputs=(design, study, terms), force=force)
    # Single precision stops far from the minimum.
    jax.config.update("jax_enable_x64", True)
    checkpoint = checkpoint_path(output, resume=resume)
    if resume and not checkpoint.exists():
        raise InputError(f"--resume must be used after an interrupted run, got no checkpoint {checkpoint}.")
    if terms is not None:
        add_terms(terms)
    partial_outputs[checkpoint] = RESUMABLE
    with Progress() as progress, workers:
        how = {"progress": progress, "checkpoint": checkpoint, "resume": resume, "workers": workers}
        outcome = search.run_study(design, study, **how)
    write_outcome(output, outcome, parent=design, source=study, provenance=provenance_of(design, study, terms))
    checkpoint.unlink(missing_ok=True)
    Console().print(before_and_after(outcome))
    for end in outcome.log.ends:
        click.echo(f"stage {end['stage'] + 1}, start {end['start']}: {end['reason']} ({end['steps']} steps)")
    click.echo(f"{output}: {outcome.design.name}, from {outcome.parent.name} in {outcome.seconds:.0f} s")


@click.command("pareto", epilog="Example: gs-jax pareto design/studies/geomscope-sharpness.toml --out front")
@click.argument("study", type=Path)
@click.option("--out", type=Path, default=Path("gs-jax-pareto"), help="Folder to write to.")
@terms_option
@worker_options
def pareto_command(study: Path, out: Path, terms: Path | None, workers: Workers):
    """Compute the trade-off of the file STUDY: its one goal against one or two moving limits.

    The folder gets pareto.json, to which each design is added when it is found, and pareto.png.
    """
    import jax
    from rich.console import Console
    from rich.table import Table

    from ..base.errors import errors_name_file
    from ..codesign.pareto import as_json, picture, sweep_of, trade_off
    from ..codesign.study import parent_path, read_study
    from ..codesign.terms import SIGNS, add_terms
    from ..design.design import design_text, read_design
    from ..io.files import write_figure
    from ..io.provenance import KEY

    # Single precision stops far from the minimum.
    jax.config.update("jax_enable_x64", True)
    if terms is not None:
        add_terms(terms)
    question = read_study(study)
    start = parent_path(study, question)
    parent = read_design(start)
    with errors_name_file(study):
        sweep_of(parent, question)
    make_folder(out)
    numbers, drawing = check_output(out / "pareto.json", [".json"]), check_output(out / "pareto.png", [".png"])
    check_may_write(numbers, drawing, inputs=(study, start, terms))
    provenance = provenance_of(study, start, terms, design=design_text(parent))

    def each(front):
        write_json(numbers, {KEY: provenance} | as_json(front))
        partial_outputs[numbers] = PARTIAL

    with Progress() as progress, workers:
        front = trade_off(parent, question, each=each, progress=progress, workers=workers)
    write_figure(drawing, picture(front))
    limits = [f"{term.name} {SIGNS[term.kind]}" for term in front.objectives[1:]]
    table = Table(*limits, *(term.name for term in front.objectives), "", box=None, pad_edge=False)
    for row, point, best in zip(front.values, front.points, front.best, strict=True):
        status = "" if best else "dominated" if point.feasible else "misses a target"
        table.add_row(*(f"{x:g}" for x in point.limits), *(f"{x:.4g}" for x in row), status)
    Console().print(table)
    click.echo(f"{drawing}: {front.best.sum()} of {len(front.points)} points on the front")
