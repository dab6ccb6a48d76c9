"""Captures of other programs, channels of one file, and Zarr stores at addresses."""

import functools
import http.server
import os
import sys
import threading
from typing import Any

import numpy as np
import pytest
import tifffile
from click.testing import CliRunner

import gs_jax as gs
from gs_jax import InputError
from gs_jax.__main__ import commands
from gs_jax.io.camera import Correction, Readout, read_corrected
from gs_jax.io.captures import Selection, read_capture
from gs_jax.io.files import decoding
from gs_jax.io.ngff import ngff_attributes
from gs_jax.io.provenance import made_by, read_provenance
from gs_jax.io.recordings import capture_files, open_recording

from .test_matrix import cropped

RNG = np.random.default_rng(0)
# Two frames of two channels.
STACK = RNG.integers(0, 4000, (2, 2, 12, 14)).astype(np.uint16)
NAMES = ["GFP", "mCherry"]


def run(line: str):
    result = CliRunner().invoke(commands, line.split())
    if isinstance(result.exception, InputError):
        return str(result.exception)
    assert result.exit_code == 0, result.output
    return result.output


def write_tiff(path):
    tifffile.imwrite(path, STACK, metadata={"axes": "TCYX", "Channel": {"Name": NAMES}}, ome=True)


def write_czi(path):
    czi = pytest.importorskip("pylibCZIrw.czi", reason="writes CZI")
    with czi.create_czi(str(path)) as file:
        for t in range(2):
            for c in range(2):
                file.write(STACK[t, c][..., None], plane={"T": t, "C": c, "Z": 0})
        file.write_metadata("made up", channel_names=dict(enumerate(NAMES)))


def write_hdf5(path):
    h5py = pytest.importorskip("h5py", reason="pip install 'gs-jax[bioio]'")
    with h5py.File(path, "w") as file:
        file["table"] = np.arange(3.0)
        array = file.create_dataset("run/images", data=STACK)
        for dimension, name in zip(array.dims, "tcyx", strict=True):
            dimension.label = name


def write_zarr(path):
    zarr = pytest.importorskip("zarr", reason="pip install 'gs-jax[zarr]'")
    axes = [{"name": "t", "type": "time"}, {"name": "c", "type": "channel"}, {"name": "y"}, {"name": "x"}]
    image = {"axes": axes, "datasets": [{"path": "0"}]}
    labels = [{"label": name} for name in NAMES]
    attributes = {"ome": {"version": "0.5", "multiscales": [image], "omero": {"channels": labels}}}
    group = zarr.create_group(store=path, zarr_format=3, attributes=attributes)
    array = group.create_array("0", shape=STACK.shape, dtype="uint16", chunks=(1, 1, 12, 14))
    array[...] = STACK


WRITERS = {"a.ome.tif": write_tiff, "a.czi": write_czi, "a.h5": write_hdf5, "a.zarr": write_zarr}


@pytest.mark.parametrize("name", WRITERS)
def test_a_channel_of_a_recording_is_read_by_its_name_or_number(tmp_path, name):
    if name.endswith(".czi"):
        pytest.importorskip("bioio_czi", reason="pip install 'gs-jax[bioio]'")
    WRITERS[name](path := tmp_path / name)
    chosen = [("2", 1)] if name.endswith(".h5") else [("mcherry", 1), ("GFP", 0), ("2", 1)]
    for channel, number in chosen:
        with open_recording(path, channel=channel) as frames:
            assert frames is not None and len(frames.names) == 2
            for frame in range(2):
                (image,) = frames.images(frame, Selection(channel=channel))
                np.testing.assert_array_equal(image, STACK[frame, number])
    with pytest.raises(InputError, match=r"--channel must be .*, or a number from 1, got '(DAPI|none)'"):
        with open_recording(path, channel="DAPI") as frames:
            pass


