"""Depths in files that count from the sample's surface.

Such a file says so, and where the surface is: a volume in its provenance, a table of points in a column. What reads it
adds the surface, so that all depths in the program are from the array.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..base.errors import input_error
from ..grid import Grid
from ..typing import PathLike
from .provenance import read_provenance

# Keys of provenance; the second is also a column of points.
FRAME, SURFACE = "depths_from", "sample_surface_mm"


class DepthFrame(NamedTuple):
    """What the depths of an output count from: the array (None), or a surface at a depth, mm."""

    surface: float | None = None

    @property
    def note(self) -> dict[str, str]:
        """What provenance says of it."""
        return {FRAME: "array"} if self.surface is None else {FRAME: "sample", SURFACE: f"{self.surface:.9g}"}

    def grid(self, grid: Grid) -> Grid:
        """The grid of an output, from one with depths from the array."""
        return grid if self.surface is None else grid.at(moved(grid.depths, -self.surface))

    def columns(self, columns: Mapping[str, Any]) -> dict[str, Any]:
        """Columns of points, from those with depths from the array."""
        if self.surface is None:
            return dict(columns)
        depths = moved(columns["z_mm"], -self.surface)
        return {**columns, "z_mm": depths, SURFACE: np.full(len(depths), self.surface)}

    def points(self, points: Any, more: Mapping[str, Any] | None) -> tuple[Any, Mapping[str, Any] | None]:
        """Points and their further columns, from points with depths from the array."""
        if self.surface is None:
            return points, more
        columns = self.columns({"z_mm": np.asarray(points)[:, 2]} | dict(more or {}))
        rows = np.array(points, float)
        rows[:, 2] = columns.pop("z_mm")
        return rows, columns


def moved(depths: Any, by: float) -> np.ndarray:
    """Depths to a nanometre, which float32's digits do not show."""
    return np.round(np.asarray(depths, float) + by, 6)


def frame_of(path: PathLike) -> str | None:
    """What the depths of a volume or of points count from, "array" or "sample"; None if it does not say."""
    if Path(path).suffix.lower() == ".csv":
        with open(path, "rb") as file:
            if SURFACE.encode() in file.readline(1000):
                return "sample"
    return read_provenance(path).get(FRAME)


def surface_of(path: PathLike) -> float:
    """Depth from which those of a volume count, mm; 0 from the array."""
    provenance = read_provenance(path)
    if provenance.get(FRAME) != "sample":
        return 0.0
    try:
        return float(provenance[SURFACE])
    except (KeyError, ValueError) as error:
        raise input_error(SURFACE, "a number of mm", provenance.get(SURFACE, "nothing"), path) from error
