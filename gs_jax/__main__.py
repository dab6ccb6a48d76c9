"""The command line: runs a command, and turns errors into one line and an exit status.

The exit status is 0 on success; 2 on wrong input, 1 if a file cannot be read or written, 130 on Ctrl-C and 143 on
SIGTERM, each with one line and no traceback; 1, with a traceback, on faults of the program.
"""

import io
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from importlib import import_module
from typing import Any

import click

from ._version import __version__
from .base.errors import InputError, InputWarning
from .base.progress import QUIET, VERBOSE, verbosity
from .cli.command import ARGUMENTS, exit_now, exit_on_signal, exit_status, interrupt_message, partial_outputs

# Longer messages are cut: their ends matter least.
_MAX_MESSAGE = 380
# The module of each command in `gs_jax/cli`, imported when the command is used: some need seconds that others do not.
COMMANDS = {
    "reconstruct": "reconstruct",
    "calibrate": "calibrate",
    "simulate": "simulate",
    "deconvolve": "deconvolve",
    "metrics": "designs",
    "new-design": "new_design",
    "layout": "designs",
    "optimize": "optimize",
    "pareto": "optimize",
    "tolerance": "fabrication",
    "benchmark": "presentation",
    "mold": "fabrication",
    "mask": "fabrication",
    "heights": "fabrication",
    "train": "train",
    "report": "presentation",
    "explore": "presentation",
    "demo": "presentation",
    "info": "designs",
}


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
    """Run `main` as a process that ends soon after a signal."""
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
        command = getattr(module, f"{cmd_name.replace('-', '_')}_command")
        if not any(param.name == "quiet" for param in command.params):
            command.params += _LEVELS
            command.callback = _with_platforms(command.callback)
        return command


def _with_platforms(callback: Any) -> Any:
    """A command that first looks whether JAX can run; its help does without JAX."""

    @wraps(callback)
    def call(*arguments, **options):
        from .base.machine import check_platforms

        check_platforms()
        return callback(*arguments, **options)

    return call


def _set_level(context: click.Context, param: click.Parameter, value: bool) -> None:
    if value:
        token = verbosity.set(QUIET if param.name == "quiet" else VERBOSE)
        context.call_on_close(lambda: verbosity.reset(token))


_LEVELS = [
    click.Option(names, is_flag=True, expose_value=False, callback=_set_level, help=text)
    for names, text in (
        (["-q", "--quiet"], "Show no progress and no replaced files."),
        (["-v", "--verbose"], "Print the duration of each step."),
    )
]


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


if __name__ == "__main__":
    script()
