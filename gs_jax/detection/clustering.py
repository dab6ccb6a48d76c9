"""The paper's particle clustering: background suppression for sparse objects, from the volume alone. Host code.

`gs_jax.detection.locate` goes back to the capture and finds more; `gs_jax.rasterize` makes a volume of points.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float, Float64
from skimage.measure import label, regionprops

from ..grid import Grid
from ..typing import Number

# Standard deviation of a normal distribution over its median deviation from the median.
_DEVIATION = 1.4826


def find_clusters(
    volume: Float[Array | np.ndarray, "depth y x"],
    grid: Grid,
    *,
    thresholds: Sequence[Number] = (0.05, 0.1, 0.15, 0.2),
    noise_floor: Number = 5.0,
) -> Float64[np.ndarray, "point 4"]:
    """Points by the paper's particle clustering, from the volume alone.

    "Background suppression through a particle clustering algorithm": what exceeds the first threshold falls into
    connected groups. Each is divided by its own maximum and cut at the next threshold, which divides some into smaller
    ones, and so on. The brightest voxel of every group of any threshold is a point. Voxels are connected by a face, an
    edge or a corner (26 neighbours). The thresholds are those of the authors' published code, as parts of a group's
    maximum; where that code breaks a tie at random, we take the first voxel.

    Parameters
    ----------
    volume, grid
        A reconstruction and its voxels. The median of each plane is taken for its background and subtracted.
    thresholds
        Between 0 and 1, ascending.
    noise_floor
        Points are brighter than so many standard deviations of the volume's noise, as the median deviation from the
        median tells it: noise too has clusters. The paper removes "system noise" by a threshold that it does not give.

    Returns
    -------
    ndarray
        `(point, 4)`: voxel centres, and the values there above the background, brightest first.

    Raises
    ------
    ValueError
        If the volume is not of the grid's shape, or a threshold is out of range.
    """
    volume = np.asarray(volume, np.float32)
    if volume.shape != grid.volume_shape:
        raise ValueError(f"`volume` must be of the grid's shape {grid.volume_shape}, got {volume.shape}.")
    if not all(0 < t < 1 for t in thresholds):
        raise ValueError(f"`thresholds` must be between 0 and 1, got {tuple(thresholds)}.")
    above = volume - np.median(volume, axis=(1, 2), keepdims=True)
    groups, peaks = [above], set()
    corners = [np.zeros(3, int)]
    for threshold in thresholds:
        parts, part_corners = [], []
        for group, corner in zip(groups, corners, strict=True):
            top = group.max()
            if not top > 0:
                continue
            for region in regionprops(label(group > threshold * top, connectivity=3)):
                box = region.slice
                part = np.where(region.image, group[box], 0)
                at = corner + [side.start for side in box]
                peaks.add(tuple(at + np.unravel_index(part.argmax(), part.shape)))
                parts.append(part)
                part_corners.append(at)
        groups, corners = parts, part_corners
    voxels = np.array(sorted(peaks), int).reshape(-1, 3)
    points = np.column_stack([grid.to_mm(voxels), above[tuple(voxels.T)]])
    points = points[points[:, 3] > noise_floor * _DEVIATION * np.median(np.abs(above))]
    return points[np.argsort(-points[:, 3], kind="stable")]
