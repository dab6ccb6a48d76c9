"""Local maxima of a reconstruction, profiles through them, and their widths."""

import numpy as np
from skimage.feature import peak_local_max

from gs_jax import Grid, Imager, backproject


def around_the_axis(image: np.ndarray, imager: Imager, depth: float) -> tuple[np.ndarray, Grid]:
    """Back-project around the point `(0, 0, depth)`, with voxels of 2 um laterally and 20 um axially."""
    grid = Grid(depth + np.arange(-0.8, 0.801, 0.02), (101, 101), 0.002)
    return np.asarray(backproject(image, imager, grid)), grid


def local_maxima(volume: np.ndarray, grid: Grid, **options) -> np.ndarray:
    """Peaks `(x, y, z, value)`, mm, by scikit-image's `peak_local_max` with these options."""
    voxels = peak_local_max(volume, exclude_border=False, **options)
    return np.column_stack([grid.to_mm(voxels), volume[tuple(voxels.T)]])


def through_peak(volume: np.ndarray, grid: Grid) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Coordinates (mm) and values along x, y and z through the brightest voxel, normalised to 1."""
    d, r, c = np.unravel_index(int(volume.argmax()), volume.shape)
    volume = volume / volume.max()
    x, y, z = (np.asarray(a, np.float64) for a in (grid.x, grid.y, grid.depths))
    return {"x": (x, volume[d, r, :]), "y": (y, volume[d, :, c]), "z": (z, volume[:, r, c])}


def fwhm(coordinate: np.ndarray, profile: np.ndarray) -> float:
    """Full width at half maximum, linear between samples; infinite if the profile does not fall to a half."""
    half, peak = profile.max() / 2, int(profile.argmax())
    width = 0.0
    for side in (slice(peak, None), slice(peak, None, -1)):
        values, places = profile[side], coordinate[side]
        below = np.flatnonzero(values < half)
        if not below.size:
            return float("inf")
        b = below[0]
        part = (values[b - 1] - half) / (values[b - 1] - values[b])
        width += abs(places[b - 1] + part * (places[b] - places[b - 1]) - places[0])
    return float(width)


def dip(coordinate: np.ndarray, profile: np.ndarray) -> float:
    """Lowest value between the maxima on both sides of the middle, relative to the lower maximum; 1 without a dip."""
    middle = (coordinate[0] + coordinate[-1]) / 2
    left = int(np.where(coordinate < middle, profile, -np.inf).argmax())
    right = int(np.where(coordinate >= middle, profile, -np.inf).argmax())
    return float(profile[left : right + 1].min() / min(profile[left], profile[right]))
