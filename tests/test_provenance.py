"""Where files say that they come from, and what other programs read in them."""

import functools
import json

import numpy as np
import pytest
import tifffile
from click.testing import CliRunner

import gs_jax as gs
from gs_jax.__main__ import commands
from gs_jax.base.weights import load_weights, save_weights
from gs_jax.design.design import design_text
from gs_jax.io.provenance import DepthFrame, made_by, read_provenance, sidecar
from gs_jax.mold.export import Mesh, read_mesh, write_mesh
from gs_jax.widget.layers import reader

ORIGIN = {"software": "gs_jax 1", "command": "gs-jax 'a <b> & \"c\"'", "design": 'name = "µ"\n\n[sensor]\n'}
VOXELS = np.random.default_rng(0).random((3, 5, 4), np.float32)
GRID = gs.Grid([18.0, 18.5, 19.0], (5, 4), 0.04)
TETRAHEDRON = Mesh(
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)
WRITE = {
    "v.ome.tif": lambda path, **o: gs.write_volume(path, VOXELS, GRID, **o),
    "v.zarr": lambda path, **o: gs.write_volume(path, VOXELS, GRID, **o),
    "c.tif": lambda path, **o: gs.write_capture(path, VOXELS[0], **o),
    "c.npy": lambda path, **o: gs.write_capture(path, VOXELS[0], **o),
    "c.png": lambda path, **o: gs.write_capture(path, np.ones((5, 4), np.uint16), **o),
    "p.csv": lambda path, **o: gs.write_points(path, np.ones((2, 4)), **o),
    "w.npz": lambda path, **o: save_weights(path, np.ones(3), {"n": 1}, **o),
    "m.3mf": lambda path, **o: write_mesh(path, TETRAHEDRON, "a <part>", **o),
}


@pytest.mark.parametrize("name", WRITE)
def test_a_file_says_where_it_comes_from(tmp_path, name):
    path = tmp_path / name
    WRITE[name](path, provenance=ORIGIN)
    assert read_provenance(path) == ORIGIN
    shown = CliRunner().invoke(commands, ["info", str(path)])
    assert shown.exit_code == 0 and ORIGIN["command"] in shown.stdout
    # What the file holds can be read.
    read = {".npz": lambda path: load_weights(path, lambda n: np.zeros(3)), ".csv": gs.read_points, ".3mf": read_mesh}
    read.get(path.suffix, gs.read_volume if name.startswith("v") else gs.read_capture)(path)
    WRITE[name](path)
    assert read_provenance(path) == {}
    assert [each.name for each in tmp_path.iterdir()] == [name]


