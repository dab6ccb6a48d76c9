"""Opens TIFF files, with the order that they declare of their pages, and decodes these; refuses damaged ones in words.

A page is numbered as in the file, from 0. The images of a stack are in the order of its axes, and may lie in further
files of its set.
"""

import contextlib
import math
import re
import warnings
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tifffile
from PIL import Image, UnidentifiedImageError

from ..base.errors import InputError, InputWarning, input_error
from .axes import UNNAMED, axis_letter, is_ome, read_ndtiff, read_ome
from .files import decoding
from .names import natural_order

# Tags of TIFF/EP: the size of a mosaic's cell and its colours, which are numbered as in "RGB".
_CELL, _PATTERN = 33421, 33422
# Its number among compressions.
_LZW = 5
# Those of which libtiff knows that they are of differences: LZW, Deflate, LZMA, Zstandard. With others it ignores it.
_WITH_DIFFERENCES = (_LZW, 8, 32946, 34925, 50000)
# Keys of ImageJ and of Micro-Manager for axes t, z and c.
_IMAGEJ, _MICRO_MANAGER = ("frames", "slices", "channels"), ("Frames", "Slices", "Channels")
# Files of one recording that Micro-Manager continues under further names; the first has no number.
_CONTINUED = re.compile(r"(.*(?:MMStack|NDTiffStack).*?)(_\d+)?((?:\.ome)?\.tiff?)", re.IGNORECASE)
# The type of pixels as libtiff leaves them, in the machine's order of bytes, by Pillow's mode.
_NATIVE = {"L": "L", "I;16": "I;16N", "I;16B": "I;16N", "F": "F;32NF"}


class Stack(NamedTuple):
    """Images of a TIFF in the order that it declares.

    `axes` are names and lengths of its axes before y and x; `images` has file and page of each image, or None of one
    that is missing between others.
    """

    axes: list[tuple[str, int]]
    images: list[tuple[Path, int] | None]


