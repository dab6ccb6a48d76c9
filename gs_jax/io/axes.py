"""Axes of stacks: their names in all file formats, and which of them may hold frames or planes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..base.errors import InputError, input_error

# Name of an axis of which a file says nothing but its length.
UNNAMED = "?"
_TIME, _DEPTH, _CHANNEL = (
    ("t", "time", "frame", "frames"),
    ("z", "depth", "plane", "slice"),
    ("c", "channel", "channels", "wavelength"),
)
_LETTERS = {word: words[0] for words in (_TIME, _DEPTH, _CHANNEL) for word in words}
_LETTERS |= {"row": "y", "rows": "y", "column": "x", "columns": "x", "col": "x"}
# tifffile's letters of an axis that it made up, and names that xarray makes up.
_MADE_UP = ("", "q", "i", "none")


def axis_letter(name: Any, kind: Any = None) -> str:
    """One name for an axis, `t`, `z`, `c`, `y` or `x`, whatever it is called; others in lower case, or `UNNAMED`.

    `kind` is the type that NGFF declares beside a name.
    """
    word = str(name).lower()
    if kind in ("time", "channel"):
        return str(kind)[0]
    return UNNAMED if word in _MADE_UP or word.startswith("dim_") else _LETTERS.get(word, word)


def stack_axis(lengths: Sequence[tuple[str, int]], allowed: str) -> int | None:
    """Number of the axis whose images follow each other: the only one longer than 1, or else the first.

    Parameters
    ----------
    lengths
        Name and length of each axis before y and x.
    allowed
        Names that it may have beside `UNNAMED`, such as "t", or "tz".

    Returns
    -------
    int or None
        None if several axes are longer than 1, or one with another name is.
    """
    longer = [(number, name) for number, (name, length) in enumerate(lengths) if length != 1]
    if not longer:
        return 0
    number, name = longer[0]
    return number if len(longer) == 1 and name in (*allowed, UNNAMED) else None


def stack_error(path: Path, allowed: str, shape: Sequence[int], names: Sequence[str], advice: str = "") -> InputError:
    """The error of a stack with other axes than `allowed`; `shape` and `names` are those of all of its axes."""
    first = allowed[-1]
    named = f" ({', '.join(names)})" if any(name not in (UNNAMED, "y", "x") for name in names) else ""
    wanted = f"({first}, y, x), with axes of 1 alone between {first} and y"
    return input_error("array", wanted, f"{' x '.join(map(str, shape))}{named}{advice}", path)
