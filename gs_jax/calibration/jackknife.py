"""Standard errors of a calibration by leaving out blocks of neighbouring lenses.

The Gauss-Newton covariance takes residuals as independent. Those of neighbouring lenses are not where something smooth
is not modelled: a stretch, a distortion, uneven light within discs. Estimates without a block then differ by more.
"""

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float64, Int

from .spot_model import Observations, Unknowns, named_values, residual_jacobian, weighted_residuals

# Most blocks: few enough that a block is wider than what is alike in it, enough for a standard error to a fifth.
_BLOCKS = 16
# Reciprocal condition number below which spots without a block determine nothing.
_SINGULAR = 1e-12


def jackknife_errors(unknowns: Unknowns, data: Observations, lens_sd: float) -> dict[str, float]:
    """Standard errors by name, to first order in the change by each block; 0 of lenses and where a block is decisive.

    A lens that is left out itself says nothing of its own error.
    """
    args = data, jnp.asarray(lens_sd, data.positions.dtype)
    jacobian = np.asarray(residual_jacobian(unknowns, args), np.float64)
    off = np.asarray(weighted_residuals(unknowns, args)[0], np.float64)
    normal, count = jacobian.T @ jacobian, off.size
    lengths = np.sqrt(np.diag(normal))
    scale = np.where(lengths > 0, lengths, 1)
    rows = (jacobian[:count] / scale).reshape(*off.shape, -1)
    normal /= np.outer(scale, scale)
    valid = np.flatnonzero(data.valid)
    centers = np.asarray(data.imager.array.centers, np.float64)
    squares, blocks = np.zeros(len(scale)), _blocks(centers, np.asarray(data.lenses)[valid])
    for block in blocks:
        part, residual = rows[valid[block]].reshape(-1, len(scale)), off[valid[block]].ravel()
        others = normal - part.T @ part
        if np.linalg.cond(others) * _SINGULAR > 1:
            return {name: 0.0 for name in named_values(unknowns)}
        squares += np.linalg.solve(others, part.T @ residual) ** 2
    errors = np.sqrt(squares * (1 - 1 / len(blocks))) / scale
    flat, unravel = ravel_pytree(unknowns)
    return named_values(unravel(jnp.asarray(errors, flat.dtype)))


def _blocks(centers: Float64[np.ndarray, "lens 2"], lenses: Int[np.ndarray, " spot"]) -> list[np.ndarray]:
    """Spots of neighbouring lenses, by halving the lenses across their wider side."""
    blocks = [np.unique(lenses)]
    while len(blocks) < _BLOCKS and max(map(len, blocks)) > 1:
        halves = []
        for block in blocks:
            across = centers[block, np.ptp(centers[block], axis=0).argmax()]
            halves += np.array_split(block[np.argsort(across, kind="stable")], 2)
        blocks = [half for half in halves if len(half)]
    return [np.flatnonzero(np.isin(lenses, block)) for block in blocks]
