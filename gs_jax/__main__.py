"""The command line: what runs a command and says what went wrong.

Exit status 0 on success, 2 on wrong input (one line, no traceback), 1 otherwise.
"""

import sys
from importlib import import_module

import click

from ._version import __version__
from .base.errors import InputError

# Each is `gs_jax/cli/NAME.py`, imported when it is asked for: some need seconds for what others do not.
COMMANDS = (
    "reconstruct",
    "simulate",
    "metrics",
    "layout",
    "optimize",
    "pareto",
    "benchmark",
    "mold",
    "train",
    "demo",
    "info",
)


def main() -> None:
    """Run the command line, and exit."""
    try:
        status = commands.main(standalone_mode=False, prog_name="gs-jax")
    except InputError as error:
        _fail(str(error), 2)
    except click.ClickException as error:
        _fail(" ".join(error.format_message().split()), 2)
    except (click.Abort, KeyboardInterrupt):
        _fail("interrupted", 1)
    else:
        sys.exit(status if isinstance(status, int) else 0)


def _fail(message: str, status: int) -> None:
    click.echo(f"gs-jax: {message}", err=True)
    sys.exit(status)


class _Commands(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        return import_module(f".cli.{cmd_name}", __package__).command


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]}, no_args_is_help=False)
@click.version_option(__version__, prog_name="gs-jax")
def commands():
    """Design, simulate and reconstruct with lensless 3-D microscopes of random microlenses."""


if __name__ == "__main__":
    main()
