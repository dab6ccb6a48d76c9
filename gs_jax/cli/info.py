"""`gs-jax info`: what it runs on."""

import click


@click.command("info")
def command():
    """Show versions, devices and memory."""
    from ..base.info import describe

    for name, value in describe().items():
        click.echo(f"{name:<12} {value}")
