"""Where point sources are in captures, on disk: CSV, of which people know some columns and cells."""

import csv
import io
import math
import os
from collections.abc import Sequence
from pathlib import PurePath

import numpy as np
from jaxtyping import Float64, Int

from ..base.errors import InputError, short_repr
from .disk import read_text

COLUMNS = ("x_mm", "y_mm", "z_mm")
_CAPTURE = "capture"
MAX_SOURCES = 10_000


def read_positions(
    path: str | os.PathLike[str], captures: Sequence[str | os.PathLike[str]]
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


def _capture(place: str, cell: str, captures: Sequence[str | os.PathLike[str]]) -> int:
    names = [PurePath(path).name for path in captures]
    if cell in names:
        return names.index(cell)
    if cell.isdecimal() and 1 <= int(cell) <= len(names):
        return int(cell) - 1
    allowed = f"a number from 1 to {len(names)} or the name of a capture"
    raise InputError(f"{place}, {_CAPTURE}: found {short_repr(cell)}, allowed: {allowed}.")
