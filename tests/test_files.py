import itertools
import json
import os
import re
import shutil
import stat
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numcodecs
import numpy as np
import pytest
import tifffile
import zarr
from hypothesis import HealthCheck, given, settings, strategies as st
from PIL import Image

from gs_jax import Grid
from gs_jax.base.errors import InputError
from gs_jax.io import files
from gs_jax.io.captures import read_capture, write_capture
from gs_jax.io.files import atomic_write, check_output, write_json
from gs_jax.io.point_tables import POINTS_HEADER, read_points, read_positions, read_table, write_points
from gs_jax.io.volumes import read_volume, write_volume
from gs_jax.simulation import read_scene

from .helpers import examples

GREY = np.arange(30, dtype=np.uint16).reshape(5, 6) * 2000
GRID = Grid([18.0, 18.1, 18.2], (5, 6), 0.0123)
VOLUME = np.random.default_rng(0).normal(size=(3, 5, 6)).astype(np.float32)


def refusal(function, path, *arguments, words=()):
    """The one line of the InputError that the call raises; nothing appears in, or leaves, the folder."""
    before = sorted(os.listdir(path.parent)) if path.parent.is_dir() else None
    with pytest.raises(InputError) as caught:
        function(path, *arguments)
    message = str(caught.value)
    assert message.isprintable() and len(message) < 1000
    for word in (path.name, *words):
        assert word in message, f"{word!r} is not in {message!r}"
    assert before is None or sorted(os.listdir(path.parent)) == before
    return message


# Captures


@pytest.mark.parametrize("suffix", [".tif", ".tiff", ".TIF", ".png", ".npy"])
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray])
def test_capture_round_trip(tmp_path, suffix, dtype, kind):
    if (suffix, dtype) == (".png", "float32"):
        pytest.skip("PNG holds no float32: refused, tested below")
    image = (np.arange(30).reshape(5, 6) * 7.5).astype(dtype)
    path = tmp_path / f"a{suffix}"
    write_capture(path, kind(image))
    back = read_capture(path, (5, 6))
    assert back.dtype == image.dtype and back.flags.c_contiguous
    np.testing.assert_array_equal(back, image)
    assert os.listdir(tmp_path) == [path.name]


def png(rows, columns, bits=8, colour=0, body=b""):
    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", columns, rows, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(body)) + chunk(b"IEND", b"")


def tiff(path, pixels: Any = GREY, **options: Any):
    options = {"photometric": "minisblack"} | options
    tifffile.imwrite(path, pixels, **options)


def cut(path, end):
    path.write_bytes(path.read_bytes()[:end])


def retag(path, code, value):
    with tifffile.TiffFile(path, mode="r+") as file:
        file.pages.first.tags[code].overwrite(value)


def saved(pixels):
    return lambda path: np.save(path, pixels, allow_pickle=True)


def image(pixels, **options):
    return lambda path: Image.fromarray(pixels).save(path, **options)


RGB = np.zeros((5, 6, 3), np.uint8)
WRONG_CAPTURES = {
    "missing.tif": (None, ["No such file"]),
    "folder.tif": (Path.mkdir, ["a folder"]),
    "pipe.tif": (os.mkfifo, ["a device or a pipe"]),
    "suffix.jpg": (image(RGB[..., 0]), [".jpg", ".tif", ".png", ".npy"]),
    "suffix": (lambda path: path.write_bytes(b""), ["''", ".tif"]),
    "empty.tif": (lambda path: path.write_bytes(b""), ["TIFF"]),
    "empty.png": (lambda path: path.write_bytes(b""), ["PNG"]),
    "empty.npy": (lambda path: path.write_bytes(b""), [".npy"]),
    "text.tif": (lambda path: path.write_text("no image"), ["TIFF"]),
    "text.png": (lambda path: path.write_text("no image" * 9), ["PNG"]),
    "text.npy": (lambda path: path.write_text("no image"), [".npy"]),
    "other.png": (tiff, ["PNG"]),
    "other.npy": (lambda path: path.write_bytes(b"PK\3\4" + bytes(99)), [".npy"]),
    "cut.tif": (lambda path: (tiff(path), cut(path, -20)), ["TIFF"]),
    "cut_header.tif": (lambda path: (tiff(path), cut(path, 60)), ["TIFF"]),
    "cut_deflate.tif": (lambda path: (tiff(path, compression="zlib"), cut(path, -9)), ["TIFF"]),
    "empty_strip.tif": (lambda path: (tiff(path), retag(path, 279, 0)), ["TIFF", "not in the file"]),
    "rows.tif": (lambda path: (tiff(path), retag(path, 257, 2**20)), ["strips", "got 1"]),
    "short_strip.tif": (lambda path: (tiff(path), retag(path, 279, 40)), ["TIFF", "not in the file"]),
    "strips.tif": (lambda path: (tiff(path, rowsperstrip=2), retag(path, 257, 20)), ["the 10 strips", "got 3"]),
    "cut.png": (lambda path: (image(GREY)(path), cut(path, -30)), ["PNG"]),
    "cut.npy": (lambda path: (np.save(path, GREY), cut(path, -1)), [".npy"]),
    "samples.tif": (lambda path: tiff(path, RGB, planarconfig="contig"), ["3 samples", "greyscale"]),
    "palette.tif": (lambda path: Image.fromarray(RGB).convert("P").save(path), ["palette", "greyscale"]),
    "white.tif": (lambda path: tiff(path, photometric="miniswhite"), ["0 as white", "0 as black"]),
    "alpha.png": (image(np.zeros((5, 6, 2), np.uint8)), ["transparency", "greyscale"]),
    "palette.png": (lambda path: Image.fromarray(RGB).convert("P").save(path), ["palette", "greyscale"]),
    "bits.png": (lambda path: Image.fromarray(RGB[..., 0]).convert("1").save(path), ["1-bit", "uint8"]),
    "animated.png": (
        lambda path: Image.fromarray(RGB[..., 0]).save(
            path, save_all=True, append_images=[Image.fromarray(RGB[..., 0] + 9)]
        ),
        ["2 pages"],
    ),
    "line.npy": (saved(np.zeros(5, np.uint8)), ["2-D"]),
    "scalar.npy": (saved(np.array(5, np.uint8)), ["2-D"]),
    "none.npy": (saved(np.zeros((0, 5), np.uint8)), []),
    "float64.tif": (lambda path: tiff(path, GREY.astype(float)), ["float64", "uint16", "convert"]),
    "int16.tif": (lambda path: tiff(path, GREY.astype(np.int16)), ["int16", "uint16", "convert"]),
    "uint32.tif": (lambda path: tiff(path, GREY.astype(np.uint32)), ["uint32", "convert"]),
    "float16.npy": (saved(GREY.astype(np.float16)), ["float16", "convert"]),
    "complex.npy": (saved(GREY.astype(np.complex64)), ["complex64", "convert"]),
    "bool.npy": (saved(GREY > 9), ["bool", "convert"]),
    "record.npy": (saved(np.zeros((5, 6), [("a", "u1"), ("b", "u2")])), ["convert"]),
    "pickle.npy": (saved(np.full((5, 6), {}, object)), [".npy"]),
    "nan.tif": (lambda path: tiff(path, np.full((5, 6), np.nan, np.float32)), ["nan", "(0, 0)", "finite"]),
    "infinite.npy": (saved(np.where(GREY == 2000 * 8, -np.inf, 0).astype(np.float32)), ["-inf", "(1, 2)", "finite"]),
    "damaged.tif": (lambda path: (tiff(path, np.float32(GREY)), retag(path, 259, 8)), ["TIFF"]),
    "bomb.png": (lambda path: path.write_bytes(png(10**6, 10**6)), ["1000000 x 1000000", "at most"]),
    "pillow_bomb.png": (lambda path: path.write_bytes(png(20_000, 20_000)), ["PNG", "pixels"]),
    "bomb.tif": (lambda path: (tiff(path), retag(path, 256, 2**31), retag(path, 257, 2**31)), []),
    "short.png": (lambda path: path.write_bytes(png(5, 6, body=b"\0\1\2")), ["PNG"]),
}


