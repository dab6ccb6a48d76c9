"""`gs-jax layout`, `metrics` and `info`: random lens centres, the datasheet of a design, the machine and files."""

import re
from itertools import groupby
from pathlib import Path

import click

from ..base.errors import InputError
from ..io.files import check_output, write_json
from .command import check_may_write, force_option, provenance_of
from .light import Light, check_beyond, objects_in, sample_options
from .options import DESIGN, MM, UM, Depths, shipped_designs


@click.command("layout", epilog="Example: gs-jax layout --count 200 --size-mm 20 20 --pitch-mm 1.23 -o centers.csv")
@click.option("--count", type=click.IntRange(1, 100_000), required=True, help="Number of lenses.")
@click.option("--size-mm", type=MM, nargs=2, required=True, help="Size of the plate, X Y.")
@click.option("--pitch-mm", type=MM, required=True, help="Mean distance of a lens from its nearest neighbour.")
@click.option("--diameter-mm", type=MM, default=2.0, help="Lens diameter; the lenses cover the plate.")
@click.option("--seed", type=click.IntRange(0), default=0)
@click.option("-o", "--output", type=Path, required=True, help="CENTERS.csv, with the header x_mm,y_mm.")
@force_option
def layout_command(
    count: int, size_mm: tuple[float, float], pitch_mm: float, diameter_mm: float, seed: int, output: Path, force: bool
):
    """Make a random layout of lenses, for the key `centers_file` of a design."""
    from ..design.centers import write_centers
    from ..layouts import coverage, nearest_neighbour_distances, random_layout

    check_output(output, [".csv"])
    check_may_write(output, inputs=(), force=force)
    centers = random_layout(count, size_mm, pitch=pitch_mm, diameter=diameter_mm, seed=seed)
    write_centers(output, centers, provenance_of())
    distances = nearest_neighbour_distances(centers)
    covered = coverage(centers, size_mm, diameter=diameter_mm)
    spread = f"pitch {distances.mean():.3f} mm, SD {distances.std():.3f} mm, " if count > 1 else ""
    click.echo(f"{output}: {count} lenses, {spread}{100 * covered:.1f} % of the plate covered")


@click.command("metrics", epilog="Example: gs-jax metrics design/geomscope.toml --depths 18:22:1")
@click.argument("design", type=DESIGN)
@click.option("--json", "output", type=Path, help="Also write the numbers to this file.")
@click.option("--depths", type=Depths(), help="START:STOP:STEP in mm.  [default: seven in the working distance]")
@click.option("--confusion-um", type=UM, help="Diameter of the circle of confusion, um.  [default: two pixels]")
@sample_options
def metrics_command(
    design: Path, output: Path | None, depths: list[float] | None, confusion_um: float | None, light: Light
):
    """Show what the microscope of DESIGN resolves (the paper's Eqs. 1-11, and exact rays), in five lines.

    --verbose adds the tables by depth and all problems; --json has all numbers.

    DESIGN is a file, or the name of one that comes with the package, such as geomscope.
    """
    from rich.console import Console

    from ..base.progress import VERBOSE, verbosity
    from ..design.datasheets import band_in_words, datasheet, overview, path_in_words, summary, tables
    from ..design.design import read_design
    from ..design.diagnostics import findings

    if output:
        check_output(output, [".json"])
        check_may_write(output, inputs=(design,))
    circle_of_confusion = confusion_um and confusion_um / 1000
    microscope = light.design(read_design(design))
    if depths:
        check_beyond(microscope.imager(), depths, "--depths")
    sheet = datasheet(microscope, depths, circle_of_confusion=circle_of_confusion)
    if output:
        write_json(output, sheet)
    click.echo(summary(microscope, sheet))
    click.echo(f"  {objects_in(microscope.imager())}; {_calibration(microscope.provenance)}")
    lines = overview(microscope, sheet, circle_of_confusion=circle_of_confusion)
    for words in filter(None, (path_in_words(sheet), band_in_words(sheet), *lines)):
        click.echo(f"  {words}")
    problems = findings(microscope, sheet, circle_of_confusion=circle_of_confusion)
    if verbosity.get() != VERBOSE:
        click.echo(f"  tables by depth and {len(problems)} remark{'s' * (len(problems) != 1)}: --verbose")
        return
    console = Console()
    for table in tables(sheet):
        console.print()
        console.print(table)
    click.echo()
    for sentence in problems:
        click.echo(f"- {sentence}")


def _calibration(provenance) -> str:
    """The line about what `gs-jax calibrate` wrote into the file."""
    if "calibrated_spots" not in provenance:
        return "not calibrated: the geometry is that of the design"
    spots, captures = provenance["calibrated_spots"], provenance["calibrated_captures"]
    rms, deviations = provenance["calibrated_rms_pixels"], provenance["standard_deviations"]
    known = ", ".join(f"{name} +- {deviation:g}" for name, deviation in deviations.items())
    return f"calibrated by {spots} spots of {captures} captures, {rms:.3f} pixels RMS: {known}"


@click.command("info", epilog="Examples: gs-jax info volume.ome.tif, gs-jax info --designs")
@click.argument("file", type=Path, required=False)
@click.option("--designs", is_flag=True, help="List the names of the designs that come with the package.")
def info_command(file: Path | None, designs: bool):
    """Show versions, devices and memory; with FILE, which gs-jax command made it, and from what.

    Of long lists in the design the first lines are shown, with --verbose all. Of an image that another program made:
    its size, type and axes, and what commands take it for.
    """
    from ..base.progress import VERBOSE, verbosity

    if designs and file:
        raise InputError(f"--designs must be used without a FILE, got {file}.")
    if designs:
        from ..design.design import read_design

        # The second line of a design describes its array.
        lines = {path.stem: repr(read_design(path)).splitlines()[1].strip() for path in shipped_designs()}
    elif file:
        from ..io.captures import summarise
        from ..io.provenance import read_provenance

        lines = read_provenance(file) or summarise(file) | {"provenance": f"{file} has no provenance."}
    else:
        from ..base.machine import describe

        lines = describe()
    width = max(map(len, lines))
    for name, value in lines.items():
        # The text of a design has many lines, most of them of its lenses' centres.
        value = value if verbosity.get() == VERBOSE else _shortened(value)
        click.echo(f"{name:<{width}} {value}" if "\n" not in value else f"{name}\n\n{value}")


# A line of a list of numbers, or of pairs of them, in TOML; lines of a list that are shown.
_NUMBERS, _SHOWN = re.compile(r"\s*\[?[-+0-9.e, ]+\]?,?\s*"), 3


def _shortened(text: str) -> str:
    """A text without most lines of long lists of numbers."""
    lines = []
    for is_list, group in groupby(text.split("\n"), lambda line: bool(line.strip() and _NUMBERS.fullmatch(line))):
        part = list(group)
        if is_list and len(part) > 2 * _SHOWN:
            part = [*part[:_SHOWN], f"    # and {len(part) - _SHOWN} more"]
        lines += part
    return "\n".join(lines)
