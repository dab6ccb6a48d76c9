"""Opens recordings: pages of a TIFF or an .npy, captures of a folder or a glob, or a Zarr array.

Frames are read when they are asked for, and files of many pages stay open. `WatchedFolder` tells of captures as a
camera's program writes them.
"""

import contextlib
import glob
import os
import queue
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..base.errors import InputError, needs_extra
from ..typing import PathLike
from .axes import UNNAMED, axis_letter, stack_axis, stack_error
from .captures import (
    CAPTURE_SUFFIXES,
    OWN,
    Images,
    Selection,
    check_colour,
    check_declared,
    check_images,
    check_stack,
    read_images,
    read_tiff_page,
)
from .files import TIFF_SUFFIXES, check_input, decoding
from .names import natural_order
from .ngff import missing_chunk
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
        with decoding(check_input(path), ".npy of numbers"):
            shape = np.lib.format.open_memmap(path, mode="r").shape
        read = lambda index, selection: read_images(path, selection._replace(page=index + 1))
        yield _paged(path, shape[0], read) if len(shape) == 3 and shape[0] > 1 else None
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


def _paged(path: Path, count: int, read: Callable[[int, Selection], Images]) -> Recording:
    return Recording([f"{path.name}, page {page}" for page in range(1, count + 1)], read, [path])


def capture_files(path: Path) -> list[Path] | None:
    """Captures of a folder or a pattern, in natural order; None if the path is neither."""
    if path.is_dir():
        matches = [path / name for name in os.listdir(path)]
    elif re.search(r"[*?[]", str(path)) and not path.exists():
        matches = [Path(name) for name in glob.glob(_pattern(path), recursive=True)]
    else:
        return None
    files = [each for each in matches if each.suffix.lower() in CAPTURE_SUFFIXES and not each.name.startswith(".")]
    return natural_order(each for each in files if not each.is_dir())


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
    read = lambda index, selection: read_images(files[index], selection._replace(page=OWN if page is None else page))
    return Recording([each.name for each in files], read, files)


def _open_zarr(path: Path, page: int | str | None, allowed: str) -> Recording:
    with needs_extra("zarr"):
        import zarr
        from zarr import open as open_zarr

    if page is not None:
        raise InputError(f"--page must not be given for a recording in Zarr, got --page {page} ({path}).")
    with decoding(path, "Zarr store"):
        store = _only_series(open_zarr(path, mode="r"))
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
    if "bioformats2raw.layout" in _attributes(store):
        series = [group for name, group in store.groups() if name != "OME"]
        return series[0] if len(series) == 1 else store
    return store


def _attributes(store) -> dict[str, Any]:
    """NGFF's attributes, which version 0.5 has in `ome`."""
    attributes = store.attrs.asdict()
    return attributes.get("ome", attributes)


def _image_array(group):
    """The full-size array of OME-Zarr of one image, or the only array of a group."""
    images = _attributes(group).get("multiscales") or [{}]
    if len(images) == 1 and (datasets := images[0].get("datasets")):
        return group[datasets[0]["path"]]
    arrays = [array for _, array in group.arrays()]
    return arrays[0] if len(arrays) == 1 else None


def _axes(store, array) -> list[str]:
    """Names of the axes of an array: NGFF's, those of Zarr 3, or xarray's."""
    count = array.ndim
    with contextlib.suppress(KeyError, TypeError, AttributeError, IndexError):
        axes = [axis_letter(axis["name"], axis.get("type")) for axis in _attributes(store)["multiscales"][0]["axes"]]
        if len(axes) == count:
            return axes
    names = getattr(array.metadata, "dimension_names", None) or array.attrs.asdict().get("_ARRAY_DIMENSIONS")
    names = [axis_letter("" if name is None else name) for name in names or ()]
    return names if len(names) == count else [UNNAMED] * count


# Milliseconds: between two looks of the watching library, and the longest time for which it gathers changes.
_STEP, _GATHER = 4, 8
# Milliseconds without a change after which the folder is listed, in case that a change was lost.
_LISTED = 2000


class WatchedFolder:
    """Context manager that tells which captures of a folder are new or were written to.

    Parameters
    ----------
    folder
        Its captures, not those of folders in it. Names that begin with a dot are left out, so that a program may write
        a file under such a name and rename it.

    Raises
    ------
    InputError
        If it is no folder, or `watchfiles` is not installed.
    """

    def __init__(self, folder: Path):
        if not folder.is_dir():
            raise InputError(f"{folder} must be a folder to be watched, got {'a file' if folder.exists() else 'none'}.")
        with needs_extra("live"):
            import watchfiles
        self.folder, self._watch = folder, watchfiles.watch
        self._changes: queue.SimpleQueue[list[str] | Exception] = queue.SimpleQueue()
        self._told: set[str] = set()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "WatchedFolder":
        self._thread.start()
        return self

    def __exit__(self, *_) -> None:
        self._stop.set()
        self._thread.join()

    def changes(self, timeout: float) -> list[str]:
        """Names of captures that are new or have changed since the last call, in natural order.

        If there are none, waits for the first for so many seconds. Names may be told twice.
        """
        names: list[str] = []
        try:
            while True:
                found = self._changes.get(timeout=timeout) if not names and timeout else self._changes.get_nowait()
                if isinstance(found, Exception):
                    raise found
                names += found
        except queue.Empty:
            return natural_order(dict.fromkeys(names))

    def _run(self) -> None:
        how = {"step": _STEP, "debounce": _GATHER, "rust_timeout": _LISTED, "yield_on_timeout": True}
        listed = True
        try:
            self._tell(os.listdir(self.folder), listed)
            for changes in self._watch(
                self.folder, watch_filter=None, stop_event=self._stop, recursive=False, raise_interrupt=False, **how
            ):
                # What came before the library began to watch is in the list.
                listed = listed or not changes
                if listed:
                    self._tell(os.listdir(self.folder), listed)
                self._tell([os.path.basename(path) for _, path in changes], listed=False)
                listed = False
        except OSError as error:
            self._changes.put(InputError(f"{self.folder}: cannot be watched any more: {error.strerror or error}."))

    def _tell(self, names: list[str], listed: bool) -> None:
        captures = [name for name in names if name.lower().endswith(CAPTURE_SUFFIXES) and not name.startswith(".")]
        captures = [name for name in captures if name not in self._told] if listed else captures
        # The library also tells of files that are deleted.
        captures = [name for name in captures if (self.folder / name).is_file()]
        self._told.update(captures)
        if captures:
            self._changes.put(captures)
