"""ADMM: least squares with total variation and sparsity, not negative, for any operator.

It minimises

    |A x - image|^2 / 2 + tv TV(x) + l1 sum(x)    over x >= 0

by the alternating direction method of multipliers (Boyd et al., Found. Trends Mach. Learn. 3, 1, 2011). `x` is split
from its differences `D x` and from its copy that is not negative; the x-step is a linear system, `A'A + rho (D'D + 1)`,
solved by a few conjugate gradients. Without total variation there is no split of the differences, which would only
hold the steps back. `convolution_admm` has the version for convolutions, by FFTs.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Num, PyTree

from ..base.arrays import divide
from ..typing import Real
from .base import (
    as_image,
    check_options,
    differences,
    differences_adjoint,
    least_weight_of_darkness,
    norm,
    shrink,
    total_variation,
)

# The penalty is doubled or halved where one residual is this many times the other (Boyd, section 3.4.1), and so often
# at most: a penalty that stays the same from some step on is what convergence is proven for.
_BALANCE, _FACTOR, _CHANGES = 10.0, 2.0, 50
# Over-relaxation (Boyd, section 3.4.3) with conjugate gradients. Measured on images of particles and of letters: with
# 1.8 the cost after as many steps is below that with 1, and about that with 1.6.
_RELAXATION = 1.8


class Prior(eqx.Module):
    """What is added to the squares; `wrap` takes the last and the first voxel of a line for neighbours."""

    tv: Float[Array, ""]
    l1: Float[Array, ""]
    isotropic: bool = eqx.field(static=True)
    wrap: bool = eqx.field(static=True)

    @classmethod
    def of(cls, solver: Any, back: Float[Array, "*shape"], *, wrap: bool) -> "Prior":
        """With the weights of a solver, which are in parts of the largest voxel of `back = A' image`."""
        unit = least_weight_of_darkness(back)
        tv, l1 = (jnp.asarray(weight, back.dtype) * unit for weight in (solver.tv, solver.sparsity))
        return cls(tv, l1, solver.isotropic, wrap)

    @property
    def varies(self) -> Float[Array, ""]:
        """1 with total variation, 0 without: the weight of the differences in the split."""
        return (self.tv > 0).astype(self.tv.dtype)

    def split(self, x):
        return self.varies * differences(x, wrap=self.wrap), x

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
    """Scaled ADMM's `x`, its split `z`, the multipliers `u`, the penalty `rho` and how often that may still change."""

    x: PyTree
    z: PyTree
    u: PyTree
    rho: Array
    changes: Array

    @classmethod
    def start(cls, x: PyTree, split: PyTree, rho: Array) -> "Splitting":
        """From `x = 0` and its split."""
        return cls(x, split, split, rho, jnp.array(_CHANGES))


class Point(NamedTuple):
    """A volume `x`, `A x` and `A'A x`: kept together, a step of conjugate gradients applies `A` and `A'` once."""

    x: Array
    image: Array
    back: Array

    @classmethod
    def of(cls, A: lx.AbstractLinearOperator, x: Array) -> "Point":
        image = A.mv(x)
        return cls(x, image, A.T.mv(image))


class State(NamedTuple):
    """Of `ADMM`: the splitting, what is known of the volume, and `A' image`."""

    splitting: Splitting
    prior: Prior
    back: Array


