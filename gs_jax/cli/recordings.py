"""`gs-jax reconstruct` for recordings, and for the captures of a watched folder: all frames to one OME-Zarr."""

import atexit
import hashlib
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import click
import numpy as np

from ..base.errors import InputError, InputWarning
from ..base.machine import accelerator, copy_to
from ..base.progress import Progress
from ..base.workers import Workers
from ..io.files import side_file, write_figure
from .commands import RESUMABLE, OptionGroup, given_options, partial_outputs, plural, print_warning, provenance_of
from .options import CaptureOptions, Number, Parsed, objects_in, voxels

# Options that must not be given with tiles.
_WHOLE = ("points", "surface", "score", "deviation", "suppress", "stop_at_noise")
_WHOLE += ("watch", "frame_interval", "track", "track_memory", "warm_start")
# Failed frames that are named; others are only counted, and listed in the journal.
_MAX_NAMED = 10
# Options that do not change the volumes.
_OTHER_OPTIONS = ("capture", "design", "output", "points", "track", "track_memory", "resume", "watch", "force")
_OTHER_OPTIONS += ("workers", "scheduler")
# The table of points is written again after this multiple of the time that it took last, and seconds at least.
_SHARE, _PAUSE = 20, 1.0
# Seconds for which a thread keeps the interpreter: a tenth of the default, so that threads wait shorter for each other.
_SWITCH = 5e-4


def _search_range(text: str) -> tuple[float, ...]:
    um = Number(1e-2, 1e6, "um", usual=(0.1, 2e4))
    ranges = tuple(um.convert(part, None, None) for part in text.split(","))
    if len(ranges) > 2:
        raise click.BadParameter(f"must be XY or XY,Z in um, got {text!r}.")
    return ranges


@dataclass
class RecordingOptions(OptionGroup):
    """Options of recordings.

    Options:
        watch: CAPTURE is a folder into which a camera writes: reconstruct each capture as it comes, the newest first,
            to VOLUME.zarr, until Ctrl-C. Needs pip install 'gs-jax[live]'.
        frame_interval: Recordings: seconds between frames, the scale of the time axis. [default: unknown]
        track: Recordings with --points: largest displacement of a particle between frames, um, or two of them,
            laterally and along z, where points are 3 to 10 times less certain. POINTS.csv gets a column of particle
            numbers, and beside it are written POINTS.csv.tracks.csv, with the duration, path and mean speed of each,
            and a picture, POINTS.csv.tracks.png. Needs pip install 'gs-jax[track]'.
        track_memory: Frames from which a particle may be missing and keep its number. [default: 2]
        warm_start: Recordings by list-rl or richardson-lucy: start each frame from the volume of the one before, and
            take only the steps that it needs.
        resume: Recordings and --tiles: keep the frames or tiles that an interrupted run left in VOLUME.zarr, if any,
            and make the others. Without it, only --force replaces an unfinished VOLUME.zarr.
    """

    watch: bool = False
    frame_interval: Annotated[float, Number(1e-9, 1e9, "s")] | None = None
    track: Annotated[tuple[float, ...], Parsed("xy[,z]", _search_range)] | None = None
    track_memory: Annotated[int, click.IntRange(0, 10_000)] | None = None
    warm_start: bool | None = None
    resume: bool = False

    def track_files(self, points: Path) -> list[Path]:
        """The table of tracks and its picture beside a table of points, if particles are followed."""
        from ..io.traces import TRACKS_SUFFIXES

        return [side_file(points, suffix) for suffix in TRACKS_SUFFIXES if self.track]


