"""Unrolled inversion: an iterative solver with small trained networks between its steps.

The operators of the microscope hold all that is known of its lenses, so the same networks serve every lens layout. The
first steps are accelerated Richardson-Lucy with back-projection in place of the adjoint. In each of the next, the
Richardson-Lucy factor is raised to a trained power, and a network weighs each voxel by its neighbourhood. The last
steps are conjugate gradients of least squares, weighted by the brightness found so far.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Num, PRNGKeyArray

from ..base.arrays import divide
from ..base.errors import InputError
from ..base.weights import shipped_weights
from .base import (
    Operator,
    Refinement,
    as_image,
    blurred,
    check_options,
    kept_pixels,
    norm,
    project,
    project_back,
    stages,
)
from .richardson_lucy import (
    BACKGROUND_KNOTS,
    RichardsonLucy,
    State as LucyState,
    agreement,
    background_step,
    bilinear_background,
    extrapolate,
    kl_divergence,
    multiplied,
    ratio_to_expected,
)

# Input channels of a network: the voxel after and before the step, the maximum and the mean over its column, the
# agreement of its lenses, the factor of the step, and the voxel's sensitivity.
_CHANNELS = 7
# Kernel sizes of the layers, and a network's lateral reach.
_SIDES = (3, 3, 1)
_MARGIN = sum(side // 2 for side in _SIDES)
# Light that counts as dark in ratios, relative to the mean pixel.
_FAINT = 1e-3
# Steps of kind 1 that are taken on narrow voxels after those on wide ones.
_NARROW = 5
_MAX_FACTOR = 20.0
# Rows of voxels that a network processes at once, which bounds the memory.
_ROWS = 128
_MAX_STEPS, _MAX_WIDTH = 64, 1024
# Kinds of steps: Richardson-Lucy, with a network, preparation of conjugate gradients, and these.
_NETWORK, _START, _GRADIENT = 1, 2, 3
_LUCY = RichardsonLucy(accelerate=True, background_knots=BACKGROUND_KNOTS)


class Layer(eqx.Module):
    """Convolution over rows and columns, one for each step; neighbouring planes are additional input channels."""

    weight: Float[Array, "*step side side inputs outputs"]
    bias: Float[Array, "*step outputs"]


class ConjugateGradients(NamedTuple):
    """State of conjugate gradients on `weights`, the estimate divided by the prior `variance` of each voxel.

    `residual` is the negative gradient, `product` its preconditioned square, `noise` the variance of the noise.
    """

    weights: Array
    residual: Array
    direction: Array
    variance: Array
    noise: Array
    product: Array
    cost: Array


class State(NamedTuple):
    """State of `Unrolled`: those of its parts, the agreement of the lenses at each voxel, and the steps taken."""

    lucy: LucyState
    agreement: Array
    gradients: ConjugateGradients
    number: Int[Array, ""]


class Unrolled(eqx.Module):
    """Unrolled inversion by trained networks; `Unrolled.pretrained()` loads those of the package.

    *Differentiable.*

    The steps are of three kinds, with the forward model `A` and back-projection `B`:

    1. Accelerated Richardson-Lucy with `B` in place of the adjoint.
    2. `x <- w x (B(image / A x) / B 1)^p` with a power `p` for each step and weights `w` in (0, 2) from a network.
       Steps of kinds 1 and 2 also fit a smooth background.
    3. Conjugate gradients, from zero, on `|A x - image|^2 / noise + |x|^2 / variance` with the exact adjoint. The
       variance is the `x` of step 2, blurred by a voxel, times its mean brightness; it preconditions the gradients,
       which stop early (Calvetti et al., "Bayes meets Krylov", arXiv:1503.06844). The noise is the mean square of the
       residual at that `x`. A dark image gives zeros.

    Parameters
    ----------
    layers
        Layers of the networks.
    power
        Power `p` of each step of kind 2.
    first, last
        Numbers of steps of kind 1 and kind 3.
    steps, tolerance
        As for `Solver`; at most the sum of all three kinds. The cost of kind 3 is half the squares.

    Raises
    ------
    InputError
        If an option is negative, or `steps` is 0 or too many.

    Examples
    --------
    >>> method = gs.Unrolled.pretrained()
    >>> volume = gs.reconstruct(image, scope, grid, method, optics="near")
    >>> volume.shape
    (3, 41, 41)
    """

    layers: tuple[Layer, ...]
    power: Float[Array, " step"]
    first: int = eqx.field(static=True)
    last: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        check_options(self)
        # `power` is not an array where JAX builds the module of shapes or placeholders.
        if isinstance(self.power, jax.Array) and self.steps > (most := self.first + self.power.size + self.last):
            raise InputError(f"steps must be 1 to {most}, the number that was trained, got {self.steps}.")

    def init(self, A: Operator, image: Num[Array | np.ndarray, "..."]) -> State:
        image = jnp.maximum(as_image(A, image), 0)
        lucy = _LUCY.init(A, image)
        zeros, zero = jnp.zeros_like(lucy.x), jnp.zeros((), lucy.x.dtype)
        gradients = ConjugateGradients(zeros, zeros, zeros, zeros, zero, zero, zero)
        return State(lucy, agreement(A, image, lucy.sensitivity), gradients, jnp.zeros((), jnp.int32))

    def step(
        self, A: Operator, image: Num[Array | np.ndarray, "..."], state: State
    ) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        """Next state, the cost before it, and the relative change.

        The first conjugate gradient follows a step that prepares them. The operator is compiled once for all kinds.
        """
        light = as_image(A, image)
        last = self.first + self.power.size
        kind = jnp.sum(state.number >= jnp.array([self.first, last, last], jnp.int32))

        def advance(carry, step):
            needed = (step == kind) | ((step == _START) & (state.number == last))
            return lax.cond(needed, lambda: self._advance(A, light, carry[0], kind=step), lambda: carry), None

        zero = jnp.zeros((), state.lucy.x.dtype)
        steps = jnp.stack([jnp.array(_START, kind.dtype), kind])
        (state, cost, residual), _ = lax.scan(advance, (state, zero, zero), steps)
        return state._replace(number=state.number + 1), cost, residual

    def network_step(
        self, A: Operator, image: Float[Array, "..."], state: State
    ) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        """`step` of the kind with a network alone, for training: gradients of `step` would hold arrays of all kinds."""
        state, cost, change = self._advance(A, image, state, kind=_NETWORK)
        return state._replace(number=state.number + 1), cost, change

    def _advance(self, A, light, state, *, kind):
        """Take a step of some kind, traced or not, with one image of a volume and one volume of an image."""
        choose = (lambda options: options[kind]()) if isinstance(kind, int) else partial(lax.switch, kind)
        image, lucy, gradients = jnp.maximum(light, 0), state.lucy, state.gradients
        current = lambda: lucy.x
        volume = choose((lambda: extrapolate(lucy), current, current, lambda: gradients.variance * gradients.direction))
        shown = project(A, volume, exact=kind == _GRADIENT)
        background, kept = bilinear_background(lucy.knots, image), kept_pixels(A)
        expected, ratio = ratio_to_expected(image, shown + background)
        faint = divide(image, expected + _FAINT * jnp.mean(image))
        pulled = choose((lambda: ratio, lambda: faint, lambda: light, lambda: shown))
        back = project_back(A, pulled, exact=kind >= _START)

        def multiplied_by(new):
            change = divide(norm(new.x - lucy.x), norm(new.x))
            return state._replace(lucy=new), kl_divergence(image, expected), change

        def after_start():
            new = _first_gradient(lucy, light, light - shown - background, back, kept)
            return state._replace(gradients=new), new.cost, jnp.ones_like(new.cost)

        def after_gradient():
            new, change = _next_gradient(gradients, volume, shown, back)
            return state._replace(gradients=new), gradients.cost, change

        after_lucy = lambda: multiplied_by(multiplied(lucy, volume, ratio, back, kept))
        after_network = lambda: multiplied_by(self._weighed(state, faint, back, kept))
        return choose((after_lucy, after_network, after_start, after_gradient))

    def _weighed(self, state, ratio, back, kept) -> LucyState:
        """The estimate after a step by the back-projected ratio, weighed by a network."""
        (x, sensitivity, momentum, knots), number = state.lucy, state.number - self.first
        factor = jnp.clip(divide(back, sensitivity), 1 / _MAX_FACTOR, _MAX_FACTOR)
        ahead = x * factor ** self.power[number].astype(x.dtype)
        unit = _rms(ahead)

        def in_unit(volume, unit):
            return jnp.arcsinh(divide(volume, jnp.broadcast_to(unit, volume.shape)))

        def column(reduce):
            return in_unit(jnp.broadcast_to(reduce(ahead, axis=0, keepdims=True), x.shape), unit)

        channels = [
            in_unit(ahead, unit),
            in_unit(x, unit),
            column(jnp.max),
            column(jnp.mean),
            in_unit(state.agreement, _rms(state.agreement)),
            jnp.log(factor),
            divide(sensitivity, jnp.broadcast_to(jnp.max(sensitivity), x.shape)),
        ]
        layers = jax.tree.map(lambda leaf: leaf[number], self.layers)
        new = ahead * 2 * jax.nn.sigmoid(_apply_network(layers, jnp.stack(channels, -1)))
        return LucyState(new, sensitivity, momentum, background_step(knots, ratio, kept))

    def estimate(self, state: State) -> Float[Array, "..."]:
        gradients = state.gradients
        is_last = state.number > self.first + self.power.size
        return jnp.where(is_last, jnp.maximum(gradients.variance * gradients.weights, 0), state.lucy.x)

    def stages(self, count: int) -> list[Any]:
        """Steps of kind 1 on wide voxels, and a few of them with the others; none if there are no others."""
        if not _NARROW < self.first < self.steps:
            return []
        last = dataclasses.replace(self, steps=self.steps - self.first + _NARROW)
        return stages(dataclasses.replace(_LUCY, steps=self.first), count, last)

    def refined(self, A: Operator, image: Float[Array, "..."], state: LucyState, refinement: Refinement) -> State:
        """The state before the last steps of kind 1."""
        start = self.init(A, image)
        lucy = _LUCY.refined(A, image, state, refinement)._replace(sensitivity=start.lucy.sensitivity)
        return start._replace(lucy=lucy, number=jnp.full_like(start.number, self.first - _NARROW))

    @staticmethod
    def pretrained() -> "Unrolled":
        """The networks that come with the package; the model card describes their training."""
        return shipped_weights("unrolled", unrolled_skeleton)


def unrolled_skeleton(first: int, networks: int, width: int, squares: int | None = None, last: int = 0) -> Unrolled:
    """Shapes of the networks. The numbers are checked: they decide how much memory is allocated.

    Older files have `last` steps of Richardson-Lucy in place of conjugate gradients (`squares`).
    """
    if squares is None:
        raise ValueError(f"the last steps must be conjugate gradients, got {last} of Richardson-Lucy: train again")
    is_count = lambda n, least, most: type(n) is int and least <= n <= most
    steps = is_count(first, 0, _MAX_STEPS) and is_count(networks, 1, _MAX_STEPS) and is_count(squares, 0, _MAX_STEPS)
    if not (steps and is_count(width, 1, _MAX_WIDTH)):
        raise ValueError("its number of steps or its width is out of range")
    make = lambda key: initialize_unrolled(first, networks, squares, width, key=key)
    return eqx.filter_eval_shape(make, jax.random.key(0))


def initialize_unrolled(
    first: int = 15, networks: int = 3, last: int = 0, width: int = 16, *, key: PRNGKeyArray
) -> Unrolled:
    """Random networks to train, which change voxels little; `networks` steps have one."""
    widths = (_CHANNELS, *(len(_SIDES) - 1) * (width,), 1)
    layers = []
    for layer_key, side, inputs, outputs in zip(
        jax.random.split(key, len(_SIDES)), _SIDES, widths[:-1], widths[1:], strict=True
    ):
        # He's normal distribution; as many planes are inputs as rows.
        shape = (networks, side, side, side * inputs, outputs)
        weight = jax.random.normal(layer_key, shape) * (2 / (side**3 * inputs)) ** 0.5
        layers.append(Layer(weight.astype(jnp.float32), jnp.zeros((networks, outputs), jnp.float32)))
    layers[-1] = eqx.tree_at(lambda layer: layer.weight, layers[-1], 0.1 * layers[-1].weight)
    return Unrolled(tuple(layers), jnp.full(networks, 1.3, jnp.float32), first, last, first + networks + last)


def _first_gradient(lucy: LucyState, image, misfit, back, kept) -> ConjugateGradients:
    """State before the first conjugate gradient; `back` is `A' image`, and `misfit` what `lucy` leaves of the image."""
    x = lucy.x
    # Where light is likely, it is likely in neighbours, too.
    variance = blurred(x) * divide(jnp.vdot(x, x), jnp.sum(x))
    product, noise = jnp.vdot(back, variance * back), jnp.mean(misfit**2, where=None if kept is None else kept > 0)
    return ConjugateGradients(jnp.zeros_like(x), back, back, variance, noise, product, jnp.vdot(image, image) / 2)


def _next_gradient(state: ConjugateGradients, step, image, back):
    """State after a conjugate gradient, and the relative change; `image` is that of `step`, and `back` `A' image`."""
    weights, residual, direction, variance, noise, product, cost = state
    length = divide(product, jnp.vdot(image, image) + noise * jnp.vdot(direction, step))
    weights = weights + length * direction
    residual = residual - length * (back + noise * direction)
    new = jnp.vdot(residual, variance * residual)
    direction = residual + divide(new, product) * direction
    after = ConjugateGradients(weights, residual, direction, variance, noise, new, cost - length * product / 2)
    return after, divide(norm(length * step), norm(variance * weights))


def _rms(x):
    return norm(x) / x.size**0.5


def _apply_network(layers, channels: Float[Array, "depth y x channel"]) -> Float[Array, "depth y x"]:
    """Apply the network of one step, in bands of rows, with zeros beyond the volume."""
    depths, rows, columns, count = channels.shape
    bands = -(-rows // _ROWS)
    tall = -(-rows // bands)
    padded = jnp.pad(channels, [(0, 0), (_MARGIN, bands * tall - rows + _MARGIN), (_MARGIN, _MARGIN), (0, 0)])
    shape = (depths, tall + 2 * _MARGIN, columns + 2 * _MARGIN, count)

    def network(first):
        x = lax.dynamic_slice(padded, (0, first, 0, 0), shape)
        for layer in layers:
            if layer is not layers[0]:
                x = jax.nn.relu(x)
            x = _convolve(x, layer.weight.astype(x.dtype)) + layer.bias.astype(x.dtype)[None, None, None]
        return x[..., 0]

    outputs = lax.map(network, jnp.arange(bands) * tall)
    return jnp.moveaxis(outputs, 0, 1).reshape(depths, bands * tall, columns)[:, :rows]


def _convolve(x, weight):
    """Convolution as a sum of matrix products: XLA's convolutions take five times as long within loops on CPUs."""
    side, _, inputs, outputs = weight.shape
    reach = side // 2
    depths, rows, columns = x.shape[0], x.shape[1] - 2 * reach, x.shape[2] - 2 * reach
    planes = jnp.pad(x, [(reach, reach), (0, 0), (0, 0), (0, 0)])
    stacked = jnp.concatenate([planes[first : first + depths] for first in range(side)], -1)
    total = jnp.zeros((depths * rows * columns, outputs), x.dtype)
    for row, column in np.ndindex(side, side):
        window = stacked[:, row : row + rows, column : column + columns].reshape(-1, inputs)
        total = total + window @ weight[row, column]
    return total.reshape(depths, rows, columns, outputs)
