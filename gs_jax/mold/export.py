"""Files for manufacturing: meshes as binary STL and 3MF, the opaque mask between the lenses as DXF, SVG and GDSII.

STL stores neither units nor shared vertices; readers find neighbours of a facet by equal corners. Meshes are therefore
rounded to float32 and merged before they are checked and written. All lengths in mm.
"""

import io
import json
import math
import zipfile
from dataclasses import dataclass
from importlib import import_module
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
from ..base.errors import InputError, needs_extra
from ..base.typing import PathLike
from ..io.files import atomic_write, check_input, check_output, check_suffix, decoding
from ..io.provenance import KEY, Provenance, write_sidecar
from ..microscope.lenses import MicrolensArray
from .lenslets import Part
from .solids import MoldShape, alignment_marks, mold_bounds

# Readers accept a few million facets of 50 bytes.
MAX_MESH_BYTES = 2**31
# Chordal tolerance of polygons where openings overlap, mm: below the resolution of photomasks.
_MASK_CHORD = 1e-4
# Unit and grid of GDSII files, m, and their last record, ENDLIB.
_GDS_UNIT, _GDS_GRID, _GDS_END = 1e-6, 1e-9, b"\0\4\4\0"

Ring = Float[np.ndarray, "corner 2"]


@dataclass(frozen=True)
class Mesh:
    """Facets of a closed surface, counter-clockwise seen from outside, as indices of vertices, mm."""

    vertices: Float[np.ndarray, "vertex 3"]
    facets: Int[np.ndarray, "facet 3"]

    def solid(self) -> m3.Manifold:
        """The solid inside; its `status()` says whether there is one."""
        return m3.Manifold(m3.Mesh64(self.vertices.astype(np.float64), self.facets.astype(np.uint64)))


def float32_mesh(solid: m3.Manifold) -> Mesh:
    """The mesh of a solid with vertices in float32, as STL stores them; vertices that become equal are merged."""
    mesh = solid.to_mesh64()
    return _merge_vertices(mesh.vert_properties[:, :3].astype(np.float32), mesh.tri_verts.astype(np.int64))


def _merge_vertices(vertices: np.ndarray, facets: np.ndarray) -> Mesh:
    """Merges equal vertices and removes facets that collapse. A few times faster than `np.unique` of rows."""
    order = np.lexsort(vertices.T)
    ordered = vertices[order]
    is_new = np.concatenate([[True], (ordered[1:] != ordered[:-1]).any(axis=1)])
    index = np.empty(len(order), np.int64)
    index[order] = np.cumsum(is_new) - 1
    facets = index[facets]
    return Mesh(ordered[is_new], facets[(facets != np.roll(facets, 1, axis=1)).all(axis=1)])


def write_mesh(path: PathLike, mesh: Mesh, name: str, provenance: Provenance | None = None) -> None:
    """Writes a mesh as binary STL or 3MF, by the suffix, atomically and reproducibly; `InputError` as `check_output`.

    `name`, of the part, goes to the header of STL and the title of 3MF, `provenance` to the metadata of 3MF.
    """
    path = check_output(path, MESH_SUFFIXES)
    if path.suffix.lower() == ".stl":
        header = f"gs_jax, unit: mm, {name}".encode("ascii", "replace")[:80].ljust(80)
        data = header + export_stl(trimesh.Trimesh(mesh.vertices, mesh.facets, process=False))[80:]
    else:
        data = _encode_3mf(mesh, name, provenance or {})
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def _encode_3mf(mesh: Mesh, name: str, provenance: Provenance) -> bytes:
    # Strict readers refuse the files of trimesh, and lib3mf gives parts random identifiers.
    title = escape("".join(c for c in name if c.isprintable()) or "part", {'"': "&quot;"})
    fields = {"Title": title, "Application": f"gs_jax {__version__}"}
    if provenance:
        fields[f"gs:{KEY}"] = escape(json.dumps(dict(provenance), ensure_ascii=False))
    metadata = "".join(f'<metadata name="{key}">{value}</metadata>\n' for key, value in fields.items())
    vertices = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>\n' for x, y, z in mesh.vertices)
    facets = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>\n' for a, b, c in mesh.facets.tolist())
    model = (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<model unit="millimeter" xml:lang="en-US" xmlns="{_3MF_CORE}" '
        f'xmlns:gs="https://pypi.org/project/gs-jax/provenance">\n{metadata}<resources>\n'
        f'<object id="1" type="model" name="{title}"><mesh>\n<vertices>\n{vertices}</vertices>\n'
        f"<triangles>\n{facets}</triangles>\n</mesh></object>\n</resources>\n"
        f'<build><item objectid="1"/></build>\n</model>\n'
    )
    parts = {"[Content_Types].xml": _3MF_TYPES, "_rels/.rels": _3MF_RELATIONS, "3D/3dmodel.model": model}
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, text in parts.items():
            # The earliest time that ZIP can store, so that files are reproducible.
            archive.writestr(zipfile.ZipInfo(member, (1980, 1, 1, 0, 0, 0)), text, zipfile.ZIP_DEFLATED)
    return data.getvalue()


