"""Opens recordings: pages of a TIFF or an .npy, captures of a folder or a glob, or a Zarr array.

Frames are read when they are asked for, and files of many pages stay open. Images of points, one for each plane of a
measured stack of PSFs, are read in the same way.
"""

import contextlib
import glob
import os
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..base.errors import InputError, InputWarning
from ..typing import PathLike
from .axes import UNNAMED, axis_letter, stack_axis, stack_error
from .camera import Corrected, Correction, Prepared, Readout, prepare, read_frame
from .captures import (
    CAPTURE_SUFFIXES,
    OWN,
    GreyError,
    Images,
    Selection,
    check_colour,
    check_declared,
    check_images,
    check_stack,
    open_npy,
    read_images,
    read_tiff_page,
)
from .files import TIFF_SUFFIXES, check_input, decoding
from .names import natural_order
from .ngff import import_zarr, missing_chunk, ngff_attributes
from .tiff import Tiff, open_tiff

_ZARR_ROOTS = (".zarray", ".zgroup", "zarr.json")


class Recording(NamedTuple):
    """Frames of one camera in the order of time.

    Parameters
    ----------
    names
        Name of each frame, for messages.
    images
        Reads a frame, counted from 0, as one image, or several to be averaged; not thread-safe.
    files
        Files that are read, except the many of a Zarr store.
    """

    names: list[str]
    images: Callable[[int, Selection], Images]
    files: list[Path]


