"""`gs-jax reconstruct`: a volume, and points, from a capture or from each frame of a recording."""

from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from ..base.errors import InputError, needs_extra
from ..base.progress import Progress
from ..base.workers import Workers
from ..io.files import check_output
from .command import check_even, check_may_write, force_option, provenance_of
from .light import Light, light_options, objects_in
from .options import (
    DESIGN,
    FIDELITIES,
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
from .recordings import check_recording, reconstruct_recording, recording_options, residual_in_words
from .watch_command import check_watched, watch_folder


@click.command(
    "reconstruct",
    epilog="Example: gs-jax reconstruct capture.tif design/geomscope.toml --depths 18:22:0.25 -o volume.ome.tif",
)
@click.argument("capture", type=Path)
@click.argument("design", type=DESIGN)
@click.option(
    # From the sample's surface, 0 is a depth.
    "--depths",
    type=Depths(0.0),
    required=True,
    help="START:STOP:STEP in mm from the array, STOP included; or one depth.",
)
@click.option(
    "--voxel-um",
    type=UM,
    help="Lateral voxel pitch; doubling it takes about a quarter of the time.  [default: one pixel as seen at the "
    "middle depth; 4 pixels for iterative methods]",
)
@click.option("--method", type=click.Choice(METHODS), default="backproject")
@click.option(
    "--steps",
    type=click.IntRange(1, 100_000),
    help="Steps of list-rl, richardson-lucy, fista and admm; unrolled and surface have their own.  [default: 20]",
)
@click.option(
    "--optics",
    type=click.Choice(FIDELITIES),
    default="full",
    help="Model of the light: all of it, one PSF for all lenses near a point, or chief rays alone.",
)
@click.option("--tv", type=Number(0.0, 10.0), help="Weight of total variation (richardson-lucy, admm).")
@click.option("--sparsity", type=Number(0.0, 1.0), help="Weight of the sum of voxels (fista, admm).")
@click.option(
    "--stop-at-noise", is_flag=True, help="Stop early when all but noise is explained (list-rl to admm in --method)."
)
@click.option(
    "--suppress",
    type=click.Choice(SUPPRESSIONS),
    default="none",
    help="Background suppression: points on which their lenses agree, the paper's clusters, or a network.",
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
    "--points", type=Path, help="POINTS.csv: also write the points in the capture; of a recording with their frame."
)
@click.option("--sheets", type=click.IntRange(1, 8), help="Sheets one behind the other (surface).  [default: 1]")
@click.option(
    "--surface",
    type=Path,
    help="SURFACE.ome.tif or .ply: also write brightness and depth of --method surface, as maps in um or a mesh in mm.",
)
@click.option(
    "--score",
    is_flag=True,
    help="Also reconstruct four times without a quarter of the lenses, predict their light, and tell how well: a score "
    "without ground truth.",
)
@light_options
@recording_options
@worker_options
@capture_options
@force_option
def reconstruct_command(
    capture: Path,
    design: Path,
    depths: list[float],
    voxel_um: float | None,
    output: Path,
    points: Path | None,
    surface: Path | None,
    score: bool,
    weights: Path | None,
    force: bool,
    frame_interval: float | None,
    track: float | None,
    warm_start: bool | None,
    resume: bool,
    watch: bool,
    light: Light,
    camera: CaptureOptions,
    workers: Workers,
    **method_options: Any,
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
    """
    from ..design.design import design_text, read_design
    from ..io.point_tables import write_points
    from ..io.provenance import INTENSITY, SCORE, DepthFrame
    from ..io.recordings import open_recording
    from ..io.volumes import SURFACE_SUFFIXES, VOLUME_SUFFIXES, write_surface, write_volume
    from ..projection.linear_map import compiled_for_cpu
    from ..reconstruction.plan import Plan

    check_output(output, VOLUME_SUFFIXES)
    check_even(output, depths)
    if surface:
        check_output(surface, SURFACE_SUFFIXES)
        if method_options["method"] != "surface":
            raise InputError(f"--surface must be used with --method surface, got {method_options['method']}.")
    if score and (method_options["suppress"] != "none" or method_options["method"] == "surface"):
        got = "--suppress {suppress} and --method {method}".format(**method_options)
        raise InputError(f"--score must be used with --suppress none and methods of free voxels, got {got}.")
    if output.suffix.lower() == ".zarr":
        with needs_extra("zarr"):
            import_module("zarr")
    if points:
        check_output(points, [".csv"])
    if track:
        from ..detection.linking import import_linker

        if not points:
            raise InputError("--track must be used with --points POINTS.csv, which has the particles.")
        import_linker()
    check_may_write(
        None if resume else output, points, surface, inputs=(capture, design, weights, *camera.files), force=force
    )
    if capture.suffix.lower() == ".toml":
        raise InputError(f"{capture}: CAPTURE must be an image, got a design: CAPTURE comes first, then DESIGN.")
    microscope = read_design(design)
    text, imager = design_text(microscope), camera.imager(light.imager(microscope))
    frame, shown = DepthFrame(light.origin(imager)), depths
    depths = light.from_array(depths, imager)
    if warm_start and workers.remote:
        raise InputError("--warm-start must be used without --workers and --scheduler, which take frames in any order.")
    method_options |= {"points": points is not None, "weights": weights, "warm_start": bool(warm_start)}
    plan = Plan.of(imager, depths, voxel_um and voxel_um / 1000, **method_options)
    how = {"track": track, "interval": frame_interval, "resume": resume}
    if watch:
        check_watched(
            output, {"--surface": surface, "--score": score}, workers=workers.remote, resume=resume, force=force
        )
        with Progress() as progress:
            files = {"design_text": text, "camera": camera, "points": points, "frame": frame}
            return watch_folder(capture, plan, output, **files, **how, progress=progress)
    with open_recording(capture, page=camera.page) as recording, Progress() as progress:
        given = {"--resume": resume, "--frame-interval": frame_interval, "--track": track, "--warm-start": warm_start}
        given["--workers or --scheduler"] = workers.remote
        check_recording(capture, recording, output, resume=resume, given=given, force=force)
        if recording and (surface or score):
            option = "--surface" if surface else "--score"
            raise InputError(f"{option} must be used with a single capture, got {len(recording.names)} frames.")
        if recording:
            files = {"design_text": text, "capture": capture, "camera": camera, "points": points, "frame": frame}
            with workers:
                return reconstruct_recording(
                    recording, plan, output, **files, **how, workers=workers, progress=progress
                )
        image = camera.read(capture)
        reconstruct = plan.prepare(progress)
        # Back-projection alone runs its kernels once; iterative methods and points run them many times.
        is_single_pass = method_options["method"] == "backproject" and plan.suppress != "points" and not points
        with compiled_for_cpu("xla") if is_single_pass else nullcontext():
            result = reconstruct(image, progress)
        residual = plan.check(result.volume, image, progress) if plan.is_learned else None
        predicted = _score_in_words(plan.score(image, progress)) if score else None
        with progress.step("Writing"):
            provenance = camera.recorded(provenance_of(capture, weights, *camera.files, design=text))
            provenance |= frame.note if imager.sample is not None else {}
            provenance |= {SCORE: predicted} if predicted else {}
            write_volume(output, result.volume, frame.grid(plan.grid), provenance)
            if points and result.points is not None:
                write_points(points, *frame.points(result.points, result.statistics), provenance=provenance | INTENSITY)
            if surface and (fit := result.surface):
                maps = fit.brightness, fit.depth, fit.depth_sd
                write_surface(surface, *maps, plan.grid, below=frame.surface or 0.0, provenance=provenance)
    camera.print_corrections()
    z, y, x = result.volume.shape
    size = f"{z} x {y} x {x} voxels (z, y, x), {plan.grid.pitch * 1000:.4g} um laterally"
    click.echo(f"{output}: {size}, {depth_range(shown)}, {objects_in(imager)}")
    if residual:
        click.echo(f"{output}: imaged again it is {residual_in_words(residual)}")
    if predicted:
        click.echo(f"{output}: {predicted}")
    if fit := result.surface:
        others = f"one more {fit.further_error:.1%}, free voxels {fit.free_error:.1%}"
        click.echo(f"{surface or output}: sheets leave {fit.error:.1%} of the capture unexplained (RMS), {others}")
    if result.points is not None:
        count = len(result.points)
        click.echo(f"{points or output}: {count} point{'s' * (count != 1)}")
    if result.warning:
        click.echo(f"gs-jax: warning: {result.warning}", err=True)


def _score_in_words(found) -> str:
    noise = f"; its noise allows {found.best_db:.1f} dB" if found.noise else ""
    return f"it predicts lenses that were left out {found.score_db:.1f} dB better than an empty volume does{noise}"