class Tiff:
    """An open TIFF. `count` is the number of its pages, those of a stack with one entry for all included."""

    def __init__(self, path: Path, exits: contextlib.ExitStack, kind: str):
        self.path, self._exits, self._others = path, exits, {}
        with decoding(path, kind):
            # Without what tifffile makes of metadata that name further files: they may be anywhere.
            file = tifffile.TiffFile(path, is_ome=False, is_mmstack=False, is_ndtiff=False)
            self.file = exits.enter_context(file)
            if not len(self.file.pages):
                raise ValueError("it has no page")
            self.first = self.file.pages.first
            self.entries = self.count = len(self.file.pages)
            self._axes = _declared_axes(self.file)
            if self.entries == 1 and int(self.first.compression) == 1 and self.first.is_contiguous:
                room = (path.stat().st_size - self.first.dataoffsets[0]) // max(self.first.nbytes, 1)
                self.count = max(1, min(math.prod(length for _, length in self._axes), room))

    @cached_property
    def stack(self) -> Stack:
        """The images that the file declares, in their order, with a warning if fewer are there.

        Raises `InputError` if what it declares does not fit to its pages.
        """
        if is_ome(self.first.description) and (stack := self._ome_stack()):
            return stack
        if indexed := read_ndtiff(self.path):
            return self._of_set(*indexed)
        pages = self._full_pages()
        declared = math.prod(length for _, length in self._axes)
        if declared <= len(pages):
            self._warn_if_cut(len(pages))
        if declared == 1:
            return self._continued(Stack([(UNNAMED, len(pages))], [(self.path, page) for page in pages]))
        if declared < len(pages):
            raise input_error("pages", f"{declared}, as the file declares; choose by --page", len(pages), self.path)
        return self._continued(self._without_missing(self._axes, [(self.path, page) for page in pages], declared))

    def at(self, image: tuple[Path, int] | None, number: int) -> tuple["Tiff", int]:
        """The open file of an image of the stack, and its page; `InputError` if it is missing."""
        if image is None:
            raise InputError(f"{self.path}: image {number + 1} is not in the file, which declares it.")
        path, page = image
        if path == self.path:
            return self, page
        if path not in self._others:
            self._others[path] = self._exits.enter_context(open_tiff(path))
        return self._others[path], page

    def _ome_stack(self) -> Stack | None:
        """The images that OME-XML declares; None if it is damaged and the file has a single page."""
        try:
            images = read_ome(self.path, self.first.description, self.count)
        except InputError:
            # Of a single page nothing has to be known, unless it is one of a set.
            if self.count > 1 or "BinaryOnly" in self.first.description:
                raise
            return None
        if not images and self.count > 1:
            raise input_error("OME-XML", f"about the file's {self.count} pages", "none of them", self.path)
        if len(images) != 1:
            planes = [plane for image in images for plane in image.planes]
            return Stack([("image", len(images)), *images[0].lengths.items()], planes) if images else None
        size, (lengths, declared, planes) = (self.first.imagelength, self.first.imagewidth), images[0]
        if declared != size:
            given = "{} x {} pixels in OME-XML".format(*declared)
            raise input_error("image", "{} x {} pixels, as its page".format(*size), given, self.path)
        return self._of_set(list(lengths.items()), planes)

    def _of_set(self, axes, images: list[tuple[Path, int] | None]) -> Stack:
        """A stack of images in this file and others, some of which may not be there."""
        counts = {self.path: self.count}
        for file in {image[0] for image in images if image} - {self.path}:
            if file.is_file():
                with open_tiff(file) as other:
                    counts[file] = other.count
        there = [image if image and image[1] < counts.get(image[0], 0) else None for image in images]
        lost = sorted({image[0].name for image in images if image and image[0] not in counts})
        return self._continued(self._without_missing(axes, there, len(there), lost))

    def _without_missing(self, axes, images: list, declared: int, lost: list[str] | None = None) -> Stack:
        """A stack without the missing images at its end, about which it warns."""
        while images and images[-1] is None:
            images = images[:-1]
        if len(images) < declared:
            where = f"; {', '.join(lost)} is missing" if lost else ""
            text = f"{self.path}: declares {declared} images and holds {len(images)}, which are used{where}."
            warnings.warn(InputWarning(text), stacklevel=2)
            if len([length for _, length in axes if length != 1]) == 1:
                axes = [(name, length if length == 1 else len(images)) for name, length in axes]
        return Stack(axes, images)

    def _continued(self, stack: Stack) -> Stack:
        """A stack with the images of files that continue this one by their names alone."""
        match = _CONTINUED.fullmatch(self.path.name)
        if not match:
            return stack
        begin, number, end = match.groups()
        first = self.path.with_name(f"{begin}{end}")
        if number and first.is_file():
            raise InputError(f"{self.path}: is a part of a set of files; give the first, {first.name}.")
        known = {image[0] for image in stack.images if image}
        pattern = re.compile(rf"{re.escape(begin)}_\d+{re.escape(end)}", re.IGNORECASE)
        others = [path for path in self.path.parent.iterdir() if pattern.fullmatch(path.name) and path not in known]
        if number or not others:
            return stack
        long = [place for place, (_, length) in enumerate(stack.axes) if length != 1] or [0]
        images = list(stack.images)
        for path in natural_order(others):
            with open_tiff(path) as other:
                images += [(path, page) for page in range(other.count)]
        if len(long) == 1:
            axes = [(name, len(images) if place == long[0] else n) for place, (name, n) in enumerate(stack.axes)]
        else:
            axes = [("file", 1 + len(others)), *stack.axes]
        return Stack(axes, images)

    def _full_pages(self) -> list[int]:
        """Pages that are no smaller copies of others, nor masks; the second page tells whether there are any."""
        with decoding(self.path, "TIFF"):
            is_full = lambda page: not self.file.pages[page].aspage().subfiletype & 0b101
            has_reduced = self.entries > 1 and not is_full(1)
            return [page for page in range(self.count) if not page or not has_reduced or is_full(page)]

    def check_alone(self) -> None:
        """Raise `InputError` if a file of one page had more, and is cut off; other files of its set do not matter."""
        if (declared := math.prod(length for _, length in self._axes)) > self.count or self._is_cut():
            number = f"declares {declared} images and " if declared > 1 else ""
            raise InputError(f"{self.path}: {number}is cut off after its first.")

    def _is_cut(self) -> bool:
        """Whether the entry of a next page is beyond the end of the file."""
        with decoding(self.path, "TIFF"):
            place, handle = self.file.pages.next_page_offset, self.file.filehandle
            handle.seek(place or 0)
            return place is not None and any(handle.read(self.file.tiff.offsetsize))

    def _warn_if_cut(self, count: int) -> None:
        if self._is_cut():
            rest = "page, which is" if count == 1 else f"{count} pages, which are"
            warnings.warn(InputWarning(f"{self.path}: is cut off after its first {rest} used."), stacklevel=2)


@contextlib.contextmanager
def open_tiff(path: Path, kind: str = "TIFF") -> Iterator[Tiff]:
    """Open a TIFF, and when they are asked for, the other files of its set; errors call it `kind`."""
    with contextlib.ExitStack() as exits:
        yield Tiff(path, exits, kind)


