"""Signals of regions of a recording over time: means above the background about each region, and dF/F. Host code."""

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.ndimage import binary_dilation, find_objects, gaussian_filter, percentile_filter
from scipy.spatial import KDTree
from skimage.feature import peak_local_max
from skimage.filters import threshold_li
from skimage.measure import label
from skimage.segmentation import relabel_sequential, watershed

from ..base.errors import InputError
from ..base.typing import Volume
from ..microscope.grid import Grid

Labels = Int[np.ndarray, "depth y x"]
Signals = Float[np.ndarray, "frame region"]
Means = Float64[np.ndarray, " region"]

# Standard deviation, in voxels of a plane, by which a volume is smoothed before it is segmented, the neighbourhood
# (z, y, x) of which a seed is the brightest voxel, and fewest voxels of a region.
_SMOOTHING, _NEIGHBOURHOOD, _LEAST = 1.0, (3, 5, 5), 4
_NO_REGION = "no region stands out of the volume; give --segment mean, --regions or --from-points"
# Voxels about a region that belong to neither it nor its background, fewest voxels of its background, and the largest
# distance of these.
_GAP, _BACKGROUND, _FARTHEST = 1, 60, 12
# Radius by which a voxel is within a region: the rounding of depths must not decide about a neighbouring plane.
_WITHIN = 1 + 1e-4


class SummaryVolumes:
    """Mean and standard deviation over time, of volumes that are added one by one (Welford's algorithm)."""

    def __init__(self, shape: tuple[int, ...]):
        self.count, self.mean, self._squares = 0, np.zeros(shape, np.float32), np.zeros(shape, np.float32)

    def add(self, volume: Volume) -> None:
        self.count += 1
        change = volume - self.mean
        self.mean += change / np.float32(self.count)
        self._squares += change * (volume - self.mean)

    @property
    def deviation(self) -> Volume:
        return np.sqrt(self._squares / np.float32(max(self.count, 1)))


def segment(volume: Volume) -> Labels:
    """Divide what is bright in a volume into regions, numbered from 1; 0 is outside.

    Voxels above the threshold of least cross-entropy (Li and Tam, Pattern Recognit. Lett. 19, 771, 1998) are divided by
    a watershed from the local maxima. Of a mean over time these are bright regions; of a standard deviation, those that
    change.

    Raises `InputError` if no region stands out.
    """
    smooth = gaussian_filter(volume, (0, _SMOOTHING, _SMOOTHING))
    if not np.ptp(smooth) > 0:
        raise InputError(f"{_NO_REGION}.")
    bright = smooth > threshold_li(smooth)
    seeds = np.zeros(volume.shape, np.int32)
    footprint = np.ones([min(side, n) for side, n in zip(_NEIGHBOURHOOD, volume.shape, strict=True)], bool)
    peaks = peak_local_max(smooth, footprint=footprint, labels=label(bright), exclude_border=False)
    seeds[tuple(peaks.T)] = np.arange(1, len(peaks) + 1)
    labels = watershed(-smooth, seeds, mask=bright)
    small = np.bincount(labels.ravel()) < _LEAST
    small[0] = True
    labels = relabel_sequential(np.where(small[labels], 0, labels))[0]
    if not labels.any():
        raise InputError(f"{_NO_REGION}.")
    return labels.astype(np.int32)


