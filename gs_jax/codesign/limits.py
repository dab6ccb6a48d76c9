"""Residuals of a study, and what each of its limits costs: derivatives of the optimum.

A search minimises half the sum of squared residuals, in which a limit that is missed by little is a hinge with a
weight. By the envelope theorem (Milgrom and Segal, Econometrica 70, 583, 2002) the least cost changes with a limit as
the cost does at fixed parameters: with the weight times what the limit is missed by, its Lagrange multiplier. By a
bound of a parameter it changes as by the parameter itself, which stays there.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from ..base.arrays import as_float
from ..microscope.geometry import Imager
from ..objectives.conditions import Conditions
from .parameters import Values, candidate
from .solve import Transforms, forward
from .study import Study, TermTable, only_goal
from .terms import Objective

# Draws of random terms that a derivative is the mean of.
_DRAWS = 8
# Relative change of the goal, by a relative change of a limit or by one of a bound in its range, below which the limit
# does not bind; distance from a bound within which a parameter is at it, in the range. `Sigmoid` reaches no bound.
_BINDS, _AT_BOUND = 1e-3, 0.01


class Residuals(eqx.Module):
    """Residuals of a study's terms as a function of a solver's variables; every number is a leaf.

    `values`: parameters, of which those that have no transform stay.
    """

    imager: Imager
    at: Conditions
    values: Values
    transforms: Transforms
    objectives: tuple[Objective, ...]
    margin: Float[Array, ""] = eqx.field(converter=as_float)

    def parameters(self, free: Values) -> Values:
        """All parameters, by the solver's variables."""
        return self.values | forward(self.transforms, free)

    def of_terms(self, values: Values, key: Key[Array, ""]) -> list[Float[Array, " entry"]]:
        """The residuals of each term at parameters."""
        new = candidate(self.imager, self.at, values)
        return [objective.residual(*new, key, margin=self.margin) for objective in self.objectives]

    def __call__(self, free: Values, key: Key[Array, ""]) -> Float[Array, " entry"]:
        return jnp.concatenate(self.of_terms(self.parameters(free), key))


class Limit(NamedTuple):
    """A limit of a study, and the derivative of the optimum by it, in the goal's unit per unit of the limit.

    `name`: of a term or of a free parameter. `kind`: at_most, at_least or equal. `slope`: 0 if the limit does not bind.
    """

    name: str
    kind: str
    value: float
    slope: float


@eqx.filter_jit
def _slopes(
    residuals: Residuals, values: Values, key: Key[Array, ""]
) -> tuple[Float[Array, " term"], tuple[list[Float[Array, ""]], Values]]:
    """Size of each residual, and derivatives of the cost by the terms' targets and by parameters with a transform."""

    def total(targets, free):
        own = eqx.tree_at(lambda r: [o.target for o in r.objectives], residuals, targets)
        squares = jnp.stack([jnp.sum(part**2) for part in own.of_terms(values | free, key)])
        return jnp.sum(squares) / 2, squares

    targets = [objective.target for objective in residuals.objectives]
    free = {name: values[name] for name in residuals.transforms}
    (_, squares), slopes = jax.value_and_grad(total, (0, 1), has_aux=True)(targets, free)
    return squares, slopes


def limits_of(
    residuals: Residuals, terms: Sequence[TermTable], study: Study, values: Values, key: Key[Array, ""]
) -> list[Limit]:
    """The limits of an optimum, and its derivative by each; none if not exactly one term is minimised or maximised.

    Parameters
    ----------
    residuals, terms
        Of the search: `terms` are those of its objectives.
    study
        Has the bounds of the parameters. Of these, only those that bind are in the result.
    values
        Parameters at the optimum.
    key
        For random terms: the derivative is the mean of eight draws.

    Returns
    -------
    list
        The derivative is that of the power mean that stands for the goal's worst entry.
    """
    own = only_goal(terms)
    if own is None:
        return []
    draws = _DRAWS if any(objective.term.random for objective in residuals.objectives) else 1
    samples = [_slopes(residuals, values, draw) for draw in jax.random.split(key, draws)]
    squares, (by_target, by_value) = jax.tree.map(lambda *x: np.mean([np.asarray(y, float) for y in x], 0), *samples)
    size = math.sqrt(squares[terms.index(own)])
    if not size > 0:
        return []
    # The goal's residual, over its weight, is the ratio of the goal to its unit or the other way round.
    downwards = own.kind == "maximise"
    goal = own.target * (own.weight / size if downwards else size / own.weight)
    # The cost's change is the square of that residual times the relative change of the goal.
    scale = (-goal if downwards else goal) / size**2

    def limit(name: str, kind: str, value: float, slope: float, size: float) -> Limit:
        slope = scale * slope
        return Limit(name, kind, value, slope if abs(slope * size) >= _BINDS * abs(goal) else 0.0)

    pairs = zip(terms, by_target, strict=True)
    limits = [limit(t.name, t.kind, t.target, float(x), t.target) for t, x in pairs if not t.is_goal]
    at_bounds = (
        limit(name, kind, bound, float(np.sum(slope, where=np.abs(values[name] - bound) <= _AT_BOUND * size)), size)
        for name, slope in by_value.items()
        for low, high in [study.free[name]]
        for size in [high - low]
        for kind, bound in (("at_least", low), ("at_most", high))
    )
    return limits + _outward(at_bounds, own.kind)


def _outward(limits: Iterable[Limit], goal: str) -> list[Limit]:
    """Bounds that bind and that the goal would be better beyond."""
    better = 1 if goal == "maximise" else -1
    return [x for x in limits if x.slope * better * (1 if x.kind == "at_most" else -1) > 0]
