"""Search for the imager that a loss of your own is least for; studies are this with terms by name."""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from ..base.errors import InputError, short_repr
from ..geometry import Imager
from ..layers import check_room
from .parameters import Free
from .solve import CONVERGED, LBFGSB, NOT_FINITE, Bounds, Box, Solver, least_change, run, stepper


class Optimum(NamedTuple):
    """What `gs_jax.optimize` found.

    `imager`: the best. `value`: its loss, of residuals half the sum of their squares. `result`: of
    `optimistix.RESULTS`, whether the solver converged, ran out of steps, or came to what is not finite. `stats`:
    `"num_steps"`, and `"values"`, the loss after each.
    """

    imager: Imager
    value: Float[Array, ""]
    result: optx.RESULTS
    stats: dict[str, Any]


def optimize(
    loss: Callable[[Imager], Float[Array, "..."]],
    imager: Imager,
    *,
    free: Free,
    solver: Solver | None = None,
    bounds: Mapping[str, tuple[Any, Any]] = MappingProxyType({}),
    steps: int = 256,
    callback: Callable[[int, float, Imager], None] | None = None,
) -> Optimum:
    """Search for the imager of the least loss.

    *Host.*

    Parameters
    ----------
    loss
        From an imager to one number, or to an array of residuals, half the sum of whose squares is minimised.
        Traced and differentiated: `gs_jax.objectives` are made for it.
    imager
        To start from. Double precision (`jax_enable_x64`) finds a minimum to a billionth, single stops far from it.
    free
        What may change, of `gs_jax.free`.
    solver
        Of optimistix, a minimiser, or for residuals one of least squares; of optax, which runs all steps; or
        `gs_jax.codesign.solve.LBFGSB()`, which wants bounds for all. By default `optimistix.BFGS`.
    bounds
        Lowest and highest value by name, numbers or arrays. A change of variables keeps them. A start at a bound or
        beyond it is moved inside.
    steps
        The most to take.
    callback
        Called after each step with its number, the loss and the imager.

    Raises
    ------
    InputError
        If an argument is of another kind, a bound is of what is not free or is not below the other, `LBFGSB` lacks a
        bound, `loss` is one number and the solver is one of least squares, or layers have no room in the imager found.

    Examples
    --------
    >>> import gs_jax as gs, jax.numpy as jnp
    >>> scope = gs.geomscope().imager()
    >>> loss = lambda scope: (scope.magnification(20.0) - 0.25) ** 2
    >>> found = gs.optimize(loss, scope, free=gs.free("sensor_distance"), bounds={"sensor_distance": (4.0, 8.0)})
    >>> print(round(float(found.imager.magnification(20.0)), 2))
    0.25
    """
    solver = optx.BFGS(least_change(), least_change()) if solver is None else solver
    _check(imager, free, solver, steps)
    maps = {
        name: _map(name, free, bounds, isinstance(solver, LBFGSB)) for name in {**dict.fromkeys(free.names), **bounds}
    }
    values = free.values(imager)
    start = {name: maps[name].free(value) for name, value in values.items()}
    at = lambda moved: free.replaced(imager, {name: maps[name].value(moved[name]) for name in free.names})
    steps_of = stepper(lambda moved, given, key: loss(at(moved)), start, None, solver, jax.random.key(0))
    losses = []

    def after(state):
        losses.append(float(state.cost))
        if callback is not None:
            callback(int(state.step), losses[-1], at(state.free))

    state, reason = run(steps_of, steps_of.begin(start, None), None, limit=steps, enough=-math.inf, each=after)
    results = {CONVERGED: optx.RESULTS.successful, NOT_FINITE: optx.RESULTS.nonlinear_divergence}
    result = results.get(reason, optx.RESULTS.nonlinear_max_steps_reached)
    found = at(state.free)
    try:
        check_room(found.sensor_distance, found.filters, found.windows, found.sample, found.array.orientation)
    except ValueError as error:
        raise InputError(f"optimize: other bounds are needed: {error}") from error
    return Optimum(found, state.cost, result, {"num_steps": int(state.step), "values": np.array(losses)})


def _check(imager, free, solver, steps):
    for name, found, wanted, words in (
        ("imager", imager, Imager, "an Imager, as `design.imager()` is"),
        ("free", free, Free, "a Free, as `gs_jax.free` makes it"),
        ("solver", solver, Solver, "a solver of optimistix or optax, or LBFGSB()"),
    ):
        if not isinstance(found, wanted):
            raise InputError(f"{name} must be {words}, got {short_repr(found)}.")
    if steps < 1:
        raise InputError(f"steps must be 1 or more, got {steps}.")


class _Unbounded:
    """Values as they are."""

    value = free = staticmethod(lambda x: x)


def _map(name, free, bounds, box):
    if name not in free.names:
        raise InputError(f"bounds: names must be among the free ones, {', '.join(free.names)}, got {name}.")
    if name not in bounds:
        if box:
            raise InputError(f"bounds: LBFGSB needs bounds of all that is free, got none of {name}.")
        return _Unbounded
    low, high = (np.asarray(end, float) for end in bounds[name])
    if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
        raise InputError(f"bounds of {name} must be finite, the lower one first, got {low} to {high}.")
    return (Box if box else Bounds)(low, high)
