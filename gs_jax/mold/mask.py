"""The opaque mask between the lenses: what it covers, as a drawing to have it made.

In the part's frame (`solids`), mm: the design's, x and y as the sensor's, if the plano side faces the object. Drawings
have +y up, so they show the sheet as the mold from above, from the plano side: the object's, or, if the curved side
faces the object, the sensor's. Openings are the lenses' clear discs. The sheet is as large as the mold, and has its
marks.
"""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import manifold3d as m3
import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from ..base.errors import InputError
from ..io.files import atomic_write, check_output
from ..io.provenance import Provenance, write_sidecar
from ..lenses import MicrolensArray
from .caps import caps_of
from .solids import MoldShape, mark_plans, mold_block

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


def write_mask(path: str | os.PathLike[str], mask: Mask, provenance: Provenance | None = None) -> None:
    """Writes a mask as DXF, SVG or, where `gdstk` is installed, GDSII, by the suffix; whole or not at all.

    Layers are OUTLINE, OPENINGS and MARKS (GDSII: 0, 1 and 2). DXF and SVG are in mm, GDSII in um.

    Raises
    ------
    InputError
        As `check_output`; for GDSII without `gdstk`.
    """
    path = check_output(path, MASK_SUFFIXES)
    with atomic_write(path) as temporary:
        _WRITERS[path.suffix.lower()](temporary, mask)
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


_WRITERS: dict[str, Callable[[Path, Mask], None]] = {".dxf": _write_dxf, ".svg": _write_svg, ".gds": _write_gds}
MASK_SUFFIXES = tuple(_WRITERS)
