"""Writes sheets: an OME-TIFF of brightness, depth and its uncertainty, or a mesh as PLY."""

from typing import Any, cast

import numpy as np
import tifffile
from jaxtyping import Float

from ..grid import Grid
from ..typing import PathLike
from .files import atomic_write, check_output
from .ngff import first_um, title, um
from .provenance import NAMESPACE, Provenance, write_sidecar

SURFACE_SUFFIXES = (".tif", ".tiff", ".ply")
# Neighbours whose depths differ by more voxels than this lie on different parts of the scene.
_STEEP = 4

Maps = Float[np.ndarray, "sheet y x"]


def write_surface(
    path: PathLike,
    brightness: Maps,
    depth: Maps,
    depth_sd: Maps,
    grid: Grid,
    *,
    below: float = 0.0,
    provenance: Provenance | None = None,
) -> None:
    """Writes sheets, whole or not at all.

    Parameters
    ----------
    path
        Ends in `.tif` or `.tiff` (best `.ome.tif`): brightness, depth and its standard deviation, um, as channels of a
        float32 image; NaN where it is dark. Or in `.ply`: a mesh in mm, coloured by brightness.
    brightness, depth, depth_sd
        As in `SurfaceFit`, mm.
    grid
        Positions of the columns.
    below
        Depth from which those of the file count, mm.
    provenance
        Kept in the OME-TIFF, or beside a mesh.

    Raises
    ------
    InputError
        As `check_output`.
    """
    path = check_output(path, SURFACE_SUFFIXES)
    depth = depth - np.float32(below)
    if path.suffix.lower() == ".ply":
        data = _mesh(brightness, depth, grid)
        with atomic_write(path) as temporary:
            temporary.write_bytes(data)
        write_sidecar(path, provenance)
        return
    sheets = range(1, len(depth) + 1)
    names = [
        f"{what}{f' {n}' if len(sheets) > 1 else ''}" for n in sheets for what in ("brightness", "depth_um", "sd_um")
    ]
    channels = np.stack([brightness, 1000 * depth, 1000 * depth_sd], 1).reshape(-1, *depth.shape[1:])
    y, x = first_um(grid)
    plane = {"PositionX": [x] * len(names), "PositionY": [y] * len(names)}
    metadata: dict[str, Any] = {"axes": "CYX", "Name": title(path), "Channel": {"Name": names}}
    metadata |= {f"PhysicalSize{axis}": um(grid.pitch) for axis in "XY"}
    metadata |= {f"PhysicalSize{axis}Unit": "µm" for axis in "XY"}
    metadata["Plane"] = plane | {f"{name}Unit": ["µm"] * len(names) for name in plane}
    if provenance:
        metadata["MapAnnotation"] = {"Namespace": NAMESPACE, **provenance}
    with atomic_write(path) as temporary:
        tifffile.imwrite(temporary, channels.astype(np.float32), ome=True, photometric="minisblack", metadata=metadata)


def _mesh(brightness, depth, grid) -> bytes:
    """Triangles between lit neighbours, of all sheets, as PLY."""
    import trimesh  # 0.3 s that images do not need

    y, x = np.meshgrid(np.asarray(grid.y), np.asarray(grid.x), indexing="ij")
    number = np.arange(depth.size).reshape(depth.shape)
    corners = [np.s_[:, :-1, :-1], np.s_[:, :-1, 1:], np.s_[:, 1:, 1:], np.s_[:, 1:, :-1]]
    around = np.stack([depth[part] for part in corners])
    # Where it is dark the range is NaN, which is not small.
    flat = np.ptp(around, axis=0) <= _STEEP * grid.pitch
    a, b, c, d = (number[part][flat] for part in corners)
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    vertices = np.stack([np.broadcast_to(x, depth.shape), np.broadcast_to(y, depth.shape), depth], -1).reshape(-1, 3)
    grey = np.clip(255 * brightness / max(np.percentile(brightness, 99.5), 1e-30), 0, 255).astype(np.uint8).reshape(-1)
    used, faces = np.unique(faces, return_inverse=True)
    colours = np.stack([*(grey[used],) * 3, np.full(used.size, 255, np.uint8)], -1)
    mesh = trimesh.Trimesh(vertices[used], faces.reshape(-1, 3), vertex_colors=colours, process=False)
    return bytes(cast(bytes, mesh.export(file_type="ply")))