@dataclass
class SeriesRun:
    """A run that makes the volumes of a recording, or of the captures that come into a folder.

    `plan` is a `Plan`, `frame` a `DepthFrame`.
    """

    capture: Path
    output: Path
    points: Path | None
    plan: Any
    camera: CaptureOptions
    frame: Any
    design: Any
    options: RecordingOptions
    workers: Workers
    force: bool

    def check(self, recording) -> bool:
        """Return whether there is a recording, or a folder to watch.

        Raises `InputError` if the output cannot hold one, or options of recordings are given without one.
        """
        from ..io.names import first_gap
        from ..io.ngff import check_replaceable

        options, is_series = self.options, recording is not None or self.options.watch
        if not is_series:
            given = given_options(vars(options)) or ["--workers or --scheduler"] * self.workers.remote
            if given:
                raise InputError(f"{given[0]} must be used with a recording, got a single capture {self.capture}.")
            if self.output.suffix.lower() == ".zarr" and not self.force:
                check_replaceable(self.output)
            return False
        if self.output.suffix.lower() != ".zarr":
            if recording is None:
                raise InputError(f"-o must be VOLUME.zarr, which grows in time, with --watch, got {self.output}.")
            count = len(recording.names)
            if recording.files == [self.capture]:
                raise InputError(
                    f"{self.capture} must be one image, got {count} pages: choose one by --page 1 to {count}, average "
                    "them by --page mean, or reconstruct all with -o VOLUME.zarr."
                )
            raise InputError(f"-o must be VOLUME.zarr, which has a time axis, for {count} frames, got {self.output}.")
        if recording is None and self.workers.remote:
            raise InputError(
                "--workers and --scheduler must not be given with --watch, which makes one volume at a time."
            )
        if given := given_options(("surface", "score", "deviation")):
            got = "--watch" if recording is None else f"{len(recording.names)} frames"
            raise InputError(f"{given[0]} must be used with a single capture, got {got}.")
        if not (options.resume or self.force):
            check_replaceable(self.output)
        if recording and (options.frame_interval or options.track) and (gap := first_gap(recording.names)):
            text = f"captures are missing between {gap[0]} and {gap[1]}; frames are taken as evenly spaced in time"
            warnings.warn(InputWarning(f"{self.capture}: {text}."), stacklevel=2)
        return True

    def reconstruct(self, recording, progress: Progress) -> int:
        """Make and write all frames, print a summary, and return the exit status: 1 if a frame failed."""
        from ..io.volumes import plain_depths
        from ..reconstruction.recording import reconstruct_frames, reconstruct_frames_by

        if self.workers.remote:
            self.camera.frames(recording)  # reads the correction, which is printed below; workers read their own
            opened = partial(_open_frames, self.capture, self.camera, self.plan)
            run = partial(reconstruct_frames_by, self.workers, open_frames=opened)
        else:
            read, make = _frames_of(recording, self.camera, self.plan)
            run = partial(reconstruct_frames, read=read, make=make)
        names = recording.names
        series = self._open_series(names)
        partial_outputs[self.output] = RESUMABLE
        before, start, failed = len(series.finished), time.monotonic(), []
        # Printed when a frame succeeds: if all fail, the error says the reason once.
        messages = []

        def on_failure(number: int, reason: str) -> None:
            failed.append(number)
            if len(failed) <= _MAX_NAMED:
                messages.append(f"gs-jax: frame {number} ({names[number]}): {reason}")
            if series.finished:
                print_messages()

        def print_messages() -> None:
            while messages:
                click.echo(messages.pop(0), err=True)

        run(series, on_failure=on_failure, progress=progress)
        print_messages()
        seconds, new = time.monotonic() - start, len(series.finished) - before
        lines = [f"{self.points}: {self._write_points(self.points, series)}"] if self.points else []
        self.camera.print_corrections()
        if check := _print_notes(series):
            lines.insert(0, f"{self.output}: {check}")
        shape, depths = (series.count, *self.plan.grid.volume_shape), plain_depths(self.frame.grid(self.plan.grid))
        rest = f"; {before} were there" if before else ""
        rate = (
            f"{new} frames in {seconds:.3g} s, {new / seconds:.3g} frames/s{rest}" if new else "all frames were there"
        )
        text = voxels(shape, "t, z, y, x", self.plan.grid.pitch, depths, self.plan.imager)
        for line in (f"{self.output}: {text}", f"{self.output}: {rate}", *lines):
            click.echo(line)
        if series.failed:
            numbers = ", ".join(map(str, sorted(series.failed)[:_MAX_NAMED]))
            numbers += ", ..." if len(series.failed) > _MAX_NAMED else ""
            text = f"{len(series.failed)} of {series.count} frames failed and are empty: {numbers}"
            click.echo(f"gs-jax: {self.output}: {text}; --resume tries them again", err=True)
        return int(bool(series.failed))

    def reconstruct_in_tiles(self, side: int | None, recording, progress: Progress) -> int:
        """Make and write one volume tile by tile, print a summary, and return the exit status."""
        from ..io.ngff import VolumeSeries, check_replaceable
        from ..io.volumes import plain_depths
        from ..reconstruction.tiles import make_tiles, reconstruct_tiles

        if recording is not None or self.output.suffix.lower() != ".zarr":
            got = f"{self.output}" if recording is None else f"{len(recording.names)} frames"
            raise InputError(f"--tiles must be used with one capture and -o VOLUME.zarr, got {got}.")
        if given := given_options(_WHOLE):
            raise InputError(f"{given[0]} must not be given with --tiles.")
        if not (self.options.resume or self.force):
            check_replaceable(self.output)
        tiles, image = make_tiles(self.plan, side, self.workers.count or 1), self.camera.read(self.capture)
        provenance = provenance_of(self.capture, self.plan.weights, *self.camera.files, design=self.design)
        options = {"request": request_of(provenance, None) | {"tiles": str(tiles.side)}, "resume": self.options.resume}
        provenance = self.camera.recorded(provenance) | (self.frame.note if self.plan.imager.sample is not None else {})
        grid = self.frame.grid(self.plan.grid)
        series = VolumeSeries(self.output, tiles.count, grid, **options, provenance=provenance, tile=tiles.side)
        partial_outputs[self.output] = RESUMABLE
        with self.workers:
            reconstruct_tiles(self.plan, tiles, image, series, self.workers, progress)
        self.camera.print_corrections()
        text = voxels(grid.volume_shape, "z, y, x", grid.pitch, plain_depths(grid), self.plan.imager)
        for line in (text, f"{plural(tiles.count, 'tile')} of {tiles.side} x {tiles.side} voxels"):
            click.echo(f"{self.output}: {line}")
        return print_failed_tiles(series)

    def watch(self, progress: Progress) -> None:
        """Make a volume of each capture that comes, until an interrupt, and print a summary."""
        from ..io.captures import read_images
        from ..io.recordings import Recording, WatchedFolder
        from ..reconstruction.recording import reconstruct_live

        folder, series = self.capture, self._open_series(None)

        def images(index, selection):
            return read_images(folder / series.names[index], selection._replace(page=self.camera.page))

        watched = WatchedFolder(folder)
        with progress.step("Preparing"):
            read, make = _frames_of(Recording(series.names, images, []), self.camera, self.plan, is_live=True)
        partial_outputs[self.output] = RESUMABLE
        state = _State(len(series.finished))
        table = _Table(partial(self._write_points, self.points, series)) if self.points else None

        def changes(timeout: float) -> list[str]:
            if table:
                table.write_if_due(len(series.finished))
            return watched.changes(timeout)

        def on_failure(number: int, reason: str) -> None:
            state.failures += 1
            if state.failures <= _MAX_NAMED:
                click.echo(f"gs-jax: frame {number} ({series.names[number]}): {reason}", err=True)

        click.echo(f"{folder}: watched until Ctrl-C, {objects_in(self.plan.imager)}", err=True)
        before, _ = sys.getswitchinterval(), sys.setswitchinterval(_SWITCH)
        try:
            with watched, progress.counter("Reconstructing", None, rate="frames", words=state.text) as advance:

                def on_done(done) -> None:
                    state.delays.append(done.delay)
                    state.waiting = done.waiting
                    advance()

                reconstruct_live(series, folder, changes, read, make, on_failure=on_failure, on_done=on_done)
        finally:
            sys.setswitchinterval(before)
            if table:
                table.write()
            self.camera.print_corrections()
            _print_notes(series)
            for line in state.summary(series):
                click.echo(f"{self.output}: {line}")

    def _open_series(self, names: list[str] | None):
        """Open the volumes of frames of these names, or of captures that are to come."""
        from ..io.names import plain_text
        from ..io.ngff import VolumeSeries
        from ..io.provenance import input_key

        provenance = provenance_of(self.plan.weights, *self.camera.files, design=self.design)
        request = request_of(provenance, names)
        source = f"{len(names)} frames, {names[0]} to {names[-1]}" if names else "a folder, as captures came"
        provenance = self.camera.recorded(provenance | {input_key(self.capture): plain_text(source)})
        self.provenance = provenance | (self.frame.note if self.plan.imager.sample is not None else {})
        options = {"interval": self.options.frame_interval, "resume": self.options.resume, "request": request}
        count, grid = len(names) if names else None, self.frame.grid(self.plan.grid)
        return VolumeSeries(self.output, count, grid, **options, provenance=self.provenance)

    def _write_points(self, path: Path, series) -> str:
        """Write the points of all frames, and their tracks; return their number, and that of particles, as text."""
        from ..detection.particles import MEMORY, track
        from ..io.point_tables import write_points_in_time
        from ..io.provenance import INTENSITY

        counts, followed = [0], []

        def count(frames) -> Iterator[tuple[int, dict[str, Any]]]:
            for number, columns in frames:
                counts.append(len(columns["x_mm"]))
                if "particle" in columns:
                    names = ("particle", "x_mm", "y_mm", "z_mm")
                    followed.append(np.column_stack([np.full(counts[-1], number), *(columns[name] for name in names)]))
                yield number, columns

        frames = ((number, self.frame.columns(note["points"])) for number, note in series.notes())
        if ranges := self.options.track:
            lateral, axial = ranges[0] / 1000, ranges[-1] / 1000
            memory = self.options.track_memory
            frames = track(frames, (lateral, axial), MEMORY if memory is None else memory)
        provenance = self.provenance | INTENSITY
        write_points_in_time(path, count(frames), provenance=provenance)
        text = plural(sum(counts), "point")
        if not ranges:
            return text
        particles = self._write_tracks(path, np.concatenate([np.zeros((0, 5)), *followed]), provenance)
        return f"{text} of {plural(particles, 'particle')}"

    def _write_tracks(self, points: Path, rows: np.ndarray, provenance: dict[str, str]) -> int:
        """Write the tracks of points `(frame, particle, x, y, z)` as a table and a picture; return their number."""
        from ..apps.trace_pictures import draw_tracks
        from ..detection.particles import tracks_table
        from ..io.point_tables import write_rows

        (frame, particle), positions = rows[:, :2].T.astype(int), rows[:, 2:]
        interval, (path, picture) = self.options.frame_interval, self.options.track_files(points)
        table = tracks_table(frame, particle, positions, interval)
        write_rows(path, table, zip(*table.values(), strict=True), provenance)
        write_figure(picture, draw_tracks(frame, particle, positions, interval))
        return len(table["particle"])


