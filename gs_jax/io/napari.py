"""Layers of napari: volumes, in time too, and points to scale and in one place, in um; and a reader that makes them.

`napari.yaml` names the reader.

napari's other readers of OME-TIFF leave out where the first voxel is, and those of CSV know pixels alone.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Num

from ..base.errors import InputError
from ..grid import Grid
from ..typing import Points
from .point_tables import POINTS_HEADER, read_points
from .volume_series import Series, read_series
from .volumes import VOLUME_SUFFIXES, display_range, read_volume

Layer = tuple[Any, dict[str, Any], str]

_UM = 1000.0
_AXES: dict[str, Any] = {"axis_labels": ("z", "y", "x"), "units": ("um", "um", "um")}


def reader(path: str | list[str]) -> Callable[[str | list[str]], list[Layer]] | None:
    """What reads this path, or None if it is not ours: napari then asks others."""
    if isinstance(path, list):
        return None
    suffix = Path(path).suffix.lower()
    if suffix in VOLUME_SUFFIXES:
        return _volume
    return _points if suffix == ".csv" and _has_points(path) else None


def _has_points(path: str) -> bool:
    try:
        with open(path, encoding="utf-8-sig") as file:
            return file.readline().startswith(POINTS_HEADER)
    except (OSError, UnicodeDecodeError):
        return False


def _volume(path) -> list[Layer]:
    if (series := read_series(path)) is not None:
        return [_in_time(path, series)]
    try:
        voxels, grid = read_volume(path)
    except InputError as error:
        raise ValueError(f"not a volume of gs_jax: {error}") from error
    return [volume_layer(voxels, grid, Path(path).name)]


def volume_layer(volume: Num[np.ndarray, "depth y x"], grid: Grid, name: str) -> Layer:
    """A volume, with the range of values that files of it have too."""
    first = _UM * np.array([float(grid.depths[0]), float(grid.y[0]), float(grid.x[0])])
    scale = _UM * np.array([step_of(grid), grid.pitch, grid.pitch])
    options = {"scale": scale, "translate": first, "contrast_limits": display_range(volume), "name": name}
    return volume, options | _AXES, "image"


def step_of(grid: Grid) -> float:
    """From plane to plane in the mean, mm; a single plane is as thick as a voxel is wide."""
    return float(np.diff(np.asarray(grid.depths, np.float64)).mean()) if grid.depths.size > 1 else grid.pitch


def points_layer(points: Points, name: str, thickness: float = 0.25) -> Layer:
    """Points, each shown in the planes that are less than half of `thickness` from it, mm."""
    points = np.asarray(points, np.float64)
    # A plane shows what is within half a unit of the data's.
    scale = np.array([_UM * thickness, 1.0, 1.0])
    options = {"features": {"intensity": points[:, 3]}, "size": _SIZE, "scale": scale, "name": name}
    marks = {
        "face_color": "transparent",
        "border_color": "cyan",
        "border_width": 0.15,
        "blending": "translucent_no_depth",
    }
    return _UM * points[:, 2::-1] / scale, options | marks | _AXES, "points"


def _in_time(path, series: Series) -> Layer:
    """Volumes in time, which napari reads where it shows them."""
    unit = "s" if series.interval else "pixel"
    options = {
        "scale": series.scale,
        "translate": series.first,
        "contrast_limits": series.shown,
        "name": Path(path).name,
        "axis_labels": ("t", *_AXES["axis_labels"]),
        "units": (unit, *_AXES["units"]),
        "multiscale": len(series.levels) > 1,
    }
    return series.levels if len(series.levels) > 1 else series.levels[0], options, "image"


def _points(path) -> list[Layer]:
    return [points_layer(read_points(path), Path(path).name)]


# Of a ring around a point, um: it leaves what is in it to be seen.
_SIZE = 300.0
