"""`gs-jax traces`: signals of regions of a recording over time, from its volumes, its points, or its captures."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import click

from ..base.errors import InputError, errors_name_file
from ..base.progress import Progress
from ..io.files import check_output, side_file
from .commands import check_outputs, command, given_options, plural, print_warning, provenance_of
from .options import CAPTURE_OPTIONS, LIGHT_OPTIONS, CaptureOptions, DesignPath, Light, Number, Parsed

_SUMMARIES = ("deviation", "mean")
# Captures whose mean sets the weights of pixels.
_REFERENCES = 8


def _baseline(text: str) -> tuple[float, int | None]:
    percentile, _, window = text.partition(",")
    share = Number(0.0, 100.0, "%").convert(percentile, None, None)
    if window and not (window.isdecimal() and int(window) > 1):
        raise click.BadParameter(f"must be PERCENT or PERCENT,FRAMES with 2 frames or more, got {text!r}.")
    return share, int(window) if window else None


def _radius(text: str) -> tuple[float, float]:
    um = Number(1e-2, 1e6, "um", usual=(0.1, 2e4))
    parts = [um.convert(part, None, None) for part in text.split(",")]
    if len(parts) != 2:
        raise click.BadParameter(f"must be XY,Z in um, got {text!r}.")
    return parts[0] / 1000, parts[1] / 1000


@dataclass
class _Recording:
    """Regions of a recording, and their signals `(frame, region)` by name.

    `places` are `(1 or frame, region, 3)`, mm, `emitters` of each region its points, and `spread` how far its place
    moves along x or y, mm. `labels`, `image` and `grid` are those of volumes.
    """

    numbers: Any
    frames: Any
    places: Any
    signals: dict[str, Any]
    emitters: list[Any]
    spread: Any = 0.0
    count: int | None = None
    interval: float | None = None
    grid: Any = None
    labels: Any = None
    image: Any = None
    lines: list[str] = field(default_factory=list)


@command("traces", "Example: gs-jax traces volumes.zarr -o traces.csv")
def traces_command(
    source: Path,
    *,
    regions: Path | None = None,
    from_points: Path | None = None,
    radius_um: Annotated[tuple[float, float], Parsed("xy,z", _radius)] | None = None,
    segment: Annotated[str, click.Choice(_SUMMARIES)] | None = None,
    baseline: Annotated[tuple[float, int | None], Parsed("percent[,frames]", _baseline)] | None = None,
    demix: Path | None = None,
    design: DesignPath | None = None,
    output: Path,
    light: Light,
    camera: CaptureOptions,
    force: bool = False,
):
    """Write the signals of regions of a recording over time: a row for each region and frame.

    SOURCE is VOLUME.zarr (t, z, y, x) of `gs-jax reconstruct`, or POINTS.csv of one with --track. Regions of a volume
    are those of a label image (--regions), lie about points (--from-points), or are segmented here.

    Of volumes, `mean` is that of the region's voxels and `background` that of voxels about it in its planes; F is their
    difference. Of points, F is `intensity`. `dff` is (F - F0) / F0, with the baseline F0.

    With --demix, F is the light of each region in the captures themselves, by least squares of the images that the
    regions cast through the microscope of --design, none negative: `demixed`, with its standard error `demixed_se`. The
    light of neighbours is told apart, and that of other planes. SOURCE then only says where the regions are, and may
    be any POINTS.csv.

    \b
    Points that were found in the mean of the frames, demixed:
    gs-jax traces points.csv --demix "run7/*.tif" --design my.toml -o traces.csv

    Options:
        regions: LABELS.tif or .zarr: a label image of the volume, or of a plane, for all planes, as napari's Labels.
        from_points: POINTS.csv: the voxels about each point of it.
        radius_um: Half axes of these regions, laterally and along z. [default: 1.5 voxels and 1 plane,
            with both neighbouring planes]
        segment: Segment the standard deviation of the frames, or their mean, by a threshold and a watershed; the
            regions are also written to TRACES.csv.labels.tif. [default: deviation, without --regions and
            --from-points]
        baseline: F0: a percentile of F over all frames, or over so many frames about each. [default: 10]
        demix: Captures of the recording, as for `gs-jax reconstruct`.
        design: DESIGN.toml of the microscope, for --demix.
        output: TRACES.csv, or .h5 (needs pip install 'gs-jax[hdf5]'); a picture, TRACES.csv.png, is written beside it.
    """
    import numpy as np

    from ..apps.trace_pictures import draw_traces
    from ..design.design import read_design
    from ..io.files import write_figure
    from ..io.traces import TRACE_SUFFIXES, import_h5py, write_traces
    from ..io.volumes import write_labels
    from ..reconstruction.traces import relative_change, traces_table

    if bool(demix) != bool(design):
        given, other = ("--demix", "--design")[:: 1 if demix else -1]
        raise InputError(f"{given} must be used with {other}.")
    if not demix and (given := given_options((*CAPTURE_OPTIONS, *LIGHT_OPTIONS))):
        raise InputError(f"{given[0]} must be used with --demix.")
    if sum(option is not None for option in (regions, from_points, segment)) > 1:
        raise InputError("only one of --regions, --from-points and --segment must be given.")
    if radius_um and not from_points:
        raise InputError("--radius-um must be used with --from-points.")
    is_table = source.suffix.lower() == ".csv"
    if is_table and (given := given_options(("regions", "from_points", "segment"))):
        raise InputError(f"{given[0]} must be used with VOLUME.zarr, got {source}.")
    picture, beside = side_file(output, ".png"), side_file(output, ".labels.tif")
    own_labels = [beside] if not (is_table or regions or from_points) else []
    inputs = (source, regions, from_points, demix, design, *camera.files)
    check_output(output, TRACE_SUFFIXES)
    if output.suffix.lower() == ".h5":
        import_h5py()
    check_outputs(output, TRACE_SUFFIXES, picture, *own_labels, inputs=[*filter(None, inputs)], force=force)
    if own_labels and beside.exists() and not force:
        # It may have been corrected by hand.
        raise InputError(f"{beside}: the output must be a new file, got an existing one; --force replaces it.")
    with Progress() as progress:
        if is_table:
            found = _of_points(source, demixed=demix is not None)
        else:
            found = _of_volumes(source, regions, from_points, radius_um, segment or _SUMMARIES[0], progress)
        signal = found.signals["intensity"] if is_table and not demix else None
        microscope = None
        if demix and design:
            microscope = read_design(design)
            imager = camera.imager(light.of_channel(microscope, camera.channel).imager(microscope))
            signal = _demix(found, demix, imager, camera, progress)
        elif not is_table:
            signal = found.signals["mean"] - found.signals["background"]
        share, window = baseline or (10.0, None)
        found.signals["dff"] = relative_change(np.asarray(signal), share, window)
        table = traces_table(found.numbers, found.frames, found.places, found.signals, found.interval)
        used = f"{share:g} % of {'all frames' if window is None else f'{window} frames about each'}"
        provenance = camera.recorded(provenance_of(*inputs, design=microscope)) | {"baseline": f"percentile {used}"}
        with progress.step("Writing"):
            write_traces(output, table, provenance)
            labels = found.labels
            write_figure(
                picture, draw_traces(table, found.image, None if labels is None else labels.max(0), found.grid)
            )
            if own_labels and labels is not None:
                write_labels(beside, labels, found.grid, provenance)
    camera.print_corrections()
    text = f"{plural(len(found.numbers), 'region')} in {plural(len(found.frames), 'frame')}"
    for line in (*found.lines, f"{text}, dF/F over the percentile {used}"):
        click.echo(f"{output}: {line}")
    if dark := int(np.sum(~np.isfinite(found.signals["dff"]).any(axis=0))):
        print_warning(f"{plural(dark, 'region')} of {len(found.numbers)}: the baseline is not above 0, and dff is nan")


def _of_volumes(source: Path, regions, from_points, radius, summary: str, progress: Progress) -> _Recording:
    """Regions of volumes and their means, in two passes over the frames."""
    import numpy as np

    from ..io.ngff import frames_of, read_series, series_grid
    from ..io.point_tables import read_scene_points
    from ..io.traces import read_labels
    from ..reconstruction import traces

    series = read_series(source)
    if series is None or series.levels[0].ndim != 4:
        raise InputError(f"{source}: must be VOLUME.zarr of a recording by gs-jax reconstruct, or POINTS.csv.")
    volumes, grid = series.levels[0], series_grid(series)
    frames = frames_of(volumes.shape[0], source)
    shape = grid.volume_shape
    labels = read_labels(regions, shape) if regions else None
    if from_points:
        with errors_name_file(from_points):
            points = read_scene_points(from_points)
            if not len(points):
                raise InputError("must have points, got none.")
            labels = traces.regions_of_points(points, grid, radius)
    over_time = traces.SummaryVolumes(shape)
    for frame in progress.track(frames, "Reading volumes"):
        over_time.add(np.asarray(volumes[frame]))
    image = over_time.mean if summary == "mean" else over_time.deviation
    if labels is None:
        with progress.step("Segmenting"), errors_name_file(source):
            labels = traces.segment(image)
    signals = traces.RegionSignals(labels)
    rows = list(signals.measure(volumes, progress.track(frames, "Measuring")))
    means, backgrounds = (np.array(part) for part in zip(*rows, strict=True))
    emitters = traces.emitters_of_regions(labels, over_time.mean, backgrounds.mean(0), grid)
    places = np.array([[part[:, :3].T @ part[:, 3] for part in emitters]])
    line = f"{np.min(signals.sizes)} to {np.max(signals.sizes)} voxels a region"
    return _Recording(
        numbers=signals.numbers,
        frames=np.array(frames),
        places=places,
        signals={"mean": means, "background": backgrounds},
        emitters=emitters,
        count=volumes.shape[0],
        interval=series.interval,
        grid=grid,
        labels=labels,
        image=image.max(0),
        lines=[line],
    )


def _of_points(source: Path, *, demixed: bool) -> _Recording:
    """Particles of a table and their intensities; or points that stay where they are, to be demixed."""
    import numpy as np

    from ..io.point_tables import read_point_columns

    points, more = read_point_columns(source)
    if not len(points):
        raise InputError(f"{source}: must have points, got none.")
    frame = more.get("frame", np.zeros(len(points))).astype(int)
    if "particle" not in more and (not demixed or np.ptp(frame)):
        raise InputError(f"{source}: must have the columns frame and particle; gs-jax reconstruct --track writes them.")
    numbers, region = np.unique(more.get("particle", np.arange(1, len(points) + 1)).astype(int), return_inverse=True)
    frames, row = np.unique(frame, return_inverse=True)
    places = np.full((len(frames), len(numbers), 4), np.nan)
    if len(np.unique(np.stack([row, region]), axis=1).T) < len(points):
        raise InputError(f"{source}: a particle must be one point in each frame, got several.")
    places[row, region] = points
    middle = np.array([np.median(points[region == number], axis=0) for number in range(len(numbers))])
    emitters = [np.array([[*place[:3], 1.0]]) for place in middle]
    if demixed:
        spread = np.array([np.ptp(points[region == number, :2], axis=0).max() for number in range(len(numbers))])
        return _Recording(numbers, frames, middle[None, :, :3], {}, emitters, spread)
    return _Recording(numbers, frames, places[..., :3], {"intensity": places[..., 3]}, emitters)


def _demix(found: _Recording, captures: Path, imager, camera: CaptureOptions, progress: Progress):
    """Demix the captures, add the signals to those of the regions, and return them."""
    import numpy as np

    from ..io.recordings import open_recording
    from ..reconstruction.demixing import demix, image_regions, prepare_demixing

    pixel = imager.sensor.pixel_pitch / np.asarray(imager.magnification(found.places[0, :, 2]))
    if moving := int(np.sum(found.spread > pixel)):
        text = f"{moving} of {plural(len(found.numbers), 'particle')} move by more than a pixel"
        camera.warnings[f"{text}, and all frames are demixed with their median places"] = None
    with open_recording(captures, page=camera.page, channel=camera.channel) as recording:
        if recording is None:
            raise InputError(f"--demix must be a recording, got a single capture {captures}.")
        count = len(recording.names)
        if found.count not in (None, count):
            raise InputError(f"--demix must have the {found.count} frames of the volumes, got {count} ({captures}).")
        if found.count is None:
            found.frames = np.arange(count)
        read = camera.frames(recording)
        images = image_regions(found.emitters, imager, numbers=found.numbers, progress=progress)
        some = found.frames[np.linspace(0, len(found.frames) - 1, min(_REFERENCES, len(found.frames))).astype(int)]
        system = prepare_demixing(images, (read(int(frame))[0] for frame in some))
        rows, warned = [], []
        for frame in progress.track(found.frames, "Demixing"):
            image, _, warnings = read(int(frame))
            rows.append(demix(image, system))
            warned += warnings[:1]
    if warned:
        camera.warnings[f"in {plural(len(warned), 'frame')}, the first: {warned[0]}"] = None
    found.signals["demixed"], found.signals["demixed_se"] = (np.array(part) for part in zip(*rows, strict=True))
    found.lines.append(f"demixed in {len(system.pixels)} of {np.prod(imager.sensor.shape)} pixels")
    return found.signals["demixed"]
