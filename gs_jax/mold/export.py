"""Solids on disk: binary STL and 3MF, in mm.

STL has no units and no shared vertices: a reader finds the neighbours of a facet by equal corners. So vertices are
rounded to float32 and merged before anything is written, and what is left is checked again.
"""

import io
import json
import math
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import manifold3d as m3
import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from trimesh.exchange.stl import export_stl

from .._version import __version__
from ..base.errors import InputError
from ..io.files import atomic_write, check_input, check_output, decoding
from ..io.provenance import KEY, Provenance, write_sidecar
from ..lenses import MicrolensArray
from ..typing import PathLike
from .lenslets import caps_of
from .solids import MoldShape, mark_plans, mold_block

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


def write_mesh(path: PathLike, mesh: Mesh, name: str, provenance: Provenance | None = None) -> None:
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


def read_mesh(path: PathLike) -> Mesh:
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


Ring = Float[np.ndarray, "corner 2"]

# Of polygons where circles overlap, mm: below what photomasks resolve.
_CHORD = 1e-4
# The unit of a GDSII file, and its grid, m.
_GDS_UNIT, _GDS_GRID = 1e-6, 1e-9
# Its last record, ENDLIB.
_GDS_END = b"\0\4\4\0"


class Mask(NamedTuple):
    """A mask's plan, mm: `circles` are rows `(x, y, diameter)`; rings are closed, holes run the other way round.

    Parameters
    ----------
    outline
        Of the sheet.
    circles, openings
        Where light passes: lenses that stand alone, and what others make together.
    marks
        Crosses for alignment, as in the mold's rim.
    """

    outline: Ring
    circles: Float[np.ndarray, "circle 3"]
    openings: list[Ring]
    marks: list[Ring]


def mask_plan(array: MicrolensArray, shape: MoldShape = MoldShape()) -> Mask:
    """The mask of an array, with the marks of its mold.

    Raises
    ------
    InputError
        If the plate is infinite, or if lenses cover it: there is nothing to be masked.
    """
    if not np.isfinite(np.asarray(array.size, float)).all():
        raise InputError("`array.size_mm`: found an infinite plate, allowed: a finite one.")
    caps, side = caps_of(array), np.asarray(array.size, float)
    centers, reach = np.stack([cap.center for cap in caps]), np.array([cap.reach for cap in caps])
    alone = np.all(np.abs(centers) + reach[:, None] <= side / 2, axis=1)
    pairs = KDTree(centers).query_pairs(2 * reach.max(), output_type="ndarray")
    meet = np.hypot(*(centers[pairs[:, 0]] - centers[pairs[:, 1]]).T) <= reach[pairs].sum(axis=1)
    alone[pairs[meet]] = False
    discs = [_disc(r).translate(at) for at, r in zip(centers[~alone].tolist(), reach[~alone].tolist(), strict=True)]
    others = m3.CrossSection.batch_boolean(discs, m3.OpType.Add)
    plate = m3.CrossSection.square(side.tolist(), center=True)
    together = others ^ plate
    if (plate - together).area() < 1e-6 * plate.area():
        raise InputError("`lens.aperture_diameter_mm`: found lenses that cover the plate, allowed: some of it left.")
    (left, bottom, _), (right, top, _) = mold_block(array, shape)
    outline = np.array([(left, bottom), (right, bottom), (right, top), (left, top)])
    circles = np.column_stack([centers[alone], 2 * reach[alone]])
    marks = [ring for plan in mark_plans(array, shape) for ring in plan.to_polygons()]
    return Mask(outline, circles, together.to_polygons(), marks)


def _disc(radius: float) -> m3.CrossSection:
    # A chord of a circle is that far inside it.
    return m3.CrossSection.circle(radius, 4 * math.ceil(math.pi / 4 / math.acos(1 - min(_CHORD / radius, 1))))


