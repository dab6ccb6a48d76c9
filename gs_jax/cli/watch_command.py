"""`gs-jax reconstruct --watch`: captures to one OME-Zarr while a camera takes them."""

import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

from ..base.errors import InputError
from ..base.progress import Progress
from .command import RESUMABLE, partial_outputs, provenance_of
from .light import objects_in
from .options import CaptureOptions
from .recordings import MAX_NAMED, frames_of, print_notes, request_of, write_series_points

# The table of points is written again after this multiple of the time that it took last, and seconds at least.
_SHARE, _PAUSE = 20, 1.0
# Seconds for which a thread keeps the interpreter: a tenth of the default, so that threads wait shorter for each other.
_SWITCH = 5e-4


def check_watched(output: Path, single: dict[str, Any], *, workers: bool, resume: bool, force: bool) -> None:
    """Raise `InputError` if the output cannot hold the volumes of a watched folder, or if options exclude `--watch`.

    `single` are options of single captures.
    """
    from ..io.volume_series import check_replaceable

    if output.suffix.lower() != ".zarr":
        raise InputError(f"-o must be VOLUME.zarr, which grows in time, with --watch, got {output}.")
    if workers:
        raise InputError("--workers and --scheduler must not be given with --watch, which makes one volume at a time.")
    if option := next((name for name, value in single.items() if value), None):
        raise InputError(f"{option} must be used with a single capture, got --watch.")
    if not (resume or force):
        check_replaceable(output)


def watch_folder(
    folder: Path,
    plan,
    output: Path,
    *,
    design_text: str,
    camera: CaptureOptions,
    progress: Progress,
    points: Path | None,
    track: float | None,
    interval: float | None,
    resume: bool,
    frame,
) -> None:
    """Make a volume of each capture that comes, until an interrupt, and print a summary."""
    from ..io.captures import read_images
    from ..io.provenance import input_key
    from ..io.recordings import Recording
    from ..io.volume_series import VolumeSeries
    from ..io.watched_folder import WatchedFolder
    from ..reconstruction.recording import reconstruct_live

    page = camera.page
    images = lambda index, selection: read_images(folder / series.names[index], selection._replace(page=page))
    provenance = provenance_of(plan.weights, *camera.files, design=design_text)
    request = request_of(provenance)
    provenance = camera.recorded(provenance | {input_key(folder): "a folder, as captures came"})
    provenance |= frame.note if plan.imager.sample is not None else {}
    described = {"interval": interval, "request": request, "provenance": provenance}
    series = VolumeSeries(output, None, frame.grid(plan.grid), **described, resume=resume)
    watched = WatchedFolder(folder)
    with progress.step("Preparing"):
        read, make = frames_of(Recording(series.names, images, []), camera, plan, is_live=True)
    partial_outputs[output] = RESUMABLE
    state = _State(len(series.finished))
    table = _Table(partial(write_series_points, points, series, track, provenance, frame)) if points else None

    def changes(timeout: float) -> list[str]:
        if table:
            table.write_if_due(len(series.finished))
        return watched.changes(timeout)

    def on_failure(number: int, reason: str) -> None:
        state.failures += 1
        if state.failures <= MAX_NAMED:
            click.echo(f"gs-jax: frame {number} ({series.names[number]}): {reason}", err=True)

    click.echo(f"{folder}: watched until Ctrl-C, {objects_in(plan.imager)}", err=True)
    before, _ = sys.getswitchinterval(), sys.setswitchinterval(_SWITCH)
    try:
        with watched, progress.counter("Reconstructing", None, rate="frames", words=state.words) as advance:

            def on_done(done) -> None:
                state.delays.append(done.delay)
                state.waiting = done.waiting
                advance()

            reconstruct_live(series, folder, changes, read, make, on_failure=on_failure, on_done=on_done)
    finally:
        sys.setswitchinterval(before)
        if table:
            table.write()
        camera.print_corrections()
        print_notes(series)
        for line in state.summary(series):
            click.echo(f"{output}: {line}")


class _State:
    """Delays of the volumes of this run, seconds, and what waits."""

    def __init__(self, before: int):
        self.before, self.delays, self.waiting, self.failures = before, [], 0, 0

    def words(self) -> str:
        late = f"delay {_in_words(self.delays[-1])}" if self.delays else "no capture yet"
        return f"{late}, {self.waiting} waiting"

    def summary(self, series) -> list[str]:
        new, left = len(self.delays), series.count - len(series.finished)
        rest = f"; {self.before} were there" if self.before else ""
        lines = [f"{new} frame{'s' * (new != 1)} of {series.count}{rest}"]
        if new:
            middle, most = (_in_words(each) for each in np.percentile(self.delays, (50, 95)))
            lines.append(f"from a capture's last byte to its volume: {middle} at the median, {most} in 95 %")
        if left:
            # A bad capture that replaced a good one has the volume of that.
            bad = len(series.failed.keys() - series.finished)
            failed = f", {bad} failed" if bad else ""
            which, it = ("capture has", "it") if left == 1 else ("captures have", "them")
            lines.append(f"{left} {which} no volume{failed}; --resume makes {it}")
        return lines


def _in_words(seconds: float) -> str:
    return f"{1000 * seconds:.0f} ms" if seconds < 10 else f"{seconds:.0f} s"


class _Table:
    """The table of points, written again while frames come, but in a small part of the time."""

    def __init__(self, write):
        self._write, self._next, self._frames = write, 0.0, 0

    def write_if_due(self, frames: int) -> None:
        if frames > self._frames and time.monotonic() >= self._next:
            self._frames = frames
            self.write()

    def write(self) -> None:
        began = time.monotonic()
        self._write()
        ended = time.monotonic()
        self._next = ended + max(_PAUSE, _SHARE * (ended - began))
