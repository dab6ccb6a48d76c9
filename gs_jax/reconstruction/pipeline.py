"""From a capture to a volume, as the command line does it."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32, Shaped

from ..base.errors import InputError
from ..base.info import available_memory
from ..base.progress import Progress
from ..geometry import Grid, Imager
from ..optics.window import psf_of_depth
from ..projection.backprojection import backproject
from .methods import reconstruct

# Planes between two steps of the progress bar; a plane more or less changes neither speed nor memory.
_PLANES = 16
# Percentile of the pixels that is taken for the camera's offset: few captures are lit all over.
_DARKEST = 1


def voxel_grid(imager: Imager, depths: list[float], pitch: float | None = None) -> Grid:
    """The voxels to reconstruct: the field of view, as large as the sensor.

    Parameters
    ----------
    imager
        What took the capture.
    depths
        In mm.
    pitch
        Of the voxels laterally, mm. By default a pixel as seen at the middle depth, rounded to 0.1 um, and no less.

    Raises
    ------
    InputError
        If the volume would not fit into the memory.
    """
    if pitch is None:
        middle = float(imager.magnification(np.median(depths)))
        pitch = max(round(imager.sensor.pixel_pitch / middle, 4), 1e-4)
    grid = Grid.over(imager.sensor, depths=jnp.array(depths), pitch=pitch)
    size = 4 * len(depths) * grid.shape[0] * grid.shape[1]
    # The volume, the copy that is being computed, and room for the image.
    if 2.5 * size > (memory := available_memory()):
        shape = " x ".join(map(str, (len(depths), *grid.shape)))
        raise InputError(
            f"--voxel-um, --depths: found {pitch * 1000:g} um and {len(depths)} depths, a volume of {shape} voxels or "
            f"{size / 2**30:.3g} GiB, allowed: {memory / 2.5 / 2**30:.3g} GiB on this machine."
        )
    return grid


def reconstruct_stack(
    image: Shaped[Array | np.ndarray, "row column"], imager: Imager, grid: Grid, progress: Progress
) -> Float32[np.ndarray, "depth y x"]:
    """`backproject`, some planes at a time."""
    image = jnp.asarray(image)
    volume = np.empty(grid.volume_shape, np.float32)
    for first in progress.track(range(0, grid.depths.size, _PLANES), "Back-projecting"):
        planes = grid.at(grid.depths[first : first + _PLANES])
        volume[first : first + _PLANES] = backproject(image, imager, planes)
    return volume


def reconstruct_iteratively(
    image: Shaped[Array | np.ndarray, "row column"],
    imager: Imager,
    grid: Grid,
    *,
    method: str,
    steps: int,
    progress: Progress,
) -> Float32[np.ndarray, "depth y x"]:
    """A volume by one of `methods.METHODS`, from the light above the camera's offset.

    The offset is the image's darkest percent. PSF_o is that of the rays, without diffraction.

    Parameters
    ----------
    image, imager, grid
        As for `backproject`.
    method, steps
        As for `methods.reconstruct`.

    Raises
    ------
    InputError
        If a depth of the grid is blurred over more than 128 pixels.
    """
    light = jnp.asarray(image, imager.sensor_distance.dtype)
    light = jnp.maximum(light - jnp.percentile(light, _DARKEST), 0)
    if method == "list-rl":
        psf = jnp.zeros((grid.depths.size, 1, 1))
    else:
        kernel = psf_of_depth(imager, np.asarray(grid.depths), "geometric")
        psf = jnp.stack([kernel(z) for z in progress.track(np.asarray(grid.depths), "Point spread functions")])
    with progress.counter("Iterating", steps) as advance:
        volume = reconstruct(light, imager, grid, psf, method=method, steps=steps, callback=lambda *_: advance())
        return np.asarray(volume, np.float32)
