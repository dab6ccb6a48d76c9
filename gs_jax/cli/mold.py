"""`gs-jax mold`: a design to a part."""

import math
from pathlib import Path

import click

from ..base.errors import errors_name_file
from ..base.progress import Progress
from .files import check_may_write, provenance_of
from .options import DESIGN, Number


@click.command("mold", epilog="Example: gs-jax mold design/geomscope.toml -o mold.stl")
@click.argument("design", type=DESIGN)
@click.option("-o", "--output", type=Path, required=True, help="MOLD.stl or MOLD.3mf.")
@click.option("--positive", is_flag=True, help="The array itself, rather than its mold.")
@click.option(
    "--chord-um",
    type=Number(least=1e-3, most=1e3, unit="um"),
    default=0.4,
    show_default=True,
    help="Largest distance between a facet and its lens.",
)
@click.option(
    "--shrinkage-percent",
    type=Number(least=0.0, most=20.0, unit="%"),
    default=0.0,
    show_default=True,
    help="Of the cast material; the part is made larger by as much.",
)
@click.option(
    "--draft-deg",
    type=Number(least=0.0, most=30.0, unit="degrees"),
    default=0.0,
    show_default=True,
    help="Of the walls' inner faces. Silicone needs none.",
)
@click.option(
    "--headroom-mm",
    type=Number(least=0.0, most=100.0, unit="mm"),
    default=0.0,
    show_default=True,
    help="How much higher the walls are than the array is thick; 0 to cast flush under a glass plate.",
)
@click.option(
    "--resolution-um",
    type=Number(least=1e-2, most=1e3, unit="um"),
    default=25.0,
    show_default=True,
    help="Smallest feature that the printer makes.",
)
@click.option(
    "--layer-um", type=Number(least=1e-2, most=1e3, unit="um"), help="Thickness of the printer's layers, if it has any."
)
@click.option("--label/--no-label", default=True, show_default=True, help="Engrave the design's name in the rim.")
def command(
    design: Path,
    output: Path,
    positive: bool,
    chord_um: float,
    shrinkage_percent: float,
    draft_deg: float,
    headroom_mm: float,
    resolution_um: float,
    layer_um: float | None,
    label: bool,
):
    """Make the negative mold of the array of the file DESIGN, to print and to cast the array in.

    Units are mm. Lenses look toward -z. If the plano side faces the object, x and y are the design's; if the curved
    side does, the array lies turned over about x, with its y against the design's. A picture (.png) and a report
    (.json, .txt) of the same name are written beside it; what was written is read back and measured.
    """
    from ..design.design import design_text, read_design
    from ..mold.make import make_mold, report_text
    from ..mold.solids import MoldShape

    beside = (output.with_suffix(suffix) for suffix in (".png", ".json", ".txt"))
    check_may_write(output, *beside, inputs=(design,))
    microscope = read_design(design)
    shape = MoldShape(
        draft=math.radians(draft_deg),
        headroom=headroom_mm,
        shrinkage=shrinkage_percent / 100,
        label=microscope.name if label else "",
    )
    with Progress() as progress, errors_name_file(design):
        report = make_mold(
            microscope,
            output,
            positive=positive,
            shape=shape,
            chord=chord_um / 1000,
            resolution=resolution_um / 1000,
            layer=layer_um and layer_um / 1000,
            provenance=provenance_of(design, design=design_text(microscope)),
            progress=progress,
        )
    click.echo(report_text(report), nl=False)
