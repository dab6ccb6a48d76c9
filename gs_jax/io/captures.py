"""Captures on disk: greyscale TIFF, PNG or .npy of uint8, uint16 or float32, or a page or a colour of one.

Their size and type are checked on the file's own declaration, before a pixel is decoded. To add a format, add its
suffix to `_FORMATS` with a function that reads it and one that writes it.
"""

import contextlib
import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import tifffile
from jaxtyping import Array, Float32, Shaped, UInt8, UInt16
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from ..base.errors import InputError, short_repr
from ..typing import PathLike
from .files import atomic_write, check_input, check_output, decoding
from .provenance import KEY, Provenance, write_sidecar
from .tiff import declared_mosaic, decode_plane, decode_png, page_count

Capture = UInt8[np.ndarray, "row column"] | UInt16[np.ndarray, "row column"] | Float32[np.ndarray, "row column"]

MAX_PIXELS = 10**9
CHANNELS = ("red", "green", "blue")
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
DTYPES = ("uint8", "uint16", "float32")
_RGB, _MOSAIC = "colour (RGB)", 32803
_COLOURS = {0: None, 2: _RGB, 3: "a colour palette", 4: "grey with transparency", 6: _RGB}
_PHOTOMETRIC = {0: "grey with 0 as white", 1: None, 2: _RGB, 3: "a colour palette"}


class Wanted(NamedTuple):
    """What of a file is asked for: as `read_capture`, and types of pixels."""

    shape: tuple[int, ...] | None = None
    page: int | str | None = None
    channel: str | None = None
    bayer: str | None = None
    dtypes: tuple[str, ...] = DTYPES


def read_capture(
    path: PathLike,
    shape: tuple[int, int] | None = None,
    *,
    page: int | str | None = None,
    channel: str | None = None,
    bayer: str | None = None,
) -> Capture:
    """A capture `(row, column)` in the file's own type: uint8, uint16 or float32.

    *File.*

    Parameters
    ----------
    path
        A `.tif`, `.tiff`, `.png` or `.npy` file.
    shape
        `(rows, columns)` that the image in the file must have: the sensor's.
    page
        Of a file of several, which count from 1 in the file's order; or "mean", of all, float32.
    channel
        "red", "green" or "blue" of a colour image, or of the mosaic that `bayer` says it is.
    bayer
        Colours of the first pixels of a mosaic, row by row, such as "RGGB"; the capture is then of its cells of 2 x 2
        pixels, as `gs_jax.io.camera.Readout` says, and its pixels are where `Readout.sensor` says.

    Raises
    ------
    InputError
        If the file cannot be read, is none of these, is damaged, of another size than `shape` or over 1e9 pixels, of
        another type, holds a NaN or an infinity, or is in colour or has several pages and it is not said which to take.

    Examples
    --------
    >>> import gs_jax as gs, numpy as np
    >>> gs.write_capture("capture.tif", np.zeros((200, 300), np.uint16))
    >>> gs.read_capture("capture.tif").shape
    (200, 300)
    """
    image = averaged(frames(path, shape, page=page, channel=channel, bayer=bayer))
    return channel_of(image, bayer, channel) if bayer else image


def averaged(images: Iterator[Shaped[np.ndarray, "row column"]]) -> Shaped[np.ndarray, "row column"]:
    """The mean of images, float32; a single one as it is."""
    total, count = next(images), 1
    for image in images:
        total, count = np.add(total, image, dtype=np.float64), count + 1
    return total if count == 1 else (total / count).astype(np.float32)


def frames(
    path: PathLike,
    shape: tuple[int, int] | None = None,
    *,
    page: int | str | None = None,
    channel: str | None = None,
    bayer: str | None = None,
    dtypes: tuple[str, ...] = DTYPES,
) -> Iterator[Shaped[np.ndarray, "row column"]]:
    """The pages of a capture that `page` names, one after the other; of a mosaic, all of its pixels.

    Parameters and errors are those of `read_capture`.
    """
    path = check_input(path)
    form = _FORMATS.get(path.suffix.lower())
    if form is None:
        raise InputError(f"{path}: found the suffix {short_repr(path.suffix)}, allowed: {', '.join(CAPTURE_SUFFIXES)}.")
    if bayer:
        sites(bayer, channel)
    wanted = Wanted(shape and tuple(shape), page, channel, bayer, dtypes)
    yield from checked(path, form.read(path, wanted))


def checked(
    path: PathLike, images: Iterator[Shaped[np.ndarray, "row column"]]
) -> Iterator[Shaped[np.ndarray, "row column"]]:
    """Images of a file in the machine's byte order; `InputError` if they are of several sizes or not finite."""
    size = None
    for pixels in images:
        size = size or pixels.shape
        if pixels.shape != size:
            found = " and ".join(" x ".join(map(str, each)) for each in (size, pixels.shape))
            raise InputError(f"{path}: found pages of {found} pixels for --page mean, allowed: all of one size.")
        pixels = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("="))
        if pixels.dtype.kind == "f" and not np.isfinite(pixels).all():
            row, column = np.argwhere(~np.isfinite(pixels))[0].tolist()
            raise InputError(
                f"{path}: found {pixels[row, column]} at pixel ({row}, {column}), allowed: finite numbers."
            )
        yield pixels


