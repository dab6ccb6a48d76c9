"""`gs-jax demo`: the whole pipeline on the built-in design."""

from pathlib import Path

import click

from ..base.progress import Progress


@click.command("demo", epilog="Example: gs-jax demo --out demo")
@click.option("--out", type=Path, default=Path("gs-jax-demo"), show_default=True, help="Folder to write to.")
def command(out: Path):
    """Run the pipeline on the built-in design: image a scene, reconstruct it, write a folder with reports."""
    from ..apps.example_pipeline import run

    with Progress() as progress:
        report = run(out, progress)
    click.echo(f"{report}: what was made, and what it shows")
    click.echo(f"{report.with_suffix('.html')}: the microscope and what it showed, in a browser")
