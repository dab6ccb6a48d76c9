"""ADMM: least squares with total variation and sparsity, not negative; for any operator, and fast for convolutions.

It minimises

    |A x - image|^2 / 2 + tv TV(x) + l1 |x|_1    over x >= 0

by the alternating direction method of multipliers (Boyd et al., Found. Trends Mach. Learn. 3, 1, 2011). `x` is split
from its differences `D x` and from its copy that is not negative; the x-step is a linear system, `A'A + rho (D'D + 1)`,
solved by a few conjugate gradients. For a convolution followed by cropping, the convolved scene is split off
too (Antipa et al., Optica 5, 1, 2018): then FFTs solve the x-step exactly.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Num

from ..base.safe import divide
from ..layouts.cells import Real
from .convolution import Convolution
from .iteration import Callback, Solution, as_image, iterate, norm
from .total_variation import differences, differences_adjoint, shrink, total_variation

# The penalty is doubled or halved where one residual is this many times the other (Boyd, section 3.4.1). Boyd's 10
# changes it more often; on a measured image both end at the same cost.
_BALANCE, _FACTOR = 100.0, 2.0
_CG_STEPS = 10


class Prior(NamedTuple):
    """What is added to the squares; `wrap` takes the last and the first voxel of a line for neighbours."""

    tv: Real | Float[Array, ""]
    l1: Real | Float[Array, ""]
    isotropic: bool
    wrap: bool

    def split(self, x):
        return differences(x, wrap=self.wrap), x

    def adjoint(self, split):
        u, w = split
        return differences_adjoint(u, wrap=self.wrap) + w

    def prox(self, split, rho):
        u, w = split
        return shrink(u, self.tv / rho, isotropic=self.isotropic), jnp.maximum(w - self.l1 / rho, 0)

    def cost(self, split):
        u, x = split
        return self.tv * total_variation(u, isotropic=self.isotropic) + self.l1 * jnp.sum(jnp.abs(x))


def admm(
    A: lx.AbstractLinearOperator,
    image: Num[Array | np.ndarray, "..."],
    *,
    steps: int,
    tolerance: float = 0.0,
    tv: Real | Float[Array, ""] = 0.0,
    l1: Real | Float[Array, ""] = 0.0,
    isotropic: bool = False,
    cg_steps: int = _CG_STEPS,
    callback: Callback | None = None,
) -> Solution:
    """ADMM for any operator; the x-step by conjugate gradients that start from the last x.

    Parameters
    ----------
    A
        From a volume to an image.
    image
        To be explained.
    steps, tolerance, callback
        As for `iterate`. The residual is the larger of the primal and the dual one, each relative (Boyd, section 3.3).
    tv, l1
        Weights of total variation and of the sum of `x`, in the image's unit.
    isotropic
        Total variation of vectors rather than of each axis.
    cg_steps
        Of each x-step.

    Returns
    -------
    Solution
        `x` is not negative. The costs are of the unconstrained part of the split, which may be slightly negative
        before it has converged.

    Raises
    ------
    ValueError
        If the image is not of the operator's output shape, or a number is out of range.
    """
    image = as_image(A, image)
    prior = _prior(tv, l1, isotropic, image.dtype, wrap=False)
    back = A.T.mv(image)

    def update(x, target, rho):
        normal = lambda x: A.T.mv(A.mv(x)) + rho * prior.adjoint(prior.split(x))
        x = _conjugate_gradients(normal, back + rho * prior.adjoint(target), x, cg_steps)
        return x, prior.split(x)

    def cost(x, split):
        residual = A.mv(x) - image
        return jnp.vdot(residual, residual) / 2 + prior.cost(split)

    structure = A.in_structure()
    zeros = jnp.zeros(structure.shape, structure.dtype)
    state = zeros, prior.split(zeros), prior.split(zeros), _mean_gain(A)
    (_, (_, w), _, _), *history = iterate(
        _step(update, prior.prox, cost), state, steps=steps, tolerance=tolerance, callback=callback
    )
    return Solution(w, *history)


def admm_convolution(
    system: Convolution,
    image: Num[Array | np.ndarray, "row column"],
    *,
    steps: int,
    tolerance: float = 0.0,
    tv: Real | Float[Array, ""] = 0.0,
    l1: Real | Float[Array, ""] = 0.0,
    isotropic: bool = False,
    callback: Callback | None = None,
) -> Solution:
    """ADMM for a convolution; the x-step by four FFTs, exactly. Parameters as for `admm`.

    Differences wrap round the edge of the scene, in depth too. The convolved scene has its own split, weighted so that
    it is as large as the scene. `x` is of `system.scene_shape`; `system.place` says where the image is in it.
    """
    image = as_image(system.operator, image)
    prior = _prior(tv, l1, isotropic, image.dtype, wrap=True)
    shape = system.scene_shape
    axes = (0, 1, 2) if shape[0] > 1 else (1, 2)
    transform = lambda x: jnp.fft.rfftn(x, axes=axes)
    inverse = lambda f: jnp.fft.irfftn(f, s=[shape[axis] for axis in axes], axes=axes)

    # The sum of 2-D convolutions is plane 0 of a 3-D convolution, with the depths of the PSF in reverse.
    backwards = jnp.roll(system.spectra[::-1], 1, axis=0)
    spectrum = jnp.fft.fft(backwards, axis=0) if shape[0] > 1 else backwards
    gain = jnp.sqrt(jnp.mean(jnp.abs(spectrum) ** 2))
    spectrum = _times(divide(jnp.ones_like(gain), gain), spectrum)
    curvature = _curvature(shape, axes, image.dtype)[..., : spectrum.shape[-1]]
    solvent = 1 / (jnp.abs(spectrum) ** 2 + curvature + 1)
    seen = (0, *system.place)

    def update(x, target, rho):
        v, *rest = target
        found = _times(solvent, spectrum.conj() * transform(v) + transform(prior.adjoint(rest)))
        x = inverse(found)
        return x, (inverse(spectrum * found), *prior.split(x))

    def prox(split, rho):
        v, *rest = split
        measured = (rho * v[seen] + gain * image) / (rho + gain**2)
        return v.at[seen].set(measured), *prior.prox(rest, rho)

    def cost(x, split):
        v, *rest = split
        residual = gain * v[seen] - image
        return jnp.vdot(residual, residual) / 2 + prior.cost(rest)

    zeros = jnp.zeros(shape, image.dtype)
    split = (zeros, *prior.split(zeros))
    (_, (_, _, w), _, _), *history = iterate(
        _step(update, prox, cost),
        (zeros, split, split, _or_one(gain**2)),
        steps=steps,
        tolerance=tolerance,
        callback=callback,
    )
    return Solution(w, *history)


def _prior(tv, l1, isotropic, dtype, *, wrap):
    return Prior(jnp.asarray(tv, dtype), jnp.asarray(l1, dtype), isotropic, wrap)


def _step(update, prox, cost):
    """One step of scaled ADMM for `x`, its split `z`, the multipliers `u` and the penalty `rho`."""
    add = lambda a, b: jax.tree.map(jnp.add, a, b)
    subtract = lambda a, b: jax.tree.map(jnp.subtract, a, b)

    def step(state):
        x, z, u, rho = state
        x, split = update(x, subtract(z, u), rho)
        new = prox(add(split, u), rho)
        gap = subtract(split, new)
        u = add(u, gap)
        # Before the adjoint of the split, not after as Boyd has it: where the image is split off too, the adjoint of
        # the multipliers is 0 at the solution, and nothing would be left to compare with.
        primal = divide(norm(gap), jnp.maximum(norm(split), norm(new)))
        dual = divide(norm(subtract(new, z)), jnp.maximum(norm(u), norm(new)))
        factor = jnp.where(primal > _BALANCE * dual, _FACTOR, jnp.where(dual > _BALANCE * primal, 1 / _FACTOR, 1))
        factor = factor.astype(rho.dtype)
        state = x, new, jax.tree.map(lambda leaf: leaf / factor, u), rho * factor
        return state, cost(x, split), jnp.maximum(primal, dual)

    return step


def _conjugate_gradients(normal, vector, x, steps):
    """So many steps toward the solution of `normal(x) = vector`.

    Not `lineax.CG`: `linear_solve` is differentiated as the exact solution is, which so few steps do not reach. The
    derivative here is that of what was computed.
    """

    def step(state, _):
        x, residual, direction, square = state
        product = normal(direction)
        length = divide(square, jnp.vdot(direction, product))
        x, residual = x + length * direction, residual - length * product
        new = jnp.vdot(residual, residual)
        return (x, residual, residual + divide(new, square) * direction, new), None

    residual = vector - normal(x)
    return lax.scan(step, (x, residual, residual, jnp.vdot(residual, residual)), length=steps)[0][0]


def _mean_gain(A):
    """The mean of `A'A`'s diagonal: a penalty of this size weighs the split like the image (Hutchinson's estimate).

    1 for an operator that is zero.
    """
    structure = A.in_structure()
    signs = jax.random.rademacher(jax.random.key(0), structure.shape, structure.dtype)
    image = A.mv(signs)
    return _or_one(jnp.vdot(image, image) / signs.size)


def _or_one(penalty):
    return jnp.where(penalty > 0, penalty, 1)


def _times(factor, spectrum):
    """A real factor times complex numbers, without making the factor complex."""
    return lax.complex(factor * spectrum.real, factor * spectrum.imag)


def _curvature(shape, axes, dtype):
    """Eigenvalues of `D'D` with differences that wrap: `2 - 2 cos(2 pi k / n)`, summed over the axes."""
    total = jnp.zeros((1, 1, 1), dtype)
    for axis in axes:
        angle = 2 * jnp.pi * jnp.arange(shape[axis], dtype=dtype) / shape[axis]
        total = total + (2 - 2 * jnp.cos(angle)).reshape([-1 if a == axis else 1 for a in range(3)])
    return total
