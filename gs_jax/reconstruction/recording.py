"""From a recording to volumes in time: frames are read ahead and written behind while one is computed."""

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float32

from ..base.errors import InputError
from ..base.progress import Progress
from ..io.volume_series import Note, VolumeSeries

Frame = TypeVar("Frame")

# Frames that are read before they are asked for. One volume is written while the next is computed.
AHEAD = 2


def reconstruct_frames(
    series: VolumeSeries,
    read: Callable[[int], Frame],
    make: Callable[[Frame], tuple[Float32[np.ndarray, "depth row column"], Note]],
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
                    volume, note = make(found.result())
                    if not np.isfinite(volume).all():
                        raise InputError("found a NaN or an infinity in the volume, allowed: finite numbers.")
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
