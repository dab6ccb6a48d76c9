"""`gs-jax reconstruct` and `deconvolve`: volumes from captures, by a design or by measured PSFs."""

from contextlib import nullcontext
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import click
import numpy as np

from ..base.errors import InputError, input_error, needs_extra
from ..base.progress import Progress
from ..io.files import TIFF_SUFFIXES, check_output
from .channels import reconstruct_channels
from .commands import (
    RESUMABLE,
    OptionGroup,
    check_may_write,
    check_outputs,
    command,
    given_options,
    partial_outputs,
    plural,
    print_warning,
    provenance_of,
)
from .options import (
    FIDELITIES,
    METHODS,
    SUPPRESSIONS,
    Binning,
    CaptureOptions,
    DepthLight,
    DesignPath,
    MaskDepthList,
    Number,
    Page,
    PictureOptions,
    SampleDepthList,
    Steps,
    TileSide,
    Um,
    WorkerOptions,
    check_even,
    depth_range,
    voxels,
)
from .recordings import RecordingOptions, SeriesRun, examine, print_failed_tiles, request_of


@dataclass
class MethodOptions(OptionGroup):
    """Options of methods, as `Plan.from_options` takes them.

    Options:
        method: Back-projection, or an iterative method.
        steps: Steps of list-rl, richardson-lucy, fista and admm, in large volumes mostly on wider voxels, where the
            first two take 24 and 8 at least; unrolled and surface have their own. [default: 20]
        optics: Model of the light: all of it, one PSF for all lenses near a point, or chief rays alone.
        tv: Weight of total variation (richardson-lucy, admm).
        sparsity: Weight of the sum of voxels (fista, admm).
        sieve: Standard deviation, in voxels, of the finest detail (list-rl, richardson-lucy; not in tiles). [default:
            1.4, or 0 where pixels that are held out ask for it; 0 in volumes below 96 voxels a side, recordings, tiles]
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
    sieve: Annotated[float, Number(0.0, 2.0)] | None = None
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
    deviation: Path | None = None,
    tiles: TileSide | None = None,
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
        deviation: DEVIATION.ome.tif: also write the standard deviation of each voxel, by the reconstructions
            of --score.
        tiles: Compute and write a large volume to VOLUME.zarr in tiles, squares of so many voxels a side, or of as many
            as fit into memory. --resume, --workers and --scheduler are as for recordings.
    """
    from ..design.design import read_design
    from ..io.point_tables import write_points
    from ..io.provenance import DEVIATION, INTENSITY, SCORE, DepthFrame
    from ..io.recordings import open_recording
    from ..io.volumes import SURFACE_SUFFIXES, VOLUME_SUFFIXES, write_surface, write_volume
    from ..linear.linear_map import compiled_for_cpu
    from ..reconstruction.plan import Plan
    from ..reconstruction.residual import format_deviation

    check_output(output, VOLUME_SUFFIXES)
    check_even(output, depths)
    if surface:
        check_output(surface, SURFACE_SUFFIXES)
        if options.method != "surface":
            raise InputError(f"--surface must be used with --method surface, got {options.method}.")
    if deviation:
        check_output(deviation, TIFF_SUFFIXES)
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
    elif recording.track_memory is not None:
        raise InputError("--track-memory must be used with --track.")
    tracks = recording.track_files(points) if points else []
    for path in tracks:
        check_output(path, [path.suffix])
    inputs = (capture, design, options.weights, *camera.files)
    outputs = (None if recording.resume else output, points, surface, deviation, *tracks)
    check_may_write(*outputs, inputs=inputs, force=force)
    if capture.suffix.lower() == ".toml":
        raise InputError(f"{capture}: CAPTURE must be an image, got a design: CAPTURE comes first, then DESIGN.")
    microscope = read_design(design)
    names = [name.strip() for name in (camera.channel or "").split(",")]
    if len(names) > 1:
        return reconstruct_channels(capture, microscope, names, depths, voxel_um, options, output, light, camera)
    light = light.of_channel(microscope, camera.channel)
    imager = camera.imager(light.imager(microscope))
    frame, from_array = DepthFrame(light.origin(imager)), light.from_array(depths, imager)
    if recording.warm_start and workers.remote:
        raise InputError("--warm-start must be used without --workers and --scheduler, which take frames in any order.")
    further: dict[str, Any] = {"points": points is not None, "warm_start": bool(recording.warm_start)}
    further["in_tiles"] = tiles is not None
    plan = Plan.from_options(imager, from_array, voxel_um and voxel_um / 1000, **vars(options), **further)
    if score or deviation:
        plan.check_scored("--score" if score else "--deviation")
    series = SeriesRun(capture, output, points, plan, camera, frame, microscope, recording, workers, force)
    if recording.watch:
        series.check(None)
        with Progress() as progress:
            return series.watch(progress)
    with open_recording(capture, page=camera.page, channel=camera.channel) as frames, Progress() as progress:
        if tiles is not None:
            return series.reconstruct_in_tiles(None if tiles == "auto" else int(tiles), frames, progress)
        if series.check(frames):
            with workers:
                return series.reconstruct(frames, progress)
        image = camera.read(capture)
        reconstruct = plan.prepare(progress)
        # Back-projection alone runs its kernels once; iterative methods and points run them many times.
        is_single_pass = options.method == "backproject" and plan.suppress != "points" and not points
        with compiled_for_cpu("xla") if is_single_pass else nullcontext():
            result = reconstruct(image, progress)
        noted, lines = examine(plan, result, image, progress)
        validation = plan.score(image, progress) if score or deviation else None
        predicted = _format_score(validation) if score else None
        with progress.step("Writing"):
            provenance = camera.recorded(provenance_of(capture, options.weights, *camera.files, design=microscope))
            provenance |= frame.note if imager.sample is not None else {}
            provenance |= {SCORE: predicted} if predicted else {}
            provenance |= noted
            write_volume(output, result.volume, frame.grid(plan.grid), provenance)
            if deviation and validation:
                own = provenance | {DEVIATION: f"of the voxels of {output.name}"}
                write_volume(deviation, validation.deviation, frame.grid(plan.grid), own)
            if points and result.points is not None:
                write_points(points, *frame.points(result.points, result.statistics), provenance=provenance | INTENSITY)
            if surface and (fit := result.surface):
                maps = fit.brightness, fit.depth, fit.depth_sd
                write_surface(surface, *maps, plan.grid, below=frame.surface or 0.0, provenance=provenance)
    camera.print_corrections()
    click.echo(f"{output}: {voxels(result.volume.shape, 'z, y, x', plan.grid.pitch, depths, imager)}")
    for line in lines:
        click.echo(f"{output}: {line}")
    if predicted:
        click.echo(f"{output}: {predicted}")
    if deviation and validation:
        click.echo(f"{deviation}: {format_deviation(result.volume, validation.deviation)}")
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


