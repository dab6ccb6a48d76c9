"""Conditions under which an imager is evaluated, its clear aperture, and quantities of several lens types."""

import dataclasses
import inspect
import math
from collections.abc import Callable, Sequence
from functools import partial, wraps
from typing import ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..base.arrays import POSITIVE, as_float, as_float_or_none, check_fields, safe_sqrt
from ..geometry import Imager
from ..optics.apertures import VoronoiCells, clear_diameter as diameter_of, clear_diameters

# Heights over the field at which a lens is evaluated.
_FIELDS = 4


class Conditions(eqx.Module):
    """The depths at which an imager is evaluated, and constants that do not follow from the imager.

    *Differentiable.*

    Parameters
    ----------
    depths
        From the array's front, `(depth,)`, mm.
    circle_of_confusion
        Diameter of the circle of confusion, mm; two pixels by default.
    exposure
        Electrons that a mm^2 of clear aperture collects from an emitter of 40 um x 40 um, 20 mm away in air.
    largest_magnification
        An upper bound of all magnifications, for windows whose shape may not depend on traced numbers.
    directions
        Number of directions in which the edge of a clear aperture is computed, where lenses differ.
    cells
        Voronoi neighbours of each lens, where lenses are alike and keep them: a clear aperture is computed a hundred
        times faster.
    clear_diameter
        Clear diameter of the lenses, mm, where it is known; computed from the imager by default.
    field_radius
        `sqrt(A_e / pi)`, mm, in place of the imager's own, which decides shapes and cannot be traced.
    height
        Of lenses of a tilted array that are evaluated as a level one, mm: depths are less by it, and sensor distances
        more. None, the default, is 0.
    lenses
        Which of the lenses count, those of a type; all by default.

    Raises
    ------
    ValueError
        If `depths` is not `(depth,)`, or a length is not positive and finite.
    """

    depths: Float[Array, " depth"] = eqx.field(converter=as_float)
    circle_of_confusion: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    exposure: Float[Array, ""] = eqx.field(converter=as_float, default=1e4)
    largest_magnification: float = eqx.field(static=True, default=math.inf)
    directions: int = eqx.field(static=True, default=512)
    cells: VoronoiCells | None = None
    clear_diameter: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    field_radius: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    height: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    lenses: Bool[Array, " lens"] | None = None

    def __check_init__(self):
        if self.depths.ndim != 1:
            raise ValueError(f"`depths` must be (depth,), got {self.depths.shape}.")
        check_fields(self, depths=POSITIVE, circle_of_confusion=POSITIVE, exposure=POSITIVE, field_radius=POSITIVE)

    @property
    def middle(self) -> "Conditions":
        """The same at the middle of the depths alone."""
        return dataclasses.replace(self, depths=(self.depths[:1] + self.depths[-1:]) / 2)


Depths = Conditions | Float[ArrayLike, " depth"] | Sequence[float]


def as_conditions(imager: Imager, depths: Depths) -> Conditions:
    """Depths as `Conditions`, in the imager's precision."""
    dtype = imager.sensor_distance.dtype
    if not isinstance(depths, Conditions):
        return Conditions(jnp.asarray(depths, dtype))
    if depths.depths.dtype == dtype:
        return depths
    return jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, depths)


def per_type(imager: Imager, depths: Depths) -> list[tuple[Imager, Conditions]]:
    """The imager with the numbers of each lens type, and the conditions with its clear diameter and its `lenses`."""
    at, array = as_conditions(imager, depths), imager.array
    if array.alike:
        return [(imager, at)]
    types, diameters = jnp.asarray(array.type_of_lens), _clear_diameters(array, at.directions)
    with_array = lambda array: eqx.tree_at(lambda i: i.array, imager, array)
    return [
        (
            with_array(array.of_type(number)),
            dataclasses.replace(at, cells=None, clear_diameter=diameters[number], lenses=types == number),
        )
        for number in range(array.type_count)
    ]


# The arguments of a quantity: an imager, depths or `Conditions`, and what is the same for all types.
P = ParamSpec("P")
Tree = TypeVar("Tree")


def by_type(function: Callable[P, Array]) -> Callable[P, Array]:
    """Extend a quantity of lenses that are alike to several types: one row each."""

    @wraps(function)
    def of_all(*args: P.args, **options: P.kwargs) -> Array:
        return _of_types(function, args, options)[0]

    return of_all


def best_type(function: Callable[P, Array], *, best: Callable[..., Array] = jnp.argmin) -> Callable[P, Array]:
    """Extend a quantity of lenses that are alike to several types: the value of the best type at each depth."""

    @wraps(function)
    def of_best(*args: P.args, **options: P.kwargs) -> Array:
        values, several = _of_types(function, args, options)
        return jnp.take_along_axis(values, best(values, axis=0, keepdims=True), 0)[0] if several else values

    return of_best


