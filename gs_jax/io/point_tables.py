"""CSV tables: points, positions of calibration sources, and columns x and y of tables from other programs."""

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

from ..base.arrays import host_code
from ..base.errors import InputError, input_error, short_repr
from ..typing import PathLike, Points
from .files import MAX_TEXT_BYTES, atomic_write, check_input, check_output, read_text, write_text
from .provenance import SURFACE, Provenance, write_sidecar

POINTS_HEADER = "x_mm,y_mm,z_mm,intensity"
MAX_POINTS, MAX_SOURCES = 1_000_000, 10_000
_POSITION, _CAPTURE = ("x_mm", "y_mm", "z_mm"), "capture"
# Longest first line in bytes; bytes of a float64 with all its digits and a separator; characters of plain numbers.
_MAX_HEADER, _NUMBER_BYTES, _PLAIN = 1000, 32, b"0123456789+-.eE, \t\r\n"
# A semicolon or a tab between values leaves the comma for decimals, as many European spreadsheets write them.
_SEPARATORS = ";\t,"
# Names of the columns x and y: the letter, alone or with words of place about it, or the terms of images.
_PLACE = "(?:centers?|centres?|coordinates?|coord|positions?|pos|lens|c)?"
_NAMES = [re.compile(f"{_PLACE}{axis}{_PLACE}|{image}") for axis, image in (("x", "columns?|cols?"), ("y", "rows?"))]


