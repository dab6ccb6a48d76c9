"""From a recording to volumes in time: frames are read ahead and written behind while one is computed, or are shared
out to workers."""

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from ..base.errors import InputError
from ..base.progress import Progress
from ..base.workers import Workers
from ..grid import Grid
from ..io.volume_series import Note, VolumeSeries, opened_levels, write_frame
from ..typing import Volume

Frame = TypeVar("Frame")

# Frames that are read before they are asked for. One volume is written while the next is computed.
AHEAD = 2


def reconstruct_frames(
    series: VolumeSeries,
    read: Callable[[int], Frame],
    make: Callable[[Frame], tuple[Volume, Note]],
    *,
    failed: Callable[[int, str], object] = lambda frame, reason: None,
    progress: Progress | None = None,
) -> None:
    """Makes and writes the volumes that a series lacks.

    At most four frames are in memory: `AHEAD` that are read, one that is computed and one that is written. Whatever
    ends it, the volumes that were written are kept.

    Parameters
    ----------
    series
        Where volumes go.
    read
        From a frame, counted from 0, to what `make` takes; runs in a thread of its own.
    make
        To a volume, and what is to be noted of it.
    failed
        Told of a frame whose `read` or `make` raised `InputError`, and why; the others go on.
    progress
        Shows how far it is.

    Raises
    ------
    InputError
        If every frame failed: the first one's.
    """
    frames = series.unfinished
    with (progress or Progress()).counter("Reconstructing", len(frames), rate="frames") as done:
        pending: Future[Any] | None = None
        reader, writer = ThreadPoolExecutor(1), ThreadPoolExecutor(1)
        try:
            for frame, found in _ahead(reader, frames, read):
                try:
                    volume, note = _finite(*make(found.result()))
                    job = partial(series.write, frame, volume, note)
                except InputError as error:
                    job = partial(series.fail, frame, str(error))
                    failed(frame, str(error))
                if pending:
                    pending.result()
                pending = writer.submit(job)
                # The writer holds the volume until it is written; here it would be there while the next is computed.
                volume = job = None
                done()
            if pending:
                pending.result()
        finally:
            reader.shutdown(cancel_futures=True)
            writer.shutdown()
    _check_some(series)


def reconstruct_frames_by(
    workers: Workers,
    series: VolumeSeries,
    opened: Callable[[], tuple[Callable[[int], Frame], Callable[[Frame], tuple[Volume, Note]]]],
    *,
    failed: Callable[[int, str], object] = lambda frame, reason: None,
    progress: Progress | None = None,
) -> None:
    """As `reconstruct_frames`, by other processes, which write the volumes where the store is; this one says which.

    A frame whose worker died is made again: the same files hold the same. The first few volumes come here, where the
    first makes the store.

    Parameters
    ----------
    workers
        Other processes, entered.
    series, failed, progress
        As for `reconstruct_frames`.
    opened
        Gives `read` and `make`, once in each worker; can be pickled.

    Raises
    ------
    InputError
        As `reconstruct_frames`.
    """
    frames = series.unfinished
    items = ((frame, series.exists) for frame in frames)
    with (progress or Progress()).counter("Reconstructing", len(frames), rate="frames") as done:
        for (frame, _), result in workers.stream_of(partial(_writer, opened, series.path, series.grid))(items):
            try:
                volume, note = result()
            except InputError as error:
                series.fail(frame, str(error))
                failed(frame, str(error))
            else:
                series.write(frame, volume, note)
            done()
    _check_some(series)


def _writer(opened, path: Path, grid: Grid):
    """From a frame and whether the store is there to its volume, or None if it is written there; and the note."""
    read, make = opened()
    levels = cache(partial(opened_levels, path, grid))
    reading = Lock()

    def written(item):
        frame, exists = item
        # A worker of several threads has one file open for all of them.
        with reading:
            found = read(frame)
        volume, note = _finite(*make(found))
        if not exists:
            return volume, note
        write_frame(path, levels(), frame, volume)
        return None, note

    return written


def _finite(volume, note):
    if not np.isfinite(volume).all():
        raise InputError("found a NaN or an infinity in the volume, allowed: finite numbers.")
    return volume, note


def _check_some(series):
    if series.failed and not series.finished:
        raise InputError(series.failed[min(series.failed)])


def _ahead(reader: ThreadPoolExecutor, frames: Iterable[int], read: Callable[[int], Frame]):
    """Frames and what is read of them, some of which is being read before it is asked for."""
    waiting: deque[tuple[int, Future[Frame]]] = deque()
    for frame in frames:
        waiting.append((frame, reader.submit(read, frame)))
        if len(waiting) > AHEAD:
            yield waiting.popleft()
    yield from waiting
