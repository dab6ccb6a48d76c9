"""`gs-jax reconstruct`: a capture to a volume, or to points."""

import dataclasses
from pathlib import Path

import click
import numpy as np

from ..base.errors import InputError
from ..base.progress import Progress
from ..designs.design import read_design
from ..geometry import Grid
from ..io.captures import read_capture
from ..io.disk import check_output
from ..io.points import write_points
from ..io.volumes import VOLUME_SUFFIXES, write_volume
from ..projection.levels import LEVELS
from ..reconstruction.methods import METHODS
from ..reconstruction.pipeline import COARSE, reconstruct as volume_of, voxel_grid
from ..reconstruction.reprojection import reproject
from ..simulation.phantoms import rasterize
from ..solvers.unrolled import read_unrolled
from ..suppression.clustering import find_clusters
from ..suppression.locate import find_points
from ..suppression.unet import read_weights, suppress as without_background
from .options import UM, Depths, Number, depth_range


@click.command("reconstruct")
@click.argument("capture", type=Path)
@click.argument("design", type=Path)
@click.option("--depths", type=Depths(), required=True, help="START:STOP:STEP in mm from the plate, STOP included.")
@click.option(
    "--voxel-um",
    type=UM,
    help="Lateral voxel pitch, um.  [default: a pixel, seen at the middle depth; 4 pixels for iterative methods]",
)
@click.option("--method", type=click.Choice(list(METHODS)), default="backproject", show_default=True)
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
    type=click.Choice(["none", "points", "clusters", "unet"]),
    default="none",
    show_default=True,
    help="Background suppression: points that their lenses agree on, the paper's clusters, or a network for anything.",
)
@click.option(
    "--weights",
    type=Path,
    help="WEIGHTS.npz of `gs-jax train`, for --method unrolled or --suppress unet.  [default: ours]",
)
@click.option("-o", "--output", type=Path, required=True, help="VOLUME.ome.tif, or VOLUME.zarr for OME-Zarr.")
@click.option("--points", type=Path, help="POINTS.csv: write the points that the capture shows, too.")
def command(
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
):
    """Reconstruct the volume that CAPTURE shows, taken with the microscope of the file DESIGN.

    CAPTURE is a grey TIFF, PNG or .npy of the sensor's size; the volume is written to scale, for Fiji and napari.
    """
    check_output(output, VOLUME_SUFFIXES)
    if points:
        check_output(points, [".csv"])
    if suppress != "none" and method != "backproject":
        raise InputError(f"--suppress {suppress}: found --method {method}, allowed: backproject, for which it is made.")
    if suppress == "points" and optics != "full":
        raise InputError(f"--optics {optics}: found --suppress points, allowed: full, which finds points.")
    if weights and suppress != "unet" and method != "unrolled":
        found = f"--method {method} and --suppress {suppress}"
        raise InputError(f"--weights: found {found}, allowed: --method unrolled or --suppress unet.")
    if stop_at_noise and method in ("backproject", "unrolled"):
        raise InputError(f"--stop-at-noise: found --method {method}, allowed: list-rl, richardson-lucy, fista, admm.")
    chosen = read_unrolled(weights) if weights and method == "unrolled" else METHODS[method](steps)
    inversion = _with(chosen, method, tv=tv, sparsity=sparsity)
    network = read_weights(weights) if weights and suppress == "unet" else None
    microscope = read_design(design)
    imager = microscope.imager()
    pixels = 1 if method == "backproject" else COARSE
    grid = voxel_grid(imager, depths, voxel_um and voxel_um / 1000, pixels=pixels)
    image = read_capture(capture, imager.sensor.shape)
    found = np.zeros((0, 4))
    with Progress() as progress:
        if suppress == "points" or (points and suppress != "clusters"):
            found = find_points(image, imager, grid, progress=progress)
        if suppress == "points":
            volume = _volume_of_points(found, grid)
        else:
            volume = volume_of(
                image, imager, grid, inversion, optics=optics, stop_at_noise=stop_at_noise, progress=progress
            )
        if suppress == "clusters":
            with progress.step("Clustering"):
                found = find_clusters(volume, grid)
                volume = _volume_of_points(found, grid)
        if suppress == "unet":
            with progress.step("Suppressing the background"):
                volume = without_background(volume, network)
        check = None
        if method == "unrolled" or suppress == "unet":
            check = reproject(volume, image, imager, grid, optics=optics, progress=progress)
        with progress.step("Writing"):
            write_volume(output, volume, grid)
            if points:
                write_points(points, found)
    z, y, x = volume.shape
    size = f"{z} x {y} x {x} voxels (z, y, x), {grid.pitch * 1000:.4g} um laterally"
    click.echo(f"{output}: {size}, {depth_range(depths)}")
    if check:
        found = f"{check.error:.0%} RMS from the capture (correlation {check.correlation:.3f})"
        click.echo(f"{output}: imaged again it is {found}, {check.regions.max():.0%} where it is farthest")
    if points or suppress in ("points", "clusters"):
        click.echo(f"{points or output}: {len(found)} point{'s' * (len(found) != 1)}")


def _with(method, name: str, **options):
    """The method with the options that were given, if it has them."""
    given = {option: value for option, value in options.items() if value is not None}
    for option in given:
        if not hasattr(method, option):
            has = [other for other, make in METHODS.items() if hasattr(make(1), option)]
            raise InputError(f"--{option}: found --method {name}, allowed: {', '.join(has)}.")
    return dataclasses.replace(method, **given)


def _volume_of_points(points: np.ndarray, grid: Grid) -> np.ndarray:
    return np.asarray(rasterize(points, grid), np.float32)
