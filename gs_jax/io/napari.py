"""Layers of napari in um: volumes, volumes in time, points and sheets; and the reader that `napari.yaml` names.

napari's own readers of OME-TIFF ignore the position of the first voxel, and those of CSV know pixels only.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Num

from ..base.errors import InputError
from ..grid import Grid
from ..typing import Points
from .ngff import display_range
from .point_tables import POINTS_HEADER, read_points
from .surfaces import SurfaceMaps, read_surface, surface_mesh
from .volume_series import Series, read_series
from .volumes import VOLUME_SUFFIXES, read_volume

Layer = tuple[Any, dict[str, Any], str]

_UM = 1000.0
_AXES: dict[str, Any] = {"axis_labels": ("z", "y", "x"), "units": ("um", "um", "um")}
# Diameter of the ring around a point, um.
_RING = 300.0


def reader(path: str | list[str]) -> Callable[[str | list[str]], list[Layer]] | None:
    """Return the function that reads this path, or None if it is not ours: napari then asks other readers."""
    if isinstance(path, list):
        return None
    suffix = Path(path).suffix.lower()
    if suffix in VOLUME_SUFFIXES:
        return _read_volume
    return _read_points if suffix == ".csv" and _has_points(path) else None


def _has_points(path: str) -> bool:
    try:
        with open(path, encoding="utf-8-sig") as file:
            return file.readline().startswith(POINTS_HEADER)
    except (OSError, UnicodeDecodeError):
        return False


def _read_points(path) -> list[Layer]:
    return [points_layer(read_points(path), Path(path).name)]


def _read_volume(path) -> list[Layer]:
    if (series := read_series(path)) is not None:
        return [_series_layer(series, Path(path).name)]
    try:
        voxels, grid = read_volume(path)
    except InputError as error:
        try:
            return surface_layers(read_surface(path), Path(path).name)
        except InputError:
            raise ValueError(f"neither a volume nor a surface of gs_jax: {error}") from error
    return [volume_layer(voxels, grid, Path(path).name)]


def volume_layer(volume: Num[np.ndarray, "depth y x"], grid: Grid, name: str) -> Layer:
    """A volume, with the display range that files of it have too."""
    first = _UM * np.array([float(grid.depths[0]), float(grid.y[0]), float(grid.x[0])])
    scale = _UM * np.array([mean_step(grid), grid.pitch, grid.pitch])
    options = {"scale": scale, "translate": first, "contrast_limits": display_range(volume), "name": name}
    return volume, options | _AXES, "image"


def mean_step(grid: Grid) -> float:
    """Mean distance of planes, mm; for a single plane the lateral pitch."""
    return float(np.diff(np.asarray(grid.depths, np.float64)).mean()) if grid.depths.size > 1 else grid.pitch


def points_layer(points: Points, name: str, thickness: float = 0.25) -> Layer:
    """Points as rings, shown in planes that are less than half of `thickness` from them, mm."""
    points = np.asarray(points, np.float64)
    # napari shows points within half a data unit of a plane.
    scale = np.array([_UM * thickness, 1.0, 1.0])
    options = {
        "features": {"intensity": points[:, 3]},
        "size": _RING,
        "scale": scale,
        "name": name,
        "face_color": "transparent",
        "border_color": "cyan",
        "border_width": 0.15,
        "blending": "translucent_no_depth",
    }
    return _UM * points[:, 2::-1] / scale, options | _AXES, "points"


def surface_layers(maps: SurfaceMaps, name: str) -> list[Layer]:
    """A depth map for each sheet, um, and a surface of all sheets, coloured by brightness, for the view in space."""
    grid, mesh = maps.grid, surface_mesh(maps.brightness, maps.depth, maps.grid)
    lit = maps.depth[np.isfinite(maps.depth)]
    low, high = (_UM * float(part(lit)) for part in (np.min, np.max)) if lit.size else (0.0, 1.0)
    options: dict[str, Any] = {
        "scale": (_UM * grid.pitch, _UM * grid.pitch),
        "translate": (_UM * float(grid.y[0]), _UM * float(grid.x[0])),
        "contrast_limits": (low, max(high, low + 1.0)),
        "colormap": "viridis",
        "axis_labels": ("y", "x"),
        "units": ("um", "um"),
    }
    names = [f"{name}, depth, um" + (f", sheet {n + 1}" if len(maps.depth) > 1 else "") for n in range(len(maps.depth))]
    layers: list[Layer] = [
        (_UM * depth, options | {"name": each}, "image") for depth, each in zip(maps.depth, names, strict=True)
    ]
    vertices, light, faces = mesh
    if not len(faces):
        # napari draws no empty surface.
        corner = [float(grid.x[0]), float(grid.y[0]), float(grid.depths[0])]
        vertices, light, faces = np.tile(corner, (3, 1)), np.zeros(3), np.array([[0, 1, 2]])
    shown: dict[str, Any] = {"name": f"{name}, surface", "contrast_limits": (0.0, 1.0), "colormap": "gray"}
    return [*layers, ((_UM * vertices[:, ::-1], faces, light), shown | {"shading": "none"} | _AXES, "surface")]


def _series_layer(series: Series, name: str) -> Layer:
    """Volumes in time, which napari reads as it shows them."""
    multiscale = len(series.levels) > 1
    options = {
        "scale": series.scale,
        "translate": series.first,
        "contrast_limits": series.display,
        "name": name,
        "axis_labels": ("t", *_AXES["axis_labels"]),
        "units": ("s" if series.interval else "pixel", *_AXES["units"]),
        "multiscale": multiscale,
    }
    return series.levels if multiscale else series.levels[0], options, "image"
