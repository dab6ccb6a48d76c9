"""`gs-jax reconstruct`: a volume, and points, from a capture or from each frame of a recording."""

from contextlib import nullcontext
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import click

from ..base.errors import InputError, needs_extra
from ..base.progress import Progress
from ..io.files import check_output
from .command import OptionGroup, check_may_write, command, plural, print_warning, provenance_of
from .options import (
    FIDELITIES,
    METHODS,
    SUPPRESSIONS,
    CaptureOptions,
    DepthLight,
    DesignPath,
    Number,
    SampleDepthList,
    Steps,
    Um,
    WorkerOptions,
    check_even,
    voxels,
)
from .recordings import RecordingOptions, SeriesRun, format_residual


@dataclass
class MethodOptions(OptionGroup):
    """Options of methods, as `Plan.of` takes them.

    Options:
        method: Back-projection, or an iterative method.
        steps: Steps of list-rl, richardson-lucy, fista and admm; unrolled and surface have their own. [default: 20]
        optics: Model of the light: all of it, one PSF for all lenses near a point, or chief rays alone.
        tv: Weight of total variation (richardson-lucy, admm).
        sparsity: Weight of the sum of voxels (fista, admm).
        stop_at_noise: Stop early when all but noise is explained (list-rl to admm in --method).
        suppress: Background suppression: points on which their lenses agree, the paper's clusters, or a network.
        weights: WEIGHTS.npz of `gs-jax train`, for --method unrolled or --suppress unet. [default: ours]
        sheets: Sheets one behind the other (surface). [default: 1]
    """

    method: Annotated[str, click.Choice(METHODS)] = "backproject"
    steps: Steps | None = None
    optics: Annotated[str, click.Choice(FIDELITIES)] = "full"
    tv: Annotated[float, Number(0.0, 10.0)] | None = None
    sparsity: Annotated[float, Number(0.0, 1.0)] | None = None
    stop_at_noise: bool = False
    suppress: Annotated[str, click.Choice(SUPPRESSIONS)] = "none"
    weights: Path | None = None
    sheets: Annotated[int, click.IntRange(1, 8)] | None = None