_DECONVOLVERS = ("admm", "fista", "richardson-lucy", "wiener")
# Options of the methods that take steps.
_ITERATIVE = ("steps", "stop_at_noise", "psf_places", "refine_psf", "tv", "tv_z", "sparsity")


@dataclass
class Weights(OptionGroup):
    """Weights of the methods that take steps.

    Options:
        tv: Weight of total variation (admm, richardson-lucy): the more, the smoother. [default: admm takes the weight
            that predicts parts of CAPTURE best which are held out]
        tv_z: How much neighbouring planes are to be alike, relative to neighbouring pixels (admm). [default: 1]
        sparsity: Weight of the sum of voxels (admm, fista): the more, the darker.
    """

    tv: Annotated[float, Number(0.0, 10.0)] | None = None
    tv_z: Annotated[float, Number(0.0, 1000.0)] | None = None
    sparsity: Annotated[float, Number(0.0, 1.0)] | None = None


@command("deconvolve", "Example: gs-jax deconvolve capture.tif psf_stack.tif -o volume.ome.tif")
def deconvolve_command(
    capture: Path,
    psf: tuple[Path, ...],
    *,
    depths: MaskDepthList | None = None,
    voxel_um: Um | None = None,
    method: Annotated[str, click.Choice(_DECONVOLVERS)] = "admm",
    steps: Steps = 100,
    weights: Weights,
    stop_at_noise: bool = False,
    psf_page: Page | None = None,
    psf_places: Path | None = None,
    refine_psf: bool = False,
    binning: Binning = 1,
    output: Path,
    tiles: TileSide | None = None,
    resume: bool = False,
    camera: PictureOptions,
):
    """Reconstruct the scene in CAPTURE, taken through a diffuser, a lens array or another mask, from measured PSFs.

    A PSF is what the camera sees of one small source in the middle of the field, such as a lit pinhole. From one PSF
    follows the plane where the source was. From a stack, a PSF at each depth, follows a volume with a plane for each:
    give the pages of a TIFF, a folder of images, a Zarr array (z, y, x), or several files in order.

    If the PSF changes over the field, measure it at several places and list them with --psf-places. The order of
    sources is free; scale and orientation need not be known.

    All files may be TIFF, PNG or .npy, in the same pixels; a PSF may be smaller than CAPTURE, its source then being in
    the PSF's middle. --dark, --flat, --bad-pixels and --offset correct all of them; --channel is taken of those in
    colour.

    \b
    One plane:
    gs-jax deconvolve capture.tif psf.tif -o scene.tif

    \b
    A volume from PSFs at 10, 10.5, ... 20 mm, with squares of 2 x 2 pixels summed:
    gs-jax deconvolve capture.tif psfs/ --depths 10:20:0.5 --binning 2 -o volume.ome.tif

    Options:
        depths: START:STOP:STEP in mm, STOP included, or a list such as 10,12,40: depths of the planes, in the order of
            the PSFs. [default: planes are numbered]
        voxel_um: What a pixel of CAPTURE is wide in the scene, for scale bars.
        method: admm: smooth areas with edges, best for most scenes; fista: separate points; richardson-lucy: dim light,
            where photons are few; wiener: a preview in a second, of one plane.
        steps: At most so many steps.
        stop_at_noise: Stop early when all but noise is explained.
        psf_page: Make one plane of each PSF file: of this page, from 1; or of the mean of repeated frames.
            [default: a plane for each page]
        psf_places: PLACES.csv, x_mm,y_mm,z_mm, a line for each PSF: of sources all over the field, four or more at each
            z, if the PSF varies over the field.
        refine_psf: Fit scale and blur of the PSFs together with the scene, kept if they predict held-out pixels
            better.
        binning: Sum squares of so many pixels a side, of CAPTURE and PSFs alike: 2 takes a quarter of time and memory.
        output: VOLUME.ome.tif, .npy, or .zarr (with --depths and --voxel-um), float32, planes of CAPTURE's size.
        tiles: Compute and write a large scene to VOLUME.zarr in tiles, squares of so many pixels a side, or of as many
            as fit into memory.
        resume: Keep the tiles that an interrupted run left in VOLUME.zarr, if any, and make the others.
    """
    from ..base.arrays import flat_warning
    from ..io.captures import write_capture
    from ..io.ngff import VolumeSeries, check_replaceable
    from ..io.recordings import spot_names
    from ..io.volumes import STACK_SUFFIXES, write_planes
    from ..microscope.grid import Grid
    from ..reconstruction.deconvolution import SOLVERS, bin_pixels, filter_image, pad_to_largest, run_deconvolution
    from ..reconstruction.deconvolution_tiles import deconvolve_tiles, scene_tiles
    from ..reconstruction.field_fit import fit_field
    from ..reconstruction.pipeline import method_by_name
    from ..reconstruction.psf_fit import fit_psf

    files = [path for path in (*psf, psf_places, *camera.files) if path]
    check_outputs(None if resume else output, STACK_SUFFIXES, inputs=(capture, *files))
    if tiles is not None and (output.suffix.lower() != ".zarr" or method == "wiener" or psf_places or stop_at_noise):
        allowed = "-o VOLUME.zarr, methods that take steps, and without --psf-places and --stop-at-noise"
        raise InputError(f"--tiles must be used with {allowed}.")
    if resume and tiles is None:
        raise InputError("--resume must be used with --tiles.")
    if refine_psf and (tiles is not None or psf_places):
        raise InputError(f"--refine-psf must be used without {'--psf-places' if psf_places else '--tiles'}, got both.")
    if not resume and output.suffix.lower() == ".zarr":
        check_replaceable(output, "remove it")
    places, solver = None, None
    if method != "wiener":
        solver = method_by_name(SOLVERS, method, steps, vars(weights))
    elif given := given_options(_ITERATIVE):
        raise InputError(f"{', '.join(given)} must not be given with --method wiener, which takes no steps.")
    if psf_places:
        if depths:
            raise InputError("--depths must not be given with --psf-places, whose z_mm are the depths, got both.")
        if weights.tv_z is not None:
            raise InputError("--tv-z must not be given with --psf-places, got both.")
        places = _read_places(psf_places, psf)
        depths = None if np.isnan(places[:, 2]).any() else np.unique(places[:, 2]).tolist()
    if output.suffix.lower() == ".zarr" and not (depths and voxel_um):
        raise InputError(f"{output}: OME-Zarr needs --depths and --voxel-um, got not both; use .ome.tif or .npy.")
    check_even(output, depths)
    if depths and depths[0] <= 0 and voxel_um and output.suffix.lower() != ".npy":
        raise input_error("z_mm", "positive with --voxel-um", f"{depths[0]:g}", psf_places)
    names, fit, refined, result = spot_names(psf, psf_page), None, None, None
    with Progress() as progress:
        with progress.step("Reading"):
            image = bin_pixels(camera.read(capture), binning)
            planes = [bin_pixels(spot, binning) for spot in camera.read_spots(psf, psf_page)]
            spots = pad_to_largest(planes)
        if depths and places is None and len(depths) != len(spots):
            raise InputError(f"--depths must be one for each PSF, {len(spots)} in all, got {len(depths)} depths.")
        if places is not None:
            with progress.step("Fitting the PSFs"):
                fit = fit_field(spots, places, image.shape)
        if tiles is not None:
            assert solver is not None and depths is not None and voxel_um is not None
            grid = Grid(depths, image.shape, voxel_um * binning / 1000)
            parts = scene_tiles(grid, spots, solver, None if tiles == "auto" else int(tiles))
            provenance = provenance_of(capture, *files)
            options = {"request": request_of(provenance, None) | {"tiles": str(parts.side)}, "resume": resume}
            series = VolumeSeries(
                output, parts.count, grid, **options, provenance=camera.recorded(provenance), tile=parts.side
            )
            partial_outputs[output] = RESUMABLE
            choose = method == "admm" and weights.tv is None
            chosen = deconvolve_tiles(image, spots, solver, parts, series, choose=choose, progress=progress)
            camera.print_corrections()
            _warn_of_cut_psfs(planes)
            text = f"{depth_range(depths)}, {image.shape[0]} x {image.shape[1]} pixels, {method}"
            click.echo(f"{output}: {text}, {plural(parts.count, 'tile')} of {parts.side} x {parts.side} pixels")
            _print_smoothness(chosen)
            change = max(note["change"] for _, note in series.notes())
            click.echo(f"steps: the last changed a tile by {change:.1g} of it at most")
            return print_failed_tiles(series)
        if solver is None:
            with progress.step("Filtering"):
                volume = filter_image(image, spots)[None]
        else:
            choose = method == "admm" and weights.tv is None
            refined = fit_psf(image, spots, solver, choose=choose, progress=progress) if refine_psf else None
            system = fit.operator if fit else refined.psf if refined else spots
            result = run_deconvolution(
                image, system, solver, choose=choose, stop_at_discrepancy=stop_at_noise, progress=progress
            )
            volume = result.scene
        flat = flat_warning(volume)
        with progress.step("Writing"):
            provenance = camera.recorded(provenance_of(capture, *files))
            if result and result.smoothness:
                provenance |= {"tv": f"{result.smoothness.tv:.3g}, chosen from the capture"}
            provenance |= {"refined PSF": _format_psf_fit(refined)} if refined else {}
            if len(volume) == 1 and not depths:
                write_capture(output, volume[0], provenance)
            else:
                write_planes(output, volume, depths, voxel_um and voxel_um * binning / 1000, provenance)
    camera.print_corrections()
    if len(names) > 1 and not fit:
        at = [f"at {depth:g} mm" for depth in depths] if depths else [f"is plane {n + 1}" for n in range(len(names))]
        click.echo(f"PSFs: {', '.join(f'{name} {place}' for name, place in zip(names, at, strict=True))}")
    _warn_of_cut_psfs(planes)
    if flat:
        print_warning(flat)
    if fit:
        click.echo(
            f"{psf_places}: {fit.rank} components explain {len(spots)} PSFs to {fit.error:.2g} of their RMS, those at "
            f"other places predict one to {fit.left_out_error:.2g}; places fit to {fit.place_error:.2g} pixels"
        )
    if refined:
        click.echo(f"refined PSF: {_format_psf_fit(refined)}")
    z, rows, columns = volume.shape
    of = "" if z == 1 and not depths else f"{depth_range(depths)}, " if depths else f"{z} planes, "
    taken = f", {result.steps} steps" if result else ""
    click.echo(f"{output}: {of}{rows} x {columns} pixels, {method}{taken}")
    if result:
        _print_quality(result)


