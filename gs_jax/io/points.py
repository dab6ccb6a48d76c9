"""Points on disk: CSV."""

import os

import numpy as np
from jaxtyping import Array, Float, Float64

from ..base.errors import InputError, short_repr
from .disk import read_table, write_text

MAX_POINTS = 1_000_000
POINTS_HEADER = "x_mm,y_mm,z_mm,intensity"


def read_points(path: str | os.PathLike[str]) -> Float64[np.ndarray, "point 4"]:
    """Points `(x, y, z, intensity)` from a CSV file with the header `x_mm,y_mm,z_mm,intensity`.

    Raises
    ------
    InputError
        As `read_table`, and if a depth is not above 0 or an intensity is below 0.
    """
    points = read_table(path, POINTS_HEADER, MAX_POINTS)
    for column, wrong, allowed in ((2, points[:, 2] <= 0, "a depth above 0"), (3, points[:, 3] < 0, "0 or more")):
        if wrong.any():
            row = int(np.argmax(wrong))
            name = POINTS_HEADER.split(",")[column]
            found = short_repr(float(points[row, column]))
            raise InputError(f"{path}: point {row + 1}, {name}: found {found}, allowed: {allowed}.")
    return points


def write_points(path: str | os.PathLike[str], points: Float[Array | np.ndarray, "point 4"]) -> None:
    """Writes points `(x, y, z, intensity)`, mm, as CSV; what is read back is equal.

    Raises
    ------
    InputError
        As `check_output`, for `.csv`.
    """
    rows = np.asarray(points)
    # `str` of the array's own scalars: the shortest digits that read back as the same float32 or float64.
    lines = [POINTS_HEADER, *(",".join(str(value) for value in row) for row in rows)]
    write_text(path, "\n".join(lines) + "\n", [".csv"])
