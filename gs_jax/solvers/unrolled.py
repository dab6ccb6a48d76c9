"""Unrolled inversion: an iterative solver, whose last steps have small networks between them, trained together.

What a capture says of a volume is in the operators of its own microscope, which the networks do not hold: they are the
same for every layout of lenses. The first steps are those of accelerated list-Richardson-Lucy. In each of the next its
step is taken to a power that was learned, and a network then weighs each voxel by what it and its neighbours look like.
The last have no networks again: where light may be is known then, and least squares say how much of it there is.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Num, PRNGKeyArray

from ..base.arrays import divide
from ..base.errors import InputError
from ..io import weights
from ..io.provenance import Provenance
from ..typing import PathLike
from .base import Unmatched, as_image, check_options, norm
from .richardson_lucy import TENTS, RichardsonLucy, State as LucyState, divergence, tent_background, tent_step

# Channels that a network sees: the voxel after the step and before it, the largest and the mean over its column, how
# far its lenses agree, what the step asked for, and how many lenses see it.
_SEEN = 7
# Voxels along a side of each layer's convolution, and how far a network sees laterally.
_SIDES = (3, 3, 1)
_MARGIN = sum(side // 2 for side in _SIDES)
# Light that counts as none, in parts of the image's mean: where lenses are asked whether they agree, and in ratios.
_DARK, _FAINT = 1e-2, 1e-3
# What a step may ask for at most, and at least, as the network sees it.
_MOST = 20.0
# Rows of voxels at a time, which bounds the memory: what a network sees does not depend on them.
_ROWS = 128
# Binomial weights, whose standard deviation is one voxel: where light is likely, it is so beside it, too.
_BESIDE = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)
_MOST_STEPS, _MOST_WIDTH = 64, 1024
_LUCY = RichardsonLucy(accelerate=True, tents=TENTS)


class Layer(eqx.Module):
    """A convolution, one for each step: over rows and columns, with neighbouring planes among the channels seen."""

    weight: Float[Array, "*step side side seen made"]
    bias: Float[Array, "*step made"]


class Squares(NamedTuple):
    """Of conjugate gradients: the estimate over the variance that each voxel is expected to have, the negative
    gradient, the next direction, that variance, the variance of noise, the gradient's square in its unit, and the cost.
    """

    weights: Array
    residual: Array
    direction: Array
    variance: Array
    noise: Array
    product: Array
    cost: Array


class State(NamedTuple):
    """Of `Unrolled`: the state of Richardson-Lucy, how far the lenses agree, that of conjugate gradients, and the steps
    that are done.
    """

    lucy: LucyState
    agreement: Array
    squares: Squares
    number: Int[Array, ""]


class Unrolled(eqx.Module):
    """Unrolled inversion, by networks: `Unrolled.pretrained()` has those that come with the package.

    *Differentiable.*

    `x <- w x (B(image / A x) / B 1)^p`, with the forward model `A`, back-projection `B` in the place of its adjoint, a
    power `p` of each step, and weights `w` between 0 and 2 that a network gives. Before that come the first steps of
    accelerated Richardson-Lucy with `A` and `B`. Both fit a slow background, too. After that come conjugate gradients
    from darkness towards the least `|A x - image|^2 / noise + |x|^2 / variance`, with the exact adjoint. The variance
    that each voxel is expected to have is the `x` before them, blurred by a voxel, times its mean brightness; they are
    preconditioned by it, and end early (Calvetti et al., "Bayes meets Krylov", arXiv:1503.06844). The noise is what
    that `x` leaves of the image, so that nothing is made of noise alone. A dark image gives zeros.

    Parameters
    ----------
    layers
        Of the networks.
    power
        One for each step with a network.
    first
        Steps before those with networks.
    last
        Conjugate gradients after them.
    steps, tolerance
        As for `Solver`; `first`, one for each network, and `last`, or fewer. The cost of the last is half the squares.

    Raises
    ------
    InputError
        If an option is negative, or there are no steps or too many.

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> import numpy as np
    >>> point = np.array([[0.2, -0.1, 20.0, 1.0]])  # x, y, z in mm, and its light
    >>> image = gs.simulate(point, scope, optics="near", psf="geometric")
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
        # Where modules are made of shapes or of nothing, there is nothing to check.
        if isinstance(self.power, jax.Array) and self.steps > (most := self.first + self.power.size + self.last):
            raise InputError(
                f"steps: found {self.steps}, allowed: 1 to {most}, {self.power.size} of them with networks."
            )

    def init(self, A: lx.AbstractLinearOperator | Unmatched, image: Num[Array | np.ndarray, "..."]) -> State:
        image = jnp.maximum(as_image(A, image), 0)
        lucy = _LUCY.init(A, image)
        dark = _DARK * jnp.mean(image)
        inverse = divide(jnp.ones_like(image), image + dark)
        # The harmonic mean of the pixels under a voxel's lenses: bright where all of them are.
        agreement = jnp.maximum(divide(lucy.sensitivity, A.T.mv(inverse)) - dark, 0)
        zeros, zero = jnp.zeros_like(lucy.x), jnp.zeros((), lucy.x.dtype)
        return State(lucy, agreement, Squares(zeros, zeros, zeros, zeros, zero, zero, zero), jnp.zeros((), jnp.int32))

    def step(
        self, A: lx.AbstractLinearOperator | Unmatched, image: Num[Array | np.ndarray, "..."], state: State
    ) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        light = as_image(A, image)
        image = jnp.maximum(light, 0)

        def lucy(state):
            lucy, *told = _LUCY.step(A, image, state.lucy)
            return state._replace(lucy=lucy), *told

        def learned(state):
            lucy, *told = self.learned(A, image, state)
            return state._replace(lucy=lucy), *told

        def squares(state):
            begin = lambda: _squares(A, light, state.lucy)
            squares, *told = _conjugate(A, lax.cond(state.number == ended[1], begin, lambda: state.squares))
            return state._replace(squares=squares), *told

        ended = jnp.array([self.first, self.first + self.power.size], jnp.int32)
        state, cost, residual = lax.switch(jnp.sum(state.number >= ended), (lucy, learned, squares), state)
        return state._replace(number=state.number + 1), cost, residual

    def learned(
        self, A: lx.AbstractLinearOperator | Unmatched, image: Float[Array, "..."], state: State
    ) -> tuple[LucyState, Float[Array, ""], Float[Array, ""]]:
        """A step with a network: the new estimate, the cost of the old one, and the relative change."""
        (x, sensitivity, momentum, _), number = state.lucy, state.number - self.first
        expected, tents, asked = _asked(A, image, state.lucy)
        ahead = x * asked ** self.power[number].astype(x.dtype)
        unit = _rms(ahead)
        in_unit = lambda volume, unit: jnp.arcsinh(divide(volume, jnp.broadcast_to(unit, volume.shape)))
        column = lambda part: in_unit(jnp.broadcast_to(part(ahead, axis=0, keepdims=True), x.shape), unit)
        seen = [
            in_unit(ahead, unit),
            in_unit(x, unit),
            column(jnp.max),
            column(jnp.mean),
            in_unit(state.agreement, _rms(state.agreement)),
            jnp.log(asked),
            divide(sensitivity, jnp.broadcast_to(jnp.max(sensitivity), x.shape)),
        ]
        layers = jax.tree.map(lambda part: part[number], self.layers)
        new = ahead * 2 * jax.nn.sigmoid(_weighed(layers, jnp.stack(seen, -1)))
        lucy = LucyState(new, sensitivity, momentum, tents)
        return lucy, divergence(image, expected), divide(norm(new - x), norm(new))

    def estimate(self, state: State) -> Float[Array, "..."]:
        squares = state.number > self.first + self.power.size
        return jnp.where(squares, jnp.maximum(state.squares.variance * state.squares.weights, 0), state.lucy.x)

    @staticmethod
    def pretrained() -> "Unrolled":
        """The networks that come with the package; their model card says how they were made."""
        return weights.shipped("unrolled", _skeleton)


