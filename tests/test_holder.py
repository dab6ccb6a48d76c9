"""The rig of a design: a holder that keeps the array at its distance, and a target whose pinholes calibrate it."""

import dataclasses
import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

import gs_jax as gs
from gs_jax import InputError
from gs_jax.__main__ import commands
from gs_jax.calibration.fit import calibrate
from gs_jax.io.point_tables import read_positions
from gs_jax.io.provenance import read_provenance
from gs_jax.mold.export import float32_mesh, read_mesh
from gs_jax.mold.holder import LEAST_SHIMS, SHIMS, Holder, HolderShape, make_rig, shims_of
from gs_jax.mold.lenslets import Part
from gs_jax.mold.manufacturability import check_solid
from gs_jax.mold.solids import array_solid

from .test_matrix import cropped

BOLTED = HolderShape(flange=11.5, bore=30.0, bolts=44.0)
SHAPES = {"c-mount": HolderShape(), "bolted": BOLTED, "before the camera": HolderShape(flange=1.5, bore=20.0)}
FACINGS = {"plano": {}, "curved": {"orientation": "curved", "aperture_diameter_mm": 1.2}}


def device(**lens):
    return cropped("geomscope", lens=lens)


@pytest.mark.parametrize("facing", FACINGS)
@pytest.mark.parametrize("name", SHAPES)
def test_parts_are_solids_of_their_volumes_and_the_array_lies_on_the_ledge(name, facing):
    design, shape = device(**FACINGS[facing]), SHAPES[name]
    rig, holder = make_rig(design, shape), Holder(design, shape)
    holes = 5 if shape.bolts else 1
    parts = {"holder": (rig.holder, rig.holder_volume, holes), "target": (rig.target, rig.target_volume, 5)}
    for part, (solid, volume, handles) in parts.items():
        checks = check_solid(float32_mesh(solid), volume, part, handles=handles)
        assert all(check.level == "ok" for check in checks), checks
    # In the frame of the part lenses look toward -z, and the plano face is at 0.
    array = array_solid(Part(design.imager().array), 2e-3)
    array = (array if facing == "plano" else array.rotate([180, 0, 0])).translate([0, 0, holder.seat])
    assert (array ^ rig.holder).volume() < 1e-6
    moved = array.translate([0, 0, 0.05 * holder.side])
    assert (moved ^ rig.holder).volume() > 0.5
    # With the shims the plano face is at the design's distance from the sensor.
    imaging, thickness = design.imaging, design.array.substrate_thickness_mm
    away = holder.seat + holder.shims + shape.flange
    assert away == pytest.approx(imaging.sensor_distance_mm + (thickness if facing == "plano" else 0))
    # The cap goes over the collar without touching it.
    assert (rig.target ^ rig.holder).volume() < 1e-6
    assert float(rig.target.bounding_box()[2]) == pytest.approx(2.0)


def test_shims_are_standard_ones_and_make_up_what_whole_layers_leave():
    for distance in np.linspace(5.7, 5.9, 23):
        holder = Holder(device().replace(sensor_distance_mm=float(distance)), HolderShape())
        assert holder.seat / 0.05 == pytest.approx(round(holder.seat / 0.05))
        assert LEAST_SHIMS - 1e-6 <= holder.shims < LEAST_SHIMS + 0.05
        shims = shims_of(holder.shims)
        assert set(shims) <= set(SHIMS) and abs(sum(shims) - holder.shims) <= SHIMS[-1] / 2 + 1e-9


def test_the_thread_is_that_of_a_c_mount():
    vertices = float32_mesh(make_rig(device()).holder).vertices
    away = np.hypot(vertices[:, 0], vertices[:, 1])
    thread = (vertices[:, 2] < -0.1) & (vertices[:, 2] > -3.9) & (away > 12.18)
    assert away[thread].max() == pytest.approx(12.6, abs=1e-3) and away[thread].min() > 12.19
    # Right-handed: the crest goes up by 25.4 / 32 mm in a turn from +x toward +y.
    x, y, z = vertices[thread & (away > 12.58)].T
    assert abs(np.exp(1j * (np.arctan2(y, x) - 2 * math.pi * z * 32 / 25.4)).mean()) > 0.95
    assert abs(np.exp(1j * (np.arctan2(y, x) + 2 * math.pi * z * 32 / 25.4)).mean()) < 0.5