def _declared_axes(tiff: tifffile.TiffFile) -> list[tuple[str, int]]:
    """Names and lengths of the axes before y and x that a file without OME-XML declares; none if it says nothing."""
    first = tiff.pages.first
    if imagej := tiff.imagej_metadata:
        lengths = [int(imagej.get(key, 1)) for key in _IMAGEJ]
        if lengths[2] == first.samplesperpixel:
            lengths[2] = 1
        # Unless it is a hyperstack, ImageJ calls any stack slices.
        names = "tzc" if imagej.get("hyperstack") or lengths[0] > 1 or lengths[2] > 1 else UNNAMED * 3
        declared = math.prod(lengths)
        return list(zip(names, lengths, strict=True)) if declared > 1 else [(UNNAMED, int(imagej.get("images", 1)))]
    if tiff.is_micromanager:
        summary = {}
        # Single images have the tag without the metadata.
        with contextlib.suppress(ValueError, KeyError, IndexError):
            summary = (tiff.micromanager_metadata or {}).get("Summary", {})
        lengths = [int(summary.get(key) or 1) for key in _MICRO_MANAGER]
        return list(zip("tzc", lengths, strict=True))
    series = tiff.series
    axes = [
        (axis_letter(name), length)
        for name, length in zip(series[0].axes, series[0].shape, strict=True)
        if name not in "YXS"
    ]
    if len({(each.axes, each.shape) for each in series}) > 1 or not series:
        return []
    return [(UNNAMED, len(series)), *axes] if len(series) > 1 else axes


def mosaic_pattern(page: tifffile.TiffPage) -> str | None:
    """Colours of the first 2 x 2 pixels of a mosaic, as `Readout.bayer`, if the file declares them."""
    cell, pattern = (page.tags.get(code) for code in (_CELL, _PATTERN))
    if cell is None or pattern is None or tuple(cell.value) != (2, 2):
        return None
    return "".join("RGB"[number] for number in bytes(pattern.value))


def decode_plane(tiff: Tiff, index: int) -> np.ndarray:
    """Pixels of a page, whose declared size has been checked."""
    if index < tiff.entries:
        return decode_page(tiff.path, tiff.file.pages[index].aspage())
    first = tiff.first
    _check_segments(tiff.path, first)
    with decoding(tiff.path, "TIFF"):
        dtype = np.dtype(first.dtype).newbyteorder(tiff.file.byteorder)
        return np.array(np.memmap(tiff.path, dtype, "r", first.dataoffsets[0] + index * first.nbytes, first.shape))


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
        # Decoders that are not installed are imported, or looked for in imagecodecs, when they are called.
        if "imagecodecs" not in str(error) and not isinstance(error.__cause__, ImportError):
            raise
        if (pixels := _decode_by_pillow(path, page)) is not None:
            return pixels
        name = f"{getattr(page.compression, 'name', page.compression)} compression"
        name = name if page.bitspersample % 8 == 0 else f"packed pixels of {page.bitspersample} bits"
        advice = "save it uncompressed or with Deflate (ZIP), or `pip install imagecodecs`"
        raise InputError(f"{path}: no decoder for {name} is installed; {advice}.") from error


def _decode_by_pillow(path: Path, page: tifffile.TiffPage) -> np.ndarray | None:
    """Pixels as Pillow's libtiff decodes them (LZW, packed 12 bits), unless it does not, or changes their type."""
    if page.predictor != 1 and int(page.compression) not in _WITH_DIFFERENCES:
        return None
    try:
        with decoding(path, "TIFF"), Image.open(path, formats=["TIFF"]) as image:
            image.seek(page.index)
            # Pillow takes float32 for big-endian where the file is, though libtiff has turned it.
            if image.mode in _NATIVE and all(tile.codec_name == "libtiff" for tile in image.tile):
                image.tile = [tile._replace(args=(_NATIVE[image.mode], *(tile.args or ())[1:])) for tile in image.tile]
            pixels = np.array(image)
    except InputError as error:
        # Every libtiff has LZW: what it cannot decode is damaged, unless Pillow has no such pixels.
        cause = error.__cause__
        if (
            int(page.compression) == _LZW
            and isinstance(cause, OSError)
            and not isinstance(cause, UnidentifiedImageError)
        ):
            raise
        return None
    return pixels if pixels.shape == page.shape and pixels.dtype.newbyteorder("=") == page.dtype else None


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
