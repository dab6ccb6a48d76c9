"""Richardson-Lucy deconvolution for any operator without negative entries.

Richardson, J. Opt. Soc. Am. 62, 55 (1972); Lucy, Astron. J. 79, 745 (1974). Each step multiplies the estimate by the
back-projected ratio of the measured to the expected image, which increases the likelihood of Poisson counts.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Num

from ..base.arrays import divide
from ..base.errors import InputError, short_repr
from ..base.typing import Real
from .base import (
    Operator,
    Refinement,
    as_image,
    blurred,
    check_options,
    differences,
    differences_adjoint,
    kept_pixels,
    magnitude,
    none_if_zero,
    norm,
    stages,
)

# Default number of background knots along each side: their spacing is wider than the stray light of a spot.
BACKGROUND_KNOTS = 8
# Lower bound of Dey's denominator, which must stay positive.
_MIN_DENOMINATOR = 0.1
# Light that counts as dark in the agreement of lenses, relative to the mean pixel.
_DARK = 1e-2
# Rounding errors of an FFT, in units of the type's precision times the largest sensitivity.
_ROUNDING = 100
# Uniform share of the volume from which the next image of a recording starts.
_UNIFORM = 0.1
# Steps on voxels four times and twice as wide, and on those of the volume, relative to `steps`.
_SHARES = 2, 1.5, 0.75
# Steps that are taken at least: on wide voxels they cost little, and find the depth.
_LEAST_STEPS = 24, 8, 1
# Widest sieve, voxels, and the reach of its Gaussian.
WIDEST_SIEVE, _REACH = 2.0, 6
# A width that leaves all as it is.
_NO_SIEVE = 0.05
# Least share of a voxel that is left by an extrapolation.
_LEAST = 0.1
# Initial level of the background relative to the mean pixel: the voxels explain the light first.
_INITIAL_BACKGROUND = 0.02


class State(NamedTuple):
    """State of `RichardsonLucy`.

    `sensitivity` is `A'1`, by which steps are divided; `momentum` holds the last estimate of the accelerated method and
    the number of steps since it started anew; `knots` are the values of the fitted background.
    """

    x: Array
    sensitivity: Array
    momentum: tuple[Array, Array] | None
    knots: Float[Array, "knot knot"] | None = None


class RichardsonLucy(eqx.Module):
    """Richardson-Lucy: `x <- x A'(image / (A x + background)) / A'1`, from a uniform start.

    *Differentiable.*

    With total variation it has no derivative. The cost is the Kullback-Leibler divergence of the image from
    `A x + background`. Entries of `A` must not be negative and need no normalisation; negative pixels (read noise)
    count as 0. `x` is 0 in voxels that no pixel sees, and everywhere if the image is dark.

    Parameters
    ----------
    steps, tolerance
        As for `Solver`; the residual is the relative change of `x`.
    background
        Light that comes from no voxel, a number or an image.
    accelerate
        Extrapolate along the last change before each step, as Nesterov does (Wang and Miller, IEEE Trans. Image
        Process. 23, 848, 2014), and start anew when that points away from the image (O'Donoghue and Candes, Found.
        Comput. Math. 15, 715, 2015): needs far fewer steps, but is not monotone.
    tv
        Weight of total variation, about 1e-3 to 1e-2 (Dey et al., Microsc. Res. Tech. 69, 260, 2006): the step is
        divided by `1 - tv div(grad x / |grad x|)`. 0, kept as None, leaves it out.
    background_knots
        Knots per side of a smooth background that is fitted to 2-D images in addition, bilinear between the knots.
        0 fits none.
    min_sensitivity
        Lower bound of the sensitivity in steps, relative to the mean: voxels that few pixels see would otherwise take
        the light that an incomplete model cannot explain. 0, kept as None, is no bound.
    sieve
        Standard deviation, in voxels, of a lateral Gaussian `K`: the estimate is `K a`, with `a` found for `A K`, so
        that no noise is finer (Snyder and Miller, IEEE Trans. Nucl. Sci. 32, 3864, 1985). At most 2: wider voxels cost
        less. Light reaches the neighbours of voxels that pixels see. 0, kept as None, is no sieve. `reconstruct` takes
        several, from narrow to wide: on wider voxels it leaves out squares of pixels, and chooses the widest sieve that
        predicts them nearly as well as any. Without such steps it takes the first.

    Raises
    ------
    InputError
        If an option is negative, `steps` is 0, `background_knots` is 1, or `sieve` is not as above.

    Examples
    --------
    >>> A = gs.ImagingOperator(scope, grid)
    >>> scene = np.zeros(grid.volume_shape)
    >>> scene[1, 19, 22] = 1.0
    >>> image = gs.forward(scene, scope, grid)
    >>> solution = gs.solve(A, image, gs.RichardsonLucy(steps=30, accelerate=True))
    >>> costs, brightest = solution.stats["costs"], np.unravel_index(solution.value.argmax(), grid.volume_shape)
    >>> print(bool(costs[-1] < costs[0]), brightest[0])
    True 1
    """

    steps: int = eqx.field(static=True, default=20)
    tolerance: float = eqx.field(static=True, default=0.0)
    background: Real | Float[Array, "..."] = 0.0
    accelerate: bool = eqx.field(static=True, default=False)
    tv: Real | Float[Array, ""] | None = eqx.field(converter=none_if_zero, default=0.0)
    background_knots: int = eqx.field(static=True, default=0)
    min_sensitivity: Real | Float[Array, ""] | None = eqx.field(converter=none_if_zero, default=0.0)
    sieve: Real | tuple[Real, ...] | Float[Array, ""] | None = eqx.field(
        converter=lambda sieve: tuple(sieve) if isinstance(sieve, list) else none_if_zero(sieve), default=0.0
    )

    def __check_init__(self):
        check_options(self)
        if self.background_knots == 1 or self.background_knots < 0:
            raise InputError(f"background_knots must be 0, or 2 or more, got {self.background_knots}.")
        sieves = self.sieve if isinstance(self.sieve, tuple) else (self.sieve,)
        # Other leaves are arrays of JAX or their placeholders.
        known = [sieve for sieve in sieves if isinstance(sieve, int | float | str | np.generic | np.ndarray)]
        if not sieves or any(isinstance(sieve, str) or not 0 <= sieve <= WIDEST_SIEVE for sieve in known):
            raise InputError(f"sieve must be 0 to {WIDEST_SIEVE:g} voxels, got {short_repr(self.sieve)}.")
        if len(known) == len(sieves) and sorted(known) != known:
            raise InputError(f"sieve must go from narrow to wide, got {short_repr(self.sieve)}.")

    def init(self, A: Operator, image: Num[Array | np.ndarray, "..."]) -> State:
        image = jnp.maximum(as_image(A, image), 0)
        if self.background_knots and image.ndim != 2:
            raise InputError(f"image must be 2-D to fit a background with background_knots, got {image.ndim}-D.")
        sensitivity = self._sensitivity(A, image)
        # The start has as much light as the image; its scale matters only with a background.
        level = divide(jnp.sum(image), jnp.sum(sensitivity))
        x = jnp.where(sensitivity > 0, level, 0)
        momentum = (x, jnp.zeros((), x.dtype)) if self.accelerate else None
        shape = (self.background_knots, self.background_knots)
        knots = jnp.full(shape, _INITIAL_BACKGROUND * jnp.mean(image)) if self.background_knots else None
        return State(x, sensitivity, momentum, knots)

    def step(
        self, A: Operator, image: Num[Array | np.ndarray, "..."], state: State
    ) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        image, point = jnp.maximum(as_image(A, image), 0), extrapolate(state)
        expected, ratio = ratio_to_expected(image, self._shown(A, image, point, state.knots))
        back = self._sieved(A.T.mv(ratio))
        back = back if self.tv is None else divide(back, _tv_denominator(point, self.tv))
        new = multiplied(state, point, ratio, back, kept_pixels(A))
        return new, kl_divergence(image, expected), divide(norm(new.x - state.x), norm(new.x))

    def misfit(self, A: Operator, image: Float[Array, "..."], state: State) -> Float[Array, ""]:
        """Kullback-Leibler divergence of the pixels that `A` keeps from those of an estimate."""
        expected, kept = jnp.maximum(self._shown(A, image, state.x, state.knots), 0), kept_pixels(A)
        kept = 1 if kept is None else kept
        return kl_divergence(kept * jnp.maximum(image, 0), kept * expected)

    def estimate(self, state: State) -> Float[Array, "..."]:
        return self._sieved(state.x)

    def stages(self, count: int) -> "list[RichardsonLucy]":
        """Stages of a solver on so many grids of wider voxels, each twice as narrow as the last, and on its own."""

        def with_sieve(number, solver):
            factor = 2 ** (count - number)
            return dataclasses.replace(solver, sieve=jax.tree.map(lambda sieve: sieve / factor, self.sieve))

        return [
            with_sieve(*one)
            for one in enumerate(stages(self, count, shares=_SHARES[-1 - count :], least=_LEAST_STEPS[-1 - count :]))
        ]

    def refined(self, A: Operator, image: Float[Array, "..."], state: State, refinement: Refinement) -> State:
        """The state on narrower voxels; it goes on with the same momentum."""
        momentum = state.momentum
        if momentum:
            momentum = refinement.light(momentum[0]), momentum[1]
        knots = None if state.knots is None else state.knots / refinement.factor**2
        return State(refinement.light(state.x), self._sensitivity(A, image), momentum, knots)

    def _shown(self, A, image, x, knots):
        """The image of a volume before the sieve."""
        return A.mv(self._sieved(x)) + jnp.asarray(self.background, image.dtype) + bilinear_background(knots, image)

    def _sensitivity(self, A, image):
        """`K A'1`, with its lower bound."""
        sensitivity = self._sieved(_without_rounding(A.T.mv(jnp.ones_like(image))))
        if self.min_sensitivity is None:
            return sensitivity
        minimum = jnp.asarray(self.min_sensitivity, sensitivity.dtype) * jnp.mean(sensitivity)
        return jnp.where(sensitivity > 0, jnp.maximum(sensitivity, minimum), 0)

    def _sieved(self, x):
        """`K x`, and with the symmetric `K` its adjoint."""
        if self.sieve is None:
            return x
        if isinstance(self.sieve, tuple):
            raise InputError(f"sieve must be one number but with reconstruct, got {short_repr(self.sieve)}.")
        width = jnp.maximum(jnp.asarray(self.sieve, x.dtype), _NO_SIEVE)
        taps = jnp.exp(-0.5 * (jnp.arange(-_REACH, _REACH + 1, dtype=x.dtype) / width) ** 2)
        # Voxels that no pixel sees stay so.
        taps = jnp.where(taps > jnp.finfo(x.dtype).eps, taps, 0)
        return blurred(x, taps / taps.sum())


def restarted(state: State) -> State:
    """State from which the next image of a recording starts: the estimate, blurred by a voxel for what has moved.

    A tenth is uniform, because steps multiply: they never light a voxel that is dark.
    """
    seen = state.sensitivity > 0
    uniform = jnp.where(seen, jnp.mean(state.x, where=seen), 0)
    x = (1 - _UNIFORM) * blurred(state.x) + _UNIFORM * uniform
    momentum = (x, jnp.zeros((), x.dtype)) if state.momentum else None
    return state._replace(x=x, momentum=momentum)


def agreement(A: Operator, image: Float[Array, "..."], sensitivity: Float[Array, "..."]) -> Float[Array, "..."]:
    """Harmonic mean of the pixels under a voxel's lenses, bright where all of them are; `sensitivity` is `A.T 1`."""
    dark = _DARK * jnp.mean(image)
    inverse = divide(jnp.ones_like(image), image + dark)
    return jnp.maximum(divide(sensitivity, A.T.mv(inverse)) - dark, 0)


