"""Reconstruction of images that follow each other, each from the volume of the last one on."""

from collections.abc import Callable

import jax
import numpy as np

from ..base.progress import Progress
from ..geometry import Imager
from ..grid import Grid
from ..solvers.richardson_lucy import RichardsonLucy, restarted
from ..typing import Image, Volume
from .methods import PinholeRichardsonLucy
from .pipeline import reconstructor

# Methods whose images may follow each other.
Followed = RichardsonLucy | PinholeRichardsonLucy
# What an image may leave unexplained, of what the last one that took all steps left, for its steps to end.
_ENOUGH = 1.02


def following_reconstructor(
    imager: Imager, grid: Grid, method: Followed, *, progress: Progress, **options
) -> Callable[[Image, Progress], Volume]:
    """Prepare `reconstruct` for the frames of a recording; parameters and errors as there.

    The first image takes all steps. Each of the others starts from the volume of the last one, and its steps end when
    they explain it as well as all steps explained an earlier one: after a quarter to a half of them, where little has
    moved, or all, where the scene is another.
    """
    read = lambda solver, state, cost: (np.asarray(solver.estimate(state), np.float32), state, cost)
    prepared = reconstructor(imager, grid, method, progress=progress, read=read, **options)
    restart, last, left = jax.jit(restarted), None, 0.0

    def volume_of(image, progress):
        nonlocal last, left
        # The divergence of counts is proportional to their sum.
        light = max(float(np.sum(image, dtype=float)), 1e-30)
        # No step lights a volume that is dark.
        start = restart(last) if last is not None and bool(last.x.any()) else None
        target = 0.0 if start is None else _ENOUGH * left * light
        volume, last, cost = prepared(image, progress, start=start, enough=target)
        if cost >= target:
            left = cost / light
        return volume

    return volume_of
