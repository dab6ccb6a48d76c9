"""Writes and reads sheets: an OME-TIFF of brightness, depth and its uncertainty; writes meshes as PLY."""

from typing import Any, NamedTuple, cast
from xml.etree import ElementTree

import numpy as np
import tifffile
from jaxtyping import Float, Int

from ..base.errors import input_error
from ..grid import Grid
from ..typing import PathLike
from .files import TIFF_SUFFIXES, atomic_write, check_input, check_output, check_suffix, decoding
from .ngff import first_um, title, um
from .provenance import NAMESPACE, Provenance, surface_of, write_sidecar
from .tiff import decode_plane, open_tiff
from .volumes import checked_grid, ome_length

SURFACE_SUFFIXES = (*TIFF_SUFFIXES, ".ply")
# Neighbours whose depths differ by more voxels than this lie on different parts of the scene.
_STEEP = 4

Maps = Float[np.ndarray, "sheet y x"]
# Channels of a sheet.
_CHANNELS = ("brightness", "depth_um", "sd_um")


class SurfaceMaps(NamedTuple):
    """Sheets of a file: brightness, depth from the array and its standard deviation, mm, and where the columns are."""

    brightness: Maps
    depth: Maps
    depth_sd: Maps
    grid: Grid


class Mesh(NamedTuple):
    """Triangles between lit neighbours of sheets: vertices `(x, y, z)`, mm, and their brightness, from 0 to 1."""

    vertices: Float[np.ndarray, "vertex 3"]
    brightness: Float[np.ndarray, " vertex"]
    faces: Int[np.ndarray, "face 3"]


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
        data = _ply(surface_mesh(brightness, depth, grid))
        with atomic_write(path) as temporary:
            temporary.write_bytes(data)
        write_sidecar(path, provenance)
        return
    sheets = range(1, len(depth) + 1)
    names = [f"{what}{f' {n}' if len(sheets) > 1 else ''}" for n in sheets for what in _CHANNELS]
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


def read_surface(path: PathLike) -> SurfaceMaps:
    """Read an OME-TIFF of `write_surface`; depths are from the array, whatever those of the file count from.

    Raises `InputError` if it cannot be read, or holds no sheets.
    """
    check_suffix(path, TIFF_SUFFIXES)
    path = check_input(path)
    with open_tiff(path, "OME-TIFF") as tiff:
        with decoding(path, "OME-TIFF"):
            words = tiff.first.description
            pixels = ElementTree.fromstring(words).find("{*}Image/{*}Pixels") if words.startswith("<?xml") else None
        names = [] if pixels is None else [each.get("Name", "") for each in pixels.findall("{*}Channel")]
        planes = [decode_plane(*tiff.at(image, number)) for number, image in enumerate(tiff.stack.images)]
        with decoding(path, "OME-TIFF"):
            maps = np.stack(planes)
    count = len(maps) // len(_CHANNELS)
    kinds = [name.split(" ")[0] for name in names]
    if pixels is None or kinds != [*_CHANNELS] * count or len(kinds) != len(maps) or maps.dtype != np.float32:
        raise input_error("channels", f"{', '.join(_CHANNELS)} of float32, as --surface writes", names or "none", path)
    brightness, depth, sd = maps.reshape(count, len(_CHANNELS), *maps.shape[1:]).swapaxes(0, 1)
    pitches = [ome_length(path, pixels, f"PhysicalSize{axis}", "µm") for axis in "YX"]
    plane = pixels.find("{*}Plane")
    place = ElementTree.Element("Plane") if plane is None else plane
    first = [ome_length(path, place, f"Position{axis}", "reference frame") for axis in "YX"]
    depth = depth / np.float32(1000)
    middle = float(np.nanmedian(depth)) if np.isfinite(depth).any() else 1.0
    grid = checked_grid(path, [middle], (maps.shape[1], maps.shape[2]), pitches, first)
    return SurfaceMaps(brightness, depth + np.float32(surface_of(path)), sd / np.float32(1000), grid)


def surface_mesh(brightness: Maps, depth: Maps, grid: Grid) -> Mesh:
    """Triangles between lit neighbours, of all sheets, but where the depth jumps."""
    y, x = np.meshgrid(np.asarray(grid.y), np.asarray(grid.x), indexing="ij")
    number = np.arange(depth.size).reshape(depth.shape)
    corners = [np.s_[:, :-1, :-1], np.s_[:, :-1, 1:], np.s_[:, 1:, 1:], np.s_[:, 1:, :-1]]
    around = np.stack([depth[part] for part in corners])
    # Where it is dark the range is NaN, which is not small.
    flat = np.ptp(around, axis=0) <= _STEEP * grid.pitch
    a, b, c, d = (number[part][flat] for part in corners)
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    vertices = np.stack([np.broadcast_to(x, depth.shape), np.broadcast_to(y, depth.shape), depth], -1).reshape(-1, 3)
    light = np.clip(brightness / max(np.percentile(brightness, 99.5), 1e-30), 0, 1).reshape(-1)
    used, faces = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], light[used], faces.reshape(-1, 3))


def _ply(mesh: Mesh) -> bytes:
    """A mesh as PLY, coloured by brightness."""
    import trimesh  # 0.3 s that images do not need

    grey = (255 * mesh.brightness).astype(np.uint8)
    colours = np.stack([grey, grey, grey, np.full_like(grey, 255)], -1)
    made = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)
    return bytes(cast(bytes, made.export(file_type="ply")))
