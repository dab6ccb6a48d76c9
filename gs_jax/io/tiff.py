"""TIFF and PNG: pages decoded or refused in words, and a second description of a file."""

import contextlib
import math
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image, ImageFile

from ..base.errors import InputError
from .files import decoding

# TIFF's number of a description, and of the tag after it, whose place a second one takes.
_DESCRIPTION, _AFTER = 270, 271
# Of TIFF/EP: the colours of a mosaic's cell, 2 x 2 of them, and how they are numbered.
_CELL, _PATTERN, _COLOURS = 33421, 33422, "RGB"


def page_count(tiff: tifffile.TiffFile) -> int:
    """Pages of a file: those of its list, or of a stack that has one entry for all, as ImageJ writes large ones."""
    first = tiff.pages.first
    return max(len(tiff.pages), tiff.series[0].size // max(first.size, 1))


def declared_mosaic(page: tifffile.TiffPage) -> str | None:
    """The colours of a mosaic's first pixels, as `Readout.bayer`, if the file says them."""
    cell, pattern = (page.tags.get(code) for code in (_CELL, _PATTERN))
    if cell is None or pattern is None or tuple(cell.value) != (2, 2):
        return None
    return "".join(_COLOURS[number] for number in bytes(pattern.value))


def decode_plane(path: Path, tiff: tifffile.TiffFile, index: int) -> np.ndarray:
    """The pixels of a page, counted from 0, of those of `page_count`; its declared size has been checked."""
    if index < len(tiff.pages):
        return decode_page(path, tiff.pages[index].aspage())
    first = tiff.pages.first
    _check_segments(path, first)
    with decoding(path, "TIFF"):
        kind = np.dtype(first.dtype).newbyteorder(tiff.byteorder)
        return np.array(np.memmap(path, kind, "r", first.dataoffsets[0] + index * first.nbytes, first.shape))


def decode_png(path: Path, image: ImageFile.ImageFile, bits: int) -> np.ndarray:
    """The pixels of a PNG `(row, column)`, or `(row, column, colour)`, of 8 or 16 bits.

    Pillow keeps 8 of 16 bits in colour: it is asked twice, for either half.
    """
    if bits != 16 or len(image.getbands()) == 1:
        return np.array(image)
    (tile,), halves = image.tile, []
    for order in "BL":
        with Image.open(path, formats=["PNG"]) as half:
            half.tile = [tile._replace(args=f"{half.mode};16{order}")]
            halves.append(np.array(half).astype(np.uint16))
    return halves[0] << 8 | halves[1]


def decode_page(path: Path, page: tifffile.TiffPage) -> np.ndarray:
    """The pixels of a page whose declared size has been checked.

    Raises
    ------
    InputError
        If a part of the page is missing (the decoder would put zeros there), its compression has no decoder
        here, or it is damaged.
    """
    _check_segments(path, page)
    try:
        with decoding(path, "TIFF"):
            return page.asarray()
    except InputError as error:
        if "imagecodecs" not in str(error):
            raise
        found = getattr(page.compression, "name", page.compression)
        if (pixels := _by_pillow(path, page)) is not None:
            return pixels
        advice = "save it uncompressed or with Deflate (ZIP), or `pip install imagecodecs`"
        found = f"{found} compression" if page.bitspersample % 8 == 0 else f"packed pixels of {page.bitspersample} bits"
        raise InputError(f"{path}: found {found}, whose decoder is not installed; {advice}.") from error


def _by_pillow(path: Path, page: tifffile.TiffPage) -> np.ndarray | None:
    """The pixels as Pillow and its libtiff read them (LZW, packed 12 bits), unless it changes their type."""
    with contextlib.suppress(InputError), decoding(path, "TIFF"), Image.open(path, formats=["TIFF"]) as image:
        image.seek(page.index)
        pixels = np.array(image)
        if pixels.shape == page.shape and pixels.dtype.newbyteorder("=") == page.dtype:
            return pixels
    return None


def _check_segments(path: Path, page: tifffile.TiffPage) -> None:
    """Each strip or tile that the declared size asks for is in the file, and whole where it is not compressed."""
    with decoding(path, "TIFF"):
        offsets, counts = (np.array(n, dtype=np.int64) for n in (page.dataoffsets, page.databytecounts))
        segments, bits = math.prod(page.chunked), page.bitspersample * math.prod(page.shape)
        raw = int(page.compression) == 1
    end = path.stat().st_size
    if offsets.shape != (segments,) or counts.shape != (segments,):
        raise InputError(f"{path}: found {offsets.size} strips or tiles, allowed: the {segments} that its size needs.")
    missing = (offsets < 1) | (counts < 1) | (offsets > end) | (counts > end - offsets)
    if missing.any() or (raw and 8 * counts.sum() < bits):
        raise InputError(f"{path}: not a whole and valid TIFF: a part of page {page.index + 1} is not in the file.")


def place_for_description(text: str) -> tuple[int, int, int, str, bool]:
    """An extra tag for `tifffile`, which writes one description itself: a second one, until it takes its place."""
    return (_AFTER, 2, 0, text, True)


def take_place(path: Path) -> None:
    """Makes a description of the first page's tag of `place_for_description`."""
    with tifffile.TiffFile(path) as tiff:
        entry, order = tiff.pages.first.tags[_AFTER].offset, tiff.byteorder
    with path.open("r+b") as file:
        file.seek(entry)
        file.write(_DESCRIPTION.to_bytes(2, "little" if order == "<" else "big"))
