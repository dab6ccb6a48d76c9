"""Links the points of successive frames to particles, with trackpy. Host code.

trackpy minimises the sum of squared displacements (Crocker and Grier, J. Colloid Interface Sci. 179, 298, 1996).
"""

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from jaxtyping import Float

from ..base.errors import InputError, needs_extra

# Frames that a particle may be missing from and still keep its number; trackpy's term.
MEMORY = 2


def import_linker() -> Callable[..., Iterator[tuple[int, list[int]]]]:
    """Import `trackpy.link_iter` and silence its log; `InputError` if trackpy is not installed."""
    with needs_extra("track"):
        import trackpy
    trackpy.quiet()
    return trackpy.link_iter


def link_particles(frames: Iterable[Float[np.ndarray, "_ 3"]], search_range: float) -> Iterator[list[int]]:
    """Number the particle of each point, frame by frame; particles are counted from 0 in order of appearance.

    Parameters
    ----------
    frames
        Positions of the points of every frame in order, mm, also of frames without points. One frame is held at a time.
    search_range
        Largest displacement between frames, mm, smaller than the distance of particles. Particles that were missing
        from up to `MEMORY` frames are searched for within the same distance.

    Raises
    ------
    InputError
        If trackpy is not installed, or too many particles are closer than `search_range`.
    """
    link = import_linker()
    from trackpy.linking import SubnetOversizeException

    frames = iter(frames)
    try:
        # trackpy fails on an empty sequence.
        for first in itertools.islice(frames, 1):
            for _, particles in link(itertools.chain([first], frames), search_range, memory=MEMORY):
                yield particles
    except SubnetOversizeException as error:
        distance = f"{search_range * 1000:g} um"
        raise InputError(f"--track: too many particles are within {distance} to tell them apart; reduce it.") from error


def track(frames: Iterable[tuple[int, dict[str, list]]], search_range: float) -> Iterator[tuple[int, dict[str, list]]]:
    """Insert the column `particle` after the first four columns of each frame's points.

    Frames ascend; those left out have no points. `search_range` and errors as in `link_particles`.
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

    for particles in link_particles(positions(), search_range):
        if (item := pending.popleft()) is not None:
            frame, columns = item
            names = list(columns)
            before, after = ({name: columns[name] for name in part} for part in (names[:4], names[4:]))
            yield frame, before | {"particle": particles} | after
