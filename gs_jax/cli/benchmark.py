"""`gs-jax benchmark`: the paper's Fig. 9."""

from pathlib import Path

import click

from ..base.progress import Progress
from ..io.files import make_folder
from .files import provenance_of
from .interrupt import PARTIAL, kept


@click.command("benchmark", epilog="Example: gs-jax benchmark --out benchmark")
@click.option("--out", type=Path, default=Path("gs-jax-benchmark"), show_default=True, help="Folder to write to.")
def command(out: Path):
    """Compare back-projection with ADMM, Richardson-Lucy and others: time, memory and quality (the paper's Fig. 9)."""
    from ..apps.benchmark_report import write, write_records
    from ..apps.method_benchmark import run

    folder = make_folder(out)
    numbers, provenance = folder / "benchmark.json", provenance_of()

    def each(records):
        write_records(numbers, records, provenance)
        kept[numbers] = PARTIAL

    with Progress() as progress:
        records, left_out = run(each=each, progress=progress)
    write(records, left_out, folder, provenance)
    for missing in left_out:
        click.echo(f"left out: {missing['method']} at {missing['pairs']:.1e} pairs: {missing['reason']}")
    click.echo(f"{folder}: benchmark.json, .csv, .md and .png")