@contextlib.contextmanager
def open_recording(path: PathLike, *, page: int | str | None = None, axes: str = "t") -> Iterator[Recording | None]:
    """Open the frames of a recording, or the planes of a stack; None if the path is a single capture.

    Parameters
    ----------
    path
        A folder, or a pattern with `*`, `?` or `[...]`, whose captures are the frames, in natural order (`f2` before
        `f10`); a TIFF, with the other files of its set, or an .npy of several pages; a Zarr array `(t, y, x)` or
        `(t, 1, 1, y, x)`, or the OME-Zarr image of one.
    page
        As for `read_capture`: each file is then one frame, and a single file no recording.
    axes
        The axes that may hold the images, if the file names them: "t", or "tz" for stacks.

    Raises
    ------
    InputError
        If nothing matches, a file or store cannot be read, or it declares other axes.

    Warns
    -----
    InputWarning
        If a TIFF declares more images than it holds.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if path.is_dir() and (suffix == ".zarr" or any((path / name).exists() for name in _ZARR_ROOTS)):
        yield _open_zarr(path, page, axes)
    elif (files := capture_files(path)) is not None:
        yield _open_files(path, files, page)
    elif page is not None or suffix not in (*TIFF_SUFFIXES, ".npy"):
        yield None
    elif suffix == ".npy":
        shape = open_npy(check_input(path)).shape
        yield _open_npy(path, shape[0]) if len(shape) == 3 and shape[0] > 1 else None
    else:
        with open_tiff(check_input(path)) as tiff:
            yield _open_pages(tiff, axes) if len(tiff.stack.images) > 1 else None


def _open_pages(tiff: Tiff, axes: str) -> Recording:
    """The images of a TIFF, and of the further files of its set, in the order that it declares."""
    advice = "; --page takes one image; if all follow each other, save them with the axes TYX"
    check_stack(tiff, axes, advice)
    images = tiff.stack.images

    def read(index: int, selection: Selection) -> Images:
        yield read_tiff_page(*tiff.at(images[index], index), selection)

    names = [f"{image[0].name}, page {image[1] + 1}" if image else f"{tiff.path.name}, no page" for image in images]
    files = list(dict.fromkeys([tiff.path, *(image[0] for image in images if image)]))
    return Recording(names, lambda index, selection: check_images(tiff.path, read(index, selection)), files)


def _open_npy(path: Path, count: int) -> Recording:
    def read(index: int, selection: Selection) -> Images:
        return read_images(path, selection._replace(page=index + 1))

    return Recording([f"{path.name}, page {page}" for page in range(1, count + 1)], read, [path])


def capture_files(path: Path) -> list[Path] | None:
    """Captures of a folder or a pattern, in natural order; None if the path is neither."""
    if path.is_dir():
        matches = [path / name for name in os.listdir(path)]
    elif re.search(r"[*?[]", str(path)) and not path.exists():
        matches = [Path(name) for name in glob.glob(_pattern(path), recursive=True)]
    else:
        return None
    return natural_order(match for match in matches if is_capture(match.name) and not match.is_dir())


def is_capture(name: str) -> bool:
    """Whether a file of this name is a capture; one whose name begins with a dot may not be complete."""
    return name.lower().endswith(CAPTURE_SUFFIXES) and not name.startswith(".")


def _pattern(path: Path) -> str:
    """A pattern for `glob`, in which the names of folders that exist stand for themselves, such as `run[1]`."""
    folder = Path()
    for place, part in enumerate(path.parts):
        if not (folder / part).is_dir():
            return str(Path(glob.escape(str(folder)), *path.parts[place:]))
        folder /= part
    return glob.escape(str(folder))


def _open_files(path: Path, files: list[Path], page: int | str | None) -> Recording:
    if not files:
        raise InputError(f"{path}: no captures; their files end in {', '.join(CAPTURE_SUFFIXES)}.")

    def read(index: int, selection: Selection) -> Images:
        return read_images(files[index], selection._replace(page=OWN if page is None else page))

    return Recording([file.name for file in files], read, files)


def _open_zarr(path: Path, page: int | str | None, allowed: str) -> Recording:
    zarr = import_zarr()
    if page is not None:
        raise InputError(f"--page must not be given for a recording in Zarr, got --page {page} ({path}).")
    with decoding(path, "Zarr store"):
        store = _only_series(zarr.open(path, mode="r"))
        array = store if isinstance(store, zarr.Array) else _image_array(store)
    if not isinstance(array, zarr.Array):
        raise InputError(f"{path}: no image; must be a Zarr array (t, y, x), or OME-Zarr of one image.")
    shape, names = array.shape, _axes(store, array)
    stack = list(zip(names, shape, strict=True))[:-2]
    axis = stack_axis(stack, allowed) if stack else None
    if axis is None or not shape[axis] or names[-2:] not in (["y", "x"], [UNNAMED] * 2):
        raise stack_error(path, allowed, shape, names)

    def read(index, selection):
        check_colour(path, None, selection)
        check_declared(path, shape[-2:], array.dtype.name, selection)
        place = tuple(index if number == axis else 0 for number in range(len(stack)))
        with decoding(path, "Zarr array"):
            missing = missing_chunk(array, place)
            image = None if missing else np.asarray(array[place])
        if image is None:
            advice = "if it is dark there, write it with write_empty_chunks=True"
            raise InputError(f"{path}: frame {index + 1} is incomplete: there is no chunk {missing}; {advice}.")
        yield image

    labels = [f"{path.name}, frame {frame}" for frame in range(1, shape[axis] + 1)]
    return Recording(labels, lambda index, selection: check_images(path, read(index, selection)), [])


def _only_series(store):
    """The image of a store that Bio-Formats wrote, whose root has a group for each."""
    if "bioformats2raw.layout" in ngff_attributes(store):
        series = [group for name, group in store.groups() if name != "OME"]
        return series[0] if len(series) == 1 else store
    return store


def _image_array(group) -> Any:
    """The full-size array of OME-Zarr of one image, or the only array of a group."""
    images = ngff_attributes(group).get("multiscales") or [{}]
    if len(images) == 1 and (datasets := images[0].get("datasets")):
        return group[datasets[0]["path"]]
    arrays = [array for _, array in group.arrays()]
    return arrays[0] if len(arrays) == 1 else None


def _axes(store, array) -> list[str]:
    """Names of the axes of an array: NGFF's, those of Zarr 3, or xarray's."""
    count = array.ndim
    with contextlib.suppress(KeyError, TypeError, AttributeError, IndexError):
        axes = ngff_attributes(store)["multiscales"][0]["axes"]
        if len(axes) == count:
            return [axis_letter(axis["name"], axis.get("type")) for axis in axes]
    names = getattr(array.metadata, "dimension_names", None) or array.attrs.asdict().get("_ARRAY_DIMENSIONS")
    names = [axis_letter("" if name is None else name) for name in names or ()]
    return names if len(names) == count else [UNNAMED] * count


def read_spots(
    paths: Sequence[Path],
    *,
    page: int | str | None = None,
    readout: Readout = Readout(),
    correction: Correction = Correction(),
) -> Iterator[tuple[Path, Corrected]]:
    """Read and correct images of a point, and yield each with its file.

    Parameters
    ----------
    paths
        TIFF, PNG or .npy, each with a page or several; folders or patterns of such files; Zarr arrays (z, y, x).
    page
        None: a plane for each page. A page, or "mean" of all: a plane for each file.
    readout, correction
        As for `read_corrected`. With `bad_pixels="auto"` no pixel is taken for a hot one: a spot may be as sharp. A
        channel is selected of images in colour alone.

    Raises
    ------
    InputError
        As `open_recording` and `read_corrected`.
    """
    if correction.bad_pixels == "auto":
        correction = correction._replace(bad_pixels="none")
    selection = Selection(None, page, readout.channel, readout.bayer)
    prepared: dict[Any, Prepared] = {}
    for path in paths:
        with open_recording(path, page=page, axes="tz") as recording:
            stack = recording or Recording([path.name], lambda _, selected, path=path: read_images(path, selected), [])
            for plane, name in enumerate(stack.names):
                own = readout
                try:
                    images = list(stack.images(plane, selection))
                except GreyError:
                    own = readout._replace(channel=None)
                    images = list(stack.images(plane, selection._replace(channel=None)))
                shape = images[0].shape
                if (key := (shape, own)) not in prepared:
                    cells = (shape[0] // 2, shape[1] // 2)
                    prepared[key] = prepare(cells if own.bayer else shape, shape, own, correction)
                yield path, read_frame(name, iter(images), prepared[key], own)


def spot_names(paths: Sequence[Path], page: int | str | None = None) -> list[str]:
    """Names of the images of `read_spots`, in their order; warns where files are in the order of texts, not numbers.

    Raises `InputError` as `open_recording`.
    """
    names = [path.name for path in paths]
    if names == sorted(names) and names != (ordered := natural_order(names)):
        text = f"{names[0]} to {names[-1]} are taken in this order; by their numbers {ordered[0]} is the first"
        warnings.warn(
            InputWarning(f"{text}, and {ordered[-1]} the last: give their folder to sort them so."), stacklevel=2
        )
    names = []
    for path in paths:
        with open_recording(path, page=page, axes="tz") as several:
            names += several.names if several else [path.name]
    return names
