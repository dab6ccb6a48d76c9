"""`gs-jax mold`, `mask`, `heights`, `holder` and `tolerance`: fabrication of a design, and its errors."""

import math
from pathlib import Path
from typing import Annotated, Any

import click

from ..apps.tolerance_spec import ToleranceSpec
from ..base.errors import InputError, errors_name_file
from ..base.progress import Progress
from ..io.files import side_file, write_json
from .commands import check_outputs, command, given_options, provenance_of
from .options import DepthList, DesignPath, Light, Number, Seed, Um, objects_in

SmallUm = Annotated[float, Number(1e-3, 1e3, "um")]
FeatureUm = Annotated[float, Number(1e-2, 1e3, "um")]


@command("mold", "Example: gs-jax mold design/geomscope.toml -o mold.stl")
def mold_command(
    design: DesignPath,
    *,
    output: Path,
    positive: bool = False,
    chord_um: SmallUm | None = None,
    shrinkage_percent: Annotated[float, Number(0.0, 20.0, "%")] = 0.0,
    draft_deg: Annotated[float, Number(0.0, 30.0, "degrees")] = 0.0,
    headroom_mm: Annotated[float, Number(0.0, 100.0, "mm")] = 0.0,
    resolution_um: FeatureUm = 25.0,
    layer_um: FeatureUm | None = None,
    label: bool = True,
):
    """Make the negative mold of the array of the file DESIGN, to print and cast the array in.

    Units are mm. The lenses face -z. If the plano side faces the object, x and y are the design's; if the curved side
    does, the array is turned over about x, and y is reversed. A picture (MOLD.stl.png) and a report
    (MOLD.stl.json, MOLD.stl.txt) are written beside it; the mold is read back and measured.

    Options:
        output: MOLD.stl or MOLD.3mf.
        positive: Make the array itself instead of its mold.
        chord_um: Largest distance between a facet and the lens surface. [default: 0.4; less if lenses are below 40 um
            high]
        shrinkage_percent: Of the cast material; the part is made larger.
        draft_deg: Of the walls' inner faces. Silicone needs none.
        headroom_mm: Walls above the array; 0 to cast under a glass plate.
        resolution_um: Smallest feature of the printer.
        layer_um: Thickness of the printer's layers, if any.
        label: Engrave the design's name in the rim.
    """
    from ..design.design import read_design
    from ..mold.export import MESH_SUFFIXES
    from ..mold.make import make_mold, report_text, side_files
    from ..mold.solids import MoldShape

    if positive and (given := given_options(("draft_deg", "headroom_mm"))):
        raise InputError(f"{given[0]} must be used without --positive: it is of the mold's walls.")
    check_outputs(output, MESH_SUFFIXES, *side_files(output), inputs=(design,))
    microscope = read_design(design)
    shape = MoldShape(
        draft=math.radians(draft_deg),
        headroom=headroom_mm,
        shrinkage=shrinkage_percent / 100,
        label=microscope.name if label else "",
    )
    options = {
        "positive": positive,
        "shape": shape,
        "chord": chord_um and chord_um / 1000,
        "resolution": resolution_um / 1000,
        "layer": layer_um and layer_um / 1000,
    }
    provenance = provenance_of(design, design=microscope)
    with Progress() as progress, errors_name_file(design):
        report = make_mold(microscope, output, **options, provenance=provenance, progress=progress)
    click.echo(report_text(report), nl=False)


@command("mask", "Example: gs-jax mask design/geomscope-optimized.toml -o mask.dxf")
def mask_command(design: DesignPath, *, output: Path):
    """Draw the opaque mask between the lenses of the file DESIGN, to have it made.

    Openings are the lenses' clear apertures. The sheet has the size and alignment marks of the mold, and is seen from
    above, from the plano side of the lenses. DXF and SVG are in mm, GDSII in um (needs `pip install 'gs-jax[gds]'`). A
    file of its name plus .json has the provenance.

    Options:
        output: MASK.dxf, MASK.svg, or MASK.gds for GDSII.
    """
    from ..design.conversion import AIR
    from ..design.design import read_design
    from ..mold.export import MASK_SUFFIXES, make_mask, write_mask

    check_outputs(output, MASK_SUFFIXES, inputs=(design,))
    microscope = read_design(design)
    with errors_name_file(design):
        mask = make_mask(microscope.imager(AIR).array)
    write_mask(output, mask, provenance_of(design, design=microscope))
    alone, rings = len(mask.circles), len(mask.openings)
    width, height = mask.outline.max(0) - mask.outline.min(0)
    click.echo(f"{output}: {alone} round openings and {rings} others on a sheet of {width:g} x {height:g} mm")


