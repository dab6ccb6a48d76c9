"""`gs-jax simulate`: a capture of a scene."""

import math
from pathlib import Path
from typing import Annotated

import click

from ..base.errors import InputError, errors_name_file
from ..base.progress import Progress
from .commands import check_outputs, command, given_options, provenance_of
from .options import PSFS, SIMULATED, Counts, DepthLight, DesignPath, Number, Seed, ask_for_unit, objects_in

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
    import jax
    import numpy as np

    from ..design.design import read_design
    from ..io.captures import CAPTURE_SUFFIXES, write_capture
    from ..simulation.synthetic import Camera, expose, read_scene, simulate

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
            write_capture(output, image, provenance_of(scene, design=microscope))
    size = " x ".join(map(str, image.shape))
    click.echo(f"{output}: {size} pixels, {image.dtype}, from {image.min():g} to {image.max():g}, {objects_in(imager)}")


def _placed(scene: Path, objects, grid, light: DepthLight, imager):
    """A scene with depths from the array: a file that says that it counts from the sample was moved when read."""
    import numpy as np

    from ..geometry import check_beyond
    from ..io.provenance import frame_of

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
