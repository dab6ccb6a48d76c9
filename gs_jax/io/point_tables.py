"""CSV tables: points, positions of calibration sources, and columns x and y of tables from other programs."""

import contextlib
import csv
import io
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int, Shaped

from ..base.arrays import host_code
from ..base.errors import InputError, input_error, short_repr
from ..base.typing import PathLike, Points
from .files import MAX_TEXT_BYTES, atomic_write, check_output, read_text
from .provenance import SURFACE, Provenance, write_sidecar

POINTS_HEADER = "x_mm,y_mm,z_mm,intensity"
MAX_POINTS, MAX_SOURCES = 1_000_000, 10_000
_POSITION, _CAPTURE = ("x_mm", "y_mm", "z_mm"), "capture"
# Longest line of numbers in bytes: ten float64 with all their digits. Characters of plain numbers.
_LINE_BYTES, _PLAIN = 320, b"0123456789+-.eE, \t\r\n"
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
    >>> gs.write_points("points.csv", np.array([[0.5, -0.4, 19.5, 1.0]]))
    >>> gs.read_points("points.csv")
    array([[ 0.5, -0.4, 19.5,  1. ]])
    """
    return read_point_columns(path)[0]


def read_scene_points(path: PathLike) -> Float64[np.ndarray, "point 4"]:
    """Points of one scene, as `read_points`; `InputError` if a column `frame` has those of several."""
    points, more = read_point_columns(path)
    if (count := len(np.unique(more.get("frame", [])))) > 1:
        raise input_error("column frame", "of one frame, which is one scene", f"{count} frames", path)
    return points


def read_point_columns(
    path: PathLike,
) -> tuple[Float64[np.ndarray, "point 4"], dict[str, Float64[np.ndarray, " point"]]]:
    """Points with depths from the array, and further columns by name; `InputError` as `read_points`."""
    names, table = read_table(path, POINTS_HEADER, MAX_POINTS)
    points, more = np.ascontiguousarray(table[:, :4]), dict(zip(names[4:], table[:, 4:].T, strict=True))
    points[:, 2] += more.get(SURFACE, 0.0)
    for column, name, wrong, allowed in (
        (2, "z_mm", points[:, 2] <= 0, "above 0"),
        (3, "intensity", points[:, 3] < 0, "0 or more"),
    ):
        if wrong.any():
            row = int(np.argmax(wrong))
            raise input_error(f"point {row + 1}, {name}", allowed, float(points[row, column]), path)
    return points, more


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
    >>> gs.write_points("points.csv", np.array([[0.5, -0.4, 19.5, 1.0]]))
    >>> print(Path("points.csv").read_text(), end="")
    x_mm,y_mm,z_mm,intensity
    0.5,-0.4,19.5,1.0
    """
    columns = [*np.asarray(points).T, *(more or {}).values()]
    write_rows(path, [POINTS_HEADER, *(more or {})], zip(*columns, strict=True), provenance)


def write_points_in_time(
    path: PathLike, frames: Iterable[tuple[int, Mapping[str, list]]], *, provenance: Provenance | None = None
) -> None:
    """Write the points of frames as one CSV, with the column `frame` after those of `write_points`.

    `frames` are their numbers and the columns of their points by name, in all the same, the first four as in
    `read_points`; one frame is held at a time. `InputError` as `check_output`.
    """
    frames = iter(frames)
    first = list(itertools.islice(frames, 1))
    rows = (
        (*row[:4], frame, *row[4:])
        for frame, columns in itertools.chain(first, frames)
        for row in zip(*columns.values(), strict=True)
    )
    names = list(first[0][1])[4:] if first else []
    write_rows(path, [POINTS_HEADER, "frame", *names], rows, provenance)


