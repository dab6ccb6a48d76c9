"""Points in a volume by the paper's particle clustering. Host code."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float, Float64
from skimage.measure import label, regionprops

from ..grid import Grid
from ..typing import Number

# Standard deviation of a normal distribution over its median absolute deviation.
_DEVIATION = 1.4826


def find_clusters(
    volume: Float[Array | np.ndarray, "depth y x"],
    grid: Grid,
    *,
    thresholds: Sequence[Number] = (0.05, 0.1, 0.15, 0.2),
    noise_floor: Number = 5.0,
) -> Float64[np.ndarray, "point 4"]:
    """Find points by the paper's particle clustering.

    "Background suppression through a particle clustering algorithm": voxels above the first threshold form connected
    groups (26 neighbours). Each group is divided by its maximum and cut at the next threshold, which splits some, and
    so on. The brightest voxel of every group of any threshold is a point. The thresholds are those of the authors'
    published code, relative to a group's maximum; of equal voxels, where that code chooses at random, the first counts.

    Parameters
    ----------
    volume, grid
        A reconstruction and its voxels. The median of each plane is subtracted as background.
    thresholds
        Between 0 and 1, ascending.
    noise_floor
        Points exceed so many standard deviations of the volume's noise, estimated by the median absolute deviation, as
        noise has clusters, too. The paper removes "system noise" by a threshold that it does not give.

    Returns
    -------
    ndarray
        `(point, 4)`: voxel centers, and the values there above the background, brightest first.

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
    groups, peaks = [(above, np.zeros(3, int))], set()
    for threshold in thresholds:
        parts = []
        for group, corner in groups:
            if not (top := group.max()) > 0:
                continue
            for region in regionprops(label(group > threshold * top, connectivity=3)):
                part = np.where(region.image, group[region.slice], 0)
                at = corner + [side.start for side in region.slice]
                peaks.add(tuple(at + np.unravel_index(part.argmax(), part.shape)))
                parts.append((part, at))
        groups = parts
    voxels = np.array(sorted(peaks), int).reshape(-1, 3)
    points = np.column_stack([grid.to_mm(voxels), above[tuple(voxels.T)]])
    points = points[points[:, 3] > noise_floor * _DEVIATION * np.median(np.abs(above))]
    return points[np.argsort(-points[:, 3], kind="stable")]
