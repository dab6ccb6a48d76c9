"""`gs-jax reconstruct` for recordings: all frames to one OME-Zarr."""

import atexit
import hashlib
import time
import warnings
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

import click

from ..base.errors import InputError, InputWarning
from ..base.progress import Progress
from ..base.workers import Workers
from .command import RESUMABLE, partial_outputs, provenance_of
from .light import objects_in
from .options import UM, CaptureOptions, Number, depth_range

# Failed frames that are named; others are only counted, and listed in the journal.
MAX_NAMED = 10
# Options that do not change the volumes.
_OTHER_OPTIONS = ("capture", "design", "output", "points", "track", "resume", "watch", "force", "workers", "scheduler")


def recording_options(command):
    """Add the options of recordings."""
    interval = click.option(
        "--frame-interval",
        type=Number(1e-9, 1e9, "s"),
        help="Recordings: seconds between frames, the scale of the time axis.  [default: unknown]",
    )
    resume = click.option(
        "--resume",
        is_flag=True,
        help="Recordings: keep the frames that an interrupted run left in VOLUME.zarr, if any, and make the others. "
        "Without it, only --force replaces an unfinished VOLUME.zarr.",
    )
    track = click.option(
        "--track",
        type=UM,
        help="Recordings with --points: largest displacement of a particle between frames, um; POINTS.csv gets a "
        "column of particle numbers. Needs pip install 'gs-jax[track]'.",
    )
    watch = click.option(
        "--watch",
        is_flag=True,
        help="CAPTURE is a folder into which a camera writes: reconstruct each capture as it comes, the newest first, "
        "to VOLUME.zarr, until Ctrl-C. Needs pip install 'gs-jax[live]'.",
    )
    warm = click.option(
        "--warm-start",
        is_flag=True,
        default=None,
        help="Recordings by list-rl or richardson-lucy: start each frame from the volume of the one before, and "
        "take only the steps that it needs.",
    )
    return watch(interval(track(warm(resume(command)))))


def check_recording(capture: Path, recording, output: Path, *, resume: bool, given: dict[str, Any], force: bool):
    """Raise `InputError` if the output cannot hold a recording, or `given` are options of recordings without one."""
    from ..io.names import first_gap
    from ..io.volume_series import check_replaceable

    if recording is None:
        if option := next((name for name, value in given.items() if value), None):
            raise InputError(f"{option} must be used with a recording, got a single capture {capture}.")
        return
    if output.suffix.lower() != ".zarr":
        count = len(recording.names)
        if recording.files == [capture]:
            raise InputError(
                f"{capture} must be one image, got {count} pages: choose one by --page 1 to {count}, average them by "
                "--page mean, or reconstruct all with -o VOLUME.zarr."
            )
        raise InputError(f"-o must be VOLUME.zarr, which has a time axis, for {count} frames, got {output}.")
    if not (resume or force):
        check_replaceable(output)
    if (given["--frame-interval"] or given["--track"]) and (gap := first_gap(recording.names)):
        text = (
            f"{capture}: captures are missing between {gap[0]} and {gap[1]}; frames are taken as evenly spaced in time"
        )
        warnings.warn(InputWarning(f"{text}."), stacklevel=2)


def open_frames(capture: Path, camera: CaptureOptions, plan):
    """`frames_of` a recording that stays open until the process ends; for workers."""
    from ..io.recordings import open_recording

    stack = ExitStack()
    atexit.register(stack.close)
    return frames_of(stack.enter_context(open_recording(capture, page=camera.page)), camera, plan)


def frames_of(recording, camera: CaptureOptions, plan, *, is_live: bool = False):
    """Prepare a recording and a `Plan`; return `read` and `make` of `reconstruct_frames`.

    `is_live` compiles all before the first frame comes.
    """
    import numpy as np

    image_of, reconstruct = camera.frames(recording), plan.prepare(Progress())
    if is_live:
        with suppress(InputError):
            reconstruct(_image_to_compile_for(plan), Progress())
    # Only the first frame is checked; an iterator gives one item to one thread.
    checks = iter([plan.check] if plan.is_learned else [])

    def make(frame, last):
        number, image, done, warnings = frame
        result = reconstruct(image, Progress(), last)
        if result.warning:
            warnings = [*warnings, result.warning]
        note: dict[str, Any] = {name: lines for name, lines in (("done", done), ("warnings", warnings)) if lines}
        for check in checks:
            words = residual_in_words(check(result.volume, image, Progress()))
            note["check"] = f"frame {number} imaged again is {words}"
        if result.points is not None:
            points = np.asarray(result.points).T
            columns = dict(zip(("x_mm", "y_mm", "z_mm", "intensity"), points, strict=True)) | (result.statistics or {})
            note["points"] = {name: np.asarray(values).tolist() for name, values in columns.items()}
        return result.volume, note, result.last

    return lambda frame: (frame, *image_of(frame)), make


def _image_to_compile_for(plan):
    """An image for which all is compiled that captures need: dark, or of points where points are found."""
    import numpy as np

    if not plan.points and plan.suppress == "none":
        return np.zeros(plan.imager.sensor.shape, np.float32)
    from ..simulation.phantoms import random_points
    from ..simulation.synthetic import simulate

    depths, side = np.asarray(plan.grid.depths, float), float(plan.imager.field_radius)
    points = random_points(10, (side, side), (depths.min(), depths.max()), seed=0)
    return np.asarray(simulate(points, plan.imager, optics="near", psf="geometric"), np.float32)


