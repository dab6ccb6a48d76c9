"""Conditions under which an imager is evaluated, its clear aperture, and quantities of several lens types."""

import dataclasses
import inspect
import math
from collections.abc import Callable, Sequence
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..base.arrays import POSITIVE, as_float, as_float_or_none, check_fields, safe_sqrt
from ..base.errors import check_kind, input_error, short_repr
from ..microscope.geometry import Imager
from ..optics.apertures import clear_diameter as diameter_of, clear_diameters

# Width of the paper's voxels, mm.
DETAIL = 0.04
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
        Electrons that each mm^2 of clear aperture, 20 mm away in air, would collect without losses from an emitter of
        40 um x 40 um.
    detail
        Width of the voxels of the scenes that `volume_error` and `volume_bound` are for, mm; objects in them are five
        quarters of that wide.
    directions
        Number of directions in which the edge of a clear aperture is computed, where lenses differ.
    clear_diameter
        Clear diameter of the lenses, mm, where it is known; computed from the imager by default.
    field_radius
        `sqrt(A_e / pi)`, mm, in place of the imager's own, which decides shapes and cannot be traced. `volume_error`
        counts all lenses, whatever it is.
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
    detail: Float[Array, ""] = eqx.field(converter=as_float, default=DETAIL)
    directions: int = eqx.field(static=True, default=512)
    clear_diameter: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    field_radius: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    height: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    lenses: Bool[Array, " lens"] | None = None

    def __check_init__(self):
        if self.depths.ndim != 1:
            raise ValueError(f"`depths` must be (depth,), got {self.depths.shape}.")
        lengths = {name: POSITIVE for name in ("depths", "circle_of_confusion", "detail", "field_radius")}
        check_fields(self, exposure=POSITIVE, **lengths)

    @property
    def middle(self) -> "Conditions":
        """The same at the middle of the depths alone."""
        return dataclasses.replace(self, depths=(self.depths[:1] + self.depths[-1:]) / 2)


Depths = Conditions | Float[ArrayLike, " depth"] | Sequence[float]


def as_conditions(imager: Imager, depths: Depths) -> Conditions:
    """Depths as `Conditions`, in the imager's precision."""
    check_kind("imager", imager, Imager, "an Imager, as `design.imager()` is")
    dtype = imager.sensor_distance.dtype
    if not isinstance(depths, Conditions):
        if any(isinstance(leaf, Array) for leaf in jax.tree.leaves(depths)):
            return Conditions(jnp.asarray(depths, dtype))
        numbers = np.asarray(depths)
        if numbers.dtype.kind not in "iuf":
            raise input_error("depths", "real lengths, mm, or Conditions", short_repr(depths))
        # An array on the host: JAX would compile a conversion for each number of depths.
        return Conditions(jnp.asarray(numbers.astype(dtype), dtype))
    if depths.depths.dtype == dtype:
        return depths
    return jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, depths)


def per_type(imager: Imager, depths: Depths) -> list[tuple[Imager, Conditions]]:
    """The imager with the numbers of each lens type, and the conditions with its clear diameter and its `lenses`."""
    at, array = as_conditions(imager, depths), imager.array
    if array.alike:
        return [(imager, at)]
    return _per_type(imager, at, _clear_diameters(array, at.directions))


@eqx.filter_jit
def _per_type(imager, at, diameters):
    array, types = imager.array, jnp.asarray(imager.array.type_of_lens)

    def with_array(array):
        return eqx.tree_at(lambda i: i.array, imager, array)

    return [
        (
            with_array(array.of_type(number)),
            dataclasses.replace(at, clear_diameter=diameters[number], lenses=types == number),
        )
        for number in range(array.type_count)
    ]


# The arguments of a quantity: an imager, depths or `Conditions`, and what is the same for all types.
P = ParamSpec("P")
Result = TypeVar("Result")


def by_type(function: Callable[P, Result]) -> Callable[P, Result]:
    """Extend a quantity of lenses that are alike to several types, one row each, and compile it."""
    return _of_types(function, None)


def best_type(function: Callable[P, Result], *, best: Callable[..., Array] = jnp.argmin) -> Callable[P, Result]:
    """Extend a quantity of lenses that are alike to several types, the best one at each depth, and compile it."""
    return _of_types(function, best)


def _of_types(function: Callable[..., Any], best: Callable[..., Array] | None) -> Any:
    # The wrapped function has the names and the defaults of the arguments.
    signature = inspect.signature(function)

    @wraps(function)
    def of_all(*args, **options):
        bound = signature.bind(*args, **options)
        bound.apply_defaults()
        imager, depths, *others = bound.args
        parts = per_type(imager, depths)
        if imager.array.alike:
            # By a program of its own, as it takes longest to compile, and all objectives need it.
            parts = [with_clear_diameter(*parts[0])]
        types = None if imager.array.alike else len(parts)
        return _evaluate(function, best, types, _typical_lenses(parts), others)

    return of_all