def write_unrolled(path: PathLike, networks: Unrolled, provenance: Provenance | None = None) -> None:
    """Writes the networks as `.npz`; see `gs_jax.io.weights`."""
    width = networks.layers[0].bias.shape[-1]
    about = {"first": networks.first, "networks": networks.power.size, "squares": networks.last, "width": width}
    weights.write_weights(path, networks, about, provenance)


def read_unrolled(path: PathLike) -> Unrolled:
    """The networks in a file of `write_unrolled`, in float32. Nothing in the file is ever executed.

    Raises
    ------
    InputError
        If the file cannot be read, or holds no such networks, or not their arrays, finite.
    """
    return weights.read_weights(path, _skeleton)


def _skeleton(first: int, networks: int, width: int, squares: int | None = None, last: int = 0) -> Unrolled:
    """The shapes of the networks, checked: what a file says decides how much memory is asked for."""
    if squares is None:
        raise ValueError(f"found {last} last steps of Richardson-Lucy, allowed: conjugate gradients, by training again")
    whole = lambda n, least, most: type(n) is int and least <= n <= most
    steps = whole(first, 0, _MOST_STEPS) and whole(networks, 1, _MOST_STEPS) and whole(squares, 0, _MOST_STEPS)
    if not (steps and whole(width, 1, _MOST_WIDTH)):
        raise ValueError("its number of steps or its width is out of range")
    return eqx.filter_eval_shape(lambda key: untrained(first, networks, squares, width, key=key), jax.random.key(0))


