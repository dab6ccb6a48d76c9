"""What files declare of their images beside what is in them: axes, order, number, sister files, missing chunks."""

import json
import shutil
import struct
import sys
import warnings
import zlib
from typing import Any

import numpy as np
import pytest
import tifffile
import tifffile._imagecodecs
import zarr
from click.testing import CliRunner
from PIL import Image, UnidentifiedImageError

from gs_jax import read_capture, read_volume
from gs_jax.__main__ import commands
from gs_jax.base.errors import InputError, InputWarning
from gs_jax.design.design import read_design
from gs_jax.io.camera import Correction, read_corrected
from gs_jax.io.captures import Selection
from gs_jax.io.provenance import read_provenance
from gs_jax.io.recordings import open_recording, read_spots
from gs_jax.io.volumes import write_volume

from .helpers import DESIGN
from .test_files import GRID, VOLUME

STACK = np.random.default_rng(0).integers(0, 4096, (5, 12, 14)).astype(np.uint16)


def save(path, axes, shape, writer):
    """A stack with axes of these names and lengths, in one of the ways in which they are declared."""
    pixels = STACK[: int(np.prod(shape))].reshape(*shape, *STACK.shape[1:])
    if writer == "ngff":
        names = [{"name": name} for name in f"{axes}YX".lower()]
        attributes = {"multiscales": [{"axes": names, "datasets": [{"path": "0"}]}]}
        zarr.create_group(path, zarr_format=2, attributes=attributes).create_array("0", data=pixels)
    elif writer == "zarr 3":
        zarr.create_array(path, data=pixels, dimension_names=list(f"{axes}YX".lower()))
    else:
        options = {"imagej": {"imagej": True}, "ome": {"ome": True}, "shaped": {}}[writer]
        metadata = {"axes": f"{axes}YX"}
        tifffile.imwrite(path, pixels, photometric="minisblack", metadata=metadata, **options)
    return path


def frames(path, axes="t"):
    """Images of a recording by their numbers in `STACK`; None for a single capture."""
    with open_recording(path, axes=axes) as recording:
        if recording is None:
            return None
        images = [next(recording.images(frame, Selection())) for frame in range(len(recording.names))]
    return [int(np.argmax([np.array_equal(image, plane) for plane in STACK])) for image in images]


@pytest.mark.parametrize("writer", ["imagej", "ome", "shaped", "ngff", "zarr 3"])
@pytest.mark.parametrize(
    ("axes", "shape", "allowed", "good"),
    [
        ("T", (5,), "t", True),
        ("T", (5,), "tz", True),
        ("Z", (5,), "t", False),
        ("Z", (5,), "tz", True),
        ("C", (5,), "t", False),
        ("C", (5,), "tz", False),
        ("TC", (2, 2), "t", False),
        ("ZC", (2, 2), "tz", False),
        ("TZ", (2, 2), "tz", False),
        ("TZC", (1, 5, 1), "tz", True),
        ("TZC", (5, 1, 1), "t", True),
    ],
)
def test_axes_mean_the_same_in_all_containers(tmp_path, writer, axes, shape, allowed, good):
    """Channels and depths never become frames, nor channels planes."""
    path = save(tmp_path / ("a.zarr" if writer in ("ngff", "zarr 3") else "a.tif"), axes, shape, writer)
    if good:
        assert frames(path, allowed) == [0, 1, 2, 3, 4]
        return
    with pytest.raises(InputError, match=r"array must be \([tz], y, x\).*got ") as caught:
        frames(path, allowed)
    assert all(name.lower() in str(caught.value).partition("got")[2] for name in axes)
    if path.suffix == ".tif":
        # What is asked for by its number is taken as it is.
        np.testing.assert_array_equal(read_capture(path, page=2), STACK[1])


def test_axes_that_say_nothing(tmp_path):
    """Pages, ImageJ's plain stacks, and arrays of three axes; not of four."""
    tifffile.imwrite(tmp_path / "pages.tif", STACK, photometric="minisblack")
    tifffile.imwrite(
        tmp_path / "slices.tif", STACK, photometric="minisblack", description="ImageJ=1.53t\nimages=5\nslices=5\n"
    )
    with tifffile.TiffWriter(tmp_path / "one by one.tif") as file:
        for plane in STACK:
            file.write(plane)
    zarr.create_array(tmp_path / "a.zarr", data=STACK)
    for name in ("pages.tif", "slices.tif", "one by one.tif", "a.zarr"):
        assert frames(tmp_path / name) == frames(tmp_path / name, "tz") == [0, 1, 2, 3, 4]
    tifffile.imwrite(tmp_path / "four.tif", STACK[:4].reshape(2, 2, 12, 14), photometric="minisblack")
    tifffile.imwrite(
        tmp_path / "three.tif", STACK, photometric="minisblack", description="ImageJ=1.53t\nimages=3\nframes=3\n"
    )
    for name, words in (("four.tif", "got 2 x 2 x 12 x 14"), ("three.tif", "pages must be 3, as the file declares")):
        with pytest.raises(InputError, match=words):
            frames(tmp_path / name)