@eqx.filter_jit
def _typical_lenses(parts: list[tuple[Imager, Conditions]]) -> list[tuple[Imager, Conditions]]:
    """A lens of each type, at a few heights if the array is tilted, and the conditions that it has among the others.

    Nothing else depends on the number of lenses, so that all objectives have one program for arrays of any size.
    """
    return [_alone(*lens) for part in parts for lens in _at_heights(*part)]


def with_clear_diameter(imager: Imager, at: Conditions) -> tuple[Imager, Conditions]:
    """An imager, and conditions that have its clear diameter."""
    if at.clear_diameter is not None:
        return imager, at
    return imager, dataclasses.replace(at, clear_diameter=clear_diameter(imager, at))


def _alone(imager: Imager, at: Conditions) -> tuple[Imager, Conditions]:
    """A lens alone, with what decides shapes of other quantities left out."""
    sensor = dataclasses.replace(imager.sensor, shape=(2, 2), origin=(0.0, 0.0))
    alone = dataclasses.replace(imager, array=imager.array.lens(0), sensor=sensor)
    return alone, dataclasses.replace(at, lenses=None, directions=1)


@eqx.filter_jit
def _evaluate(function, best, types: int | None, lenses: list[tuple[Imager, Conditions]], others: list):
    """Mean over the heights of the quantities of each type: the only one's, a row each, or the best one's."""

    def of_lens(imager, at):
        return function(imager, at, *others)

    if len(lenses) == 1:
        values = jax.tree.map(lambda value: value[None, None], of_lens(*lenses[0]))
    else:
        stacked = jax.tree.map(lambda *each: jnp.stack(each), *lenses)
        values = jax.tree.map(lambda x: x.reshape(types or 1, -1, *x.shape[1:]), jax.vmap(of_lens)(*stacked))

    def over_types(value):
        value = value[:, 0] if value.shape[1] == 1 else jax.vmap(_mean_of_heights)(value)
        if types is None:
            return value[0]
        return value if best is None else jnp.take_along_axis(value, best(value, axis=0, keepdims=True), 0)[0]

    return jax.tree.map(over_types, values)


def whole_array(function: Callable[P, Result], *, aperture: bool = False) -> Callable[P, Result]:
    """Compile a quantity of all lenses together; with `aperture` one that depends on their clear diameter."""
    signature, compiled = inspect.signature(function), eqx.filter_jit(cast(Any, function))

    @wraps(function)
    def of_array(*args: P.args, **options: P.kwargs) -> Result:
        bound = signature.bind(*args, **options)
        bound.apply_defaults()
        imager, *depths = bound.args
        at = [as_conditions(imager, own) for own in depths]
        return compiled(*with_clear_diameter(imager, *at)) if aperture else compiled(imager, *at)

    return of_array


# Heights of the lenses of a tilted array, in standard deviations, and their weights: exact for polynomials up to the
# fifth power where heights are spread evenly.
_HEIGHTS, _SHARES = np.array([-1, 0, 1]) * math.sqrt(9 / 5), np.array([5, 8, 5]) / 18


def _at_heights(imager: Imager, at: Conditions) -> list[tuple[Imager, Conditions]]:
    """Level imagers, and their conditions, at a few heights of the lenses of a tilted array."""
    if imager.tilt is None:
        return [(imager, at)]
    own = imager.heights
    mean = lambda values: jnp.mean(values, where=True if at.lenses is None else at.lenses)
    middle = mean(own)
    spread = safe_sqrt(mean((own - middle) ** 2))
    heights = [middle + spread * jnp.asarray(number, own.dtype) for number in _HEIGHTS]
    return [(imager.at_height(h), dataclasses.replace(at, depths=at.depths - h, height=h)) for h in heights]


def _mean_of_heights(values):
    """Mean over the first axis."""
    return jnp.tensordot(jnp.asarray(_SHARES, values.dtype), values, 1)


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
        return _mean_diameter(array)
    return _root_mean_square(_clear_diameters(array, at.directions), array.type_of_lens)


_mean_diameter = jax.jit(diameter_of)


@partial(jax.jit, static_argnums=1)
def _clear_diameters(array, directions):
    return clear_diameters(array, directions=directions)


@jax.jit
def _root_mean_square(values, types):
    return jnp.sqrt(jnp.mean(values[types] ** 2))


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
