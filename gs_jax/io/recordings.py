"""Recordings on disk: the pages of a TIFF or an .npy, the captures of a folder or a glob, or an array in Zarr.

Nothing of a frame is read before it is asked for, and files of many pages stay open.
"""

import contextlib
import glob
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from ..base.errors import InputError, needs_extra
from ..typing import PathLike
from .captures import CAPTURE_SUFFIXES, Wanted, check_colour, check_declared, checked, frames, opened_tiff, tiff_page
from .files import check_input, decoding

Images = Iterator[Shaped[np.ndarray, "row column"]]

_IN_PAGES = (".tif", ".tiff", ".npy")
_ZARR_ROOTS = (".zarray", ".zgroup", "zarr.json")
_MAGIC = re.compile(r"[*?[]")


class Recording(NamedTuple):
    """Frames of one camera, in the order of time.

    Parameters
    ----------
    names
        Of the frames, for people.
    images
        From a frame, counted from 0, and what is wanted of it to its images: one, or several to be averaged. From one
        thread at a time.
    files
        That it is read from, but for the many of a Zarr store.
    """

    names: list[str]
    images: Callable[[int, Wanted], Images]
    files: list[Path]


@contextlib.contextmanager
def opened_recording(path: PathLike, *, page: int | str | None = None) -> Iterator[Recording | None]:
    """The frames of a recording, or None if the path is a single capture.

    Parameters
    ----------
    path
        A folder, whose captures are the frames; a pattern with `*`, `?` or `[...]`, likewise (names are ordered as
        people count: `f2` before `f10`); a Zarr array `(t, y, x)` or `(t, 1, 1, y, x)`, or the OME-Zarr image of one;
        or a TIFF or an .npy of several pages, which are the frames.
    page
        If given, a page of each file is a frame, as `read_capture` says, and a file is no recording.

    Raises
    ------
    InputError
        If nothing matches, or a file or store cannot be read.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if path.is_dir() and (suffix == ".zarr" or any((path / name).exists() for name in _ZARR_ROOTS)):
        yield _of_zarr(path, page)
    elif path.is_dir():
        yield _of_files(path, [path / name for name in os.listdir(path)], page)
    elif _MAGIC.search(str(path)) and not path.exists():
        yield _of_files(path, [Path(name) for name in glob.glob(str(path), recursive=True)], page)
    elif page is not None or suffix not in _IN_PAGES:
        yield None
    elif suffix == ".npy":
        with decoding(check_input(path), ".npy of numbers"):
            shape = np.lib.format.open_memmap(path, mode="r").shape
        read = lambda index, wanted: frames(path, **(wanted._asdict() | {"page": index + 1}))
        yield _of_pages(path, shape[0], read) if len(shape) == 3 and shape[0] > 1 else None
    else:
        with opened_tiff(check_input(path)) as (tiff, count):
            read = lambda index, wanted: checked(path, (tiff_page(path, tiff, at, wanted) for at in (index,)))
            yield _of_pages(path, count, read) if count > 1 else None


def _of_pages(path, count, read):
    return Recording([f"{path.name}, page {page}" for page in range(1, count + 1)], read, [path])


def _of_files(path, found, page):
    files = [each for each in found if each.suffix.lower() in CAPTURE_SUFFIXES and not each.name.startswith(".")]
    files = sorted((each for each in files if not each.is_dir()), key=_counted)
    if not files:
        raise InputError(f"{path}: found no captures, allowed: files that end in {', '.join(CAPTURE_SUFFIXES)}.")
    read = lambda index, wanted: frames(files[index], **(wanted._asdict() | {"page": page}))
    return Recording([each.name for each in files], read, files)


def _counted(path: Path) -> list[Any]:
    """Of which names are ordered as people count; texts and numbers take turns."""
    parts = re.split(r"(\d+)", str(path))
    return [int(part) if place % 2 else part for place, part in enumerate(parts)]


def _of_zarr(path, page):
    with needs_extra("zarr"):
        import zarr
        from zarr import open as open_zarr

    if page is not None:
        raise InputError(f"--page {page}: found {path}, a recording in Zarr, allowed: no page.")
    with decoding(path, "Zarr store"):
        store = open_zarr(path, mode="r")
        array = store if isinstance(store, zarr.Array) else _image(store)
    if not isinstance(array, zarr.Array):
        raise InputError(f"{path}: found no array in Zarr, allowed: an array (t, y, x), or OME-Zarr of one image.")
    shape, axes = array.shape, _axes(store)
    inner = shape[1:-2]
    if len(shape) < 3 or any(n != 1 for n in inner) or not shape[0] or (axes and axes[0] != "t"):
        found = f"{' x '.join(map(str, shape))}{f' ({short_axes})' if (short_axes := ', '.join(axes)) else ''}"
        raise InputError(f"{path}: found an array of {found}, allowed: (t, y, x), and between them axes of 1 alone.")

    def image(index, wanted):
        check_colour(path, None, wanted)
        check_declared(path, shape[-2:], array.dtype.name, wanted)
        with decoding(path, "Zarr array"):
            yield np.asarray(array[index]).reshape(shape[-2:])

    names = [f"{path.name}, frame {frame}" for frame in range(1, shape[0] + 1)]
    return Recording(names, lambda index, wanted: checked(path, image(index, wanted)), [])


def _multiscale(group):
    attributes = group.attrs.asdict()
    return (attributes.get("ome", attributes).get("multiscales") or [{}])[0]


def _image(group):
    """The full-size array of OME-Zarr, or the only array that there is."""
    datasets = _multiscale(group).get("datasets")
    if datasets:
        return group[datasets[0]["path"]]
    arrays = [array for _, array in group.arrays()]
    return arrays[0] if len(arrays) == 1 else None


def _axes(store) -> list[str]:
    with contextlib.suppress(KeyError, TypeError, AttributeError):
        return [str(axis["name"]) for axis in _multiscale(store)["axes"]]
    return []
