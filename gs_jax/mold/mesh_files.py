"""Solids on disk: binary STL and 3MF, in mm.

STL has no units and no shared vertices: a reader finds the neighbours of a facet by equal corners. So vertices are
rounded to float32 and merged before anything is written, and what is left is checked again.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import manifold3d as m3
import numpy as np
import trimesh
from jaxtyping import Float, Int
from trimesh.exchange.stl import export_stl
from trimesh.exchange.threemf import export_3MF

from ..base.errors import InputError
from ..io.disk import atomic_write, check_input, check_output, decoding

# Of a file to be read back: 50 bytes a facet, a few million facets.
MAX_MESH_BYTES = 2**31


@dataclass(frozen=True)
class Mesh:
    """Facets of a closed surface, counter-clockwise seen from outside, as indices of vertices, mm."""

    vertices: Float[np.ndarray, "vertex 3"]
    facets: Int[np.ndarray, "facet 3"]

    def solid(self) -> m3.Manifold:
        """The solid inside; its `status()` says whether there is one."""
        return m3.Manifold(m3.Mesh64(self.vertices.astype(np.float64), self.facets.astype(np.uint64)))


def printable(solid: m3.Manifold) -> Mesh:
    """The mesh of a solid as STL can hold it: float32 corners that are all different, no facet without corners."""
    mesh = solid.to_mesh64()
    return _merged(mesh.vert_properties[:, :3].astype(np.float32), mesh.tri_verts.astype(np.int64))


def _merged(vertices: np.ndarray, facets: np.ndarray) -> Mesh:
    """With equal vertices made one, and without the facets that this leaves fewer than three."""
    order = np.lexsort(vertices.T)
    ordered = vertices[order]
    is_new = np.concatenate([[True], (ordered[1:] != ordered[:-1]).any(axis=1)])
    index = np.empty(len(order), np.int64)
    index[order] = np.cumsum(is_new) - 1
    facets = index[facets]
    whole = (facets != np.roll(facets, 1, axis=1)).all(axis=1)
    return Mesh(ordered[is_new], facets[whole])


def write_mesh(path: str | os.PathLike[str], mesh: Mesh, name: str) -> None:
    """Writes a mesh as binary STL or 3MF, by the suffix, whole or not at all.

    STL's header says what it is and that its unit is the millimetre; 3MF has a field for it.

    Raises
    ------
    InputError
        As `check_output`, for `.stl` and `.3mf`.
    """
    path = check_output(path, MESH_SUFFIXES)
    solid = trimesh.Trimesh(mesh.vertices, mesh.facets, process=False)
    data = _WRITERS[path.suffix.lower()](solid, name)
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def _stl(solid: trimesh.Trimesh, name: str) -> bytes:
    header = f"gs_jax, unit: mm, {name}".encode("ascii", "replace")[:80].ljust(80)
    return header + export_stl(solid)[80:]


def _3mf(solid: trimesh.Trimesh, name: str) -> bytes:
    plain = "".join(c for c in name if c.isprintable()) or "part"
    return export_3MF(trimesh.Scene({plain: solid}))


# To add a format that trimesh reads, add its suffix with what it is written by.
_WRITERS = {".stl": _stl, ".3mf": _3mf}
MESH_SUFFIXES = tuple(_WRITERS)


def read_mesh(path: str | os.PathLike[str]) -> Mesh:
    """The mesh in an STL or 3MF file, in mm, with equal corners merged.

    Raises
    ------
    InputError
        If it cannot be read, is too large, is no such file, or holds no facet.
    """
    path = check_input(path)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(f"{path}: found the suffix {path.suffix!r}, allowed: {', '.join(MESH_SUFFIXES)}.")
    if path.stat().st_size > MAX_MESH_BYTES:
        raise InputError(f"{path}: found {path.stat().st_size} bytes, allowed: at most {MAX_MESH_BYTES}.")
    with decoding(path, "STL or 3MF file"):
        corners = _corners(path)
    if not len(corners) or not np.isfinite(corners).all():
        raise InputError(f"{path}: found {len(corners)} facets, allowed: one or more, of finite coordinates.")
    return _merged(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def _corners(path: Path) -> np.ndarray:
    scene = trimesh.load_scene(path, process=False)
    mesh = scene.to_mesh()
    if scene.units not in (None, "mm", "millimeter", "millimeters"):
        mesh.units = scene.units
        mesh.convert_units("millimeters")
    return np.asarray(mesh.triangles)