def untrained(first: int = 15, networks: int = 3, last: int = 0, width: int = 16, *, key: PRNGKeyArray) -> Unrolled:
    """Networks before their training: they leave nearly every voxel as it is."""
    widths = (_SEEN, *(len(_SIDES) - 1) * (width,), 1)
    layers = []
    for one, side, seen, made in zip(jax.random.split(key, len(_SIDES)), _SIDES, widths[:-1], widths[1:], strict=True):
        # He's normal distribution. As many planes are seen as rows.
        weight = jax.random.normal(one, (networks, side, side, side * seen, made)) * (2 / (side**3 * seen)) ** 0.5
        layers.append(Layer(weight.astype(jnp.float32), jnp.zeros((networks, made), jnp.float32)))
    layers[-1] = eqx.tree_at(lambda layer: layer.weight, layers[-1], 0.1 * layers[-1].weight)
    return Unrolled(tuple(layers), jnp.full(networks, 1.3, jnp.float32), first, last, first + networks + last)


def _asked(A, image, lucy: LucyState):
    """The image of an estimate and its background, the next background, and the factors of Richardson-Lucy's step."""
    expected = jnp.maximum(A.mv(lucy.x) + tent_background(lucy.tents, image), 0)
    ratio = divide(image, expected + _FAINT * jnp.mean(image))
    asked = jnp.clip(divide(A.T.mv(ratio), lucy.sensitivity), 1 / _MOST, _MOST)
    return expected, tent_step(lucy.tents, ratio), asked


def _squares(A, image, lucy: LucyState) -> Squares:
    """Before the first of the conjugate gradients, with the volume that says where light may be."""
    x, forward = lucy.x, A.forward if isinstance(A, Unmatched) else A
    left = image - forward.mv(x) - tent_background(lucy.tents, image)
    # As bright as light is on average, where there is as much of it as there is.
    variance = _blurred(_blurred(x, 1), 2) * divide(jnp.vdot(x, x), jnp.sum(x))
    residual = _exact(A).T.mv(image)
    product = jnp.vdot(residual, variance * residual)
    cost = jnp.vdot(image, image) / 2
    return Squares(jnp.zeros_like(x), residual, residual, variance, jnp.mean(left**2), product, cost)


def _conjugate(A, squares: Squares):
    """One of them: the next state, the cost of the last, and the relative change."""
    A = _exact(A)
    weights, residual, direction, variance, noise, product, cost = squares
    step = variance * direction
    image = A.mv(step)
    length = divide(product, jnp.vdot(image, image) + noise * jnp.vdot(direction, step))
    weights = weights + length * direction
    residual = residual - length * (A.T.mv(image) + noise * direction)
    new = jnp.vdot(residual, variance * residual)
    direction = residual + divide(new, product) * direction
    after = Squares(weights, residual, direction, variance, noise, new, cost - length * product / 2)
    return after, cost, divide(norm(length * step), norm(variance * weights))


def _exact(A: lx.AbstractLinearOperator | Unmatched) -> lx.AbstractLinearOperator:
    return (A.squares or A.forward) if isinstance(A, Unmatched) else A


def _blurred(x, axis):
    """By `_BESIDE`; beyond the volume it is dark."""
    reach, size = len(_BESIDE) // 2, x.shape[axis]
    wide = jnp.pad(x, [(reach, reach) if along == axis else (0, 0) for along in range(x.ndim)])
    return sum(w * lax.slice_in_dim(wide, i, i + size, axis=axis) for i, w in enumerate(_BESIDE))


def _rms(x):
    return norm(x) / x.size**0.5


def _weighed(layers, seen: Float[Array, "depth y x channel"]) -> Float[Array, "depth y x"]:
    """What the network of one step says of each voxel; beyond the volume it sees zeros."""
    depths, rows, columns, channels = seen.shape
    bands = -(-rows // _ROWS)
    tall = -(-rows // bands)
    wide = jnp.pad(seen, [(0, 0), (_MARGIN, bands * tall - rows + _MARGIN), (_MARGIN, _MARGIN), (0, 0)])
    shape = (depths, tall + 2 * _MARGIN, columns + 2 * _MARGIN, channels)
    network = lambda first: _network(layers, lax.dynamic_slice(wide, (0, first, 0, 0), shape))
    found = lax.map(network, jnp.arange(bands) * tall)
    return jnp.moveaxis(found, 0, 1).reshape(depths, bands * tall, columns)[:, :rows]


def _network(layers, x):
    for layer in layers:
        if layer is not layers[0]:
            x = jax.nn.relu(x)
        x = _convolved(x, layer.weight.astype(x.dtype)) + layer.bias.astype(x.dtype)[None, None, None]
    return x[..., 0]


def _convolved(x, weight):
    """Sums of products of matrices: within loops XLA's convolutions take five times as long on processors."""
    side, _, seen, made = weight.shape
    ends = side // 2
    depths, rows, columns = x.shape[0], x.shape[1] - 2 * ends, x.shape[2] - 2 * ends
    planes = jnp.pad(x, [(ends, ends), (0, 0), (0, 0), (0, 0)])
    beside = jnp.concatenate([planes[first : first + depths] for first in range(side)], -1)
    total = jnp.zeros((depths * rows * columns, made), x.dtype)
    for row, column in np.ndindex(side, side):
        total = total + beside[:, row : row + rows, column : column + columns].reshape(-1, seen) @ weight[row, column]
    return total.reshape(depths, rows, columns, made)