def test_what_bio_formats_writes(tmp_path):
    """A root with a group for each image, and all five axes; rows and columns are the last."""
    group = zarr.create_group(tmp_path / "a.zarr", zarr_format=2, attributes={"bioformats2raw.layout": 3})
    axes = [{"name": "t", "type": "time"}, {"name": "c", "type": "channel"}, *({"name": name} for name in "zyx")]
    image = group.create_group("0", attributes={"multiscales": [{"axes": axes, "datasets": [{"path": "0"}]}]})
    image.create_array("0", data=STACK[:, None, None])
    group.create_group("OME")
    assert frames(tmp_path / "a.zarr") == [0, 1, 2, 3, 4]
    group.create_group("1")
    zarr.create_array(tmp_path / "b.zarr", data=STACK, dimension_names=["t", "x", "y"])
    for name, words in (("a.zarr", "no image"), ("b.zarr", r"\(t, x, y\)")):
        with pytest.raises(InputError, match=words):
            frames(tmp_path / name)


def ome(tiff_data, sizes=(5, 1, 1), order="XYCZT", uuid="", own="", pixels=1):
    """OME-XML with these elements `TiffData`; sizes of t, c and z."""
    t, c, z = sizes
    image = (
        f'<Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="{order}" Type="uint16" SizeX="14" SizeY="12" '
        f'SizeC="{c}" SizeZ="{z}" SizeT="{t}">{tiff_data}</Pixels></Image>'
    )
    root = f'UUID="{own}"' if own else ""
    schema = "http://www.openmicroscopy.org/Schemas/OME/2016-06"
    return f'<?xml version="1.0"?><OME xmlns="{schema}" {root}>{pixels * image}</OME>'


def write_ome(path, planes, xml):
    tifffile.imwrite(path, planes, photometric="minisblack", description=xml, metadata=None)


def test_planes_are_in_the_order_of_tiff_data(tmp_path):
    order = [3, 0, 4, 1, 2]
    data = "".join(f'<TiffData FirstT="{t}" IFD="{ifd}"/>' for t, ifd in enumerate(order))
    write_ome(tmp_path / "a.tif", STACK, ome(data))
    assert frames(tmp_path / "a.tif") == order
    psfs = [spot.image for _, spot in read_spots([tmp_path / "a.tif"])]
    np.testing.assert_array_equal(psfs, STACK[order])
    # A page by its number is that of the file.
    np.testing.assert_array_equal(read_capture(tmp_path / "a.tif", page=1), STACK[0])
    write_ome(tmp_path / "b.tif", STACK[:4], ome('<TiffData IFD="0" PlaneCount="4"/>', (2, 2, 1), "XYTCZ"))
    with pytest.raises(InputError, match=r"got 2 x 2 x 1 x 12 x 14 \(t, c, z, y, x\)"):
        frames(tmp_path / "b.tif")


def test_a_volume_has_its_planes_in_the_declared_order(tmp_path):
    write_volume(tmp_path / "a.ome.tif", VOLUME, GRID)
    with tifffile.TiffFile(tmp_path / "a.ome.tif") as file:
        text = (file.ome_metadata or "").replace(
            '<TiffData IFD="0" PlaneCount="3"/>',
            '<TiffData FirstZ="0" IFD="2"/><TiffData FirstZ="1" IFD="1"/><TiffData FirstZ="2" IFD="0"/>',
        )
    tifffile.imwrite(
        tmp_path / "b.ome.tif", VOLUME[::-1], photometric="minisblack", description=text.encode(), metadata=None
    )
    np.testing.assert_array_equal(read_volume(tmp_path / "b.ome.tif")[0], VOLUME)


def micro_manager(folder, names=("run_MMStack_Pos0.ome.tif", "run_MMStack_Pos0_1.ome.tif"), counts=(3, 2)):
    """A recording over two files; the first says where each plane is, the second where the first is."""
    data, first = "", 0
    for name, count in zip(names, counts, strict=True):
        for ifd in range(count):
            uuid = f'<UUID FileName="{name}">urn:uuid:{name}</UUID>'
            data += f'<TiffData FirstT="{first + ifd}" IFD="{ifd}" PlaneCount="1">{uuid}</TiffData>'
        first += count
    write_ome(folder / names[0], STACK[: counts[0]], ome(data, own=f"urn:uuid:{names[0]}"))
    schema = "http://www.openmicroscopy.org/Schemas/OME/2016-06"
    only = f'<BinaryOnly MetadataFile="{names[0]}" UUID="urn:uuid:{names[0]}"/>'
    write_ome(folder / names[1], STACK[counts[0] :], f'<?xml version="1.0"?><OME xmlns="{schema}">{only}</OME>')
    return folder / names[0], folder / names[1]


