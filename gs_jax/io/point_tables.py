"""Points on disk: CSV."""

import contextlib
import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePath
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int, Shaped

from ..base.errors import InputError, short_repr
from ..typing import PathLike, Points
from .files import MAX_TEXT_BYTES, atomic_write, check_input, check_output, read_text, write_text
from .provenance import Provenance, write_sidecar

MAX_POINTS = 1_000_000
# Of a number in a table: a float64 with all its digits and a separator has up to 25. What plain numbers are made of.
_NUMBER_BYTES, _PLAIN = 32, b"0123456789+-.eE, \t\r\n"
# Of the first line, bytes.
_LONGEST = 1000
POINTS_HEADER = "x_mm,y_mm,z_mm,intensity"


def read_points(path: PathLike) -> Float64[np.ndarray, "point 4"]:
    """Points `(x, y, z, intensity)` from a CSV file with the header `x_mm,y_mm,z_mm,intensity`.

    *File.*

    Further columns after these are left out.

    Raises
    ------
    InputError
        As `read_table`, and if a depth is not above 0 or an intensity is below 0.

    Examples
    --------
    >>> import gs_jax as gs, numpy as np
    >>> gs.write_points("points.csv", np.array([[0.5, -0.4, 19.5, 1.0]]))
    >>> gs.read_points("points.csv")
    array([[ 0.5, -0.4, 19.5,  1. ]])
    """
    with check_input(path).open("rb") as file:
        first = file.readline(_LONGEST).decode("utf-8-sig", "replace").rstrip("\r\n")
    header = first if first.startswith(f"{POINTS_HEADER},") else POINTS_HEADER
    points = np.ascontiguousarray(read_table(path, header, MAX_POINTS)[:, :4])
    for column, wrong, allowed in ((2, points[:, 2] <= 0, "a depth above 0"), (3, points[:, 3] < 0, "0 or more")):
        if wrong.any():
            row = int(np.argmax(wrong))
            name = POINTS_HEADER.split(",")[column]
            found = short_repr(float(points[row, column]))
            raise InputError(f"{path}: point {row + 1}, {name}: found {found}, allowed: {allowed}.")
    return points


def write_points(
    path: PathLike,
    points: Points,
    more: Mapping[str, Shaped[np.ndarray, " point"]] | None = None,
    *,
    provenance: Provenance | None = None,
) -> None:
    """Writes points `(x, y, z, intensity)`, mm, as CSV; what is read back is equal.

    *File.*

    Parameters
    ----------
    path, points
        The file, and what it holds.
    more
        Further columns, by name.
    provenance
        Where they come from, for a file beside this.

    Raises
    ------
    InputError
        As `check_output`, for `.csv`.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gs_jax as gs, numpy as np
    >>> gs.write_points("points.csv", np.array([[0.5, -0.4, 19.5, 1.0]]))
    >>> print(Path("points.csv").read_text(), end="")
    x_mm,y_mm,z_mm,intensity
    0.5,-0.4,19.5,1.0
    """
    rows, more = np.asarray(points), more or {}
    # `str` of the array's own scalars: the shortest digits that read back as the same float32 or float64.
    further = zip(*more.values(), strict=True) if more else [()] * len(rows)
    lines = [",".join([POINTS_HEADER, *more])]
    lines += [",".join(str(value) for value in (*row, *others)) for row, others in zip(rows, further, strict=True)]
    write_text(path, "\n".join(lines) + "\n", [".csv"])
    write_sidecar(path, provenance)


def write_points_in_time(
    path: PathLike,
    frames: Iterable[tuple[int, Mapping[str, list]]],
    *,
    provenance: Provenance | None = None,
) -> None:
    """Writes the points of frames as one CSV, with the column `frame` after those of `write_points`.

    Parameters
    ----------
    path
        The file.
    frames
        Of each its number, and the columns of its points by name, the first four those of `read_points`; all frames
        have the same. One is held at a time.
    provenance
        Where they come from, for a file beside this.

    Raises
    ------
    InputError
        As `check_output`, for `.csv`.
    """
    path, first = check_output(path, [".csv"]), True
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as to:
        for frame, columns in frames:
            if first:
                to.write(",".join([POINTS_HEADER, "frame", *list(columns)[4:]]) + "\n")
                first = False
            for row in zip(*columns.values(), strict=True):
                to.write(",".join(map(str, (*row[:4], frame, *row[4:]))) + "\n")
        if first:
            to.write(f"{POINTS_HEADER},frame\n")
    write_sidecar(path, provenance)


COLUMNS = ("x_mm", "y_mm", "z_mm")
_CAPTURE = "capture"
MAX_SOURCES = 10_000