def print_failed_tiles(series) -> int:
    """Name the tiles of a volume that failed and are empty, warn if all is flat; return the exit status."""
    from ..base.arrays import flat_warning
    from ..io.ngff import open_levels

    if series.exists and (text := flat_warning(np.asarray(open_levels(series.path, series.grid)[-1][:]))):
        print_warning(text)
    for number, reason in series.failed.items():
        click.echo(f"gs-jax: tile {number}: {reason}", err=True)
    return int(bool(series.failed))


def request_of(provenance: dict[str, str], names: list[str] | None) -> dict[str, str]:
    """What the volumes depend on: options, the design, and the contents of the files beside the recording."""
    options = click.get_current_context().params
    request = {name: str(value) for name, value in options.items() if name not in _OTHER_OPTIONS and value is not None}
    request |= {name: text for name, text in provenance.items() if name.startswith(("input ", "design"))}
    request["points"] = str(bool(options.get("points")))
    if names is not None:
        request["names of frames"] = hashlib.sha256("\n".join(names).encode("utf-8", "surrogateescape")).hexdigest()
    return request


def _open_frames(capture: Path, camera: CaptureOptions, plan):
    """`_frames_of` a recording that stays open until the process ends; for workers."""
    from ..io.recordings import open_recording

    stack = ExitStack()
    atexit.register(stack.close)
    return _frames_of(
        stack.enter_context(open_recording(capture, page=camera.page, channel=camera.channel)), camera, plan
    )


