"""Commands from functions: options from signatures, help from docstrings; checks of outputs, and provenance."""

import inspect
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import wraps
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import click
from click.core import ParameterSource

from ..base.errors import InputError
from ..base.progress import QUIET, VERBOSE, verbosity
from ..io.files import check_output

# Files that people write by hand: designs, studies, points and centres.
_WRITTEN_BY_HAND = (".toml", ".csv")
# Key of the command line in click's `meta`.
ARGUMENTS = "gs_jax.arguments"
# Files to name after an interrupt, with a text about each.
partial_outputs: dict[Path, str] = {}
RESUMABLE, PARTIAL = "has what is done, and --resume goes on from it", "has what is done"


# Help of options that are the same in all commands.
_HELP = {
    "force": "Replace existing .toml and .csv files.",
    "terms": "FILE.py with terms of your own for the study, in a dictionary TERMS. The file is executed.",
    "out": "Folder to write to.",
}


class OptionGroup:
    """Base of classes whose arguments are options of every command that has a parameter of the class."""


def command(
    name: str, epilog: str, more: Sequence[click.Option] = ()
) -> Callable[[Callable[..., object]], click.Command]:
    """Make a command of a function.

    Parameters before `*` become arguments, those after it options, which are required without a default. A `bool`
    becomes a flag, a parameter of an `OptionGroup` the options of that class. `Annotated` may hold a click type, and
    further names of an option. The docstring is the help, and in its section "Options:" that of each option, as
    "name: text". Values of the options `more` are further keyword arguments of the function.
    """

    def decorate(function: Callable[..., object]) -> click.Command:
        groups = {
            parameter.name: parameter.annotation
            for parameter in inspect.signature(function).parameters.values()
            if _is_group(parameter.annotation)
        }

        @wraps(function)
        def callback(**values: Any) -> object:
            from ..base.machine import check_platforms

            check_platforms()
            for key, group in groups.items():
                values[key] = group(**{option: values.pop(option) for option in inspect.signature(group).parameters})
            return function(**values)

        text, _ = _documentation(function)
        params = [*_parameters(function), *more, *_LEVELS]
        return click.Command(name, params=params, callback=callback, help=text, epilog=epilog)

    return decorate


def _is_group(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, OptionGroup)


def _documentation(documented: Any) -> tuple[str, dict[str, str]]:
    """Split a docstring into its text and the help of options; classes have the options of their bases too."""
    bases = documented.__mro__[1:-1] if isinstance(documented, type) else ()
    texts = {name: text for base in reversed(bases) for name, text in _documentation(base)[1].items()}
    text, _, section = inspect.cleandoc(documented.__doc__ or "").partition("\nOptions:\n")
    for name, lines in re.findall(r"^    (\w+): (.+(?:\n {8}.+)*)", section, re.MULTILINE):
        # As click sets the default apart.
        texts[name] = " ".join(lines.split()).replace(" [default", "  [default")
    return text, texts


def _parameters(documented: Any) -> Iterator[click.Parameter]:
    """Yield the arguments and options of a function or an `OptionGroup`."""
    texts = _HELP | _documentation(documented)[1]
    for parameter in inspect.signature(documented).parameters.values():
        if _is_group(parameter.annotation):
            yield from _parameters(parameter.annotation)
        elif parameter.kind is parameter.KEYWORD_ONLY or _is_group(documented):
            yield _option(parameter, texts.get(parameter.name, ""))  # without docstrings (python -OO) no help
        elif parameter.kind is not parameter.VAR_KEYWORD:
            required = parameter.default is parameter.empty
            yield click.Argument([parameter.name], required=required, **_type(parameter.annotation))


def _option(parameter: inspect.Parameter, text: str) -> click.Option:
    name, settings = f"--{parameter.name.replace('_', '-')}", _type(parameter.annotation)
    if settings["type"] is bool:
        settings = {"is_flag": True, "default": parameter.default}
        name = f"{name}/--no-{name[2:]}" if parameter.default else name
    elif parameter.default is parameter.empty:
        settings["required"] = True
    elif parameter.default is not None:
        settings["default"] = parameter.default
    short = ["-o"] if parameter.name == "output" else []
    further = [part for part in get_args(parameter.annotation) if isinstance(part, str)]
    return click.Option([parameter.name, *short, name, *further], help=text, **settings)


def _type(annotation: Any) -> dict[str, Any]:
    """Return `type` of an option or argument, and `nargs` if it takes several values."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        types = [part for part in parts[1:] if isinstance(part, click.ParamType)]
        return {"type": types[0]} if types else _type(parts[0])
    if origin in (Union, UnionType):
        return _type(next(part for part in parts if part is not NoneType))
    if origin is tuple:
        return _type(parts[0]) | {"nargs": -1 if parts[1] is ... else len(parts)}
    return {"type": annotation}


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


def given_options(names: Iterable[str]) -> list[str]:
    """Those of some options of the running command that its user gave, as `--name`."""
    source = click.get_current_context().get_parameter_source
    return [f"--{name.replace('_', '-')}" for name in names if source(name) is ParameterSource.COMMANDLINE]


def check_outputs(
    output: Path | None,
    suffixes: Sequence[str],
    *beside: Path,
    inputs: Iterable[Path | None] = (),
    force: bool = False,
) -> None:
    """Check an output, and the files beside it, by `check_output` and `check_may_write`; None is no output."""
    if output is None:
        return
    check_output(output, suffixes)
    for path in beside:
        check_output(path, [path.suffix])
    check_may_write(output, *beside, inputs=inputs, force=force)


def check_may_write(*outputs: Path | None, inputs: Iterable[Path | None], force: bool = False) -> None:
    """Check the outputs before any work; when the command succeeds, report on standard error what was replaced.

    Raises `InputError` if an output is an input, a capture of an input's folder or pattern, another output, or an
    existing .toml or .csv file without `force`.
    """
    paths = [path for path in outputs if path is not None]
    resolved = [os.path.realpath(path) for path in paths]
    for path, target in zip(paths, resolved, strict=True):
        if resolved.count(target) > 1:
            raise InputError(f"{path}: outputs must be different files, got the same file for two.")
    existing = [path for path in paths if os.path.exists(path)]
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

    def report() -> None:
        if sys.exc_info()[0] is None and not quiet:
            click.echo(f"gs-jax: replaced {names}", err=True)

    click.get_current_context().call_on_close(report)


def provenance_of(*inputs: Path | None, design: Any = None) -> dict[str, str]:
    """Provenance of the running command's outputs: command line, inputs, and the text of a `Design`."""
    from ..design.design import design_text
    from ..io.provenance import made_by

    context = click.get_current_context()
    arguments = shlex.join(["gs-jax", *context.meta.get(ARGUMENTS, [context.info_name])])
    return made_by(arguments, [path for path in inputs if path is not None], design_text(design) if design else "")


def print_warning(text: str) -> None:
    """Print a warning, a line on standard error."""
    click.echo(f"gs-jax: warning: {text}", err=True)


def plural(count: int, noun: str) -> str:
    """A number of things, such as "2 points"."""
    return f"{count} {noun}{'s' * (count != 1)}"
