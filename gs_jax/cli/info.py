"""`gs-jax info`: what it runs on."""

import click

from ..base.info import describe


@click.command("info")
def command():
    """Show versions, devices and memory."""
    for name, value in describe().items():
        click.echo(f"{name:<12} {value}")