def write_capture(
    path: PathLike, image: Shaped[Array | np.ndarray, "row column"], provenance: Provenance | None = None
) -> None:
    """Writes a capture as it is, by its suffix a TIFF, a PNG or an .npy; whole or not at all.

    *File.*

    Parameters
    ----------
    path
        Ends in `.tif`, `.tiff`, `.png` or `.npy`.
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

    Examples
    --------
    >>> import gs_jax as gs, numpy as np
    >>> gs.write_capture("capture.png", np.full((200, 300), 16, np.uint16))
    """
    path = check_output(path, CAPTURE_SUFFIXES)
    pixels = np.asarray(image)
    if pixels.dtype.name not in DTYPES:
        raise ValueError(f"`image` must be one of {', '.join(DTYPES)}, got {pixels.dtype.name}.")
    form = _FORMATS[path.suffix.lower()]
    if pixels.dtype.name not in form.dtypes:
        allowed = f"{', '.join(form.dtypes)} in {path.suffix}; use .tif or .npy"
        raise InputError(f"{path}: found pixels of type {pixels.dtype.name}, allowed: {allowed}.")
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        form.write(file, pixels, provenance)
    if path.suffix.lower() == ".npy":
        write_sidecar(path, provenance)


def check_declared(path: Path, size: tuple[int, ...], dtype: str, wanted: Wanted) -> None:
    """`InputError` unless the size and the type that a file declares are what is wanted."""
    found, shape = " x ".join(str(n) for n in size), wanted.shape
    if len(size) != 2 or min(size) < 1:
        raise InputError(f"{path}: found an image of {found or 'no'} pixels, allowed: 2-D greyscale, rows x columns.")
    if shape is not None and size != shape:
        allowed = f"{shape[0]} x {shape[1]}, the sensor of the design, or what --roi and --binning leave of it"
        raise InputError(f"{path}: found {found} pixels (rows x columns), allowed: {allowed}.")
    if size[0] * size[1] > MAX_PIXELS:
        raise InputError(f"{path}: found {found} pixels (rows x columns), allowed: at most {MAX_PIXELS} in all.")
    if dtype not in wanted.dtypes:
        advice = "convert it without rescaling, e.g. in Fiji by Image > Type > 32-bit"
        raise InputError(f"{path}: found pixels of type {dtype}, allowed: {', '.join(wanted.dtypes)}; {advice}.")


def _pages(path: Path, count: int, page: int | str | None) -> range:
    """The pages to read, counted from 0."""
    if page == "mean":
        return range(count)
    if page is None and count == 1:
        return range(1)
    if page is None:
        choice = f"choose by --page 1 to {count}, or average repeated frames by --page mean"
        raise InputError(f"{path}: found {count} pages, allowed: one; {choice}.")
    if not isinstance(page, int) or not 1 <= page <= count:
        raise InputError(f"{path}: found --page {page} for {count} pages, allowed: 1 to {count}, or mean.")
    return range(page - 1, page)


def check_colour(path: Path, colour: str | None, wanted: Wanted) -> None:
    """`InputError` unless the channel that is wanted is there; `colour` is what the file says, None if it is grey."""
    if colour and colour != _RGB:
        raise InputError(f"{path}: found {colour}, allowed: greyscale, one sample a pixel, 0 as black.")
    if colour and wanted.bayer:
        raise InputError(f"{path}: found colour for --bayer {wanted.bayer}, allowed: a grey image of the mosaic.")
    if colour and not wanted.channel:
        raise InputError(f"{path}: found {colour}, allowed: greyscale, or --channel {', '.join(CHANNELS)} of it.")
    if not colour and wanted.channel and not wanted.bayer:
        allowed = "colour, or --bayer with it for a mosaic"
        raise InputError(f"{path}: found greyscale for --channel {wanted.channel}, allowed: {allowed}.")
    if wanted.channel and wanted.channel not in CHANNELS:
        raise InputError(f"{path}: found --channel {wanted.channel}, allowed: {', '.join(CHANNELS)}.")


def _taken(pixels: np.ndarray, wanted: Wanted, colours_first: bool = False) -> np.ndarray:
    """The image that is wanted of what a page holds."""
    if pixels.ndim == 2:
        return pixels
    return np.moveaxis(pixels, 0 if colours_first else -1, 0)[CHANNELS.index(wanted.channel or "")]


@contextlib.contextmanager
def opened_tiff(path: Path) -> Iterator[tuple[tifffile.TiffFile, int]]:
    """A TIFF, and how many pages it has."""
    with contextlib.ExitStack() as stack:
        with decoding(path, "TIFF"):
            # Without OME: a set of files is not a capture, and no other file is to be opened.
            tiff = stack.enter_context(tifffile.TiffFile(path, is_ome=False))
            count = page_count(tiff)
        yield tiff, count