FOREIGN = {
    "stack.tif": (np.zeros((4, 6, 5), np.uint16), "minisblack", ["6 x 5", "uint16", "QYX, 4 x 6 x 5", "stack of PSFs"]),
    "colour.tif": (np.zeros((6, 5, 3), np.uint8), "rgb", ["YXS, 6 x 5 x 3", "or --channel red, green"]),
    "wide.tif": (np.zeros((6, 5)), "minisblack", ["float64", "pixels must be uint8, uint16, float32, got float64"]),
    "plain.npy": (np.zeros((6, 5), np.uint8), None, ["6 x 5", "uint8", "a capture, or a PSF for `gs-jax deconvolve`"]),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_info_says_what_an_image_of_another_program_is_good_for(tmp_path, name):
    pixels, photometric, expected = FOREIGN[name]
    save = functools.partial(tifffile.imwrite, photometric=photometric) if photometric else np.save
    save(tmp_path / name, pixels)
    shown = CliRunner().invoke(commands, ["info", str(tmp_path / name)])
    assert shown.exit_code == 0 and f"{tmp_path / name} has no provenance." in shown.stdout
    assert [words for words in expected if words not in shown.stdout] == []
    use = next(line for line in shown.stdout.splitlines() if line.startswith("use"))
    assert str(tmp_path) not in use


def test_info_shows_the_first_of_many_centres(tmp_path):
    design = gs.geomscope()
    WRITE["c.tif"](tmp_path / "c.tif", provenance=ORIGIN | {"design": design_text(design)})
    show = lambda *options: CliRunner().invoke(commands, ["info", str(tmp_path / "c.tif"), *options]).stdout
    short, whole = show(), show("--verbose")
    assert "# and 197 more" in short and short.count("\n") < 60 and "sensor_distance_mm = 5.8" in short
    assert design_text(design) in whole


def test_points_that_are_found_have_nine_digits():
    points, columns = DepthFrame().points(np.full((2, 4), 1 / 3), {"lenses": np.array([3, 4]), "snr": [1 / 7, 2 / 7]})
    written = points[0, 0], columns["snr"][0], columns["lenses"][0]
    assert list(map(str, written)) == ["0.33333334", "0.14285715", "3"]


def test_commands_sign_what_they_write(tmp_path):
    path = tmp_path / "centers.csv"
    arguments = ["layout", "--count", "9", "--size-mm", "4", "4", "--pitch-mm", "1.2", "-o", str(path)]
    assert CliRunner().invoke(commands, arguments).exit_code == 0
    origin = read_provenance(path)
    assert origin["command"] == f"gs-jax {' '.join(arguments)}" and origin["software"].startswith("gs_jax ")
    assert json.loads(sidecar(path).read_text()) == {"provenance": origin}
    (tmp_path / "a.bin").write_bytes(b"abc")
    inputs = made_by("gs-jax", [tmp_path / "a.bin", tmp_path])
    # The digest of FIPS 180-4's example.
    assert inputs["input a.bin"] == "sha256 ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert inputs[f"input {tmp_path.name}"] == "a folder"


def test_another_file_is_refused(tmp_path):
    with pytest.raises(gs.InputError, match="suffix must be .tif.*got '.txt'"):
        read_provenance(tmp_path / "a.txt")
    (tmp_path / "a.tif").write_bytes(b"no")
    with pytest.raises(gs.InputError, match="not a whole and valid .tif file"):
        read_provenance(tmp_path / "a.tif")


def test_imagej_reads_the_scale(tmp_path):
    """Its reader takes the last description, if that begins with its name, and pixels in one piece."""
    path = tmp_path / "v.ome.tif"
    gs.write_volume(path, VOXELS, GRID)
    with tifffile.TiffFile(path) as tiff:
        first = tiff.pages.first
        entries = [tag.code for tag in first.tags]
        said = dict(line.split("=") for line in first.description1.splitlines())
        assert entries == sorted(entries) and first.description.startswith("<?xml")
        assert tiff.is_ome and tiff.is_imagej
        offsets = [page.dataoffsets[0] for page in tiff.pages]
        assert set(np.diff(offsets)) == {VOXELS[0].nbytes}
        per_um = [first.tags[name].value for name in ("XResolution", "YResolution")]
        assert first.tags["ResolutionUnit"].value == 1 and all(n / d == pytest.approx(1 / 40) for n, d in per_um)
    assert list(said)[0] == "ImageJ" and (said["unit"], float(said["spacing"]), said["images"]) == ("um", 500, "3")
    # Where zero is, in voxels: the grid is centred.
    assert [float(said[f"{axis}origin"]) for axis in "xyz"] == [1.5, 2, -36]
    assert VOXELS.min() <= float(said["min"]) < float(said["max"]) <= VOXELS.max()


@pytest.mark.parametrize("voxels, shown", [(VOXELS, (0, 1)), (np.zeros((3, 5, 4)), (0, 1)), (VOXELS > 0.99, (0, 1))])
def test_viewers_are_told_what_to_show(tmp_path, voxels, shown):
    path = tmp_path / "v.zarr"
    gs.write_volume(path, voxels, GRID)
    (channel,) = json.loads((path / ".zattrs").read_text())["omero"]["channels"]
    start, end = channel["window"]["start"], channel["window"]["end"]
    assert channel["label"] == "v" and shown[0] <= start < end <= shown[1]


def test_napari_shows_volume_and_points_in_one_place(tmp_path):
    """Both in um; a point lies in the voxel of its place."""
    grid = gs.Grid([18.0, 18.5, 19.0], (5, 4), 0.04, (1.0, -2.0))
    place = grid.to_mm(np.array([[1, 3, 2]]))
    gs.write_points(tmp_path / "p.csv", np.column_stack([place, [1.0]]), {"lenses": np.array([7])})
    for name in ("v.ome.tif", "v.zarr"):
        gs.write_volume(tmp_path / name, VOXELS, grid)
        (voxels, image, kind), (points, marks, other) = (
            read(str(tmp_path / each))[0] for each in (name, "p.csv") if (read := reader(str(tmp_path / each)))
        )
        assert (kind, other) == ("image", "points") and image["units"] == marks["units"]
        place = points[0] * marks["scale"]
        np.testing.assert_allclose((place - image["translate"]) / image["scale"], [1, 3, 2], atol=1e-9)
        np.testing.assert_array_equal(voxels, VOXELS)
    (tmp_path / "other.csv").write_text("index,axis-0\n")
    assert reader(str(tmp_path / "other.csv")) is None and reader("a.png") is None and reader(["a.zarr"]) is None


def test_a_3mf_passes_the_strict_reader(tmp_path):
    lib3mf = pytest.importorskip("lib3mf")
    path, again = tmp_path / "a.3mf", tmp_path / "b.3mf"
    for each in (path, again):
        write_mesh(each, TETRAHEDRON, 'a "part" & more', ORIGIN)
    assert path.read_bytes() == again.read_bytes()
    model = lib3mf.get_wrapper().CreateModel()
    reader = model.QueryReader("3mf")
    reader.SetStrictModeActive(True)
    reader.ReadFromFile(str(path))
    assert reader.GetWarningCount() == 0
    meshes = model.GetMeshObjects()
    assert meshes.MoveNext()
    found = meshes.GetCurrentMeshObject()
    assert (found.GetTriangleCount(), found.IsManifoldAndOriented()) == (4, True)
    assert found.GetName() == 'a "part" & more'
