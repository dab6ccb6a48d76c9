"""Captures as cameras and their programs deliver them, and what is said of those that need a choice."""

import struct
import sys
import zlib

import numpy as np
import pytest
import tifffile
from PIL import Image, UnidentifiedImageError

from gs_jax import read_capture
from gs_jax.base.errors import InputError

RNG = np.random.default_rng(0)
GREY = RNG.integers(0, 65536, (37, 41)).astype(np.uint16)
STACK = RNG.integers(0, 4096, (5, 37, 41)).astype(np.uint16)
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
    stack = STACK.astype(dtype)
    options = {"bigtiff": bigtiff, "photometric": "minisblack", "metadata": {"axes": "TYX", "truncate": True}}
    tifffile.imwrite(tmp_path / "a.tif", stack, byteorder=">", **options)
    for page in (1, 5):
        found = read_capture(tmp_path / "a.tif", page=page)
        assert found.dtype.isnative
        np.testing.assert_array_equal(found, stack[page - 1])


def test_a_missing_decoder_is_named_whatever_fails_first(tmp_path, monkeypatch):
    """As a module, or in tifffile's words. Pillow always has LZW: what it cannot decode is damaged."""
    monkeypatch.setitem(sys.modules, "compression.zstd", None)
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
        tifffile.imwrite(path, STACK, **STACKS[name])
    elif name == "lzw.tif":
        first, *others = map(Image.fromarray, STACK)
        first.save(path, compression="tiff_lzw", save_all=True, append_images=others)
    else:
        np.save(path, STACK)
    for page in (1, 4, 5):
        np.testing.assert_array_equal(read_capture(path, (37, 41), page=page), STACK[page - 1])
    mean = read_capture(path, page="mean")
    assert mean.dtype == np.float32
    np.testing.assert_allclose(mean, STACK.mean(0), rtol=1e-6)
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
