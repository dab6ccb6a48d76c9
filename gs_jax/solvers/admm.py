"""ADMM: non-negative least squares with total variation and an L1 penalty, for any operator.

It minimises

    |A x - image|^2 / 2 + tv TV(x) + l1 sum(x)    over x >= 0

by the alternating direction method of multipliers (Boyd et al., Found. Trends Mach. Learn. 3, 1, 2011). The split
variables are the differences `D x` and a non-negative copy of `x`. The x-step is the linear system
`A'A + rho (D'D + 1)`, solved by a few conjugate gradients. Without total variation the differences are not split, which
would slow convergence.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Num, PyTree

from ..base.arrays import divide
from ..typing import Real
from .base import (
    Operator,
    as_image,
    check_options,
    differences,
    differences_adjoint,
    lambda_max,
    norm,
    shrink,
    total_variation,
)

# The penalty changes by a factor where one residual is this many times the other (Boyd, section 3.4.1), and only so
# many times: convergence is proven for a penalty that is constant from some step on.
_BALANCE, _FACTOR, MAX_CHANGES = 10.0, 2.0, 50
# Over-relaxation (Boyd, section 3.4.3) with conjugate gradients. On images of particles and of letters, 1.8 gives a
# lower cost than 1 after as many steps, and about the same as 1.6.
_RELAXATION = 1.8


class Regularizer(eqx.Module):
    """Total variation, L1 norm and non-negativity of the split variables; `wrap` makes differences periodic."""

    tv: Float[Array, ""]
    l1: Float[Array, ""]
    isotropic: bool = eqx.field(static=True)
    wrap: bool = eqx.field(static=True)

    @classmethod
    def of(cls, solver: Any, back: Float[Array, "*shape"], *, wrap: bool) -> "Regularizer":
        """The weights of a solver, which are relative to `lambda_max(back)` of `back = A' image`."""
        unit = lambda_max(back)
        tv, l1 = (jnp.asarray(weight, back.dtype) * unit for weight in (solver.tv, solver.sparsity))
        return cls(tv, l1, solver.isotropic, wrap)

    @property
    def splits_differences(self) -> Float[Array, ""]:
        """1 with total variation, 0 without: the weight of the differences in the split."""
        return (self.tv > 0).astype(self.tv.dtype)

    def split(self, x):
        return self.splits_differences * differences(x, wrap=self.wrap), x

    def adjoint(self, split):
        u, w = split
        return differences_adjoint(u, wrap=self.wrap) + w

    def prox(self, split, rho):
        u, w = split
        return shrink(u, self.tv / rho, isotropic=self.isotropic), jnp.maximum(w - self.l1 / rho, 0)

    def cost(self, split):
        u, x = split
        return self.tv * total_variation(u, isotropic=self.isotropic) + self.l1 * jnp.sum(jnp.abs(x))


class Splitting(NamedTuple):
    """Variables of scaled ADMM: `x`, its split `z`, the multipliers `u`, the penalty `rho`, and its changes left."""

    x: PyTree
    z: PyTree
    u: PyTree
    rho: Array
    changes: Array

    @classmethod
    def start(cls, x: PyTree, split: PyTree, rho: Array) -> "Splitting":
        """From `x = 0` and its split."""
        return cls(x, split, split, rho, jnp.array(MAX_CHANGES))


class Iterate(NamedTuple):
    """A volume `x` with `A x` and `A'A x`, so that a step of conjugate gradients applies `A` and `A'` once."""

    x: Array
    image: Array
    back: Array


class State(NamedTuple):
    """State of `ADMM`: the splitting, the regularizer, and `A' image`."""

    splitting: Splitting
    regularizer: Regularizer
    back: Array


class ADMM(eqx.Module):
    """ADMM: non-negative least squares with total variation and an L1 penalty, for any operator.

    *Differentiable.*

    Conjugate gradients solve the x-step from the last `x`; each applies the operator and its adjoint once. The steps
    are over-relaxed, and the penalty starts at the mean diagonal entry of `A'A` and adapts to the primal and dual
    residuals (Boyd, sections 3.4.1 and 3.4.3). The residual is the larger of these two, each relative (Boyd, section
    3.3). Costs are those of the unconstrained `x`, which may be slightly negative before convergence; the estimate is
    not.

    Parameters
    ----------
    steps, tolerance
        As for `Solver`.
    sparsity, tv
        Weights of the sum and of the total variation of `x`, relative to `max(A' image)`, the smallest L1 weight for
        which `x = 0` is optimal. At `tv=0` the derivative with respect to `tv` is 0.
    isotropic
        Total variation of gradient vectors rather than of each axis.
    cg_steps
        Conjugate gradients of each x-step. Three give about the lowest cost per application of the operator.

    Raises
    ------
    InputError
        If an option is negative or a number of steps is 0.

    Examples
    --------
    >>> scene = np.zeros(grid.volume_shape)
    >>> scene[1, 19:23, 22] = 1.0
    >>> image = gs.forward(scene, scope, grid)
    >>> solution = gs.solve(gs.ImagingOperator(scope, grid), image, gs.ADMM(steps=5, tv=0.001))
    >>> print(bool(solution.value.min() >= 0))
    True
    """

    steps: int = eqx.field(static=True, default=20)
    tolerance: float = eqx.field(static=True, default=0.0)
    sparsity: Real | Float[Array, ""] = 0.01
    tv: Real | Float[Array, ""] = 0.0
    isotropic: bool = eqx.field(static=True, default=False)
    cg_steps: int = eqx.field(static=True, default=3)

    def __check_init__(self):
        check_options(self)

    def init(self, A: Operator, image: Num[Array | np.ndarray, "..."]) -> State:
        image = as_image(A, image)
        back = A.T.mv(image)
        regularizer = Regularizer.of(self, back, wrap=False)
        x = jnp.zeros_like(back)
        start = Iterate(x, jnp.zeros_like(image), x)
        return State(Splitting.start(start, regularizer.split(x), _mean_gain(A)), regularizer, back)

    def step(
        self, A: Operator, image: Num[Array | np.ndarray, "..."], state: State
    ) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        image = as_image(A, image)
        splitting, regularizer, back = state

        def update(iterate, target, rho):
            smooth = lambda x: rho * regularizer.adjoint(regularizer.split(x))
            right_side = back + rho * regularizer.adjoint(target)
            iterate = _conjugate_gradients(A, smooth, right_side, iterate, self.cg_steps)
            return iterate, regularizer.split(iterate.x)

        def cost(iterate, split):
            residual = iterate.image - image
            return jnp.vdot(residual, residual) / 2 + regularizer.cost(split)

        splitting, now, residual = advance(splitting, update, regularizer.prox, cost, _RELAXATION)
        return State(splitting, regularizer, back), now, residual

    def estimate(self, state: State) -> Float[Array, "..."]:
        return state.splitting.z[-1]

    def smoother(self, state: State, factor: float) -> State:
        """The state to continue from with `factor` times the weight of total variation."""
        regularizer = dataclasses.replace(state.regularizer, tv=factor * state.regularizer.tv)
        return state._replace(regularizer=regularizer)


def advance(
    splitting: Splitting, update, prox, cost, relaxation: float = 1.0
) -> tuple[Splitting, Float[Array, ""], Float[Array, ""]]:
    """Take one step of scaled ADMM; return the splitting, the cost and the residual.

    Parameters
    ----------
    update
        Maps `x`, the target of its split, and `rho` to the next `x` and its split.
    prox
        Proximal map of the split, with `rho`.
    cost
        Cost of `x` and its split.
    relaxation
        Between 1 (none) and 2 (over-relaxation).
    """
    add = lambda a, b: jax.tree.map(jnp.add, a, b)
    subtract = lambda a, b: jax.tree.map(jnp.subtract, a, b)
    x, z, u, rho, changes = splitting
    x, split = update(x, subtract(z, u), rho)
    relaxed = jax.tree.map(lambda a, b: relaxation * a + (1 - relaxation) * b, split, z)
    new = prox(add(relaxed, u), rho)
    u = add(u, subtract(relaxed, new))
    # Residuals of the split itself, not of its adjoint as in Boyd: where the image is split too, the adjoint of the
    # multipliers is 0 at the solution, and a relative residual would have no scale.
    primal = divide(norm(subtract(split, new)), jnp.maximum(norm(split), norm(new)))
    dual = divide(norm(subtract(new, z)), jnp.maximum(norm(u), norm(new)))
    factor, changes = balance(primal, dual, changes)
    splitting = Splitting(x, new, jax.tree.map(lambda leaf: leaf / factor, u), rho * factor, changes)
    return splitting, cost(x, split), jnp.maximum(primal, dual)


def balance(primal, dual, changes):
    """Factor of the penalty that balances the residuals, and the changes that are left."""
    factor = jnp.where(primal > _BALANCE * dual, _FACTOR, jnp.where(dual > _BALANCE * primal, 1 / _FACTOR, 1))
    factor = jnp.where(changes > 0, factor, 1).astype(primal.dtype)
    return factor, changes - (factor != 1).astype(changes.dtype)


def _conjugate_gradients(A, smooth, right_side, iterate, steps):
    """Take `steps` conjugate gradients toward the solution of `A'A x + smooth(x) = right_side`.

    Not `lineax.CG`: `linear_solve` has the derivative of the exact solution, which so few steps do not reach. This has
    the derivative of what was computed.
    """

    def step(state, _):
        iterate, residual, direction, square = state
        image = A.mv(direction)
        change = Iterate(direction, image, A.T.mv(image))
        product = change.back + smooth(direction)
        length = divide(square, jnp.vdot(direction, product))
        iterate = jax.tree.map(lambda a, b: a + length * b, iterate, change)
        residual = residual - length * product
        new = jnp.vdot(residual, residual)
        return (iterate, residual, residual + divide(new, square) * direction, new), None

    residual = right_side - iterate.back - smooth(iterate.x)
    return lax.scan(step, (iterate, residual, residual, jnp.vdot(residual, residual)), length=steps)[0][0]


def _mean_gain(A):
    """Mean diagonal entry of `A'A` by Hutchinson's estimate, or 1 for a zero operator.

    A penalty of this size weighs the split like the image.
    """
    structure = A.in_structure()
    signs = jax.random.rademacher(jax.random.key(0), structure.shape, structure.dtype)
    image = A.mv(signs)
    return positive_or_one(jnp.vdot(image, image) / signs.size)


def positive_or_one(penalty):
    return jnp.where(penalty > 0, penalty, 1)
