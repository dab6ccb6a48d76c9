"""`gs-jax calibrate`: the geometry of a real microscope, from captures of point sources."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import click

from ..base.errors import InputError, errors_name_file
from ..base.progress import Progress
from ..io.files import side_file
from .commands import check_outputs, command, provenance_of
from .options import CaptureOptions, DepthLight, DesignPath, Parsed, ask_for_unit

# Names of quantities, of which the first four are always fitted.
FIT_NAMES = "sensor-distance rotation shift tilt scale depth-offset lenses sample-at sample-index".split()
# Depth of the source of a pattern unless --positions says another, mm: 10 m.
_FAR = 1e4


def _names(text: str) -> tuple[str, ...]:
    names = [name.strip().replace("_", "-") for name in text.split(",")]
    if wrong := [name for name in names if name not in FIT_NAMES]:
        raise click.BadParameter(f"must be some of {', '.join(FIT_NAMES)}, got {wrong[0]!r}.")
    return tuple(name.replace("-", "_") for name in names)


Names = Annotated[tuple[str, ...], Parsed("names", _names)]


@command("calibrate", "Example: gs-jax calibrate geomscope a.tif b.tif --positions p.csv -o my.toml")
def calibrate_command(
    design: DesignPath,
    captures: tuple[Path, ...] = (),
    *,
    positions: Path | None = None,
    fit: Names = (),
    hold: Names = (),
    find_lenses: bool = False,
    from_scene: bool = False,
    pattern: Path | None = None,
    output: Path,
    light: DepthLight,
    camera: CaptureOptions,
    force: bool = False,
):
    """Find the geometry of a real microscope, from CAPTURES of a pinhole or bead at known positions.

    Sensor distance, rotation, shift and tilt are fitted. DESIGN has the lens centres; its sensor distance may be off by
    a quarter, its rotation and shift by any amount, and the array may be mirrored. Positions are in the sensor's frame,
    with z from the array, or from the sample. One capture suffices; several depths and positions are better.

    Without a point source, a --pattern shows how the array is turned and mirrored, where it is, and its scale on the
    sensor. Its light is taken to come from 10 m straight ahead (beside CAPTURES: from any direction), unless
    --positions has a line for it, whose `capture` is the file's name. Lenses may differ and be out of focus, but their
    images must be apart.

    DESIGN's layers are in place. Sources at --positions are in air, unless --sample says what held them (`--sample
    sample` for DESIGN's [sample]) or a number of the sample is fitted; a scene is in DESIGN's [sample]. Points of known
    depths in a sample show where it begins and its index: --fit sample-at,sample-index, with --hold
    sensor-distance,rotation,shift,tilt. Those of a scene that nobody knows hardly show.

    Options:
        positions: POINTS.csv: x_mm,y_mm,z_mm of the source in each capture, one line each; with several sources per
            capture, a first column `capture` (number or file name). Empty cells are unknown and are fitted.
        fit: Also fit these: scale, depth-offset, lenses, sample-at, sample-index. sensor-distance, rotation, shift,
            tilt are always fitted.
        hold: Take these from the design and do not fit them.
        find_lenses: Find the lenses instead of using DESIGN's; needs --positions.
        from_scene: Fit rotation and tilt to one capture of any sparse scene, without positions.
        pattern: Capture with one image of every lens, sharp or not: of a far source, or of an even white surface.
            Alone, it fits rotation, shift and scale of the lenses' pattern; with CAPTURES, scale beside the rest.
        output: CALIBRATED.toml; a picture of the residuals, CALIBRATED.toml.png, is written beside it.
    """
    import numpy as np
    from rich.console import Console

    from ..calibration.calibrated_design import apply_calibration, plot_residuals, summary_table
    from ..calibration.fit import PATTERN_FITTED, SELF_FITTED, calibrate, self_calibrate
    from ..calibration.sources import MisfitError, Sources
    from ..calibration.spot_model import FITTED, OF_SAMPLE, with_surface
    from ..design.conversion import format_medium
    from ..design.design import read_design, write_design
    from ..io.files import write_figure
    from ..io.point_tables import read_positions
    from ..reconstruction.pipeline import voxel_grid

    if from_scene and (positions or pattern or find_lenses or len(captures) != 1):
        raise InputError("--from-scene needs one capture, without --positions, --pattern and --find-lenses.")
    if pattern and find_lenses:
        raise InputError("--pattern needs DESIGN's lenses, got --find-lenses.")
    if not from_scene and (bool(captures) and not positions or not (captures or pattern)):
        raise InputError(
            "calibrate needs captures with --positions POINTS.csv, or a --pattern, or one capture with --from-scene."
        )
    drawing = side_file(output, ".png")
    pictures = (*captures, *([pattern] if pattern else []))
    inputs = (design, *pictures, *([positions] if positions else []), *camera.files)
    check_outputs(output, [".toml"], drawing, inputs=inputs, force=force)
    microscope = read_design(design)
    fitted = SELF_FITTED if from_scene else FITTED if captures else PATTERN_FITTED
    names = [name for name in (*fitted, *(["scale"] if pattern else []), *fit) if name not in hold]
    of_sample = from_scene or light.depths_from == "sample" or not set(names).isdisjoint(OF_SAMPLE)
    light = _with_sample(light, microscope, default="sample" if of_sample else "air")
    imager = camera.imager(light.imager(microscope))
    with Progress() as progress:
        if from_scene:
            capture = next(iter(captures))
            image = camera.read(capture)
            camera.print_corrections()
            near, far = microscope.imaging.working_distance_mm
            grid = voxel_grid(imager, [max(near, float(str(imager.sample_surface))), far])
            with errors_name_file(capture):
                outcome = self_calibrate(image, imager, grid, fit=names, progress=progress)
        else:
            points, numbers = read_positions(positions, pictures) if positions else (np.zeros((0, 3)), np.zeros(0, int))
            ask_for_unit(positions, points)
            points[:, 2] += light.origin(imager) or 0.0
            blurred = [len(captures)] if pattern else []
            if pattern and len(captures) not in numbers:
                # A far source shows the array's shift unless others do: then its own direction is fitted.
                aside = np.nan if captures else 0.0
                points = np.append(points, [[aside, aside, _FAR]], 0)
                numbers = np.append(numbers, len(captures))
            with errors_name_file(positions or pattern or design):
                Sources(points, numbers).check(len(pictures), imager, names, blurred)
            images = [camera.read(path) for path in progress.track(pictures, "Reading captures")]
            camera.print_corrections()
            options = {"captures": numbers, "fit": names, "find_lenses": find_lenses, "blurred": blurred}
            try:
                outcome = calibrate(images, points, imager, **options, progress=progress)
            except MisfitError as error:
                _print_fits(pictures, error.fits)
                raise
    provenance = camera.recorded(provenance_of(*inputs))
    write_design(output, apply_calibration(microscope, outcome, provenance, sample=light.sample))
    write_figure(drawing, plot_residuals(outcome))
    Console().print(summary_table(microscope, outcome, with_surface(imager, names)))
    _print_fits(pictures, outcome.captures)
    mirrored = ", the array mirrored (y to -y) and rotated" if outcome.mirrored else ""
    lenses = f", {len(outcome.imager.array.centers)} lenses found" if find_lenses else ""
    click.echo(f"sources in {format_medium(outcome.imager)}{_other_samples(light, microscope)}")
    click.echo(f"{output}: {len(outcome.residuals)} spots, {outcome.rms:.3f} pixels RMS{mirrored}{lenses}")


def _print_fits(pictures, fits) -> None:
    """One line for each capture: the number of spots used, and of those expected, and their residual."""
    for path, fit in zip(pictures, fits, strict=True):
        click.echo(f"{path.name}: {fit}")


def _with_sample(light: DepthLight, design, default: str) -> DepthLight:
    """The light with its sample by name; "sample" is the design's `[sample]`, if no other has this name."""
    name = light.sample or (default if light.sample_index is None else None)
    return replace(light, sample=None if name == "sample" and name not in design.samples else name)


def _other_samples(light: DepthLight, design) -> str:
    """The names of a design's samples, if the sources are taken to be in air."""
    from ..design.conversion import AIR, NO_SAMPLE, default_sample

    names = [*(["sample"] if default_sample(design) != NO_SAMPLE else []), *design.samples]
    return f"; if they were in a sample: --sample {' or '.join(names)}" if light.sample == AIR and names else ""
