"""Captures on disk: 2-D greyscale TIFF, PNG or .npy of uint8, uint16 or float32.

Their size and type are checked on the file's own declaration, before a pixel is decoded. To add a format, add its
suffix to `_FORMATS` with a function that reads it and one that writes it.
"""

import contextlib
import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import tifffile
from jaxtyping import Array, Float32, Shaped, UInt8, UInt16
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from ..base.errors import InputError, short_repr
from .disk import atomic_write, check_input, check_output, decoding
from .provenance import KEY, Provenance, write_sidecar
from .tiff import decode_page

Capture = UInt8[np.ndarray, "row column"] | UInt16[np.ndarray, "row column"] | Float32[np.ndarray, "row column"]

MAX_PIXELS = 10**9
_DTYPES = ("uint8", "uint16", "float32")
_COLOURS = {2: "colour (RGB)", 3: "a colour palette", 4: "grey with transparency", 6: "colour with transparency"}
_PHOTOMETRIC = {0: "grey with 0 as white", 2: "colour (RGB)", 3: "a colour palette", 32803: "a colour filter mosaic"}


def read_capture(path: str | os.PathLike[str], shape: tuple[int, int] | None = None) -> Capture:
    """A capture `(row, column)` in the file's own type: uint8, uint16 or float32.

    Parameters
    ----------
    path
        A `.tif`, `.tiff`, `.png` or `.npy` file.
    shape
        `(rows, columns)` that the image must have: the sensor's.

    Raises
    ------
    InputError
        If the file cannot be read, is none of these, is damaged, in colour, multi-page, of another size than
        `shape` or over 1e9 pixels, of another type, or holds a NaN or an infinity.
    """
    path = check_input(path)
    form = _FORMATS.get(path.suffix.lower())
    if form is None:
        raise InputError(f"{path}: found the suffix {short_repr(path.suffix)}, allowed: {', '.join(CAPTURE_SUFFIXES)}.")
    pixels = form.read(path, shape)
    pixels = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("="))
    if pixels.dtype.kind == "f" and not np.isfinite(pixels).all():
        row, column = np.argwhere(~np.isfinite(pixels))[0].tolist()
        raise InputError(f"{path}: found {pixels[row, column]} at pixel ({row}, {column}), allowed: finite numbers.")
    return pixels


def write_capture(
    path: str | os.PathLike[str], image: Shaped[Array | np.ndarray, "row column"], provenance: Provenance | None = None
) -> None:
    """Writes a capture as it is, by its suffix a TIFF, a PNG or an .npy; whole or not at all.

    Parameters
    ----------
    image
        `(row, column)` of uint8, uint16 or float32.
    provenance
        Where it comes from; beside an .npy.

    Raises
    ------
    InputError
        As `check_output`, and for float32 in PNG, which cannot hold it.
    ValueError
        If the image has another type.
    """
    path = check_output(path, CAPTURE_SUFFIXES)
    pixels = np.asarray(image)
    if pixels.dtype.name not in _DTYPES:
        raise ValueError(f"`image` must be one of {', '.join(_DTYPES)}, got {pixels.dtype.name}.")
    form = _FORMATS[path.suffix.lower()]
    if pixels.dtype.name not in form.dtypes:
        allowed = f"{', '.join(form.dtypes)} in {path.suffix}; use .tif or .npy"
        raise InputError(f"{path}: found pixels of type {pixels.dtype.name}, allowed: {allowed}.")
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        form.write(file, pixels, provenance)
    if path.suffix.lower() == ".npy":
        write_sidecar(path, provenance)


def _check_declared(path: Path, size: tuple[int, ...], dtype: str, shape: tuple[int, int] | None) -> None:
    found = " x ".join(str(n) for n in size)
    if len(size) != 2 or min(size) < 1:
        raise InputError(f"{path}: found an image of {found or 'no'} pixels, allowed: 2-D greyscale, rows x columns.")
    if shape is not None and size != tuple(shape):
        allowed = f"{shape[0]} x {shape[1]}, the sensor of the design"
        raise InputError(f"{path}: found {found} pixels (rows x columns), allowed: {allowed}.")
    if size[0] * size[1] > MAX_PIXELS:
        raise InputError(f"{path}: found {found} pixels (rows x columns), allowed: at most {MAX_PIXELS} in all.")
    if dtype not in _DTYPES:
        advice = "convert it without rescaling, e.g. in Fiji by Image > Type > 32-bit"
        raise InputError(f"{path}: found pixels of type {dtype}, allowed: {', '.join(_DTYPES)}; {advice}.")


