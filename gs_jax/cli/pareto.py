"""`gs-jax pareto`: what one thing costs in another."""

from pathlib import Path

import click
import jax
from rich.console import Console
from rich.table import Table

from ..base.errors import InputError, errors_name_file
from ..base.progress import Progress
from ..codesign.pareto import as_json, picture, sweep
from ..codesign.search import problem_of
from ..codesign.study import parent_path, read_study
from ..designs.design import read_design
from ..io.disk import check_output, make_folder, write_json
from ..io.figures import write_figure


@click.command("pareto")
@click.argument("study", type=Path)
@click.option("--out", type=Path, default=Path("gs-jax-pareto"), show_default=True, help="Folder to write to.")
def command(study: Path, out: Path):
    """Show the trade-off that the file STUDY asks for: its one goal against one or two moving limits.

    The folder gets pareto.json, the designs' numbers, and pareto.png.
    """
    # Searches end within a billionth of the minimum; single precision stops far from it.
    jax.config.update("jax_enable_x64", True)
    question = read_study(study)
    if not question.pareto:
        raise InputError(f"{study}: `pareto`: found nothing, allowed: one or two tables.")
    design = read_design(parent_path(study, question))
    with errors_name_file(study):
        problem_of(design, question)
    make_folder(out)
    numbers, drawing = check_output(out / "pareto.json", [".json"]), check_output(out / "pareto.png", [".png"])
    with Progress() as progress, errors_name_file(study):
        front = sweep(design, question, progress=progress)
    write_json(numbers, as_json(front))
    write_figure(drawing, picture(front))
    table = Table(*(term.name for term in front.objectives), "", box=None, pad_edge=False)
    for row, point, best in zip(front.values, front.points, front.best, strict=True):
        status = "" if best else "dominated" if point.feasible else "misses a target"
        table.add_row(*(f"{x:.4g}" for x in row), status)
    Console().print(table)
    click.echo(f"{drawing}: {front.best.sum()} of {len(front.points)} points on the front")