@pytest.mark.parametrize("declared", [True, False])
def test_frames_go_on_in_sister_files(tmp_path, declared):
    """Which OME-XML names; or, as Micro-Manager leaves them after a crash, their names alone."""
    first, second = micro_manager(tmp_path)
    if not declared:
        tifffile.imwrite(first, STACK[:3], photometric="minisblack", ome=False)
        tifffile.imwrite(second, STACK[3:], photometric="minisblack", ome=False)
    with open_recording(first) as recording:
        assert recording is not None and recording.files == [first, second]
        assert recording.names[2:4] == [f"{first.name}, page 3", f"{second.name}, page 1"]
    assert frames(first) == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(read_capture(first, page="mean"), STACK.mean(0), rtol=1e-6)
    with pytest.raises(InputError, match=f"is a part of a set of files.* give the first, {first.name}"):
        frames(second)
    np.testing.assert_array_equal(read_capture(second, page=2), STACK[4])


def ndtiff(folder, places, counts=(5,)):
    """A data set of Micro-Manager: images at these places, in files of so many, and an index."""
    index, first = b"", 0
    for number, count in enumerate(counts):
        name = f"run_NDTiffStack{f'_{number}' if number else ''}.tif"
        planes = STACK[first : first + count]
        tifffile.imwrite(folder / name, planes, photometric="minisblack", metadata=None)
        for at in places[first : first + count]:
            words = [json.dumps(at).encode(), name.encode()]
            index += b"".join(struct.pack("<I", len(word)) + word for word in words) + bytes(32)
        first += count
    (folder / "NDTiff.index").write_bytes(index)
    return folder / "run_NDTiffStack.tif"


