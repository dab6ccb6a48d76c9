"""The opaque mask between lenses, as other programs read it."""

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner
from ezdxf.filemanagement import readfile

from gs_jax import InputError, MicrolensArray
from gs_jax.__main__ import commands
from gs_jax.io.provenance import read_provenance
from gs_jax.mold.export import make_mask, write_mask
from gs_jax.mold.lenslets import Part
from gs_jax.mold.solids import MoldShape, alignment_marks, mold_bounds

DESIGNS = Path(__file__).parents[1] / "design"
# One alone, two that overlap, one across the edge of the plate; of three sizes.
ARRAY = MicrolensArray(
    [[-2.0, 1.0], [1.0, 0.0], [1.6, 0.0], [0.0, -3.0]], 2.0, 1.43, [0.8, 1.4, 1, 1], 1.0, size=(6.0, 6.0)
)
# Of two discs of radii 0.7 and 0.5, 0.6 apart: both less the lens that they share, of two segments on a chord.
CHORD_AT = (0.6**2 + 0.7**2 - 0.5**2) / (2 * 0.6)
SEGMENTS = [r**2 * math.acos(h / r) - h * math.sqrt(r**2 - h**2) for r, h in ((0.7, CHORD_AT), (0.5, 0.6 - CHORD_AT))]
PAIR = math.pi * (0.7**2 + 0.5**2) - sum(SEGMENTS)


def area(ring) -> float:
    x, y = np.asarray(ring).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def test_openings_are_the_lenses_on_the_plate():
    mask = make_mask(ARRAY)
    np.testing.assert_allclose(mask.circles, [[-2, 1, 0.8]])
    assert sum(map(area, mask.openings)) == pytest.approx(PAIR + math.pi / 8, rel=1e-3)
    assert max(np.abs(ring).max() for ring in mask.openings) <= 3
    low, high = mold_bounds(Part(ARRAY), MoldShape())
    np.testing.assert_allclose([mask.outline.min(0), mask.outline.max(0)], [low[:2], high[:2]])
    assert sum(map(area, mask.marks)) == pytest.approx(
        sum(plan.area() for plan in alignment_marks(Part(ARRAY), MoldShape()))
    )
    assert len(mask.marks) == 3


def test_dxf(tmp_path):
    write_mask(tmp_path / "a.dxf", make_mask(ARRAY))
    document = readfile(tmp_path / "a.dxf")
    assert document.units == 4 and not document.audit().errors  # mm
    found = {layer: [e for e in document.modelspace() if e.dxf.layer == layer] for layer in ("OPENINGS", "MARKS")}
    (circle,) = (e for e in found["OPENINGS"] if e.dxftype() == "CIRCLE")
    assert tuple(circle.dxf.center)[:2] == (-2, 1) and circle.dxf.radius == 0.4
    assert len(found["MARKS"]) == 3 and len(found["OPENINGS"]) == 3


def test_svg(tmp_path):
    write_mask(tmp_path / "a.svg", make_mask(ARRAY))
    root = ElementTree.parse(tmp_path / "a.svg").getroot()
    assert root.get("width") == f"{np.ptp(make_mask(ARRAY).outline[:, 0]):.10g}mm"
    (circle,) = root.iterfind(".//{*}circle")
    # The y axis of SVG points down, that of the drawing up.
    assert (circle.get("cx"), circle.get("cy"), circle.get("r")) == ("-2", "1", "0.4")
    (group,) = root
    assert group.get("transform") == "matrix(1 0 0 -1 0 0)"


def test_gds_has_polygons_without_holes(tmp_path):
    gdstk = pytest.importorskip("gdstk")
    ring = [(math.cos(a), math.sin(a)) for a in np.arange(6) * math.pi / 3]
    mask = make_mask(MicrolensArray(np.array(ring), 2.0, 1.43, 1.4, 1.0, size=(6.0, 6.0)))
    assert sorted(area(ring) > 0 for ring in mask.openings) == [False, True]
    write_mask(tmp_path / "a.gds", mask)
    library = gdstk.read_gds(tmp_path / "a.gds")
    (cell,) = library.cells
    found = sum(polygon.area() for polygon in cell.polygons if polygon.layer == 1)
    assert library.unit == 1e-6 and found == pytest.approx(1e6 * sum(map(area, mask.openings)), rel=1e-4)


def test_nothing_to_mask_is_said(tmp_path):
    covered = MicrolensArray([[0.0, 0.0], [0.5, 0.0]], 3.0, 1.43, 3.0, 1.0, size=(1.0, 1.0))
    with pytest.raises(InputError, match="lenses cover it"):
        make_mask(covered)
    result = CliRunner().invoke(commands, ["mask", str(DESIGNS / "geomscope.toml"), "-o", str(tmp_path / "a.svg")])
    assert isinstance(result.exception, InputError) and "geomscope.toml" in str(result.exception)
    assert not list(tmp_path.iterdir())


def test_the_command_draws_and_signs(tmp_path):
    path = tmp_path / "a.dxf"
    result = CliRunner().invoke(commands, ["mask", str(DESIGNS / "geomscope-optimized.toml"), "-o", str(path)])
    assert result.exit_code == 0 and "195 round openings and 5 others" in result.stdout
    assert read_provenance(path)["command"].startswith("gs-jax mask ")
