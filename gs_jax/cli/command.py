"""A command's outputs: checks before it starts, provenance, and what SIGINT or SIGTERM leaves of them.

A signal ends a command soon, even within compiled code, and leaves no half-written file.
"""

import itertools
import multiprocessing
import os
import shlex
import signal
import socket
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from ..base.errors import InputError, input_error
from ..base.progress import QUIET, verbosity
from ..io.files import remove_temporaries

# Files that people write by hand: designs, studies, points and centres.
_WRITTEN_BY_HAND = (".toml", ".csv")
# Key of the command line in click's `meta`.
ARGUMENTS = "gs_jax.arguments"

force_option = click.option("--force", is_flag=True, help="Replace existing .toml and .csv files.")


def check_may_write(*outputs: Path | None, inputs: Iterable[Path | None], force: bool = False) -> None:
    """Check the outputs before any work; when the command succeeds, report on standard error what was replaced.

    Raises `InputError` if an output is an input, a capture of an input's folder or pattern, another output, or an
    existing .toml or .csv file without `force`.
    """
    given = [path for path in outputs if path is not None]
    places = [os.path.realpath(path) for path in given]
    for path, place in zip(given, places, strict=True):
        if places.count(place) > 1:
            raise InputError(f"{path}: outputs must be different files, got the same file for two.")
    existing = [path for path in given if os.path.exists(path)]
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


def check_even(output: Path, depths: list[float] | None) -> None:
    """Raise `InputError` before the work if a file has one step for all depths, and they are uneven."""
    if output.suffix.lower() != ".zarr" or not depths or len(depths) < 3:
        return
    steps = [after - before for before, after in itertools.pairwise(depths)]
    if max(steps) - min(steps) > 1e-6 * max(depths):
        raise input_error("depths", "in even steps for OME-Zarr", "uneven ones; use .ome.tif", output)


def provenance_of(*inputs: Path | None, design: str = "") -> dict[str, str]:
    """Provenance of the running command's outputs: command line, inputs, and the text of the design."""
    from ..io.provenance import made_by

    context = click.get_current_context()
    command = shlex.join(["gs-jax", *context.meta.get(ARGUMENTS, [context.info_name])])
    return made_by(command, [path for path in inputs if path is not None], design)


def _report_replaced(names, quiet):
    if sys.exc_info()[0] is None and not quiet:
        click.echo(f"gs-jax: replaced {names}", err=True)


# Seconds that Python has to end by itself, to close files and print its last lines.
PATIENCE = 1.0
# Exit statuses of commands that a signal ended begin here, as in shells.
_BY_SIGNAL = 128
# Files to name after an interrupt, with a text about each.
partial_outputs: dict[Path, str] = {}
RESUMABLE, PARTIAL = "has what is done, and --resume goes on from it", "has what is done"


class Terminated(KeyboardInterrupt):
    """Raised by SIGTERM, as `KeyboardInterrupt` by Ctrl-C."""


def exit_status(interrupt: BaseException | None) -> int:
    """130 for Ctrl-C, 143 for SIGTERM."""
    return _BY_SIGNAL + (signal.SIGTERM if isinstance(interrupt, Terminated) else signal.SIGINT)


def interrupt_message() -> str:
    """The last line of an interrupted command."""
    existing = [f"{path} {text}" for path, text in partial_outputs.items() if path.exists()]
    return f"gs-jax: {'; '.join(['interrupted', *existing])}"


@contextmanager
def exit_on_signal() -> Iterator[None]:
    """Within it, a signal raises an exception, and ends the process if that has not done so within `PATIENCE`.

    Compiled code may return to Python only minutes later, and no exception is raised before. Only the main thread may
    enter it.
    """
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    wakeup = signal.set_wakeup_fd(theirs.fileno())
    # A background process may ignore Ctrl-C, and continues to.
    replaced = {number: own for number, own in _HANDLERS.items() if signal.getsignal(number) != signal.SIG_IGN}
    handlers = {number: signal.signal(number, own) for number, own in replaced.items()}
    hook, sys.unraisablehook = sys.unraisablehook, _unraisable
    threading.Thread(target=_watch, args=(ours,), daemon=True).start()
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(wakeup)
        theirs.close()


def exit_now(status: int) -> None:
    """End the process without shutting the interpreter down, which may crash under running compiled code."""
    remove_temporaries()
    for child in multiprocessing.active_children():
        child.terminate()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)


def _interrupt(number, frame):
    _exit_if_importing(number, frame)
    raise KeyboardInterrupt


def _terminate(number, frame):
    _exit_if_importing(number, frame)
    raise Terminated


_HANDLERS = {signal.SIGINT: _interrupt, signal.SIGTERM: _terminate}


def _exit_if_importing(number, frame):
    # An exception within the initialisation of an extension may crash it; nothing has been written that early.
    while frame:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            print(interrupt_message(), file=sys.stderr)
            exit_now(_BY_SIGNAL + number)
        frame = frame.f_back


def _unraisable(unraisable):
    # An interrupt within a garbage collector's callback is lost; `_watch` ends the process.
    if not (unraisable.exc_type and issubclass(unraisable.exc_type, KeyboardInterrupt)):
        sys.__unraisablehook__(unraisable)


def _watch(ours):
    with ours:
        while number := ours.recv(1):
            if number[0] in (signal.SIGINT, signal.SIGTERM):
                break
        else:
            return
    threading.Event().wait(PATIENCE)
    print(f"\n{interrupt_message()}", file=sys.stderr)
    exit_now(_BY_SIGNAL + number[0])