@pytest.mark.parametrize("suffix", [".tif", ".png", ".npy"])
def test_wrong_size_is_refused_before_decoding(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_capture(path, GREY)
    refusal(read_capture, path, (6, 5), words=["5 x 6", "6 x 5", "sensor"])
    cut(path, -1 if suffix == ".npy" else -15)
    if suffix == ".png":  # the others see the cut before the size
        refusal(read_capture, path, (6, 5), words=["5 x 6", "6 x 5", "sensor"])


def test_wrong_images_are_not_written(tmp_path):
    floats = GREY.astype(np.float32)
    refusal(write_capture, tmp_path / "a.png", floats, words=["float32", "uint16", ".npy"])
    refusal(write_capture, tmp_path / "a.jpg", GREY, words=["'.jpg'", ".tif"])
    refusal(write_capture, tmp_path / "no" / "a.tif", GREY, words=["no folder"])
    (tmp_path / "a.tif").mkdir()
    refusal(write_capture, tmp_path / "a.tif", GREY, words=["folder"])
    with pytest.raises(ValueError, match="float64") as caught:
        write_capture(tmp_path / "a.npy", GREY.astype(float))
    assert not isinstance(caught.value, InputError)  # the program's fault, not the user's
    assert os.listdir(tmp_path) == ["a.tif"]


# Points


WRONG_POINTS = {
    "empty": (b"", ["header", "x_mm,y_mm,z_mm,intensity"]),
    "header": (b"x,y,z,i\n1,2,3,4\n", ["header", "x,y,z,i", "x_mm,y_mm,z_mm,intensity"]),
    "unit": (b"x_um,y_um,z_um,intensity\n1,2,3,4\n", ["header", "x_um"]),
    "three": (b"x_mm,y_mm,z_mm,intensity\n1,2,3\n", ["line 2", "got 3 values", "intensity"]),
    "word": (b"x_mm,y_mm,z_mm,intensity\n1,2,3,4\n1,2,x,4\n", ["line 3", "z_mm", "'x'"]),
    "nan": (b"x_mm,y_mm,z_mm,intensity\n1,2,3,nan\n", ["line 2", "intensity", "'nan'"]),
    "inf": (b"x_mm,y_mm,z_mm,intensity\n1,2,inf,1\n", ["line 2", "z_mm", "'inf'"]),
    "separators": (b"x_mm;y_mm;z_mm;intensity\n1,2,3,4\n", ["line 2", "4 values", "got 1 values"]),
    "blanks": (b"x_mm,y_mm,z_mm,intensity\n1,2,3,4\n  \n", ["line 3", "got 1 values"]),
    "comma": (b"x_mm,y_mm,z_mm,intensity\n1,5,2,5,18,0,1,0\n", ["line 2", "got 8 values"]),
    "behind": (b"x_mm,y_mm,z_mm,intensity\n1,2,20,1\n1,2,-20,1\n", ["point 2", "z_mm", "-20.0", "above 0"]),
    "dark": (b"x_mm,y_mm,z_mm,intensity\n1,2,20,-1\n", ["point 1", "intensity", "-1.0", "0 or more"]),
    "latin": (b"x_mm,y_mm,z_mm,intensity\n\xb5,2,3,4\n", ["UTF-8"]),
    "carriage": (b'x_mm,y_mm,z_mm,intensity\n"1\r\n\r\n2",2,3,4\n', ["line", "x_mm"]),
}


FLOATS = st.floats(-1e4, 1e4)
ROWS = st.lists(st.tuples(FLOATS, FLOATS, st.floats(1e-3, 1e4), st.floats(0, 1e300)), max_size=4)
FUZZ = settings(max_examples=examples(120), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@FUZZ
@given(rows=ROWS, dtype=st.sampled_from([np.float64, np.float32]))
def test_points_round_trip(tmp_path, rows, dtype):
    with np.errstate(over="ignore"):
        points = np.nan_to_num(np.array(rows, dtype).reshape(-1, 4))
    write_points(tmp_path / "a.csv", jnp.asarray(points) if dtype == np.float32 else points)
    back = read_points(tmp_path / "a.csv")
    assert back.dtype == np.float64
    np.testing.assert_array_equal(back.astype(dtype), points)


def test_points_file_is_the_contracts(tmp_path):
    write_points(tmp_path / "a.csv", np.array([[0.1, -2.0, 18.25, 1e-7]]))
    assert (tmp_path / "a.csv").read_bytes() == b"x_mm,y_mm,z_mm,intensity\n0.1,-2.0,18.25,1e-07\n"
    write_points(tmp_path / "a.csv", np.zeros((0, 4)))
    assert read_points(tmp_path / "a.csv").shape == (0, 4)
    (tmp_path / "a.csv").write_bytes(b'\xef\xbb\xbf"x_mm","y_mm",z_mm,intensity\r\n1, 2,3e0,4\r\n')
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv"), [[1, 2, 3, 4]])
    refusal(write_points, tmp_path / "a.txt", np.zeros((0, 4)), words=["'.txt'", ".csv"])


def read_or_refusal(path):
    try:
        names, numbers = read_table(path, "a,b", 3)
        return names, numbers.tolist()
    except InputError as error:
        return str(error)


CELLS = st.sampled_from('1|-2.5| 3|4\t|+1e-3|.5|5.|1e400|nan|1_0|x||"6"|1e|\x1c7|٣|1\r|#'.split("|"))
LINES = st.lists(st.one_of(st.tuples(CELLS, CELLS).map(",".join), CELLS), max_size=5)
HEADERS = st.sampled_from(["a,b\n", "a,b\r\n", "a,b", "a,b\r", "b,a\n", '"a",b\n', "\ufeffa,b\n", "\n"])


@FUZZ
@given(header=HEADERS, lines=LINES, end=st.sampled_from(["\n", "\r\n", "\n\n", "\r"]))
def test_plain_tables_are_read_as_all_others(tmp_path, header, lines, end):
    """What NumPy reads at once, and what is read line by line to say what is wrong: equal numbers, equal words."""
    path = tmp_path / "a.csv"
    path.write_text(header + end.join(lines), encoding="utf-8", newline="")
    found = read_or_refusal(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gs_jax.io.point_tables._plain_numbers", lambda *_: None)
        assert read_or_refusal(path) == found


@pytest.mark.parametrize("separator", [";", "\t"])
def test_points_of_european_spreadsheets(tmp_path, separator):
    """With decimal commas, further columns and quoted names; and as fast a table as any, with points."""
    path, header = tmp_path / "a.csv", POINTS_HEADER.replace(",", separator)
    path.write_bytes(f"\ufeff{header}\r\n0,5{separator}-0.25{separator} 18,75{separator}1e3\r\n".encode())
    np.testing.assert_array_equal(read_points(path), [[0.5, -0.25, 18.75, 1000]])
    path.write_text(f"{header}{separator}frame\n0,5{separator}1{separator}20{separator}1{separator}7\n")
    np.testing.assert_array_equal(read_points(path), [[0.5, 1, 20, 1]])
    path.write_text(f"{header}\n0,5{separator}1{separator}20\n")
    refusal(read_points, path, words=["line 2", "got 3 values"])
    path.write_text(f"{header}\n1,5,5{separator}1{separator}20{separator}1\n")
    refusal(read_points, path, words=["line 2, x_mm"])


def test_positions_of_european_spreadsheets(tmp_path):
    (tmp_path / "a.csv").write_text("capture;x_mm;z_mm\nb.tif;0,5;18\n1;;20,25\n")
    points, captures = read_positions(tmp_path / "a.csv", ["a.tif", "b.tif"])
    np.testing.assert_array_equal(points, [[0.5, np.nan, 18], [np.nan, np.nan, 20.25]])
    assert captures.tolist() == [1, 0]
    (tmp_path / "a.csv").write_text("x_cm;z_mm\n1;2\n")
    with pytest.raises(InputError, match="header must be .*x_mm,y_mm,z_mm, got 'x_cm,z_mm'"):
        read_positions(tmp_path / "a.csv", [])


def test_points_of_several_frames_are_no_scene(tmp_path):
    write_points(tmp_path / "a.csv", np.ones((2, 4)), {"frame": np.array([3, 3])})
    assert len(read_scene(tmp_path / "a.csv")[0]) == 2
    write_points(tmp_path / "a.csv", np.ones((2, 4)), {"frame": np.array([0, 3])})
    refusal(read_scene, tmp_path / "a.csv", words=["column frame must be of one frame", "got 2 frames"])
    assert len(read_points(tmp_path / "a.csv")) == 2


def test_a_million_points_with_all_their_digits(tmp_path):
    path = tmp_path / "a.csv"
    line = "-1.2345678901234567,-9.876543210987654,18.123456789012344,0.1234567890123456\n"
    path.write_text(POINTS_HEADER + "\n" + 1_000_000 * line)
    points = read_points(path)
    assert points.shape == (1_000_000, 4)
    np.testing.assert_array_equal(points[[0, -1]], 2 * [[float(cell) for cell in line.split(",")]])


# Volumes


def ome_attributes(path):
    with tifffile.TiffFile(path) as file:
        assert file.is_ome and file.series[0].kind == "ome" and file.series[0].axes == "ZYX"
        np.testing.assert_array_equal(file.asarray(), VOLUME)
        return tifffile.xml2dict(file.ome_metadata or "")["OME"]["Image"]["Pixels"]


def test_ome_tiff_metadata(tmp_path):
    write_volume(tmp_path / "a.ome.tif", VOLUME, GRID)
    pixels = ome_attributes(tmp_path / "a.ome.tif")
    assert pixels["Type"] == "float" and [pixels[f"Size{axis}"] for axis in "XYZCT"] == [6, 5, 3, 1, 1]
    assert [pixels[f"PhysicalSize{axis}"] for axis in "XYZ"] == pytest.approx([12.3, 12.3, 100.0], rel=1e-12)
    assert {pixels[f"PhysicalSize{axis}Unit"] for axis in "XYZ"} == {"µm"}
    assert [plane["TheZ"] for plane in pixels["Plane"]] == [0, 1, 2]
    assert [plane["PositionZ"] for plane in pixels["Plane"]] == [18000, 18100, 18200]
    for plane in pixels["Plane"]:  # the centre of the first voxel
        assert plane["PositionX"] == pytest.approx(float(GRID.x[0]) * 1000, rel=1e-12)
        assert plane["PositionY"] == pytest.approx(float(GRID.y[0]) * 1000, rel=1e-12)
        assert {plane[f"Position{axis}Unit"] for axis in "XYZ"} == {"µm"}
    # Order of elements in OME 2016-06; a plane has no step.
    write_volume(tmp_path / "a.tif", VOLUME[:1], Grid([20.0], (5, 6), 0.01))
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        xml = file.pages.first.description
    ((attributes, body),) = re.findall(r"<Pixels (.*?)>(.*)</Pixels>", xml)
    assert 'xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"' in xml and "PhysicalSizeZ" not in attributes
    assert re.findall(r"<(\w+)[ />]", body) == ["Channel", "LightPath", "TiffData", "Plane"]
    assert 'TheC="0" TheZ="0" TheT="0"' in body and 'PositionZ="20000.0"' in body


def test_ome_tiff_keeps_uneven_depths(tmp_path):
    for depths in ([18.0, 19.0, 22.0], [22.0, 19.0, 18.0], [20.0, 20.0, 20.0]):
        write_volume(tmp_path / "a.tif", VOLUME, Grid(depths, (5, 6), 0.0123))
        back, grid = read_volume(tmp_path / "a.tif")
        np.testing.assert_array_equal(grid.depths, depths)
        pixels = ome_attributes(tmp_path / "a.tif")
        assert pixels.get("PhysicalSizeZ") == (None if depths[0] == 20 else 2000)


def test_ome_zarr_metadata(tmp_path):
    write_volume(tmp_path / "a.ome.zarr", VOLUME, GRID)
    root = tmp_path / "a.ome.zarr"
    assert json.loads((root / ".zgroup").read_text()) == {"zarr_format": 2}
    array = json.loads((root / "0" / ".zarray").read_text())
    assert array["shape"] == [3, 5, 6] and array["chunks"] == [1, 5, 6] and array["dtype"] == "<f4"
    assert array["dimension_separator"] == "/" and array["compressor"]["id"] == "blosc"
    assert array["order"] == "C" and array["filters"] is None and array["fill_value"] == 0
    (multiscale,) = json.loads((root / ".zattrs").read_text())["multiscales"]
    assert multiscale["version"] == "0.4"
    assert multiscale["axes"] == [{"name": n, "type": "space", "unit": "micrometer"} for n in "zyx"]
    (dataset,) = multiscale["datasets"]
    scale, translation = dataset["coordinateTransformations"]
    assert dataset["path"] == "0" and scale == {"type": "scale", "scale": [100.0, 12.3, 12.3]}
    first = [18000, float(GRID.y[0]) * 1000, float(GRID.x[0]) * 1000]
    assert translation["type"] == "translation" and translation["translation"] == pytest.approx(first, rel=1e-12)
    chunk = numcodecs.Blosc().decode((root / "0" / "1" / "0" / "0").read_bytes())
    np.testing.assert_array_equal(np.frombuffer(chunk, "<f4").reshape(5, 6), VOLUME[1])


@FUZZ
@given(
    shape=st.tuples(st.integers(1, 4), st.integers(1, 9), st.integers(1, 9)),
    start=st.integers(1, 30_000),
    step=st.integers(1, 1000),
    pitch=st.floats(1e-3, 1.0),
    suffix=st.sampled_from([".tif", ".zarr"]),
    dtype=st.sampled_from([jnp.float32, jnp.float64]),
)
def test_volume_round_trip(tmp_path, shape, start, step, pitch, suffix, dtype):
    depths = jnp.asarray((start + step * np.arange(shape[0])) / 1000, dtype)
    grid = Grid(depths, shape[1:], pitch, (-3 * pitch, 0.7))
    volume = np.random.default_rng(step).normal(size=shape).astype(np.float32)
    write_volume(tmp_path / f"a{suffix}", volume, grid)
    back, found = read_volume(tmp_path / f"a{suffix}")
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, volume)
    assert found.shape == grid.shape
    np.testing.assert_allclose(found.origin, grid.origin, atol=1e-6)
    # 12 digits are written; a float32 depth is written as the decimal that it is the nearest of.
    assert found.pitch == pytest.approx(pitch, rel=1e-11)
    np.testing.assert_allclose(found.depths, depths.astype(float), rtol=1e-11 if dtype == jnp.float64 else 1e-6)


def test_a_volume_larger_than_a_chunk(tmp_path):
    volume = np.zeros((1, 3, 1500), np.float32)
    volume[0, 2, 1300] = 1e30  # neither clipped nor rescaled
    write_volume(tmp_path / "a.zarr", jnp.asarray(volume), Grid([20.0], (3, 1500), 0.004))
    np.testing.assert_array_equal(read_volume(tmp_path / "a.zarr")[0], volume)
    assert sorted(os.listdir(tmp_path / "a.zarr" / "0" / "0" / "0")) == ["1"]  # empty chunks take no room


@pytest.mark.parametrize("suffix", [".tif", ".zarr"])
def test_volumes_become_float32(tmp_path, suffix):
    for dtype in (bool, np.uint8, np.int16, np.float16, np.float64):
        write_volume(tmp_path / f"a{suffix}", VOLUME.astype(np.float16).astype(dtype), GRID)
        back, _ = read_volume(tmp_path / f"a{suffix}")
        np.testing.assert_array_equal(back, VOLUME.astype(np.float16).astype(dtype))
    write_volume(tmp_path / f"a{suffix}", VOLUME / np.float64(3), GRID)
    np.testing.assert_array_equal(read_volume(tmp_path / f"a{suffix}")[0], (VOLUME / np.float64(3)).astype(np.float32))
    path = tmp_path / f"b{suffix}"
    for wrong in (np.full((3, 5, 6), 2**24 + 1), np.full((3, 5, 6), 1e300)):
        refusal(write_volume, path, wrong, GRID, words=[str(wrong.dtype), "float32"])
    refusal(write_volume, path, VOLUME.astype(complex), GRID, words=["complex128"])


def test_faults_of_the_program_are_not_the_users(tmp_path):
    nan = np.where(VOLUME == VOLUME.max(), np.nan, VOLUME).astype(np.float32)
    for volume, words in ((VOLUME[:2], "grid's shape"), (nan, "finite")):
        with pytest.raises(ValueError, match=words) as caught:
            write_volume(tmp_path / "a.tif", volume, GRID)
        assert not isinstance(caught.value, InputError)
    assert os.listdir(tmp_path) == []


def test_zarr_refuses_what_it_cannot_express(tmp_path):
    for depths in ([18.0, 19.0, 22.0], [20.0, 19.0, 18.0], [20.0, 20.0, 20.0]):
        grid = Grid(depths, (5, 6), 0.0123)
        refusal(write_volume, tmp_path / "a.zarr", VOLUME, grid, words=["depths", "even steps", ".ome.tif"])
    grid = Grid(jnp.linspace(18, 19, 3, dtype=jnp.float32), (5, 6), 0.0123)  # even but for rounding
    write_volume(tmp_path / "a.zarr", VOLUME, grid)


def ome(path, change=str.encode, pixels: Any = VOLUME, **options):
    """A volume of ours with its OME-XML edited."""
    write_volume(path.with_suffix(".tif"), VOLUME, GRID)
    with tifffile.TiffFile(path) as file:
        xml = file.pages.first.description
    tifffile.imwrite(path, pixels, description=change(xml), metadata=None, photometric="minisblack", **options)


def two_sizes(path):
    write_volume(path, VOLUME, GRID)
    with tifffile.TiffFile(path) as file:
        xml = file.pages.first.description.encode()
    with tifffile.TiffWriter(path) as file:
        file.write(VOLUME[0], description=xml, metadata=None)
        file.write(VOLUME[1, :4], metadata=None)


def less(pattern, replacement=""):
    def change(xml):
        changed = re.sub(pattern, replacement, xml, count=1)
        assert changed != xml
        return changed.encode()

    return change


WRONG_TIFF_VOLUMES = {
    "missing": (None, ["No such file"]),
    "folder": (Path.mkdir, ["a folder"]),
    "text": (lambda path: path.write_text("no"), ["OME-TIFF"]),
    "plain": (lambda path: tiff(path, VOLUME), ["OME-TIFF"]),
    "xml": (lambda path: ome(path, less("</OME>", "OME>")), ["OME-TIFF"]),
    "images": (lambda path: ome(path, less("<Image.*</Image>")), ["0 images", "one"]),
    "sizes": (lambda path: ome(path, less('SizeZ="3"', 'SizeZ="4"')), ["OME sizes", "'4'"]),
    "channels": (lambda path: ome(path, less('SizeC="1"', 'SizeC="3"')), ["OME sizes"]),
    "no depth": (lambda path: ome(path, less("<Plane[^>]*>")), ["PositionZ", "plane 1", "a depth for each plane"]),
    "no position": (lambda path: ome(path, less(' PositionZ="[^"]*"')), ["`PositionZ`", "nothing", "µm"]),
    "no unit": (lambda path: ome(path, less(' PositionZUnit="[^"]*"')), ["`PositionZ`", "reference frame", "µm"]),
    "word": (lambda path: ome(path, less('PositionZ="[^"]*"', 'PositionZ="far"')), ["`PositionZ`", "far", "µm"]),
    "behind": (lambda path: ome(path, less('PositionZ="', 'PositionZ="-')), ["depth", "-18.0 mm", "from 1e-6"]),
    "nan": (lambda path: ome(path, less('PositionZ="[^"]*"', 'PositionZ="nan"')), ["depth", "nan", "from 1e-6"]),
    "no pitch": (lambda path: ome(path, less(' PhysicalSizeX="[^"]*"')), ["`PhysicalSizeX`", "nothing", "µm"]),
    "pitch 0": (lambda path: ome(path, less('SizeX="12.3"', 'SizeX="0"')), ["voxels", "squares", "mm"]),
    "oblong": (lambda path: ome(path, less('SizeX="12.3"', 'SizeX="13"')), ["voxels", "0.013", "squares"]),
    "unit": (lambda path: ome(path, less('SizeXUnit="[^"]*', 'SizeXUnit="pixel')), ["`PhysicalSizeX`", "pixel", "µm"]),
    "far": (lambda path: ome(path, less('PositionX="[^"]*"', 'PositionX="1e9"')), ["first voxel", "1e4 mm"]),
    "colour": (lambda path: ome(path, pixels=np.zeros((3, 5, 6, 3), np.uint8), planarconfig="contig"), ["voxels"]),
    "float64": (lambda path: ome(path, pixels=VOLUME.astype(float)), ["float64", "float32"]),
    "voxel nan": (lambda path: ome(path, pixels=np.full_like(VOLUME, np.nan)), ["NaN", "finite"]),
    "cut": (lambda path: (ome(path), cut(path, -100)), ["OME-TIFF"]),
    "two sizes": (two_sizes, ["2 sizes", "one"]),
}


def test_other_units_and_no_lateral_position(tmp_path):
    ome(tmp_path / "a.tif", less("<OME", '<!DOCTYPE a [<!ENTITY b "c">]><OME'))
    np.testing.assert_array_equal(read_volume(tmp_path / "a.tif")[0], VOLUME)

    def change(xml):
        xml = re.sub(' Position[XY](Unit)?="[^"]*"', "", xml)
        xml = xml.replace('PositionZ="18000.0" PositionZUnit="µm"', 'PositionZ="18.0" PositionZUnit="mm"')
        return xml.replace(' PhysicalSizeXUnit="µm"', "").encode()  # the schema's default

    ome(tmp_path / "a.tif", change)
    _, grid = read_volume(tmp_path / "a.tif")
    np.testing.assert_array_equal(grid.depths, [18.0, 18.1, 18.2])
    assert grid.pitch == 0.0123


def edit_json(name, edit):
    def make(path):
        write_volume(path, VOLUME, GRID)
        data = json.loads((path / name).read_text())
        edit(data)
        (path / name).write_text(json.dumps(data))

    return make


def attributes(edit):
    return edit_json(".zattrs", lambda data: edit(data["multiscales"][0]))


def transform(index, value):
    def edit(multiscale):
        multiscale["datasets"][0]["coordinateTransformations"][index] = value

    return attributes(edit)


def scrambled_chunk(path):
    write_volume(path, VOLUME, GRID)
    (path / "0" / "1" / "0" / "0").write_bytes(b"no zlib")


WRONG_ZARRS = {
    "missing": (None, ["no such folder"]),
    "file": (lambda path: path.write_text(""), ["a file", "a Zarr folder"]),
    "empty": (Path.mkdir, ["OME-Zarr"]),
    "array": (lambda path: zarr.create_array(str(path), data=VOLUME), ["OME-Zarr"]),
    "no attributes": (edit_json(".zattrs", dict.clear), ["multiscales", "NGFF 0.4"]),
    "number": (edit_json(".zattrs", lambda data: data.update(multiscales=3)), ["multiscales", "NGFF 0.4"]),
    "two": (edit_json(".zattrs", lambda data: data["multiscales"].append({})), ["multiscales", "NGFF 0.4"]),
    "axes": (attributes(lambda m: m["axes"].reverse()), ["axes z, y, x", "micrometer"]),
    "unit": (attributes(lambda m: m["axes"][0].update(unit="parsec")), ["parsec", "micrometer"]),
    "five axes": (attributes(lambda m: m["axes"].append({"name": "t", "unit": "micrometer"})), ["axes z, y, x"]),
    "above": (attributes(lambda m: m.update(coordinateTransformations=[])), ["one scale"]),
    "no scale": (transform(0, {"type": "identity"}), ["scale", "one scale"]),
    "short scale": (transform(0, {"type": "scale", "scale": [1]}), ["multiscales", "one scale"]),
    "word scale": (transform(0, {"type": "scale", "scale": ["1", 2, 3]}), ["multiscales", "one scale"]),
    "oblong": (transform(0, {"type": "scale", "scale": [100, 12.3, 13]}), ["voxels", "squares"]),
    "negative": (transform(0, {"type": "scale", "scale": [-10000, 12.3, 12.3]}), ["depth", "-2.0 mm"]),
    "huge": (transform(0, {"type": "scale", "scale": [10**400, 12.3, 12.3]}), ["multiscales"]),
    "far": (transform(1, {"type": "translation", "translation": [18000, 0, 1e9]}), ["first voxel", "1e4 mm"]),
    "path": (attributes(lambda m: m["datasets"][0].update(path="1")), ["OME-Zarr"]),
    "group": (attributes(lambda m: m["datasets"][0].update(path="")), []),
    "outside": (attributes(lambda m: m["datasets"][0].update(path="../../other")), []),
    "shape": (edit_json("0/.zarray", lambda data: data.update(shape=[3, 5])), ["OME-Zarr", "shape"]),
    "large": (edit_json("0/.zarray", lambda data: data.update(shape=[3, 10**6, 10**6])), ["at most"]),
    "dtype": (edit_json("0/.zarray", lambda data: data.update(dtype="<f8")), ["float64", "float32"]),
    "codec": (edit_json("0/.zarray", lambda data: data.update(compressor={"id": "no"})), ["OME-Zarr"]),
    "json": (lambda path: (write_volume(path, VOLUME, GRID), (path / ".zattrs").write_text("{")), ["OME-Zarr"]),
    "chunk": (scrambled_chunk, ["OME-Zarr"]),
}


def cases():
    for name, (make, words) in WRONG_CAPTURES.items():
        yield pytest.param(read_capture, name, make, words, id=name)
    for name, (content, words) in WRONG_POINTS.items():
        make = lambda path, content=content: path.write_bytes(content)
        yield pytest.param(read_points, "points.csv", make, words, id=f"points {name}")
    for suffix, table in ((".tif", WRONG_TIFF_VOLUMES), (".zarr", WRONG_ZARRS)):
        for name, (make, words) in table.items():
            yield pytest.param(read_volume, f"a{suffix}", make, words, id=f"{suffix} {name}")
    yield pytest.param(read_volume, "a.png", None, ["'.png'", ".tif", ".zarr"], id="suffix of a volume")


@pytest.mark.parametrize(("read", "name", "make", "words"), list(cases()))
def test_a_wrong_file_is_refused_in_one_line(tmp_path, read, name, make, words):
    if make is not None:
        make(tmp_path / name)
    refusal(read, tmp_path / name, words=words)


def test_ngff_05_is_read(tmp_path):
    write_volume(tmp_path / "a.zarr", VOLUME, GRID)
    old = zarr.open_group(tmp_path / "a.zarr", mode="r")
    new = zarr.create_group(
        tmp_path / "b.zarr", zarr_format=3, attributes={"ome": {**old.attrs.asdict(), "version": "0.5"}}
    )
    new.create_array("0", data=VOLUME)
    back, grid = read_volume(tmp_path / "b.zarr")
    np.testing.assert_array_equal(back, VOLUME)
    np.testing.assert_array_equal(grid.depths, GRID.depths)


# Writing whole or not at all


def test_check_output(tmp_path, monkeypatch):
    assert check_output(str(tmp_path / "a.TIF"), [".tif"]) == tmp_path / "a.TIF"
    assert os.listdir(tmp_path) == []
    refusal(check_output, tmp_path / "a", [".tif", ".png"], words=["''", ".tif, .png"])
    refusal(check_output, tmp_path / "no" / "a.tif", [".tif"], words=["no folder"])
    refusal(check_output, tmp_path / ("a" * 300 + ".tif"), [".tif"], words=["name too long"])
    (tmp_path / "file").write_text("")
    refusal(check_output, tmp_path / "file" / "a.tif", [".tif"], words=["no folder"])
    os.mkfifo(tmp_path / "a.tif")
    refusal(check_output, tmp_path / "a.tif", [".tif"], words=["another kind"])
    (tmp_path / "a.zarr").write_text("")
    refusal(check_output, tmp_path / "a.zarr", [".zarr"], words=["another kind"])

    def denied(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.TemporaryFile", denied)  # the tests may run as root, whom no mode stops
    refusal(check_output, tmp_path / "b.tif", [".tif"], words=["Permission denied"])


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("folder", [False, True])
def test_an_error_leaves_what_was_there(tmp_path, error, folder):
    path = tmp_path / ("a.zarr" if folder else "a.tif")
    for before in (False, True):
        if before:
            write_volume(path, VOLUME, GRID)
        with pytest.raises(error), atomic_write(path) as temporary:
            assert temporary.parent == tmp_path and temporary.suffix == path.suffix
            if folder:
                temporary.mkdir()
                (temporary / "part").write_text("half")
            else:
                temporary.write_text("half")
            raise error
        assert os.listdir(tmp_path) == [path.name] * before
        if before:
            np.testing.assert_array_equal(read_volume(path)[0], VOLUME)


@pytest.mark.parametrize("exchanged", [True, False])
def test_a_zarr_image_is_there_at_all_times(exchanged, tmp_path, monkeypatch):
    """While another replaces it. Only where the system cannot exchange folders it is renamed twice."""
    if exchanged and sys.platform not in ("linux", "darwin"):
        pytest.skip("this system does not exchange folders")
    if not exchanged:
        monkeypatch.setattr(files, "_exchange", lambda first, second: False)
    path, seen, rename = tmp_path / "v.zarr", [], os.rename

    def watched(source, target):
        rename(source, target)
        seen.append(path.exists())

    monkeypatch.setattr(os, "rename", watched)
    for number in range(3):
        with atomic_write(path) as temporary:
            temporary.mkdir()
            (temporary / ".zgroup").write_text(str(number))
        assert (path / ".zgroup").read_text() == str(number) and os.listdir(tmp_path) == ["v.zarr"]
    assert seen == ([] if exchanged else 2 * [False, True])


@pytest.mark.parametrize("taken", [True, False])
def test_a_failed_rename_loses_nothing(tmp_path, monkeypatch, taken):
    """Where the system cannot exchange folders: the old image comes back, or stays beside one that took its name."""
    path, rename, calls = tmp_path / "a.zarr", os.rename, itertools.count()
    write_volume(path, VOLUME, GRID)

    def second_fails(*names):
        if next(calls) == 1:
            raise OSError("the disk is gone")
        rename(*names)

    def other_takes_the_name(source, target):
        rename(source, target)
        if Path(source) == path:
            (path / "0").mkdir(parents=True)

    monkeypatch.setattr(os, "rename", other_takes_the_name if taken else second_fails)
    monkeypatch.setattr(files, "_exchange", lambda *_: False)
    with pytest.raises(OSError, match=r"a\.zarr" if taken else "the disk is gone"):
        write_volume(path, 2 * VOLUME, GRID)
    (old,) = (folder for folder in tmp_path.iterdir() if (folder / ".zattrs").exists())
    assert (old == path) != taken and path.exists()
    np.testing.assert_array_equal(zarr.open_array(old / "0", mode="r")[...], VOLUME)


def test_only_an_image_in_zarr_is_replaced(tmp_path):
    path = tmp_path / "a.zarr"
    write_volume(path, VOLUME, GRID)
    write_volume(path, 2 * VOLUME, GRID)
    np.testing.assert_array_equal(read_volume(path)[0], 2 * VOLUME)
    assert os.listdir(tmp_path) == ["a.zarr"]
    for name in ("notes.txt", "labels"):
        (path / name).mkdir()
        refusal(write_volume, path, VOLUME, GRID, words=["folder", "Zarr"])
        (path / name).rmdir()
    shutil.rmtree(path)
    path.mkdir()
    (path / "thesis.tex").write_text("years of work")
    refusal(write_volume, path, VOLUME, GRID, words=["folder", "Zarr"])
    assert (path / "thesis.tex").read_text() == "years of work"


def mode_of(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_mode_and_links(tmp_path):
    """A file that is replaced keeps its mode, a new one has what the umask leaves; so have Zarr folders."""
    (tmp_path / "real.json").write_text("old")
    (tmp_path / "link.json").symlink_to("real.json")
    write_volume(tmp_path / "a.zarr", VOLUME, GRID)
    (tmp_path / "real.json").chmod(0o604)
    (tmp_path / "a.zarr").chmod(0o710)
    old = os.umask(0o027)
    try:
        write_json(tmp_path / "link.json", {"a": 1})
        write_json(tmp_path / "new.json", {"a": 1})
        write_volume(tmp_path / "a.zarr", VOLUME, GRID)
    finally:
        os.umask(old)
    assert (tmp_path / "link.json").is_symlink() and json.loads((tmp_path / "real.json").read_text()) == {"a": 1}
    assert [mode_of(tmp_path / name) for name in ("real.json", "new.json", "a.zarr")] == [0o604, 0o640, 0o710]


@pytest.mark.parametrize("name", ["a.ome.tif", "a.zarr", "a.csv", "a.csv.json"])
def test_write_protection_is_respected(tmp_path, name):
    """By the mode, which the superuser could ignore; also of the provenance beside a file."""
    path, output = tmp_path / name, tmp_path / name.removesuffix(".json")
    if name == "a.zarr":
        write_volume(path, VOLUME, GRID)
    else:
        path.write_text("{}")
    path.chmod(mode := 0o555 if name == "a.zarr" else 0o444)
    write = (lambda path: write_points(path, np.ones((1, 4)))) if output.suffix == ".csv" else None
    refusal(write or (lambda path: write_volume(path, VOLUME, GRID)), output, words=["write-protected", "chmod u+w"])
    assert mode_of(path) == mode and path.is_dir() == (name == "a.zarr")


def test_json(tmp_path):
    data = {"far_mm": float("inf"), "x": np.float32(0.5), "a": np.array([1.0, np.nan]), "j": jnp.arange(2)}
    write_json(tmp_path / "a.json", data | {"t": (1, "µ")})
    plain = {"far_mm": None, "x": 0.5, "a": [1.0, None], "j": [0, 1], "t": [1, "µ"]}
    assert json.loads((tmp_path / "a.json").read_text("utf-8")) == plain
    refusal(write_json, tmp_path / "a.txt", {}, words=[".json"])
    with pytest.raises(TypeError):
        write_json(tmp_path / "a.json", {"a": object()})
    assert len(os.listdir(tmp_path)) == 1


def test_a_refusal_prints_nothing_else(tmp_path):
    """No log line of a decoder, no warning, reaches the terminal beside the one line."""
    assert str(InputError("a\nb\r\n\x1b[31mc\u2028d\x85e\n")) == "a b [31mc d e"
    tiff(tmp_path / "a.tif")
    cut(tmp_path / "a.tif", 100)
    code = f"""
from gs_jax.io.captures import read_capture
try:
    read_capture({str(tmp_path / "a.tif")!r})
except ValueError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.count("\n") == 1 and done.stderr == ""


# Any bytes: a valid object or an InputError


def parses_or_refuses(read, path):
    try:
        read(path)
    except InputError as error:
        assert str(error).isprintable() and path.name in str(error)


def mutate(data, valid):
    """One to four edits: a byte or a 2- or 4-byte number set, bytes cut out or put in, or the end cut off."""
    content = bytearray(valid)
    for _ in range(data.draw(st.integers(1, 4))):
        if not content:
            break
        at = data.draw(st.integers(0, min(len(content) - 1, 1500)))
        length = data.draw(st.sampled_from([0, 1, 2, 4]))
        content[at : at + length] = data.draw(st.binary(min_size=length, max_size=length or 3))
    end = data.draw(st.just(len(content)) | st.integers(0, len(content)))
    return bytes(content[:end])


def valid_files(folder):
    write_capture(folder / "a.tif", GREY)
    tiff(folder / "b.tif", GREY, compression="zlib", rowsperstrip=2)
    tiff(folder / "c.tif", np.float32(GREY), tile=(16, 16), bigtiff=True)
    image(GREY, compression="packbits")(folder / "e.tif")
    image(GREY, compression="tiff_lzw")(folder / "d.tif")
    write_capture(folder / "a.png", GREY)
    write_capture(folder / "a.npy", GREY.astype(np.float32))
    write_points(folder / "a.csv", np.array([[0.5, -1.0, 20.0, 3.0], [1.0, 2.0, 18.0, 0.0]]))
    write_volume(folder / "v.tiff", VOLUME, GRID)
    readers = {".csv": read_points, ".tiff": read_volume}
    return [(readers.get(path.suffix, read_capture), path.name, path.read_bytes()) for path in sorted(folder.iterdir())]


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    return valid_files(tmp_path_factory.mktemp("valid"))


@settings(parent=FUZZ, max_examples=examples(600))
@given(data=st.data())
def test_mutated_files(tmp_path, valid, data):
    read, name, content = data.draw(st.sampled_from(valid))
    (tmp_path / name).write_bytes(mutate(data, content))
    parses_or_refuses(read, tmp_path / name)


@FUZZ
@given(
    content=st.binary(max_size=300),
    magic=st.sampled_from([b"", b"II*\0\x08\0\0\0", b"\x93NUMPY\1\0", b"\x89PNG\r\n\x1a\n"]),
)
def test_random_bytes(tmp_path, content, magic):
    for read, name in itertools.product((read_capture, read_volume, read_points), ("a.tif", "a.png", "a.npy", "a.csv")):
        (tmp_path / name).write_bytes(magic + content)
        parses_or_refuses(read, tmp_path / name)


@FUZZ
@given(data=st.data())
def test_mutated_zarr(tmp_path, data):
    path = tmp_path / "a.zarr"
    if not path.exists():
        write_volume(path, VOLUME, GRID)
    part = path / data.draw(st.sampled_from([".zattrs", ".zgroup", "0/.zarray", "0/.zattrs", "0/1/0/0"]))
    content = part.read_bytes()
    try:
        part.write_bytes(mutate(data, content))
        parses_or_refuses(read_volume, path)
    finally:
        part.write_bytes(content)
