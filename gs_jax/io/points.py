"""Points on disk: CSV."""

import os
from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Array, Float, Float64, Shaped

from ..base.errors import InputError, short_repr
from .disk import atomic_write, check_input, check_output, read_table, write_text
from .provenance import Provenance, write_sidecar

MAX_POINTS = 1_000_000
# Of the first line, bytes.
_LONGEST = 1000
POINTS_HEADER = "x_mm,y_mm,z_mm,intensity"


def read_points(path: str | os.PathLike[str]) -> Float64[np.ndarray, "point 4"]:
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
    path: str | os.PathLike[str],
    points: Float[Array | np.ndarray, "point 4"],
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
    path: str | os.PathLike[str],
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
