"""Microlenses on a plate, and the shape of their surface. Lengths are in millimetres."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from ..base.arrays import (
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    Rule,
    array_namespace,
    as_float,
    as_float_or_none,
    check_fields,
    one_program,
)
from ..base.errors import InputError
from ..base.typing import Scalar, Scalars

# The side of the lenses that faces the object.
Orientation = Literal["plano", "curved"]
# Numbers that may differ between lenses.
EACH = ("radius_of_curvature", "aperture_diameter", "conic_constant")
INDEX: Rule = ("1 or more and finite", lambda x: (x >= 1) & (x < np.inf))


def _as_plate(x):
    size = as_float_or_none(x)
    # That a plate is infinite is part of the structure, which compiled code knows.
    return None if size is None or (not isinstance(size, Tracer) and np.isinf(size).all()) else size


def _as_types(x):
    # An array on the host: JAX would compile a conversion for each number of lenses.
    return x if x is None or isinstance(x, Array) else jax.device_put(np.asarray(x))


def _at(values, index):
    """Some entries of an array; on the host if they are known, as JAX compiles programs to index each shape."""
    if isinstance(values, Tracer) or isinstance(index, Tracer):
        return jnp.asarray(values)[index]
    entries = np.asarray(values)[np.asarray(index)]
    return entries if isinstance(values, np.ndarray) else jax.device_put(entries)


class MicrolensArray(eqx.Module):
    """Plano-convex microlenses on one plate, their vertices in one plane.

    *Differentiable.*

    A surface is a conic with even polynomial terms: it falls `c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + A_4 r^4 + ...`
    below its vertex, `c = 1/R` (ISO 10110-12).

    Parameters
    ----------
    centers
        Lens vertices `(lens, 2)` in the array's own frame, mm.
    radius_of_curvature, aperture_diameter
        One number for all lenses, or one for each, mm. The aperture is nominal: overlapping lenses are truncated where
        their surfaces intersect, which for identical lenses is the Voronoi edge.
    refractive_index, substrate_thickness
        Index of lenses and plate; distance from the plate's plano face to the vertices, mm.
    thin_lens_focal_length
        Overrides the focal length that follows from the radius, mm, for a thin-lens study.
    size
        `(x, y)` of the centred plate, mm, which truncates the outer lenses. None, the default, is an infinite plate.
    orientation
        The side of the lenses that faces the object, `"plano"` or `"curved"`.
    conic_constant
        `k`: 0 of a sphere, -1 of a paraboloid, between these of an ellipsoid. One for all lenses, or one for each.
    aspheric_terms
        `(term,)`: A_4, A_6, ..., in mm^-3, mm^-5, ....
    others
        Lenses on the same plate that are not imaged through, but end these where their surfaces meet; see `subset`.
    types
        The type of each lens, `(lens,)`, from 0 on, where lenses differ: numbers are then `(type,)`. Without it numbers
        of each lens `(lens,)` are sorted into types of equal lenses. Numbers that JAX traces have no values to compare:
        every lens is then a type of its own, unless `types` is given.

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite or out of range (traced values are not checked), or the orientation
        does not exist.

    Examples
    --------
    >>> array = gs.MicrolensArray([[0.0, 0.0], [1.2, 0.0]], radius_of_curvature=2.0, refractive_index=1.43)
    >>> print(round(float(array.focal_length), 2))  # R / (n - 1), mm
    4.65
    """

    centers: Float[Array, "lens 2"] = eqx.field(converter=as_float)
    radius_of_curvature: Float[Array, "*type"] = eqx.field(converter=as_float, default=2.0)
    refractive_index: Float[Array, ""] = eqx.field(converter=as_float, default=1.43)
    aperture_diameter: Float[Array, "*type"] = eqx.field(converter=as_float, default=2.0)
    substrate_thickness: Float[Array, ""] = eqx.field(converter=as_float, default=1.0)
    thin_lens_focal_length: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    size: Float[Array, "2"] | None = eqx.field(converter=_as_plate, default=None)
    orientation: Orientation = eqx.field(static=True, default="plano")
    conic_constant: Float[Array, "*type"] = eqx.field(converter=as_float, default=0.0)
    aspheric_terms: Float[Array, " term"] = eqx.field(converter=as_float, default=())
    others: "MicrolensArray | None" = None
    types: Int[Array, " lens"] | None = eqx.field(converter=_as_types, default=None)

    def __post_init__(self):
        numbers = {name: as_float(getattr(self, name)) for name in EACH}
        own = [name for name in EACH if numbers[name].ndim]
        if not own:
            self.types = None
        is_sorted = self.types is not None or any(isinstance(number, Tracer) for number in numbers.values())
        if is_sorted or {numbers[name].shape for name in own} != {np.shape(self.centers)[:1]}:
            return
        types, first = _sorted_types([np.asarray(number) for number in numbers.values()])
        if len(first) == len(types):
            return
        self.types = _as_types(types) if len(first) > 1 else None
        for name in own:
            values = np.asarray(numbers[name])[first if len(first) > 1 else 0]
            setattr(self, name, jnp.asarray(values, numbers[name].dtype))

    def __check_init__(self):
        if self.centers.ndim != 2 or self.centers.shape[1] != 2 or self.centers.shape[0] < 1:
            raise ValueError(f"`centers` must be (lens, 2) with a lens at least, got {self.centers.shape}.")
        lenses = self.centers.shape[0]
        expected = (lenses if self.types is None else self.type_count,)
        for name in EACH:
            if (shape := getattr(self, name).shape) not in ((), expected):
                raise ValueError(f"`{name}` must be one number or {expected}, got {shape}.")
        if self.types is not None:
            _check_types(self.types, lenses, *expected)
        if self.size is not None and self.size.shape != (2,):
            raise ValueError(f"`size` must be (x, y), got {self.size.shape}.")
        if self.orientation not in ("plano", "curved"):
            raise ValueError(f"`orientation` must be 'plano' or 'curved', got {self.orientation!r}.")
        check_fields(self, radius_of_curvature=POSITIVE, aperture_diameter=POSITIVE, thin_lens_focal_length=POSITIVE)
        check_fields(self, refractive_index=INDEX, substrate_thickness=NOT_NEGATIVE, size=POSITIVE)
        check_fields(self, centers=FINITE, conic_constant=FINITE, aspheric_terms=FINITE)

    @property
    def half_plate(self) -> Scalars:
        """Half the plate's `(x, y)`, infinite without `size`, in the precision of the centres."""
        if self.size is None:
            return array_namespace(self.centers).full(2, math.inf, self.centers.dtype)
        return (self.size / 2).astype(self.centers.dtype)

    @property
    def plate(self) -> tuple[float, float]:
        """The plate's `(x, y)` as plain numbers, infinite without `size`. Host code."""
        if self.size is None:
            return math.inf, math.inf
        x, y = np.asarray(self.size, float).tolist()
        return x, y

    @property
    def alike(self) -> bool:
        """Whether all lenses have the same numbers, which are scalars then."""
        return not self._own

    @property
    def type_count(self) -> int:
        """Number of lens types."""
        return max(getattr(self, name).size for name in EACH)

    @property
    def type_of_lens(self) -> Int[Array | np.ndarray, " lens"]:
        """The type of each lens, from 0 on."""
        if self.types is not None:
            return self.types
        count = len(self.centers)
        return np.zeros(count, int) if self.alike else np.arange(count)

    def of_lenses(self, name: str) -> Scalars:
        """A number of each lens `(lens,)`: its radius of curvature, aperture diameter, conic constant, ...."""
        value, xp = getattr(self, name), array_namespace(self.centers)
        return _at(value, self.type_of_lens) if value.ndim else xp.broadcast_to(value, len(self.centers))

    def check_alike(self) -> None:
        """Raise `InputError` unless all lenses are alike."""
        if not self.alike:
            differ = ", ".join(self._own)
            raise InputError(f"Lenses must be alike, got lenses that differ in {differ}; `lens(k)` is one of them.")

    def lens(self, index: int) -> "MicrolensArray":
        """One of the lenses alone, on the same plate."""
        return self._alike(_at(self.centers, np.array([index])), _at(self.type_of_lens, index))

    def of_type(self, number: int) -> "MicrolensArray":
        """All lenses, with the numbers of one type."""
        return self._alike(self.centers, number)

    def subset(self, which: Sequence[int] | Int[np.ndarray, " kept"]) -> "MicrolensArray":
        """Lenses that are alike, such as those of a type, as an array whose `others` are the rest."""
        which = np.array(which)
        rest = np.setdiff1d(np.arange(len(self.centers)), which)
        numbers = {name: _at(self.of_lenses(name), rest) for name in self._own} | {"centers": _at(self.centers, rest)}
        others = dataclasses.replace(self, types=None, **numbers) if rest.size else None
        return self._alike(_at(self.centers, which), _at(self.type_of_lens, which[0]), others)

    @property
    def whole(self) -> "MicrolensArray":
        """These lenses and the others as one array."""
        if self.others is None:
            return self
        both, xp = (self, self.others), array_namespace(self.centers)
        numbers = {name: xp.concatenate([part.of_lenses(name) for part in both]) for name in EACH}
        centers = xp.concatenate([part.centers for part in both])
        return dataclasses.replace(self, centers=centers, others=None, types=None, **numbers)

    @property
    def _own(self) -> list[str]:
        """Names of the numbers in which lenses differ."""
        return [name for name in EACH if getattr(self, name).ndim]

    def _alike(self, centers, number, others=None) -> "MicrolensArray":
        """Lenses of one type."""
        numbers = {name: _at(getattr(self, name), number) for name in self._own}
        return dataclasses.replace(self, centers=centers, others=others, types=None, **numbers)

    @property
    def focal_length(self) -> Scalars:
        """Focal length in air, `R / (n - 1)` for a plano-convex lens, mm; of each type where lenses differ."""
        if self.thin_lens_focal_length is None:
            return self.radius_of_curvature / (self.refractive_index - 1)
        return self.thin_lens_focal_length

    @property
    @one_program
    def reduced_thickness_front(self) -> Scalar:
        """Reduced thickness `t/n` of the plate in front of the vertices, mm; 0 if the curved side is in front."""
        reduced = self.substrate_thickness / self.refractive_index
        return reduced if self.orientation == "plano" else 0 * reduced

    @property
    @one_program
    def reduced_thickness_back(self) -> Scalar:
        """Reduced thickness `t/n` of the plate behind the vertices, mm."""
        return self.substrate_thickness / self.refractive_index - self.reduced_thickness_front

    @property
    @one_program
    def departure(self) -> Scalar:
        """Coefficient of `r^4` in the departure from a sphere, `k / (8 R^3) + A_4`, 1/mm^3."""
        departure = self.conic_constant / (8 * self.radius_of_curvature**3)
        return departure + self.aspheric_terms[0] if self.aspheric_terms.size else departure

    def reaches(self, squared_radius: Scalars) -> Scalars:
        """Whether the surface exists at a squared distance from the axis, mm^2: a conic may end."""
        return (1 + self.conic_constant) * squared_radius < self.radius_of_curvature**2

    def sag(self, squared_radius: Scalars) -> Scalars:
        """Depth of the surface below its vertex, mm, where it `reaches`."""
        return sag(squared_radius, *self._shape)

    def sag_slope_over_r(self, squared_radius: Scalars) -> Scalars:
        """Slope of the surface over the radius, `s'(r) / r`, 1/mm, finite on the axis."""
        return sag_slope_over_r(squared_radius, *self._shape)

    @property
    def _shape(self):
        return self.radius_of_curvature, self.conic_constant, self.aspheric_terms