def reconstruct_recording(
    recording,
    plan,
    output: Path,
    *,
    design_text: str,
    capture: Path,
    camera: CaptureOptions,
    progress: Progress,
    points: Path | None,
    track: float | None,
    interval: float | None,
    resume: bool,
    workers: Workers,
    frame,
) -> int:
    """Make and write all frames, print a summary, and return the exit status: 1 if a frame failed."""
    from ..io.names import plain_text
    from ..io.provenance import input_key
    from ..io.volume_series import VolumeSeries
    from ..io.volumes import plain_depths
    from ..reconstruction.recording import reconstruct_frames, reconstruct_frames_by

    if workers.remote:
        camera.frames(recording)  # reads the correction, which is printed below; workers read their own
        run = partial(reconstruct_frames_by, workers, open_frames=partial(open_frames, capture, camera, plan))
    else:
        read, make = frames_of(recording, camera, plan)
        run = partial(reconstruct_frames, read=read, make=make)
    names = recording.names
    provenance = provenance_of(plan.weights, *camera.files, design=design_text)
    request = request_of(provenance, names)
    provenance[input_key(capture)] = plain_text(f"{len(names)} frames, {names[0]} to {names[-1]}")
    provenance = camera.recorded(provenance)
    provenance |= frame.note if plan.imager.sample is not None else {}
    grid = frame.grid(plan.grid)
    described = {"interval": interval, "request": request, "provenance": provenance}
    series = VolumeSeries(output, len(names), grid, **described, resume=resume)
    partial_outputs[output] = RESUMABLE
    before, began = len(series.finished), time.monotonic()
    # Printed when a frame succeeds: if all fail, the error says the reason once.
    messages, failures = [], 0

    def on_failure(frame, reason):
        nonlocal failures
        failures += 1
        if failures <= MAX_NAMED:
            messages.append(f"gs-jax: frame {frame} ({names[frame]}): {reason}")
        if series.finished:
            print_messages()

    def print_messages():
        while messages:
            click.echo(messages.pop(0), err=True)

    run(series, on_failure=on_failure, progress=progress)
    print_messages()
    seconds, new = time.monotonic() - began, len(series.finished) - before
    written = write_series_points(points, series, track, provenance, frame) if points else ""
    camera.print_corrections()
    check = print_notes(series)
    size = " x ".join(map(str, (series.count, *plan.grid.volume_shape)))
    rest = f"; {before} were there" if before else ""
    rate = f"{new} frames in {seconds:.3g} s, {new / seconds:.3g} frames/s{rest}" if new else "all frames were there"
    voxels = f"{size} voxels (t, z, y, x), {plan.grid.pitch * 1000:.4g} um laterally"
    click.echo(f"{output}: {voxels}, {depth_range(plain_depths(grid))}, {objects_in(plan.imager)}")
    click.echo(f"{output}: {rate}")
    if check:
        click.echo(f"{output}: {check}")
    if points:
        click.echo(f"{points}: {written}")
    if series.failed:
        numbers = ", ".join(map(str, sorted(series.failed)[:MAX_NAMED]))
        numbers += ", ..." if len(series.failed) > MAX_NAMED else ""
        failed = f"{len(series.failed)} of {series.count} frames failed and are empty: {numbers}"
        click.echo(f"gs-jax: {output}: {failed}; --resume tries them again", err=True)
    return int(bool(series.failed))


def residual_in_words(residual) -> str:
    """A `ForwardResidual` in words."""
    error = f"{residual.error:.0%} RMS from the capture (correlation {residual.correlation:.3f})"
    return f"{error}, {residual.regions.max():.0%} where it is farthest"


def request_of(provenance: dict[str, str], names: list[str] | None = None) -> dict[str, str]:
    """What the volumes depend on: options, the design, and the contents of the files beside the recording."""
    options = click.get_current_context().params
    request = {name: str(value) for name, value in options.items() if name not in _OTHER_OPTIONS and value is not None}
    request |= {name: text for name, text in provenance.items() if name.startswith(("input ", "design"))}
    request["points"] = str(bool(options.get("points")))
    if names is not None:
        request["names of frames"] = hashlib.sha256("\n".join(names).encode("utf-8", "surrogateescape")).hexdigest()
    return request


def write_series_points(path, series, track, provenance, frame) -> str:
    """Write the points of all frames; return their number, and that of particles, in words."""
    from ..detection.linking import track as track_particles
    from ..io.point_tables import write_points_in_time
    from ..io.provenance import INTENSITY

    points, particles = 0, 0

    def count(frames):
        nonlocal points, particles
        for number, columns in frames:
            points += len(columns["x_mm"])
            particles = max([particles, *(1 + particle for particle in columns.get("particle", ()))])
            yield number, columns

    frames = ((number, frame.columns(note["points"])) for number, note in series.notes())
    if track:
        frames = track_particles(frames, track / 1000)
    write_points_in_time(path, count(frames), provenance=provenance | INTENSITY)
    words = f"{points} point{'s' * (points != 1)}"
    return f"{words} of {particles} particle{'s' * (particles != 1)}" if track else words


def print_notes(series) -> str:
    """Print how many frames were corrected or have warnings, with the first warning; return the check."""
    from ..io.volume_series import JOURNAL

    done, warned, first, check = 0, 0, "", ""
    for _, note in series.notes():
        done += bool(note.get("done"))
        warned += bool(note.get("warnings"))
        first = first or next(iter(note.get("warnings", [])), "")
        check = check or note.get("check", "")
    if done:
        where = f"{JOURNAL} in {series.path} has their numbers"
        click.echo(f"{done} frame{'s' * (done > 1)}: pixels filled from neighbours; {where}")
    if warned:
        click.echo(f"gs-jax: warning: in {warned} frame{'s' * (warned > 1)}, the first: {first}", err=True)
    return check