def regions_of_points(
    points: Float[np.ndarray, "point _"],
    grid: Grid,
    radius: tuple[float, float] | None = None,
    numbers: Int[np.ndarray, " point"] | None = None,
) -> Labels:
    """Give each point the voxels within a radius, lateral and axial, mm, that are nearer to it than to other points.

    The radius is 1.5 voxels and 1 plane unless it is given; of a point in a plane, both neighbouring planes count.
    Regions have the numbers of the points, from 1. The voxel that is nearest to a point is its own.

    Raises `InputError` if a point is outside the grid, or shares its voxel with another one; it names the point by its
    number in `numbers`, by default from 1.
    """
    names = np.arange(1, len(points) + 1) if numbers is None else numbers
    axes = z, y, x = [np.asarray(axis, np.float64) for axis in (grid.depths, grid.y, grid.x)]
    step = [np.ptp(axis) / max(len(axis) - 1, 1) or math.inf for axis in axes]
    lateral, axial = radius or (1.5 * grid.pitch, step[0] if len(z) > 1 else grid.pitch)
    scale = np.array([lateral, lateral, axial])
    scaled = points[:, :3] / scale
    tree, labels = KDTree(scaled), np.zeros(grid.volume_shape, np.int32)
    planes, rows, columns = (
        np.flatnonzero([np.abs(scaled[:, n] - at).min() <= _WITHIN for at in axis / scale[n]])
        for n, axis in zip((2, 1, 0), axes, strict=True)
    )
    # Plane by plane, as the places of all voxels may need more memory than the volume.
    for plane in planes:
        places = np.stack(np.meshgrid(x[columns], y[rows], z[plane]), -1)[:, :, 0] / scale
        nearest = tree.query(places, distance_upper_bound=_WITHIN)[1]
        labels[plane, rows[:, None], columns] = np.where(nearest < len(points), nearest + 1, 0)
    for number, point in enumerate(points, 1):
        index = tuple(int(np.abs(axis - at).argmin()) for axis, at in zip(axes, point[2::-1], strict=True))
        away = [abs(axis[i] - at) for axis, i, at in zip(axes, index, point[2::-1], strict=True)]
        if any(distance > side for distance, side in zip(away, step, strict=True)):
            place = np.round(point[:3], 4).tolist()
            raise InputError(f"point {names[number - 1]} must be within the volume, got {place} mm.")
        if tree.query(np.array([x[index[2]], y[index[1]], z[index[0]]]) / scale)[1] == number - 1:
            labels[index] = number
    missing = np.setdiff1d(np.arange(1, len(points) + 1), labels)
    if len(missing):
        name = names[missing[0] - 1]
        raise InputError(f"point {name} must have a voxel of its own, got one that is nearer to another point.")
    return labels


def _boxes(labels: Labels) -> Iterator[tuple[int, tuple[slice, ...]]]:
    """Number of each region and the box that it lies in; numbers may be large."""
    return zip(np.unique(labels[labels > 0]), find_objects(relabel_sequential(labels)[0]), strict=True)


class RegionSignals:
    """Mean of each region, and of the background about it, in volumes that are given one by one.

    The background is what lies beside a region in its own planes, two voxels or more from every region, up to twelve
    voxels away; where other regions leave no room, all that is outside of regions.

    Parameters
    ----------
    labels
        Numbers of regions, 0 outside.
    """

    def __init__(self, labels: Labels):
        self.numbers = np.unique(labels[labels > 0])
        self._inside = np.flatnonzero(labels)
        self._owner = np.searchsorted(self.numbers, labels.ravel()[self._inside])
        self.sizes = np.bincount(self._owner)
        free = ~np.asarray(binary_dilation(labels > 0, np.ones((1, 3, 3), bool), _GAP), bool)
        if not free.any():
            raise InputError("regions must leave voxels for the background, got regions that fill the volume.")
        self._around = [self._background(labels, number, box, free) for number, box in _boxes(labels)]

    @staticmethod
    def _background(labels: Labels, number: int, box, free: Bool[np.ndarray, "depth y x"]):
        """Flat indices of the voxels about a region."""
        wide = (slice(max(side.start - _FARTHEST, 0), side.stop + _FARTHEST) for side in box[1:])
        box = (box[0], *wide)
        near, allowed = binary_dilation(labels[box] == number, np.ones((1, 3, 3), bool), _GAP), free[box]
        for _ in range(_FARTHEST - _GAP):
            near = binary_dilation(near, np.ones((1, 3, 3), bool))
            if np.count_nonzero(near & allowed) >= _BACKGROUND:
                break
        around = near & allowed
        if not around.any():
            return np.flatnonzero(free)
        place = np.argwhere(around) + [side.start for side in box]
        return np.ravel_multi_index(tuple(place.T), free.shape)

    def __call__(self, volume: Volume) -> tuple[Means, Means]:
        """Return the means of the regions and those of their backgrounds."""
        values = volume.ravel()
        means = np.bincount(self._owner, values[self._inside], len(self.numbers)) / self.sizes
        return means, np.array([values[voxels].mean(dtype=np.float64) for voxels in self._around])

    def measure(self, volumes: Any, frames: Iterable[int]) -> Iterator[tuple[Means, Means]]:
        """Yield the same of frames of an array `(frame, depth, y, x)`, from which only planes in use are read."""
        used = np.concatenate([self._inside, *self._around]) // math.prod(volumes.shape[2:])
        planes, volume = slice(used.min(), used.max() + 1), np.zeros(volumes.shape[1:], np.float32)
        for frame in frames:
            volume[planes] = volumes[frame, planes]
            yield self(volume)


