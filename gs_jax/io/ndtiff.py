"""Which page of which file holds which image, as the index of an NDTiff data set of Micro-Manager declares."""

import math
from pathlib import Path, PurePath

import tifffile

from .axes import axis_letter
from .files import decoding
from .ome import MAX_PLANES

_INDEX = "NDTiff.index"


def read_ndtiff(path: Path) -> tuple[list[tuple[str, int]], list[tuple[Path, int] | None]] | None:
    """Axes and images of the data set of which `path` is a file, or None if it is of none.

    Axes are names with lengths; images are file and page, from 0, in the order of the axes, or None of one that the
    index lacks. Raises `InputError` if the index is damaged.
    """
    if not (index := path.with_name(_INDEX)).is_file():
        return None
    with decoding(index, "NDTiff index"):
        entries = [(entry[0], PurePath(entry[1]).name) for entry in tifffile.read_ndtiff_index(index)]
        if path.name not in {name for _, name in entries}:
            return None
        # Places along an axis are numbers, or names in the order in which they came.
        places: dict[str, dict] = {}
        for at, _ in entries:
            for axis, place in at.items():
                places.setdefault(axis, {}).setdefault(place)
        axes = sorted(places, key=lambda axis: "tcz".find(_letter(axis)))
        numbers = {axis: _numbered(list(places[axis])) for axis in axes}
        lengths = [(_letter(axis), 1 + max(numbers[axis].values())) for axis in axes]
        count = math.prod(length for _, length in lengths)
        if count > MAX_PLANES:
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


def _numbered(places: list) -> dict:
    """Numbers of places along an axis; where these are numbers, with room for those that the index lacks."""
    if all(isinstance(place, int) for place in places):
        return {place: place - min(places) for place in places}
    return {place: number for number, place in enumerate(places)}
