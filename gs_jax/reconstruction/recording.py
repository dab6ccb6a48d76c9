"""Reconstruction of a recording frame by frame, in this process or by workers, or while a camera takes it.

In this process frames are read ahead and written behind while one is computed. While a camera runs the newest capture
comes first, the others when there is time. A capture is read when its file is told to have changed. If that fails, it
may be half-written: it is read again at its next change, and given up when it has not changed for a while.
"""

import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple, TypeVar

from ..base.arrays import check_finite
from ..base.errors import InputError
from ..base.progress import Progress
from ..base.typing import Volume
from ..base.workers import Workers
from ..io.ngff import Note, VolumeSeries, open_levels, write_frame
from ..microscope.grid import Grid

Frame = TypeVar("Frame")
# From a frame, and what the last one left for it, to a volume, a note, and what it leaves for the next one.
Make = Callable[[Frame, Any], tuple[Volume, Note, Any]]

# Frames that are read before they are needed. One volume is written while the next is computed.
PREFETCH = 2


def reconstruct_frames(
    series: VolumeSeries,
    read: Callable[[int], Frame],
    make: Make,
    *,
    on_failure: Callable[[int, str], object] = lambda frame, reason: None,
    progress: Progress | None = None,
) -> None:
    """Make and write the volumes that a series lacks.

    At most four frames are in memory: `PREFETCH` that are read, one that is computed and one that is written. Volumes
    that were written are kept whatever ends the run.

    Parameters
    ----------
    series
        Destination of the volumes.
    read
        Maps a frame's number, from 0, to the argument of `make`; runs in another thread.
    make
        Maps it, and what the frame before left, to a volume, a note, and what is left for the next frame.
    on_failure
        Called with the number of a frame whose `read` or `make` raised `InputError`, and the reason.
    progress
        Shows progress.

    Raises
    ------
    InputError
        If every frame failed: the first one's.
    """
    frames = series.unfinished
    with (progress or Progress()).counter("Reconstructing", len(frames), rate=series.parts) as advance:
        pending: Future[Any] | None = None
        last = None
        reader, writer = ThreadPoolExecutor(1), ThreadPoolExecutor(1)
        try:
            for frame, image in _read_ahead(reader, frames, read):
                try:
                    volume, note, last = make(image.result(), last)
                    check_finite("volume", volume, "voxels")
                    job = partial(series.write, frame, volume, note)
                except InputError as error:
                    job = partial(series.fail, frame, str(error))
                    on_failure(frame, str(error))
                if pending:
                    pending.result()
                pending = writer.submit(job)
                # Only the writer may hold the volume while the next is computed.
                volume = job = None
                advance()
            if pending:
                pending.result()
        finally:
            reader.shutdown(cancel_futures=True)
            writer.shutdown()
    _check_any_finished(series)


def reconstruct_frames_by(
    workers: Workers,
    series: VolumeSeries,
    open_frames: Callable[[], tuple[Callable[[int], Frame], Make]],
    *,
    on_failure: Callable[[int, str], object] = lambda frame, reason: None,
    progress: Progress | None = None,
) -> None:
    """Let other processes make and write the volumes that a series lacks; parameters and errors as above.

    A frame whose worker died is made again, with the same result. The first few volumes are written here, where the
    first one creates the store.

    Parameters
    ----------
    workers
        Other processes, entered.
    series, on_failure, progress
        As for `reconstruct_frames`.
    open_frames
        Returns `read` and `make`, once in each worker; must be picklable.
    """
    frames = series.unfinished
    items = ((frame, series.exists) for frame in frames)
    with (progress or Progress()).counter("Reconstructing", len(frames), rate=series.parts) as advance:
        stream = workers.mapper(partial(_frame_maker, open_frames, series.path, series.grid, series.tile))
        for (frame, _), result in stream(items):
            try:
                volume, note = result()
            except InputError as error:
                series.fail(frame, str(error))
                on_failure(frame, str(error))
            else:
                series.write(frame, volume, note)
            advance()
    _check_any_finished(series)


def _frame_maker(open_frames, path: Path, grid: Grid, tile: int | None):
    """In a worker: the function that makes a frame, and writes it if the store exists."""
    read, make = open_frames()
    levels = cache(partial(open_levels, path, grid))
    # Threads of a worker share one open file.
    lock = Lock()

    def make_frame(item):
        frame, exists = item
        with lock:
            image = read(frame)
        volume, note, _ = make(image, None)
        check_finite("volume", volume, "voxels")
        if not exists:
            return volume, note
        write_frame(path, levels(), frame, volume, tile)
        return None, note

    return make_frame


def _check_any_finished(series):
    if series.failed and not series.finished:
        raise InputError(series.failed[min(series.failed)])


def _read_ahead(reader: ThreadPoolExecutor, frames: Iterable[int], read: Callable[[int], Frame]):
    waiting: deque[tuple[int, Future[Frame]]] = deque()
    for frame in frames:
        waiting.append((frame, reader.submit(read, frame)))
        if len(waiting) > PREFETCH:
            yield waiting.popleft()
    yield from waiting


# Seconds after which a file that cannot be read counts as bad, and for which to wait for changes at most.
SETTLED, _WAIT = 2.0, 0.5


class Done(NamedTuple):
    """A volume that was written: its frame, seconds since the file's last change, and frames that wait."""

    frame: int
    delay: float
    waiting: int