# Heights of the lenses of a tilted array, in standard deviations, and their weights: exact for polynomials up to the
# fifth power where heights are spread evenly.
_HEIGHTS, _SHARES = np.array([-1, 0, 1]) * math.sqrt(9 / 5), np.array([5, 8, 5]) / 18


def over_heights(function: Callable[[Imager, Conditions], Tree]) -> Callable[[Imager, Conditions], Tree]:
    """Extend quantities of lenses that are alike to a tilted array: the mean over the heights of the lenses.

    It is infinite if the quantity is at one of them.
    """

    @wraps(function)
    def mean(imager: Imager, at: Conditions) -> Tree:
        parts = _at_heights(imager, at)
        return function(*parts[0]) if len(parts) == 1 else jax.tree.map(_mean_of_heights, _map(function, parts))

    return mean


def _at_heights(imager: Imager, at: Conditions) -> list[tuple[Imager, Conditions]]:
    """Level imagers, and their conditions, at a few heights of the lenses of a tilted array."""
    if imager.tilt is None:
        return [(imager, at)]
    if at.clear_diameter is None:
        at = dataclasses.replace(at, clear_diameter=clear_diameter(imager, at))
    own = imager.heights
    mean = lambda values: jnp.mean(values, where=True if at.lenses is None else at.lenses)
    middle = mean(own)
    spread = safe_sqrt(mean((own - middle) ** 2))
    heights = [middle + spread * jnp.asarray(number, own.dtype) for number in _HEIGHTS]
    return [(imager.at_height(h), dataclasses.replace(at, depths=at.depths - h, height=h)) for h in heights]


def _map(function, parts):
    """The function of imagers and conditions of one structure, as one program."""
    return jax.vmap(function)(*jax.tree.map(lambda *each: jnp.stack(each), *parts))


def _mean_of_heights(values):
    """Mean over the first axis."""
    return jnp.tensordot(jnp.asarray(_SHARES, values.dtype), values, 1)


def _of_types(function, args, options) -> tuple[Array, bool]:
    """The value, and False; or a row for each of several types, and True."""
    # The wrapped function has the names and the defaults of the arguments.
    bound = inspect.signature(function).bind(*args, **options)
    bound.apply_defaults()
    imager, depths, *others = bound.args
    parts = per_type(imager, depths)
    of_type = lambda one, at: function(one, at, *others)
    if len(parts) == 1:
        return over_heights(of_type)(*parts[0]), False
    # What is asked of a type does not depend on its lenses' places: one program serves any number of types.
    at_heights = [part for one in parts for part in _at_heights(*one)]
    values = _map(of_type, [(eqx.tree_at(lambda i: i.array, one, one.array.lens(0)), at) for one, at in at_heights])
    values = values.reshape(len(parts), -1, *values.shape[1:])
    return (values[:, 0] if imager.tilt is None else jax.vmap(_mean_of_heights)(values)), True


def of_lenses(imager: Imager, values: Float[Array, "..."]) -> Float[Array, "lens ..."]:
    """A row for each lens of what `by_type` functions return."""
    array = imager.array
    return jnp.broadcast_to(values, (len(array.centers), *values.shape)) if array.alike else values[array.type_of_lens]


def clear_diameter(imager: Imager, depths: Depths = (1.0,)) -> Float[Array, ""]:
    """Diameter of the disc whose area is the mean clear aperture of all lenses."""
    at, array = as_conditions(imager, depths), imager.array
    if at.clear_diameter is not None:
        return at.clear_diameter
    if array.alike:
        return _mean_diameter(array, at.cells)
    return jnp.sqrt(jnp.mean(_clear_diameters(array, at.directions)[array.type_of_lens] ** 2))


_mean_diameter = jax.jit(lambda array, cells: diameter_of(array, cells=cells))


@partial(jax.jit, static_argnums=1)
def _clear_diameters(array, directions):
    return clear_diameters(array, directions=directions)


def field_heights(imager: Imager, at: Conditions) -> Float[Array, " field"]:
    """Heights beside a lens's axis at which it is evaluated: the middles of four rings of equal area."""
    rings = (np.arange(_FIELDS) + 0.5) / _FIELDS
    return field_radius(imager, at) * jnp.sqrt(jnp.asarray(rings, imager.sensor_distance.dtype))


def finite_plate(imager: Imager) -> Float[Array, "2"]:
    """Size of the plate; `ValueError` if it is infinite, where lenses have no density."""
    if imager.array.size is None:
        raise ValueError("`imager.array.size` must be given: the lenses of an infinite plate have no density.")
    return 2 * imager.array.half_plate


def field_radius(imager: Imager, at: Conditions) -> Float[Array, ""]:
    """The field radius of the conditions, or the imager's."""
    if at.field_radius is not None:
        return at.field_radius
    return jnp.asarray(imager.field_radius, imager.sensor_distance.dtype)
