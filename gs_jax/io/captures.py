"""Reads and writes captures: greyscale TIFF, PNG or .npy of uint8, uint16 or float32, or one page or colour of a file.

Size and type are checked as the file declares them, before pixels are decoded. To add a format, add its suffix to
`CAPTURE_SUFFIXES`, how it is opened to `open_source`, and how it is written to `write_capture`.
"""

import contextlib
import json
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tifffile
from jaxtyping import Array, Float32, Shaped, UInt8, UInt16
from PIL import Image, ImageFile
from PIL.PngImagePlugin import PngInfo

from ..base.arrays import host_code
from ..base.errors import InputError, input_error, short_repr
from ..base.typing import PathLike
from .axes import UNNAMED, channel_names, stack_axis, stack_error
from .files import TIFF_SUFFIXES, atomic_write, check_input, check_output, check_suffix, decoding
from .provenance import KEY, Provenance, write_sidecar
from .tiff import Tiff, decode_plane, mosaic_pattern, open_tiff

Capture = UInt8[np.ndarray, "row column"] | UInt16[np.ndarray, "row column"] | Float32[np.ndarray, "row column"]
Images = Iterator[Shaped[np.ndarray, "row column"]]

CHANNELS = ("red", "green", "blue")
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
MAX_PIXELS = 10**9
DTYPES = ("uint8", "uint16", "float32")
CAPTURE_SUFFIXES = (*TIFF_SUFFIXES, ".png", ".npy")
# Files of other programs, which are read alone, by `open_vendor`.
HDF5_SUFFIXES = (".h5", ".hdf5")
VENDOR_SUFFIXES = (".nd2", ".czi", ".lif", *HDF5_SUFFIXES)
READ_SUFFIXES = (*CAPTURE_SUFFIXES, *VENDOR_SUFFIXES)
# Pages that are chosen for files that go together: the one that a file has for itself, though it may be one of a set;
# and all, if they are repeats of one image.
OWN, REPEATS = "own", "repeats"
# What files call colour, None if grey, by number in PNG and in TIFF.
_RGB, _MOSAIC = "colour (RGB)", 32803
_PNG_COLOURS = {0: None, 2: _RGB, 3: "a colour palette", 4: "grey with transparency", 6: _RGB}
_TIFF_COLOURS = {0: "grey with 0 as white", 1: None, 2: _RGB, 3: "a colour palette"}


class GreyError(InputError):
    """A channel was selected of an image that is grey."""


class Source(NamedTuple):
    """Images of an open file or store, in the order that it declares.

    `axes` are names and lengths of its axes before y and x, and `size` its rows and columns, as it declares them;
    `names` are those of the images, for messages; `read` reads the selected part of an image, counted from 0; `files`
    are those that are read, except the many of a Zarr store; `channels` are names along the axis c, if it declares any.
    """

    axes: list[tuple[str, int]]
    size: tuple[int, ...]
    names: list[str]
    read: Callable[[int, "Selection"], np.ndarray]
    files: list[Path]
    channels: Sequence[str] = ()