@pytest.mark.parametrize("suffix", ["3mf", "stl"])
def test_the_command_writes_all_files(tmp_path, monkeypatch, suffix):
    monkeypatch.chdir(tmp_path)
    gs.write_design("my.toml", device())
    line = "holder my.toml --flange-mm 11.5 --bore-mm 30 --bolts-mm 44 -o"
    result = CliRunner().invoke(commands, [*line.split(), f"rig.{suffix}"])
    assert result.exit_code == 0, result.output
    assert "[ok] shims: 100 um" in result.output and "rig-target.csv: in mm" in result.output
    report = json.loads((tmp_path / f"rig.{suffix}.json").read_text())
    assert report["shims_mm"] == [0.1] and report["provenance"]["command"].startswith("gs-jax holder")
    points, captures = read_positions("rig-target.csv", ["target.tif"])
    assert (captures == 0).all() and (points[:, 2] == report["target_depth_mm"]).all() and (points[0, :2] == 0).all()
    # The pinholes of the mesh are where the table says, and as deep.
    mesh = read_mesh(f"rig-target.{suffix}")
    front = report["printed_step_mm"]
    rim = mesh.vertices[np.isclose(mesh.vertices[:, 2], front + points[0, 2], atol=1e-4)]
    for x, y, _ in points:
        assert np.hypot(rim[:, 0] - x, rim[:, 1] - y).min() == pytest.approx(0.05, abs=1e-4)
    for name in (f"rig.{suffix}", f"rig-target.{suffix}", "rig-target.csv"):
        assert read_provenance(name)["input my.toml"].startswith("sha256")
    assert (tmp_path / f"rig.{suffix}.png").stat().st_size > 10_000
    again = CliRunner().invoke(commands, [*line.split(), f"rig.{suffix}"])
    assert isinstance(again.exception, InputError) and "--force" in str(again.exception)


WINDOW = {"sensor": [{"thickness_mm": 4.2}, {"name": "window", "thickness_mm": 1.0, "refractive_index": 1.5}]}
FILTER = {"object": [{"name": "filter", "thickness_mm": 2.0, "refractive_index": 1.5}]}


@pytest.mark.parametrize(
    "changes, shape, message",
    [
        ({"size_mm": (20.0, 20.0)}, HolderShape(), "`array.size_mm` must be at most 20.3 mm across its corners"),
        ({"layers": WINDOW}, BOLTED, "mm more for the holder, which ends 0.1 mm from the camera's window"),
        ({"layers": FILTER}, BOLTED, "`layers.object` must begin with 1 mm of air or more"),
        ({}, dataclasses.replace(BOLTED, bolts=30.0), "--bolts-mm must be"),
        ({}, dataclasses.replace(BOLTED, target=3.0), "--target-mm must be"),
        # Here the front of the array is far above the collar, which the target must clear.
        ({}, HolderShape(flange=1.5, bore=20.0, target=0.5), "--target-mm must be 1 or more, beyond the holder"),
        ({}, HolderShape(clearance=0.4), "--clearance-mm must be below 0.4, the depth of the C-mount thread"),
        ({}, dataclasses.replace(BOLTED, pinhole=1.0), "--pinhole-um must be at most"),
        ({"working_distance_mm": (5.0, 30.0)}, HolderShape(), "must begin beyond the holder"),
        ({}, HolderShape(flange=40.0), "`imaging.working_distance_mm` must begin beyond the holder"),
    ],
)
def test_what_does_not_go_together_is_said(changes, shape, message):
    with pytest.raises(InputError, match=message):
        make_rig(device().replace(**changes), shape)


def test_screws_need_an_opening(tmp_path):
    gs.write_design(tmp_path / "my.toml", device())
    line = ["holder", str(tmp_path / "my.toml"), "--bolts-mm", "40", "-o", str(tmp_path / "rig.stl")]
    result = CliRunner().invoke(commands, line)
    assert isinstance(result.exception, InputError) and "--bore-mm" in str(result.exception)
    assert [path.name for path in tmp_path.iterdir()] == ["my.toml"]


def test_one_capture_of_the_target_calibrates():
    design = device()
    listed = design.imager()
    true = dataclasses.replace(listed, sensor_distance=5.87, rotation=0.3, shift=np.array([0.12, -0.2]))
    places = make_rig(design, HolderShape(target=20.5)).places
    image = gs.simulate(np.column_stack([places, np.ones(len(places))]), true, optics="near", psf="geometric")
    result = calibrate([np.asarray(image)], places, listed, captures=np.zeros(len(places), int))
    assert float(result.imager.sensor_distance) == pytest.approx(5.87, abs=3 * result.deviations["sensor_distance_mm"])
    assert float(result.imager.rotation) == pytest.approx(0.3, abs=1e-3) and result.rms < 0.2
