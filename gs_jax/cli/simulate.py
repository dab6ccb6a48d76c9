"""`gs-jax simulate`: a capture of a scene."""

import math
from pathlib import Path

import click

from ..base.errors import InputError, errors_name_file
from ..base.progress import Progress
from ..io.files import check_output
from .command import check_may_write, provenance_of
from .light import Light, ask_for_unit, check_beyond, light_options, objects_in
from .options import DESIGN, PSFS, SIMULATED, Number, given_options

PEAK = Number(1.0, 1e6, "electrons")
ELECTRONS = Number(0.0, 1e9, "electrons")
GAIN = Number(1e-3, 1e6, "electrons")
WELL = Number(1.0, 1e9, "electrons")
COUNTS = Number(0.0, 65535.0, "counts")
# Options of the exposure.
_CAMERA = ("peak_electrons", "gain", "offset", "read_noise", "full_well", "bits", "seed")


@click.command("simulate", epilog="Example: gs-jax simulate points.csv design/geomscope.toml -o capture.tif")
@click.argument("scene", type=Path)
@click.argument("design", type=DESIGN)
@click.option(
    "--optics",
    type=click.Choice(SIMULATED),
    default="full",
    help="full: all of the light, by ray tracing; near: Eq. (2), with one PSF for all lenses near a point.",
)
@click.option("--psf", type=click.Choice(PSFS), help="PSF of --optics near.  [default: diffraction]")
@click.option("--peak-electrons", type=PEAK, default=1e4, help="Electrons in the brightest pixel.")
@click.option("--noise/--no-noise", default=True, help="Without noise the capture is float32.")
@click.option("--gain", type=GAIN, default=10.0, help="Electrons per count.")
@click.option("--offset", type=COUNTS, default=16.0, help="Counts of a dark pixel.")
@click.option("--read-noise", type=ELECTRONS, default=2.0, help="Standard deviation, electrons.")
@click.option("--full-well", type=WELL, help="Largest number of electrons in a pixel.  [default: no limit]")
@click.option("--bits", type=click.IntRange(1, 16), default=16, help="Bits of the converter.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, help="Seed of the noise.")
@click.option("-o", "--output", type=Path, required=True, help="CAPTURE.tif, .png or .npy.")
@light_options
def simulate_command(
    scene: Path,
    design: Path,
    optics: str,
    psf: str | None,
    peak_electrons: float,
    noise: bool,
    gain: float,
    offset: float,
    read_noise: float,
    full_well: float | None,
    bits: int,
    seed: int,
    output: Path,
    light: Light,
):
    """Simulate the capture of SCENE by the microscope of the file DESIGN.

    SCENE is a CSV of points, x_mm,y_mm,z_mm,intensity, or a volume (OME-TIFF or OME-Zarr) of uniformly lit voxels.
    """
    import jax
    import numpy as np

    from ..design.design import design_text, read_design
    from ..io.captures import CAPTURE_SUFFIXES, write_capture
    from ..simulation.synthetic import Camera, expose, read_scene, simulate

    check_output(output, CAPTURE_SUFFIXES)
    check_may_write(output, inputs=(scene, design))
    if not noise and output.suffix.lower() == ".png":
        raise InputError(f"{output}: the suffix must be .tif, .tiff or .npy with --no-noise: PNG holds no float32.")
    if scene.suffix.lower() == ".toml":
        raise InputError(f"{scene}: SCENE must be points or a volume, got a design: SCENE comes first, then DESIGN.")
    if not noise and (given := given_options(_CAMERA)):
        raise InputError(f"{given[0]} must be used with noise: --no-noise writes the light itself, without a camera.")
    if psf and optics == "full":
        raise InputError(f"--psf {psf} must be used with --optics near, which has one PSF for all lenses.")
    microscope = read_design(design)
    with Progress() as progress:
        imager = light.imager(microscope)
        with errors_name_file(scene):
            objects, grid = _placed(scene, *read_scene(scene), light, imager)
            image = simulate(objects, imager, grid, optics=optics, psf=psf, progress=progress)
        if noise:
            with progress.step("Exposing"):
                camera = Camera(gain, offset, read_noise, math.inf if full_well is None else full_well, bits)
                image = np.asarray(expose(image, camera, jax.random.key(seed), peak_electrons=peak_electrons))
        with progress.step("Writing"):
            write_capture(output, image, provenance_of(scene, design=design_text(microscope)))
    size = " x ".join(map(str, image.shape))
    click.echo(f"{output}: {size} pixels, {image.dtype}, from {image.min():g} to {image.max():g}, {objects_in(imager)}")


def _placed(scene: Path, objects, grid, light: Light, imager):
    """A scene with depths from the array: what says that it counts from the sample is so already."""
    import numpy as np

    from ..io.provenance import frame_of

    origin, said = light.origin(imager), frame_of(scene)
    if origin is not None and said == "array":
        raise InputError("--depths-from must be array, as SCENE says that its depths count from there, got sample.")
    moved = (origin or 0.0) if said is None else 0.0
    if grid is None:
        ask_for_unit(scene, objects)
        objects = objects + np.array([0, 0, moved, 0])
    elif moved:
        grid = grid.at(np.round(np.asarray(grid.depths, float) + moved, 6))
    check_beyond(imager, objects[:, 2] if grid is None else np.asarray(grid.depths), "depths")
    return objects, grid