def _frames_of(recording, camera: CaptureOptions, plan, *, is_live: bool = False):
    """Prepare a recording and a `Plan`; return `read` and `make` of `reconstruct_frames`.

    `is_live` compiles all before the first frame comes.
    """
    image_of, reconstruct = camera.frames(recording), plan.of_frames.prepare(Progress())
    if is_live:
        with suppress(InputError):
            reconstruct(_image_to_compile_for(plan), Progress())
    # Only the first frame is checked; an iterator gives one item to one thread.
    checks = iter([plan.check] if plan.is_learned else [])

    device = accelerator() if plan.reads_pixels_once and not is_live else None

    def read(frame):
        image, *lines = image_of(frame)
        if device and image.dtype.kind == "u":
            return frame, copy_to(device, image), *lines
        # One type for all frames, so that nothing is compiled twice.
        return frame, np.asarray(image, np.float32), *lines

    def make(frame, last):
        number, image, done, warnings = frame
        result = reconstruct(image, Progress(), last)
        if result.warning:
            warnings = [*warnings, result.warning]
        note: dict[str, Any] = {name: lines for name, lines in (("done", done), ("warnings", warnings)) if lines}
        for check in checks:
            text = format_residual(check(result.volume, image, Progress()))
            note["check"] = f"frame {number} imaged again is {text}"
        if result.points is not None:
            points = np.asarray(result.points).T
            columns = dict(zip(("x_mm", "y_mm", "z_mm", "intensity"), points, strict=True)) | (result.statistics or {})
            note["points"] = {name: np.asarray(values).tolist() for name, values in columns.items()}
        return result.volume, note, result.last

    return read, make


