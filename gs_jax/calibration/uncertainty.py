"""What a fit found, and how well: in the units of files, with standard deviations."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float64

from ..base.errors import InputError
from .sources import Spots
from .unknowns import NOISE, OUTLIER, Known, Unknowns, weighed

# The noise of a spot at least, pixels.
_LEAST = 0.01
# Singular values below this part of the first are none, and leave undetermined what is this part of their direction.
_SINGULAR, _PART = 1e-6, 1e-2
# Standard deviations beyond which a number is not known; lengths over `near_of`.
_UNKNOWN = {
    "sensor_distance_mm": 3.33,
    "rotation_deg": 1.0,
    "shift_x_mm": 3.33,
    "shift_y_mm": 3.33,
    "tilt_x_deg": 0.5,
    "tilt_y_deg": 0.5,
    "scale": 0.02,
    "depth_offset_mm": 8.33,
}
# What the leaves of `Unknowns` are called in files, and their unit there.
_CALLED = {
    "sensor_distance": ("sensor_distance_mm",),
    "rotation": ("rotation_deg",),
    "shift": ("shift_x_mm", "shift_y_mm"),
    "tilt": ("tilt_x_deg", "tilt_y_deg"),
    "scale": ("scale",),
    "depth_offset": ("depth_offset_mm",),
}


def values_of(state: Unknowns) -> dict[str, float]:
    """By name, in the units of the name."""
    values = {}
    for leaf, names in _CALLED.items():
        part = getattr(state, leaf)
        if part is not None:
            values |= dict(zip(names, np.ravel(_in_unit(leaf, np.asarray(part, np.float64))).tolist(), strict=True))
    return values


def _in_unit(leaf: str, part):
    """Radians and slopes to degrees."""
    return np.degrees(part) if leaf == "rotation" else np.degrees(np.arctan(part)) if leaf == "tilt" else part


def noise_of(off: Float64[np.ndarray, "spot 2"], state: Unknowns, spots: Spots) -> float:
    """Standard deviation of the spots' coordinates, pixels, from their residuals.

    Outliers are not the noise, and hardly count; the mean of the others and the median of all bound it from below.
    """
    far = np.linalg.norm(off, axis=-1)
    near = off[far < max(3 * np.median(far), OUTLIER)]
    spread = max(np.median(np.abs(off)) / 0.6745, np.sqrt((near**2).mean()))
    numbers = sum(leaf.size for leaf in jax.tree.leaves(state))
    if state.lenses is not None:
        numbers -= state.lenses.size - 2 * len(np.unique(spots.lenses))
    return max(spread * math.sqrt(off.size / max(off.size - numbers, 1)), _LEAST)


def deviations_of(state: Unknowns, known: Known, loose: float, noise: float) -> dict[str, float]:
    """From the Gauss-Newton covariance; infinite where nothing determines it."""
    # Lenses in their standard deviations against spots in the noise that they have.
    given = known, jnp.asarray(loose * NOISE / noise, known.places.dtype)
    jacobian = np.asarray(_jacobian(state, given), np.float64)
    lengths = np.linalg.norm(jacobian, axis=0)
    # Each number in steps that move spots equally, so that what is undetermined shows.
    _, values, directions = np.linalg.svd(jacobian / np.where(lengths > 0, lengths, 1), full_matrices=False)
    blind = values <= _SINGULAR * values[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        spreads = np.where(blind, np.inf, noise / values)[:, None]
        parts = np.where(np.abs(directions) > np.where(blind, _PART, 0)[:, None], np.abs(directions) * spreads, 0)
        each = np.where(lengths > 0, np.sqrt((parts**2).sum(0)) / lengths, np.inf)
    flat, back = ravel_pytree(state)
    deviations = back(jnp.asarray(each, flat.dtype))
    named = values_of(deviations)
    if deviations.lenses is not None:
        named["lenses_mm"] = float(np.median(deviations.lenses[np.unique(np.asarray(known.lenses)[known.are])]))
    return named


@jax.jit
def _jacobian(state, given):
    flat, back = ravel_pytree(state)
    return jax.jacfwd(lambda flat: ravel_pytree(weighed(back(flat), given))[0])(flat)


def check_known(deviations: dict[str, float], near: float) -> None:
    """`InputError` if a standard deviation is larger than anybody wants of an array with `near_of`, mm."""
    most = {name: limit * (near if name.endswith("_mm") else 1) for name, limit in _UNKNOWN.items()}
    unknown = {name: sd for name, sd in deviations.items() if sd > most.get(name, math.inf)}
    if unknown:
        found = ", ".join(f"{name} to {sd:.2g}" if sd < 100 else name for name, sd in unknown.items())
        allowed = "sources at more depths and places, or known ones, or hold some of these"
        raise InputError(f"captures: found spots that do not determine {found}, allowed: {allowed}.")