def test_the_index_of_ndtiff_is_what_counts(tmp_path):
    assert frames(ndtiff(tmp_path, [{"time": 4 - t} for t in range(5)])) == [4, 3, 2, 1, 0]
    path = ndtiff(tmp_path, [{"time": t, "channel": "a"} for t in range(5)], counts=(3, 2))
    assert frames(path) == [0, 1, 2, 3, 4]
    with pytest.raises(InputError, match="give the first, run_NDTiffStack.tif"):
        frames(tmp_path / "run_NDTiffStack_1.tif")
    (tmp_path / "run_NDTiffStack_1.tif").unlink()
    with pytest.warns(InputWarning, match="declares 5 images and holds 3.*run_NDTiffStack_1.tif is missing"):
        assert frames(path) == [0, 1, 2]
    path = ndtiff(tmp_path, [{"z": z} for z in range(5)])
    assert frames(path, "tz") == [0, 1, 2, 3, 4]
    for places, words in (
        ([{"z": z} for z in range(5)], r"got 5 x 12 x 14 \(z, y, x\)"),
        ([{"time": t // 2, "channel": "ab"[t % 2]} for t in range(4)], r"got 2 x 2 x 12 x 14 \(t, c, y, x\)"),
    ):
        with pytest.raises(InputError, match=words):
            frames(ndtiff(tmp_path, places))
    with open_recording(ndtiff(tmp_path, [{"time": t} for t in (0, 1, 3)])) as recording:
        assert recording is not None and len(recording.names) == 4
        with pytest.raises(InputError, match="image 3 is not in the file"):
            next(recording.images(2, Selection()))


def test_a_sister_file_that_is_missing_is_told(tmp_path):
    first, second = micro_manager(tmp_path)
    second.unlink()
    with pytest.warns(InputWarning, match=f"declares 5 images and holds 3.*{second.name} is missing"):
        assert frames(first) == [0, 1, 2]
    # A file that was renamed is still itself.
    shutil.move(first, tmp_path / "b.tif")
    with pytest.warns(InputWarning, match="holds 3"):
        assert frames(tmp_path / "b.tif") == [0, 1, 2]


def test_files_of_elsewhere_are_not_opened(tmp_path):
    (tmp_path / "in").mkdir()
    tifffile.imwrite(tmp_path / "secret.tif", STACK[1])
    uuid = '<UUID FileName="../secret.tif">urn:uuid:x</UUID>'
    data = f'<TiffData FirstT="0" IFD="0"/><TiffData FirstT="1" IFD="0">{uuid}</TiffData>'
    write_ome(tmp_path / "in" / "a.tif", STACK[0], ome(data, (2, 1, 1), own="urn:uuid:a"))
    with pytest.warns(InputWarning, match="declares 2 images and holds 1"):
        assert frames(tmp_path / "in" / "a.tif") is None


def test_a_folder_has_the_files_of_a_set_once(tmp_path):
    """As OME-TIFF with a file for each plane, of which each names all."""
    names = [f"f{t}.ome.tif" for t in range(3)]
    for own, name in enumerate(names):
        uuids = [f'<UUID FileName="{each}">urn:uuid:{each}</UUID>' for each in names]
        data = "".join(
            f'<TiffData FirstT="{t}" IFD="0" PlaneCount="1">{uuid}</TiffData>' for t, uuid in enumerate(uuids)
        )
        write_ome(tmp_path / name, STACK[own], ome(data, (3, 1, 1), own=f"urn:uuid:{name}"))
    assert frames(tmp_path) == frames(tmp_path / "f*.tif") == frames(tmp_path / names[0]) == [0, 1, 2]


def test_an_image_that_is_missing_between_others_fails_alone(tmp_path):
    data = "".join(f'<TiffData FirstT="{t}" IFD="{t}"/>' for t in (0, 1, 3, 4))
    write_ome(tmp_path / "a.tif", STACK, ome(data))
    with open_recording(tmp_path / "a.tif") as recording:
        assert recording is not None and len(recording.names) == 5
        np.testing.assert_array_equal(next(recording.images(4, Selection())), STACK[4])
        with pytest.raises(InputError, match="image 3 is not in the file"):
            next(recording.images(2, Selection()))


@pytest.mark.parametrize(
    ("xml", "words"),
    [
        (ome("").replace("12", "24"), "24 x 14 pixels in OME-XML"),
        (ome("").replace('SizeT="5"', 'SizeT="many"'), "OME-XML must be with sizes"),
        (ome("").replace('SizeT="5"', 'SizeT="100000000000"'), "OME-XML must be with sizes"),
        (ome("", order="XYZ"), "OME-XML must be with sizes"),
        (ome("")[:-9], "not a whole and valid OME-XML"),
        (ome("", pixels=2), r"\(image, t, c, z, y, x\)"),
        (ome("", pixels=0), "about the file's 5 pages"),
    ],
)
def test_wrong_ome_xml_is_one_line(tmp_path, xml, words):
    write_ome(tmp_path / "a.tif", STACK, xml)
    with pytest.raises(InputError, match=words):
        frames(tmp_path / "a.tif")
    np.testing.assert_array_equal(read_capture(tmp_path / "a.tif", page=5), STACK[4])


@pytest.mark.parametrize("writer", ["imagej", "ome", "shaped", "pages", "bigtiff"])
def test_a_stack_that_is_cut_off(tmp_path, writer):
    """Entries of pages come after all pixels, and are the first to be lost."""
    path = tmp_path / "a.tif"
    options: Any = {"imagej": {"imagej": True}, "ome": {"ome": True}, "bigtiff": {"bigtiff": True}}.get(writer, {})
    metadata = None if writer in ("pages", "bigtiff") else {"axes": "TYX"}
    tifffile.imwrite(path, STACK, photometric="minisblack", metadata=metadata, **options)
    size = STACK[0].nbytes
    path.write_bytes(path.read_bytes()[: int(3.5 * size) + 400])
    path.rename(tmp_path / "b.tif")
    tifffile.imwrite(tmp_path / "c.tif", STACK[1])
    with open_recording(tmp_path) as recording:
        # As one of a folder it would be a frame alone.
        assert recording is not None
        with pytest.raises(InputError, match="3 pages; choose" if metadata and writer != "ome" else "is cut off"):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", InputWarning)
                next(recording.images(0, Selection()))
        np.testing.assert_array_equal(next(recording.images(1, Selection())), STACK[1])
    (tmp_path / "b.tif").rename(path)
    if metadata and writer != "ome":
        with pytest.warns(InputWarning, match="declares 5 images and holds 3, which are used"):
            assert frames(path) == [0, 1, 2]
        with pytest.raises(InputError, match="3 pages"), pytest.warns(InputWarning):
            read_capture(path)
    else:
        # What says how many there are is lost, too.
        with pytest.warns(InputWarning, match="is cut off"):
            np.testing.assert_array_equal(read_capture(path), STACK[0])


@pytest.mark.parametrize("name", ["one by one.tif", "deflate.ome.tif"])
def test_pages_that_are_lost_are_told_whatever_lies_where(tmp_path, name):
    """Where each entry comes before its pixels; the last page that is left is not whole, and fails alone."""
    with tifffile.TiffWriter(tmp_path / name) as file:
        for plane in STACK if name == "one by one.tif" else STACK[None]:
            compression = None if name == "one by one.tif" else "zlib"
            metadata = {"axes": "TYX"[-plane.ndim :]}
            file.write(plane, photometric="minisblack", compression=compression, metadata=metadata)
    with tifffile.TiffFile(tmp_path / name) as file:
        end = file.pages[2].aspage().dataoffsets[0] + 10
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:end])
    with pytest.warns(InputWarning, match="is cut off after its first 3 pages, which are used"):
        with open_recording(tmp_path / name) as recording:
            assert recording is not None and len(recording.names) == 3
            np.testing.assert_array_equal(next(recording.images(1, Selection())), STACK[1])
            with pytest.raises(InputError, match="a part of page 3 is not in the file"):
                next(recording.images(2, Selection()))


def test_smaller_copies_are_no_frames(tmp_path):
    """As pyramids and thumbnails among the pages, and below them."""
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(STACK[0], photometric="minisblack", subifds=1, metadata=None)
        file.write(STACK[0, ::2, ::2], photometric="minisblack", subfiletype=1)
        file.write(STACK[0, ::4, ::4], photometric="minisblack", subfiletype=1)
    assert frames(tmp_path / "a.tif") is None
    np.testing.assert_array_equal(read_capture(tmp_path / "a.tif"), STACK[0])


def test_channels_are_no_repeats_of_a_dark_frame(tmp_path):
    tifffile.imwrite(tmp_path / "capture.tif", STACK[0])
    dark = save(tmp_path / "dark.tif", "C", (5,), "ome")
    with pytest.raises(InputError, match=r"\(t, c, z, y, x\); its images are not repeats of one"):
        read_corrected(tmp_path / "capture.tif", correction=Correction(dark=dark))
    dark = save(tmp_path / "dark.tif", "T", (5,), "ome")
    image, done, _ = read_corrected(tmp_path / "capture.tif", correction=Correction(dark=dark))
    np.testing.assert_allclose(image, STACK[0] - STACK.mean(0), atol=1e-3)


@pytest.mark.parametrize(("version", "shards"), [(2, None), (3, None), (3, (1, 12, 14))])
def test_a_missing_chunk_is_named(tmp_path, version, shards):
    size: Any = {"chunks": (1, 12, 7), "shards": shards} if shards else {"chunks": (2, 12, 7)}
    array = zarr.create_array(tmp_path / "a.zarr", data=STACK, zarr_format=version, **size)
    key = array.metadata.encode_chunk_key((2, 0, 0))
    (tmp_path / "a.zarr" / key).unlink()
    with open_recording(tmp_path / "a.zarr") as recording:
        assert recording is not None
        np.testing.assert_array_equal(next(recording.images(1, Selection())), STACK[1])
        lost = 2 if shards else 4
        with pytest.raises(InputError, match=f"frame {lost + 1} is incomplete: there is no chunk {key}"):
            next(recording.images(lost, Selection()))


# Captures as cameras and their programs deliver them, and what is said of those that need a choice.


RNG = np.random.default_rng(0)
GREY = RNG.integers(0, 65536, (37, 41)).astype(np.uint16)
FORMATS_STACK = RNG.integers(0, 4096, (5, 37, 41)).astype(np.uint16)
COLOUR = RNG.integers(0, 65536, (37, 41, 3)).astype(np.uint16)
# How grey images of any type are saved.
GREYS = {
    "plain": dict(photometric="minisblack"),
    "big-endian": dict(byteorder=">"),
    "tiles": dict(tile=(16, 16), compression="zlib"),
    "deflate": dict(compression="zlib"),
    "ome": dict(ome=True),
    "imagej": dict(imagej=True),
}
# How several pages are.
STACKS = {
    "pages.tif": dict(photometric="minisblack"),
    "imagej.tif": dict(imagej=True),
    "one_entry.tif": dict(imagej=True, truncate=True),
    "deflate.tif": dict(photometric="minisblack", compression="zlib", rowsperstrip=5),
    "channels.ome.tif": dict(photometric="minisblack", metadata={"axes": "CYX"}),
}


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("name", GREYS)
def test_grey_tiff(tmp_path, name, dtype):
    pixels = (GREY >> 8).astype(dtype)
    tifffile.imwrite(tmp_path / "a.tif", pixels, **GREYS[name])
    found = read_capture(tmp_path / "a.tif", (37, 41))
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, pixels)


