"""`gs-jax reconstruct` of a recording: its frames to one OME-Zarr."""

import atexit
import hashlib
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import click

from ..base.errors import InputError
from ..base.progress import Progress
from ..base.workers import Workers
from .files import provenance_of
from .interrupt import RESUMABLE, kept
from .options import UM, CaptureOptions, Number, depth_range

# Frames that failed and are named as they do; later ones are counted, and are all in the store.
_NAMED = 10
# Options that say where results go and how, not what they are.
_ELSEWHERE = ("capture", "design", "output", "points", "track", "resume", "force", "workers", "scheduler")


def recording_options(command):
    """Of recordings alone."""
    interval = click.option(
        "--frame-interval",
        type=Number(least=1e-9, most=1e9, unit="s"),
        help="Of a recording: seconds from frame to frame, the scale of its time axis.  [default: unknown]",
    )
    resume = click.option(
        "--resume",
        is_flag=True,
        help="Of a recording: keep the frames that a run left in VOLUME.zarr, if any, and make the others. Without it "
        "an unfinished VOLUME.zarr is replaced by --force alone.",
    )
    track = click.option(
        "--track",
        type=UM,
        help="Of a recording with --points: how far a particle moves from frame to frame at most, um; POINTS.csv then "
        "says which particle a point is. Needs pip install 'gs-jax[track]'.",
    )
    return interval(track(resume(command)))


def check_recording(capture: Path, recording, output: Path, *, resume: bool, given: dict[str, Any], force: bool):
    """`InputError` where the output cannot hold time, or would be lost; or where there is no time for what is given."""
    from ..io.volume_series import check_replaceable

    if recording is None:
        if option := next((name for name, value in given.items() if value), None):
            raise InputError(f"{option}: found a single capture {capture}, allowed: a recording.")
        return
    if output.suffix.lower() != ".zarr":
        count = len(recording.names)
        if recording.files == [capture]:
            page = f"choose by --page 1 to {count}, or average repeated frames by --page mean"
            raise InputError(f"{capture}: found {count} pages, allowed: one ({page}), or for all -o VOLUME.zarr.")
        raise InputError(f"{output}: found a recording of {count} frames, allowed: VOLUME.zarr, which has a time axis.")
    if not (resume or force):
        check_replaceable(output)


def opened_frames(capture: Path, camera: CaptureOptions, making: Callable, again: Callable | None):
    """`read` and `make` of `reconstruct_frames`, of a recording that stays open: for a worker."""
    from ..io.recordings import opened_recording

    stack = ExitStack()
    # A worker has no other end, and what nobody holds is closed.
    atexit.register(stack.close)
    return frames_of(stack.enter_context(opened_recording(capture, page=camera.page)), camera, making, again)


def frames_of(recording, camera: CaptureOptions, making: Callable, again: Callable | None):
    """`read` and `make` of `reconstruct_frames`: what is the same for all frames is done here.

    `making` gives a `maker`'s function. `again` images a volume again, and compares it with its image; it does so with
    the first one.
    """
    frame_of, volume_of, checks = camera.frames(recording), making(Progress()), iter([again] if again else [])

    def make(frame):
        number, image, done, said = frame
        found = volume_of(image, Progress())
        if found.warning:
            said = [*said, found.warning]
        note: dict[str, Any] = {name: lines for name, lines in (("done", done), ("warnings", said)) if lines}
        for check in checks:
            words = in_words(check(found.volume, image, Progress()))
            note["check"] = f"frame {number} imaged again is {words}"
        if found.points is not None:
            note["points"] = _columns(found.points, found.evidence)
        return found.volume, note

    return lambda frame: (frame, *frame_of(frame)), make


