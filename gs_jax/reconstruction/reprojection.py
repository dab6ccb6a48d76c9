"""What of a capture a volume explains: the check on any reconstruction, and on a learned one above all."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from ..base.progress import Progress
from ..base.safe import divide
from ..geometry import Grid, Imager
from ..projection.forward_model import Optics, forward
from .pipeline import above_offset, explained

# Squares along a side of the sensor, unless it has fewer pixels.
REGIONS = 16


class Reprojection(NamedTuple):
    """How far the image of a volume is from the capture, after the one gain that fits it best.

    Parameters
    ----------
    error
        RMS of the difference over that of the capture above its offset: 0 if all is explained, 1 if nothing is.
    correlation
        Pearson's, of the pixels.
    regions
        The error in squares of the sensor, relative to the whole capture's RMS: where it is large, do not trust what
        is reconstructed from there.
    """

    error: float
    correlation: float
    regions: Float[np.ndarray, "row column"]


def reproject(
    volume: Float[Array | np.ndarray, "depth y x"],
    image: Num[Array | np.ndarray, "row column"],
    imager: Imager,
    grid: Grid,
    *,
    optics: Optics | str = "full",
    progress: Progress | None = None,
) -> Reprojection:
    """Image a volume again, and compare with the capture that it was reconstructed from.

    It is compared as `reconstruct` sees it: above the camera's offset, pixels as wide as voxels, and without what the
    optics takes for background.

    Parameters
    ----------
    volume
        `grid.volume_shape`, of any method.
    image, imager, grid, optics, progress
        As for `reconstruct`.
    """
    light = above_offset(np.asarray(image, imager.sensor_distance.dtype))
    light, imager, background, optics = explained(light, imager, grid, optics, progress or Progress())
    light = jnp.asarray(light - background)
    return Reprojection(*_compared(jnp.asarray(volume, light.dtype), light, imager, grid, optics))


def _compared(volume, light, imager, grid, optics):
    model = forward(volume, imager, grid, optics)
    # Scaled by hand: squares of a capture's counts times a volume's leave half of float32's range.
    model = divide(model, jnp.broadcast_to(jnp.max(jnp.abs(model)), model.shape))
    left = light - divide(jnp.vdot(model, light), jnp.vdot(model, model)) * model
    whole = jnp.sqrt(jnp.mean(light**2))
    centred = [part - jnp.mean(part) for part in (model, light)]
    correlation = divide(jnp.vdot(*centred), jnp.linalg.norm(centred[0]) * jnp.linalg.norm(centred[1]))
    error = float(divide(jnp.sqrt(jnp.mean(left**2)), whole))
    return error, float(correlation), _rms_of_regions(np.asarray(left)) / max(float(whole), 1e-30)


def _rms_of_regions(image):
    first = [np.unique(np.linspace(0, n, REGIONS, endpoint=False).astype(int)) for n in image.shape]
    sums = lambda part: np.add.reduceat(np.add.reduceat(part, first[0], 0), first[1], 1)
    return np.sqrt(sums(image**2) / sums(np.ones_like(image)))
