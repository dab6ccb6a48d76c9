"""`gs-jax deconvolve`: a plane or a volume, from a capture and measured PSFs."""

from pathlib import Path
from typing import Any

import click

from ..base.errors import InputError, input_error
from ..base.progress import Progress
from .options import UM, CaptureOptions, Depths, Number, Page, depth_range, picture_options
from .outputs import check_may_write, provenance_of

_METHODS = ("admm", "fista", "richardson-lucy")


@click.command("deconvolve", epilog="Example: gs-jax deconvolve capture.tif psf_stack.tif -o volume.ome.tif")
@click.argument("capture", type=Path)
@click.argument("psf", type=Path, nargs=-1, required=True)
@click.option(
    "--depths",
    type=Depths(),
    help="START:STOP:STEP in mm, STOP included: depths of the planes, in the order of the PSFs.  "
    "[default: planes are numbered]",
)
@click.option("--voxel-um", type=UM, help="What a pixel of CAPTURE is wide in the scene, for scale bars.")
@click.option(
    "--method",
    type=click.Choice(_METHODS),
    default="admm",
    show_default=True,
    help="admm: smooth areas with edges, best for most scenes; fista: separate points; richardson-lucy: dim light, "
    "where photons are few.",
)
@click.option("--steps", type=click.IntRange(1, 100_000), default=100, show_default=True, help="At most so many steps.")
@click.option(
    "--tv",
    type=Number(0.0, 10.0),
    help="Weight of total variation (admm, richardson-lucy): the more, the smoother.  [default: 0.001 of admm]",
)
@click.option(
    "--tv-z",
    type=Number(0.0, 1000.0),
    help="How much neighbouring planes are to be alike, relative to neighbouring pixels (admm).  [default: 1]",
)
@click.option(
    "--sparsity", type=Number(0.0, 1.0), help="Weight of the sum of voxels (admm, fista): the more, the darker."
)
@click.option("--stop-at-noise", is_flag=True, help="Stop early when all but noise is explained.")
@click.option(
    "--psf-page",
    type=Page(),
    help="Make one plane of each PSF file: of this page, from 1; or of the mean of repeated frames.  "
    "[default: a plane for each page]",
)
@click.option(
    "--psf-places",
    type=Path,
    help="PLACES.csv, x_mm,y_mm,z_mm, a line for each PSF: of sources all over the field, four or more at each z, if "
    "the PSF varies over the field.",
)
@click.option(
    "--binning",
    type=click.IntRange(1, 64),
    default=1,
    help="Sum squares of so many pixels a side, of CAPTURE and PSFs alike: 2 takes a quarter of time and memory.",
)
@click.option(
    "-o",
    "--output",
    type=Path,
    required=True,
    help="VOLUME.ome.tif, .npy, or .zarr (with --depths and --voxel-um), float32, planes of CAPTURE's size.",
)
@picture_options
def deconvolve_command(
    capture: Path,
    psf: tuple[Path, ...],
    output: Path,
    depths: list[float] | None,
    voxel_um: float | None,
    psf_page: int | str | None,
    psf_places: Path | None,
    binning: int,
    method: str,
    steps: int,
    stop_at_noise: bool,
    camera: CaptureOptions,
    **weights: Any,
):
    """Reconstruct the scene in CAPTURE, taken through a diffuser, a lens array or another mask, from measured PSFs.

    A PSF is what the camera sees of one small source in the middle of the field, such as a lit pinhole. From one PSF
    follows the plane where the source was. From a stack, a PSF at each depth, follows a volume with a plane for each:
    give the pages of a TIFF, a folder of images, a Zarr array (z, y, x), or several files in order.

    If the PSF changes over the field, measure it at several places and list them with --psf-places. The order of
    sources is free; scale and orientation need not be known.

    All files may be TIFF, PNG or .npy, in the same pixels; a PSF may be smaller than CAPTURE, its source then being in
    the PSF's middle. --dark, --flat, --bad-pixels and --offset correct all of them.

    \b
    One plane:
    gs-jax deconvolve capture.tif psf.tif -o scene.tif

    \b
    A volume from PSFs at 10, 10.5, ... 20 mm, with squares of 2 x 2 pixels summed:
    gs-jax deconvolve capture.tif psfs/ --depths 10:20:0.5 --binning 2 -o volume.ome.tif
    """
    import numpy as np

    from ..io.captures import write_capture
    from ..io.files import check_output
    from ..io.plane_stacks import STACK_SUFFIXES, spot_names, write_planes
    from ..reconstruction.deconvolution import bin_pixels, deconvolve, make_solver
    from ..reconstruction.field_fit import fit_field

    check_output(output, STACK_SUFFIXES)
    files = [path for path in (*psf, psf_places, *camera.files) if path]
    check_may_write(output, inputs=(capture, *files))
    places = None
    if psf_places:
        if depths:
            raise InputError("--depths must not be given with --psf-places, whose z_mm are the depths, got both.")
        if weights["tv_z"] is not None:
            raise InputError("--tv-z must not be given with --psf-places, got both.")
        places = _read_places(psf_places, psf)
        depths = None if np.isnan(places[:, 2]).any() else np.unique(places[:, 2]).tolist()
    if output.suffix.lower() == ".zarr" and not (depths and voxel_um):
        raise InputError(f"{output}: OME-Zarr needs --depths and --voxel-um, got not both; use .ome.tif or .npy.")
    if depths and depths[0] <= 0 and voxel_um and output.suffix.lower() != ".npy":
        raise input_error("z_mm", "positive with --voxel-um", f"{depths[0]:g}", psf_places)
    names = spot_names(psf, psf_page)
    solver = make_solver(method, steps, weights)
    with Progress() as progress:
        with progress.step("Reading"):
            image = bin_pixels(camera.read(capture), binning)
            spots = np.stack([bin_pixels(spot, binning) for spot in camera.read_spots(psf, psf_page)])
        fit = None
        if places is not None:
            with progress.step("Fitting the PSFs"):
                fit = fit_field(spots, places, image.shape)
        elif depths and len(depths) != len(spots):
            raise InputError(f"--depths must be one for each PSF, {len(spots)} in all, got {len(depths)} depths.")
        planes = deconvolve(
            image, fit.operator if fit else spots, solver, stop_at_discrepancy=stop_at_noise, progress=progress
        )
        with progress.step("Writing"):
            provenance = camera.recorded(provenance_of(capture, *files))
            if len(planes) == 1 and not depths:
                write_capture(output, planes[0], provenance)
            else:
                write_planes(output, planes, depths, voxel_um and voxel_um * binning / 1000, provenance)
    camera.print_corrections()
    if len(names) > 1 and not fit:
        at = [f"at {depth:g} mm" for depth in depths] if depths else [f"is plane {n + 1}" for n in range(len(names))]
        click.echo(f"PSFs: {', '.join(f'{name} {place}' for name, place in zip(names, at, strict=True))}")
    if fit:
        click.echo(
            f"{psf_places}: {fit.rank} components explain {len(spots)} PSFs to {fit.error:.2g} of their RMS, those at "
            f"other places predict one to {fit.left_out_error:.2g}; places fit to {fit.place_error:.2g} pixels"
        )
    z, rows, columns = planes.shape
    of = "" if z == 1 and not depths else f"{depth_range(depths)}, " if depths else f"{z} planes, "
    click.echo(f"{output}: {of}{rows} x {columns} pixels, {method}, at most {steps} steps")


def _read_places(path, psf):
    """Places of the sources, one for each PSF in their order; z is NaN where unknown."""
    import numpy as np

    from ..io.point_tables import read_positions

    places, captures = read_positions(path, psf)
    if not np.array_equal(captures, np.arange(len(places))):
        raise input_error("lines", "in the order of the PSFs, one for each", "another column capture", path)
    return places
