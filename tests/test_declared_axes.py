"""What files declare of their images beside what is in them: axes, order, number, sister files, missing chunks."""

import json
import shutil
import struct
import warnings
from typing import Any

import numpy as np
import pytest
import tifffile
import zarr

from gs_jax import read_capture, read_volume
from gs_jax.base.errors import InputError, InputWarning
from gs_jax.io.camera import Correction, read_corrected
from gs_jax.io.captures import Selection
from gs_jax.io.recordings import open_recording, read_spots
from gs_jax.io.volumes import write_volume

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
