"""The image of points that lie anywhere: one stamp of PSF_o for each lens that sees a point. Host code."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import KDTree

from ..base.progress import Progress
from ..geometry import Imager, envelope, field_limit

# Places of a stamp within a pixel, along each axis: it is at most a tenth of a pixel off.
STEPS = 5


class Stamps(NamedTuple):
    """PSF_o at some depths, moved by every fifth of a pixel.

    `kernels[d, i, j]` is on the sensor's pixels, and its chief ray lands `(i - 2, j - 2)` fifths of a pixel (row,
    column) from the middle of the central one.
    """

    depths: Float[np.ndarray, " depth"]
    kernels: Float[np.ndarray, "depth 5 5 size size"]


def stamps(depths: Float[np.ndarray, " depth"], fine: Float[np.ndarray, "depth fine fine"]) -> Stamps:
    """Stamps from PSFs on pixels a fifth as large, `(depth, 5 size, 5 size)` with an odd size.

    Raises
    ------
    ValueError
        If the depths do not ascend, or the size is not five times an odd number.
    """
    size = fine.shape[-1] // STEPS
    if fine.shape != (len(depths), STEPS * size, STEPS * size) or size % 2 == 0:
        raise ValueError(f"`fine` must be ({len(depths)}, n, n) with n five times an odd number, got {fine.shape}.")
    if (np.diff(depths) <= 0).any():
        raise ValueError(f"`depths` must ascend, got {depths}.")
    half = STEPS // 2
    kernels = np.empty((len(depths), STEPS, STEPS, size, size), fine.dtype)
    for i, j in np.ndindex(STEPS, STEPS):
        moved = np.roll(fine, (i - half, j - half), (1, 2))
        kernels[:, i, j] = moved.reshape(-1, size, STEPS, size, STEPS).sum((2, 4))
    return Stamps(depths, kernels)


def forward_points(
    points: Float[Array | np.ndarray, "point 4"], imager: Imager, stamps: Stamps, progress: Progress
) -> Float[np.ndarray, "row column"]:
    """The image of points, Eq. (2): what `forward` does for voxels, without a grid.

    The PSF is interpolated linearly between the depths of `stamps` and moved by fifths of a pixel.

    Parameters
    ----------
    points
        `(x, y, z, intensity)`, mm. Each lens's image of a point adds `intensity` times the envelope C.
    imager
        What sees them.
    stamps
        PSF_o. A point beyond its depths takes the nearest.
    progress
        Shows how many points are done.

    Returns
    -------
    ndarray
        `sensor.shape`, of the type of the stamps.
    """
    points = np.asarray(points, np.float64)
    pixels = np.asarray(imager.sensor.to_pixels(imager.project(points[:, :3])), np.float64)
    size = stamps.kernels.shape[-1]
    # A border for what spreads beyond the sensor; spots that are wholly beyond it are left out.
    image = np.zeros([n + 2 * size for n in imager.sensor.shape], stamps.kernels.dtype)
    tree = KDTree(np.asarray(imager.centers))
    limit = field_limit(imager.field_radius)
    for number in progress.track(range(len(points)), "Imaging points"):
        x, y, z, intensity = points[number]
        lenses = tree.query_ball_point((x, y), limit)
        distance2 = ((tree.data[lenses] - (x, y)) ** 2).sum(1)
        weights = intensity * np.asarray(envelope(distance2, float(imager.reduced_depth(z)), imager.field_radius))
        (near, near_part), (far, far_part) = _between(stamps.depths, z)
        for weight, place in zip(weights, pixels[lenses, number], strict=True):
            fifths = np.floor(place * STEPS + 0.5).astype(int) + STEPS // 2
            (row, column), (i, j) = fifths // STEPS, fifths % STEPS
            corner = np.array([row, column]) - size // 2 + size
            if (corner < 0).any() or (corner > np.array(image.shape) - size).any():
                continue
            patch = image[corner[0] : corner[0] + size, corner[1] : corner[1] + size]
            patch += (weight * near_part) * stamps.kernels[near, i, j]
            if far_part:
                patch += (weight * far_part) * stamps.kernels[far, i, j]
    return image[size:-size, size:-size]


def _between(depths: np.ndarray, depth: float):
    """The two planes around a depth and their parts."""
    place = float(np.interp(depth, depths, np.arange(len(depths))))
    near = min(int(place), len(depths) - 1)
    return (near, 1 - (place - near)), (min(near + 1, len(depths) - 1), place - near)
