"""The command line: runs a command, and turns errors and signals into one line and an exit status.

The exit status is 0 on success; 2 on wrong input, 1 if a file cannot be read or written, 130 on Ctrl-C and 143 on
SIGTERM, each with one line and no traceback; 1, with a traceback, on faults of the program. A signal ends a command
soon, even within compiled code, and leaves no half-written file.
"""

import io
import multiprocessing
import os
import signal
import socket
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module

import click

from ._version import __version__
from .base.errors import InputError, InputWarning
from .base.machine import keep_programs
from .cli.commands import ARGUMENTS, partial_outputs
from .io.files import remove_temporaries

# Longer messages are cut: their ends matter least.
_MAX_MESSAGE = 380
# Commands by their modules in `gs_jax/cli`, imported when a command is used: some need seconds that others do not.
_MODULES = {
    "reconstruct": ("reconstruct", "deconvolve"),
    "captures": ("calibrate", "simulate"),
    "traces": ("traces",),
    "designs": ("metrics", "layout", "optimize", "pareto", "info"),
    "new_design": ("new-design",),
    "fabrication": ("tolerance", "mold", "mask", "heights", "holder"),
    "presentation": ("report", "explore", "benchmark", "demo"),
    "train": ("train",),
}
COMMANDS = {name: module for module, names in _MODULES.items() for name in names}


def main(leave: Callable[[int], object] = sys.exit) -> None:
    """Run the command line and exit, after an interrupt by `leave`."""
    partial_outputs.clear()
    for stream in (sys.stdout, sys.stderr):
        # Names of files may hold bytes that are not UTF-8.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        status = commands.main(standalone_mode=False, prog_name="gs-jax")
    except InputError as error:
        _fail(str(error), 2)
    except click.ClickException as error:
        _fail(" ".join(error.format_message().split()), 2)
    except (click.Abort, KeyboardInterrupt) as error:
        click.echo(interrupt_message(), err=True)
        leave(exit_status(error.__cause__ or error))
    except OSError as error:
        # A full disk or a missing folder; errors without a number are faults of the program.
        if error.errno is None:
            raise
        where = f"{error.filename}: " if error.filename else ""
        _fail(f"{where}{error.strerror or error}", 1)
    else:
        sys.exit(status if isinstance(status, int) else 0)


def script() -> None:
    """Run `main` as a process that ends soon after a signal, and finds what the last one compiled."""
    keep_programs()
    with exit_on_signal():
        main(exit_now)


def _fail(message: str, status: int) -> None:
    click.echo(f"gs-jax: {message[:_MAX_MESSAGE]}{' ...' * (len(message) > _MAX_MESSAGE)}", err=True)
    sys.exit(status)


class _Commands(click.Group):
    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.meta[ARGUMENTS] = list(args)
        return super().parse_args(ctx, args)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module = import_module(f".cli.{COMMANDS[cmd_name]}", __package__)
        return getattr(module, f"{cmd_name.replace('-', '_')}_command")


@contextmanager
def _print_warnings_once() -> Iterator[None]:
    """Print each `InputWarning` once, in one line."""
    printed = set()
    with warnings.catch_warnings():
        show_other = warnings.showwarning
        warnings.simplefilter("always", InputWarning)

        def show(message, category, *place, **more):
            if not issubclass(category, InputWarning):
                show_other(message, category, *place, **more)
            elif str(message) not in printed:
                printed.add(str(message))
                click.echo(f"gs-jax: {' '.join(str(message).split())}", err=True)

        warnings.showwarning = show
        yield


@click.group(
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
    invoke_without_command=True,
)
@click.version_option(__version__, prog_name="gs-jax")
def commands():
    """Design, simulate and reconstruct with lensless 3-D microscopes of random microlenses."""
    context = click.get_current_context()
    context.with_resource(_print_warnings_once())
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


# Seconds that Python has after a signal to end by itself, to close files and print its last lines.
PATIENCE = 1.0
# Exit statuses of commands that a signal ended begin here, as in shells.
_BY_SIGNAL = 128


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
    heard = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) != signal.SIG_IGN]
    handlers = {number: signal.signal(number, _interrupt) for number in heard}
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
    """Raise an exception; but one within the initialisation of an extension may crash it: then end the process."""
    while frame:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            # Nothing has been written that early.
            print(interrupt_message(), file=sys.stderr)
            exit_now(_BY_SIGNAL + number)
        frame = frame.f_back
    raise Terminated if number == signal.SIGTERM else KeyboardInterrupt


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


if __name__ == "__main__":
    script()