@command(
    "reconstruct",
    "Example: gs-jax reconstruct capture.tif design/geomscope.toml --depths 18:22:0.25 -o volume.ome.tif",
)
def reconstruct_command(
    capture: Path,
    design: DesignPath,
    *,
    depths: SampleDepthList,
    voxel_um: Um | None = None,
    options: MethodOptions,
    output: Path,
    points: Path | None = None,
    surface: Path | None = None,
    score: bool = False,
    light: DepthLight,
    recording: RecordingOptions,
    workers: WorkerOptions,
    camera: CaptureOptions,
    force: bool = False,
):
    """Reconstruct the volume in CAPTURE, an image by the microscope of the file DESIGN.

    CAPTURE is a grey TIFF, PNG or .npy of the sensor's size; other files need --page, --channel, --bayer, --roi or
    --binning. --dark, --flat, --bad-pixels and --offset correct it. The volume opens to scale in Fiji and napari.

    CAPTURE may be a recording: a TIFF or .npy of several pages, a folder of captures, a pattern in quotes, or a Zarr
    array (t, y, x). All frames go to one VOLUME.zarr (t, z, y, x); a frame that fails is named and left empty (exit
    status 1).

    \b
    A recording of 20 frames a second, to be continued after an interrupt:
    gs-jax reconstruct "run7/*.tif" my.toml --depths 18:22:0.25 --frame-interval 0.05 -o run7.zarr --resume

    \b
    A part of the sensor, binned, with a dark frame and a flat field:
    gs-jax reconstruct part.tif my.toml --roi 1024,512,2048,2048 --binning 2
      --dark dark.tif --flat flat.tif --depths 18:22:0.25 -o volume.ome.tif

    Options:
        depths: START:STOP:STEP in mm from the array, STOP included; or one depth.
        voxel_um: Lateral voxel pitch; doubling it takes about a quarter of the time. [default: one pixel as seen at the
            middle depth; 4 pixels for iterative methods]
        output: VOLUME.ome.tif, or VOLUME.zarr for OME-Zarr and for recordings.
        points: POINTS.csv: also write the points in the capture; of a recording with their frame.
        surface: SURFACE.ome.tif or .ply: also write brightness and depth of --method surface, as maps in um or a mesh
            in mm.
        score: Also reconstruct four times without a quarter of the lenses, predict their light, and tell how well: a
            score without ground truth.
    """
    from ..design.design import read_design
    from ..io.point_tables import write_points
    from ..io.provenance import INTENSITY, SCORE, DepthFrame
    from ..io.recordings import open_recording
    from ..io.surfaces import SURFACE_SUFFIXES, write_surface
    from ..io.volumes import VOLUME_SUFFIXES, write_volume
    from ..projection.linear_map import compiled_for_cpu
    from ..reconstruction.plan import Plan

    check_output(output, VOLUME_SUFFIXES)
    check_even(output, depths)
    if surface:
        check_output(surface, SURFACE_SUFFIXES)
        if options.method != "surface":
            raise InputError(f"--surface must be used with --method surface, got {options.method}.")
    if score and (options.suppress != "none" or options.method == "surface"):
        got = f"--suppress {options.suppress} and --method {options.method}"
        raise InputError(f"--score must be used with --suppress none and methods of free voxels, got {got}.")
    if output.suffix.lower() == ".zarr":
        with needs_extra("zarr"):
            import_module("zarr")
    if points:
        check_output(points, [".csv"])
    if recording.track:
        from ..detection.particles import import_linker

        if not points:
            raise InputError("--track must be used with --points POINTS.csv, which has the particles.")
        import_linker()
    inputs = (capture, design, options.weights, *camera.files)
    check_may_write(None if recording.resume else output, points, surface, inputs=inputs, force=force)
    if capture.suffix.lower() == ".toml":
        raise InputError(f"{capture}: CAPTURE must be an image, got a design: CAPTURE comes first, then DESIGN.")
    microscope = read_design(design)
    imager = camera.imager(light.imager(microscope))
    frame, from_array = DepthFrame(light.origin(imager)), light.from_array(depths, imager)
    if recording.warm_start and workers.remote:
        raise InputError("--warm-start must be used without --workers and --scheduler, which take frames in any order.")
    further: dict[str, Any] = {"points": points is not None, "warm_start": bool(recording.warm_start)}
    plan = Plan.of(imager, from_array, voxel_um and voxel_um / 1000, **vars(options), **further)
    series = SeriesRun(capture, output, points, plan, camera, frame, microscope, recording, workers, force)
    if recording.watch:
        series.check(None)
        with Progress() as progress:
            return series.watch(progress)
    with open_recording(capture, page=camera.page) as frames, Progress() as progress:
        if series.check(frames):
            with workers:
                return series.reconstruct(frames, progress)
        image = camera.read(capture)
        reconstruct = plan.prepare(progress)
        # Back-projection alone runs its kernels once; iterative methods and points run them many times.
        is_single_pass = options.method == "backproject" and plan.suppress != "points" and not points
        with compiled_for_cpu("xla") if is_single_pass else nullcontext():
            result = reconstruct(image, progress)
        residual = plan.check(result.volume, image, progress) if plan.is_learned else None
        predicted = _format_score(plan.score(image, progress)) if score else None
        with progress.step("Writing"):
            provenance = camera.recorded(provenance_of(capture, options.weights, *camera.files, design=microscope))
            provenance |= frame.note if imager.sample is not None else {}
            provenance |= {SCORE: predicted} if predicted else {}
            write_volume(output, result.volume, frame.grid(plan.grid), provenance)
            if points and result.points is not None:
                write_points(points, *frame.points(result.points, result.statistics), provenance=provenance | INTENSITY)
            if surface and (fit := result.surface):
                maps = fit.brightness, fit.depth, fit.depth_sd
                write_surface(surface, *maps, plan.grid, below=frame.surface or 0.0, provenance=provenance)
    camera.print_corrections()
    click.echo(f"{output}: {voxels(result.volume.shape, 'z, y, x', plan.grid.pitch, depths, imager)}")
    if residual:
        click.echo(f"{output}: imaged again it is {format_residual(residual)}")
    if predicted:
        click.echo(f"{output}: {predicted}")
    if fit := result.surface:
        others = f"one more {fit.further_error:.1%}, free voxels {fit.free_error:.1%}"
        click.echo(f"{surface or output}: sheets leave {fit.error:.1%} of the capture unexplained (RMS), {others}")
    if result.points is not None:
        click.echo(f"{points or output}: {plural(len(result.points), 'point')}")
    if result.warning:
        print_warning(result.warning)


def _format_score(score) -> str:
    noise = f"; its noise allows {score.best_db:.1f} dB" if score.noise else ""
    return f"it predicts lenses that were left out {score.score_db:.1f} dB better than an empty volume does{noise}"
