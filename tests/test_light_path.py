"""Layers, samples and materials in design files."""

import dataclasses
import json
from typing import Any, get_args

import jax
import numpy as np
import pytest

import gs_jax as gs
from gs_jax.base.errors import InputError
from gs_jax.calibration.calibrated_design import with_sample
from gs_jax.codesign.study import Study
from gs_jax.design.datasheets import datasheet
from gs_jax.design.design import Design, checked_design
from gs_jax.design.start import commented
from gs_jax.design.tables import Material
from gs_jax.io.provenance import DepthFrame, frame_of
from gs_jax.microscope.media import MATERIALS
from gs_jax.mold.manufacturability import check_design
from gs_jax.mold.solids import MoldShape
from gs_jax.widget.layers import reader

from .test_designs import edited

FILTER = {"name": "filter", "thickness_mm": 2.0, "refractive_index": 1.52}
SLIP = {"thickness_mm": 0.17, "refractive_index": 1.523}
STACK = {
    "imaging.working_distance_mm": [19.7, 30.0],
    "layers.object": [FILTER],
    "layers.sensor": [{"thickness_mm": 0.6}, {"thickness_mm": 0.55, "refractive_index": "BK7"}],
    "sample": {"refractive_index": "water", "surface_mm": 19.67, "layers": [{"thickness_mm": 1.0}, SLIP]},
    "samples": {"gel": {"refractive_index": 1.43, "layers": [SLIP]}},
}


def design_of(changes) -> Design:
    return checked_design("design.toml", edited(changes))


@pytest.mark.parametrize(
    ("material", "wavelength", "index"),
    [
        ("BK7", 587.56, 1.51680),
        ("BK7", 486.13, 1.52238),
        ("fused silica", 587.56, 1.45846),
        ("PMMA", 587.56, 1.4911),
        ("polystyrene", 587.6, 1.5917),
        ("water", 589.3, 1.3332),
        ("PDMS", 589.3, 1.4118),  # data sheet of Sylgard 184
        ("air", 520.0, 1.0),
    ],
)
def test_indices_of_materials_are_the_published_ones(material, wavelength, index):
    last_digit = {"BK7": 1e-5, "fused silica": 1e-5, "air": 0}.get(material, 6e-4)
    assert gs.refractive_index(material, wavelength) == pytest.approx(index, abs=last_digit)


def test_files_take_all_materials():
    assert get_args(Material) == tuple(MATERIALS)


@pytest.mark.parametrize(
    ("material", "wavelength", "words"),
    [("PMMA", 400.0, "436.8 to 1052 nm for the index of PMMA, got 400"), ("glass", 520.0, "fused silica, water, got")],
)
def test_indices_that_are_not_known(material, wavelength, words):
    with pytest.raises(InputError, match=words):
        gs.refractive_index(material, wavelength)


def test_the_imager_has_the_layers_of_the_file():
    design = design_of(STACK)
    water, scope = gs.refractive_index("water", 520.0), design.imager()
    by_hand = 19.67 - 2.0 * (1 - 1 / 1.52) - 0.17 * (1 - 1 / 1.523) + 1.33 / water + 1.0 / 1.43
    assert float(scope.reduced_depth(21.0)) == pytest.approx(by_hand)
    assert float(scope.reduced_sensor_distance) == pytest.approx(
        5.8 - 0.55 * (1 - 1 / gs.refractive_index("BK7", 520.0))
    )
    in_contact = 2.17 - 2.0 * (1 - 1 / 1.52) - 0.17 * (1 - 1 / 1.523) + (21 - 2.17) / 1.43 + 1.0 / 1.43
    assert float(design.imager("gel").reduced_depth(21.0)) == pytest.approx(in_contact)
    assert design.imager("air").sample is None
    red, thick = design.imager(wavelength_nm=650.0), design.imager(gs.Sample(1.5))
    assert red.sample is not None and thick.sample is not None
    assert float(red.wavelength) == pytest.approx(650e-6)
    assert float(red.sample.refractive_index) == pytest.approx(gs.refractive_index("water", 650.0))
    assert float(thick.sample.refractive_index) == 1.5


