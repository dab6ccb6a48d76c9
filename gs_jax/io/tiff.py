"""Opens TIFF files and decodes their pages; refuses damaged ones in words."""

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image

from ..base.errors import InputError, input_error
from .files import decoding

# Tags of TIFF/EP: the size of a mosaic's cell and its colours, which are numbered as in "RGB".
_CELL, _PATTERN = 33421, 33422


@contextlib.contextmanager
def open_tiff(path: Path) -> Iterator[tuple[tifffile.TiffFile, int]]:
    """Open a TIFF, and count its pages, those of a stack with one entry for all too, as ImageJ writes large ones."""
    with contextlib.ExitStack() as stack:
        with decoding(path, "TIFF"):
            # Without OME, whose metadata may name further files.
            tiff = stack.enter_context(tifffile.TiffFile(path, is_ome=False))
            count = max(len(tiff.pages), tiff.series[0].size // max(tiff.pages.first.size, 1))
        yield tiff, count


def mosaic_pattern(page: tifffile.TiffPage) -> str | None:
    """Colours of the first 2 x 2 pixels of a mosaic, as `Readout.bayer`, if the file declares them."""
    cell, pattern = (page.tags.get(code) for code in (_CELL, _PATTERN))
    if cell is None or pattern is None or tuple(cell.value) != (2, 2):
        return None
    return "".join("RGB"[number] for number in bytes(pattern.value))


def decode_plane(path: Path, tiff: tifffile.TiffFile, index: int) -> np.ndarray:
    """Pixels of a page of `open_tiff`, counted from 0, whose declared size has been checked."""
    if index < len(tiff.pages):
        return decode_page(path, tiff.pages[index].aspage())
    first = tiff.pages.first
    _check_segments(path, first)
    with decoding(path, "TIFF"):
        dtype = np.dtype(first.dtype).newbyteorder(tiff.byteorder)
        return np.array(np.memmap(path, dtype, "r", first.dataoffsets[0] + index * first.nbytes, first.shape))


def decode_page(path: Path, page: tifffile.TiffPage) -> np.ndarray:
    """Pixels of a page whose declared size has been checked.

    Raises `InputError` if a part of the page is missing (tifffile would fill it with zeros), no decoder of its
    compression is installed, or it is damaged.
    """
    _check_segments(path, page)
    try:
        with decoding(path, "TIFF"):
            return page.asarray()
    except InputError as error:
        if "imagecodecs" not in str(error):
            raise
        if (pixels := _decode_by_pillow(path, page)) is not None:
            return pixels
        name = f"{getattr(page.compression, 'name', page.compression)} compression"
        name = name if page.bitspersample % 8 == 0 else f"packed pixels of {page.bitspersample} bits"
        advice = "save it uncompressed or with Deflate (ZIP), or `pip install imagecodecs`"
        raise InputError(f"{path}: no decoder for {name} is installed; {advice}.") from error


def _decode_by_pillow(path: Path, page: tifffile.TiffPage) -> np.ndarray | None:
    """Pixels as Pillow's libtiff decodes them (LZW, packed 12 bits), unless it changes their type."""
    with contextlib.suppress(InputError), decoding(path, "TIFF"), Image.open(path, formats=["TIFF"]) as image:
        image.seek(page.index)
        pixels = np.array(image)
        if pixels.shape == page.shape and pixels.dtype.newbyteorder("=") == page.dtype:
            return pixels
    return None


def _check_segments(path: Path, page: tifffile.TiffPage) -> None:
    """Raise `InputError` unless each strip or tile is in the file, and whole where it is not compressed."""
    with decoding(path, "TIFF"):
        offsets, counts = (np.array(n, dtype=np.int64) for n in (page.dataoffsets, page.databytecounts))
        segments, bits = math.prod(page.chunked), page.bitspersample * math.prod(page.shape)
        raw = int(page.compression) == 1
    end = path.stat().st_size
    if offsets.shape != (segments,) or counts.shape != (segments,):
        raise input_error("TIFF", f"of the {segments} strips or tiles that its size needs", offsets.size, path)
    missing = (offsets < 1) | (counts < 1) | (offsets > end) | (counts > end - offsets)
    if missing.any() or (raw and 8 * counts.sum() < bits):
        raise InputError(f"{path}: not a whole and valid TIFF: a part of page {page.index + 1} is not in the file.")
