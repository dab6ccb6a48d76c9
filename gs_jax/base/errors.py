"""`InputError`, which every mistake of a user raises, `InputWarning`, and the wording of their messages."""

import contextlib
import re
import reprlib
from collections.abc import Iterator
from types import UnionType

# C0 and C1 controls and Unicode's own line ends: a file name or a key may hold any of them.
_CONTROLS = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+")


class InputError(ValueError):
    """Wrong input from a user, explained in one line.

    *Host.*

    The line names the key or argument, what is expected, what was given, and the file. The command line prints it and
    exits with status 2. Any other exception is a fault of the program.

    Parameters
    ----------
    message
        The explanation. Line ends and other control characters in it become blanks.

    Examples
    --------
    >>> try:
    ...     gs.read_design("missing.toml")
    ... except gs.InputError as error:
    ...     print(error)
    missing.toml: ...
    """

    def __init__(self, message: str):
        super().__init__(_CONTROLS.sub(" ", message).strip())


class MissingExtraError(InputError):
    """An optional dependency that is not installed, for which no file is to blame."""


class InputWarning(UserWarning):
    """Input that is valid but implausible: a question in one line. The command line prints it once and continues."""


def input_error(name: str, allowed: object, given: object, file: object = None) -> InputError:
    """`InputError` with the message "NAME must be ALLOWED, got GIVEN (FILE)."."""
    return InputError(f"{name} must be {allowed}, got {given}{f' ({file})' if file else ''}.")


def check_kind(name: str, value: object, kind: type | UnionType | tuple[type, ...], allowed: str) -> None:
    """Raise `InputError` unless a value is of a kind; the class in place of its object is not."""
    if not isinstance(value, kind):
        raise input_error(name, allowed, short_repr(value))


@contextlib.contextmanager
def errors_name_file(path: object) -> Iterator[None]:
    """Add the name of a file to each `InputError` that is raised inside."""
    try:
        yield
    except MissingExtraError:
        raise
    except InputError as error:
        raise InputError(f"{str(error).removesuffix('.')} ({path}).") from error


@contextlib.contextmanager
def needs_extra(extra: str) -> Iterator[None]:
    """Name the extra of an optional dependency that is imported within and not installed: `InputError`."""
    try:
        yield
    except ModuleNotFoundError as error:
        message = f"{error.name or error} is not installed; it comes with pip install 'gs-jax[{extra}]'."
        raise MissingExtraError(message) from error


def short_repr(value: object) -> str:
    """`repr` of a value for a one-line message, limited in length and depth."""
    return reprlib.repr(value)
