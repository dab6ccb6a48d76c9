"""ADMM: least squares with total variation and an L1 penalty, by conjugate gradients for any operator, or by FFTs.

Both solvers minimise

    |A x - image|^2 / 2 + tv TV(x) + l1 sum|x|

by the scaled alternating direction method of multipliers (Boyd et al., Found. Trends Mach. Learn. 3, 1, 2011). The
split variables `K x` are the differences of `x` and a copy of it, and with FFTs the convolved scene, too. A step with
the penalty `rho` is

    x <- minimum of the squares about the target `z - u` of `K x`    by conjugate gradients, or exactly by FFTs
    s <- 1.8 K x + (1 - 1.8) z + u                                   over-relaxed (Boyd, section 3.4.3)
    z <- prox(s),  u <- s - z

States hold the sums `s` alone, from which the proximal map gives `z` and the multipliers `u`. Without total variation
the differences are not split, which would slow convergence.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Num

from ..base.arrays import divide, safe_sqrt
from ..base.errors import InputError
from ..base.typing import Image, Real
from ..linear.measured_psf import ConvolutionOperator
from .base import (
    Operator,
    as_image,
    check_options,
    differences,
    differences_adjoint,
    lambda_max,
    shrink,
    total_variation,
)

# The penalty changes by a factor where one residual is this many times the other (Boyd, section 3.4.1), and only so
# many times: convergence is proven for a penalty that is constant from some step on.
_BALANCE, _FACTOR, _MAX_CHANGES = 10.0, 2.0, 50
# With conjugate gradients, 1.8 gives a lower cost than 1 on images of particles and letters, about the same as 1.6.
_RELAXATION = 1.8
# Initial penalty of the convolved scene, relative to the image's weight. With 1 or 0.01 the cost falls more slowly, on
# both captures of DiffuserCam and on random ones.
_INITIAL_PENALTY = 0.1


class Weights(NamedTuple):
    """Absolute weights of total variation and of the L1 norm, and 1 if the differences are split, else 0."""

    tv: Array
    l1: Array
    splits: Array


class Penalty(NamedTuple):
    """`rho`, by which sums are scaled, the factor by which it changes before the next step, and the changes left."""

    rho: Array
    factor: Array
    changes: Array


def _weights(solver: Any, back: Float[Array, "*shape"]) -> Weights:
    """The weights of a solver, which are relative to `lambda_max(back)` of `back = A' image`."""
    unit = lambda_max(back)
    tv, l1 = (jnp.asarray(weight, back.dtype) * unit for weight in (solver.tv, solver.sparsity))
    return Weights(tv, l1, (tv > 0).astype(tv.dtype))


def _first_penalty(rho: Float[Array, ""]) -> Penalty:
    return Penalty(jnp.where(rho > 0, rho, 1), jnp.ones_like(rho), jnp.array(_MAX_CHANGES))


def _proximal_maps(weights: Weights, rho: Array, *, isotropic: bool, nonnegative: bool) -> tuple[Callable, Callable]:
    """Proximal maps of the differences and of the copy of `x`."""
    limit = weights.l1 / rho

    def sparse(w):
        return jnp.maximum(w - limit, 0) if nonnegative else w - jnp.clip(w, -limit, limit)

    return lambda u: shrink(u, weights.tv / rho, isotropic=isotropic), sparse


def _target(total: Array, prox: Callable, factor: Array) -> tuple[Array, Array]:
    """What a split variable is, and what the x-step aims at, after the penalty has changed by a factor."""
    z = prox(total)
    return z, z - (total - z) / factor


def _next_sum(split: Array, total: Array, prox: Callable, factor: Array) -> tuple[Array, Array]:
    """Next sum of a split variable, whose value by the x-step is `split`; and the variable before."""
    z = prox(total)
    return _RELAXATION * split + (1 - _RELAXATION) * z + (total - z) / factor, z


def _squares(split: Array, before: Array, total: Array, after: Array) -> Float[Array, "5"]:
    """Squares of a split variable's residuals and sizes, for `_balanced`."""
    parts = split - after, split, after, after - before, total - after
    return jnp.stack([jnp.vdot(part, part) for part in parts])