def reconstruct_live(
    series: VolumeSeries,
    folder: Path,
    changes: Callable[[float], list[str] | None],
    read: Callable[[int], Frame],
    make: Make,
    *,
    on_failure: Callable[[int, str], object] = lambda frame, reason: None,
    on_done: Callable[[Done], object] = lambda done: None,
) -> None:
    """Make and write the volume of each capture of a folder, until `changes` returns None.

    Frames are read, computed and written one after the other: overlapped, on two busy cores no more volumes are made,
    and each comes later. A volume that is being written when this ends is written wholly.

    Parameters
    ----------
    series
        Destination, which grows. Its names are those of files in `folder`; those without a volume are made, too.
    folder
        The folder.
    changes
        Waits for some seconds at most; returns the names of captures that are new or were written to.
    read
        Maps a frame's number to the argument of `make`; raises `InputError` if the file is not whole.
    make
        Maps it, and what the frame before left, to a volume, a note, and what is left for the next frame.
    on_failure
        Called with the number of a frame that was given up, and the reason.
    on_done
        Called when a volume has been written, in another thread.

    Raises
    ------
    OSError
        If a volume cannot be written.
    """
    queue = _Queue(series, folder)
    # In another thread, so that Ctrl-C does not end it half-way.
    writer, last = ThreadPoolExecutor(1), None
    try:
        while (names := changes(queue.patience)) is not None:
            for name in names:
                queue.add(name)
            if (frame := queue.pop()) is None:
                continue
            try:
                stamp, image = queue.read(frame, read)
                volume, note, last = make(image, last)
                check_finite("volume", volume, "voxels")
                job = partial(_write, series, frame, volume, note, stamp, len(queue.waiting), on_done)
            except _NotWhole:
                continue
            except InputError as error:
                job = partial(series.fail, frame, str(error))
                on_failure(frame, str(error))
            writer.submit(job).result()
    finally:
        writer.shutdown()


def _write(series: VolumeSeries, frame: int, volume: Volume, note: Note, stamp, waiting: int, on_done) -> None:
    series.write(frame, volume, note)
    on_done(Done(frame, time.time() - stamp.changed, waiting))


class _NotWhole(Exception):
    """A file that is read again when it changes."""


class _Stamp(NamedTuple):
    """Size of a file, time of its last change, and its number, by which it is seen whether it was written to."""

    size: int
    changed: float
    inode: int


class _Queue:
    """Frames to be made, the last one first, and frames that could not be read yet."""

    def __init__(self, series: VolumeSeries, folder: Path):
        self.series, self.folder = series, folder
        self.numbers = {name: number for number, name in enumerate(series.names)}
        # Of captures that came under one name, the file has the last.
        last = set(self.numbers.values())
        self.waiting: dict[int, None] = dict.fromkeys(frame for frame in series.unfinished if frame in last)
        # What was read of each frame, and the times at which frames that are not whole are read for the last time.
        self.stamps: dict[int, _Stamp | None] = {}
        self.deadlines: dict[int, float] = {}
        # Names that were written to after a volume was made.
        self.rewritten: set[str] = set()

    def add(self, name: str) -> None:
        """Take a new capture, or one that was written to since it was read.

        A program may make a file and fill it later; what it then writes under that name is another capture.
        """
        frame = self.numbers.get(name)
        if frame is not None and frame not in self.waiting:
            # Of a capture of an earlier run, only what is written from now on counts.
            before = self.stamps.setdefault(frame, now := self.stamp(frame))
            if before == now:
                return
            if frame in self.series.finished:
                if before and now and self._is_another(name, before, now):
                    frame = None
                self.rewritten.add(name)
        if frame is None:
            frame = self.numbers[name] = self.series.add(name)
        self.deadlines.pop(frame, None)
        self.waiting[frame] = None

    def _is_another(self, name: str, before: _Stamp, now: _Stamp) -> bool:
        is_later = now.changed > before.changed + SETTLED
        return name in self.rewritten or now.inode != before.inode or is_later

    def stamp(self, frame: int) -> _Stamp | None:
        try:
            status = os.stat(self.folder / self.series.names[frame])
        except OSError:
            return None
        return _Stamp(status.st_size, status.st_mtime, status.st_ino)

    @property
    def patience(self) -> float:
        """Seconds for which to wait for captures."""
        if self.waiting:
            return 0.0
        return min(_WAIT, max(0.0, min(self.deadlines.values(), default=math.inf) - time.monotonic()))

    def pop(self) -> int | None:
        """The frame to be read next."""
        if self.waiting:
            return self.waiting.popitem()[0]
        return next((frame for frame, at in self.deadlines.items() if at <= time.monotonic()), None)

    def read(self, frame: int, read: Callable[[int], Frame]) -> tuple[_Stamp, Frame]:
        """Read a frame; `_NotWhole` if it may still be written, `InputError` if it is bad."""
        is_last = self.deadlines.pop(frame, None) is not None
        stamp = self.stamps[frame] = self.stamp(frame)
        try:
            image = read(frame)
            if stamp is None or stamp != self.stamp(frame):
                raise InputError(f"{self.series.names[frame]} must be whole, got one that is being written.")
        except InputError as error:
            if is_last or (stamp and time.time() - stamp.changed > SETTLED):
                raise
            self.deadlines[frame] = time.monotonic() + SETTLED
            raise _NotWhole from error
        return stamp, image