def tiff_page(path: Path, tiff: tifffile.TiffFile, index: int, wanted: Wanted) -> Shaped[np.ndarray, "row column"]:
    """What is wanted of a page, counted from 0."""
    with decoding(path, "TIFF"):
        page = tiff.pages[min(index, len(tiff.pages) - 1)].aspage()
        photometric, samples = int(page.photometric), page.samplesperpixel
        size, dtype = tuple(page.shape), str(page.dtype)
        planar, declared = int(page.planarconfig) == 2, declared_mosaic(page)
    colour = _PHOTOMETRIC.get(photometric, f"{samples} samples a pixel, photometric {photometric}")
    if photometric == 2 and samples >= 3 and len(size) == 3:
        size = size[1:] if planar else size[:2]
    elif samples != 1:
        colour = f"{samples} samples a pixel, photometric {photometric}"
    _check_mosaic(path, declared, wanted) if photometric == _MOSAIC else check_colour(path, colour, wanted)
    check_declared(path, size, dtype, wanted)
    return _taken(decode_plane(path, tiff, index), wanted, planar)


def _read_tiff(path: Path, wanted: Wanted) -> Iterator[np.ndarray]:
    with opened_tiff(path) as (tiff, count):
        for index in _pages(path, count, wanted.page):
            yield tiff_page(path, tiff, index, wanted)


def _check_mosaic(path: Path, declared: str | None, wanted: Wanted) -> None:
    if not wanted.bayer:
        allowed = f"greyscale, or --bayer {declared or 'RGGB (or another)'} with --channel {', '.join(CHANNELS)}"
        raise InputError(f"{path}: found a colour filter mosaic, allowed: {allowed}.")
    if declared and declared != wanted.bayer:
        raise InputError(f"{path}: found --bayer {wanted.bayer}, allowed: {declared}, as the file says.")


def _read_png(path: Path, wanted: Wanted) -> Iterator[np.ndarray]:
    with path.open("rb") as file:
        header = file.read(26)
    if len(header) < 26 or header[:8] != b"\x89PNG\r\n\x1a\n" or header[12:16] != b"IHDR":
        raise InputError(f"{path}: not a whole and valid PNG: found another beginning.")
    columns, rows, bits, colour = struct.unpack(">IIBB", header[16:])
    check_colour(path, _COLOURS.get(colour, "an unknown type of pixels"), wanted)
    dtype = {8: "uint8", 16: "uint16"}.get(bits, f"{bits}-bit")
    check_declared(path, (rows, columns), dtype, wanted)
    with decoding(path, "PNG"), Image.open(path, formats=["PNG"]) as image:
        count = getattr(image, "n_frames", 1)
        pixels = decode_png(path, image, bits)
    if count != 1:
        raise InputError(f"{path}: found {count} pages, allowed: one in a PNG.")
    _pages(path, 1, wanted.page)
    yield _taken(pixels.astype(dtype), wanted)


def _read_npy(path: Path, wanted: Wanted) -> Iterator[np.ndarray]:
    with decoding(path, ".npy of numbers"):
        pixels = np.lib.format.open_memmap(path, mode="r")
    pages = pixels if pixels.ndim == 3 and len(pixels) else pixels[None]
    check_colour(path, None, wanted)
    for index in _pages(path, len(pages), wanted.page):
        check_declared(path, pages[index].shape, pixels.dtype.name, wanted)
        yield _taken(np.array(pages[index]), wanted)


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
    """How files of one suffix are read, page by page, and written, and what they can hold."""

    read: Callable[[Path, Wanted], Iterator[np.ndarray]]
    write: Callable[[BinaryIO, np.ndarray, Provenance | None], None]
    dtypes: tuple[str, ...] = DTYPES


_FORMATS = {
    ".tif": _Format(_read_tiff, _write_tiff),
    ".tiff": _Format(_read_tiff, _write_tiff),
    ".png": _Format(_read_png, _write_png, ("uint8", "uint16")),
    ".npy": _Format(_read_npy, _write_npy),
}
CAPTURE_SUFFIXES = tuple(_FORMATS)


def sites(bayer: str, channel: str | None) -> list[tuple[int, int]]:
    """`(row, column)` in a cell of the pixels of a channel.

    Raises
    ------
    InputError
        If there is no such pattern or channel.
    """
    if bayer not in PATTERNS:
        raise InputError(f"--bayer: found {short_repr(bayer)}, allowed: {', '.join(PATTERNS)}.")
    if channel not in CHANNELS:
        raise InputError(
            f"--bayer {bayer}: found {f'--channel {channel}' if channel else 'no --channel'}, allowed: "
            f"--channel {', '.join(CHANNELS)}."
        )
    return [divmod(place, 2) for place, colour in enumerate(bayer) if colour == channel[0].upper()]


def channel_of(mosaic: Shaped[np.ndarray, "row column"], bayer: str, channel: str | None) -> Shaped[np.ndarray, "y x"]:
    """The image of a mosaic's cells in one colour: see `Readout`. Green is float32; errors as `sites`."""
    rows, columns = (n // 2 * 2 for n in mosaic.shape)
    parts = [mosaic[row:rows:2, column:columns:2] for row, column in sites(bayer, channel)]
    return parts[0] if len(parts) == 1 else np.asarray(np.mean(parts, axis=0, dtype=np.float32))
