"""TIFF: one page decoded or refused in words, and a second description of a file."""

import math
from pathlib import Path

import numpy as np
import tifffile

from ..base.errors import InputError
from .disk import decoding

# TIFF's number of a description, and of the tag after it, whose place a second one takes.
_DESCRIPTION, _AFTER = 270, 271


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
        advice = "save it uncompressed or with Deflate (ZIP), or `pip install imagecodecs`"
        raise InputError(f"{path}: found {found} compression, whose decoder is not installed; {advice}.") from error


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
