"""ADMM for measured stacks of PSFs, with an exact x-step by FFTs, plane by plane."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..base.arrays import divide, safe_sqrt
from ..base.errors import InputError
from ..projection.measured_psf import ConvolutionOperator
from ..typing import Image, Real
from .admm import MAX_CHANGES, balance, positive_or_one
from .base import as_image, check_options, lambda_max, none_if_zero, shrink, total_variation

# Initial penalty of the convolved scene, relative to the image's weight. With 1 or 0.01 the cost falls more slowly, on
# both captures of DiffuserCam and on random ones.
_INITIAL_PENALTY = 0.1
# Over-relaxation (Boyd, section 3.4.3).
_RELAXATION = 1.8


class System(NamedTuple):
    """What does not change from step to step.

    `tv` and `l1` are absolute weights, `splits` is 1 with total variation and 0 without. `smooth` is the spectrum of
    `D'D + 1` within planes. `filters` are `(D'D + 1)^-1 psf*`, a plane each; None without differences along z, where
    they are `psf.conj() / smooth`. `response` is the spectrum of `sum(psf filters)`, and `inverse` that of
    `1 / (gain^2 + response)`.
    """

    tv: Array
    l1: Array
    splits: Array
    gain: Array
    smooth: Array
    filters: Array | None
    response: Array
    inverse: Array


class Sums(NamedTuple):
    """Each split variable plus its scaled multiplier; the proximal map tells them apart.

    `image` is the convolved scene over the gain; `differences` and `scene` are those of the scene, plane by plane.
    """

    image: Float[Array, "tall wide"]
    differences: Float[Array, "depth axis tall wide"]
    scene: Float[Array, "depth tall wide"]


class Penalty(NamedTuple):
    """`rho`, by which sums are scaled, the factor by which it changes before the next step, and the changes left."""

    rho: Array
    factor: Array
    changes: Array


class State(NamedTuple):
    """State of `ConvolutionADMM`.

    `spectra` are `(D'D + 1)^-1` of the differences and the scene that the next x-step aims at; `best` is the best
    estimate so far, and `cost` its cost.
    """

    system: System
    sums: Sums
    spectra: Array
    penalty: Penalty
    best: Array
    cost: Array


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
    mean eigenvalue of `A'A` for the mean plane. For one split the best penalty is the geometric mean of the extreme
    eigenvalues (Ghadimi et al., IEEE Trans. Autom. Control 60, 644, 2015); the smallest of a diffuser is 0, hence the
    mean. With the mean alone, low spatial frequencies, up to `max / mean` times as strong (4e5 for 2 million pixels),
    outweigh the regularizer, which then acts slowly.

    Parameters
    ----------
    steps, tolerance, sparsity, tv, isotropic
        As for `ADMM`.
    tv_z
        Weight of differences between planes, relative to those within planes. 0, kept as None: each plane for itself.
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
    tv_z: Real | Float[Array, ""] | None = eqx.field(converter=none_if_zero, default=1.0)
    nonnegative: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        check_options(self)

    def init(self, A: ConvolutionOperator, image: Image) -> State:
        if not isinstance(A, ConvolutionOperator):
            raise InputError(f"ConvolutionADMM() must be used with a ConvolutionOperator, got {type(A).__name__}.")
        image = as_image(A, image)
        unit = lambda_max(A.T.mv(image))
        tv, l1 = (jnp.asarray(weight, image.dtype) * unit for weight in (self.tv, self.sparsity))
        splits = (tv > 0).astype(tv.dtype)
        power = jnp.sum(A.spectra.real**2 + A.spectra.imag**2, axis=0)
        depths, *size = A.scene_shape
        gain = safe_sqrt(safe_sqrt(jnp.mean(power) * jnp.max(power)) / depths)
        smooth = 1 + splits * _laplacian(size, power.dtype)
        filters = None
        if self._axes(A) == 3:
            filters = _solve_along_z(smooth, A.spectra.conj(), splits * self._z(splits) ** 2)
        response = power / smooth if filters is None else jnp.sum(_real_of_product(A.spectra, filters), axis=0)
        x = jnp.zeros(A.scene_shape, image.dtype)
        sums = Sums(x[0], jnp.zeros((depths, self._axes(A), *size), image.dtype), x)
        penalty = Penalty(positive_or_one(_INITIAL_PENALTY * gain**2), jnp.ones_like(gain), jnp.array(MAX_CHANGES))
        inverse = divide(jnp.ones_like(response), gain**2 + response)
        system = System(tv, l1, splits, gain, smooth, filters, response, inverse)
        return State(system, sums, jnp.zeros_like(A.spectra), penalty, x, jnp.vdot(image, image) / 2)

    def step(
        self, A: ConvolutionOperator, image: Image, state: State
    ) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        image = as_image(A, image)
        sums, penalty, residual = self._update_sums(A, image, state)
        spectra, best, cost = self._update_best(A, image, state._replace(sums=sums, penalty=penalty))
        return State(state.system, sums, spectra, penalty, best, cost), state.cost, residual

    def estimate(self, state: State) -> Float[Array, "depth tall wide"]:
        return state.best

    def smoother(self, state: State, factor: float) -> State:
        """The state to continue from with `factor` times the weight of total variation."""
        system = state.system._replace(tv=factor * state.system.tv)
        # Costs of another weight do not compare.
        return state._replace(system=system, cost=jnp.full_like(state.cost, jnp.finfo(state.cost.dtype).max))

    def _axes(self, A):
        """Number of axes along which there are differences."""
        return 3 if self.tv_z is not None and A.scene_shape[0] > 1 else 2

    def _z(self, like):
        return jnp.asarray(self.tv_z, like.dtype)

    def _differences(self, x, following):
        """Differences of a plane, along the plane's axes and to the following plane."""
        return jnp.stack(
            [_roll(x, -1, 0) - x, _roll(x, -1, 1) - x] + ([] if following is None else [self._z(x) * (following - x)])
        )

    def _prox(self, A, image, system, rho):
        """Proximal maps of the three splits, each of a plane."""
        window, gain = A.window, system.gain

        def measured(v):
            seen = (rho * v[window] + gain * image) / (rho + gain**2)
            return v.at[window].set(seen if A.kept is None else jnp.where(A.kept > 0, seen, v[window]))

        def sparse(w):
            if self.nonnegative:
                return jnp.maximum(w - system.l1 / rho, 0)
            return w - jnp.clip(w, -system.l1 / rho, system.l1 / rho)

        return measured, lambda u: shrink(u, system.tv / rho, isotropic=self.isotropic), sparse

    def _update_sums(self, A, image, state):
        """Solve the x-step and add its scene to the multipliers."""
        system, sums, spectra, penalty = state.system, state.sums, state.spectra, state.penalty
        gain, response, factor, size = system.gain, system.response, penalty.factor, A.scene_shape[1:]
        rho = penalty.rho * factor
        before, after = self._prox(A, image, system, penalty.rho), self._prox(A, image, system, rho)

        def update(x, total, old):
            """Next sum of a split `x`, and the split variable before."""
            z = old(total)
            multiplier = (total - z) / factor
            return _RELAXATION * x + (1 - _RELAXATION) * z + multiplier, z

        def squares_of(x, z, total, changed):
            """Squares of the residuals of a split, and of its sizes."""
            parts = x - changed, x, changed, changed - z, total - changed
            return jnp.stack([jnp.vdot(part, part) for part in parts])

        # The x-step by Woodbury's identity: `spectra` plus what the convolved scene adds through the filters.
        v = before[0](sums.image)
        target = jnp.fft.rfft2(v - (sums.image - v) / factor)
        seen = jnp.sum(A.spectra * spectra, axis=0)
        light = _scale(system.inverse, _scale(gain, target) - seen)
        convolved = jnp.fft.irfft2(seen + _scale(response, light), size)
        seen = divide(convolved, jnp.broadcast_to(gain, size))
        image_sum, v = update(seen, sums.image, before[0])
        squares = squares_of(seen, v, image_sum, after[0](image_sum))
        if system.filters is None:
            light = _scale(1 / system.smooth, light)

        def plane(carry, planes):
            following, squares = carry
            spectrum, filter, differences, scene, is_last = planes
            x = jnp.fft.irfft2(spectrum + (filter.conj() if system.filters is None else filter) * light, size)
            toward = None if following is None else jnp.where(is_last, x, following)
            split = system.splits * self._differences(x, toward)
            differences, _ = update(split, differences, before[1])
            scene, w = update(x, scene, before[2])
            carry = None if following is None else x, squares + squares_of(x, w, scene, after[2](scene))
            return carry, (differences, scene)

        filters = A.spectra if system.filters is None else system.filters
        is_last = jnp.arange(len(filters)) == len(filters) - 1
        start = (None if self._axes(A) == 2 else jnp.zeros(size, image.dtype)), squares
        planes = spectra, filters, sums.differences, sums.scene, is_last
        (_, squares), (differences, scene) = lax.scan(plane, start, planes, reverse=True)
        primal, split, changed, dual, multiplier = safe_sqrt(squares)
        # Residuals of the splits themselves, as for `ADMM`, but of the differences, which follow the scene.
        primal, dual = divide(primal, jnp.maximum(split, changed)), divide(dual, jnp.maximum(multiplier, changed))
        factor, changes = balance(primal, dual, penalty.changes)
        return Sums(image_sum, differences, scene), Penalty(rho, factor, changes), jnp.maximum(primal, dual)

    def _update_best(self, A, image, state):
        """Solve for what the next x-step aims at, and keep the best of the sparse scenes."""
        system, sums, penalty = state.system, state.sums, state.penalty
        _, prox_differences, prox_scene = self._prox(A, image, system, penalty.rho)
        along_z = self._axes(A) == 3

        def target(total, prox):
            z = prox(total)
            return z, z - (total - z) / penalty.factor

        def variation(x, following):
            split = self._differences(x, following if along_z else None)
            return total_variation(split, isotropic=self.isotropic)

        def plane(carry, planes):
            last, last_z, seen, cost = carry
            psf, differences, scene, is_first = planes
            _, u = target(differences, prox_differences)
            x, w = target(scene, prox_scene)
            back = jnp.roll(u[0], 1, 0) - u[0] + jnp.roll(u[1], 1, 1) - u[1]
            if along_z:
                back = back + self._z(back) * (last_z - u[2])
            cost = cost + jnp.where(is_first, 0, system.tv * variation(last, x)) + system.l1 * jnp.sum(jnp.abs(x))
            spectrum = jnp.fft.rfft2(system.splits * back + w)
            spectrum = spectrum if along_z else _scale(1 / system.smooth, spectrum)
            return (x, u[-1] if along_z else last_z, seen + psf * jnp.fft.rfft2(x), cost), spectrum

        dark = jnp.zeros_like(sums.image)
        is_first = jnp.arange(len(A.spectra)) == 0
        start = dark, dark, jnp.zeros_like(A.spectra[0]), jnp.zeros((), image.dtype)
        planes = A.spectra, sums.differences, sums.scene, is_first
        (last, _, seen, cost), spectra = lax.scan(plane, start, planes)
        cost = cost + system.tv * variation(last, last)
        if along_z:
            spectra = _solve_along_z(system.smooth, spectra, system.splits * self._z(system.splits) ** 2)
        seen = jnp.fft.irfft2(seen, A.scene_shape[1:])[A.window]
        seen = seen if A.kept is None else A.kept * seen
        # The exact minimum along the ray of the sparse scene, as the penalties are homogeneous.
        scale = divide(jnp.maximum(jnp.vdot(seen, image) - cost, 0), jnp.vdot(seen, seen))
        residual = scale * seen - image
        cost = jnp.vdot(residual, residual) / 2 + scale * cost
        better = cost < state.cost
        best = jnp.where(better, scale * prox_scene(sums.scene), state.best)
        return spectra, best, jnp.where(better, cost, state.cost)


