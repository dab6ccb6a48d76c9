"""Checks of a command's outputs before it starts, and the provenance that it writes into them."""

import os
import shlex
import sys
from collections.abc import Iterable
from pathlib import Path

import click

from ..base.errors import InputError
from ..base.progress import QUIET, verbosity

# Files that people write by hand: designs, studies, points and centres.
_WRITTEN_BY_HAND = (".toml", ".csv")
# Key of the command line in click's `meta`.
ARGUMENTS = "gs_jax.arguments"

force_option = click.option("--force", is_flag=True, help="Replace existing .toml and .csv files.")


def check_may_write(*outputs: Path | None, inputs: Iterable[Path | None], force: bool = False) -> None:
    """Check the outputs before any work; when the command succeeds, report on standard error what was replaced.

    Raises
    ------
    InputError
        If an output is an input, a capture of an input's folder or pattern, another output, or an existing .toml or
        .csv file without `force`.
    """
    given = [path for path in outputs if path is not None]
    places = [os.path.realpath(path) for path in given]
    for path, place in zip(given, places, strict=True):
        if places.count(place) > 1:
            raise InputError(f"{path}: outputs must be different files, got the same file for two.")
    existing = [path for path in given if os.path.exists(path)]
    existing = [path for path in outputs if path is not None and os.path.exists(path)]
    if not existing:
        return
    from ..io.recordings import capture_files

    files = [file for path in inputs if path is not None for file in capture_files(path) or [path]]
    existing_inputs = [path for path in files if os.path.exists(path)]
    for path in existing:
        if any(os.path.samefile(path, other) for other in existing_inputs):
            raise InputError(f"{path}: the output must be another file than the inputs, got an input.")
        if path.suffix.lower() in _WRITTEN_BY_HAND and not force:
            raise InputError(f"{path}: the output must be a new file, got an existing one; --force replaces it.")
    names, quiet = ", ".join(map(str, existing)), verbosity.get() == QUIET
    click.get_current_context().call_on_close(lambda: _report_replaced(names, quiet))


def provenance_of(*inputs: Path | None, design: str = "") -> dict[str, str]:
    """Provenance of the running command's outputs: command line, inputs, and the text of the design."""
    from ..io.provenance import made_by

    context = click.get_current_context()
    command = shlex.join(["gs-jax", *context.meta.get(ARGUMENTS, [context.info_name])])
    return made_by(command, [path for path in inputs if path is not None], design)


def _report_replaced(names, quiet):
    if sys.exc_info()[0] is None and not quiet:
        click.echo(f"gs-jax: replaced {names}", err=True)