# 3D Manufacturing Format, core specification 1.3.
_3MF_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_3MF_TYPES = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)
_3MF_RELATIONS = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Id="rel0" Target="/3D/3dmodel.model" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
)
MESH_SUFFIXES = (".stl", ".3mf")


def check_mesh_reader(path: Path) -> None:
    """`InputError` if what reads a mesh file of this suffix is not installed."""
    if path.suffix.lower() == ".3mf":
        with needs_extra("mold"):
            import_module("lxml.etree")


def read_mesh(path: PathLike) -> Mesh:
    """Reads an STL or 3MF file, in mm, and merges equal vertices.

    Units that a 3MF declares are converted. Raises `InputError` if the file cannot be read, is too large, has another
    format, or holds no facet.
    """
    path = check_input(path)
    check_suffix(path, MESH_SUFFIXES)
    if path.stat().st_size > MAX_MESH_BYTES:
        raise InputError(f"{path}: must have at most {MAX_MESH_BYTES} bytes, got {path.stat().st_size}.")
    check_mesh_reader(path)
    with decoding(path, "STL or 3MF file"):
        scene = trimesh.load_scene(path, process=False)
        mesh = scene.to_mesh()
        if scene.units not in (None, "mm", "millimeter", "millimeters"):
            mesh.units = scene.units
            mesh.convert_units("millimeters")
        corners = np.asarray(mesh.triangles)
    if not len(corners) or not np.isfinite(corners).all():
        raise InputError(f"{path}: must hold facets with finite coordinates, got {len(corners)} facets.")
    return _merge_vertices(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


class Mask(NamedTuple):
    """Plan of an opaque mask between the lenses, mm. Rings are closed; holes run clockwise.

    `circles`, rows `(x, y, diameter)`, are openings of lenses that do not touch others; `openings` are the outlines of
    the others. `outline` is that of the sheet, and `marks` are the alignment crosses in the rim of the mold.
    """

    outline: Ring
    circles: Float[np.ndarray, "circle 3"]
    openings: list[Ring]
    marks: list[Ring]


def make_mask(array: MicrolensArray, shape: MoldShape = MoldShape()) -> Mask:
    """The mask of an array: openings are the clear apertures; sheet and marks are those of the mold.

    The plan uses the frame of the part with +y up: it shows the sheet as the mold from above, from the plano side.

    Raises `InputError` if the plate is infinite, or lenses cover all of it.
    """
    if array.size is None:
        raise InputError("`array.size_mm` must be finite, got an infinite plate.")
    part, side = Part(array), np.array(array.plate)
    centers, radii = part.centers, np.array([lenslet.semi_aperture for lenslet in part.lenslets])
    alone = np.all(np.abs(centers) + radii[:, None] <= side / 2, axis=1)
    pairs = KDTree(centers).query_pairs(2 * radii.max(), output_type="ndarray")
    touch = np.hypot(*(centers[pairs[:, 0]] - centers[pairs[:, 1]]).T) <= radii[pairs].sum(axis=1)
    alone[pairs[touch]] = False
    discs = [_disc(r).translate(at) for at, r in zip(centers[~alone].tolist(), radii[~alone].tolist(), strict=True)]
    plate = m3.CrossSection.square(side.tolist(), center=True)
    openings = m3.CrossSection.batch_boolean(discs, m3.OpType.Add) ^ plate
    if (plate - openings).area() < 1e-6 * plate.area():
        raise InputError("`lens.aperture_diameter_mm` must leave some of the plate uncovered; lenses cover it.")
    (left, bottom, _), (right, top, _) = mold_bounds(part, shape)
    outline = np.array([(left, bottom), (right, bottom), (right, top), (left, top)])
    marks = [ring for plan in alignment_marks(part, shape) for ring in plan.to_polygons()]
    return Mask(outline, np.column_stack([centers[alone], 2 * radii[alone]]), openings.to_polygons(), marks)


def _disc(radius: float) -> m3.CrossSection:
    segments = 4 * math.ceil(math.pi / 4 / math.acos(1 - min(_MASK_CHORD / radius, 1)))
    return m3.CrossSection.circle(radius, segments)


def write_mask(path: PathLike, mask: Mask, provenance: Provenance | None = None) -> None:
    """Writes a mask as DXF, SVG or, with `gdstk`, GDSII, by the suffix, atomically.

    Layers are OUTLINE, OPENINGS and MARKS (GDSII: 0, 1 and 2). DXF and SVG are in mm, GDSII in um.

    Raises `InputError` as `check_output`; for GDSII without `gdstk`.
    """
    path = check_output(path, MASK_SUFFIXES)
    layers = {"OUTLINE": [mask.outline], "OPENINGS": mask.openings, "MARKS": mask.marks}
    with atomic_write(path) as temporary:
        _MASK_WRITERS[path.suffix.lower()](temporary, layers, mask.circles)
    write_sidecar(path, provenance)


def _write_dxf(path: Path, layers: dict[str, list[Ring]], circles: np.ndarray) -> None:
    with needs_extra("mold"):
        from ezdxf.filemanagement import new
        from ezdxf.units import MM

    document = new("R2010", units=MM)
    space = document.modelspace()
    for color, (layer, rings) in enumerate(layers.items(), start=1):
        document.layers.add(layer, color=color)
        for ring in rings:
            space.add_lwpolyline(ring.tolist(), close=True, dxfattribs={"layer": layer})
    for x, y, diameter in circles.tolist():
        space.add_circle((x, y), diameter / 2, dxfattribs={"layer": "OPENINGS"})
    document.saveas(path)


def _write_svg(path: Path, layers: dict[str, list[Ring]], circles: np.ndarray) -> None:
    left, top = layers["OUTLINE"][0].min(0)
    width, height = np.ptp(layers["OUTLINE"][0], axis=0)
    root = ElementTree.Element(
        "svg",
        xmlns="http://www.w3.org/2000/svg",
        width=f"{width:.10g}mm",
        height=f"{height:.10g}mm",
        viewBox=f"{left:.10g} {top:.10g} {width:.10g} {height:.10g}",
    )
    upward = ElementTree.SubElement(root, "g", transform=f"matrix(1 0 0 -1 0 {2 * top + height:.10g})")
    for layer, rings in layers.items():
        group = ElementTree.SubElement(upward, "g", id=layer, fill="black" if layer == "OUTLINE" else "white")
        outlines = ["M" + "L".join(f"{x:.10g},{y:.10g}" for x, y in ring) + "Z" for ring in rings]
        if outlines:
            ElementTree.SubElement(group, "path", {"d": "".join(outlines), "fill-rule": "evenodd"})
        for x, y, diameter in circles.tolist() if layer == "OPENINGS" else ():
            ElementTree.SubElement(group, "circle", cx=f"{x:.10g}", cy=f"{y:.10g}", r=f"{diameter / 2:.10g}")
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _write_gds(path: Path, layers: dict[str, list[Ring]], circles: np.ndarray) -> None:
    with needs_extra("gds"):
        import gdstk
    library = gdstk.Library("gs_jax", unit=_GDS_UNIT, precision=_GDS_GRID)
    cell = library.new_cell("MASK")
    um = 1000
    for layer, rings in enumerate(layers.values()):
        # Polygons of GDSII have no holes: `boolean` cuts them.
        outer, holes = ([gdstk.Polygon((um * r).tolist()) for r in rings if _is_hole(r) == hole] for hole in (0, 1))
        cell.add(*gdstk.boolean(outer, holes, "not", precision=_GDS_GRID / _GDS_UNIT, layer=layer))
    for x, y, diameter in circles:
        cell.add(gdstk.ellipse((um * x, um * y), um * diameter / 2, layer=1, tolerance=um * _MASK_CHORD))
    library.write_gds(path)
    # gdstk does not report failed writes.
    if not path.read_bytes().endswith(_GDS_END):
        raise OSError("the file is incomplete: no end of the library")


def _is_hole(ring: Ring) -> bool:
    x, y = ring.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) < 0


_MASK_WRITERS = {".dxf": _write_dxf, ".svg": _write_svg, ".gds": _write_gds}
MASK_SUFFIXES = tuple(_MASK_WRITERS)