def test_hdf5_says_what_is_wrong(tmp_path):
    h5py = pytest.importorskip("h5py", reason="pip install 'gs-jax[bioio]'")
    with h5py.File(tmp_path / "two.h5", "w") as file:
        file["a"], file["b"] = STACK[0, 0], STACK[0, 1]
    with pytest.raises(InputError, match=r"must hold one image, got 2 \(a, b\)"):
        read_capture(tmp_path / "two.h5")
    with h5py.File(tmp_path / "one.hdf5", "w") as file:
        file["a"] = STACK[0, 0]
    np.testing.assert_array_equal(read_capture(tmp_path / "one.hdf5", (12, 14)), STACK[0, 0])
    with pytest.raises(InputError, match="3 x 3"):
        read_capture(tmp_path / "one.hdf5", (3, 3))
    (tmp_path / "bad.h5").write_bytes(b"no")
    with pytest.raises(InputError, match="not a whole and valid HDF5 file"):
        read_capture(tmp_path / "bad.h5")


@pytest.mark.parametrize("name", ["a.nd2", "a.czi", "a.lif", "a.h5"])
def test_a_missing_reader_names_the_extra(tmp_path, name, monkeypatch):
    for package in ("bioio_nd2", "bioio_czi", "bioio_lif", "h5py"):
        monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / name).write_bytes(b"anything")
    with pytest.raises(InputError, match=r"pip install 'gs-jax\[bioio\]'"):
        read_capture(tmp_path / name)


CHANNELS = {"GFP": {"wavelength_nm": 510.0}, "mCherry": {"wavelength_nm": 610.0}}


def two_channels(folder):
    """A design with two channels, and a capture of a point in each."""
    design = cropped("geomscope").replace(channels=CHANNELS, refractive_index="PDMS")
    gs.write_design(folder / "my.toml", design)
    points = [np.array([[x, 0.2, 20.0, 1.0]]) for x in (-0.8, 0.6)]
    options: dict[str, Any] = {"optics": "near", "psf": "geometric"}
    images = [np.asarray(gs.simulate(point, design.imager(), **options), np.float32) for point in points]
    for name, image in zip(NAMES, images, strict=True):
        gs.write_capture(folder / f"{name}.tif", image)
    tifffile.imwrite(folder / "both.ome.tif", np.stack(images), metadata={"axes": "CYX", "Channel": {"Name": NAMES}})


@pytest.mark.parametrize("output", ["both.ome.tif", "both.zarr"])
def test_channels_become_one_image_each_at_its_wavelength(tmp_path, monkeypatch, output):
    monkeypatch.chdir(tmp_path)
    two_channels(tmp_path)
    os.mkdir("out")
    depths = "--depths 19:21:1 --voxel-um 100"
    text = run(f"reconstruct both.ome.tif my.toml --channel GFP,mCherry {depths} -o out/{output}")
    assert "GFP at 510 nm, mCherry at 610 nm" in text
    alone = []
    for name, wavelength in (("GFP", 510), ("mCherry", 610)):
        run(f"reconstruct {name}.tif my.toml --wavelength-nm {wavelength} {depths} -o out/{name}.ome.tif")
        alone.append(gs.read_volume(f"out/{name}.ome.tif")[0])
    if output.endswith(".zarr"):
        zarr = pytest.importorskip("zarr", reason="pip install 'gs-jax[zarr]'")
        group = zarr.open_group(f"out/{output}", mode="r")
        image, attributes = np.asarray(group["0"]), ngff_attributes(group)
        assert [axis["name"] for axis in attributes["multiscales"][0]["axes"]] == list("czyx")
        assert [channel["label"] for channel in attributes["omero"]["channels"]] == NAMES
        assert attributes["multiscales"][0]["datasets"][0]["coordinateTransformations"][0]["scale"][:2] == [1.0, 1000.0]
    else:
        with tifffile.TiffFile(f"out/{output}") as file:
            assert file.series[0].axes == "CZYX"
            image, text = file.asarray(), file.ome_metadata or ""
        assert 'EmissionWavelength="610.0"' in text and 'Name="mCherry"' in text
        assert text.count("PositionZ=") == 6
    np.testing.assert_allclose(image, np.stack(alone), rtol=1e-5, atol=1e-6 * image.max())
    assert read_provenance(f"out/{output}")["command"].startswith("gs-jax reconstruct")


