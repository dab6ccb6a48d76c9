"""Sheets in the report: pictures of brightness and depth, and what the browser draws in space."""

from typing import Any, NamedTuple

import numpy as np

from ...grid import Grid
from ...io.surfaces import SurfaceMaps, surface_mesh
from ...pictures import png_uri, to_base64, to_uint8
from .report_tables import mesh_view

# Pixels along a picture, and columns of sheets in space.
_MAX_PIXELS, _MAX_COLUMNS = 720, 40_000


def surface_view(maps: SurfaceMaps) -> dict[str, Any] | None:
    """Sheets for the browser, with the brightness of each vertex from 0 to 255; None if all is dark."""
    step = int(np.ceil(np.sqrt(maps.depth.size / _MAX_COLUMNS)))
    first = np.s_[:, step // 2 :: step, step // 2 :: step]
    brightness, depth = maps.brightness[first], maps.depth[first]
    grid = Grid(maps.grid.depths, depth.shape[1:], maps.grid.pitch * step, maps.grid.origin)
    vertices, light, faces = surface_mesh(brightness, depth, grid)
    return mesh_view(vertices, faces) | {"light": to_base64(to_uint8(light, 0.0, 1.0))} if len(faces) else None


class SheetPictures(NamedTuple):
    """Pictures of a sheet, transparent where it is dark, and the median standard deviation of its depth, mm."""

    brightness: str
    depth: str
    sd: float


def sheet_pictures(maps: SurfaceMaps) -> tuple[list[SheetPictures], float, float]:
    """Pictures of each sheet, and the depths of the first and the last colour, mm."""
    lit = np.isfinite(maps.depth)
    low, high = np.percentile(maps.depth[lit], (0.5, 99.5)) if lit.any() else (0.0, 0.0)
    pictures = []
    for brightness, depth, sd in zip(maps.brightness, maps.depth, maps.depth_sd, strict=True):
        # 0 is left for the dark.
        colours = np.maximum(to_uint8(np.nan_to_num(depth, nan=low), low, high), 1) * np.isfinite(depth)
        small = max(-(-max(depth.shape) // _MAX_PIXELS), 1)
        light = to_uint8(brightness, 0.0, float(np.percentile(brightness, 99.5)))
        depth_picture = png_uri(colours.astype(np.uint8)[::small, ::small], "viridis", transparent=0)
        known = sd[np.isfinite(sd)]
        middle = float(np.median(known)) if known.size else 0.0
        pictures.append(SheetPictures(png_uri(light[::small, ::small]), depth_picture, middle))
    return pictures, float(low), float(high)