def _balanced(rho: Array, squares: Float[Array, "5"], changes: Array) -> tuple[Penalty, Float[Array, ""]]:
    """The penalty that balances primal and dual residual, and the larger of the two.

    These are residuals of the split itself, not of its adjoint as in Boyd: where the image is split too, the adjoint of
    the multipliers is 0 at the solution, and a relative residual would have no scale.
    """
    primal, split, after, dual, multiplier = safe_sqrt(squares)
    primal, dual = divide(primal, jnp.maximum(split, after)), divide(dual, jnp.maximum(multiplier, after))
    factor = jnp.where(primal > _BALANCE * dual, _FACTOR, jnp.where(dual > _BALANCE * primal, 1 / _FACTOR, 1))
    factor = jnp.where(changes > 0, factor, 1).astype(primal.dtype)
    return Penalty(rho, factor, changes - (factor != 1).astype(changes.dtype)), jnp.maximum(primal, dual)


class Iterate(NamedTuple):
    """A volume `x` with `A x` and `A'A x`, so that a step of conjugate gradients applies `A` and `A'` once."""

    x: Array
    image: Array
    back: Array


class State(NamedTuple):
    """State of `ADMM`: the iterate, the sums of the differences and of the copy of `x`, and `back = A' image`."""

    iterate: Iterate
    sums: tuple[Array, ...]
    penalty: Penalty
    weights: Weights
    back: Array


class ADMM(eqx.Module):
    """ADMM: non-negative least squares with total variation and an L1 penalty, for any operator.

    *Differentiable.*

    Conjugate gradients solve the x-step from the last `x`; each applies the operator and its adjoint once. The penalty
    starts at the mean diagonal entry of `A'A` and adapts to the primal and dual residuals (Boyd, section 3.4.1). The
    residual is the larger of these two, each relative. Costs are those of the unconstrained `x`, which may be slightly
    negative before convergence; the estimate is not.

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
        x = jnp.zeros_like(back)
        start = Iterate(x, jnp.zeros_like(image), x)
        return State(start, (differences(x), x), _first_penalty(_mean_gain(A)), _weights(self, back), back)

    def step(
        self, A: Operator, image: Num[Array | np.ndarray, "..."], state: State
    ) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        image = as_image(A, image)
        iterate, sums, penalty, weights, back = state
        factor, rho = penalty.factor, penalty.rho * penalty.factor
        before, after = self._prox(weights, penalty.rho), self._prox(weights, rho)
        (_, u), (_, w) = (_target(total, prox, factor) for total, prox in zip(sums, before, strict=True))

        def smooth(x):
            return rho * (differences_adjoint(weights.splits * differences(x)) + x)

        right_side = back + rho * (differences_adjoint(u) + w)
        iterate = _conjugate_gradients(A, smooth, right_side, iterate, self.cg_steps)
        split = weights.splits * differences(iterate.x), iterate.x
        pairs = [_next_sum(x, s, old, factor) for x, s, old in zip(split, sums, before, strict=True)]
        sums = tuple(total for total, _ in pairs)
        squares: Any = sum(_squares(x, z, s, new(s)) for x, (s, z), new in zip(split, pairs, after, strict=True))
        penalty, residual = _balanced(rho, squares, penalty.changes)
        misfit = iterate.image - image
        variation = total_variation(split[0], isotropic=self.isotropic)
        cost = jnp.vdot(misfit, misfit) / 2 + weights.tv * variation + weights.l1 * jnp.sum(jnp.abs(iterate.x))
        return State(iterate, sums, penalty, weights, back), cost, residual

    def estimate(self, state: State) -> Float[Array, "..."]:
        return self._prox(state.weights, state.penalty.rho)[1](state.sums[1])

    def smoother(self, state: State, factor: float) -> State:
        """The state to continue from with `factor` times the weight of total variation."""
        return state._replace(weights=state.weights._replace(tv=factor * state.weights.tv))

    def _prox(self, weights, rho):
        return _proximal_maps(weights, rho, isotropic=self.isotropic, nonnegative=True)


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
    """Mean diagonal entry of `A'A` by Hutchinson's estimate: a penalty of this size weighs the split like the image."""
    structure = A.in_structure()
    signs = jax.random.rademacher(jax.random.key(0), structure.shape, structure.dtype)
    image = A.mv(signs)
    return jnp.vdot(image, image) / signs.size


