"""Which page of which file holds which plane, as the OME-XML of an OME-TIFF declares."""

import math
from pathlib import Path, PurePath
from typing import NamedTuple
from xml.etree import ElementTree

from ..base.errors import InputError, input_error
from .files import TIFF_SUFFIXES, decoding

MAX_PLANES = 10**7
_AXES = "TCZ"


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
    lengths = {axis: int(pixels.attrib[f"Size{axis}"]) for axis in _AXES}
    samples = {int(channel.get("SamplesPerPixel", 1)) for channel in pixels.iterfind("{*}Channel")} or {1}
    if len(samples) == 1:
        # A colour image has as many channels as samples, in one plane.
        lengths["C"] //= samples.pop()
    count = math.prod(lengths.values())
    if min(lengths.values()) < 1 or count > MAX_PLANES:
        raise ValueError(f"sizes {lengths}")
    order = [axis for axis in pixels.attrib["DimensionOrder"] if axis in _AXES]
    if sorted(order) != sorted(_AXES):
        raise ValueError(f"order {order}")
    planes: list[tuple[Path, int] | None] = [None] * count
    elements = pixels.findall("{*}TiffData") or [ElementTree.Element("TiffData")]
    names = {name for each in elements if (name := _name(each))}
    for element in elements:
        uuid = element.find("{*}UUID")
        file, known = path, pages
        # A file that was renamed keeps its UUID; where none says which file is this one, one name alone must be.
        is_own = uuid is None or (own is not None and uuid.text == own) or _name(element) == path.name
        if not is_own and (own is not None or len(names) > 1 or (path.parent / (_name(element) or "")).is_file()):
            file, known = path.parent / (_name(element) or "unnamed"), MAX_PLANES
        page = int(element.get("IFD", 0))
        every = 1 if "IFD" in element.attrib else (known if uuid is None else count)
        number = int(element.get("PlaneCount", element.get("NumPlanes", every)))
        first, step = 0, 1
        for axis in order:
            first, step = first + int(element.get(f"First{axis}", 0)) * step, step * lengths[axis]
        for place in range(first, min(first + number, count)):
            if page + place - first < known:
                planes[_row_major(place, order, lengths)] = (file, page + place - first)
    size = int(pixels.attrib["SizeY"]), int(pixels.attrib["SizeX"])
    return OmePlanes({axis.lower(): n for axis, n in lengths.items()}, size, planes)


def _name(element: ElementTree.Element) -> str | None:
    """Name of the file that holds a plane, without folders: files elsewhere are not opened."""
    uuid = element.find("{*}UUID")
    name = None if uuid is None else uuid.get("FileName")
    return name and PurePath(name.replace("\\", "/")).name


def _row_major(place: int, order: list[str], lengths: dict[str, int]) -> int:
    """Number of a plane with z as the fastest axis, then c, from that in the declared order, fastest first."""
    at = {}
    for axis in order:
        place, at[axis] = divmod(place, lengths[axis])
    return (at["T"] * lengths["C"] + at["C"]) * lengths["Z"] + at["Z"]