class Selection(NamedTuple):
    """The part of a file to read, as the arguments of `read_capture`, and the types of pixels that are allowed."""

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
        Page of a file of several, counted from 1; or "mean", the float32 mean of all.
    channel
        "red", "green" or "blue" of a colour image or a mosaic; of a file with an axis of channels the name of one, or
        its number from 1.
    bayer
        Colours of the first 2 x 2 pixels of a mosaic, row by row, such as "RGGB". The capture then has one pixel per
        2 x 2 cell; see `gs_jax.io.camera.Readout`.

    Raises
    ------
    InputError
        If the file cannot be read, is damaged, has another size than `shape` or over 1e9 pixels, another type, a NaN or
        an infinity, or has colours or pages of which none is chosen.

    Examples
    --------
    >>> gs.write_capture("capture.tif", np.zeros((200, 300), np.uint16))
    >>> gs.read_capture("capture.tif").shape
    (200, 300)
    """
    image = average(read_images(path, Selection(shape, page, channel, bayer)))
    return mosaic_channel(image, bayer, channel) if bayer else image


def average(images: Iterable[Shaped[np.ndarray, "row column"]]) -> Shaped[np.ndarray, "row column"]:
    """The float32 mean of images; a single one is returned unchanged."""
    images = iter(images)
    total, count = next(images), 1
    for image in images:
        total, count = np.add(total, image, dtype=np.float64), count + 1
    return total if count == 1 else (total / count).astype(np.float32)


def read_images(path: PathLike, selection: Selection = Selection()) -> Images:
    """Yield the selected pages of a capture, of a mosaic with all of its pixels; errors as `read_capture`."""
    path, page = check_input(path), selection.page
    check_suffix(path, READ_SUFFIXES)
    if selection.bayer:
        mosaic_sites(selection.bayer, selection.channel)
    shape = selection.shape and tuple(selection.shape)
    with open_source(path, page, selection.channel) as source:
        if page == REPEATS:
            check_stack(path, source, "tz", "; its images are not repeats of one")
        indices = _pages(path, len(source.names), page)
        yield from check_images(path, (source.read(index, selection._replace(shape=shape)) for index in indices))


@contextlib.contextmanager
def open_source(path: Path, page: int | str | None = None, channel: str | None = None) -> Iterator[Source]:
    """Open the images of a file, of one channel if it is given or the file is of another program.

    Those of a TIFF are its pages if one is chosen by its number.
    """
    suffix = path.suffix.lower()
    if suffix in VENDOR_SUFFIXES:
        from .vendors import open_vendor

        with open_vendor(path) as source:
            yield of_channel(path, source, channel)
    elif suffix in TIFF_SUFFIXES:
        with open_tiff(path) as tiff:
            source = _tiff_source(tiff, page)
            yield of_channel(path, source, channel) if channel else source
    elif suffix == ".npy":
        pixels = open_npy(path)
        pages = pixels if pixels.ndim == 3 and len(pixels) else pixels[None]
        names = [f"{path.name}, page {page}" for page in range(1, len(pages) + 1)]
        read = lambda index, selection: _read_array(path, np.asarray(pages[index]), selection)
        yield Source([(UNNAMED, len(pages))], pages.shape[1:], names, read, [path])
    else:
        yield Source([(UNNAMED, 1)], (), [path.name], lambda _, selection: _read_png(path, selection), [path])


def of_channel(path: Path, source: Source, channel: str | None) -> Source:
    """Take one channel of a source with an axis of channels, by its name or its number from 1; others are unchanged.

    Raises `InputError` unless one is chosen of several.
    """
    at = next((number for number, (name, _) in enumerate(source.axes) if name == "c"), None)
    if at is None:
        return source
    lengths = [length for _, length in source.axes]
    names = list(source.channels)
    names = names if len(names) == lengths[at] else [str(number) for number in range(1, lengths[at] + 1)]
    lower, wanted = [name.lower() for name in names], (channel or "").strip().lower()
    if wanted in lower:
        chosen = lower.index(wanted)
    elif wanted.isdecimal() and 1 <= int(wanted) <= len(names):
        chosen = int(wanted) - 1
    elif len(names) == 1:
        return source
    else:
        raise input_error("--channel", f"{listed(names)}, or a number from 1", short_repr(channel or "none"), path)
    axes = [axis for number, axis in enumerate(source.axes) if number != at]
    indices = np.take(np.arange(len(source.names)).reshape(lengths), chosen, at).ravel().tolist()

    def read(index: int, selection: Selection) -> np.ndarray:
        return source.read(indices[index], selection._replace(channel=None))

    return source._replace(
        axes=axes or [(UNNAMED, 1)], names=[source.names[k] for k in indices], read=read, channels=()
    )


def is_grey(path: Path, page: int | str | None, channel: str | None) -> bool:
    """Whether a file of captures is known to be grey: a channel named as a colour is then one along its axis."""
    if channel not in CHANNELS or path.suffix.lower() not in TIFF_SUFFIXES:
        return path.suffix.lower() in (".npy", *VENDOR_SUFFIXES)
    with open_source(path, page) as source:
        return any(name == "c" for name, _ in source.axes)


def listed(names: Sequence[str], most: int = 5) -> str:
    """The first few names as text."""
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")


def check_images(path: PathLike, images: Images) -> Images:
    """Yield images in the machine's byte order; `InputError` if their sizes differ or they are not finite."""
    size = None
    for pixels in images:
        size = size or pixels.shape
        if pixels.shape != size:
            given = f"{size_text(size)} and {size_text(pixels.shape)}"
            raise input_error("pages", "all of one size for --page mean", f"{given} pixels", path)
        pixels = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("="))
        if pixels.dtype.kind == "f" and not np.isfinite(pixels).all():
            row, column = np.argwhere(~np.isfinite(pixels))[0].tolist()
            raise input_error(f"pixel ({row}, {column})", "finite", pixels[row, column], path)
        yield pixels