@command("heights", "Example: gs-jax heights design/geomscope.toml -o array.tif")
def heights_command(design: DesignPath, *, output: Path, step_um: SmallUm = 10.0, force: bool = False):
    """Write the molded surface of the file DESIGN for its maker, or for an optical program.

    TIFF, PNG and text hold heights above the plate between the lenses, seen from the lenses' side: x to the right, y
    up. A grid sag, and the list of a plate and its lenses for non-sequential rays, have z along the light, and z = 0 at
    the vertices. A .json of the output's name plus .json has the frame and scale. The file is read back and compared
    with the design.

    Options:
        output: HEIGHTS.tif (float, mm), .png (16 bits), .xyz (text), .dat (grid sag of OpticStudio); LENSES.csv.
        step_um: Distance of points; not of LENSES.csv.
    """
    from ..design.design import read_design
    from ..io.provenance import sidecar
    from ..mold.heights import HEIGHT_SUFFIXES, write_heights

    if output.suffix.lower() == ".csv" and given_options(["step_um"]):
        raise InputError(f"--step-um must be used with heights, got the list of lenses {output}.")
    check_outputs(output, HEIGHT_SUFFIXES, sidecar(output), inputs=(design,), force=force)
    microscope = read_design(design)
    provenance = provenance_of(design, design=microscope)
    with Progress() as progress, errors_name_file(design):
        report = write_heights(microscope, output, step=step_um / 1000, provenance=provenance, progress=progress)
    columns, rows = report.get("points", (0, 0))
    what = f"{columns} x {rows} points every {step_um:g} um" if columns else f"{report['objects']} objects"
    count = f", {1e6 * scale:.4g} nm a count" if (scale := report.get("mm_per_count")) else ""
    click.echo(f"{output}: {what}{count}; read back, it is within {report['deviation_nm']:.2g} nm of the design")
    click.echo(f"{output}: {report['frame']}; (x, y) of the design is ({report['design_x_y']})")


@command("holder", "Example: gs-jax holder my.toml --flange-mm 11.5 --bore-mm 42 --bolts-mm 56 -o rig.stl")
def holder_command(
    design: DesignPath,
    *,
    output: Path,
    flange_mm: Annotated[float, Number(0.1, 200.0, "mm")] = 17.526,
    bore_mm: Annotated[float, Number(1.0, 500.0, "mm")] | None = None,
    bolts_mm: Annotated[float, Number(1.0, 500.0, "mm")] | None = None,
    wall_mm: Annotated[float, Number(0.5, 20.0, "mm")] = 2.0,
    clearance_mm: Annotated[float, Number(0.0, 2.0, "mm")] = 0.1,
    pinhole_um: Annotated[float, Number(1.0, 1000.0, "um")] = 100.0,
    target_mm: Annotated[float, Number(0.1, 1e4, "mm")] | None = None,
    force: bool = False,
):
    """Make a holder that keeps the array of DESIGN before a camera, and a target of pinholes to calibrate by.

    The array's plano face lies on the holder's ledge, which is printed so that the named shims, under its shoulder,
    make up the sensor distance. The camera has a C-mount thread, or with --bore-mm any round opening. The target, a cap
    for the holder, is RIG-target.stl, the places of its pinholes RIG-target.csv, for `calibrate --positions`.
    RIG.stl.png shows all in section; RIG.stl.json has the numbers.

    Options:
        output: RIG.stl or RIG.3mf.
        flange_mm: Distance from the sensor to the camera's face on which the holder stands.
        bore_mm: Diameter of the opening in that face. [default: a C-mount thread]
        bolts_mm: Diameter of the circle of four M3 screws about the opening; needs --bore-mm.
        wall_mm: Thickness of walls.
        clearance_mm: Gap between parts that fit into each other.
        pinhole_um: Diameter of the pinholes.
        target_mm: Depth of the pinholes from the array's front. [default: the middle of the working distance]
    """
    from ..design.design import read_design
    from ..mold.export import MESH_SUFFIXES
    from ..mold.holder import HolderShape
    from ..mold.rig import rig_files, write_rig

    if bolts_mm and not bore_mm:
        raise InputError("--bolts-mm must be used with --bore-mm: a C-mount thread needs no screws.")
    check_outputs(output, MESH_SUFFIXES, *rig_files(output), inputs=(design,), force=force)
    microscope = read_design(design)
    shape = HolderShape(flange_mm, bore_mm, bolts_mm, wall_mm, clearance_mm, pinhole_um / 1000, target_mm)
    with Progress() as progress, errors_name_file(design):
        provenance = provenance_of(design, design=microscope)
        report = write_rig(microscope, output, shape, provenance=provenance, progress=progress)
    for check in report["checks"]:
        click.echo(f"[{check['level']}] {check['check']}: {check['text']}")
    click.echo(f"{', '.join(report['files'])}: in mm, {report['frame']}")


