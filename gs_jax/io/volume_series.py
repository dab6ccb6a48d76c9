"""Volumes in time on disk, frame by frame: OME-Zarr `(t, z, y, x)` that opens at any moment, and its journal.

The store lies in its place from the first frame on, with its full size; what is not yet written reads as zeros. In it,
`frames.jsonl` has a line of JSON for the request, then one for each frame, added when the frame is wholly written, with
what is said of it; a line that a crash cut off does not count. So a run that ended anyhow is gone on with.

It is OME-Zarr 0.5 (Zarr 3), whose shards make one file of a frame's planes, whole or not there. In 0.4 each plane is
a file: of 10^5 frames of 13 planes 1.3 million, which few file systems of clusters bear. ome-zarr-py, napari-ome-zarr
and bioio read both alike.
"""

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from ..base.errors import InputError, needs_extra, short_repr
from ..grid import Grid
from ..typing import PathLike, Volume
from .files import atomic_write, decoding
from .provenance import Provenance
from .volumes import CHUNK, image_attributes, plain_depths, sharded

JOURNAL = "frames.jsonl"
Note = dict[str, Any]


class VolumeSeries:
    """The volumes of a recording's frames, being written; from one thread at a time.

    Parameters
    ----------
    path
        Of the store, ends in `.zarr`. It is made with the first frame, and replaces an image that is there.
    count
        Of frames.
    grid
        Of every frame.
    interval
        Seconds between frames, if they are known.
    request
        What the volumes depend on, as texts.
    provenance
        Where they come from.
    resume
        Go on with what is there, if anything.

    Raises
    ------
    InputError
        If what is there is another recording's, or, without `resume`, one that is not finished; if the depths have no
        single step.
    """

    def __init__(
        self,
        path: Path,
        count: int,
        grid: Grid,
        *,
        interval: float | None = None,
        request: dict[str, str] | None = None,
        provenance: Provenance | None = None,
        resume: bool = False,
    ):
        self.path, self.count, self.grid, self.interval = path, count, grid, interval
        self.request, self.provenance = request or {}, provenance or {}
        self.finished: set[int] = set()
        self.failed: dict[int, str] = {}
        self._levels: list[Any] = []
        if resume and path.exists():
            self._go_on()

    @property
    def unfinished(self) -> list[int]:
        """Frames to make, those that failed before, too."""
        return [frame for frame in range(self.count) if frame not in self.finished]

    @property
    def exists(self) -> bool:
        """Whether the store is there, for others to write volumes to by `write_frame`."""
        return bool(self._levels)

    def write(self, frame: int, volume: Volume | None, note: Note | None = None) -> None:
        """Writes the volume of a frame, counted from 0, and then that it is there, with what is said of it.

        None is a volume that somebody else has written.
        """
        if volume is not None:
            if not self._levels:
                self._create(volume)
            write_frame(self.path, self._levels, frame, volume)
        self._append({"frame": frame, **(note or {})})
        self.finished.add(frame)
        self.failed.pop(frame, None)

    def fail(self, frame: int, reason: str) -> None:
        """Notes why a frame has no volume."""
        self.failed[frame] = reason
        if self._levels:
            self._append({"frame": frame, "error": reason})

    def notes(self) -> Iterator[tuple[int, Note]]:
        """The finished frames in their order, and what was noted of each; read from the journal, one at a time."""
        if not self._levels:
            return
        with open(self.path / JOURNAL, "rb") as file:
            places = {frame: place for frame, place, error in _lines(file) if not error}
            for frame in sorted(places):
                file.seek(places[frame])
                yield frame, json.loads(file.readline())

    def _append(self, note: Note) -> None:
        with open(self.path / JOURNAL, "a", encoding="utf-8", newline="\n") as file:
            file.write(json.dumps(note, ensure_ascii=False) + "\n")

    def _create(self, volume) -> None:
        with needs_extra("zarr"):
            import zarr

        shapes = pyramid(volume.shape[1:])
        depths = plain_depths(self.grid)
        in_time = {"in_time": True, "interval": self.interval}
        attributes = image_attributes(self.path, depths, self.grid, shapes, volume, self.provenance, **in_time)
        with atomic_write(self.path) as temporary:
            group = zarr.create_group(store=temporary, zarr_format=3, attributes=attributes)
            for level, shape in enumerate(shapes):
                size = (self.count, len(depths), *shape)
                group.create_array(str(level), shape=size, dtype=volume.dtype, **sharded(size))
            lines = [{"request": self.request, "frames": self.count}]
            lines += [{"frame": frame, "error": reason} for frame, reason in self.failed.items()]
            text = "".join(json.dumps(line, ensure_ascii=False) + "\n" for line in lines)
            (temporary / JOURNAL).write_text(text, encoding="utf-8", newline="\n")
        self._open()

    def _open(self) -> None:
        self._levels = opened_levels(self.path, self.grid)

    def _go_on(self) -> None:
        head = read_head(self.path)
        if head is None:
            raise InputError(f"{self.path}: found nothing for --resume to go on with, allowed: what a recording left.")
        now, before = ({**request, "frames": str(count)} for request, count in ((self.request, self.count), head))
        for key in dict.fromkeys([*now, *before]):
            if before.get(key) != now.get(key):
                found, allowed = (short_repr(each.get(key, "nothing")) for each in (now, before))
                raise InputError(f"{self.path}: found {key} {found} for --resume, allowed: {allowed}, as it was begun.")
        journal = self.path / JOURNAL
        with open(journal, "rb") as file:
            for frame, _, error in _lines(file):
                if error:
                    self.failed[frame] = error
                else:
                    self.finished.add(frame)
                    self.failed.pop(frame, None)
            whole = file.tell()
        # What follows the last whole line, a crash cut off.
        os.truncate(journal, whole)
        self._open()