def reconstruct_recording(
    recording,
    design_text: str,
    grid,
    making: Callable,
    output: Path,
    *,
    capture: Path,
    camera: CaptureOptions,
    progress: Progress,
    points: Path | None,
    track: float | None,
    weights: Path | None,
    interval: float | None,
    resume: bool,
    workers: Workers,
    again: Callable | None = None,
) -> int:
    """Makes and writes all frames, says what was made, and returns the exit status: 1 if a frame failed.

    `making`, `again`: as for `frames_of`; they can be pickled.
    """
    from ..io.volume_series import VolumeSeries
    from ..io.volumes import plain_depths
    from ..reconstruction.recording import reconstruct_frames, reconstruct_frames_by

    if workers.elsewhere:
        camera.frames(recording)  # for what is said of the correction, which workers read themselves
        run = partial(reconstruct_frames_by, workers, opened=partial(opened_frames, capture, camera, making, again))
    else:
        read, make = frames_of(recording, camera, making, again)
        run = partial(reconstruct_frames, read=read, make=make)
    names = recording.names
    provenance = provenance_of(weights, *camera.files, design=design_text)
    request = _request(names, provenance)
    provenance[f"input {capture.name}"] = f"{len(names)} frames, {names[0]} to {names[-1]}"
    provenance = camera.recorded(provenance)
    series = VolumeSeries(
        output, len(names), grid, interval=interval, request=request, provenance=provenance, resume=resume
    )
    kept[output] = RESUMABLE
    before, began = len(series.finished), time.monotonic()
    # Where every frame fails for one reason, that is said once, as the error.
    to_say, said = [], 0

    def failed(frame, reason):
        nonlocal said
        said += 1
        if said <= _NAMED:
            to_say.append(f"gs-jax: frame {frame} ({names[frame]}): {reason}")
        if series.finished:
            say()

    def say():
        while to_say:
            click.echo(to_say.pop(0), err=True)

    run(series, failed=failed, progress=progress)
    say()
    seconds, new = time.monotonic() - began, len(series.finished) - before
    found = ""
    if points:
        found = _write_points(points, series, track, provenance)
    camera.say()
    check = _say_of_frames(series)
    size = " x ".join(map(str, (series.count, *grid.volume_shape)))
    rest = f"; {before} were there" if before else ""
    rate = f"{new} frames in {seconds:.3g} s, {new / seconds:.3g} frames/s{rest}" if new else "all frames were there"
    voxels = f"{size} voxels (t, z, y, x), {grid.pitch * 1000:.4g} um laterally"
    click.echo(f"{output}: {voxels}, {depth_range(plain_depths(grid))}")
    click.echo(f"{output}: {rate}")
    if check:
        click.echo(f"{output}: {check}")
    if points:
        click.echo(f"{points}: {found}")
    if series.failed:
        some = ", ".join(map(str, sorted(series.failed)[:_NAMED])) + (", ..." if len(series.failed) > _NAMED else "")
        what = f"{len(series.failed)} of {series.count} frames failed and are empty: {some}"
        click.echo(f"gs-jax: {output}: {what}; --resume tries them again", err=True)
    return int(bool(series.failed))


def in_words(check) -> str:
    """How far a volume that is imaged again is from its capture."""
    error = f"{check.error:.0%} RMS from the capture (correlation {check.correlation:.3f})"
    return f"{error}, {check.regions.max():.0%} where it is farthest"


def _request(names, provenance) -> dict[str, str]:
    """What volumes depend on: options, the design, and the contents of the files beside the recording."""
    given = click.get_current_context().params
    request = {name: str(value) for name, value in given.items() if name not in _ELSEWHERE and value is not None}
    request |= {name: text for name, text in provenance.items() if name.startswith(("input ", "design"))}
    request["points"] = str(bool(given.get("points")))
    request["names of frames"] = hashlib.sha256("\n".join(names).encode()).hexdigest()
    return request


def _write_points(path, series, track, provenance) -> str:
    """Writes the points of all frames, and gives their number, and that of particles, in words."""
    from ..detection.tracking import tracked
    from ..io.point_tables import write_points_in_time

    points, particles = 0, 0

    def counted(frames):
        nonlocal points, particles
        for frame, columns in frames:
            points += len(columns["x_mm"])
            particles = max([particles, *(1 + number for number in columns.get("particle", ()))])
            yield frame, columns

    frames = ((frame, note["points"]) for frame, note in series.notes())
    write_points_in_time(path, counted(tracked(frames, track / 1000) if track else frames), provenance=provenance)
    words = f"{points} point{'s' * (points != 1)}"
    return f"{words} of {particles} particle{'s' * (particles != 1)}" if track else words


def _columns(points, evidence) -> dict[str, list]:
    import numpy as np

    named = dict(zip(("x_mm", "y_mm", "z_mm", "intensity"), np.asarray(points).T, strict=True)) | (evidence or {})
    return {name: np.asarray(values).tolist() for name, values in named.items()}


def _say_of_frames(series) -> str:
    """Says what was done to single frames and what is wrong with them: their number, and the first; gives the check."""
    from ..io.volume_series import JOURNAL

    done, wrong, first, check = 0, 0, "", ""
    for _, note in series.notes():
        done += bool(note.get("done"))
        wrong += bool(note.get("warnings"))
        first = first or next(iter(note.get("warnings", [])), "")
        check = check or note.get("check", "")
    if done:
        where = f"{JOURNAL} in {series.path} says how many"
        click.echo(f"{done} frame{'s' * (done > 1)}: pixels filled from neighbours; {where}")
    if wrong:
        click.echo(f"gs-jax: warning: in {wrong} frame{'s' * (wrong > 1)}, the first: {first}", err=True)
    return check