def _tolerance_options() -> list[click.Option]:
    """An option for each tolerance."""
    options = []
    for name, field in ToleranceSpec.model_fields.items():
        least, most = (getattr(bound, side) for bound, side in zip(field.metadata, ("ge", "le"), strict=True))
        unit = name.rpartition("_")[2] if "_" in name else ""
        text = f"{str(field.title)[:1].upper()}{str(field.title)[1:]}.  [default: {field.default:g}]"
        kind = Number(least=float(least), most=float(most), unit=unit)
        options.append(click.Option([name, f"--{name.replace('_', '-')}"], type=kind, help=text))
    return options


@command(
    "tolerance",
    "Example: gs-jax tolerance geomscope --sensor-distance-um 20 -o tolerance.json",
    more=_tolerance_options(),
)
def tolerance_command(
    design: DesignPath,
    *,
    output: Path | None = None,
    tolerances: Path | None = None,
    max_width_um: Um | None = None,
    min_strehl: Annotated[float, Number(1e-3, 1.0)] | None = None,
    max_depth_error_um: Um | None = None,
    depths: DepthList | None = None,
    positions: Path | None = None,
    draws: Annotated[int, click.IntRange(1, 10**6)] = 1000,
    seed: Seed = 0,
    light: Light,
    **values: float | None,
):
    """Show the effect of tolerances on the spots and depths of the microscope of DESIGN, and the yield.

    Tolerances are standard deviations; roughness and printed layers are the same in every device. Depth errors are
    those of points located with the design's geometry, and with a calibrated one.

    Options:
        output: TOLERANCE.json: write the numbers, and beside it a picture (.json.png).
        tolerances: TOML file of tolerances: position_um = 3.0 and so on.
        max_width_um: Target: width of spots in the object. [default: 1.2 of the design's]
        min_strehl: Target: Strehl ratio on the axis. [default: 0.8 times the design's, if that is 0.1 or more]
        max_depth_error_um: Target: error of calibrated depths. [default: the axial resolution, Eq. 6]
        depths: START:STOP:STEP in mm. [default: five in the working distance]
        positions: POINTS.csv: x_mm,y_mm,z_mm of calibration sources. [default: four]
        draws: Random devices.
        seed: Seed of the devices.
    """
    import jax
    import numpy as np
    from rich.console import Console

    from ..apps.tolerance_spec import read_tolerances
    from ..apps.tolerances import as_json, picture, sentences, tables, tolerance
    from ..io.files import write_figure
    from ..io.point_tables import read_positions
    from ..io.provenance import KEY
    from ..microscope.geometry import check_beyond

    # Single precision would leave errors of micrometres.
    jax.config.update("jax_enable_x64", True)
    drawing = output and side_file(output, ".png")
    if output and drawing:
        check_outputs(output, [".json"], drawing, inputs=(design, tolerances, positions))
    given = {name: value for name, value in values.items() if value is not None}
    chosen = (read_tolerances(tolerances) if tolerances else ToleranceSpec()).model_copy(update=given)
    sources = None
    if positions:
        sources, _ = read_positions(positions, [])
        if not len(sources) or np.isnan(sources).any() or not (sources[:, 2] > 0).all():
            raise InputError(f"{positions}: every source must have x, y and z > 0, got one without.")
    microscope = light.read_design(design)
    check_beyond(microscope.imager(), [*(depths or ()), *([] if sources is None else sources[:, 2])], "depths")
    targets: dict[str, Any] = {
        "max_width": max_width_um and max_width_um / 1000,
        "min_strehl": min_strehl,
        "max_depth_error": max_depth_error_um and max_depth_error_um / 1000,
    }
    with Progress() as progress, errors_name_file(design):
        options: dict[str, Any] = {
            "depths": depths,
            "sources": sources,
            "draws": draws,
            "seed": seed,
            "progress": progress,
        }
        result = tolerance(microscope, chosen, **options, **targets)
    if output and drawing:
        provenance = provenance_of(design, tolerances, positions, design=microscope)
        write_json(output, {KEY: provenance, "seed": seed} | as_json(result))
        write_figure(drawing, picture(result))
    click.echo(objects_in(microscope.imager()))
    console = Console()
    for table in tables(result):
        console.print(table)
        console.print()
    for sentence in sentences(result):
        click.echo(f"- {sentence}")
