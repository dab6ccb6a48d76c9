"""Terms compared with their targets: residuals for solvers, rows of a table for people."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from ..base.arrays import as_float
from ..base.errors import input_error
from ..geometry import Imager
from ..objectives.conditions import Conditions
from ..typing import Real
from .study import GOALS, TermTable
from .terms import TERMS, Term

# Exponent of the power mean that stands for the worst entry.
_POWER = 8
_LEAST_TOLERANCE = 1e-3
# Largest logarithm of a ratio: e^50 does not overflow in float32.
_LONGEST = 50.0

SIGNS = {"at_most": "<=", "at_least": ">=", "equal": "=", "minimise": "min", "maximise": "max"}


class Row(NamedTuple):
    """Lowest and highest entry of a term, and whether it meets its target (None without one)."""

    low: float
    high: float
    met: bool | None


def evaluate(term: Term, imager: Imager, at: Conditions, key: Key[Array, ""]) -> Float[Array, " entry"]:
    """Entries of a term, in its unit."""
    entries = _entries(term, imager, at, key)
    return jnp.exp(entries) if term.log else entries


class Objective(eqx.Module):
    """A term as a search sees it: its kind, `at_most` and so on, and its weight, a leaf."""

    term: Term = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    weight: Float[Array, ""] = eqx.field(converter=as_float)

    @classmethod
    def of_table(cls, table: TermTable) -> "Objective":
        return cls(TERMS[table.name], table.kind, table.weight)

    def residual(
        self, target: Float[Array, ""], imager: Imager, at: Conditions, key: Key[Array, ""], *, margin: Real
    ) -> Float[Array, " entry"]:
        """Residual of a term, relative to its target: zero where a limit holds, so that its square is smooth.

        `ln(1 + relu(x/t - (1 - margin)))` for at most, `relu(1 + margin - x/t)` for at least, `x/t - 1` for equal;
        times the weight over the root of the number of entries. For a term that is a logarithm `ln(x/t)` takes the
        place of `x/t - 1` in a limit. For a goal it is one entry, the mean of `(x/t)^8` (or `(t/x)^8`) to the power
        1/8.

        Parameters
        ----------
        target
            In the term's unit.
        margin
            Fraction by which a limit is tightened.
        """
        ratio = self._ratio(_entries(self.term, imager, at, key), target)
        missing = _missing(self.kind, ratio, jnp.asarray(margin, ratio.dtype))
        return missing * (self.weight.astype(ratio.dtype) / math.sqrt(missing.size))

    def _ratio(self, entries: Float[Array, " entry"], target: Float[Array, ""]) -> Float[Array, " entry"]:
        if not self.term.log:
            return entries / target
        logarithm = entries - jnp.log(target)
        # A goal needs a positive ratio.
        is_goal = self.kind in GOALS
        return jnp.exp(jnp.clip(logarithm, -_LONGEST, _LONGEST)) if is_goal else 1 + logarithm


def _missing(kind: str, ratio: Float[Array, " entry"], margin: Float[Array, ""]) -> Float[Array, " _"]:
    match kind:
        case "at_most":
            return jnp.log1p(jax.nn.relu(ratio - (1 - margin)))
        case "at_least":
            return jax.nn.relu(1 + margin - ratio)
        case "equal":
            return ratio - 1
        case "minimise":
            return _power_mean(ratio)
        case _:
            positive = ratio > 0
            return _power_mean(jnp.where(positive, 1 / jnp.where(positive, ratio, 1), 1e6))


def _power_mean(x: Float[Array, " entry"]) -> Float[Array, "1"]:
    """Power mean of non-negative numbers; zero, with zero slope, where all are zero."""
    largest = jax.lax.stop_gradient(jnp.max(x))
    largest = jnp.where(largest > 0, largest, 1)
    mean = jnp.mean((x / largest) ** _POWER)
    positive = mean > 0
    return jnp.where(positive, largest * jnp.where(positive, mean, 1) ** (1 / _POWER), 0)[None]


def _entries(term, imager, at, key):
    entries = jnp.ravel(term.function(imager, at, key) if term.random else term.function(imager, at))
    if not jnp.issubdtype(entries.dtype, jnp.floating):
        # They have no slope: a search would stay where it begins.
        raise input_error(f"a term ({term.meaning})", "of floating point", entries.dtype)
    return entries


def assess(table: TermTable, entries: Float[np.ndarray, " entry"]) -> Row:
    """Assess the entries of a term. An equality holds within 0.1 %."""
    low, high = float(np.min(entries)), float(np.max(entries))
    target = table.target
    off = max(abs(low - target), abs(high - target)) / target
    met = {"at_most": high <= target, "at_least": low >= target, "equal": off <= _LEAST_TOLERANCE}.get(table.kind)
    return Row(low, high, met)


def worst_entry(table: TermTable, entries: Float[Array, " entry"]) -> Float[Array, ""]:
    """The entry farthest from the target."""
    if table.kind == "equal":
        return entries[jnp.argmax(jnp.abs(entries - table.target))]
    return jnp.min(entries) if table.kind in ("at_least", "maximise") else jnp.max(entries)