def relative_change(signals: Signals, percentile: float = 10.0, window: int | None = None) -> Signals:
    """Return (F - F0) / F0, where F0, the baseline, is a percentile over time; NaN where that is not above 0.

    Parameters
    ----------
    signals
        F of each region in each frame; NaN in frames without.
    percentile
        From 0 to 100.
    window
        Frames of the running window of the baseline, centred; where it ends, frames are mirrored. None: all frames.
    """
    signals = np.asarray(signals, np.float64)
    baseline = np.full(signals.shape, np.nan)
    for column, base in zip(signals.T, baseline.T, strict=True):
        known = np.isfinite(column)
        if window and known.any():
            base[known] = percentile_filter(column[known], percentile, size=min(window, known.sum()), mode="reflect")
        elif known.any():
            base[:] = np.percentile(column[known], percentile)
    return np.divide(signals - baseline, baseline, out=np.full(signals.shape, np.nan), where=baseline > 0)


def emitters_of_regions(
    labels: Labels, mean: Volume, backgrounds: Float[np.ndarray, " region"], grid: Grid
) -> list[Float64[np.ndarray, "emitter 4"]]:
    """Voxels of each region as points `(x, y, z, share)`: shares of the region's light above its background, sum 1.

    A region that is nowhere above its background shines evenly.
    """
    emitters = []
    for (number, box), background in zip(_boxes(labels), backgrounds, strict=True):
        voxels = np.argwhere(labels[box] == number) + [side.start for side in box]
        light = np.maximum(mean[tuple(voxels.T)].astype(np.float64) - background, 0)
        light = light if light.any() else np.ones(len(voxels))
        places = np.asarray(grid.to_mm(voxels), np.float64)
        emitters.append(np.column_stack([places, light / light.sum()])[light > 0])
    return emitters


def traces_table(
    numbers: Int[np.ndarray, " region"],
    frames: Int[np.ndarray, " frame"],
    places: Float[np.ndarray, "_ region 3"],
    signals: Mapping[str, Signals],
    interval: float | None = None,
) -> dict[str, np.ndarray]:
    """Columns of a table with a row for each region in each frame in which its signals are known.

    Parameters
    ----------
    numbers, frames
        Of the regions and frames.
    places
        `(x, y, z)` of the regions, mm: in each frame, or in one for all.
    signals
        By name.
    interval
        Seconds between frames, if they are known.
    """
    shape = len(frames), len(numbers)
    known = np.all([np.isfinite(values) for name, values in signals.items() if name != "dff"], axis=0)
    frame, region = (np.broadcast_to(part, shape)[known] for part in (frames[:, None], numbers))
    columns = {"region": region, "frame": frame} | ({"time_s": frame * interval} if interval else {})
    for axis, name in enumerate(("x_mm", "y_mm", "z_mm")):
        columns[name] = np.broadcast_to(places[..., axis], shape)[known]
    return columns | {name: np.asarray(values)[known] for name, values in signals.items()}
