"""The command line: each command parses, calls the library, writes its files.

Exit status 0 on success, 2 on wrong input (one line, no traceback), 1 otherwise.
"""

import math
import sys
from pathlib import Path

import click
import jax
import numpy as np
from rich.console import Console

from . import __version__
from .camera import Camera, expose
from .coverage import coverage, nearest_neighbour_distances
from .datasheet import datasheet, summary, tables
from .designs import read_design, write_centers
from .disk import check_output, write_json
from .errors import InputError
from .files import CAPTURE_SUFFIXES, read_capture, write_capture
from .findings import findings
from .info import describe
from .layouts import random_layout
from .progress import Progress
from .reconstruct import reconstruct_stack, voxel_grid
from .simulate import PSFS, simulate_scene
from .volumes import VOLUME_SUFFIXES, write_volume

# Far more planes than any sensor resolves; a mistyped step asks for millions.
_MOST_DEPTHS = 10_000


def main() -> None:
    """Run the command line, and exit."""
    try:
        status = commands.main(standalone_mode=False, prog_name="gs-jax")
    except InputError as error:
        _fail(str(error), 2)
    except click.ClickException as error:
        _fail(" ".join(error.format_message().split()), 2)
    except (click.Abort, KeyboardInterrupt):
        _fail("interrupted", 1)
    else:
        sys.exit(status if isinstance(status, int) else 0)


def _fail(message: str, status: int) -> None:
    click.echo(f"gs-jax: {message}", err=True)
    sys.exit(status)


@click.group(context_settings={"help_option_names": ["-h", "--help"]}, no_args_is_help=False)
@click.version_option(__version__, prog_name="gs-jax")
def commands():
    """Design, simulate and reconstruct with lensless 3-D microscopes of random microlenses."""


class _Number(click.ParamType):
    """A number within bounds."""

    name = "number"

    def __init__(self, *, least: float, most: float, unit: str):
        self.least, self.most, self.unit = least, most, unit

    def convert(self, value, param, ctx):
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not self.least <= number <= self.most:
            self.fail(f"found {value!r}, allowed: {self.least:g} to {self.most:g} {self.unit}.", param, ctx)
        return number


class _Depths(click.ParamType):
    """START:STOP:STEP in mm, inclusive of STOP when it falls on the step."""

    name = "start:stop:step"

    def convert(self, value, param, ctx):
        if isinstance(value, list):
            return value
        try:
            start, stop, step = map(float, value.split(":"))
        except ValueError:
            self.fail(f"found {value!r}, allowed: START:STOP:STEP, three numbers of mm such as 18:22:0.25.", param, ctx)
        if not all(map(math.isfinite, (start, stop, step))) or not 0 < start <= stop or not step > 0:
            self.fail(f"found {value!r}, allowed: 0 < START <= STOP and STEP > 0, in mm.", param, ctx)
        # A step that misses STOP by rounding alone falls on it.
        count = (stop - start) / step + 1 + 1e-6
        if count > _MOST_DEPTHS + 1:
            self.fail(f"found {value!r}, {count:.3g} depths, allowed: at most {_MOST_DEPTHS}.", param, ctx)
        return [round(start + i * step, 9) for i in range(int(count))]


_MM = _Number(least=1e-3, most=1e4, unit="mm")
_UM = _Number(least=1e-2, most=1e6, unit="um")


@commands.command()
@click.argument("capture", type=Path)
@click.argument("design", type=Path)
@click.option("--depths", type=_Depths(), required=True, help="START:STOP:STEP in mm from the plate, STOP included.")
@click.option("--voxel-um", type=_UM, help="Lateral voxel pitch, um.  [default: a pixel, seen at the middle depth]")
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
    click.echo(f"{output}: {z} x {y} x {x} voxels (z, y, x), {grid.pitch * 1000:.4g} um laterally, {_range(depths)}")


