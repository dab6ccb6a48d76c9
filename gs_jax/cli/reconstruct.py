"""`gs-jax reconstruct`: a capture to a volume, or to points; a recording to volumes in time."""

from contextlib import nullcontext
from functools import partial
from pathlib import Path

import click

from ..base.errors import InputError
from ..base.progress import Progress
from ..base.workers import Workers
from ..io.files import check_output
from .files import check_may_write, force_option, provenance_of
from .options import (
    DESIGN,
    LEVELS,
    METHODS,
    SUPPRESSIONS,
    UM,
    CaptureOptions,
    Depths,
    Number,
    capture_options,
    depth_range,
    worker_options,
)
from .recording_command import check_recording, in_words, reconstruct_recording, recording_options


@click.command(
    "reconstruct",
    epilog="Example: gs-jax reconstruct capture.tif design/geomscope.toml --depths 18:22:0.25 -o volume.ome.tif",
)
@click.argument("capture", type=Path)
@click.argument("design", type=DESIGN)
@click.option(
    "--depths", type=Depths(), required=True, help="START:STOP:STEP in mm from the plate, STOP included; or one."
)
@click.option(
    "--voxel-um",
    type=UM,
    help="Lateral voxel pitch; twice as wide takes about a quarter of the time.  "
    "[default: a pixel, seen at the middle depth; 4 pixels for iterative methods]",
)
@click.option("--method", type=click.Choice(METHODS), default="backproject", show_default=True)
@click.option(
    "--steps",
    type=click.IntRange(1, 100_000),
    default=20,
    show_default=True,
    help="Of list-rl to admm; unrolled has its own.",
)
@click.option(
    "--optics",
    type=click.Choice(LEVELS),
    default="full",
    show_default=True,
    help="What the method knows of the light: all, one PSF for all lenses near a point, or chief rays alone.",
)
@click.option(
    "--tv", type=Number(least=0.0, most=10.0, unit=""), help="Weight of total variation (richardson-lucy, admm)."
)
@click.option(
    "--sparsity", type=Number(least=0.0, most=1.0, unit=""), help="Weight of the sum of voxels (fista, admm)."
)
@click.option(
    "--stop-at-noise", is_flag=True, help="End before the last step where all but noise is explained (list-rl to admm)."
)
@click.option(
    "--suppress",
    type=click.Choice(SUPPRESSIONS),
    default="none",
    show_default=True,
    help="Background suppression: points that their lenses agree on, the paper's clusters, or a network for anything.",
)
@click.option(
    "--weights",
    type=Path,
    help="WEIGHTS.npz of `gs-jax train`, for --method unrolled or --suppress unet.  [default: ours]",
)
@click.option(
    "-o", "--output", type=Path, required=True, help="VOLUME.ome.tif, or VOLUME.zarr for OME-Zarr and for recordings."
)
@click.option(
    "--points",
    type=Path,
    help="POINTS.csv: write the points that the capture shows, too; of a recording with their frame, from 0.",
)
@recording_options
@worker_options
@capture_options
@force_option
def reconstruct_command(
    capture: Path,
    design: Path,
    depths: list[float],
    voxel_um: float | None,
    method: str,
    steps: int,
    optics: str,
    tv: float | None,
    sparsity: float | None,
    stop_at_noise: bool,
    suppress: str,
    weights: Path | None,
    output: Path,
    points: Path | None,
    force: bool,
    frame_interval: float | None,
    track: float | None,
    resume: bool,
    camera: CaptureOptions,
    workers: Workers,
):
    """Reconstruct the volume that CAPTURE shows, taken with the microscope of the file DESIGN.

    CAPTURE is a grey TIFF, PNG or .npy of the sensor's size, or what --page, --channel, --bayer, --roi, --binning say
    of it; --dark, --flat, --bad-pixels and --offset correct it. The volume is written to scale, for Fiji and napari.

    CAPTURE may be a recording: a TIFF or .npy of several pages, a folder of captures, a pattern in quotes, or a Zarr
    array (t, y, x). All frames go to one VOLUME.zarr (t, z, y, x); a bad one is named and left empty (exit status 1).

    \b
    A recording of 20 frames a second, and on after an interrupt:
    gs-jax reconstruct "run7/*.tif" my.toml --depths 18:22:0.25 --frame-interval 0.05 -o run7.zarr --resume

    \b
    A part of the sensor, binned, with a dark frame and a flat field:
    gs-jax reconstruct part.tif my.toml --roi 1024,512,2048,2048 --binning 2
      --dark dark.tif --flat flat.tif --depths 18:22:0.25 -o volume.ome.tif
    """
    from ..design.design import design_text, read_design
    from ..io.recordings import opened_recording
    from ..io.volumes import VOLUME_SUFFIXES, write_volume
    from ..projection.cpu.dispatch import once
    from ..reconstruction.workflow import imaged_again, plan

    check_output(output, VOLUME_SUFFIXES)
    if points:
        check_output(points, [".csv"])
    if track:
        from ..detection.tracking import linker

        if not points:
            raise InputError("--track: found no --points, allowed: with POINTS.csv, which has the particles.")
        linker()
    check_may_write(None if resume else output, points, inputs=(capture, design, weights, *camera.files), force=force)
    if capture.suffix.lower() == ".toml":
        raise InputError(f"{capture}: found a design in the place of CAPTURE, allowed: CAPTURE first, then DESIGN.")
    microscope = read_design(design)
    imager = camera.imager(microscope.imager())
    grid, making = plan(
        imager,
        depths,
        voxel_um and voxel_um / 1000,
        method=method,
        steps=steps,
        optics=optics,
        tv=tv,
        sparsity=sparsity,
        stop_at_noise=stop_at_noise,
        suppress=suppress,
        points=points is not None,
        weights=weights,
    )
    again = partial(imaged_again, imager, grid, optics) if method == "unrolled" or suppress == "unet" else None
    with opened_recording(capture, page=camera.page) as recording, Progress() as progress:
        given = {"--resume": resume, "--frame-interval": frame_interval, "--track": track}
        given["--workers or --scheduler"] = workers.elsewhere
        check_recording(capture, recording, output, resume=resume, given=given, force=force)
        if recording:
            with workers:
                return reconstruct_recording(
                    recording,
                    design_text(microscope),
                    grid,
                    making,
                    output,
                    capture=capture,
                    camera=camera,
                    progress=progress,
                    points=points,
                    track=track,
                    weights=weights,
                    interval=frame_interval,
                    resume=resume,
                    workers=workers,
                    again=again,
                )
        image = camera.read(capture)
        made = making(progress)
        # The paper's method is a single pass. All others, and points, are many.
        with once() if method == "backproject" and suppress != "points" and not points else nullcontext():
            volume, found, evidence, warning = made(image, progress)
        check = again(volume, image, progress) if again else None
        with progress.step("Writing"):
            provenance = camera.recorded(provenance_of(capture, weights, *camera.files, design=design_text(microscope)))
            write_volume(output, volume, grid, provenance)
            if points and found is not None:
                from ..io.point_tables import write_points

                write_points(points, found, evidence, provenance=provenance)
    camera.say()
    z, y, x = volume.shape
    size = f"{z} x {y} x {x} voxels (z, y, x), {grid.pitch * 1000:.4g} um laterally"
    click.echo(f"{output}: {size}, {depth_range(depths)}")
    if check:
        click.echo(f"{output}: imaged again it is {in_words(check)}")
    if found is not None:
        click.echo(f"{points or output}: {len(found)} point{'s' * (len(found) != 1)}")
    if warning:
        click.echo(f"gs-jax: warning: {warning}", err=True)