def _roll(x, shift, axis):
    """`jnp.roll` as a sum of two pads: XLA fuses pads with what follows, and takes half the time on a processor."""
    places = shift % x.shape[axis], shift % x.shape[axis] - x.shape[axis]
    pads = [[(by, -by, 0) if a == axis else (0, 0, 0) for a in range(x.ndim)] for by in places]
    return sum(lax.pad(x, jnp.zeros((), x.dtype), pad) for pad in pads)


def _scale(factor, spectrum):
    # Complex times real would convert the factor to a complex number.
    return lax.complex(factor * spectrum.real, factor * spectrum.imag)


def _real_of_product(a, b):
    return a.real * b.real - a.imag * b.imag


def _laplacian(size, dtype):
    """Eigenvalues of `D'D` with periodic differences along rows and columns: `2 - 2 cos(2 pi k / n)` each."""
    rows, columns = (2 - 2 * np.cos(2 * np.pi * np.arange(n) / n) for n in size)
    return jnp.asarray(rows[:, None] + columns[: size[1] // 2 + 1], dtype)


def _solve_along_z(smooth, spectra, weight):
    """`(smooth + weight Dz'Dz)^-1 spectra`: cosines diagonalise differences that end at the first and last plane."""
    count = len(spectra)
    modes = np.cos(np.pi * (np.arange(count) + 0.5) * np.arange(count)[:, None] / count)
    modes = jnp.asarray(modes / np.linalg.norm(modes, axis=1, keepdims=True), smooth.dtype)
    values = jnp.asarray(2 - 2 * np.cos(np.pi * np.arange(count) / count), smooth.dtype)
    mix = lambda matrix, part: jnp.einsum("ab,byx->ayx", matrix, part)
    stiffness = smooth[None] + weight * values[:, None, None]
    parts = (mix(modes, part) / stiffness for part in (spectra.real, spectra.imag))
    return lax.complex(*(mix(modes.T, part) for part in parts))