def opened_levels(path: Path, grid: Grid) -> list[Any]:
    """The arrays of a store that is there, to write to: of the full size, and each next of half of it."""
    with needs_extra("zarr"):
        import zarr

    group = zarr.open_group(path, mode="r+")
    return [group[str(level)] for level in range(len(pyramid(grid.shape)))]


def write_frame(path: Path, levels: list[Any], frame: int, volume: Volume) -> None:
    """Writes the volume of a frame to arrays as `opened_levels` opens: of each a file, whole or not at all."""
    for level, array in enumerate(levels):
        volume = halved(volume) if level else volume
        # Of a process that was ended as it wrote the frame.
        for left in (path / str(level) / "c" / str(frame)).rglob("*.partial"):
            left.unlink(missing_ok=True)
        array[frame] = volume


def read_head(path: PathLike) -> tuple[dict[str, str], int] | None:
    """The request of the volumes in a store, and how many frames there are to be; None if there is no journal."""
    try:
        with open(Path(path) / JOURNAL, encoding="utf-8") as file:
            head = json.loads(file.readline())
        return {str(key): str(value) for key, value in head["request"].items()}, int(head["frames"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


class Series(NamedTuple):
    """Volumes in time, of which nothing has been read.

    Parameters
    ----------
    levels
        Zarr arrays `(t, z, y, x)`, the first of the full size.
    scale, first
        Of the first level, the steps `(t, z, y, x)` and the centre of the first voxel: um, and seconds or frames.
    interval
        Seconds between frames, if they are known.
    shown
        What is black and white.
    """

    levels: list[Any]
    scale: list[float]
    first: list[float]
    interval: float | None
    shown: tuple[float, float]


def read_series(path: PathLike) -> Series | None:
    """What `VolumeSeries` wrote, or None if it is anything else."""
    if read_head(path) is None:
        return None
    with needs_extra("zarr"):
        import zarr

    with decoding(Path(path), "OME-Zarr"):
        group = zarr.open_group(path, mode="r")
        attributes: Any = group.attrs.asdict()
        # Until 0.4 it lay at the root.
        attributes = attributes.get("ome", attributes)
        (image,), window = attributes["multiscales"], attributes["omero"]["channels"][0]["window"]
        scale, first = image["datasets"][0]["coordinateTransformations"]
        interval = scale["scale"][0] if "unit" in image["axes"][0] else None
        levels = [group[each["path"]] for each in image["datasets"]]
        return Series(levels, scale["scale"], first["translation"], interval, (window["start"], window["end"]))


def check_replaceable(path: Path) -> None:
    """`InputError` if there are volumes of a recording that is not finished, which `VolumeSeries` would replace."""
    if (head := read_head(path)) is None:
        return
    with open(path / JOURNAL, "rb") as file:
        done = len({frame for frame, _, error in _lines(file) if not error})
    if done < head[1]:
        found = f"{done} of {head[1]} frames of a recording that was interrupted"
        raise InputError(f"{path}: found {found}, allowed: --resume to go on, or --force to begin anew.")


def _lines(file) -> Iterator[tuple[int, int, str]]:
    """Frames, the places of their lines and the errors of an open journal; then it is at the end of the last one."""
    file.readline()
    while (line := file.readline()).endswith(b"\n"):
        note = json.loads(line)
        yield note["frame"], file.tell() - len(line), note.get("error", "")
    file.seek(-len(line), os.SEEK_CUR)


def pyramid(shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """Rows and columns of levels, each half of the last, until one chunk holds a plane."""
    shapes = [(shape[0], shape[1])]
    while max(shapes[-1]) > CHUNK:
        shapes.append((-(-shapes[-1][0] // 2), -(-shapes[-1][1] // 2)))
    return shapes


def halved(volume: Volume) -> Float32[np.ndarray, "depth _ _"]:
    """The mean of 2 x 2 voxels of each plane; at an odd end, of those that are there."""
    odd = [(0, 0), *((0, n % 2) for n in volume.shape[1:])]
    even = np.pad(volume, odd, mode="edge") if volume.shape[1] % 2 or volume.shape[2] % 2 else volume
    return (even[:, ::2, ::2] + even[:, 1::2, ::2] + even[:, ::2, 1::2] + even[:, 1::2, 1::2]) / np.float32(4)
