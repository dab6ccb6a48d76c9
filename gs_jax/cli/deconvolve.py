"""`gs-jax deconvolve`: a plane or a volume, from a capture and measured PSFs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import click

from ..base.errors import InputError, input_error
from ..base.progress import Progress
from .command import OptionGroup, check_outputs, command, given_options, print_warning, provenance_of
from .options import Binning, MaskDepthList, Number, Page, PictureOptions, Steps, Um, check_even, depth_range

_METHODS = ("admm", "fista", "richardson-lucy", "wiener")
# Options of the methods that take steps.
_ITERATIVE = ("steps", "stop_at_noise", "psf_places", "tv", "tv_z", "sparsity")


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
    method: Annotated[str, click.Choice(_METHODS)] = "admm",
    steps: Steps = 100,
    weights: Weights,
    stop_at_noise: bool = False,
    psf_page: Page | None = None,
    psf_places: Path | None = None,
    binning: Binning = 1,
    output: Path,
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
        binning: Sum squares of so many pixels a side, of CAPTURE and PSFs alike: 2 takes a quarter of time and memory.
        output: VOLUME.ome.tif, .npy, or .zarr (with --depths and --voxel-um), float32, planes of CAPTURE's size.
    """
    import numpy as np

    from ..io.captures import write_capture
    from ..io.recordings import spot_names
    from ..io.volumes import STACK_SUFFIXES, write_planes
    from ..reconstruction.deconvolution import bin_pixels, filter_image, make_solver, pad_to_largest, run_deconvolution
    from ..reconstruction.field_fit import fit_field

    files = [path for path in (*psf, psf_places, *camera.files) if path]
    check_outputs(output, STACK_SUFFIXES, inputs=(capture, *files))
    places, solver = None, None
    if method != "wiener":
        solver = make_solver(method, steps, vars(weights))
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
    names, fit, result = spot_names(psf, psf_page), None, None
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
        if solver is None:
            with progress.step("Filtering"):
                volume = filter_image(image, spots)[None]
        else:
            choose = method == "admm" and weights.tv is None
            system = fit.operator if fit else spots
            result = run_deconvolution(
                image, system, solver, choose=choose, stop_at_discrepancy=stop_at_noise, progress=progress
            )
            volume = result.scene
        with progress.step("Writing"):
            provenance = camera.recorded(provenance_of(capture, *files))
            if result and result.smoothness:
                provenance |= {"tv": f"{result.smoothness.tv:.3g}, chosen from the capture"}
            if len(volume) == 1 and not depths:
                write_capture(output, volume[0], provenance)
            else:
                write_planes(output, volume, depths, voxel_um and voxel_um * binning / 1000, provenance)
    camera.print_corrections()
    if len(names) > 1 and not fit:
        at = [f"at {depth:g} mm" for depth in depths] if depths else [f"is plane {n + 1}" for n in range(len(names))]
        click.echo(f"PSFs: {', '.join(f'{name} {place}' for name, place in zip(names, at, strict=True))}")
    _warn_of_cut_psfs(planes)
    if fit:
        click.echo(
            f"{psf_places}: {fit.rank} components explain {len(spots)} PSFs to {fit.error:.2g} of their RMS, those at "
            f"other places predict one to {fit.left_out_error:.2g}; places fit to {fit.place_error:.2g} pixels"
        )
    z, rows, columns = volume.shape
    of = "" if z == 1 and not depths else f"{depth_range(depths)}, " if depths else f"{z} planes, "
    taken = f", {result.steps} steps" if result else ""
    click.echo(f"{output}: {of}{rows} x {columns} pixels, {method}{taken}")
    if result:
        _print_quality(result)


def _print_quality(result):
    """Print the weight of smoothness that was chosen, the residual, and whether the steps converged."""
    if chosen := result.smoothness:
        error = dict(zip(chosen.tried, chosen.errors, strict=True)).get(chosen.tv, 0)
        click.echo(
            f"smoothness: --tv {chosen.tv:.1g}, which predicts held-out pixels best of {len(chosen.tried)} weights, to "
            f"{error:.2g} of their RMS"
        )
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
    import numpy as np

    from ..io.point_tables import read_positions

    places, captures = read_positions(path, psf)
    if not np.array_equal(captures, np.arange(len(places))):
        raise input_error("lines", "in the order of the PSFs, one for each", "another column capture", path)
    return places
