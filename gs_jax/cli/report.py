"""`gs-jax report`: a design and what it showed, as a page."""

from pathlib import Path

import click

from ..base.errors import InputError, errors_name_file
from ..base.progress import Progress
from ..io.files import check_output
from .captures import CaptureOptions, capture_options
from .files import check_may_write, provenance_of
from .options import DESIGN


@click.command(
    "report",
    epilog="Example: gs-jax report my.toml volume.ome.tif --points beads.csv --capture beads.tif -o beads.html",
)
@click.argument("design", type=DESIGN)
@click.argument("volume", type=Path, required=False)
@click.option("-o", "--output", type=Path, required=True, help="REPORT.html.")
@click.option("--points", type=Path, help="POINTS.csv: found points, for a table and a view in space.")
@click.option("--capture", type=Path, help="CAPTURE.tif: what it was reconstructed from.")
@click.option("--tolerance", type=Path, help="TOLERANCE.json of `gs-jax tolerance -o`.")
@capture_options
def command(
    design: Path,
    volume: Path | None,
    output: Path,
    points: Path | None,
    capture: Path | None,
    tolerance: Path | None,
    camera: CaptureOptions,
):
    """Show the microscope of DESIGN, and what it showed, as one page that any browser opens, without a network.

    VOLUME is what `gs-jax reconstruct` wrote. The page has the device to scale, the datasheet and what violates what,
    spots and contrast through depth and field, the layout, the mold; the capture, the volume and the points where they
    are given; what calibration and tolerances say; and which files all came from. It is less than 15 MB.

    DESIGN is a file, or the name of one that comes with the package, such as geomscope.
    """
    check_output(output, [".html"])
    check_may_write(output, inputs=(design, volume, points, capture, tolerance, *camera.files))
    if volume and volume.suffix.lower() in (".csv", ".toml"):
        raise InputError(f"{volume}: found it in the place of VOLUME, allowed: .ome.tif or .zarr; points by --points.")
    from ..apps.report.page import write_report
    from ..apps.report.report_tables import read_tolerance
    from ..design.design import design_text, read_design
    from ..io.provenance import read_provenance

    microscope = read_design(design)
    given, origins = {}, {}
    if volume:
        from ..io.volumes import read_volume

        given["volume"], given["grid"] = read_volume(volume)
    if points:
        from ..io.point_tables import read_points

        given["points"] = read_points(points)
    if capture:
        camera.imager(microscope.imager())
        given["image"] = camera.read(capture)
    if tolerance:
        given["tolerance"] = read_tolerance(tolerance)
    for path in (volume, points, capture, tolerance):
        if path:
            origins[path.name] = read_provenance(path)
    provenance = provenance_of(design, volume, points, capture, tolerance, design=design_text(microscope))
    with Progress() as progress, errors_name_file(design):
        write_report(
            output, microscope, **given, origins=origins, provenance=camera.recorded(provenance), progress=progress
        )
    camera.say()
    click.echo(f"{output}: {output.stat().st_size / 1e6:.1f} MB, opens in any browser")