def test_an_imager_with_layers_makes_the_same_design(tmp_path):
    scope = dataclasses.replace(
        gs.geomscope().imager(),
        filters=gs.Layers([2.0, 0.5], [1.52, 1.0]),
        windows=gs.Layers([0.6, 0.55], [1.0, 1.51]),
        sample=gs.Sample(1.43, surface=19.0, layers=gs.Layers([0.17, 0.5], [1.523, 1.33])),
    )
    design = Design.from_imager(scope, name="stack", working_distance_mm=(19.5, 24.0))
    gs.write_design(tmp_path / "stack.toml", design)
    (tmp_path / "commented.toml").write_text(commented(design.replace(samples=design_of(STACK).samples)))
    assert gs.read_design(tmp_path / "stack.toml") == design
    assert gs.read_design(tmp_path / "commented.toml").samples == design_of(STACK).samples
    same = jax.tree.map(lambda a, b: np.array_equal(a, b), design.imager(), scope)
    assert all(jax.tree.leaves(same))
    assert "2 mm of n = 1.52" in str(design) and "n = 1.43, from z = 19 mm" in str(design)
    assert design.replace(sample={"refractive_index": 1.0}, layers={}).imager().filters is None


STUDY = Study.model_validate(
    {
        "depths_mm": (18.0, 22.0),
        "free": {"sensor_distance_mm": (4.0, 8.0)},
        "terms": ({"name": "focus_offset", "minimise": 1.0},),
        "stages": ({"solver": "lbfgsb", "steps": 1},),
    }
)


def test_a_design_with_samples_needs_a_default_or_a_choice(tmp_path):
    gel = STACK["samples"]["gel"]
    design = gs.geomscope().replace(samples={"gel": gel, "water": {"refractive_index": "water"}})
    for make in (design.imager, lambda: datasheet(design), lambda: gs.run_study(design, STUDY)):
        with pytest.raises(InputError, match="`sample` must be given .* has no default .sample., but .samples.: gel"):
            make()
    assert design.imager("none").sample is None and design.imager("gel").sample is not None
    # A table of air is a default, and stays one in a file. Molds ask for none.
    dry = design.replace(sample={"refractive_index": 1.0})
    gs.write_design(tmp_path / "dry.toml", dry)
    assert gs.read_design(tmp_path / "dry.toml") == dry and dry.imager().sample is None
    assert "samples by name: gel, water and no default" in str(design) and "no default" not in str(dry)
    shape = check_design(design, MoldShape(), chord=4e-4, resolution=0.025)
    assert all(result.level != "error" for result in shape)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"sample": "jelly"}, "`sample` must be one of [samples] in the design, gel, air, got 'jelly'"),
        ({"wavelength_nm": 0.52}, "`wavelength_nm` must be a number of nanometres from 10 to 100000, got 0.52"),
        (
            {"sample": gs.Sample(1.4, 1.0)},
            "`surface` must be 2 mm, as thick as the layers in front of the medium are, or more",
        ),
        ({"wavelength_nm": 2000.0}, "the wavelength must be 182 to 1129 nm for the index of water, got 2000"),
    ],
)
def test_imagers_that_cannot_be(how, words):
    with pytest.raises(InputError) as caught:
        design_of(STACK).imager(**how)
    assert words in str(caught.value)


# `--sample`, `--wavelength-nm` and `--depths-from`: a capture of a gel, and points in it from either origin.


SURFACE = 19.0
TRUTH = np.array([[0.2, -0.2, 20.5, 1.0], [-0.5, 0.4, 21.5, 1.0]])
GEL = {"refractive_index": 1.43, "surface_mm": SURFACE, "layers": [{"thickness_mm": 0.17, "refractive_index": 1.523}]}


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """A folder to work in, with a design that knows a gel, and points in it."""
    monkeypatch.chdir(tmp_path)
    layout = gs.random_layout(24, (6.0, 6.0), pitch=1.2, seed=1).round(3)
    filters = [{"thickness_mm": 2.0, "refractive_index": 1.52}]
    sizes = {"shape": (640, 640), "pixel_pitch_um": 9.0, "centers_mm": layout, "size_mm": (6.0, 6.0)}
    design = gs.geomscope().replace(**sizes, layers={"object": filters}, samples={"gel": GEL}, sensor_distance_mm=6.0)
    gs.write_design("lab.toml", design)
    gs.write_points("points.csv", TRUTH)
    gs.write_points("in-gel.csv", TRUTH - [0, 0, SURFACE, 0])
    return tmp_path


