"""`gs-jax calibrate` and `simulate`: the geometry of a microscope from captures of points, and captures of scenes."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import click

from ..base.errors import InputError, errors_name_file
from ..base.progress import Progress
from ..io.files import side_file
from .commands import check_outputs, command, given_options, provenance_of
from .options import (
    PSFS,
    SIMULATED,
    CaptureOptions,
    Counts,
    DepthLight,
    DesignPath,
    Number,
    Parsed,
    Seed,
    ask_for_unit,
    objects_in,
)

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
    from ..calibration.spot_model import FITTED, OF_SAMPLE, with_surface
    from ..calibration.spots import MisfitError, Sources
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
    imager = camera.imager(light.of_channel(microscope, camera.channel).imager(microscope))
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


# Options of the exposure.
_CAMERA = ("peak_electrons", "gain", "offset", "read_noise", "full_well", "bits", "seed")


@command("simulate", "Example: gs-jax simulate points.csv design/geomscope.toml -o capture.tif")
def simulate_command(
    scene: Path,
    design: DesignPath,
    *,
    optics: Annotated[str, click.Choice(SIMULATED)] = "full",
    psf: Annotated[str, click.Choice(PSFS)] | None = None,
    peak_electrons: Annotated[float, Number(1.0, 1e6, "electrons")] = 1e4,
    noise: bool = True,
    gain: Annotated[float, Number(1e-3, 1e6, "electrons")] = 10.0,
    offset: Counts = 16.0,
    read_noise: Annotated[float, Number(0.0, 1e9, "electrons")] = 2.0,
    full_well: Annotated[float, Number(1.0, 1e9, "electrons")] | None = None,
    bits: Annotated[int, click.IntRange(1, 16)] = 16,
    seed: Seed = 0,
    output: Path,
    light: DepthLight,
):
    """Simulate the capture of SCENE by the microscope of the file DESIGN.

    SCENE is a CSV of points, x_mm,y_mm,z_mm,intensity, or a volume (OME-TIFF or OME-Zarr) of uniformly lit voxels.

    Options:
        optics: full: all of the light, by ray tracing; near: Eq. (2), with one PSF for all lenses near a point.
        psf: PSF of --optics near. [default: diffraction]
        peak_electrons: Electrons in the brightest pixel.
        noise: Without noise the capture is float32.
        gain: Electrons per count.
        offset: Counts of a dark pixel.
        read_noise: Standard deviation, electrons.
        full_well: Largest number of electrons in a pixel. [default: no limit]
        bits: Bits of the converter.
        seed: Seed of the noise.
        output: CAPTURE.tif, .png or .npy.
    """
    from concurrent.futures import ThreadPoolExecutor

    import jax
    import numpy as np

    from ..design.design import read_design
    from ..io.captures import CAPTURE_SUFFIXES, write_capture
    from ..simulation import Camera, compile_exposure, expose, read_scene, simulate

    check_outputs(output, CAPTURE_SUFFIXES, inputs=(scene, design))
    if not noise and output.suffix.lower() == ".png":
        raise InputError(f"{output}: the suffix must be .tif, .tiff or .npy with --no-noise: PNG holds no float32.")
    if scene.suffix.lower() == ".toml":
        raise InputError(f"{scene}: SCENE must be points or a volume, got a design: SCENE comes first, then DESIGN.")
    if not noise and (given := given_options(_CAMERA)):
        raise InputError(f"{given[0]} must be used with noise: --no-noise writes the light itself, without a camera.")
    if psf and optics == "full":
        raise InputError(f"--psf {psf} must be used with --optics near, which has one PSF for all lenses.")
    microscope = read_design(design)
    with Progress() as progress, ThreadPoolExecutor(1) as thread:
        imager = light.imager(microscope)
        camera = Camera(gain, offset, read_noise, math.inf if full_well is None else full_well, bits)
        with errors_name_file(scene):
            objects, grid = _placed(scene, *read_scene(scene), light, imager)
            exposure = imager.sensor.shape, camera, peak_electrons
            compiling = thread.submit(compile_exposure, *exposure) if noise else None
            image = simulate(objects, imager, grid, optics=optics, psf=psf, progress=progress)
        if compiling:
            with progress.step("Exposing"):
                compiling.result()
                image = np.asarray(expose(image, camera, jax.random.key(seed), peak_electrons=peak_electrons))
        with progress.step("Writing"):
            write_capture(output, image, provenance_of(scene, design=microscope))
    size = " x ".join(map(str, image.shape))
    click.echo(f"{output}: {size} pixels, {image.dtype}, from {image.min():g} to {image.max():g}, {objects_in(imager)}")


def _placed(scene: Path, objects, grid, light: DepthLight, imager):
    """A scene with depths from the array: a file that says that it counts from the sample was moved when read."""
    import numpy as np

    from ..io.provenance import frame_of
    from ..microscope.geometry import check_beyond

    origin, declared = light.origin(imager), frame_of(scene)
    if origin is not None and declared == "array":
        raise InputError("--depths-from must be array, as SCENE says that its depths count from there, got sample.")
    moved = (origin or 0.0) if declared is None else 0.0
    if grid is None:
        ask_for_unit(scene, objects)
        objects = objects + np.array([0, 0, moved, 0])
    elif moved:
        grid = grid.at(np.round(np.asarray(grid.depths, float) + moved, 6))
    check_beyond(imager, objects[:, 2] if grid is None else np.asarray(grid.depths), "depths")
    return objects, grid
