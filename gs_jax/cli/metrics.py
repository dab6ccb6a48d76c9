"""`gs-jax metrics`: what a design promises."""

from pathlib import Path

import click

from ..io.files import check_output, write_json
from .files import check_may_write
from .options import DESIGN, UM, Depths


@click.command("metrics", epilog="Example: gs-jax metrics design/geomscope.toml --depths 18:22:1")
@click.argument("design", type=DESIGN)
@click.option("--json", "output", type=Path, help="Write the numbers to this file too.")
@click.option("--depths", type=Depths(), help="START:STOP:STEP in mm.  [default: seven over the working distance]")
@click.option("--confusion-um", type=UM, help="Diameter of the circle of confusion, um.  [default: two pixels]")
def command(design: Path, output: Path | None, depths: list[float] | None, confusion_um: float | None):
    """Show what the microscope of DESIGN promises (the paper's Eqs. 1-11), and what becomes of it.

    DESIGN is a file, or the name of one that comes with the package, such as geomscope.
    """
    from rich.console import Console

    from ..design.design import read_design
    from ..design.problems import findings
    from ..design.sheet import datasheet, summary, tables

    if output:
        check_output(output, [".json"])
        check_may_write(output, inputs=(design,))
    confusion = confusion_um and confusion_um / 1000
    microscope = read_design(design)
    sheet = datasheet(microscope, depths, confusion=confusion)
    if output:
        write_json(output, sheet)
    click.echo(summary(microscope, sheet))
    click.echo(_calibration(microscope.provenance))
    console = Console()
    for table in tables(sheet):
        console.print()
        console.print(table)
    click.echo()
    for sentence in findings(microscope, sheet, confusion=confusion):
        click.echo(f"- {sentence}")


def _calibration(provenance) -> str:
    """What `gs-jax calibrate` wrote into the file."""
    if "calibrated_spots" not in provenance:
        return "  not calibrated: the geometry is that of the design"
    spots, captures = provenance["calibrated_spots"], provenance["calibrated_captures"]
    rms, deviations = provenance["calibrated_rms_pixels"], provenance["standard_deviations"]
    known = ", ".join(f"{name} +- {deviation:g}" for name, deviation in deviations.items())
    return f"  calibrated by {spots} spots of {captures} captures, {rms:.3f} pixels RMS: {known}"