def _print_smoothness(chosen):
    """Print the weight of smoothness that was chosen, if any."""
    if chosen:
        error = dict(zip(chosen.tried, chosen.errors, strict=True)).get(chosen.tv, 0)
        click.echo(
            f"smoothness: --tv {chosen.tv:.1g}, which predicts held-out pixels best of {len(chosen.tried)} weights, to "
            f"{error:.2g} of their RMS"
        )


def _format_psf_fit(fit) -> str:
    """What the refinement of the PSFs found, in a line."""
    error = f"error of held-out pixels {fit.before:.3g} -> {fit.after:.3g} of their RMS"
    if not fit.is_better:
        return f"kept as measured, no scale within 5 % and blur help ({error})"
    return f"scale {fit.scale:.4f}, blur {fit.blur:.2f} pixels ({error})"


def _print_quality(result):
    """Print the weight of smoothness that was chosen, the residual, and whether the steps converged."""
    _print_smoothness(result.smoothness)
    if result.reached_noise:
        end = "stopped where only noise is left"
    elif result.converged:
        end = f"converged, the last step changed {result.change:.1g} of it"
    else:
        end = f"not converged, the last step changed {result.change:.1g} of it; more --steps refine the scene"
    click.echo(f"residual: {result.residual:.2g} of the capture's RMS; {end}")


def _warn_of_cut_psfs(spots):
    """Warn of PSFs that are cut by the edge of their image."""
    from ..reconstruction.deconvolution import cut_sides

    cut = {number: sides for number, spot in enumerate(spots, 1) if (sides := cut_sides(spot))}
    if cut:
        number, sides = next(iter(cut.items()))
        which = "the PSF" if len(spots) == 1 else f"PSF {number}" if len(cut) == 1 else f"{len(cut)} of the PSFs"
        print_warning(
            f"{which} is cut at the {' and '.join(sides)} by the edge of its image: expect bright lines and false "
            "light in the scene; measure it with the whole pattern on the sensor."
        )


def _read_places(path, psf):
    """Places of the sources, one for each PSF in their order; z is NaN where unknown."""
    from ..io.point_tables import read_positions

    places, captures = read_positions(path, psf)
    if not np.array_equal(captures, np.arange(len(places))):
        raise input_error("lines", "in the order of the PSFs, one for each", "another column capture", path)
    return places