def lenses_by_type(array: MicrolensArray) -> tuple[tuple[int, ...], ...]:
    """Indices of the lenses of each type. Host code."""
    types = np.asarray(array.type_of_lens)
    return tuple(tuple(np.flatnonzero(types == number).tolist()) for number in range(array.type_count))


def _sorted_types(numbers: Sequence[np.ndarray]) -> tuple[Int[np.ndarray, " lens"], Int[np.ndarray, " type"]]:
    """The type of each lens, and the first lens of each type; types are in the order of these."""
    of_lens = np.stack(np.broadcast_arrays(*numbers), -1)
    _, first, same = np.unique(of_lens, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return np.argsort(order)[same.ravel()], first[order]


def _check_types(types, lenses: int, count: int) -> None:
    if types.shape != (lenses,) or not np.issubdtype(types.dtype, np.integer):
        raise ValueError(f"`types` must be an integer for each of {lenses} lenses, got {types.dtype} {types.shape}.")
    if count >= lenses:
        raise ValueError(f"`types` must be None with a number of each lens, and numbers be of each type, got {count}.")
    if not isinstance(types, Tracer) and not np.array_equal(np.unique(types), np.arange(count)):
        raise ValueError(f"`types` must have all numbers from 0 to {count - 1}, got {np.unique(types).tolist()}.")


def sag(
    squared_radius: Scalars, radius_of_curvature: Scalar, conic_constant: Scalar, terms: Iterable[Scalar]
) -> Scalars:
    """Of `MicrolensArray`'s surface, mm."""
    total = squared_radius / (radius_of_curvature + _root(squared_radius, radius_of_curvature, conic_constant))
    for order, term in enumerate(terms, 2):
        total = total + term * squared_radius**order
    return total


def sag_slope_over_r(
    squared_radius: Scalars, radius_of_curvature: Scalar, conic_constant: Scalar, terms: Iterable[Scalar]
) -> Scalars:
    """Of `MicrolensArray`'s surface, 1/mm."""
    total = 1 / _root(squared_radius, radius_of_curvature, conic_constant)
    for order, term in enumerate(terms, 2):
        total = total + 2 * order * term * squared_radius ** (order - 1)
    return total


def _root(squared_radius, radius_of_curvature, conic_constant):
    root2 = radius_of_curvature**2 - (1 + conic_constant) * squared_radius
    return array_namespace(squared_radius).sqrt(root2)