def found_by(run, *options, depths="20:22:0.5"):
    how = ("--depths", depths, "--voxel-um", 80, "--suppress", "points", "--points", "found.csv", "--force")
    status, _, err = run("reconstruct", "gel.tif", "lab.toml", *options, *how, "-o", "found.tif")
    assert status == 0, err
    points = gs.read_points("found.csv")
    return points[np.argsort(points[:, 2])]


@pytest.mark.integration
def test_points_in_a_gel(lab, run):
    assert run("simulate", "points.csv", "lab.toml", "--sample", "gel", "-o", "gel.tif")[0] == 0
    inside = ("--sample", "gel", "--depths-from", "sample")
    assert run("simulate", "in-gel.csv", "lab.toml", *inside, "-o", "same.npy")[0] == 0
    np.testing.assert_array_equal(gs.read_capture("same.npy"), gs.read_capture("gel.tif"))
    found = found_by(run, "--sample", "gel")
    np.testing.assert_allclose(found[:, :2], TRUTH[:, :2], atol=0.02)
    np.testing.assert_allclose(found[:, 2], TRUTH[:, 2], atol=0.1)
    assert frame_of("found.csv") == frame_of("found.tif") == "array"
    # In air the points seem nearer than they are.
    in_air = found_by(run, "--sample", "air", depths="19:22:0.5")
    assert (found[:, 2] - in_air[:, 2] > 0.4).all()
    # Files that count from the surface say so, and are read as those that do not.
    from_surface = found_by(run, *inside, depths="1:3:0.5")
    np.testing.assert_allclose(from_surface[:, 2], found[:, 2], atol=0.02)
    header, first = np.loadtxt("found.csv", str, delimiter=",", max_rows=2)
    row = dict(zip(header, map(float, first), strict=True))
    assert row["sample_surface_mm"] == SURFACE and 1 < row["z_mm"] < 3
    assert frame_of("found.csv") == frame_of("found.tif") == "sample"
    np.testing.assert_allclose(gs.read_volume("found.tif")[1].depths, [20, 20.5, 21, 21.5, 22])
    # Read again they are where they were, from whatever depths count.
    for options in (("--sample", "gel"), inside):
        status, _, err = run("simulate", "found.csv", "lab.toml", *options, "-o", "again.npy")
        assert status == 0, err
    read: Any = reader("found.tif")
    layers = read("found.tif")
    assert layers[0][1]["translate"][0] == pytest.approx(20_000)


def test_what_a_calibration_finds_of_a_sample_goes_where_it_is_from(lab):
    slip = GEL["layers"][0]
    stack = [{"name": "filter", "thickness_mm": 2.0, "refractive_index": "BK7"}, {"thickness_mm": 15.0}, slip]
    design = gs.read_design("lab.toml").replace(layers={"object": stack}, sample={"refractive_index": "water"})
    # The slip moves with the surface; it becomes the sample's.
    water = gs.refractive_index("water", 520.0)
    moved = gs.Sample(water, 17.5, gs.Layers([0.17], [1.523]))
    scope = dataclasses.replace(design.imager(), filters=gs.Layers([2.0], [1.52]), sample=moved)
    new = with_sample(design, scope, None)
    assert new.layers.object == design.layers.object[:1] and new.samples == design.samples
    assert new.sample is not None and new.sample.model_dump(exclude_defaults=True) == {
        "refractive_index": "water",
        "surface_mm": 17.5,
        "layers": (slip,),
    }
    scope = dataclasses.replace(design.imager("gel"), sample=gs.Sample(1.44, 19.5, moved.layers))
    new = with_sample(design, scope, "gel")
    gel = new.samples["gel"]
    assert (new.sample, gel.refractive_index, gel.surface_mm) == (design.sample, 1.44, 19.5)


