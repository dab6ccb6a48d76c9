"""Opens recordings: pages of a TIFF or an .npy, captures of a folder or a glob, or a Zarr array.

Frames are read when they are asked for, and files of many pages stay open. Images of points, one for each plane of a
measured stack of PSFs, are read in the same way.
"""

import contextlib
import glob
import math
import os
import queue
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..base.errors import InputError, InputWarning, needs_extra
from ..base.typing import PathLike
from .axes import UNNAMED, axis_letter, stack_error
from .camera import Corrected, Correction, Prepared, Readout, prepare, read_frame
from .captures import (
    HDF5_SUFFIXES,
    OWN,
    READ_SUFFIXES,
    VENDOR_SUFFIXES,
    GreyError,
    Images,
    Selection,
    Source,
    check_colour,
    check_declared,
    check_images,
    check_stack,
    is_grey,
    of_channel,
    open_source,
    read_images,
)
from .files import TIFF_SUFFIXES, check_input, decoding
from .names import natural_order
from .ngff import missing_chunk, ngff_attributes
from .remote import import_zarr, open_store, remote_url

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
def open_recording(
    path: PathLike, *, page: int | str | None = None, axes: str = "t", channel: str | None = None
) -> Iterator[Recording | None]:
    """Open the frames of a recording, or the planes of a stack; None if the path is a single capture.

    Parameters
    ----------
    path
        A folder, or a pattern with `*`, `?` or `[...]`, whose captures are the frames, in natural order (`f2` before
        `f10`); a TIFF, with the other files of its set, or an .npy of several pages; a Zarr array `(t, y, x)` or
        `(t, 1, 1, y, x)`, or the OME-Zarr image of one, also at an s3:// or https:// address.
    page
        As for `read_capture`: each file is then one frame, and a single file no recording.
    axes
        The axes that may hold the images, if the file names them: "t", or "tz" for stacks.
    channel
        As for `read_capture`.

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
    if remote_url(path) or path.is_dir() and (suffix == ".zarr" or any((path / name).exists() for name in _ZARR_ROOTS)):
        if page is not None:
            raise InputError(f"--page must not be given for a recording in Zarr, got --page {page} ({path}).")
        source = _zarr_source(path, axes)
        yield _recording(path, of_channel(path, source, channel) if channel else source, axes)
    elif (files := capture_files(path)) is not None:
        yield _open_files(path, files, page)
    elif page is not None or suffix not in (*TIFF_SUFFIXES, ".npy", *VENDOR_SUFFIXES):
        yield None
    else:
        advice = "; --page takes one image; if all follow each other, save them with the axes TYX"
        with open_source(check_input(path), channel=channel) as source:
            yield _recording(path, source, axes, advice) if len(source.names) > 1 else None


def _recording(path: Path, source: Source, axes: str, advice: str = "") -> Recording:
    """The images of a file or a store as frames; `InputError` if they lie along other axes than these."""
    check_stack(path, source, axes, advice)

    def images(index: int, selection: Selection) -> Images:
        return check_images(path, (source.read(frame, selection) for frame in [index]))

    return Recording(source.names, images, source.files)


def capture_files(path: Path) -> list[Path] | None:
    """Captures of a folder or a pattern, in natural order; None if the path is neither."""
    if remote_url(path):
        return None
    if path.is_dir():
        matches = [path / name for name in os.listdir(path)]
    elif re.search(r"[*?[]", str(path)) and not path.exists():
        matches = [Path(name) for name in glob.glob(_pattern(path), recursive=True)]
    else:
        return None
    files = [match for match in matches if is_capture(match.name) and not match.is_dir()]
    # HDF5 beside captures is more likely what was made of them, such as signals.
    others = [file for file in files if file.suffix.lower() not in HDF5_SUFFIXES]
    return natural_order(others or files)


def is_capture(name: str) -> bool:
    """Whether a file of this name is a capture; one whose name begins with a dot may not be complete."""
    return name.lower().endswith(READ_SUFFIXES) and not name.startswith(".")


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
        raise InputError(f"{path}: no captures; their files end in {', '.join(READ_SUFFIXES)}.")

    def read(index: int, selection: Selection) -> Images:
        return read_images(files[index], selection._replace(page=OWN if page is None else page))

    return Recording([file.name for file in files], read, files)


def _zarr_source(path: Path, allowed: str) -> Source:
    """The images of a Zarr array; `InputError` if there is none, or it is none of `allowed` axes, rows and columns."""
    zarr = import_zarr()
    with decoding(remote_url(path) or path, "Zarr store"):
        store = _only_series(open_store(path))
        array = store if isinstance(store, zarr.Array) else zarr_image(store)
    if not isinstance(array, zarr.Array):
        raise InputError(f"{path}: no image; must be a Zarr array (t, y, x), or OME-Zarr of one image.")
    shape, names = array.shape, _axes(store, array)
    if len(shape) < 3 or names[-2:] not in (["y", "x"], [UNNAMED] * 2):
        raise stack_error(path, allowed, shape, names)

    def read(index: int, selection: Selection) -> np.ndarray:
        check_colour(path, None, selection)
        check_declared(path, shape[-2:], array.dtype.name, selection)
        place = tuple(map(int, np.unravel_index(index, shape[:-2])))
        with decoding(path, "Zarr array"):
            missing = missing_chunk(array, place)
            image = None if missing else np.asarray(array[place])
        if image is None:
            advice = "if it is dark there, write it with write_empty_chunks=True"
            raise InputError(f"{path}: frame {index + 1} is incomplete: there is no chunk {missing}; {advice}.")
        return image

    frames = [f"{path.name}, frame {frame}" for frame in range(1, math.prod(shape[:-2]) + 1)]
    labels = [channel.get("label", "") for channel in (ngff_attributes(store).get("omero") or {}).get("channels", [])]
    axes = list(zip(names, shape[:-2], strict=False))
    return Source(axes, shape[-2:], frames, read, [], labels if all(labels) else ())


def _only_series(store):
    """The image of a store that Bio-Formats wrote, whose root has a group for each."""
    if "bioformats2raw.layout" in ngff_attributes(store):
        series = [group for name, group in store.groups() if name != "OME"]
        return series[0] if len(series) == 1 else store
    return store


def zarr_image(group) -> Any:
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
        with open_recording(path, page=page, axes="tz", channel=readout.channel) as recording:
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
                    first = recording.files[:1] if recording else [path]
                    grey = not first or is_grey(first[0], page, own.channel)
                    prepared[key] = prepare(cells if own.bayer else shape, shape, own, correction, grey)
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
        with contextlib.suppress(queue.Empty):
            while True:
                changed = self._changes.get(block=not names and timeout > 0, timeout=timeout or None)
                if isinstance(changed, Exception):
                    raise changed
                names += changed
        return natural_order(dict.fromkeys(names))

    def _run(self) -> None:
        options = {"step": _STEP, "debounce": _GATHER, "rust_timeout": _LISTED, "yield_on_timeout": True}
        options |= {"watch_filter": None, "stop_event": self._stop, "recursive": False, "raise_interrupt": False}
        listed = True
        try:
            self._tell(os.listdir(self.folder), listed)
            for changes in self._watch(self.folder, **options):
                # What came before the library began to watch is in the list.
                if listed or not changes:
                    self._tell(os.listdir(self.folder), True)
                self._tell([os.path.basename(path) for _, path in changes], False)
                listed = False
        except OSError as error:
            self._changes.put(InputError(f"{self.folder}: cannot be watched any more: {error.strerror or error}."))

    def _tell(self, names: list[str], listed: bool) -> None:
        captures = [name for name in names if is_capture(name) and not (listed and name in self._told)]
        # The library also tells of files that are deleted.
        captures = [name for name in captures if (self.folder / name).is_file()]
        self._told.update(captures)
        if captures:
            self._changes.put(captures)