def write_rows(path: PathLike, names: Iterable[str], rows: Iterable[Iterable[Any]], provenance: Provenance | None):
    """Write a CSV file of these columns row by row, and its provenance beside it; `InputError` as `check_output`."""
    with (
        atomic_write(check_output(path, [".csv"])) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as file,
    ):
        file.write(",".join(names) + "\n")
        # `str` of NumPy's scalars has the shortest digits that read back as the same float32 or float64.
        file.writelines(",".join(map(str, row)) + "\n" for row in rows)
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
    table = _open_table(path, read_text(path))
    _, names = next(table.rows, ("", []))
    if not names or set(names) - {*_POSITION, _CAPTURE} or len(set(names)) < len(names):
        raise input_error("header", f"some of {_CAPTURE},{','.join(_POSITION)}", short_repr(",".join(names)), path)
    points, sources = [], []
    for line, cells in table.rows:
        if len(cells) > len(names):
            raise input_error(line, f"{','.join(names)}", "more values", path)
        row = dict(zip(names, cells, strict=False))
        allowed = "a number of mm, or nothing if it is not known"
        point = [(name, row.get(name)) for name in _POSITION]
        points.append([table.number(f"{line}, {name}", cell, allowed) if cell else math.nan for name, cell in point])
        capture = row.get(_CAPTURE, "")
        sources.append(_capture(path, line, capture, captures) if _CAPTURE in names else len(sources))
        if len(sources) > MAX_SOURCES:
            raise input_error("table", f"at most {MAX_SOURCES} lines", "more", path)
    return np.array(points, float).reshape(-1, 3), np.array(sources, int)


def _capture(path: PathLike, line: str, cell: str, captures: Sequence[PathLike]) -> int:
    names = [PurePath(capture).name for capture in captures]
    if cell in names:
        return names.index(cell)
    if cell.isdecimal() and 1 <= int(cell) <= len(names):
        return int(cell) - 1
    allowed = f"a number from 1 to {len(names)} or the name of a capture"
    raise input_error(f"{line}, {_CAPTURE}", allowed, short_repr(cell), path)


def read_table(path: PathLike, header: str, max_rows: int) -> tuple[list[str], Float64[np.ndarray, "row column"]]:
    """Read the numbers of a CSV file whose first columns are those of `header`, and the names of all columns.

    A semicolon or a tab in the first line separates values, in place of commas, which are then decimal ones.

    Raises `InputError` if it cannot be read, has another header, a line with too many or too few values, a value that
    is not a finite number, or more than `max_rows` rows.
    """
    text = read_text(path, max(MAX_TEXT_BYTES, max_rows * _LINE_BYTES))
    table, expected = _open_table(path, text), header.split(",")
    _, names = next(table.rows, ("", []))
    if names[: len(expected)] != expected:
        raise input_error("header", header, short_repr(",".join(names)), path)
    # Commas are decimal where another character separates.
    plain = _plain_numbers(text, len(names)) if table.separator == "," else None
    if plain is not None and len(plain) <= max_rows:
        return names, plain
    rows = [table.numbers(line, names, cells) for line, cells in itertools.islice(table.rows, max_rows + 1)]
    if len(rows) > max_rows:
        raise input_error("table", f"at most {max_rows} rows below {header}", "more", path)
    return names, np.array(rows, dtype=float).reshape(-1, len(names))


def _plain_numbers(text: str, columns: int) -> np.ndarray | None:
    """Read plain numbers below a header fast; None if there is anything else, or a fault for `read_table` to name."""
    first, _, body = text.partition("\n")
    if "\r" in first.rstrip("\r") or not body.strip() or body.encode().translate(None, _PLAIN):
        return None
    return _load_numbers(io.StringIO(body, newline=""), ",", columns)


def _load_numbers(lines: Iterable[str], delimiter: str | None, columns: int) -> np.ndarray | None:
    with contextlib.suppress(ValueError):
        table = np.loadtxt(lines, delimiter=delimiter, comments=None, ndmin=2)
        if table.shape[1] == columns and np.isfinite(table).all():
            return table
    return None


class _Table(NamedTuple):
    """A table of text: for each line that is not empty its name in messages, and its cells."""

    path: PathLike
    separator: str
    rows: Iterator[tuple[str, list[str]]]

    def numbers(self, line: str, names: Sequence[str], cells: Sequence[str]) -> list[float]:
        """Numbers of a line that has these columns; `InputError` if it has more or fewer, or other values."""
        if len(cells) != len(names):
            raise input_error(line, f"{len(names)} values ({','.join(names)})", f"{len(cells)} values", self.path)
        return [self.number(f"{line}, {name}", cell) for name, cell in zip(names, cells, strict=True)]

    def number(self, place: str, cell: str, allowed: str = "a finite number") -> float:
        value = self.parse(cell)
        if value is None or not math.isfinite(value) or "_" in cell:  # Python reads 1_000; nobody else does
            raise input_error(place, allowed, short_repr(cell), self.path)
        return value

    def parse(self, cell: str) -> float | None:
        """The number of a cell, with a decimal comma unless commas separate; None if it is none."""
        with contextlib.suppress(ValueError):
            return float(cell.replace(",", ".") if self.separator != "," and "." not in cell else cell)
        return None


