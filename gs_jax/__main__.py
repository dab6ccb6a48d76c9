"""The command line: what runs a command and says what went wrong.

Exit status 0 on success, 2 on wrong input (one line, no traceback), 1 otherwise.
"""

import sys

import click

from . import __version__
from .cli.benchmark import benchmark
from .cli.demo import demo
from .cli.info import info
from .cli.layout import layout
from .cli.metrics import metrics
from .cli.mold import mold
from .cli.optimize import optimize
from .cli.pareto import pareto
from .cli.reconstruct import reconstruct
from .cli.simulate import simulate
from .cli.train import train
from .errors import InputError


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


@click.group(context_settings={"help_option_names": ["-h", "--help"]}, no_args_is_help=False)
@click.version_option(__version__, prog_name="gs-jax")
def commands():
    """Design, simulate and reconstruct with lensless 3-D microscopes of random microlenses."""


for _command in (reconstruct, simulate, metrics, layout, optimize, pareto, benchmark, mold, train, demo, info):
    commands.add_command(_command)


if __name__ == "__main__":
    main()
