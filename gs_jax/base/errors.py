"""The one exception that a user's mistake raises, and the warning of what looks like one."""

import contextlib
import re
import reprlib
from collections.abc import Iterator

# C0 and C1 controls and Unicode's own line ends: a file name or a key may hold any of them.
_CONTROLS = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+")


class InputError(ValueError):
    """Wrong input from a user, explained in one line.

    The line names the file, the key or argument, what was found and what is allowed. The command line
    prints it and exits with status 2. A fault of the program itself never becomes an `InputError`.

    Parameters
    ----------
    message
        The explanation. Line ends and other control characters in it become blanks.

    Examples
    --------
    >>> import gs_jax as gs
    >>> try:
    ...     gs.read_design("missing.toml")
    ... except gs.InputError as error:
    ...     print(error)
    missing.toml: ...
    """

    def __init__(self, message: str):
        super().__init__(_CONTROLS.sub(" ", message).strip())


class InputWarning(UserWarning):
    """Input that is possible but hardly meant: a question in one line. The command line prints it once and goes on."""


@contextlib.contextmanager
def errors_name_file(path: object) -> Iterator[None]:
    """Around what does not know the file that its input came from: an `InputError` then names it."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


@contextlib.contextmanager
def needs_extra(extra: str) -> Iterator[None]:
    """Name the extra of an optional dependency that is imported within and not installed: `InputError`."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed; it comes with pip install 'gs-jax[{extra}]'.") from error


def short_repr(value: object) -> str:
    """What was found, short enough for a one-line message: `repr`, cut in length and depth."""
    return reprlib.repr(value)