def mosaic_sites(bayer: str, channel: str | None) -> list[tuple[int, int]]:
    """`(row, column)` of a channel in a 2 x 2 cell of a mosaic; `InputError` for an unknown pattern or channel."""
    if bayer not in PATTERNS:
        raise input_error("--bayer", ", ".join(PATTERNS), short_repr(bayer))
    if channel not in CHANNELS:
        raise input_error(f"--channel with --bayer {bayer}", ", ".join(CHANNELS), channel or "none")
    return [divmod(index, 2) for index, colour in enumerate(bayer) if colour == channel[0].upper()]


def mosaic_channel(
    mosaic: Shaped[np.ndarray, "row column"], bayer: str, channel: str | None
) -> Shaped[np.ndarray, "y x"]:
    """The image of one channel of a mosaic, a pixel per cell; green is a float32 mean. Errors as `mosaic_sites`."""
    rows, columns = (n // 2 * 2 for n in mosaic.shape)
    parts = [mosaic[row:rows:2, column:columns:2] for row, column in mosaic_sites(bayer, channel)]
    return parts[0] if len(parts) == 1 else np.asarray(np.mean(parts, axis=0, dtype=np.float32))


@host_code()
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
        Kept in the file, or beside an .npy.

    Raises
    ------
    InputError
        As `check_output`, and for float32 in PNG, which cannot hold it.
    ValueError
        If the image has another type.

    Examples
    --------
    >>> gs.write_capture("capture.png", np.full((200, 300), 16, np.uint16))
    """
    path = check_output(path, CAPTURE_SUFFIXES)
    pixels = np.asarray(image)
    if pixels.dtype.name not in DTYPES:
        raise ValueError(f"`image` must be one of {', '.join(DTYPES)}, got {pixels.dtype.name}.")
    suffix = path.suffix.lower()
    if suffix == ".png" and pixels.dtype == np.float32:
        raise input_error("pixels", "uint8, uint16 in .png (use .tif or .npy)", "float32", path)
    if suffix == ".npy":
        return write_npy(path, pixels, provenance)
    table = {KEY: dict(provenance)} if provenance else {}
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        if suffix == ".png":
            texts = PngInfo()
            for key, value in table.items():
                texts.add_itxt(key, json.dumps(value, ensure_ascii=False))
            Image.fromarray(pixels).save(file, format="PNG", pnginfo=texts)
        else:
            tifffile.imwrite(file, pixels, photometric="minisblack", metadata=table)


def write_npy(path: Path, pixels: np.ndarray, provenance: Provenance | None) -> None:
    """Write an .npy, with its provenance beside it."""
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.save(file, pixels, allow_pickle=False)
    write_sidecar(path, provenance)


def open_npy(path: Path) -> np.ndarray:
    """Map the numbers of an .npy; `InputError` if it has none."""
    with decoding(path, ".npy of numbers"):
        return np.lib.format.open_memmap(path, mode="r")


def size_text(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))


def check_declared(path: Path, size: tuple[int, ...], dtype: str, selection: Selection) -> None:
    """Raise `InputError` unless the size and the type that a file declares are allowed."""
    if len(size) != 2 or min(size) < 1:
        raise input_error("image", "2-D greyscale, rows x columns", f"{size_text(size) or 'no'} pixels", path)
    if selection.shape is not None and size != selection.shape:
        allowed = f"{size_text(selection.shape)}, the sensor of the design or what --roi and --binning leave"
        raise input_error("image", allowed, f"{size_text(size)} pixels (rows x columns)", path)
    if size[0] * size[1] > MAX_PIXELS:
        raise input_error("image", f"of at most {MAX_PIXELS} pixels", size_text(size), path)
    if dtype not in selection.dtypes:
        advice = "convert it without rescaling, e.g. in Fiji by Image > Type > 32-bit"
        raise input_error("pixels", ", ".join(selection.dtypes), f"{dtype}; {advice}", path)


def _pages(path: Path, count: int, page: int | str | None) -> range:
    """The selected pages, counted from 0."""
    if page in ("mean", REPEATS):
        return range(count)
    if page in (None, OWN) and count == 1:
        return range(1)
    if page in (None, OWN):
        choice = f"choose by --page 1 to {count}, or average repeated frames by --page mean"
        raise InputError(f"{path}: {count} pages; {choice}.")
    if not isinstance(page, int) or not 1 <= page <= count:
        raise input_error("--page", f"1 to {count}, or mean", f"--page {page} of {count} pages", path)
    return range(page - 1, page)


def check_colour(path: Path, colour: str | None, selection: Selection) -> None:
    """Raise `InputError` unless the selected channel exists; `colour` is what the file declares, None if it is grey."""
    channel, bayer, channels = selection.channel, selection.bayer, ", ".join(CHANNELS)
    if colour and colour != _RGB:
        raise input_error("image", "greyscale, one sample a pixel, 0 as black", colour, path)
    if colour and bayer:
        raise input_error("image", f"the grey image of a mosaic for --bayer {bayer}", colour, path)
    if colour and not channel:
        raise input_error("image", f"greyscale, or --channel {channels} of it", colour, path)
    if not colour and channel and not bayer:
        error = input_error("image", f"colour for --channel {channel}, or a mosaic with --bayer", "greyscale", path)
        raise GreyError(str(error))
    if channel and channel not in CHANNELS:
        raise input_error("--channel", channels, channel, path)


def _check_mosaic(path: Path, declared: str | None, bayer: str | None) -> None:
    if not bayer:
        allowed = f"greyscale, or --bayer {declared or 'RGGB (or another)'} with --channel {', '.join(CHANNELS)}"
        raise input_error("image", allowed, "a colour filter mosaic", path)
    if declared and declared != bayer:
        raise input_error("--bayer", f"{declared}, as the file declares", f"--bayer {bayer}", path)


def _select_channel(pixels: np.ndarray, channel: str | None, axis: int = -1) -> np.ndarray:
    return pixels if pixels.ndim == 2 else np.take(pixels, CHANNELS.index(channel or ""), axis)


def _read_tiff_page(tiff: Tiff, index: int, selection: Selection) -> np.ndarray:
    """The selected part of a page, counted from 0."""
    path = tiff.path
    with decoding(path, "TIFF"):
        page = tiff.file.pages[min(index, tiff.entries - 1)].aspage()
        photometric, samples = int(page.photometric), page.samplesperpixel
        size, dtype = tuple(page.shape), str(page.dtype)
        planar, declared = int(page.planarconfig) == 2, mosaic_pattern(page)
    unusual = f"{samples} samples a pixel, photometric {photometric}"
    colour = _TIFF_COLOURS.get(photometric, unusual)
    if photometric == 2 and samples >= 3 and len(size) == 3:
        size = size[1:] if planar else size[:2]
    elif samples != 1:
        colour = unusual
    if photometric == _MOSAIC:
        _check_mosaic(path, declared, selection.bayer)
    else:
        check_colour(path, colour, selection)
    check_declared(path, size, dtype, selection)
    return _select_channel(decode_plane(tiff, index), selection.channel, 0 if planar else -1)


def _tiff_source(tiff: Tiff, page: int | str | None) -> Source:
    # A page by its number is one of the file, whatever this says of it.
    axes, images = [(UNNAMED, tiff.count)], [(tiff.path, index) for index in range(tiff.count)]
    if page == OWN and tiff.count == 1:
        tiff.check_alone()
    elif not isinstance(page, int):
        axes, images = tiff.stack

    def read(index: int, selection: Selection) -> np.ndarray:
        return _read_tiff_page(*tiff.at(images[index], index), selection)

    names = [f"{image[0].name}, page {image[1] + 1}" if image else f"{tiff.path.name}, no page" for image in images]
    files = list(dict.fromkeys([tiff.path, *(image[0] for image in images if image)]))
    size = (tiff.first.imagelength, tiff.first.imagewidth)
    return Source(axes, size, names, read, files, channel_names(tiff.first.description))


def check_stack(path: Path, source: Source, axes: str, advice: str = "") -> None:
    """Raise `InputError` unless the images of a source follow each other along one of some axes, as `stack_axis`."""
    if stack_axis(source.axes, axes) is None or not source.names:
        names, lengths = zip(*source.axes, strict=True)
        raise stack_error(path, axes, (*lengths, *source.size), (*names, "y", "x"), advice)


def _read_png(path: Path, selection: Selection) -> np.ndarray:
    with path.open("rb") as file:
        header = file.read(26)
    if len(header) < 26 or header[:8] != b"\x89PNG\r\n\x1a\n" or header[12:16] != b"IHDR":
        raise InputError(f"{path}: not a whole and valid PNG: another signature.")
    columns, rows, bits, colour = struct.unpack(">IIBB", header[16:])
    check_colour(path, _PNG_COLOURS.get(colour, "an unknown type of pixels"), selection)
    dtype = {8: "uint8", 16: "uint16"}.get(bits, f"{bits}-bit")
    check_declared(path, (rows, columns), dtype, selection)
    with decoding(path, "PNG"), Image.open(path, formats=["PNG"]) as image:
        count = getattr(image, "n_frames", 1)
        pixels = _decode_png(path, image, bits)
    if count != 1:
        raise input_error("PNG", "one image", f"{count} pages", path)
    return _select_channel(pixels.astype(dtype), selection.channel)


def _decode_png(path: Path, image: ImageFile.ImageFile, bits: int) -> np.ndarray:
    """Pixels `(row, column)` or `(row, column, colour)`; Pillow reads 16-bit colour as its upper or its lower bytes."""
    if bits != 16 or len(image.getbands()) == 1:
        return np.array(image)
    (tile,), halves = image.tile, []
    for order in "BL":
        with Image.open(path, formats=["PNG"]) as half:
            half.tile = [tile._replace(args=f"{half.mode};16{order}")]
            halves.append(np.array(half).astype(np.uint16))
    return halves[0] << 8 | halves[1]


def _read_array(path: Path, pixels: np.ndarray, selection: Selection) -> np.ndarray:
    """An image of an array in a file, which is read after its size and type are checked."""
    check_colour(path, None, selection)
    check_declared(path, pixels.shape, pixels.dtype.name, selection)
    return np.array(pixels)


def summarise(path: Path) -> dict[str, str]:
    """Size, type, axes and use of a TIFF, a PNG or an .npy, from its header and its first page; empty for other files.

    Raises `InputError` if the file cannot be read as what its suffix says.
    """
    suffix, lines, is_stack = path.suffix.lower(), {}, True
    if suffix not in CAPTURE_SUFFIXES:
        return lines
    if suffix == ".npy":
        pixels = open_npy(path)
        pages = str(pixels.shape[0]) if pixels.ndim == 3 else "1"
        lines = {"pixels": size_text(pixels.shape[-2:]), "type": pixels.dtype.name, "pages": pages}
    elif suffix in TIFF_SUFFIXES:
        with open_tiff(path) as opened, decoding(path, "TIFF"), tifffile.TiffFile(path) as file:
            series, page = file.series[0], opened.first
            is_stack = opened.count == 1 or stack_axis(opened.stack.axes, "tz") is not None
            lines = {
                "pixels": size_text(page.shape[:2] if page.planarconfig == 1 else page.shape[-2:]),
                "type": str(page.dtype),
                "pages": str(opened.count),
                "axes": f"{series.axes}, {size_text(series.shape)}",
                "colours": tifffile.PHOTOMETRIC(page.photometric).name.lower(),
                "compression": tifffile.COMPRESSION(page.compression).name.lower(),
            }
    try:
        image = next(read_images(path))
        use = "a capture, or a PSF for `gs-jax deconvolve`"
        lines = {"pixels": size_text(image.shape), "type": image.dtype.name} | lines
    except InputError as error:
        use = str(error).removeprefix(f"{path}: ").removesuffix(f" ({path}).").rstrip(".")
        if lines.get("pages", "1") != "1" and is_stack:
            use = f"a recording, a stack of PSFs for `gs-jax deconvolve`, or a capture ({use})"
    return lines | {"use": use}