@commands.command()
@click.argument("design", type=Path)
@click.argument("scene", type=Path)
@click.option("--psf", type=click.Choice(list(PSFS)), default="diffraction", show_default=True)
@click.option("--peak-electrons", type=_Number(least=1.0, most=1e6, unit="electrons"), default=1e4, show_default=True)
@click.option("--noise/--no-noise", default=True, show_default=True, help="Without, the capture is float32.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, show_default=True, help="Of the noise.")
@click.option("-o", "--output", type=Path, required=True, help="CAPTURE.tif, .png or .npy.")
def simulate(design: Path, scene: Path, psf: str, peak_electrons: float, noise: bool, seed: int, output: Path):
    """Simulate the capture of SCENE by the microscope of the file DESIGN.

    SCENE is a CSV of points, x_mm,y_mm,z_mm,intensity, or a volume (OME-TIFF or OME-Zarr), whose voxels are evenly
    lit boxes. The camera has 16 bits of 10 electrons, an offset of 16 and 2 electrons of read noise.
    """
    check_output(output, CAPTURE_SUFFIXES)
    if not noise and output.suffix.lower() == ".png":
        raise InputError(f"{output}: found .png for --no-noise, allowed: .tif, .tiff, .npy, which hold float32.")
    microscope = read_design(design)
    with Progress() as progress:
        image = simulate_scene(scene, microscope, kind=psf, progress=progress)
        if noise:
            with progress.step("Exposing"):
                image = np.asarray(expose(image, Camera(), jax.random.key(seed), peak_electrons=peak_electrons))
        with progress.step("Writing"):
            write_capture(output, image)
    size = " x ".join(map(str, image.shape))
    click.echo(f"{output}: {size} pixels, {image.dtype}, from {image.min():g} to {image.max():g}")


@commands.command()
@click.option("--count", type=click.IntRange(1, 100_000), required=True, help="Number of lenses.")
@click.option("--size-mm", type=_MM, nargs=2, required=True, help="Size of the plate, X Y.")
@click.option("--pitch-mm", type=_MM, required=True, help="Mean distance of a lens from its nearest neighbour.")
@click.option("--diameter-mm", type=_MM, default=2.0, show_default=True, help="Of the lenses; they leave no hole.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@click.option("-o", "--output", type=Path, required=True, help="CENTERS.csv, with the header x_mm,y_mm.")
def layout(count: int, size_mm: tuple[float, float], pitch_mm: float, diameter_mm: float, seed: int, output: Path):
    """Make a random layout of lenses, for the key `centers_file` of a design."""
    check_output(output, [".csv"])
    centers = random_layout(count, size_mm, pitch=pitch_mm, diameter=diameter_mm, seed=seed)
    write_centers(output, centers)
    distances = nearest_neighbour_distances(centers)
    covered = coverage(centers, size_mm, diameter=diameter_mm)
    spread = f"pitch {distances.mean():.3f} mm, SD {distances.std():.3f} mm, " if count > 1 else ""
    click.echo(f"{output}: {count} lenses, {spread}{100 * covered:.1f} % of the plate covered")


@commands.command()
@click.argument("design", type=Path)
@click.option("--json", "output", type=Path, help="Write the numbers to this file too.")
@click.option("--depths", type=_Depths(), help="START:STOP:STEP in mm.  [default: seven over the working distance]")
@click.option("--confusion-um", type=_UM, help="Diameter of the circle of confusion, um.  [default: two pixels]")
def metrics(design: Path, output: Path | None, depths: list[float] | None, confusion_um: float | None):
    """Show what the microscope of the file DESIGN promises (the paper's Eqs. 1-11), and what is out of focus."""
    if output:
        check_output(output, [".json"])
    confusion = confusion_um and confusion_um / 1000
    microscope = read_design(design)
    sheet = datasheet(microscope, depths, confusion=confusion)
    if output:
        write_json(output, sheet)
    click.echo(summary(microscope, sheet))
    console = Console()
    for table in tables(sheet):
        console.print()
        console.print(table)
    click.echo()
    for sentence in findings(microscope, sheet, confusion=confusion):
        click.echo(f"- {sentence}")


@commands.command()
def info():
    """Show versions, devices and memory."""
    for name, value in describe().items():
        click.echo(f"{name:<12} {value}")


@commands.command()
@click.option("--out", type=Path, default=Path("gs-jax-demo"), show_default=True, help="Folder to write to.")
def demo(out: Path):
    """Run the pipeline on the built-in design: image a scene, reconstruct it, write a folder with a report."""
    from .demo import run  # Matplotlib takes a second to import

    with Progress() as progress:
        report = run(out, progress)
    click.echo(f"{report}: what was made, and what it shows")


def _range(depths: list[float]) -> str:
    if len(depths) == 1:
        return f"at {depths[0]:g} mm"
    return f"{len(depths)} depths from {depths[0]:g} to {depths[-1]:g} mm"


if __name__ == "__main__":
    main()