class Spectra(NamedTuple):
    """What `ConvolutionADMM` computes once.

    `gain` scales the convolved scene. `smooth` is the spectrum of `D'D + 1` within planes. `filters` are
    `(D'D + 1)^-1 psf*`, a plane each. `response` is the spectrum of `sum(psf filters)`, and `inverse` that of
    `1 / (gain^2 + response)`.
    """

    gain: Array
    smooth: Array
    filters: Array
    response: Array
    inverse: Array


class Sums(NamedTuple):
    """Sums of the convolved scene over the gain, and of the scene's differences and its copy, plane by plane."""

    image: Float[Array, "tall wide"]
    differences: Float[Array, "depth axis tall wide"]
    scene: Float[Array, "depth tall wide"]


class ConvolutionState(NamedTuple):
    """State of `ConvolutionADMM`.

    `target` is the spectrum of `(D'D + 1)^-1` of the differences and the scene that the next x-step aims at; `best` is
    the best estimate so far, and `cost` its cost.
    """

    spectra: Spectra
    weights: Weights
    sums: Sums
    penalty: Penalty
    target: Array
    best: Array
    cost: Array


def _as_weight(weight):
    return 0.0 if weight is None else weight


class ConvolutionADMM(eqx.Module):
    """ADMM for a `ConvolutionOperator`, with 3-D total variation and an L1 penalty.

    *Differentiable.*

    It minimises `|A x - image|^2 / 2 + tv TV(x) + l1 sum|x|`. The convolved scene is split, too, which separates the
    crop to the sensor from the convolution (Almeida and Figueiredo, IEEE Trans. Image Process. 22, 3074, 2013; Antipa
    et al., Optica 5, 1, 2018), so that FFTs solve the x-step exactly: for each frequency its matrix is one that is
    diagonal, plus one of rank one (Wohlberg, ICASSP 2014, 7173). Each plane takes three FFTs a step. Planes follow
    one another, so that little beside the state is of the size of the scene. Differences are periodic along rows and
    columns.

    The estimate is the best so far of the sparse split, each scaled to fit best, so costs never rise. It has
    `A.scene_shape`; `A.window` is the image's place in it.

    The convolved scene has its own penalty `rho / gain^2`, where `gain^2` is the geometric mean of the largest and the
    mean eigenvalue of `A'A` for the mean plane. For one split the best penalty is that of the extreme eigenvalues
    (Ghadimi et al., IEEE Trans. Autom. Control 60, 644, 2015), but the smallest of a diffuser is 0. With the mean,
    low spatial frequencies, up to 4e5 times as strong for 2 million pixels, outweigh the regularizer.

    Parameters
    ----------
    steps, tolerance, sparsity, tv, isotropic
        As for `ADMM`.
    tv_z
        Weight of differences between planes, relative to those within planes. 0: each plane for itself.
    nonnegative
        Whether the scene has no negative values.

    Raises
    ------
    InputError
        If an option is negative or `steps` is 0.

    Examples
    --------
    >>> stack = np.zeros((2, 20, 30))
    >>> stack[0, 10, 15] = stack[1, 10, 5] = stack[1, 10, 25] = 1.0
    >>> A = gs.ConvolutionOperator(stack)
    >>> scene = np.zeros(A.in_structure().shape)
    >>> scene[1, 18:22, 28] = 1.0
    >>> solution = gs.solve(A, A.mv(scene), gs.ConvolutionADMM(steps=30, tv=0.001))
    >>> print(np.unravel_index(solution.value.argmax(), scene.shape)[0])
    1
    """

    steps: int = eqx.field(static=True, default=20)
    tolerance: float = eqx.field(static=True, default=0.0)
    sparsity: Real | Float[Array, ""] = 0.01
    tv: Real | Float[Array, ""] = 0.0
    isotropic: bool = eqx.field(static=True, default=False)
    tv_z: Real | Float[Array, ""] = eqx.field(converter=_as_weight, default=1.0)
    nonnegative: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        check_options(self)

    def init(self, A: Any, image: Image) -> ConvolutionState:
        if not isinstance(A, ConvolutionOperator):
            raise InputError(f"ConvolutionADMM() must be used with a ConvolutionOperator, got {type(A).__name__}.")
        image = as_image(A, image)
        weights = _weights(self, A.T.mv(image))
        power = jnp.sum(A.spectra.real**2 + A.spectra.imag**2, axis=0)
        depths, *size = A.scene_shape
        gain = safe_sqrt(safe_sqrt(jnp.mean(power) * jnp.max(power)) / depths)
        smooth = 1 + weights.splits * _laplacian(size, power.dtype)
        filters = self._solve_along_z(weights, smooth, A.spectra.conj())
        response = jnp.sum(A.spectra.real * filters.real - A.spectra.imag * filters.imag, axis=0)
        inverse = divide(jnp.ones_like(response), gain**2 + response)
        x = jnp.zeros(A.scene_shape, image.dtype)
        sums = Sums(x[0], jnp.zeros((depths, 3, *size), image.dtype), x)
        penalty, target = _first_penalty(_INITIAL_PENALTY * gain**2), jnp.zeros_like(A.spectra)
        spectra = Spectra(gain, smooth, filters, response, inverse)
        return ConvolutionState(spectra, weights, sums, penalty, target, x, jnp.vdot(image, image) / 2)

    def step(
        self, A: Any, image: Image, state: ConvolutionState
    ) -> tuple[ConvolutionState, Float[Array, ""], Float[Array, ""]]:
        image = as_image(A, image)
        sums, penalty, residual = self._update_sums(A, image, state)
        target, best, cost = self._update_best(A, image, state._replace(sums=sums, penalty=penalty))
        return state._replace(sums=sums, penalty=penalty, target=target, best=best, cost=cost), state.cost, residual

    def estimate(self, state: ConvolutionState) -> Float[Array, "depth tall wide"]:
        return state.best

    def smoother(self, state: ConvolutionState, factor: float) -> ConvolutionState:
        """The state to continue from with `factor` times the weight of total variation."""
        weights = state.weights._replace(tv=factor * state.weights.tv)
        # Costs of another weight do not compare.
        return state._replace(weights=weights, cost=jnp.full_like(state.cost, jnp.finfo(state.cost.dtype).max))

    def _differences(self, x, following):
        """Differences of a plane, along the plane's axes and to the following plane."""
        return jnp.stack([_roll(x, -1, 0) - x, _roll(x, -1, 1) - x, jnp.asarray(self.tv_z, x.dtype) * (following - x)])

    def _prox(self, A, image, state, rho):
        """Proximal maps of the three splits, each of a plane."""
        window, gain = A.window, state.spectra.gain

        def measured(v):
            seen = (rho * v[window] + gain * image) / (rho + gain**2)
            return v.at[window].set(seen if A.kept is None else jnp.where(A.kept > 0, seen, v[window]))

        options = {"isotropic": self.isotropic, "nonnegative": self.nonnegative}
        return measured, *_proximal_maps(state.weights, rho, **options)

    def _update_sums(self, A, image, state):
        """Solve the x-step and add its scene to the multipliers."""
        (gain, _, filters, response, inverse), sums, factor = state.spectra, state.sums, state.penalty.factor
        rho, size = state.penalty.rho * factor, A.scene_shape[1:]
        before, after = self._prox(A, image, state, state.penalty.rho), self._prox(A, image, state, rho)
        # The x-step by Woodbury's identity: `target` plus what the convolved scene adds through the filters.
        aim = jnp.fft.rfft2(_target(sums.image, before[0], factor)[1])
        seen = jnp.sum(A.spectra * state.target, axis=0)
        light = _scale(inverse, _scale(gain, aim) - seen)
        convolved = jnp.fft.irfft2(seen + _scale(response, light), size)
        seen = divide(convolved, jnp.broadcast_to(gain, size))
        image_sum, v = _next_sum(seen, sums.image, before[0], factor)
        squares = _squares(seen, v, image_sum, after[0](image_sum))

        def plane(carry, planes):
            following, squares = carry
            spectrum, filter, differences, scene, is_last = planes
            x = jnp.fft.irfft2(spectrum + filter * light, size)
            split = state.weights.splits * self._differences(x, jnp.where(is_last, x, following))
            differences, _ = _next_sum(split, differences, before[1], factor)
            scene, w = _next_sum(x, scene, before[2], factor)
            return (x, squares + _squares(x, w, scene, after[2](scene))), (differences, scene)

        is_last = jnp.arange(len(filters)) == len(filters) - 1
        planes = state.target, filters, sums.differences, sums.scene, is_last
        # Residuals are those of the splits themselves but of the differences, which follow the scene.
        start = jnp.zeros(size, image.dtype), squares
        (_, squares), (differences, scene) = lax.scan(plane, start, planes, reverse=True)
        return Sums(image_sum, differences, scene), *_balanced(rho, squares, state.penalty.changes)

    def _update_best(self, A, image, state):
        """Solve for what the next x-step aims at, and keep the best of the sparse scenes."""
        weights, sums, factor = state.weights, state.sums, state.penalty.factor
        _, prox_differences, prox_scene = self._prox(A, image, state, state.penalty.rho)

        def variation(x, following):
            return total_variation(self._differences(x, following), isotropic=self.isotropic)

        def plane(carry, planes):
            last, last_z, seen, cost = carry
            psf, differences, scene, is_first = planes
            _, u = _target(differences, prox_differences, factor)
            x, w = _target(scene, prox_scene, factor)
            back = jnp.roll(u[0], 1, 0) - u[0] + jnp.roll(u[1], 1, 1) - u[1]
            back = back + jnp.asarray(self.tv_z, back.dtype) * (last_z - u[2])
            cost = cost + jnp.where(is_first, 0, weights.tv * variation(last, x)) + weights.l1 * jnp.sum(jnp.abs(x))
            spectrum = jnp.fft.rfft2(weights.splits * back + w)
            return (x, u[2], seen + psf * jnp.fft.rfft2(x), cost), spectrum

        dark = jnp.zeros_like(sums.image)
        is_first = jnp.arange(len(A.spectra)) == 0
        start = dark, dark, jnp.zeros_like(A.spectra[0]), jnp.zeros((), image.dtype)
        planes = A.spectra, sums.differences, sums.scene, is_first
        (last, _, seen, cost), target = lax.scan(plane, start, planes)
        cost = cost + weights.tv * variation(last, last)
        target = self._solve_along_z(weights, state.spectra.smooth, target)
        seen = jnp.fft.irfft2(seen, A.scene_shape[1:])[A.window]
        seen = seen if A.kept is None else A.kept * seen
        # The exact minimum along the ray of the sparse scene, as the penalties are homogeneous.
        scale = divide(jnp.maximum(jnp.vdot(seen, image) - cost, 0), jnp.vdot(seen, seen))
        residual = scale * seen - image
        cost = jnp.vdot(residual, residual) / 2 + scale * cost
        better = cost < state.cost
        best = jnp.where(better, scale * prox_scene(sums.scene), state.best)
        return target, best, jnp.where(better, cost, state.cost)

    def _solve_along_z(self, weights, smooth, spectra):
        """`(smooth + weight Dz'Dz)^-1 spectra`: cosines diagonalise differences that end at the outer planes."""
        count, weight = len(spectra), weights.splits * jnp.asarray(self.tv_z, smooth.dtype) ** 2
        modes = np.cos(np.pi * (np.arange(count) + 0.5) * np.arange(count)[:, None] / count)
        modes = jnp.asarray(modes / np.linalg.norm(modes, axis=1, keepdims=True), smooth.dtype)
        values = jnp.asarray(2 - 2 * np.cos(np.pi * np.arange(count) / count), smooth.dtype)
        stiffness = smooth[None] + weight * values[:, None, None]

        def solve(part):
            return jnp.einsum("ab,ayx->byx", modes, jnp.einsum("ab,byx->ayx", modes, part) / stiffness)

        return lax.complex(solve(spectra.real), solve(spectra.imag))


def _roll(x, shift, axis):
    """`jnp.roll` as a sum of two pads: XLA fuses pads with what follows, and takes half the time on a processor."""
    places = shift % x.shape[axis], shift % x.shape[axis] - x.shape[axis]
    pads = [[(by, -by, 0) if a == axis else (0, 0, 0) for a in range(x.ndim)] for by in places]
    return sum(lax.pad(x, jnp.zeros((), x.dtype), pad) for pad in pads)


def _scale(factor, spectrum):
    # Complex times real would convert the factor to a complex number.
    return lax.complex(factor * spectrum.real, factor * spectrum.imag)


def _laplacian(size, dtype):
    """Eigenvalues of `D'D` with periodic differences along rows and columns: `2 - 2 cos(2 pi k / n)` each."""
    rows, columns = (2 - 2 * np.cos(2 * np.pi * np.arange(n) / n) for n in size)
    return jnp.asarray(rows[:, None] + columns[: size[1] // 2 + 1], dtype)
