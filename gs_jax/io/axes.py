"""Axes of stacks in all file formats, which of them may hold frames or planes, and which page holds which image.

The pages are declared by the OME-XML of an OME-TIFF, or by the index of an NDTiff data set of Micro-Manager.
"""

import contextlib
import math
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import tifffile

from ..base.errors import InputError, input_error
from .files import TIFF_SUFFIXES, decoding

# Name of an axis of which a file says nothing but its length.
UNNAMED = "?"
_TIME, _DEPTH, _CHANNEL = (
    ("t", "time", "frame", "frames"),
    ("z", "depth", "plane", "slice"),
    ("c", "channel", "channels", "wavelength"),
)
_LETTERS = {word: words[0] for words in (_TIME, _DEPTH, _CHANNEL) for word in words}
_LETTERS |= {"row": "y", "rows": "y", "column": "x", "columns": "x", "col": "x"}
# tifffile's letters of an axis that it made up, and names that xarray makes up.
_MADE_UP = ("", "q", "i", "none")
# Largest number of images that is believed.
_MAX_PLANES = 10**7
_OME_AXES, _NDTIFF_INDEX = "TCZ", "NDTiff.index"


def axis_letter(name: Any, kind: Any = None) -> str:
    """One name for an axis, `t`, `z`, `c`, `y` or `x`, whatever it is called; others in lower case, or `UNNAMED`.

    `kind` is the type that NGFF declares beside a name.
    """
    word = str(name).lower()
    if kind in ("time", "channel"):
        return str(kind)[0]
    return UNNAMED if word in _MADE_UP or word.startswith("dim_") else _LETTERS.get(word, word)


def stack_axis(lengths: Sequence[tuple[str, int]], allowed: str) -> int | None:
    """Number of the axis whose images follow each other: the only one longer than 1, or else the first.

    Parameters
    ----------
    lengths
        Name and length of each axis before y and x.
    allowed
        Names that it may have beside `UNNAMED`, such as "t", or "tz".

    Returns
    -------
    int or None
        None if several axes are longer than 1, or one with another name is.
    """
    longer = [(number, name) for number, (name, length) in enumerate(lengths) if length != 1]
    if not longer:
        return 0
    number, name = longer[0]
    return number if len(longer) == 1 and name in (*allowed, UNNAMED) else None


def stack_error(path: Path, allowed: str, shape: Sequence[int], names: Sequence[str], advice: str = "") -> InputError:
    """The error of a stack with other axes than `allowed`; `shape` and `names` are those of all of its axes."""
    first = allowed[-1]
    named = f" ({', '.join(names)})" if any(name not in (UNNAMED, "y", "x") for name in names) else ""
    expected = f"({first}, y, x), with axes of 1 alone between {first} and y"
    return input_error("array", expected, f"{' x '.join(map(str, shape))}{named}{advice}", path)


class OmePlanes(NamedTuple):
    """What OME-XML declares of one image.

    `lengths` are those of t, c and z; `size` is `(rows, columns)`; `planes` has for each plane, in the order
    t, c, z, the file and the page that hold it, from 0, or None where nothing is declared.
    """

    lengths: dict[str, int]
    size: tuple[int, int]
    planes: list[tuple[Path, int] | None]


def is_ome(description: str) -> bool:
    """Whether a description of a TIFF is OME-XML."""
    return description.lstrip().startswith(("<?xml", "<OME")) and "OME" in description[:1000]


def channel_names(description: str) -> list[str]:
    """Names of the channels of the first image that OME-XML describes; empty without all of them."""
    if not is_ome(description):
        return []
    with contextlib.suppress(ElementTree.ParseError):
        pixels = ElementTree.fromstring(description).find("{*}Image/{*}Pixels")
        names = [] if pixels is None else [each.get("Name", "") for each in pixels.iterfind("{*}Channel")]
        return names if all(names) else []
    return []


def read_ome(path: Path, description: str, pages: int) -> list[OmePlanes]:
    """Read the images of OME-XML that have planes in the file `path` of so many pages.

    Raises `InputError` if it is damaged, or says that another file of its set has it all.
    """
    with decoding(path, "OME-XML"):
        root = ElementTree.fromstring(description)
    if (elsewhere := root.find("{*}BinaryOnly")) is not None:
        file = str(elsewhere.get("MetadataFile"))
        advice = f"give the first, {file}" if Path(file).suffix in TIFF_SUFFIXES else "choose by --page"
        raise InputError(f"{path}: is a part of a set of files, which {file} describes; {advice}.")
    own = root.get("UUID")
    images = []
    for pixels in root.iterfind("{*}Image/{*}Pixels"):
        try:
            planes = _planes(path, pixels, own, pages)
        except (KeyError, ValueError, TypeError) as error:
            raise input_error(
                "OME-XML", "with sizes and `TiffData` as in its schema", f"{error!r:.80}", path
            ) from error
        if any(plane and plane[0] == path for plane in planes.planes):
            images.append(planes)
    return images


