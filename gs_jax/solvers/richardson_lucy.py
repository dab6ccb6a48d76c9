"""Richardson-Lucy deconvolution, for any operator without negative entries.

Richardson, J. Opt. Soc. Am. 62, 55 (1972); Lucy, Astron. J. 79, 745 (1974). Each step multiplies the estimate by the
back-projected ratio of the image to what the estimate would give, and so climbs the likelihood of Poisson counts.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Num

from ..base.arrays import divide
from ..base.errors import InputError
from ..typing import Real
from .base import Unmatched, as_image, check_options, differences, differences_adjoint, magnitude, norm

# Tents that make a background slow, by default: wider than the halo of a spot.
TENTS = 8
# The most that total variation may hold back a voxel in one step: Dey's denominator must stay positive.
_LEAST_DENOMINATOR = 0.1
# In units of the type's precision, relative to the largest sensitivity.
_ROUNDING = 100
# Part of the light that tents have at first: the voxels may explain it before the background does.
_FIRST_TENTS = 0.02


class State(NamedTuple):
    """Of `RichardsonLucy`: the estimate, what it is divided by (`A'1`), and if it has them what accelerates, which is
    the last estimate, product and gain, and the slow background's tents.
    """

    x: Array
    sensitivity: Array
    momentum: tuple[Array, Array, Array] | None
    tents: Float[Array, "tent tent"] | None = None


class RichardsonLucy(eqx.Module):
    """Richardson-Lucy: `x <- x A'(image / (A x + background)) / A'1`, from a uniform start.

    *Differentiable.*

    The cost is the Kullback-Leibler divergence of the image from `A x + background`. Entries of `A` must not be
    negative, and need no normalisation; negative pixels (read noise) count as 0. `x` is 0 in voxels that no pixel sees,
    and everywhere if the image is dark. With total variation it has no derivative.

    Parameters
    ----------
    steps, tolerance
        As for `Solver`; the residual is the relative change of `x`.
    background
        Light that comes from no voxel: a number or an image.
    accelerate
        Extrapolate along the last change before each step, by the ratio of the last two steps' products (Biggs and
        Andrews, Appl. Opt. 36, 1766, 1997): many times fewer steps, not monotone.
    tv
        Weight of total variation, about 1e-3 to 1e-2 (Dey et al., Microsc. Res. Tech. 69, 260, 2006): the step is
        divided by `1 - tv div(grad x / |grad x|)`.
    tents
        So many along rows, and along columns, are a background that is fitted, too, to images of two dimensions: light
        that varies slowly and comes from no voxel. 0 is none.
    least_seen
        Voxels that few pixels see are divided as if these were this share of the mean voxel's: with a model that does
        not hold all light, they would take what it cannot explain.

    Raises
    ------
    InputError
        If an option is negative, or a number of steps 0, or of tents 1.

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> import numpy as np
    >>> A = gs.ImagingOperator(scope, grid)
    >>> scene = np.zeros(grid.volume_shape)
    >>> scene[1, 19, 22] = 1.0
    >>> image = gs.forward(scene, scope, grid)
    >>> found = gs.solve(A, image, gs.RichardsonLucy(steps=30, accelerate=True))
    >>> print(bool(found.costs[-1] < found.costs[0]), np.unravel_index(found.x.argmax(), grid.volume_shape)[0])
    True 1
    """

    steps: int = eqx.field(static=True, default=20)
    tolerance: float = eqx.field(static=True, default=0.0)
    background: Real | Float[Array, "..."] = 0.0
    accelerate: bool = eqx.field(static=True, default=False)
    tv: float = eqx.field(static=True, default=0.0)
    tents: int = eqx.field(static=True, default=0)
    least_seen: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        check_options(self)
        if self.tents == 1 or self.tents < 0:
            raise InputError(f"tents: found {self.tents}, allowed: 0, or 2 and more.")

    def init(self, A: lx.AbstractLinearOperator | Unmatched, image: Num[Array | np.ndarray, "..."]) -> State:
        image = jnp.maximum(as_image(A, image), 0)
        if self.tents and image.ndim != 2:
            raise InputError(f"tents: found {self.tents} and an image of {image.ndim} dimensions, allowed: of 2.")
        sensitivity = _without_rounding(A.T.mv(jnp.ones_like(image)))
        if self.least_seen:
            least = self.least_seen * jnp.mean(sensitivity)
            sensitivity = jnp.where(sensitivity > 0, jnp.maximum(sensitivity, least), 0)
        # The scale of the start does not matter without a background; this one has the image's light.
        level = divide(jnp.sum(image), jnp.sum(sensitivity))
        x = jnp.where(sensitivity > 0, level, 0)
        momentum = (x, jnp.zeros_like(x), jnp.zeros((), x.dtype)) if self.accelerate else None
        tents = jnp.full((self.tents, self.tents), _FIRST_TENTS * jnp.mean(image)) if self.tents else None
        return State(x, sensitivity, momentum, tents)

    def step(
        self, A: lx.AbstractLinearOperator | Unmatched, image: Num[Array | np.ndarray, "..."], state: State
    ) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        image = jnp.maximum(as_image(A, image), 0)
        x, sensitivity, momentum, tents = state
        point = _ahead(x, momentum) if momentum else x
        expected = jnp.maximum(
            A.mv(point) + jnp.asarray(self.background, image.dtype) + tent_background(tents, image), 0
        )
        # An FFT's rounding must not turn a dark pixel into a huge ratio.
        ratio = divide(image, expected, jnp.finfo(image.dtype).eps * lax.stop_gradient(expected.max()))
        scale = sensitivity * _hold(point, self.tv) if self.tv else sensitivity
        new = divide(point * jnp.maximum(A.T.mv(ratio), 0), scale)
        momentum = momentum and (x, new - point, _gain(new - point, momentum[1]))
        residual = divide(norm(new - x), norm(new))
        return State(new, sensitivity, momentum, tent_step(tents, ratio)), divergence(image, expected), residual

    def estimate(self, state: State) -> Float[Array, "..."]:
        return state.x


def tent_background(tents: Float[Array, "tent tent"] | None, image: Float[Array, "..."]) -> Float[Array, "..."]:
    """A slow background of the image's shape, linear between the tents; 0 if there is none."""
    if tents is None:
        return jnp.zeros((), image.dtype)
    rows, columns = (_tents(n, len(tents), tents.dtype) for n in image.shape)
    return rows @ tents @ columns.T


