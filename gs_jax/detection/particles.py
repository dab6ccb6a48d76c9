"""Particles: points in a volume by the paper's clustering, and their tracks from frame to frame. Host code.

trackpy links points by the least sum of squared displacements (Crocker and Grier, J. Colloid Interface Sci. 179, 298,
1996).
"""

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Array, Float, Float64, Int
from skimage.measure import label, regionprops

from ..base.errors import InputError, needs_extra
from ..base.typing import Number
from ..io.traces import TRACKS_HEADER
from ..microscope.grid import Grid

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


# Frames that a particle may be missing from and still keep its number, unless a caller says otherwise; trackpy's term.
MEMORY = 2

# Largest displacement between frames, mm: in all directions, or laterally and along z.
SearchRange = float | tuple[float, float]


def import_linker() -> Callable[..., Iterator[tuple[int, list[int]]]]:
    """Import `trackpy.link_iter` and silence its log; `InputError` if trackpy is not installed."""
    with needs_extra("track"):
        import trackpy
    trackpy.quiet()
    return trackpy.link_iter


def link_particles(
    frames: Iterable[Float[np.ndarray, "_ 3"]], search_range: SearchRange, memory: int = MEMORY
) -> Iterator[list[int]]:
    """Number the particle of each point, frame by frame; particles are counted from 0 in order of appearance.

    Parameters
    ----------
    frames
        Positions of the points of every frame in order, mm, also of frames without points. One frame is held at a time.
    search_range
        Largest displacement between frames, mm, smaller than the distance of particles. With two, displacements are
        measured in units of them: of points that are less certain along z, an axial displacement counts less.
    memory
        Particles that were missing from up to so many frames are searched for within the same distance.

    Raises
    ------
    InputError
        If trackpy is not installed, or too many particles are closer than `search_range`.
    """
    link = import_linker()
    from trackpy.linking import SubnetOversizeException

    frames = iter(frames)
    lateral, axial = search_range if isinstance(search_range, tuple) else (search_range, search_range)
    try:
        # trackpy fails on an empty sequence.
        for first in itertools.islice(frames, 1):
            for _, particles in link(itertools.chain([first], frames), (lateral, lateral, axial), memory=memory):
                yield particles
    except SubnetOversizeException as error:
        distance = f"{lateral * 1000:g} um" + (f" ({axial * 1000:g} um along z)" if axial != lateral else "")
        raise InputError(f"--track: too many particles are within {distance} to tell them apart; reduce it.") from error


def track(
    frames: Iterable[tuple[int, dict[str, list]]], search_range: SearchRange, memory: int = MEMORY
) -> Iterator[tuple[int, dict[str, list]]]:
    """Insert the column `particle` after the first four columns of each frame's points.

    Frames ascend; those left out have no points. `search_range`, `memory` and errors as in `link_particles`.
    """
    pending = deque()

    def positions():
        following = 0
        for frame, columns in frames:
            for _ in range(following, frame):
                pending.append(None)
                yield np.zeros((0, 3))
            pending.append((frame, columns))
            yield np.array([columns[name] for name in ("x_mm", "y_mm", "z_mm")], float).T
            following = frame + 1

    for particles in link_particles(positions(), search_range, memory):
        if (item := pending.popleft()) is not None:
            frame, columns = item
            names = list(columns)
            before, after = ({name: columns[name] for name in part} for part in (names[:4], names[4:]))
            yield frame, before | {"particle": particles} | after


def tracks_table(
    frames: Int[np.ndarray, " point"],
    particles: Int[np.ndarray, " point"],
    positions: Float[np.ndarray, "point 3"],
    interval: float | None = None,
) -> dict[str, np.ndarray]:
    """Duration, path and mean speed of each particle; columns by name, in the order of the particles.

    A path is the sum of the displacements between frames, in straight lines over frames from which the particle was
    missing. Errors of the points lengthen it, mostly along z, so the lateral path is a column of its own.

    Parameters
    ----------
    frames, particles, positions
        Of each point; mm.
    interval
        Seconds between frames. None: durations are in frames, and speeds in mm a frame.
    """
    order = np.lexsort((frames, particles))
    frames, particles, positions = frames[order], particles[order], positions[order]
    numbers, first, owner, counts = np.unique(particles, return_index=True, return_inverse=True, return_counts=True)
    last = first + counts - 1
    steps = np.diff(positions, axis=0)[np.diff(particles) == 0]
    # Of each step, the track that it belongs to.
    of_track = owner[1:][np.diff(particles) == 0]
    duration = (frames[last] - frames[first]) * (interval or 1.0)
    leading = numbers, counts, frames[first], frames[last]
    table: dict[str, np.ndarray] = dict(zip(TRACKS_HEADER.split(","), leading, strict=True))
    table["duration_s" if interval else "duration_frames"] = duration
    for name, axes in (("", 3), ("lateral_", 2)):
        path = np.bincount(of_track, np.linalg.norm(steps[:, :axes], axis=1), len(numbers))
        table[f"{name}path_mm"] = path
        speed = np.divide(path, duration, out=np.full(len(path), np.nan), where=duration > 0)
        table[f"{name}speed_mm_{'s' if interval else 'frame'}"] = speed
    return table | {"displacement_mm": np.linalg.norm(positions[last] - positions[first], axis=1)}