def tiff_of_one_strip(data, shape, bits, order, more):
    """A TIFF of coded pixels, with further tags."""
    rows, columns = shape
    tags = {256: columns, 257: rows, 258: bits, 262: 1, 273: 0, 277: 1, 278: rows, 279: len(data)} | more
    tags = dict(sorted(tags.items())) | {273: 8 + 2 + 12 * len(tags) + 4}
    entries = b"".join(struct.pack(f"{order}HHII", tag, 4, 1, value) for tag, value in tags.items())
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}IH", 8, len(tags))
    return head + entries + bytes(4) + data


def lzw(data):
    """LZW of codes of 9 bits alone: the table is cleared before it grows beyond them."""
    codes = [code for at in range(0, len(data), 200) for code in (256, *data[at : at + 200])]
    bits = "".join(f"{code:09b}" for code in (*codes, 257))
    return int(bits.ljust(-(-len(bits) // 8) * 8, "0"), 2).to_bytes(-(-len(bits) // 8), "big")


def differences(pixels, predictor, order):
    """Bytes of rows, as they are (1), of differences of neighbours (2), or of differences of bytes of floats (3)."""
    rows = pixels.astype(pixels.dtype.newbyteorder(order))
    if predictor == 2:
        rows[:, 1:] = np.diff(pixels, axis=1)
    elif predictor == 3:
        # The highest bytes of a row first.
        high_first = pixels.astype(">f4").view(np.uint8).reshape(*pixels.shape, 4)
        rows = np.moveaxis(high_first, -1, 1).reshape(len(pixels), -1)
        rows[:, 1:] = np.diff(rows.copy(), axis=1)
    return rows.tobytes()


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("compression", ["none", "lzw", "deflate", "old deflate", "packbits"])
@pytest.mark.parametrize(
    ("dtype", "predictor"),
    [("uint8", 1), ("uint16", 1), ("float32", 1), ("uint8", 2), ("uint16", 2), ("float32", 3)],
)
def test_bytes_in_either_order(tmp_path, order, compression, dtype, predictor):
    """Whichever of the two libraries decodes them."""
    pixels = (GREY >> 8).astype(dtype) / (dtype == "float32" and 3 or 1)
    pixels = pixels.astype(dtype)
    if compression in ("none", "packbits") and predictor > 1:
        return
    data = differences(pixels, predictor, order)
    runs = b"".join(bytes([len(part) - 1]) + part for part in (data[at : at + 128] for at in range(0, len(data), 128)))
    codes = {"none": 1, "lzw": 5, "deflate": 8, "old deflate": 32946, "packbits": 32773}
    coded = {"none": data, "lzw": lzw(data), "packbits": runs}.get(compression, zlib.compress(data))
    tags = {259: codes[compression], 317: predictor, 339: 3 if dtype == "float32" else 1}
    (tmp_path / "a.tif").write_bytes(tiff_of_one_strip(coded, pixels.shape, 8 * pixels.itemsize, order, tags))
    found = read_capture(tmp_path / "a.tif")
    assert found.dtype == dtype and found.dtype.isnative
    np.testing.assert_array_equal(found, pixels)


@pytest.mark.parametrize("bigtiff", [False, True])
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_big_endian_stacks_of_one_entry(tmp_path, dtype, bigtiff):
    stack = FORMATS_STACK.astype(dtype)
    options = {"bigtiff": bigtiff, "photometric": "minisblack", "metadata": {"axes": "TYX", "truncate": True}}
    tifffile.imwrite(tmp_path / "a.tif", stack, byteorder=">", **options)
    for page in (1, 5):
        found = read_capture(tmp_path / "a.tif", page=page)
        assert found.dtype.isnative
        np.testing.assert_array_equal(found, stack[page - 1])


def test_a_missing_decoder_is_named_whatever_fails_first(tmp_path, monkeypatch):
    """As a module, or in tifffile's words. Pillow always has LZW: what it cannot decode is damaged."""
    monkeypatch.setitem(sys.modules, "compression.zstd", None)
    # What tifffile falls back on where imagecodecs is not installed; it keeps the decoders that it has found.
    monkeypatch.setattr("tifffile.tifffile.imagecodecs", tifffile._imagecodecs)
    monkeypatch.setattr("tifffile.tifffile.TIFF.DECOMPRESSORS._codecs", {1: lambda data: data})
    monkeypatch.setattr("gs_jax.io.tiff.Image.open", lambda *_, **__: (_ for _ in ()).throw(UnidentifiedImageError()))
    for code, name in {50000: "ZSTD", 34712: "JPEG2000", 34887: "LERC", 50001: "WEBP", 5: "LZW"}.items():
        tifffile.imwrite(tmp_path / "a.tif", GREY, compression="zlib")
        with tifffile.TiffFile(tmp_path / "a.tif", mode="r+") as file:
            file.pages.first.tags[259].overwrite(code)
        refused(tmp_path / "a.tif", [f"no decoder for {name} compression is installed", "pip install imagecodecs"])
    monkeypatch.undo()
    refused(tmp_path / "a.tif", ["not a whole and valid TIFF"])


def packed(pixels, bits):
    """A TIFF of one strip whose pixels lie bit to bit, rows from a whole byte on."""
    kept = np.unpackbits(pixels.astype(">u2").view(np.uint8)).reshape(*pixels.shape, 16)[..., -bits:]
    data = np.packbits(kept.reshape(len(pixels), -1), axis=1).tobytes()
    return tiff_of_one_strip(data, pixels.shape, bits, "<", {259: 1})


def test_packed_12_bits(tmp_path):
    for columns in (40, 41):
        pixels = GREY[:, :columns] >> 4
        (tmp_path / "a.tif").write_bytes(packed(pixels, 12))
        np.testing.assert_array_equal(read_capture(tmp_path / "a.tif"), pixels)


@pytest.mark.parametrize("name", [*STACKS, "lzw.tif", "stack.npy"])
def test_a_page_is_chosen(tmp_path, name):
    path = tmp_path / name
    if name in STACKS:
        tifffile.imwrite(path, FORMATS_STACK, **STACKS[name])
    elif name == "lzw.tif":
        first, *others = map(Image.fromarray, FORMATS_STACK)
        first.save(path, compression="tiff_lzw", save_all=True, append_images=others)
    else:
        np.save(path, FORMATS_STACK)
    for page in (1, 4, 5):
        np.testing.assert_array_equal(read_capture(path, (37, 41), page=page), FORMATS_STACK[page - 1])
    mean = read_capture(path, page="mean")
    assert mean.dtype == np.float32
    np.testing.assert_allclose(mean, FORMATS_STACK.mean(0), rtol=1e-6)
    refused(path, ["5 pages", "--page 1 to 5", "mean"])
    for page in (0, 6):
        refused(path, [f"--page {page}", "5 pages", "1 to 5"], page=page)


def test_pages_of_several_sizes(tmp_path):
    """A preview beside the capture."""
    tifffile.imwrite(tmp_path / "a.tif", GREY, photometric="minisblack")
    tifffile.imwrite(tmp_path / "a.tif", GREY[::4, ::4], photometric="minisblack", append=True, metadata=None)
    np.testing.assert_array_equal(read_capture(tmp_path / "a.tif", (37, 41), page=1), GREY)
    refused(tmp_path / "a.tif", ["10 x 11", "37 x 41"], page="mean", shape=(37, 41))
    refused(tmp_path / "a.tif", ["10 x 11", "37 x 41"], page="mean")


def png(pixels):
    """A PNG of 16 bits a colour, which Pillow does not write."""
    rows, columns, colours = pixels.shape
    header = struct.pack(">IIBBBBB", columns, rows, 16, {3: 2, 4: 6}[colours], 0, 0, 0)
    body = zlib.compress(b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels))
    chunks = [(b"IHDR", header), (b"IDAT", body), (b"IEND", b"")]
    whole = [
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(whole)


@pytest.mark.parametrize(
    "name", ["contig.tif", "separate.tif", "lzw8.tif", "16.png", "16alpha.png", "8.png", "8alpha.png"]
)
def test_a_colour_is_chosen(tmp_path, name):
    path, pixels = tmp_path / name, COLOUR
    if name.startswith(("8", "lzw")):
        pixels = (COLOUR >> 8).astype(np.uint8)
    with_alpha = np.dstack([pixels, pixels[..., :1]]) if "alpha" in name else pixels
    if name.startswith("16"):
        path.write_bytes(png(with_alpha))
    elif name == "separate.tif":
        tifffile.imwrite(path, np.moveaxis(pixels, -1, 0), photometric="rgb", planarconfig="separate")
    elif name == "contig.tif":
        tifffile.imwrite(path, pixels, photometric="rgb")
    else:
        Image.fromarray(with_alpha).save(path, **(dict(compression="tiff_lzw") if path.suffix == ".tif" else {}))
    for number, channel in enumerate(("red", "green", "blue")):
        found = read_capture(path, (37, 41), channel=channel)
        assert found.dtype == pixels.dtype
        np.testing.assert_array_equal(found, pixels[..., number])
    refused(path, ["colour (RGB)", "--channel red, green, blue"])
    refused(path, ["pink", "red, green, blue"], channel="pink")
    refused(path, ["colour", "--bayer RGGB"], channel="red", bayer="RGGB")


def test_a_mosaic_is_split(tmp_path):
    np.save(tmp_path / "a.npy", GREY)
    read = lambda channel: read_capture(tmp_path / "a.npy", (37, 41), bayer="GBRG", channel=channel)
    np.testing.assert_array_equal(read("red"), GREY[1:36:2, 0:40:2])
    np.testing.assert_array_equal(read("blue"), GREY[0:36:2, 1:40:2])
    np.testing.assert_array_equal(read("green"), (GREY[0:36:2, 0:40:2] + GREY[1:36:2, 1:40:2].astype(float)) / 2)
    refused(tmp_path / "a.npy", ["--channel red", "--bayer", "got greyscale"], channel="red")


@pytest.mark.parametrize("declares", [True, False])
def test_a_declared_mosaic(tmp_path, declares):
    tags = [(33421, 3, 2, (2, 2), True), (33422, 1, 4, bytes([0, 1, 1, 2]), True)] if declares else []
    tifffile.imwrite(tmp_path / "a.tif", GREY, photometric=32803, extratags=tags)
    refused(tmp_path / "a.tif", ["colour filter mosaic", "--bayer RGGB", "--channel"])
    found = read_capture(tmp_path / "a.tif", bayer="RGGB", channel="blue")
    np.testing.assert_array_equal(found, GREY[1:36:2, 1:40:2])
    if declares:
        refused(tmp_path / "a.tif", ["--bayer BGGR", "RGGB"], bayer="BGGR", channel="blue")


def refused(path, words, shape=None, **options):
    with pytest.raises(InputError) as caught:
        read_capture(path, shape, **options)
    message = str(caught.value)
    assert message.isprintable() and len(message) < 400
    for word in (path.name, *words):
        assert word in message, f"{word!r} is not in {message!r}"


# The command line on captures as cameras deliver them.


SHAPE = (96, 80)
LIGHT = np.random.default_rng(0).integers(100, 3000, SHAPE)
LIGHT[40, 30] = LIGHT[41, 30] = 4000
CUT = 4095


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "design.toml").write_text(DESIGN)
    options_save(tmp_path / "capture.tif", LIGHT)
    return tmp_path


def options_save(path, pixels):
    tifffile.imwrite(path, np.asarray(pixels, np.uint16), photometric="minisblack")


def reconstruct(name, *options):
    """The volume at 20 mm, its grid, and what was said."""
    arguments = ["reconstruct", name, "design.toml", "--depths", "20", "--voxel-um", "50", "-o", "v.ome.tif", *options]
    result = CliRunner().invoke(commands, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    return *read_volume("v.ome.tif"), result


def test_a_part_of_the_sensor_needs_no_other_design(folder):
    """The volume lies in the frame of the whole sensor."""
    whole, _, _ = reconstruct("capture.tif")
    options_save("part.tif", LIGHT[10:70, 4:64])
    part, grid, result = reconstruct("part.tif", "--roi", "10,4,60,60")
    np.testing.assert_allclose(grid.origin, [(4 + 30 - 40) * 0.02, (10 + 30 - 48) * 0.02], atol=1e-9)
    assert "part.tif: rows 10 to 69, columns 4 to 63 of the sensor" in result.stdout
    # A design that says the same makes the same volume.
    text = DESIGN.replace("shape = [96, 80]", "shape = [60, 60]\norigin_mm = [-0.12, -0.16]")
    (folder / "design.toml").write_text(text)
    np.testing.assert_allclose(reconstruct("part.tif")[0], part, rtol=1e-5)
    assert whole.shape != part.shape


def test_everything_at_once_is_said_and_recorded(folder):
    """Repeated frames of a binned part, with a dark frame, a flat field and a mask; some pixels at full scale."""
    pages = np.stack([LIGHT[:60, :60]] * 3)
    pages[:, 7, 5:8] = CUT
    options_save("pages.tif", pages)
    dark = np.full((60, 60), 16)
    dark[20, 20] = 900
    options_save("dark.tif", np.stack([dark] * 2))
    options_save("flat.tif", dark + 2000 - np.arange(60))
    mask = np.zeros((60, 60), np.uint8)
    mask[3, 4] = 255
    Image.fromarray(mask).save("mask.png")
    (folder / "design.toml").write_text(DESIGN.replace("[96, 80]", "[192, 160]").replace("= 20.0", "= 10.0"))
    options = ["--page", "mean", "--roi", "8,10,120,121", "--binning", "2"]
    options += ["--dark", "dark.tif", "--flat", "flat.tif", "--bad-pixels", "mask.png"]
    _, grid, result = reconstruct("pages.tif", *options)
    lines = [
        "mean of 3 pages",
        "rows 8 to 127, columns 10 to 130 of the sensor",
        "pixels binned 2 x 2",
        "dark frame dark.tif taken off, median 16",
        "flat field flat.tif divided out, 0.985 to 1.01",
        "2 bad pixels filled from neighbours: 1 hot in dark.tif, 1 in mask.png",
    ]
    assert result.stdout.splitlines()[:6] == [f"pages.tif: {line}" for line in lines]
    assert "warning: pages.tif: 9 pixels (0.00083 of all) are saturated at 4095" in result.stderr
    said = read_provenance("v.ome.tif")
    assert all(line in said["correction"] for line in lines)
    assert {"input dark.tif", "input flat.tif", "input mask.png"} < set(said)
    np.testing.assert_allclose(grid.origin, [(10 + 60 - 80) * 0.01, (8 + 60 - 96) * 0.01], atol=1e-9)


def test_a_colour_of_a_mosaic(folder):
    volume, grid, result = reconstruct("capture.tif", "--bayer", "GRBG", "--channel", "red")
    np.testing.assert_allclose(grid.origin, [0.01, -0.01], atol=1e-9)
    assert "capture.tif: red of the mosaic GRBG" in result.stdout and volume.max() > 0


def test_a_hot_pixel_is_repaired_unless_it_is_not_wanted(folder):
    pixels = np.full(SHAPE, 20)
    pixels[48, 40] = CUT
    options_save("hot.tif", pixels)
    volume, _, result = reconstruct("hot.tif")
    assert volume.max() < 100
    assert "hot.tif: 1 bad pixel filled from neighbours: 1 hot in the capture" in result.stdout
    volume, _, result = reconstruct("hot.tif", "--bad-pixels", "none")
    assert volume.max() > 1000 and "bad pixel" not in result.stdout


def test_a_cameras_offset(folder):
    volume, _, result = reconstruct("capture.tif", "--offset", "100")
    assert "capture.tif: offset 100 taken off" in result.stdout
    assert volume.max() < reconstruct("capture.tif")[0].max()


def test_deconvolve_reads_the_same_way(folder):
    options_save("capture.tif", np.stack([LIGHT, LIGHT]))
    options_save("psf.tif", 5 + np.pad([[50]], 6))
    arguments = "deconvolve capture.tif psf.tif --steps 1 -o s.tif --page mean --offset 5".split()
    result = CliRunner().invoke(commands, arguments, catch_exceptions=False)
    assert "2 captures: offset 5 taken off" in result.stdout
    assert "offset 5" in read_provenance("s.tif")["correction"]


def test_a_region_in_a_design():
    """Its lenses may lie beyond it, one excepted."""
    from gs_jax.design.design import Design

    data = read_design("design/geomscope.toml").model_dump()
    data["sensor"] = {"shape": (800, 900), "pixel_pitch_um": 4.5, "origin_mm": (-2.0, 3.0)}
    sensor = Design.model_validate(data).imager().sensor
    assert (sensor.shape, sensor.origin) == ((800, 900), (-2.0, 3.0))
    for wrong, words in (({"origin_mm": None}, "beside the sensor"), ({"origin_mm": (90.0, 0.0)}, "beside the sensor")):
        with pytest.raises(ValueError, match=words):
            Design.model_validate(data | {"sensor": data["sensor"] | wrong})
