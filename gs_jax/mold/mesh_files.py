"""Solids on disk: binary STL and 3MF, in mm.

STL has no units and no shared vertices: a reader finds the neighbours of a facet by equal corners. So vertices are
rounded to float32 and merged before anything is written, and what is left is checked again.
"""

import io
import json
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import manifold3d as m3
import numpy as np
import trimesh
from jaxtyping import Float, Int
from trimesh.exchange.stl import export_stl

from .._version import __version__
from ..base.errors import InputError
from ..io.files import atomic_write, check_input, check_output, decoding
from ..io.provenance import KEY, Provenance

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


def write_mesh(path: str | os.PathLike[str], mesh: Mesh, name: str, provenance: Provenance | None = None) -> None:
    """Writes a mesh as binary STL or 3MF, by the suffix, whole or not at all. The same mesh gives the same bytes.

    STL's header says what it is and that its unit is the millimetre; 3MF has fields for it, and for where it comes
    from.

    Raises
    ------
    InputError
        As `check_output`, for `.stl` and `.3mf`.
    """
    path = check_output(path, MESH_SUFFIXES)
    data = _WRITERS[path.suffix.lower()](mesh, name, provenance or {})
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def _stl(mesh: Mesh, name: str, provenance: Provenance) -> bytes:
    header = f"gs_jax, unit: mm, {name}".encode("ascii", "replace")[:80].ljust(80)
    return header + export_stl(trimesh.Trimesh(mesh.vertices, mesh.facets, process=False))[80:]


def _3mf(mesh: Mesh, name: str, provenance: Provenance) -> bytes:
    """Not by trimesh, whose files strict readers refuse, nor by lib3mf, which gives parts random names."""
    plain = escape("".join(c for c in name if c.isprintable()) or "part", {'"': "&quot;"})
    fields = {"Title": plain, "Application": f"gs_jax {__version__}"}
    if provenance:
        fields[f"gs:{KEY}"] = escape(json.dumps(dict(provenance), ensure_ascii=False))
    metadata = "".join(f'<metadata name="{key}">{value}</metadata>\n' for key, value in fields.items())
    vertices = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>\n' for x, y, z in mesh.vertices)
    facets = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>\n' for a, b, c in mesh.facets.tolist())
    model = (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<model unit="millimeter" xml:lang="en-US" xmlns="{_CORE}" '
        f'xmlns:gs="https://pypi.org/project/gs-jax/provenance">\n{metadata}<resources>\n'
        f'<object id="1" type="model" name="{plain}"><mesh>\n<vertices>\n{vertices}</vertices>\n'
        f"<triangles>\n{facets}</triangles>\n</mesh></object>\n</resources>\n"
        f'<build><item objectid="1"/></build>\n</model>\n'
    )
    parts = {"[Content_Types].xml": _TYPES, "_rels/.rels": _RELATIONS, "3D/3dmodel.model": model}
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for place, text in parts.items():
            archive.writestr(zipfile.ZipInfo(place, _LONG_AGO), text, zipfile.ZIP_DEFLATED)
    return data.getvalue()


# Of the 3D Manufacturing Format, core specification 1.3.
_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_TYPES = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)
_RELATIONS = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Id="rel0" Target="/3D/3dmodel.model" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
)
# The time of every part: the earliest that ZIP has.
_LONG_AGO = (1980, 1, 1, 0, 0, 0)
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