def _read_tiff(path: Path, shape: tuple[int, int] | None) -> np.ndarray:
    with contextlib.ExitStack() as stack:
        with decoding(path, "TIFF"):
            # Without OME: a set of files is not a capture, and no other file is to be opened.
            tiff = stack.enter_context(tifffile.TiffFile(path, is_ome=False))
            page = tiff.pages.first
            planes = max(len(tiff.pages), tiff.series[0].size // max(page.size, 1))
            photometric, samples = int(page.photometric), page.samplesperpixel
            size, dtype = tuple(page.shape), str(page.dtype)
        if planes != 1:
            raise InputError(f"{path}: found {planes} pages, allowed: one; save the one wanted as its own file.")
        if photometric != 1 or samples != 1:
            found = _PHOTOMETRIC.get(photometric, f"{samples} samples a pixel, photometric {photometric}")
            raise InputError(f"{path}: found {found}, allowed: greyscale, one sample a pixel, 0 as black.")
        _check_declared(path, size, dtype, shape)
        return decode_page(path, page)


def _read_png(path: Path, shape: tuple[int, int] | None) -> np.ndarray:
    with path.open("rb") as file:
        header = file.read(26)
    if len(header) < 26 or header[:8] != b"\x89PNG\r\n\x1a\n" or header[12:16] != b"IHDR":
        raise InputError(f"{path}: not a whole and valid PNG: found another beginning.")
    columns, rows, bits, colour = struct.unpack(">IIBB", header[16:])
    if colour != 0:
        raise InputError(f"{path}: found {_COLOURS.get(colour, 'an unknown type of pixels')}, allowed: greyscale.")
    dtype = {8: "uint8", 16: "uint16"}.get(bits, f"{bits}-bit")
    _check_declared(path, (rows, columns), dtype, shape)
    with decoding(path, "PNG"), Image.open(path, formats=["PNG"]) as image:
        frames = getattr(image, "n_frames", 1)
        pixels = np.array(image)
    if frames != 1:
        raise InputError(f"{path}: found {frames} pages, allowed: one.")
    return pixels.astype(dtype)


def _read_npy(path: Path, shape: tuple[int, int] | None) -> np.ndarray:
    with decoding(path, ".npy of numbers"):
        pixels = np.lib.format.open_memmap(path, mode="r")
    _check_declared(path, pixels.shape, pixels.dtype.name, shape)
    return np.array(pixels)


def _write_tiff(file: BinaryIO, pixels: np.ndarray, provenance: Provenance | None) -> None:
    tifffile.imwrite(file, pixels, photometric="minisblack", metadata={KEY: dict(provenance)} if provenance else {})


def _write_png(file: BinaryIO, pixels: np.ndarray, provenance: Provenance | None) -> None:
    texts = PngInfo()
    if provenance:
        texts.add_itxt(KEY, json.dumps(dict(provenance), ensure_ascii=False))
    Image.fromarray(pixels).save(file, format="PNG", pnginfo=texts)


def _write_npy(file: BinaryIO, pixels: np.ndarray, provenance: Provenance | None) -> None:
    np.save(file, pixels, allow_pickle=False)


class _Format(NamedTuple):
    """How files of one suffix are read, given the size that they must have, and written, and what they can hold."""

    read: Callable[[Path, tuple[int, int] | None], np.ndarray]
    write: Callable[[BinaryIO, np.ndarray, Provenance | None], None]
    dtypes: tuple[str, ...] = _DTYPES


_FORMATS = {
    ".tif": _Format(_read_tiff, _write_tiff),
    ".tiff": _Format(_read_tiff, _write_tiff),
    ".png": _Format(_read_png, _write_png, ("uint8", "uint16")),
    ".npy": _Format(_read_npy, _write_npy),
}
CAPTURE_SUFFIXES = tuple(_FORMATS)