def _image_to_compile_for(plan):
    """An image for which all is compiled that captures need: dark, or of points where points are found."""
    if not plan.points and plan.suppress == "none":
        return np.zeros(plan.imager.sensor.shape, np.float32)
    from ..simulation import random_points, simulate

    depths, side = np.asarray(plan.grid.depths, float), float(plan.imager.field_radius)
    points = random_points(10, (side, side), (depths.min(), depths.max()), seed=0)
    return np.asarray(simulate(points, plan.imager, optics="near", psf="geometric"), np.float32)


def format_residual(residual) -> str:
    """A `ForwardResidual` as text."""
    error = f"{residual.error:.0%} RMS from the capture (correlation {residual.correlation:.3f})"
    return f"{error}, {residual.regions.max():.0%} where it is farthest"


def examine(plan, result, image, progress: Progress) -> tuple[dict[str, str], list[str]]:
    """What provenance and a report say of the reconstruction of an image: the sieve, and how a network's fits it."""
    lines = []
    if plan.is_learned:
        lines.append(f"imaged again it is {format_residual(plan.check(result.volume, image, progress))}")
    if result.sieve is None:
        return {}, lines
    lines.append(f"--sieve {result.sieve:.3g}, chosen by held-out pixels")
    return {"sieve": f"{result.sieve:.3g} voxels"}, lines


def _print_notes(series) -> str:
    """Print how many frames were corrected or have warnings, with the first warning; return the check."""
    from ..io.ngff import JOURNAL

    done, warned, first, check = 0, 0, "", ""
    for _, note in series.notes():
        done += bool(note.get("done"))
        warned += bool(note.get("warnings"))
        first = first or next(iter(note.get("warnings", [])), "")
        check = check or note.get("check", "")
    if done:
        where = f"{JOURNAL} in {series.path} has their numbers"
        click.echo(f"{plural(done, 'frame')}: pixels filled from neighbours; {where}")
    if warned:
        print_warning(f"in {plural(warned, 'frame')}, the first: {first}")
    return check


class _State:
    """Delays of the volumes of this run, seconds, and the number of captures that wait."""

    def __init__(self, before: int):
        self.before, self.delays, self.waiting, self.failures = before, [], 0, 0

    def text(self) -> str:
        late = f"delay {_format_delay(self.delays[-1])}" if self.delays else "no capture yet"
        return f"{late}, {self.waiting} waiting"

    def summary(self, series) -> list[str]:
        new, missing = len(self.delays), series.count - len(series.finished)
        rest = f"; {self.before} were there" if self.before else ""
        lines = [f"{plural(new, 'frame')} of {series.count}{rest}"]
        if new:
            middle, most = map(_format_delay, np.percentile(self.delays, (50, 95)))
            lines.append(f"from a capture's last byte to its volume: {middle} at the median, {most} in 95 %")
        if missing:
            # A bad capture that replaced a good one has the volume of that.
            bad = len(series.failed.keys() - series.finished)
            failed = f", {bad} failed" if bad else ""
            which, it = ("capture has", "it") if missing == 1 else ("captures have", "them")
            lines.append(f"{missing} {which} no volume{failed}; --resume makes {it}")
        return lines


def _format_delay(seconds: float) -> str:
    return f"{1000 * seconds:.0f} ms" if seconds < 10 else f"{seconds:.0f} s"


class _Table:
    """The table of points, written again while frames come, but in a small part of the time."""

    def __init__(self, write: Callable[[], object]):
        self._write, self._next, self._frames = write, 0.0, 0

    def write_if_due(self, frames: int) -> None:
        if frames > self._frames and time.monotonic() >= self._next:
            self._frames = frames
            self.write()

    def write(self) -> None:
        start = time.monotonic()
        self._write()
        end = time.monotonic()
        self._next = end + max(_PAUSE, _SHARE * (end - start))
