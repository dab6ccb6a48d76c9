"""Sheets fitted through a linear operator: a brightness and a depth for each column of a volume.

Free voxels spread the light of an extended object over several planes, because all lenses see it nearly from the front.
A sheet has one depth in each column, which all views determine together. The fit starts with a few steps of
Richardson-Lucy, and continues with Gauss-Newton steps. Each step, of whatever kind, takes one product with the operator
and one with its transpose.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Num

from ..base.arrays import divide, safe_sqrt
from ..base.errors import InputError
from ..base.typing import Real
from .base import Operator, as_image, check_options, differences, differences_adjoint, magnitude
from .richardson_lucy import (
    BACKGROUND_KNOTS,
    RichardsonLucy,
    State as LucyState,
    bilinear_background,
    extrapolate,
    hat_functions,
    multiplied,
    ratio_to_expected,
)

# Steps of Richardson-Lucy, Gauss-Newton steps, conjugate gradients in each, and probes of the Hessian at the end;
# Gauss-Newton steps from a given start.
_FIRST, _ROUNDS, _GRADIENTS, _PROBES, _RESTARTED = 10, 5, 3, 4, 2
# What a step is for.
_LUCY, _LINEARISE, _PROBE, _GRADIENT = range(4)
_SCHEDULE = (
    *(_LUCY,) * _FIRST,
    *(_LINEARISE, _PROBE, *(_GRADIENT,) * _GRADIENTS),
    *(_LINEARISE, *(_GRADIENT,) * _GRADIENTS) * (_ROUNDS - 1),
    _LINEARISE,
    *(_PROBE,) * _PROBES,
)
# Steps from a given start, without probes at the end: some rounds, and the misfit after them.
RESTARTED_STEPS = 1 + _RESTARTED * (1 + _GRADIENTS) + 1
# Differences between neighbours that count as edges: of depths, planes, and of roots of brightness, of their RMS.
_EDGE_DEPTH, _EDGE_ROOT = 0.1, 0.3
# Largest change of a depth in a Gauss-Newton step, planes: the derivative involves the two nearest planes.
_MAX_MOVE = 1.0
# Standard deviations by the Hessian's diagonal are too small by this factor: it leaves out correlations with neighbours
# and with brightness, and neighbours share errors of the model. Measured on ray-traced sheets (`surfaces.py`).
_UNDERSTATED = 8.0
# Share of a Gauss-Newton step that is taken: depths of whole steps, of few gradients each, swing about their limit.
_SHARE = 0.9
# Damping of the Gauss-Newton steps, of the mean diagonal of the Hessian.
_DAMPING = 1e-3
# At the start the brightness is nearly right and depths are not: the preconditioner lets depths change first.
_BRIGHTNESS_LATER = 0.3
# Voxels from one knot of the depth to the next.
_SPACING = 5
# Steps of Lloyd's algorithm, and the light, relative to the mean column's, up to which depths stay with all columns'.
_LLOYD, _ALIKE = 8, 3.0
# Least brightness of a column at the start, relative to the mean: by its root, none has no gradient.
_FAINT = 1e-3
_START = RichardsonLucy(accelerate=True, background_knots=BACKGROUND_KNOTS, min_sensitivity=0.3)


class Sheets(NamedTuple):
    """Unknowns: roots of brightness, depths at knots, in planes from the first, and the background at its knots."""

    root: Array
    depth: Array
    background: Array


class State(NamedTuple):
    """State of `Surface`.

    Parameters
    ----------
    lucy
        The free voxels from which the fit starts.
    sheets, change, residual, direction
        The sheets, and the change that conjugate gradients look for, with their residual and direction.
    diagonal
        Mean diagonal of the Hessian for each unknown, relative to that of `squared_derivatives`.
    information
        Sum of the last probes of the Hessian's diagonal, for each depth.
    inverse
        Inverse variance of the residual.
    errors
        RMS misfit of the free voxels and of the sheets, relative to the image's RMS.
    number
        Steps taken.
    """

    lucy: LucyState
    sheets: Sheets
    change: Sheets
    residual: Sheets
    direction: Sheets
    diagonal: Float[Array, "3"]
    information: Array
    inverse: Float[Array, ""]
    errors: Float[Array, "2"]
    number: Int[Array, ""]


class Surface(eqx.Module):
    """Sheets through the volume: a brightness and a depth for each column, fitted to the image.

    *Compiled.*

    The volume is `brightness max(0, 1 - |k - depth|)` on the planes `k`: linear shares of two planes. A few steps of
    Richardson-Lucy give the start; then brightness, depth and a smooth background are fitted by Gauss-Newton with
    conjugate gradients. All pixels count alike: weights of photon noise would trust dark pixels, where the model's
    errors are larger than noise. Both maps are smoothed but at edges (Charbonnier's penalty). There is no network.
    `fit_surface` returns the maps.

    Parameters
    ----------
    sheets
        Sheets one behind the other in a column.
    smooth_depth, smooth_brightness
        Weights of the penalties, relative to half of the squared residual over its mean square: of differences in depth
        between knots, 5 voxels apart, in planes, and in root brightness between voxels, relative to its RMS.
    steps, tolerance
        As for `Solver`; at most the number of the schedule.

    Raises
    ------
    InputError
        If an option is out of range.

    Examples
    --------
    >>> volume = gs.reconstruct(image, scope, grid, gs.Surface(), optics="near")
    >>> volume.shape
    (3, 41, 41)
    """

    sheets: int = eqx.field(static=True, default=1)
    smooth_depth: Real | Float[Array, ""] = 5.0
    smooth_brightness: Real | Float[Array, ""] = 0.0
    steps: int = eqx.field(static=True, default=len(_SCHEDULE))
    tolerance: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        check_options(self)
        if self.steps > len(_SCHEDULE):
            raise InputError(f"steps must be 1 to {len(_SCHEDULE)}, got {self.steps}.")
        if self.sheets < 1:
            raise InputError(f"sheets must be 1 or more, got {self.sheets}.")

    def init(self, A: Operator, image: Num[Array | np.ndarray, "..."]) -> State:
        image = jnp.maximum(as_image(A, image), 0)
        lucy = _START.init(A, image)
        none = jax.tree.map(jnp.zeros_like, jax.eval_shape(lambda: first_sheets(lucy.x, lucy.knots, self.sheets)))
        return _state_before(0, lucy, none, jnp.zeros((), image.dtype), jnp.zeros(2, image.dtype))

    def step(
        self, A: Operator, image: Num[Array | np.ndarray, "..."], state: State
    ) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        light, schedule = as_image(A, image), jnp.array(_SCHEDULE, jnp.int32)
        kind = schedule[state.number]
        following = schedule[jnp.minimum(state.number + 1, len(_SCHEDULE) - 1)]
        planes = state.lucy.x.shape[0]
        probe = _probe(state, following)
        # A volume, its image, and what is projected back, for all kinds: the operator is compiled once.
        tangent = lambda to: (jax.jvp(lambda s: volume_of(s, planes), (state.sheets,), (to,))[1], to.background)
        inputs = (
            lambda: (extrapolate(state.lucy), state.lucy.knots),
            lambda: (volume_of(state.sheets, planes), state.sheets.background),
            lambda: tangent(probe),
            lambda: tangent(state.direction),
        )
        volume, background = lax.switch(kind, inputs)
        shown = A.mv(volume) + bilinear_background(background, light)
        residual, (_, ratio) = light - shown, ratio_to_expected(jnp.maximum(light, 0), shown)
        variance = jnp.mean(residual**2)
        inverse = jnp.where(kind == _LINEARISE, divide(jnp.ones_like(variance), variance), state.inverse)
        state = state._replace(inverse=inverse)
        outputs = (lambda: ratio, lambda: state.inverse * residual, lambda: state.inverse * shown)
        pulled = lax.switch(jnp.minimum(kind, _PROBE), outputs)
        back = A.T.mv(pulled)
        misfit = divide(variance, jnp.mean(light**2)) ** 0.5

        def pullback():
            part = jax.vjp(lambda s: volume_of(s, planes), state.sheets)[1](back)[0]
            rows, columns = hats(light.shape, background.shape, light.dtype)
            return part._replace(background=rows.T @ pulled @ columns)

        def after_lucy():
            lucy = multiplied(state.lucy, volume, pulled, back)
            sheets = lax.cond(
                following == _LUCY, lambda: state.sheets, lambda: first_sheets(lucy.x, lucy.knots, self.sheets)
            )
            return state._replace(lucy=lucy, sheets=sheets, errors=state.errors.at[0].set(misfit))

        def after_linearisation():
            downhill = _add(pullback(), self._prior(state.sheets, state.sheets), -1)
            none = jax.tree.map(jnp.zeros_like, downhill)
            new = state._replace(change=none, residual=downhill, errors=state.errors.at[1].set(misfit))
            return new._replace(direction=self._precondition(new, downhill))

        def after_probe():
            product = jax.tree.map(jnp.multiply, probe, pullback())
            energy, square = squared_derivatives(state.sheets), jnp.max(probe.root**2)
            rows, columns = hats(light.shape, background.shape, light.dtype)
            means = (
                divide(product.root.sum(), square * energy.root.sum()),
                divide(product.depth.sum(), energy.depth.sum()),
                state.inverse * (rows**2).sum(0).mean() * (columns**2).sum(0).mean(),
            )
            # The last probes are of the depths alone.
            is_first = following == _GRADIENT
            new = state._replace(
                diagonal=jnp.where(is_first, jnp.maximum(jnp.stack(means), 0), state.diagonal),
                information=state.information + jnp.where(is_first, 0, product.depth),
            )
            return new._replace(direction=self._precondition(new, state.residual))

        def after_gradient():
            direction, ahead = state.direction, self._precondition(state, state.residual)
            product = _dot(state.residual, ahead)
            curved = _add(pullback(), self._prior(state.sheets, direction), 1)
            curved = _add(curved, jax.tree.map(jnp.multiply, _damping(state), direction), 1)
            length = divide(product, _dot(direction, curved))
            change, residual = _add(state.change, direction, length), _add(state.residual, curved, -length)
            ahead = self._precondition(state, residual)
            direction = _add(ahead, direction, divide(_dot(residual, ahead), product))
            sheets = lax.cond(following == _GRADIENT, lambda: state.sheets, lambda: _moved(state, change))
            return state._replace(sheets=sheets, change=change, residual=residual, direction=direction)

        state = lax.switch(kind, (after_lucy, after_linearisation, after_probe, after_gradient))
        # Steps of different kinds have no common residual: none ends the schedule early.
        return state._replace(number=state.number + 1), misfit, jnp.ones((), light.dtype)

    def estimate(self, state: State) -> Float[Array, "depth y x"]:
        is_start = state.number < _FIRST
        return lax.cond(is_start, lambda: state.lucy.x, lambda: volume_of(state.sheets, state.lucy.x.shape[0]))

    def _prior(self, at, vector):
        """Product of the penalties' Hessian, with the weights that edges have now, and a vector."""
        unit = jnp.mean(at.root**2)
        scaled = divide(at.root, jnp.broadcast_to(safe_sqrt(unit), at.root.shape))
        root = jnp.stack([_diffused(a, v, _EDGE_ROOT) for a, v in zip(scaled, vector.root, strict=True)])
        depth = jnp.stack([_diffused(a, v, _EDGE_DEPTH) for a, v in zip(at.depth, vector.depth, strict=True)])
        smooth = jnp.asarray(self.smooth_brightness, root.dtype), jnp.asarray(self.smooth_depth, root.dtype)
        root = smooth[0] * divide(root, jnp.broadcast_to(unit, root.shape))
        return Sheets(root, smooth[1] * depth, jnp.zeros_like(vector.background))

    def _precondition(self, state, vector):
        energy, mean, damping = squared_derivatives(state.sheets), state.diagonal, _damping(state)
        root = mean[0] * (energy.root + energy.root.mean())
        # A knot has four neighbours.
        smooth = jnp.asarray(self.smooth_depth / _EDGE_DEPTH, energy.depth.dtype)
        depth = mean[1] * energy.depth + damping.depth + smooth
        later = _BRIGHTNESS_LATER
        return Sheets(
            later * divide(vector.root, root),
            divide(vector.depth, depth),
            later * divide(vector.background, mean[2] + damping.background),
        )


def volume_of(sheets, planes):
    """Linear shares of each sheet on the two planes about its depth: `(plane, y, x)`."""
    depth = jnp.clip(interpolated(sheets.depth, sheets.root.shape[1:]), 0, planes - 1)
    k = jnp.arange(planes, dtype=depth.dtype)[None, :, None, None]
    return (sheets.root[:, None] ** 2 * jnp.maximum(1 - jnp.abs(k - depth[:, None]), 0)).sum(0)


def hats(shape, knots, dtype):
    """Linear interpolation from knots, a matrix for each axis."""
    return tuple(hat_functions(n, count, dtype) for n, count in zip(shape, knots, strict=True))


def interpolated(depth, shape):
    """Depths at all columns from those at knots."""
    rows, columns = hats(shape, depth.shape[1:], depth.dtype)
    return jnp.einsum("yk,zkl,xl->zyx", rows, depth, columns)


def first_sheets(x, background, count):
    """Start of a fit, from free voxels `x`: depths about which the light is, and the light of a column."""
    planes, *shape = x.shape
    knots = [max(-(-n // _SPACING), 2) for n in shape]
    rows, columns = hats(shape, knots, x.dtype)
    unit = divide(x, jnp.broadcast_to(x.max(), x.shape))
    # Squared, because the background is in all planes.
    local = jnp.einsum("yk,zyx,xl->zkl", rows, unit**2, columns)
    local = widened(widened(local, 1), 2)
    local = local - (local.min(0) if planes > 2 else jnp.zeros_like(local[0]))[None]
    k = jnp.arange(planes, dtype=x.dtype)[:, None, None]
    # Where it is dark, the mean of all.
    faint = 0.05 * local.sum(0).mean() + jnp.finfo(x.dtype).tiny
    overall = divide((k * local).sum(), local.sum())
    if count == 1:
        depth = (((k * local).sum(0) + faint * overall) / (local.sum(0) + faint))[None]
    else:
        # Several sheets divide the planes among them (Lloyd's algorithm), first those of all columns together: where
        # there is one sheet only, the others must not share its light.
        spread = safe_sqrt(divide((local * (k - overall) ** 2).sum(), local.sum()))
        depth = overall + spread * jnp.asarray(np.linspace(-1, 1, count), x.dtype)[:, None, None]
        depth = _divided(local.sum((1, 2), keepdims=True), depth, 0.0)
        depth = _divided(local, jnp.broadcast_to(depth, (count, *local.shape[1:])), _ALIKE * local.sum(0).mean())
    bright = (nearest(k, interpolated(depth, tuple(shape))) * x[None]).sum(1)
    return Sheets(safe_sqrt(bright + _FAINT * bright.mean()), depth, background)


def _divided(light, depth, faint):
    """Mean depths of the light `(plane, y, x)` that is nearest to each sheet; those of faint columns hardly change."""
    k = jnp.arange(len(light), dtype=light.dtype)[:, None, None]

    def improved(_, depth):
        mine = nearest(k, depth) * light[None]
        return ((mine * k[None]).sum(1) + faint * depth) / (mine.sum(1) + faint + jnp.finfo(light.dtype).tiny)

    return lax.fori_loop(0, _LLOYD, improved, depth)


def widened(x, axis):
    """Binomial mean of three neighbours along an axis."""
    padded = jnp.pad(x, [(int(a == axis), int(a == axis)) for a in range(x.ndim)], mode="edge")
    first, middle, last = (lax.slice_in_dim(padded, i, i + x.shape[axis], axis=axis) for i in range(3))
    return (first + 2 * middle + last) / 4


def nearest(k, depth):
    """1 where a sheet is the nearest of a plane, else 0; ties are shared: `(sheet, plane, y, x)`."""
    away = jnp.abs(k[None] - depth[:, None])
    mine = (away <= away.min(0)[None]).astype(depth.dtype)
    return mine / mine.sum(0)[None]


def squared_derivatives(sheets):
    """Squares of the derivatives of the volume's voxels in each unknown."""
    rows, columns = hats(sheets.root.shape[1:], sheets.depth.shape[1:], sheets.root.dtype)
    depth = jnp.einsum("yk,zyx,xl->zkl", rows**2, sheets.root**4, columns**2)
    return Sheets(4 * sheets.root**2, depth, jnp.ones_like(sheets.background))


@partial(jax.jit, static_argnames=("count", "cold_start"))
def restarted(state: State, count: int, *, cold_start: bool) -> State:
    """State from which a fit of `count` sheets starts: from the voxels of Richardson-Lucy, or from the last sheets."""
    lucy = state.lucy
    sheets = first_sheets(lucy.x, lucy.knots, count) if cold_start else state.sheets
    # The steps overwrite their state.
    return jax.tree.map(jnp.copy, _state_before(_FIRST, lucy, sheets, state.inverse, state.errors))


def _state_before(number, lucy, sheets, inverse, errors):
    """State before a step of this number, without Hessian or change of the sheets."""
    none = jax.tree.map(jnp.zeros_like, sheets)
    diagonal, number = jnp.zeros(3, inverse.dtype), jnp.full((), number, jnp.int32)
    return State(lucy, sheets, none, none, none, diagonal, none.depth, inverse, errors, number)


def depth_of_sheets(state: State) -> tuple[Array, Array]:
    """Depths `(sheet, y, x)` and their standard deviations, in planes from the first."""
    depth = jnp.clip(interpolated(state.sheets.depth, state.sheets.root.shape[1:]), 0, state.lucy.x.shape[0] - 1)
    # Means over neighbours: four probes alone are noisy.
    rows, columns = (hats((n,), (max(n // 3, 2),), depth.dtype)[0] for n in state.information.shape[1:])
    means = lambda m: m / m.sum(0)[None]
    local = jnp.einsum("yk,zyx,xl->zkl", means(rows), jnp.maximum(state.information, 0) / _PROBES, means(columns))
    local = interpolated(local, state.sheets.root.shape[1:])
    return depth, divide(jnp.full_like(local, _UNDERSTATED), safe_sqrt(local))


def _damping(state):
    means = [_DAMPING * d * e.mean() for d, e in zip(state.diagonal, squared_derivatives(state.sheets), strict=True)]
    return Sheets(*(jnp.full(part.shape, d) for d, part in zip(means, state.sheets, strict=True)))


def _probe(state, following):
    """Random signs: the mean of their products with the Hessian's product is its diagonal."""
    root, depth, background = state.sheets
    keys = jax.random.split(jax.random.fold_in(jax.random.key(0), state.number))
    # As bright in the image as those of the depths.
    size = jnp.where(following == _GRADIENT, safe_sqrt(jnp.mean(root**2)) / 2, 0)
    sign = lambda key, part: jax.random.rademacher(key, part.shape, part.dtype)
    return Sheets(size * sign(keys[0], root), sign(keys[1], depth), jnp.zeros_like(background))


def _moved(state, change):
    root, depth, background = state.sheets
    change = jax.tree.map(lambda part: _SHARE * part, change)
    return Sheets(
        jnp.abs(root + jnp.clip(change.root, -root, root)),
        jnp.clip(depth + jnp.clip(change.depth, -_MAX_MOVE, _MAX_MOVE), 0, state.lucy.x.shape[0] - 1),
        background + change.background,
    )


def _diffused(at, vector, edge):
    length = magnitude(differences(at))
    weight = 1 / jnp.sqrt(length**2 + edge**2)
    return differences_adjoint(weight[None] * differences(vector))


def _add(a, b, length):
    return jax.tree.map(lambda x, y: x + length * y, a, b)


def _dot(a, b):
    return jnp.stack([jnp.vdot(x, y) for x, y in zip(a, b, strict=True)]).sum()