class ADMM(eqx.Module):
    """ADMM: least squares with total variation and sparsity, not negative, for any operator.

    *Differentiable.*

    The x-step is done by conjugate gradients that start from the last x; each applies the operator and its adjoint
    once, and nothing else does. The steps are over-relaxed, and the penalty adapts: it starts at the mean of the
    diagonal of `A'A` and is doubled or halved, a bounded number of times, where the primal residual is ten times the
    dual one or the reverse (Boyd, sections 3.4.1 and 3.4.3). The residual is the larger of the two, each relative
    (Boyd, section 3.3). The costs are of the unconstrained part of the split, which may be slightly negative before it
    has converged; the estimate is not.

    Parameters
    ----------
    steps, tolerance
        As for `Solver`.
    sparsity, tv
        Weights of the sum of `x` and of its total variation, both in parts of `max(A' image)`: the least weight of the
        sum that leaves nothing but darkness. At `tv=0` the derivative with respect to `tv` is 0.
    isotropic
        Total variation of vectors rather than of each axis.
    cg_steps
        Of each x-step. Three give the lowest cost for the same number of applications of the operator, or nearly so.

    Raises
    ------
    InputError
        If an option is negative, or a number of steps 0.

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> import numpy as np
    >>> scene = np.zeros(grid.volume_shape)
    >>> scene[1, 19:23, 22] = 1.0
    >>> image = gs.forward(scene, scope, grid)
    >>> found = gs.solve(gs.ImagingOperator(scope, grid), image, gs.ADMM(steps=5, tv=0.001))
    >>> print(bool(found.x.min() >= 0))
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

    def init(self, A: lx.AbstractLinearOperator, image: Num[Array | np.ndarray, "..."]) -> State:
        image = as_image(A, image)
        back = A.T.mv(image)
        prior = Prior.of(self, back, wrap=False)
        x = jnp.zeros_like(back)
        dark = Point(x, jnp.zeros_like(image), x)
        return State(Splitting.start(dark, prior.split(x), _mean_gain(A)), prior, back)

    def step(
        self, A: lx.AbstractLinearOperator, image: Num[Array | np.ndarray, "..."], state: State
    ) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        image = as_image(A, image)
        splitting, prior, back = state

        def update(point, target, rho):
            smooth = lambda x: rho * prior.adjoint(prior.split(x))
            point = _conjugate_gradients(A, smooth, back + rho * prior.adjoint(target), point, self.cg_steps)
            return point, prior.split(point.x)

        def cost(point, split):
            residual = point.image - image
            return jnp.vdot(residual, residual) / 2 + prior.cost(split)

        splitting, now, residual = advance(splitting, update, prior.prox, cost, _RELAXATION)
        return State(splitting, prior, back), now, residual

    def estimate(self, state: State) -> Float[Array, "..."]:
        return state.splitting.z[-1]


def advance(
    splitting: Splitting, update, prox, cost, relaxation: float = 1.0
) -> tuple[Splitting, Float[Array, ""], Float[Array, ""]]:
    """One step of scaled ADMM, its cost and its residual.

    Parameters
    ----------
    update
        From `x`, the target of its split and `rho` to the next `x` and its split.
    prox
        The proximal map of the split, with `rho`.
    cost
        Of `x` and its split.
    relaxation
        Between 1 and 2: more than 1 over-relaxes.
    """
    add = lambda a, b: jax.tree.map(jnp.add, a, b)
    subtract = lambda a, b: jax.tree.map(jnp.subtract, a, b)
    x, z, u, rho, changes = splitting
    x, split = update(x, subtract(z, u), rho)
    relaxed = jax.tree.map(lambda a, b: relaxation * a + (1 - relaxation) * b, split, z)
    new = prox(add(relaxed, u), rho)
    u = add(u, subtract(relaxed, new))
    # Before the adjoint of the split, not after as Boyd has it: where the image is split off too, the adjoint of
    # the multipliers is 0 at the solution, and nothing would be left to compare with.
    primal = divide(norm(subtract(split, new)), jnp.maximum(norm(split), norm(new)))
    dual = divide(norm(subtract(new, z)), jnp.maximum(norm(u), norm(new)))
    factor = jnp.where(primal > _BALANCE * dual, _FACTOR, jnp.where(dual > _BALANCE * primal, 1 / _FACTOR, 1))
    factor = jnp.where(changes > 0, factor, 1).astype(rho.dtype)
    changes = changes - (factor != 1).astype(changes.dtype)
    splitting = Splitting(x, new, jax.tree.map(lambda leaf: leaf / factor, u), rho * factor, changes)
    return splitting, cost(x, split), jnp.maximum(primal, dual)


def _conjugate_gradients(A, smooth, vector, point, steps):
    """So many steps toward the solution of `A'A x + smooth(x) = vector`, from a `Point`.

    Not `lineax.CG`: `linear_solve` is differentiated as the exact solution is, which so few steps do not reach. The
    derivative here is that of what was computed.
    """

    def step(state, _):
        point, residual, direction, square = state
        moved = Point.of(A, direction)
        product = moved.back + smooth(direction)
        length = divide(square, jnp.vdot(direction, product))
        point = jax.tree.map(lambda a, b: a + length * b, point, moved)
        residual = residual - length * product
        new = jnp.vdot(residual, residual)
        return (point, residual, residual + divide(new, square) * direction, new), None

    residual = vector - point.back - smooth(point.x)
    return lax.scan(step, (point, residual, residual, jnp.vdot(residual, residual)), length=steps)[0][0]


def _mean_gain(A):
    """The mean of `A'A`'s diagonal: a penalty of this size weighs the split like the image (Hutchinson's estimate).

    1 for an operator that is zero.
    """
    structure = A.in_structure()
    signs = jax.random.rademacher(jax.random.key(0), structure.shape, structure.dtype)
    image = A.mv(signs)
    return or_one(jnp.vdot(image, image) / signs.size)


def or_one(penalty):
    return jnp.where(penalty > 0, penalty, 1)