def bilinear_background(knots: Float[Array, "knot knot"] | None, image: Float[Array, "..."]) -> Float[Array, "..."]:
    """Background of the image's shape, bilinear between the knots; 0 without knots."""
    if knots is None:
        return jnp.zeros((), image.dtype)
    rows, columns = (hat_functions(n, len(knots), knots.dtype) for n in image.shape)
    return rows @ knots @ columns.T


def background_step(
    knots: Float[Array, "knot knot"] | None, ratio: Float[Array, "..."], kept: Float[Array, "..."] | None = None
) -> Float[Array, "knot knot"] | None:
    """Richardson-Lucy step of the background: multiplies each knot by the mean ratio under its hat function.

    The mean is over the pixels that are kept; in others the ratio is 0.
    """
    if knots is None:
        return None
    rows, columns = (hat_functions(n, len(knots), knots.dtype) for n in ratio.shape)
    # A sensor may have fewer pixels than knots.
    count = jnp.outer(rows.sum(0), columns.sum(0)) if kept is None else rows.T @ kept @ columns
    return divide(knots * (rows.T @ ratio @ columns), count)


def hat_functions(size, count, dtype):
    """Piecewise linear functions, `(size, count)`: each is 1 at its knot and 0 at the others, and they sum to 1."""
    position = np.linspace(0, count - 1, size)
    return jnp.asarray(np.maximum(1 - np.abs(position[:, None] - np.arange(count)), 0), dtype)


