"""Points of successive frames as particles, by trackpy (J. C. Crocker and D. G. Grier, J. Colloid Interface Sci. 179,
298, 1996): the links of the least sum of squared distances."""

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from jaxtyping import Float

from ..base.errors import InputError

# Frames that a particle may be missing from, and be the same when it is back.
MISSING = 2


def linker() -> Callable[..., Iterator[tuple[int, list[int]]]]:
    """`trackpy.link_iter`, which then says nothing; `InputError` if trackpy is not installed."""
    try:
        import trackpy
    except ImportError as error:
        raise InputError("--track: found no trackpy, allowed: after pip install 'gs-jax[track]'.") from error
    trackpy.quiet()
    return trackpy.link_iter


def linked(frames: Iterable[Float[np.ndarray, "_ 3"]], farthest: float) -> Iterator[list[int]]:
    """The particle that each point is, frame by frame; particles are counted from 0, as they appear.

    Parameters
    ----------
    frames
        Places of the points, mm: of all frames in their order, those without points too. One is held at a time.
    farthest
        That a particle moves from a frame to the next, mm; less than how far particles are apart. One that was missing
        from `MISSING` frames at most is looked for as near to where it was.

    Raises
    ------
    InputError
        If trackpy is not installed, or too many particles are nearer to each other than `farthest`.
    """
    link = linker()
    from trackpy.linking import SubnetOversizeException

    frames = iter(frames)
    # None at all are too few for trackpy.
    try:
        for first in itertools.islice(frames, 1):
            for _, particles in link(itertools.chain([first], frames), farthest, memory=MISSING):
                yield particles
    except SubnetOversizeException as error:
        found = f"{farthest * 1000:g} um, within which more particles are than can be told apart"
        raise InputError(f"--track: found {found}, allowed: less.") from error


def tracked(frames: Iterable[tuple[int, dict[str, list]]], farthest: float) -> Iterator[tuple[int, dict[str, list]]]:
    """Frames, ascending, and the columns of their points, with the column `particle` after the first four.

    Frames that are left out have no points. `farthest` and errors as of `linked`.
    """
    read, names = deque(), ("x_mm", "y_mm", "z_mm")

    def places():
        number = 0
        for frame, columns in frames:
            for _ in range(number, frame):
                read.append(None)
                yield np.zeros((0, 3))
            read.append((frame, columns))
            yield np.array([columns[name] for name in names], float).T
            number = frame + 1

    for particles in linked(places(), farthest):
        if (found := read.popleft()) is not None:
            frame, columns = found
            first, rest = dict(list(columns.items())[:4]), dict(list(columns.items())[4:])
            yield frame, first | {"particle": particles} | rest
