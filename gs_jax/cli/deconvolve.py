"""`gs-jax deconvolve`: a plane, from a capture and a measured PSF."""

from pathlib import Path

import click

from ..base.errors import InputError
from ..base.progress import Progress
from ..io.files import check_output
from .files import check_may_write, provenance_of
from .options import CaptureOptions, Number, picture_options


@click.command("deconvolve", epilog="Example: gs-jax deconvolve capture.tif psf.tif --tv 1e-3 -o scene.tif")
@click.argument("capture", type=Path)
@click.argument("psf", type=Path)
@click.option("--method", type=click.Choice(["admm", "fista", "richardson-lucy"]), default="admm")
@click.option("--steps", type=click.IntRange(1, 100_000), default=100)
@click.option("--tv", type=Number(0.0, 10.0), help="Weight of total variation.  [default: 0.001 of admm]")
@click.option("-o", "--output", type=Path, required=True, help="SCENE.tif or .npy, float32, of CAPTURE's size.")
@picture_options
def deconvolve_command(
    capture: Path, psf: Path, method: str, steps: int, tv: float | None, output: Path, camera: CaptureOptions
):
    """Reconstruct the plane in CAPTURE, taken through a diffuser or another mask whose PSF is the file PSF.

    PSF is the image of a point on the axis, of any size; several pages are averaged. Both files may be TIFF, PNG or
    .npy, and are read and corrected in the same way.
    """
    from ..io.captures import write_capture
    from ..reconstruction.deconvolution import TV, deconvolve
    from ..solvers.convolution import ConvolutionADMM
    from ..solvers.fista import FISTA
    from ..solvers.richardson_lucy import RichardsonLucy

    check_output(output, [".tif", ".tiff", ".npy"])
    check_may_write(output, inputs=(capture, psf, *camera.files))
    if method == "admm":
        solver = ConvolutionADMM(steps, sparsity=0.0, tv=TV if tv is None else tv)
    elif method == "richardson-lucy":
        solver = RichardsonLucy(steps, accelerate=True, tv=tv or 0.0)
    elif tv is None:
        solver = FISTA(steps)
    else:
        raise InputError("--tv must be used with --method admm or richardson-lucy, got fista.")
    image, spot = camera.read(capture), camera.read(psf, is_spot=True)
    with Progress() as progress:
        scene = deconvolve(image, spot, solver, progress=progress)
        with progress.step("Writing"):
            write_capture(output, scene, camera.recorded(provenance_of(capture, psf, *camera.files)))
    camera.print_corrections()
    click.echo(f"{output}: {scene.shape[0]} x {scene.shape[1]} pixels, {method}, {steps} steps")