def kl_divergence(image: Float[Array, "*shape"], expected: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Kullback-Leibler divergence of counts `b` from their expectation `e`, `sum(e - b + b log(b / e))`.

    Pixels with `e = 0` are left out: no estimate explains their counts.
    """
    both = (image > 0) & (expected > 0)
    counts, likely = jnp.where(both, image, 1), jnp.where(both, expected, 1)
    # Where both are nearly equal, the logarithm of their ratio would be rounding alone.
    relative = (likely - counts) / counts
    near = jnp.abs(relative) < 0.5
    log = jnp.where(near, jnp.log1p(jnp.where(near, relative, 0)), jnp.log(likely / counts))
    return jnp.sum(jnp.where(expected > 0, expected - image, 0) - jnp.where(both, image * log, 0))


def extrapolate(state: State) -> Float[Array, "..."]:
    """Point from which the next step goes: along the last change, if it is accelerated."""
    if not state.momentum:
        return state.x
    last, count = state.momentum
    # No step lights a voxel that is dark.
    return jnp.maximum(state.x + count / (count + 3) * (state.x - last), _LEAST * state.x)


def ratio_to_expected(image: Float[Array, "..."], shown: Float[Array, "..."]) -> tuple[Array, Array]:
    """The expected image, which is not negative, and the ratio of the measured image to it."""
    expected = jnp.maximum(shown, 0)
    # An FFT's rounding must not turn a dark pixel into a huge ratio.
    return expected, divide(image, expected, jnp.finfo(image.dtype).eps * lax.stop_gradient(expected.max()))


def multiplied(
    state: State,
    point: Float[Array, "*shape"],
    ratio: Float[Array, "..."],
    back: Float[Array, "*shape"],
    kept: Float[Array, "..."] | None = None,
) -> State:
    """State after the step from `point = extrapolate(state)` by the back-projected ratio."""
    new, momentum = divide(point * jnp.maximum(back, 0), state.sensitivity), state.momentum
    if momentum:
        # `back - A'1` is the slope of the likelihood, where nothing bounds the sensitivity.
        uphill = jnp.vdot(back - state.sensitivity, new - state.x) >= 0
        momentum = state.x, jnp.where(uphill, momentum[1] + 1, 0).astype(momentum[1].dtype)
    return State(new, state.sensitivity, momentum, background_step(state.knots, ratio, kept))


def _without_rounding(sensitivity):
    # An FFT leaves rounding in voxels that no pixel sees; a quotient of two such values would grow without bound.
    minimum = _ROUNDING * jnp.finfo(sensitivity.dtype).eps * lax.stop_gradient(sensitivity.max())
    return jnp.where(sensitivity > minimum, sensitivity, 0)


def _tv_denominator(x, tv):
    u = differences(x)
    curvature = differences_adjoint(divide(u, jnp.broadcast_to(magnitude(u)[None], u.shape)))
    return jnp.maximum(1 + jnp.asarray(tv, x.dtype) * curvature, _MIN_DENOMINATOR)
