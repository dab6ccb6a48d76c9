"""Columns of numbers, two or more, out of tables as other programs and people write them."""

import contextlib
import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from ..base.errors import InputError, short_repr
from .disk import finite_number, read_text

# What columns of x and of y are called: the letter, alone or with words of place about it; or what an image has.
_ABOUT = "(?:centers?|centres?|coordinates?|coord|positions?|pos|lens|c)?"
_CALLED = [re.compile(f"{_ABOUT}{axis}{_ABOUT}|{image}") for axis, image in (("x", "columns?|cols?"), ("y", "rows?"))]
# A semicolon or a tab between values leaves the comma for decimals, as half of Europe's spreadsheets write them.
_SEPARATORS = ";\t,"


class Columns(NamedTuple):
    """The numbers `(row, 2)`, and what the header calls them, None without a header; further columns by their names."""

    numbers: Float64[np.ndarray, "row 2"]
    names: tuple[str, str] | None
    more: dict[str, Float64[np.ndarray, " row"]]


def read_columns(path: Path, wanted: Sequence[str] | None = None, *, most: int, also: Sequence[str] = ()) -> Columns:
    """x and y of a table of text, with a header or without.

    Values are separated by semicolons, tabs, commas or blanks, the first of these that the first line has. Blanks
    about values do not matter, nor do empty lines and those that begin with `#`; the last of these before the numbers
    is the header where it has as many names.

    Parameters
    ----------
    wanted
        Names of the columns of x and of y. By default those that are called so, or else the first and the second of
        two.
    most
        Rows that are allowed.
    also
        Names of further columns, which are read if the header has them.

    Raises
    ------
    InputError
        If it cannot be read, has no two columns or not the wanted ones, lines of different length, a value of x or y
        that is not a finite number, or too many rows. So it is with further columns, of which there is one of a name.
    """
    lines = [(number, line) for number, line in enumerate(_text(path).splitlines(), 1) if line.strip()]
    body = [(number, line) for number, line in lines if not line.lstrip().startswith("#")]
    if not body:
        raise InputError(f"{path}: found no line, allowed: a header such as x_mm,y_mm, and a line for each lens.")
    if len(body) > most + 1:
        raise InputError(f"{path}: found more than {most} rows, allowed: up to that many.")
    separator = next((mark for mark in _SEPARATORS if mark in body[0][1]), " ")
    first = _values(path, *body[0], separator)
    header: list[str] | None = None
    if not all(_is_number(value, separator) for value in first):
        header, body = first, body[1:]
    elif (before := lines.index(body[0])) > 0:
        remark = _values(path, 0, lines[before - 1][1].lstrip("# \t"), separator)
        header = remark if len(remark) == len(first) else None
    at = _places(path, header, len(first), wanted)
    names = (header[at[0]], header[at[1]]) if header else None
    if names and any(_is_number(name, separator) for name in names):
        raise InputError(f"{path}: found the first line {short_repr(','.join(first))}, allowed: names, or numbers.")
    if (plain := _plain_numbers(body, len(first), separator)) is not None:
        return Columns(plain[:, at], names, {})
    further = {name: header.index(name) for name in also if header and name in header}
    if twice := next((name for name in further if (header or []).count(name) > 1), None):
        raise InputError(f"{path}: found {short_repr(twice)} more than once in the header, allowed: one such column.")
    called, places = [*(names or "xy"), *further], [*at, *further.values()]
    rows = []
    for number, line in body:
        values = _values(path, number, line, separator)
        if len(values) != len(first):
            expected = f"{len(first)} ({','.join(header)})" if header else f"{len(first)}, as in the first line"
            raise InputError(f"{path}: line {number}: found {len(values)} values, allowed: {expected}.")
        cells = zip((values[i] for i in places), called, strict=True)
        rows.append([finite_number(f"{path}: line {number}, {name}", _point(cell, separator)) for cell, name in cells])
    table = np.array(rows, dtype=float).reshape(-1, len(places))
    return Columns(table[:, :2], names, dict(zip(further, table[:, 2:].T, strict=True)))


def _plain_numbers(body: Sequence[tuple[int, str]], count: int, separator: str) -> np.ndarray | None:
    """Two columns of nothing but plain numbers, read fast; None if they are others, or a line is to be refused."""
    if not body or count != 2:
        return None
    with contextlib.suppress(ValueError):
        delimiter = None if separator == " " else separator
        table = np.loadtxt((line for _, line in body), delimiter=delimiter, comments=None, ndmin=2)
        if table.shape[1] == 2 and np.isfinite(table).all():
            return table
    return None


def _text(path: Path) -> str:
    """UTF-8, or ASCII and the Greek mu of micrometres as spreadsheets on Windows write it."""
    try:
        return read_text(path)
    except InputError as error:
        if not isinstance(error.__cause__, UnicodeDecodeError):
            raise
        with contextlib.suppress(UnicodeDecodeError):
            return path.read_bytes().replace(b"\xb5", b"u").decode("ascii")
        raise


def _values(path: Path, number: int, line: str, separator: str) -> list[str]:
    if separator == " ":
        return re.sub(r"\s+(?=[(\[])", "", line).split()  # a unit in brackets belongs to the name before it
    try:
        return [value.strip() for value in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]
    except csv.Error as error:
        raise InputError(f"{path}: line {number} is not CSV: {error}.") from error


def _point(cell: str, separator: str) -> str:
    return cell.replace(",", ".") if separator != "," and "." not in cell else cell


def _is_number(cell: str, separator: str) -> bool:
    try:
        float(_point(cell, separator))
    except ValueError:
        return False
    return True


def _places(path: Path, header: list[str] | None, count: int, wanted: Sequence[str] | None) -> tuple[int, int]:
    """Which columns are x and y."""
    if wanted is not None:
        if header is None:
            raise InputError(f"{path}: found no header, allowed: one that names {' and '.join(map(repr, wanted))}.")
        plain, asked = (["".join(name.split()) for name in names] for names in (header, wanted))
        if missing := [name for name, bare in zip(wanted, asked, strict=True) if plain.count(bare) != 1]:
            found = ", ".join(map(repr, header))
            raise InputError(f"{path}: found no one column {short_repr(missing[0])}, allowed: {found:.200}.")
        return plain.index(asked[0]), plain.index(asked[1])
    called = [[i for i, name in enumerate(header or ()) if _is_called(name, which)] for which in _CALLED]
    if len(called[0]) == len(called[1]) == 1:
        return called[0][0], called[1][0]
    if count == 2:
        return 0, 1
    found = "{} columns{}".format(count, f": {', '.join(map(repr, header)):.160}" if header else " without a header")
    raise InputError(f"{path}: found {found}, allowed: two, or names of the columns of x and y (`centers_columns`).")


def _is_called(name: str, what: re.Pattern) -> bool:
    """Whether a part of the name is the word."""
    bare = re.sub(r"[(\[].*?[)\]]", " ", name.lower())
    words = re.split(r"[^a-z]+", bare)
    return any(what.fullmatch(word) for word in words)
