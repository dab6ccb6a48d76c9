"""`gs-jax pareto`: what one thing costs in another."""

from pathlib import Path

import click

from ..base.progress import Progress
from ..base.workers import Workers
from ..io.files import check_output, make_folder, write_json
from .files import check_may_write, provenance_of
from .interrupt import PARTIAL, kept
from .options import worker_options


@click.command("pareto", epilog="Example: gs-jax pareto design/studies/geomscope-sharpness.toml --out front")
@click.argument("study", type=Path)
@click.option("--out", type=Path, default=Path("gs-jax-pareto"), show_default=True, help="Folder to write to.")
@worker_options
def command(study: Path, out: Path, workers: Workers):
    """Show the trade-off that the file STUDY asks for: its one goal against one or two moving limits.

    The folder gets pareto.json, the designs' numbers, which grows as they are found, and pareto.png.
    """
    import jax
    from rich.console import Console
    from rich.table import Table

    from ..base.errors import errors_name_file
    from ..codesign.pareto import as_json, picture, sweep_of, trade_off
    from ..codesign.study import parent_path, read_study
    from ..design.design import design_text, read_design
    from ..io.files import write_figure
    from ..io.provenance import KEY

    # Searches end within a billionth of the minimum; single precision stops far from it.
    jax.config.update("jax_enable_x64", True)
    question = read_study(study)
    start = parent_path(study, question)
    parent = read_design(start)
    with errors_name_file(study):
        sweep_of(parent, question)
    make_folder(out)
    numbers, drawing = check_output(out / "pareto.json", [".json"]), check_output(out / "pareto.png", [".png"])
    check_may_write(numbers, drawing, inputs=(study, start))
    provenance = provenance_of(study, start, design=design_text(parent))

    def each(front):
        write_json(numbers, {KEY: provenance} | as_json(front))
        kept[numbers] = PARTIAL

    with Progress() as progress, workers, errors_name_file(study):
        front = trade_off(parent, question, each=each, progress=progress, workers=workers)
    write_figure(drawing, picture(front))
    table = Table(*(term.name for term in front.objectives), "", box=None, pad_edge=False)
    for row, point, best in zip(front.values, front.points, front.best, strict=True):
        status = "" if best else "dominated" if point.feasible else "misses a target"
        table.add_row(*(f"{x:.4g}" for x in row), status)
    Console().print(table)
    click.echo(f"{drawing}: {front.best.sum()} of {len(front.points)} points on the front")
