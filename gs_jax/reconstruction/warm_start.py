"""Reconstruction of images that follow each other, each from the volume of the last one on."""

from collections.abc import Callable

import jax
import numpy as np

from ..base.progress import Progress
from ..geometry import Imager
from ..grid import Grid
from ..solvers.richardson_lucy import restarted
from ..typing import Image, Volume
from .methods import Method
from .pipeline import reconstructor

# What an image may leave unexplained, of what the last one that took all steps left, for its steps to end.
_ENOUGH = 1.02
# Relative change of the light with which an image starts afresh: it, or the one before, may be dark.
_CHANGED = 0.5


def following_reconstructor(
    imager: Imager, grid: Grid, method: Method, *, progress: Progress, **options
) -> Callable[[Image, Progress], Volume]:
    """Prepare `reconstruct` for the frames of a recording; parameters and errors as there.

    The first image takes all steps of `method`, a Richardson-Lucy. Each of the others starts from the volume of the
    last one, and its steps end when they explain it as well as all steps explained an earlier one. An image with much
    more or less light than the last one starts afresh.
    """
    read = lambda solver, state, cost: (np.asarray(solver.estimate(state), np.float32), state, cost)
    prepared = reconstructor(imager, grid, method, progress=progress, read=read, **options)
    restart, last, light, left = jax.jit(restarted), None, 0.0, 0.0

    def volume_of(image, progress):
        nonlocal last, light, left
        before, light = light, float(np.sum(image, dtype=float))
        # No step lights a volume that is dark.
        follows = last is not None and abs(light - before) < _CHANGED * before and bool(last.x.any())
        # The divergence of counts is proportional to their sum.
        target = _ENOUGH * left * light if follows else 0.0
        volume, last, cost = prepared(image, progress, start=restart(last) if follows else None, enough=target)
        if cost >= target:
            left = cost / light if light > 0 else 0.0
        return volume

    return volume_of
