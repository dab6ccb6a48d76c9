"""What napari's widget shows: layers of a reconstruction, in um, and a sample capture. Needs no napari."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from ..base.errors import InputError
from ..base.progress import CancellableProgress
from ..cli.options import DESIGN, CaptureOptions, Depths, depth_range

# Seconds between looks whether the user cancelled.
_POLL_INTERVAL = 0.1
_UM_PER_MM = 1000.0


class Result(NamedTuple):
    """Layers to add, the transform of the capture's layer, and messages."""

    layers: list[Any]
    transform: dict[str, Any]
    status: str
    warnings: list[str]


def prepare_layers(
    design: Path,
    depths: str,
    voxel_um: float,
    method: str,
    suppress: str,
    points: bool,
    progress: CancellableProgress,
) -> Callable[[str, Path | np.ndarray], Result]:
    """Returns the function that reconstructs a file, or the pixels of a layer, as `gs-jax reconstruct` does.

    Raises
    ------
    InputError
        As the command.
    """
    from ..design.design import read_design
    from ..io.napari import mean_step, points_layer, surface_layers, volume_layer
    from ..io.surfaces import SurfaceMaps
    from ..reconstruction.plan import Plan

    try:
        planes = Depths().convert(depths, None, None)
    except click.BadParameter as error:
        raise InputError(f"Depths {error.message}") from error
    imager = read_design(design).imager()
    options = {"method": method, "suppress": suppress, "points": points}
    plan = Plan.of(imager, planes, voxel_um / _UM_PER_MM or None, **options)
    grid, volume_of = plan.grid, plan.prepare(progress)

    def reconstruct(name: str, capture: Path | np.ndarray) -> Result:
        with progress.step("Reading"):
            if isinstance(capture, Path):
                camera = CaptureOptions(dark=None, flat=None, bad_pixels="auto", offset=0.0)
                camera.imager(imager)
                image, warnings = camera.read(capture), list(camera.warnings)
            else:
                image, warnings = _correct_pixels(name, capture, imager.sensor)
        with progress.step("Reconstructing"):
            found = volume_of(image, progress)
        progress.check_cancelled()
        layers = [volume_layer(found.volume, grid, f"{name}, {method if suppress == 'none' else suppress}")]
        if fit := found.surface:
            layers += surface_layers(SurfaceMaps(fit.brightness, fit.depth, fit.depth_sd, grid), name)
        if found.points is not None:
            layers.append(points_layer(found.points, f"{name}, {len(found.points)} points", mean_step(grid)))
        z, y, x = found.volume.shape
        status = f"{z} x {y} x {x} voxels (z, y, x), {grid.pitch * _UM_PER_MM:.4g} um laterally, {depth_range(planes)}"
        warnings += [found.warning] if found.warning else []
        return Result(layers, _capture_transform(imager.sensor), status, warnings)

    return reconstruct


def newest_captures(folder: Path, make: Callable[[str, Path], Result], progress: CancellableProgress) -> Iterator:
    """Yields the `Result` of the newest capture of a folder again and again, or what is wrong with it in words.

    Raises
    ------
    InputError
        If the folder cannot be watched.
    """
    from ..io.recordings import WatchedFolder
    from ..reconstruction.recording import SETTLED

    name, since = "", 0.0
    with WatchedFolder(folder) as watched:
        while True:
            names = watched.changes(_POLL_INTERVAL)
            progress.check_cancelled()
            if names:
                name, since = names[-1], time.monotonic()
            if not name:
                continue
            try:
                result = make(name, folder / name)
                late = time.time() - (folder / name).stat().st_mtime
                yield result._replace(status=f"{name}, {1000 * late:.0f} ms after it was written")
            except (InputError, FileNotFoundError) as error:
                # It may be half-written.
                if time.monotonic() - since < SETTLED:
                    continue
                yield str(error)
            name = ""


def _correct_pixels(name, pixels, sensor):
    """Validates the pixels of a layer and repairs hot ones, as for a file; also returns warnings."""
    from ..io.camera import prepare, read_frame
    from ..io.captures import DTYPES, check_images

    pixels = np.asarray(pixels)
    if pixels.shape != sensor.shape or pixels.dtype.name not in DTYPES:
        given, expected = (" x ".join(map(str, shape)) for shape in (pixels.shape, sensor.shape))
        raise InputError(
            f"{name}: the layer must have {expected} pixels (rows x columns, as the design's sensor) of type "
            f"{', '.join(DTYPES)}, got {given} of {pixels.dtype}."
        )
    frame = read_frame(name, check_images(name, iter([pixels])), prepare(pixels.shape))
    return frame.image, frame.warnings


def _capture_transform(sensor) -> dict[str, Any]:
    """Scale and position of a capture's layer."""
    pitch, (x, y) = sensor.pixel_pitch, map(float, sensor.origin)
    first = [middle - (n - 1) / 2 * pitch for middle, n in zip((y, x), sensor.shape, strict=True)]
    return {
        "scale": (_UM_PER_MM * pitch, _UM_PER_MM * pitch),
        "translate": tuple(_UM_PER_MM * each for each in first),
        "units": ("um", "um"),
        "axis_labels": ("y", "x"),
    }


def sample() -> list[Any]:
    """A simulated capture of forty beads between 18 and 22 mm by `geomscope`, with camera noise."""
    import jax

    from ..design.design import read_design
    from ..simulation.phantoms import random_points
    from ..simulation.synthetic import Camera, expose, simulate

    imager = read_design(DESIGN.convert("geomscope", None, None)).imager()
    light = simulate(random_points(40, (6.0, 6.0), (18.0, 22.0), seed=0), imager, optics="near", psf="geometric")
    image = np.asarray(expose(light, Camera(), jax.random.key(0), peak_electrons=2e4))
    limits = tuple(map(float, np.percentile(image, (1, 99.95))))
    return [(image, {"name": "beads", "contrast_limits": limits} | _capture_transform(imager.sensor), "image")]
