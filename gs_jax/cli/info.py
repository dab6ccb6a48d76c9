"""`gs-jax info`: what it runs on, and where a file comes from."""

from pathlib import Path

import click


@click.command("info", epilog="Example: gs-jax info volume.ome.tif")
@click.argument("file", type=Path, required=False)
def command(file: Path | None):
    """Show versions, devices and memory; or of a FILE that gs-jax wrote, which command made it and of what."""
    if file:
        from ..io.provenance import read_provenance

        found = read_provenance(file) or {"provenance": f"{file} says nothing of where it comes from."}
    else:
        from ..base.info import describe

        found = describe()
    width = max(map(len, found))
    for name, value in found.items():
        # The text of a design has many lines.
        click.echo(f"{name:<{width}} {value}" if "\n" not in value else f"{name}\n\n{value}")
