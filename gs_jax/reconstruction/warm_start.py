"""Reconstruction of images that follow each other, each from the volume of the last one on."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..base.progress import Progress
from ..solvers.richardson_lucy import State, restarted
from ..typing import Image, Volume
from .pipeline import Reconstructor

# What an image may leave unexplained, of what the last one that took all steps left, for its steps to end.
_ENOUGH = 1.02
# Relative change of the light with which an image starts afresh: it, or the one before, may be dark.
_CHANGED = 0.5


class LastVolume(NamedTuple):
    """State of the last image, its light, and what the last one that took all steps left of its light."""

    solver: State
    light: float
    unexplained: float


def follow_volume(
    reconstructor: Reconstructor, image: Image, last: LastVolume | None, progress: Progress
) -> tuple[Volume, LastVolume]:
    """Reconstruct an image by Richardson-Lucy from the volume of the last one; return what the next one starts from.

    The first image takes all steps. Each of the others starts from the volume of the last one, and its steps end when
    they explain it as well as all steps explained an earlier one. An image with much more or less light than the last
    one starts afresh.
    """
    light = float(np.sum(image, dtype=float))
    # No step lights a volume that is dark.
    follows = last is not None and abs(light - last.light) < _CHANGED * last.light and bool(last.solver.x.any())
    target = _ENOUGH * last.unexplained * light if last and follows else 0.0
    state = reconstructor.init(image, _restart(last.solver) if last and follows else None)
    state = reconstructor.run(state._replace(target=max(state.target, target)), progress)
    # The divergence of counts is proportional to their sum.
    unexplained = last.unexplained if last else 0.0
    if state.cost >= target:
        unexplained = state.cost / light if light > 0 else 0.0
    return np.asarray(reconstructor.finish(state), np.float32), LastVolume(state.solver, light, unexplained)


@jax.jit
def _restart(state):
    # A copy, as steps overwrite their state.
    return jax.tree.map(jnp.copy, restarted(state))
