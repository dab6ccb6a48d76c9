"""Reconstruction of a recording frame by frame, in this process or by workers.

In this process frames are read ahead and written behind while one is computed.
"""

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

from ..base.arrays import check_finite
from ..base.errors import InputError
from ..base.progress import Progress
from ..base.workers import Workers
from ..grid import Grid
from ..io.volume_series import Note, VolumeSeries, open_levels, write_frame
from ..typing import Volume

Frame = TypeVar("Frame")

# Frames that are read before they are needed. One volume is written while the next is computed.
PREFETCH = 2


def reconstruct_frames(
    series: VolumeSeries,
    read: Callable[[int], Frame],
    make: Callable[[Frame], tuple[Volume, Note]],
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
        Maps it to a volume and a note.
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
    with (progress or Progress()).counter("Reconstructing", len(frames), rate="frames") as advance:
        pending: Future[Any] | None = None
        reader, writer = ThreadPoolExecutor(1), ThreadPoolExecutor(1)
        try:
            for frame, image in _read_ahead(reader, frames, read):
                try:
                    volume, note = check_volume(*make(image.result()))
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
    open_frames: Callable[[], tuple[Callable[[int], Frame], Callable[[Frame], tuple[Volume, Note]]]],
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
    with (progress or Progress()).counter("Reconstructing", len(frames), rate="frames") as advance:
        stream = workers.mapper(partial(_frame_maker, open_frames, series.path, series.grid))
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


def _frame_maker(open_frames, path: Path, grid: Grid):
    """In a worker: the function that makes a frame, and writes it if the store exists."""
    read, make = open_frames()
    levels = cache(partial(open_levels, path, grid))
    # Threads of a worker share one open file.
    lock = Lock()

    def make_frame(item):
        frame, exists = item
        with lock:
            image = read(frame)
        volume, note = check_volume(*make(image))
        if not exists:
            return volume, note
        write_frame(path, levels(), frame, volume)
        return None, note

    return make_frame


def check_volume(volume: Volume, note: Note) -> tuple[Volume, Note]:
    """Return both; `InputError` if a voxel is not finite."""
    check_finite("volume", volume, "voxels")
    return volume, note


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