def read_points(path: PathLike) -> Float64[np.ndarray, "point 4"]:
    """Points `(x, y, z, intensity)` from a CSV file with the header `x_mm,y_mm,z_mm,intensity`.

    *File.*

    Further columns after these are left out. Depths are from the array: of a file that counts them from the sample's
    surface, the column `sample_surface_mm` is added.

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
    return _read_points(path)[0]


def read_scene_points(path: PathLike) -> Float64[np.ndarray, "point 4"]:
    """Points of one scene, as `read_points`; `InputError` if a column `frame` has those of several."""
    points, more = _read_points(path)
    if (count := len(np.unique(more.get("frame", [])))) > 1:
        raise input_error("column frame", "of one frame, which is one scene", f"{count} frames", path)
    return points


def _read_points(path: PathLike) -> tuple[Float64[np.ndarray, "point 4"], dict[str, Float64[np.ndarray, " point"]]]:
    """Points with depths from the array, and further columns by name."""
    with check_input(path).open("rb") as file:
        first = file.readline(_MAX_HEADER).decode("utf-8-sig", "replace").rstrip("\r\n")
    names = [name.strip(' "') for name in first.split(_separator(first))]
    names = names if names[:4] == POINTS_HEADER.split(",") else POINTS_HEADER.split(",")
    table = read_table(path, ",".join(names), MAX_POINTS)
    points = np.ascontiguousarray(table[:, :4])
    if SURFACE in names:
        points[:, 2] += table[:, names.index(SURFACE)]
    for column, name, wrong, allowed in (
        (2, "z_mm", points[:, 2] <= 0, "above 0"),
        (3, "intensity", points[:, 3] < 0, "0 or more"),
    ):
        if wrong.any():
            row = int(np.argmax(wrong))
            raise input_error(f"point {row + 1}, {name}", allowed, float(points[row, column]), path)
    return points, dict(zip(names[4:], table[:, 4:].T, strict=True))


@host_code()
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
        Kept in a file beside this.

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
    # `str` of NumPy's scalars has the shortest digits that read back as the same float32 or float64.
    further = zip(*more.values(), strict=True) if more else [()] * len(rows)
    lines = [",".join([POINTS_HEADER, *more])]
    lines += [",".join(str(value) for value in (*row, *others)) for row, others in zip(rows, further, strict=True)]
    write_text(path, "\n".join(lines) + "\n", [".csv"])
    write_sidecar(path, provenance)


def write_points_in_time(
    path: PathLike, frames: Iterable[tuple[int, Mapping[str, list]]], *, provenance: Provenance | None = None
) -> None:
    """Write the points of frames as one CSV, with the column `frame` after those of `write_points`.

    `frames` are their numbers and the columns of their points by name, in all the same, the first four as in
    `read_points`; one frame is held at a time. `InputError` as `check_output`.
    """
    path, names = check_output(path, [".csv"]), None
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        for frame, columns in frames:
            if names is None:
                names = list(columns)
                file.write(",".join([POINTS_HEADER, "frame", *names[4:]]) + "\n")
            for row in zip(*columns.values(), strict=True):
                file.write(",".join(map(str, (*row[:4], frame, *row[4:]))) + "\n")
        if names is None:
            file.write(f"{POINTS_HEADER},frame\n")
    write_sidecar(path, provenance)


def read_positions(
    path: PathLike, captures: Sequence[PathLike]
) -> tuple[Float64[np.ndarray, "source 3"], Int[np.ndarray, " source"]]:
    """Read positions `(x, y, z)` of sources in mm, NaN where unknown, and the capture of each, from 0.

    The header has some of `x_mm`, `y_mm`, `z_mm`, and `capture` if captures have several sources: the number of the
    capture from 1, or the name of its file. Without that column there is a line per capture, in their order. An empty
    cell and a missing column are unknown. Values are separated as in `read_table`.

    Raises `InputError` if the file cannot be read, the header has other columns, or a cell is neither empty nor
    allowed.
    """
    text = read_text(path)
    separator = _separator(text.partition("\n")[0])
    lines = csv.DictReader(
        io.StringIO(text, newline=""), delimiter=separator, skipinitialspace=True, restkey="", restval=""
    )
    names = [name.strip() for name in lines.fieldnames or []]
    if not names or set(names) - {*_POSITION, _CAPTURE} or len(set(names)) < len(names):
        raise input_error("header", f"some of {_CAPTURE},{','.join(_POSITION)}", short_repr(",".join(names)), path)
    lines.fieldnames = names
    points, sources = [], []
    for line in lines:
        place = f"line {lines.line_num}"
        if "" in line:
            raise input_error(place, f"{','.join(names)}", "more values", path)
        cells = [(name, _decimal((line.get(name) or "").strip(), separator)) for name in _POSITION]
        allowed = "a number of mm, or nothing if it is not known"
        points.append([_number(path, f"{place}, {name}", cell, allowed) if cell else math.nan for name, cell in cells])
        capture = len(sources)
        sources.append(_capture(path, place, line[_CAPTURE].strip(), captures) if _CAPTURE in names else capture)
        if len(sources) > MAX_SOURCES:
            raise input_error("table", f"at most {MAX_SOURCES} lines", "more", path)
    return np.array(points, float).reshape(-1, 3), np.array(sources, int)


def _capture(path: PathLike, place: str, cell: str, captures: Sequence[PathLike]) -> int:
    names = [PurePath(capture).name for capture in captures]
    if cell in names:
        return names.index(cell)
    if cell.isdecimal() and 1 <= int(cell) <= len(names):
        return int(cell) - 1
    allowed = f"a number from 1 to {len(names)} or the name of a capture"
    raise input_error(f"{place}, {_CAPTURE}", allowed, short_repr(cell), path)


def read_table(path: PathLike, header: str, max_rows: int) -> Float64[np.ndarray, "row column"]:
    """Read the numbers of a CSV file whose first line is `header`; without rows the shape is `(0, column)`.

    A semicolon or a tab in the first line separates values, in place of commas, which are then decimal ones.

    Raises `InputError` if it cannot be read, has another header, a line with too many or too few values, a value that
    is not a finite number, or more than `max_rows` rows.
    """
    names = header.split(",")
    text = read_text(path, max(MAX_TEXT_BYTES, max_rows * len(names) * _NUMBER_BYTES))
    if (table := _plain_table(text, header, max_rows)) is not None:
        return table
    separator = _separator(text.partition("\n")[0])
    lines = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    numbers = []
    try:
        first = next(lines, [])
        if (first if separator == "," else [name.strip() for name in first]) != names:
            raise input_error("header", header, short_repr(",".join(first)), path)
        for line in lines:
            if line:
                numbers.append(
                    _numbers(path, f"line {lines.line_num}", names, [_decimal(cell, separator) for cell in line])
                )
            if len(numbers) > max_rows:
                raise input_error("table", f"at most {max_rows} rows below {header}", "more", path)
    except csv.Error as error:
        raise InputError(f"{path}: line {lines.line_num} is not CSV below the header {header}: {error}.") from error
    return np.array(numbers, dtype=float).reshape(-1, len(names))


def _plain_table(text: str, header: str, max_rows: int) -> np.ndarray | None:
    """Read a table of plain numbers fast; None if it has anything else, or an error for `read_table` to describe."""
    first, _, body = text.partition("\n")
    if first.rstrip("\r") != header or not body.strip() or body.encode().translate(None, _PLAIN):
        return None
    table = _load_numbers(io.StringIO(body, newline=""), ",", header.count(",") + 1)
    return table if table is not None and len(table) <= max_rows else None


def _load_numbers(lines: Iterable[str], delimiter: str | None, columns: int) -> np.ndarray | None:
    with contextlib.suppress(ValueError):
        table = np.loadtxt(lines, delimiter=delimiter, comments=None, ndmin=2)
        if table.shape[1] == columns and np.isfinite(table).all():
            return table
    return None


def _numbers(path: PathLike, place: str, names: Sequence[str], cells: Sequence[str]) -> list[float]:
    if len(cells) != len(names):
        raise input_error(place, f"{len(names)} values ({','.join(names)})", f"{len(cells)} values", path)
    return [_number(path, f"{place}, {name}", cell) for name, cell in zip(names, cells, strict=True)]


def _number(path: PathLike, place: str, cell: str, allowed: str = "a finite number") -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or "_" in cell:  # Python reads 1_000; nobody else does
        raise input_error(place, allowed, short_repr(cell), path)
    return value


class Columns(NamedTuple):
    """Numbers `(row, 2)`, their names in the header if there is one, and further columns by name."""

    numbers: Float64[np.ndarray, "row 2"]
    names: tuple[str, str] | None
    more: dict[str, Float64[np.ndarray, " row"]]


def read_columns(path: Path, wanted: Sequence[str] | None = None, *, most: int, also: Sequence[str] = ()) -> Columns:
    """Read x and y of a table of text, with or without a header.

    Values are separated by semicolons, tabs, commas or blanks, the first of these in the first line. Blanks about
    values, empty lines and those that begin with `#` are ignored, but the last of these before the numbers is the
    header if it has as many names. `wanted` are the names of the columns x and y, by default those with a usual name,
    or the first and the second of two; `most` is the largest number of rows, and `also` names further columns, which
    are read if the header has them.

    Raises `InputError` if the file cannot be read, lacks the columns, or has lines of different length, cells in them
    that are not finite numbers, too many rows, or a further column twice.
    """
    lines = [(number, line) for number, line in enumerate(_text(path).splitlines(), 1) if line.strip()]
    body = [(number, line) for number, line in lines if not line.lstrip().startswith("#")]
    if not body:
        raise InputError(f"{path}: no line; needs a header such as x_mm,y_mm, and a line for each lens.")
    if len(body) > most + 1:
        raise input_error("table", f"at most {most} rows", f"more than {most} rows", path)
    separator = next((mark for mark in _SEPARATORS if mark in body[0][1]), " ")
    first = _split(path, *body[0], separator)
    header: list[str] | None = None
    if not all(_is_number(value, separator) for value in first):
        header, body = first, body[1:]
    elif (before := lines.index(body[0])) > 0:
        comment = _split(path, 0, lines[before - 1][1].lstrip("# \t"), separator)
        header = comment if len(comment) == len(first) else None
    at = _find_columns(path, header, len(first), wanted)
    names = (header[at[0]], header[at[1]]) if header else None
    if names and any(_is_number(name, separator) for name in names):
        raise input_error("first line", "names, or numbers", short_repr(",".join(first)), path)
    if body and len(first) == 2:
        delimiter = None if separator == " " else separator
        if (plain := _load_numbers((line for _, line in body), delimiter, 2)) is not None:
            return Columns(plain[:, at], names, {})
    further = {name: header.index(name) for name in also if header and name in header}
    for name in header or ():
        stem = f"{name.rpartition('_')[0]}_mm"
        if name not in also and stem in also:
            raise input_error(f"column {short_repr(name)}", stem, "another unit", path)
    if twice := next((name for name in further if (header or []).count(name) > 1), None):
        raise input_error(f"column {short_repr(twice)}", "in the header once", "several", path)
    called, places = [*(names or "xy"), *further], [*at, *further.values()]
    rows = []
    for number, line in body:
        cells = _split(path, number, line, separator)
        if len(cells) != len(first):
            allowed = f"{len(first)} values ({','.join(header) if header else 'as in the first line'})"
            raise input_error(f"line {number}", allowed, f"{len(cells)} values", path)
        rows.append(_numbers(path, f"line {number}", called, [_decimal(cells[i], separator) for i in places]))
    table = np.array(rows, dtype=float).reshape(-1, len(places))
    return Columns(table[:, :2], names, dict(zip(further, table[:, 2:].T, strict=True)))


def _separator(first: str) -> str:
    """The separator of a table by its first line, which has names: a comma unless it has a semicolon or a tab."""
    return next((mark for mark in _SEPARATORS if mark in first), ",")


def _text(path: Path) -> str:
    """Read UTF-8, or ASCII with the Greek mu of micrometres as spreadsheets on Windows write it."""
    try:
        return read_text(path)
    except InputError as error:
        if not isinstance(error.__cause__, UnicodeDecodeError):
            raise
        with contextlib.suppress(UnicodeDecodeError):
            return path.read_bytes().replace(b"\xb5", b"u").decode("ascii")
        raise


def _split(path: Path, number: int, line: str, separator: str) -> list[str]:
    if separator == " ":
        return re.sub(r"\s+(?=[(\[])", "", line).split()  # a unit in brackets belongs to the name before it
    try:
        return [value.strip() for value in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]
    except csv.Error as error:
        raise InputError(f"{path}: line {number} is not CSV: {error}.") from error


def _decimal(cell: str, separator: str) -> str:
    return cell.replace(",", ".") if separator != "," and "." not in cell else cell


def _is_number(cell: str, separator: str) -> bool:
    with contextlib.suppress(ValueError):
        float(_decimal(cell, separator))
        return True
    return False


def _find_columns(path: Path, header: list[str] | None, count: int, wanted: Sequence[str] | None) -> tuple[int, int]:
    if wanted is not None:
        if header is None:
            raise InputError(f"{path}: no header, which must name {' and '.join(map(repr, wanted))}.")
        plain, asked = (["".join(name.split()) for name in names] for names in (header, wanted))
        for name, bare in zip(wanted, asked, strict=True):
            if (count := plain.count(bare)) != 1:
                once = f"in the header once ({', '.join(map(repr, header)):.200})"
                raise input_error(f"column {short_repr(name)}", once, f"it {count} times", path)
        return plain.index(asked[0]), plain.index(asked[1])
    found = [[i for i, name in enumerate(header or ()) if _is_called(name, pattern)] for pattern in _NAMES]
    if len(found[0]) == len(found[1]) == 1:
        return found[0][0], found[1][0]
    if count == 2:
        return 0, 1
    given = f"{count} columns" + (f": {', '.join(map(repr, header)):.160}" if header else " without a header")
    raise input_error("columns", "two, or named x and y (`centers_columns`)", given, path)


def _is_called(name: str, pattern: re.Pattern) -> bool:
    """Whether a word of the name, without its unit in brackets, matches."""
    bare = re.sub(r"[(\[].*?[)\]]", " ", name.lower())
    return any(pattern.fullmatch(word) for word in re.split(r"[^a-z]+", bare))