def _planes(path: Path, pixels: ElementTree.Element, own: str | None, pages: int) -> OmePlanes:
    lengths = {axis: int(pixels.attrib[f"Size{axis}"]) for axis in _OME_AXES}
    samples = {int(channel.get("SamplesPerPixel", 1)) for channel in pixels.iterfind("{*}Channel")} or {1}
    if len(samples) == 1:
        # A colour image has as many channels as samples, in one plane.
        lengths["C"] //= samples.pop()
    count = math.prod(lengths.values())
    if min(lengths.values()) < 1 or count > _MAX_PLANES:
        raise ValueError(f"sizes {lengths}")
    order = [axis for axis in pixels.attrib["DimensionOrder"] if axis in _OME_AXES]
    if sorted(order) != sorted(_OME_AXES):
        raise ValueError(f"order {order}")
    planes = np.full(count, None, object)
    elements = pixels.findall("{*}TiffData") or [ElementTree.Element("TiffData")]
    names = {name for element in elements if (name := _file_name(element))}
    for element in elements:
        uuid = element.find("{*}UUID")
        file, known = path, pages
        # A file that was renamed keeps its UUID; where none says which file is this one, one name alone must be.
        is_own = uuid is None or (own is not None and uuid.text == own) or _file_name(element) == path.name
        if not is_own and (own is not None or len(names) > 1 or (path.parent / (_file_name(element) or "")).is_file()):
            file, known = path.parent / (_file_name(element) or "unnamed"), _MAX_PLANES
        page = int(element.get("IFD", 0))
        every = 1 if "IFD" in element.attrib else (known if uuid is None else count)
        number = int(element.get("PlaneCount", element.get("NumPlanes", every)))
        first, step = 0, 1
        for axis in order:
            first, step = first + int(element.get(f"First{axis}", 0)) * step, step * lengths[axis]
        for index in range(first, min(first + number, count)):
            if page + index - first < known:
                planes[index] = (file, page + index - first)
    # The declared order has the fastest axis first; ours is t, c, z.
    slowest_first = order[::-1]
    planes = planes.reshape([lengths[axis] for axis in slowest_first])
    planes = planes.transpose([slowest_first.index(axis) for axis in _OME_AXES]).ravel().tolist()
    size = int(pixels.attrib["SizeY"]), int(pixels.attrib["SizeX"])
    return OmePlanes({axis.lower(): n for axis, n in lengths.items()}, size, planes)


def _file_name(element: ElementTree.Element) -> str | None:
    """Name of the file that holds a plane, without folders: files elsewhere are not opened."""
    uuid = element.find("{*}UUID")
    name = None if uuid is None else uuid.get("FileName")
    return name and PurePath(name.replace("\\", "/")).name


def read_ndtiff(path: Path) -> tuple[list[tuple[str, int]], list[tuple[Path, int] | None]] | None:
    """Axes and images of the data set of which `path` is a file, or None if it is of none.

    Axes are names with lengths; images are file and page, from 0, in the order of the axes, or None of one that the
    index lacks. Raises `InputError` if the index is damaged.
    """
    if not (index := path.with_name(_NDTIFF_INDEX)).is_file():
        return None
    with decoding(index, "NDTiff index"):
        entries = [(entry[0], PurePath(entry[1]).name) for entry in tifffile.read_ndtiff_index(index)]
        if path.name not in {name for _, name in entries}:
            return None
        # Positions along an axis are numbers, or names in the order in which they came.
        positions: dict[str, dict] = {}
        for at, _ in entries:
            for axis, position in at.items():
                positions.setdefault(axis, {}).setdefault(position)
        axes = sorted(positions, key=lambda axis: "tcz".find(_letter(axis)))
        numbers = {axis: _numbered(list(positions[axis])) for axis in axes}
        lengths = [(_letter(axis), 1 + max(numbers[axis].values())) for axis in axes]
        count = math.prod(length for _, length in lengths)
        if count > _MAX_PLANES:
            raise ValueError(f"{count} images")
        images: list[tuple[Path, int] | None] = [None] * count
        pages: dict[str, int] = {}
        size = dict(zip(axes, (length for _, length in lengths), strict=True))
        for at, name in entries:
            # Pages are in the order in which they were written.
            page = pages[name] = pages.get(name, -1) + 1
            number = 0
            for axis in axes:
                number = number * size[axis] + (numbers[axis][at[axis]] if axis in at else 0)
            images[number] = (path.with_name(name), page)
    return lengths or [("t", 1)], images


def _letter(axis: str) -> str:
    # Rows and columns are those of positions.
    return axis if axis in ("row", "column") else axis_letter(axis)


def _numbered(positions: list) -> dict:
    """Numbers of positions along an axis; where these are numbers, with room for those that the index lacks."""
    if all(isinstance(position, int) for position in positions):
        return {position: position - min(positions) for position in positions}
    return {position: number for number, position in enumerate(positions)}