@pytest.mark.parametrize(
    "options, message",
    [
        ("--channel GFP,DAPI", "`channels.DAPI` must be in the design"),
        ("--channel GFP,GFP", "--channel must be different names"),
        ("--channel GFP,mCherry --points p.csv", "--points must be used with one --channel"),
        ("--channel DAPI", "--channel must be GFP, mCherry, or a number from 1, got 'DAPI'"),
    ],
)
def test_channels_that_are_not_there_are_named(tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    two_channels(tmp_path)
    assert message in run(f"reconstruct both.ome.tif my.toml {options} --depths 19:21:1 -o v.ome.tif")
    assert not (tmp_path / "v.ome.tif").exists()


@pytest.mark.parametrize(
    "channel, said",
    [
        ("gfp", "--channel gfp: GFP at 510 nm"),
        ("1", "--channel 1 is none of [channels] in the design, GFP, mCherry: 520 nm is used"),
    ],
)
def test_the_wavelength_of_a_channel_is_said(tmp_path, monkeypatch, channel, said):
    monkeypatch.chdir(tmp_path)
    two_channels(tmp_path)
    line = f"reconstruct both.ome.tif my.toml --channel {channel} --depths 19:21:1 --voxel-um 100 -o v.ome.tif"
    assert said in run(line)


def test_channels_of_a_zarr_store_become_one_image(tmp_path, monkeypatch):
    zarr = pytest.importorskip("zarr", reason="pip install 'gs-jax[zarr]'")
    monkeypatch.chdir(tmp_path)
    two_channels(tmp_path)
    with tifffile.TiffFile("both.ome.tif") as file:
        pixels = file.asarray()
    axes, labels = [{"name": name} for name in "cyx"], [{"label": name} for name in NAMES]
    image = {"axes": axes, "datasets": [{"path": "0"}]}
    ome = {"version": "0.5", "multiscales": [image], "omero": {"channels": labels}}
    zarr.create_group("both.zarr", attributes={"ome": ome}).create_array("0", data=pixels)
    line = "reconstruct both.{} my.toml --channel {} --depths 19:21:1 --voxel-um 100 -o {}.ome.tif"
    run(line.format("ome.tif", "GFP,mCherry", "a"))
    run(line.format("zarr", "gfp,MCHERRY", "b"))
    np.testing.assert_array_equal(tifffile.imread("a.ome.tif"), tifffile.imread("b.ome.tif"))


@pytest.mark.parametrize("names", [NAMES, ["red", "blue"]])
def test_grey_files_correct_a_channel(tmp_path, names):
    tifffile.imwrite(tmp_path / "a.ome.tif", STACK[0], metadata={"axes": "CYX", "Channel": {"Name": names}}, ome=True)
    mask, dark = np.zeros((12, 14), np.uint8), np.full((12, 14), 7, np.uint16)
    mask[3, 4] = 255
    tifffile.imwrite(tmp_path / "mask.tif", mask)
    tifffile.imwrite(tmp_path / "dark.tif", dark)
    correction = Correction(tmp_path / "dark.tif", bad_pixels=tmp_path / "mask.tif")
    found = read_corrected(tmp_path / "a.ome.tif", readout=Readout(channel=names[1]), correction=correction)
    expected = STACK[0, 1] - 7.0
    expected[3, 4] = found.image[3, 4]
    np.testing.assert_array_equal(found.image, expected)
    assert found.done[0] == f"channel {names[1]}"
    assert found.done[-1] == "1 bad pixel filled from neighbours: 1 in mask.tif"
    # A colour of a colour image is not corrected by a grey one.
    tifffile.imwrite(tmp_path / "rgb.tif", np.zeros((12, 14, 3), np.uint16), photometric="rgb")
    with pytest.raises(InputError, match=r"colour for --channel red.*mask.tif"):
        read_corrected(
            tmp_path / "rgb.tif",
            readout=Readout(channel="red"),
            correction=Correction(bad_pixels=tmp_path / "mask.tif"),
        )


def test_hdf5_beside_captures_is_no_frame(tmp_path):
    for name in ("traces.h5", "a.HDF5"):
        (tmp_path / name).write_bytes(b"")
    assert len(capture_files(tmp_path) or []) == 2
    gs.write_capture(tmp_path / "a.tif", STACK[0, 0])
    assert capture_files(tmp_path) == capture_files(tmp_path / "*") == [tmp_path / "a.tif"]


def test_a_missing_package_is_not_a_damaged_store(monkeypatch):
    pytest.importorskip("zarr", reason="pip install 'gs-jax[zarr]'")
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    for read in (gs.read_volume, lambda path: open_recording(path).__enter__()):
        with pytest.raises(InputError, match=r"^(fsspec|aiohttp) is not installed; .*'gs-jax\[zarr\]'"):
            read("https://host.invalid/a.zarr")
    with pytest.raises(InputError, match="^https://host.invalid/a.zarr: cannot be read: no route"):
        with decoding("https://host.invalid/a.zarr", "Zarr store"):
            raise OSError("no route")


def test_provenance_leaves_out_the_queries_of_addresses():
    url = "https://host/lab/a.zarr?key=K&signature=S"
    table = made_by(f"gs-jax reconstruct '{url}' my.toml -o v.zarr", [url])
    assert table["command"] == "gs-jax reconstruct 'https://host/lab/a.zarr' my.toml -o v.zarr"
    assert table["input a.zarr"] == "https://host/lab/a.zarr" and "signature" not in str(table)


def serve(folder):
    """A server of a folder on the loopback interface."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format, *args) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server


@pytest.mark.filterwarnings("default")
def test_zarr_is_read_at_an_https_address(tmp_path):
    pytest.importorskip("aiohttp", reason="pip install 'gs-jax[zarr]'")
    write_zarr(tmp_path / "a.zarr")
    volume = RNG.random((3, 8, 9)).astype(np.float32)
    gs.write_volume(tmp_path / "v.zarr", volume, gs.Grid([18.0, 19.0, 20.0], (8, 9), 0.1))
    server = serve(tmp_path)
    try:
        root = f"http://127.0.0.1:{server.server_address[1]}"
        with open_recording(f"{root}/a.zarr", channel="GFP") as frames:
            assert frames is not None and len(frames.names) == 2
            (image,) = frames.images(1, Selection(channel="GFP"))
        np.testing.assert_array_equal(image, STACK[1, 0])
        read, grid = gs.read_volume(f"{root}/v.zarr")
        np.testing.assert_array_equal(read, volume)
        assert np.asarray(grid.depths).tolist() == [18.0, 19.0, 20.0]
        with pytest.raises(InputError, match=f"{root}/none.zarr: cannot be read: "):
            with open_recording(f"{root}/none.zarr"):
                pass
        (tmp_path / "a.zarr/0/c/1/0/0/0").unlink()
        with open_recording(f"{root}/a.zarr", channel="GFP") as frames:
            assert frames is not None
            with pytest.raises(InputError, match="incomplete: there is no chunk c/1/0/0/0"):
                list(frames.images(1, Selection(channel="GFP")))
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.filterwarnings("default")
def test_zarr_is_read_at_an_s3_address(tmp_path, monkeypatch):
    s3fs = pytest.importorskip("s3fs", reason="pip install 'gs-jax[zarr]'")
    moto = pytest.importorskip("moto.server", reason="pip install 'moto[server]'")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    server.start()
    try:
        host, port = server.get_host_and_port()
        keys = {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b", "AWS_DEFAULT_REGION": "us-east-1"}
        for name, value in (keys | {"AWS_ENDPOINT_URL": f"http://{host}:{port}"}).items():
            monkeypatch.setenv(name, value)
        write_zarr(tmp_path / "a.zarr")
        files = s3fs.S3FileSystem()
        files.mkdir("lab")
        files.put(str(tmp_path / "a.zarr"), "lab/a.zarr", recursive=True)
        with open_recording("s3://lab/a.zarr", channel="mCherry") as frames:
            assert frames is not None
            (image,) = frames.images(0, Selection(channel="mCherry"))
        np.testing.assert_array_equal(image, STACK[0, 1])
    finally:
        server.stop()
