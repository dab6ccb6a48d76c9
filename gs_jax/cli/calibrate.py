"""`gs-jax calibrate`: the geometry of a real microscope."""

from pathlib import Path

import click

from ..base.errors import errors_name_file
from ..base.progress import Progress
from ..io.disk import check_output
from .captures import CaptureOptions, capture_options
from .files import check_may_write, force_option, provenance_of
from .options import DESIGN


@click.command("calibrate", epilog="Example: gs-jax calibrate geomscope a.tif b.tif --positions p.csv -o my.toml")
@click.argument("design", type=DESIGN)
@click.argument("captures", type=Path, nargs=-1, required=True)
@click.option(
    "--positions", type=Path, required=True, help="POINTS.csv: x_mm,y_mm,z_mm of the source, a line for each capture."
)
@click.option("-o", "--output", type=Path, required=True, help="CALIBRATED.toml; a picture of residuals beside it.")
@capture_options
@force_option
def command(
    design: Path,
    captures: tuple[Path, ...],
    positions: Path,
    output: Path,
    force: bool,
    camera: CaptureOptions,
):
    """Find sensor distance, rotation and shift of a real microscope, from CAPTURES of one point source each.

    DESIGN has the lens centres; its sensor distance may be off by a fifth, its rotation and shift by anything, and the
    array may be mirrored. Positions are in the sensor's frame, z from the plate. One capture does; several depths and
    places are better.
    """
    from rich.console import Console

    from ..calibration.fit import calibrate, check_positions
    from ..calibration.outcome import calibrated, picture, table
    from ..designs.design import read_design, write_design
    from ..io.disk import read_table
    from ..io.figures import write_figure

    check_output(output, [".toml"])
    drawing = check_output(output.with_suffix(".png"), [".png"])
    check_may_write(output, drawing, inputs=(design, *captures, positions, *camera.files), force=force)
    microscope = read_design(design)
    imager = camera.imager(microscope.imager())
    points = read_table(positions, "x_mm,y_mm,z_mm", len(captures) + 1)
    with errors_name_file(positions):
        check_positions(points, len(captures))
    with Progress() as progress:
        images = [camera.read(path) for path in progress.track(captures, "Reading captures")]
        found = calibrate(images, points, imager, progress=progress)
    provenance = camera.recorded(provenance_of(design, *captures, positions, *camera.files))
    new = calibrated(microscope, found, provenance)
    write_design(output, new)
    write_figure(drawing, picture(found))
    camera.say()
    Console().print(table(microscope, found))
    mirrored = ", the array mirrored (y against -y) and turned" if found.mirrored else ""
    click.echo(f"{output}: {len(found.residuals)} spots, {found.rms:.3f} pixels RMS{mirrored}")
