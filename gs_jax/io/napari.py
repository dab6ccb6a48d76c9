"""A reader for napari: volumes, in time too, and points to scale and in one place, in um; `napari.yaml` names it.

napari's other readers of OME-TIFF leave out where the first voxel is, and those of CSV know pixels alone.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError
from .points import POINTS_HEADER, read_points
from .viewers import display_range
from .volume_series import Series, read_series
from .volumes import VOLUME_SUFFIXES, read_volume

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
    depths = np.asarray(grid.depths, np.float64)
    step = float(np.diff(depths).mean()) if depths.size > 1 else grid.pitch
    scale = _UM * np.array([step, grid.pitch, grid.pitch])
    first = _UM * np.array([depths[0], float(grid.y[0]), float(grid.x[0])])
    options = {"scale": scale, "translate": first, "contrast_limits": display_range(voxels), "name": Path(path).name}
    return [(voxels, options | _AXES, "image")]


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
    points = read_points(path)
    options = {"features": {"intensity": points[:, 3]}, "size": _SIZE, "name": Path(path).name}
    return [(_UM * points[:, 2::-1], options | _AXES, "points")]


# Of a point's marker, um: about what the microscope resolves.
_SIZE = 40.0
