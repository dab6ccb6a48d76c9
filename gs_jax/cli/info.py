"""`gs-jax info`: what it runs on, and where a file comes from."""

from pathlib import Path

import click

from .options import shipped_designs


@click.command("info", epilog="Examples: gs-jax info volume.ome.tif, gs-jax info --designs")
@click.argument("file", type=Path, required=False)
@click.option("--designs", is_flag=True, help="List the designs that come with the package, to be used by their names.")
def command(file: Path | None, designs: bool):
    """Show versions, devices and memory; or of a FILE that gs-jax wrote, which command made it and of what."""
    if designs:
        from ..design.design import read_design

        # The name of the file is what a command takes; the second line of a design says what its array is.
        found = {path.stem: repr(read_design(path)).splitlines()[1].strip() for path in shipped_designs()}
    elif file:
        from ..io.provenance import read_provenance

        found = read_provenance(file) or {"provenance": f"{file} says nothing of where it comes from."}
    else:
        from ..base.machine import describe

        found = describe()
    width = max(map(len, found))
    for name, value in found.items():
        # The text of a design has many lines.
        click.echo(f"{name:<{width}} {value}" if "\n" not in value else f"{name}\n\n{value}")
