"""`gs-jax reconstruct`: a capture to a volume."""

from pathlib import Path

import click

from ..designs import read_design
from ..disk import check_output
from ..files import read_capture
from ..progress import Progress
from ..reconstruct import reconstruct_stack, voxel_grid
from ..volumes import VOLUME_SUFFIXES, write_volume
from .options import UM, Depths, depth_range


@click.command()
@click.argument("capture", type=Path)
@click.argument("design", type=Path)
@click.option("--depths", type=Depths(), required=True, help="START:STOP:STEP in mm from the plate, STOP included.")
@click.option("--voxel-um", type=UM, help="Lateral voxel pitch, um.  [default: a pixel, seen at the middle depth]")
@click.option("--method", type=click.Choice(["backproject"]), default="backproject", show_default=True)
@click.option("-o", "--output", type=Path, required=True, help="VOLUME.ome.tif, or VOLUME.zarr for OME-Zarr.")
def reconstruct(capture: Path, design: Path, depths: list[float], voxel_um: float | None, method: str, output: Path):
    """Reconstruct the volume that CAPTURE shows, taken with the microscope of the file DESIGN.

    CAPTURE is a grey TIFF, PNG or .npy of the sensor's size; the volume is written to scale, for Fiji and napari.
    """
    check_output(output, VOLUME_SUFFIXES)
    imager = read_design(design).imager()
    grid = voxel_grid(imager, depths, voxel_um and voxel_um / 1000)
    image = read_capture(capture, imager.sensor.shape)
    with Progress() as progress:
        volume = reconstruct_stack(image, imager, grid, progress)
        with progress.step("Writing"):
            write_volume(output, volume, grid)
    z, y, x = volume.shape
    size = f"{z} x {y} x {x} voxels (z, y, x), {grid.pitch * 1000:.4g} um laterally"
    click.echo(f"{output}: {size}, {depth_range(depths)}")