def read_positions(
    path: PathLike, captures: Sequence[PathLike]
) -> tuple[Float64[np.ndarray, "source 3"], Int[np.ndarray, " source"]]:
    """Places `(x, y, z)` of sources, mm, NaN where they are not known, and the capture of each, from 0.

    The header has some of `x_mm`, `y_mm`, `z_mm`, and `capture` where captures have several sources: the number of the
    capture from 1, or the name of its file. Without that column there is a line for each capture, in their order. An
    empty cell, or a column that is not there, is not known.

    Raises
    ------
    InputError
        If the file cannot be read, the header has other columns, or a cell is neither empty nor allowed.
    """
    text = read_text(path)
    lines = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True, restkey="", restval="")
    names = [name.strip() for name in lines.fieldnames or []]
    if not names or set(names) - {*COLUMNS, _CAPTURE} or len(set(names)) < len(names):
        found = short_repr(",".join(names))
        raise InputError(f"{path}: found the header {found}, allowed: some of {_CAPTURE},{','.join(COLUMNS)}.")
    lines.fieldnames = names
    points, of = [], []
    for line in lines:
        place = f"{path}: line {lines.line_num}"
        if "" in line:
            raise InputError(f"{place}: found more values than the header has, allowed: {','.join(names)}.")
        points.append([_number(f"{place}, {name}", (line.get(name) or "").strip()) for name in COLUMNS])
        of.append(_capture(place, line[_CAPTURE].strip(), captures) if _CAPTURE in names else len(of))
        if len(of) > MAX_SOURCES:
            raise InputError(f"{path}: found more than {MAX_SOURCES} lines, allowed: up to that many.")
    return np.array(points, float).reshape(-1, 3), np.array(of, int)


def _number(place: str, cell: str) -> float:
    if not cell:
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or "_" in cell:
        raise InputError(f"{place}: found {short_repr(cell)}, allowed: a number of mm, or nothing if it is not known.")
    return value


def _capture(place: str, cell: str, captures: Sequence[PathLike]) -> int:
    names = [PurePath(path).name for path in captures]
    if cell in names:
        return names.index(cell)
    if cell.isdecimal() and 1 <= int(cell) <= len(names):
        return int(cell) - 1
    allowed = f"a number from 1 to {len(names)} or the name of a capture"
    raise InputError(f"{place}, {_CAPTURE}: found {short_repr(cell)}, allowed: {allowed}.")


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


def read_table(path: PathLike, header: str, max_rows: int) -> Float64[np.ndarray, "row column"]:
    """The numbers of a CSV file whose first line is `header`; without rows it is `(0, column)`.

    Raises
    ------
    InputError
        If it cannot be read, has another header, a line with too many or too few values, a value that is not
        a finite number, or more than `max_rows` rows.
    """
    names = header.split(",")
    text = read_text(path, max(MAX_TEXT_BYTES, max_rows * len(names) * _NUMBER_BYTES))
    if (table := _plain_table(text, header, max_rows)) is not None:
        return table
    lines = csv.reader(io.StringIO(text, newline=""))
    numbers = []
    try:
        found = next(lines, [])
        if found != names:
            raise InputError(f"{path}: found the header {short_repr(','.join(found))}, allowed: {header}.")
        for line in lines:
            if line:
                numbers.append(_numbers(f"{path}: line {lines.line_num}", names, line))
            if len(numbers) > max_rows:
                raise InputError(f"{path}: found more than {max_rows} rows below {header}, allowed: up to that many.")
    except csv.Error as error:
        raise InputError(f"{path}: line {lines.line_num} is not CSV below the header {header}: {error}.") from error
    return np.array(numbers, dtype=float).reshape(-1, len(names))


def _plain_table(text: str, header: str, max_rows: int) -> np.ndarray | None:
    """A table of nothing but plain numbers, read fast; None if it is another, or a line of it is to be refused."""
    first, _, body = text.partition("\n")
    if first.rstrip("\r") != header or not body.strip() or body.encode().translate(None, _PLAIN):
        return None
    with contextlib.suppress(ValueError):
        table = np.loadtxt(io.StringIO(body, newline=""), delimiter=",", ndmin=2)
        if table.shape[1] == header.count(",") + 1 and len(table) <= max_rows and np.isfinite(table).all():
            return table
    return None


def _numbers(place: str, names: Sequence[str], cells: Sequence[str]) -> list[float]:
    if len(cells) != len(names):
        raise InputError(f"{place}: found {len(cells)} values, allowed: {len(names)} ({','.join(names)}).")
    return [finite_number(f"{place}, {name}", cell) for name, cell in zip(names, cells, strict=True)]


def finite_number(place: str, cell: str) -> float:
    """The number that a cell of a table is; `InputError`, which names the place, if it is none."""
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or "_" in cell:  # Python reads 1_000; nobody else does
        raise InputError(f"{place}: found {short_repr(cell)}, allowed: a finite number.")
    return value