def write_mask(path: PathLike, mask: Mask, provenance: Provenance | None = None) -> None:
    """Writes a mask as DXF, SVG or, where `gdstk` is installed, GDSII, by the suffix; whole or not at all.

    Layers are OUTLINE, OPENINGS and MARKS (GDSII: 0, 1 and 2). DXF and SVG are in mm, GDSII in um.

    Raises
    ------
    InputError
        As `check_output`; for GDSII without `gdstk`.
    """
    path = check_output(path, MASK_SUFFIXES)
    with atomic_write(path) as temporary:
        _MASK_WRITERS[path.suffix.lower()](temporary, mask)
    write_sidecar(path, provenance)


def _layers(mask: Mask) -> dict[str, list[Ring]]:
    return {"OUTLINE": [mask.outline], "OPENINGS": mask.openings, "MARKS": mask.marks}


def _write_dxf(path: Path, mask: Mask) -> None:
    from ezdxf.filemanagement import new
    from ezdxf.units import MM

    document = new("R2010", units=MM)
    space = document.modelspace()
    for color, (layer, rings) in enumerate(_layers(mask).items(), start=1):
        document.layers.add(layer, color=color)
        for ring in rings:
            space.add_lwpolyline(ring.tolist(), close=True, dxfattribs={"layer": layer})
    for x, y, diameter in mask.circles.tolist():
        space.add_circle((x, y), diameter / 2, dxfattribs={"layer": "OPENINGS"})
    document.saveas(path)


def _write_svg(path: Path, mask: Mask) -> None:
    (left, top), (right, bottom) = mask.outline.min(0), mask.outline.max(0)
    width, height = right - left, bottom - top
    root = ElementTree.Element(
        "svg",
        xmlns="http://www.w3.org/2000/svg",
        width=f"{width:.10g}mm",
        height=f"{height:.10g}mm",
        viewBox=f"{left:.10g} {top:.10g} {width:.10g} {height:.10g}",
    )
    upward = ElementTree.SubElement(root, "g", transform=f"matrix(1 0 0 -1 0 {top + bottom:.10g})")
    for layer, rings in _layers(mask).items():
        group = ElementTree.SubElement(upward, "g", id=layer, fill="black" if layer == "OUTLINE" else "white")
        path_of = lambda ring: "M" + "L".join(f"{x:.10g},{y:.10g}" for x, y in ring) + "Z"
        if rings:
            ElementTree.SubElement(group, "path", {"d": "".join(map(path_of, rings)), "fill-rule": "evenodd"})
        for x, y, diameter in mask.circles.tolist() if layer == "OPENINGS" else ():
            ElementTree.SubElement(group, "circle", cx=f"{x:.10g}", cy=f"{y:.10g}", r=f"{diameter / 2:.10g}")
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _write_gds(path: Path, mask: Mask) -> None:
    try:
        import gdstk
    except ImportError as error:
        raise InputError(f"{path.suffix}: found no gdstk, allowed: after `pip install 'gs-jax[gds]'`.") from error
    library = gdstk.Library("gs_jax", unit=_GDS_UNIT, precision=_GDS_GRID)
    cell = library.new_cell("MASK")
    um = 1000
    for layer, rings in enumerate(_layers(mask).values()):
        # Its polygons have no holes: they are cut into such as have none.
        parts = [[gdstk.Polygon((um * ring).tolist()) for ring in rings if _is_hole(ring) == hole] for hole in (0, 1)]
        cell.add(*gdstk.boolean(parts[0], parts[1], "not", precision=_GDS_GRID / _GDS_UNIT, layer=layer))
    for x, y, diameter in mask.circles:
        cell.add(gdstk.ellipse((um * x, um * y), um * diameter / 2, layer=1, tolerance=um * _CHORD))
    library.write_gds(path)
    # gdstk says nothing of what it could not write.
    if not path.read_bytes().endswith(_GDS_END):
        raise OSError("found no end of the library in what was written")


def _is_hole(ring: Ring) -> bool:
    x, y = ring.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) < 0


_MASK_WRITERS: dict[str, Callable[[Path, Mask], None]] = {".dxf": _write_dxf, ".svg": _write_svg, ".gds": _write_gds}
MASK_SUFFIXES = tuple(_MASK_WRITERS)