SIMULATE, METRICS = "simulate points.csv lab.toml -o a.tif", "metrics lab.toml"
RECONSTRUCT = "reconstruct capture.npy lab.toml --depths 18:22:1 -o v.tif"
CALIBRATE = "calibrate lab.toml capture.npy --from-scene -o new.toml"
WRONG = [
    (f"{METRICS} --sample jelly", "`sample` must be one of [samples] in the design, gel, air, got 'jelly'"),
    (f"{METRICS} --sample-index 1.4", "--sample-index must be used with --sample-at"),
    (f"{METRICS} --sample-at 19", "--sample-at must be used with --sample-index"),
    (f"{METRICS} --sample gel --sample-index 1.4 --sample-at 19", "--sample must be used without"),
    (f"{METRICS} --wavelength-nm 0.52", "must be 10 to 100000 nm, got '0.52'"),
    (f"{METRICS} --sample gel --depths 18", "--depths must be 19 mm or more, where layers end"),
    (f"{METRICS} --sample-index 1.4 --sample-at 1", "`sample.surface_mm` must be 2 mm or more"),
    (f"{SIMULATE} --sample-index 1.4 --sample-at 1", "`surface` must be 2 mm, as"),
    (f"{SIMULATE} --sample none --depths-from sample", "--depths-from sample must be used with a sample, got air"),
    ("simulate in-gel.csv lab.toml --sample gel -o a.tif", "depths must be 19 mm or more"),
    (
        "simulate from-array.csv lab.toml --sample gel --depths-from sample -o a.tif",
        "--depths-from must be array, as SCENE says",
    ),
    (f"{RECONSTRUCT} --sample gel", "--depths must be 19 mm or more, where layers end"),
    (f"{RECONSTRUCT} --depths-from plate", "is not one of 'array', 'sample'"),
    ("tolerance lab.toml --sample gel --depths 18", "depths must be 19 mm or more"),
    ("report lab.toml --sample jelly -o a.html", "`sample` must be one of"),
    ("explore lab.toml --sample jelly", "`sample` must be one of"),
    # A sample is asked for where none is the default.
    *(
        (command, "`sample` must be given (--sample NAME, or sample in a study): the design has no default [sample]")
        for command in (METRICS, SIMULATE, RECONSTRUCT, "tolerance lab.toml", "report lab.toml -o a.html",
                        "explore lab.toml", CALIBRATE)
    ),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "words"), WRONG)
def test_what_does_not_go_together(lab, run, arguments, words):
    np.save("capture.npy", np.ones((640, 640), np.uint16))
    gs.write_points("from-array.csv", TRUTH, provenance={"depths_from": "array"})
    before = sorted(lab.iterdir())
    status, _, err = run(*arguments.split())
    assert status == 2 and words in err and err.count("\n") == 1 and sorted(lab.iterdir()) == before, err


RECONSTRUCTED = "reconstruct capture.npy lab.toml --depths 20 --voxel-um 200 -o v.tif"
REPORTED = pytest.param("report lab.toml -o a.html", marks=pytest.mark.integration)


@pytest.mark.parametrize("command", [METRICS, RECONSTRUCTED, REPORTED], ids=lambda command: command.split()[0])
@pytest.mark.parametrize("name", ["gel", pytest.param("none", marks=pytest.mark.integration)])
def test_commands_say_which_medium_they_take(lab, run, command, name):
    np.save("capture.npy", np.ones((640, 640), np.uint16))
    gel = "n = 1.43 from z = 19 mm, behind 2 mm of n = 1.52 and 0.17 mm of n = 1.523"
    medium = {"gel": gel, "none": "air, behind 2 mm of n = 1.52"}[name]
    status, out, err = run(*command.split(), "--sample", name)
    assert status == 0 and f"objects in {medium}" in out, err


@pytest.mark.parametrize("name", ["v.ome.tif", "v.zarr"])
def test_a_volume_from_the_surface_on_is_read_back(tmp_path, name):
    """Its first plane is the surface itself."""
    grid, frame = gs.Grid([SURFACE, SURFACE + 0.4, SURFACE + 0.8], (3, 4), 0.1), DepthFrame(SURFACE)
    gs.write_volume(tmp_path / name, np.ones(grid.volume_shape, np.float32), frame.grid(grid), frame.note)
    assert gs.read_volume(tmp_path / name)[1].depths.tolist() == pytest.approx([19.0, 19.4, 19.8])


def test_metrics_show_the_path_of_the_light(lab, run):
    status, out, err = run(*METRICS.split(), "--sample", "gel", "--json", "m.json")
    sheet = json.loads((lab / "m.json").read_text())
    assert status == 0 and "2 mm of layers before the array are 1.316 mm of air" in out, err
    assert (sheet["sample_index"], sheet["sample_surface_mm"], sheet["depth_mm"][0]) == (1.43, 19, 19)
    scope = gs.read_design("lab.toml").imager("gel")
    focus = 1 / (1 / scope.array.focal_length - 1 / scope.sensor_distance)
    air = focus - scope.array.reduced_thickness_front
    assert sheet["focus_shift_mm"] == pytest.approx(float(scope.depth_of(focus) - air), abs=1e-3)