def tent_step(tents: Float[Array, "tent tent"] | None, ratio: Float[Array, "..."]) -> Float[Array, "tent tent"] | None:
    """The step of Richardson-Lucy of a slow background: each tent by the mean ratio under it."""
    if tents is None:
        return None
    rows, columns = (_tents(n, len(tents), tents.dtype) for n in ratio.shape)
    # A sensor may have fewer pixels than tents.
    return divide(tents * (rows.T @ ratio @ columns), jnp.outer(rows.sum(0), columns.sum(0)))


def _tents(size, count, dtype):
    """Each is 1 in its place, 0 in the others', and all add up to 1: `(size, count)`."""
    place = np.linspace(0, count - 1, size)
    return jnp.asarray(np.maximum(1 - np.abs(place[:, None] - np.arange(count)), 0), dtype)


def divergence(image: Float[Array, "*shape"], expected: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Kullback-Leibler divergence of counts `b` from what was expected, `sum(e - b + b log(b / e))`.

    Where nothing is expected it leaves counts out, which no estimate explains.
    """
    both = (image > 0) & (expected > 0)
    counts, likely = jnp.where(both, image, 1), jnp.where(both, expected, 1)
    # Where they are nearly equal, the logarithm of their ratio would leave nothing but rounding.
    relative = (likely - counts) / counts
    near = jnp.abs(relative) < 0.5
    log = jnp.where(near, jnp.log1p(jnp.where(near, relative, 0)), jnp.log(likely / counts))
    return jnp.sum(jnp.where(expected > 0, expected - image, 0) - jnp.where(both, image * log, 0))


def _ahead(x, momentum):
    last, _, gain = momentum
    return jnp.maximum(x + gain * (x - last), 0)


def _gain(product, last):
    return jnp.clip(divide(jnp.vdot(product, last), jnp.vdot(last, last)), 0, 1)


def _without_rounding(sensitivity):
    """What an FFT leaves in voxels that no pixel sees is taken for 0: rounding over rounding would grow without end."""
    least = _ROUNDING * jnp.finfo(sensitivity.dtype).eps * lax.stop_gradient(sensitivity.max())
    return jnp.where(sensitivity > least, sensitivity, 0)


def _hold(x, tv):
    u = differences(x, wrap=False)
    curvature = differences_adjoint(divide(u, jnp.broadcast_to(magnitude(u)[None], u.shape)), wrap=False)
    return jnp.maximum(1 + tv * curvature, _LEAST_DENOMINATOR)