def _open_table(path: PathLike, text: str, *, blanks: bool = False) -> _Table:
    """Split a text into cells, by what separates them in its first line that is not empty; `blanks` may, too.

    Its rows raise `InputError` for a line that is not CSV.
    """
    first = next((line for line in io.StringIO(text, newline="") if line.strip()), "")
    separator = next((mark for mark in _SEPARATORS if mark in first), " " if blanks else ",")
    return _Table(path, separator, _rows(path, io.StringIO(text, newline=""), separator))


def _rows(path: PathLike, lines: Iterable[str], separator: str) -> Iterator[tuple[str, list[str]]]:
    if separator == " ":
        # A unit in brackets belongs to the name before it.
        lines = (re.sub(r"\s+(?=[(\[])", "", " ".join(line.split())) for line in lines)
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    try:
        for cells in reader:
            if cells:
                yield f"line {reader.line_num}", [cell.strip() for cell in cells]
    except csv.Error as error:
        raise InputError(f"{path}: line {reader.line_num} is not CSV: {error}.") from error


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
    comment, lines = "", _text(path).splitlines()
    for line in itertools.takewhile(lambda line: line.lstrip()[:1] in ("", "#"), lines):
        comment = line.lstrip("# \t") if line.strip() else comment
    table = _open_table(path, "\n".join("" if line.lstrip()[:1] in ("", "#") else line for line in lines), blanks=True)
    line, first = next(table.rows, ("", []))
    if not first:
        raise InputError(f"{path}: no line; needs a header such as x_mm,y_mm, and a line for each lens.")
    rows, header = table.rows, first
    if all(table.parse(cell) is not None for cell in first):
        rows = itertools.chain([(line, first)], rows)
        _, header = next(_rows(path, [comment], table.separator), ("", None))
        header = header if header and len(header) == len(first) else None
    at = _find_columns(path, header, len(first), wanted)
    names = (header[at[0]], header[at[1]]) if header else None
    if names and any(table.parse(name) is not None for name in names):
        raise input_error("first line", "names, or numbers", short_repr(",".join(first)), path)
    further = {name: header.index(name) for name in also if header and name in header}
    for name in header or ():
        stem = f"{name.rpartition('_')[0]}_mm"
        if name not in also and stem in also:
            raise input_error(f"column {short_repr(name)}", stem, "another unit", path)
    if twice := next((name for name in further if (header or []).count(name) > 1), None):
        raise input_error(f"column {short_repr(twice)}", "in the header once", "several", path)
    called, places, numbers = [*(names or "xy"), *further], [*at, *further.values()], []
    for line, cells in itertools.islice(rows, most + 1):
        if len(cells) != len(first):
            allowed = f"{len(first)} values ({','.join(header) if header else 'as in the first line'})"
            raise input_error(line, allowed, f"{len(cells)} values", path)
        numbers.append(table.numbers(line, called, [cells[place] for place in places]))
    if len(numbers) > most:
        raise input_error("table", f"at most {most} rows", f"more than {most} rows", path)
    columns = np.array(numbers, dtype=float).reshape(-1, len(places))
    return Columns(columns[:, :2], names, dict(zip(further, columns[:, 2:].T, strict=True)))


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
    x, y = ([i for i, name in enumerate(header or ()) if _is_called(name, pattern)] for pattern in _NAMES)
    if len(x) == len(y) == 1:
        return x[0], y[0]
    if count == 2:
        return 0, 1
    given = f"{count} columns" + (f": {', '.join(map(repr, header)):.160}" if header else " without a header")
    raise input_error("columns", "two, or named x and y (`centers_columns`)", given, path)


def _is_called(name: str, pattern: re.Pattern) -> bool:
    """Whether a word of the name, without its unit in brackets, matches."""
    bare = re.sub(r"[(\[].*?[)\]]", " ", name.lower())
    return any(pattern.fullmatch(word) for word in re.split(r"[^a-z]+", bare))
