"""What a command may write: nothing over what it reads, and over what a person may have made only if told to."""

import os
import shlex
import sys
from collections.abc import Iterable
from pathlib import Path

import click

from ..base.errors import InputError
from ..base.progress import QUIET, shown

# Designs, studies, points and centres: what people write by hand.
_BY_HAND = (".toml", ".csv")

force_option = click.option("--force", is_flag=True, help="Replace .toml and .csv files that are there already.")


def check_may_write(*outputs: Path | None, inputs: Iterable[Path | None], force: bool = False) -> None:
    """To be asked before any work; in the end it says on standard error which results were replaced.

    Raises
    ------
    InputError
        If an output is an input, or a file as people write by hand, and `force` is not given.
    """
    read = [path for path in inputs if path is not None]
    there = [path for path in outputs if path is not None and os.path.exists(path)]
    for path in there:
        if any(os.path.exists(other) and os.path.samefile(path, other) for other in read):
            raise InputError(f"{path}: found an input of this command in the place of its output, allowed: another.")
        if path.suffix.lower() in _BY_HAND and not force:
            raise InputError(f"{path}: found a file that is there already, allowed: another, or --force to replace it.")
    # Said when it has happened: a command that fails leaves them as they are.
    if there:
        names, quiet = ", ".join(map(str, there)), shown.get() == QUIET
        click.get_current_context().call_on_close(lambda: _say_replaced(names, quiet))


ARGUMENTS = "gs_jax.arguments"


def provenance_of(*inputs: Path | None, design: str = "") -> dict[str, str]:
    """What the running command writes into its files: itself, what it read, and the text of the design."""
    from ..io.provenance import made_by

    context = click.get_current_context()
    command = shlex.join(["gs-jax", *context.meta.get(ARGUMENTS, [context.info_name])])
    return made_by(command, [path for path in inputs if path is not None], design)


def _say_replaced(names, quiet):
    if sys.exc_info()[0] is None and not quiet:
        click.echo(f"gs-jax: replaced {names}", err=True)
