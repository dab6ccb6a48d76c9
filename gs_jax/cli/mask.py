"""`gs-jax mask`: what is opaque between the lenses."""

from pathlib import Path

import click

from ..base.errors import errors_name_file
from .files import check_may_write, provenance_of
from .options import DESIGN


@click.command("mask", epilog="Example: gs-jax mask design/geomscope-optimized.toml -o mask.dxf")
@click.argument("design", type=DESIGN)
@click.option("-o", "--output", type=Path, required=True, help="MASK.dxf, MASK.svg, or MASK.gds for GDSII.")
def command(design: Path, output: Path):
    """Draw the opaque mask between the lenses of the file DESIGN, to have it made.

    Openings are the lenses' clear discs; the sheet is as large as the mold, with its alignment marks, and seen as the
    mold from above: from the plano side of the lenses. DXF and SVG are
    in mm, GDSII in um (it needs `pip install 'gs-jax[gds]'`). Beside the drawing, .json says where it comes from.
    """
    from ..design.design import design_text, read_design
    from ..io.files import check_output
    from ..mold.export import MASK_SUFFIXES, mask_plan, write_mask

    check_output(output, MASK_SUFFIXES)
    check_may_write(output, inputs=(design,))
    microscope = read_design(design)
    with errors_name_file(design):
        mask = mask_plan(microscope.imager().array)
    write_mask(output, mask, provenance_of(design, design=design_text(microscope)))
    alone, rings = len(mask.circles), len(mask.openings)
    width, height = mask.outline.max(0) - mask.outline.min(0)
    click.echo(f"{output}: {alone} round openings and {rings} others on a sheet of {width:g} x {height:g} mm")
