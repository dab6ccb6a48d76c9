"""Plane layers in the light's path: filters, windows, cover slips, and the medium that holds the object.

A plane-parallel layer moves a ray sideways by `t tan(theta)`, whatever is before and behind it, so that the order of
layers counts for Fresnel losses alone. Near the axis a layer of thickness `t` and index `n` is as `t/n` of air, its
reduced thickness. Lengths are in millimetres.
"""

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .base.arrays import NOT_NEGATIVE, array_namespace, as_float, as_float_or_none, check_fields, one_program
from .lenses import INDEX
from .typing import Scalar, Scalars


class Layers(eqx.Module):
    """Plane-parallel layers on top of each other.

    *Differentiable.*

    Parameters
    ----------
    thickness, refractive_index
        Of each layer `(layer,)`, mm. A gap of air between two is a layer of index 1.

    Raises
    ------
    ValueError
        If the numbers of thicknesses and indices differ, a thickness is negative or an index below 1 (traced values
        are not checked).

    Examples
    --------
    >>> glass = gs.Layers([2.0, 0.5], [1.52, 1.0])
    >>> print(round(float(glass.shortening), 3))  # 2 mm - 2 mm / 1.52
    0.684
    """

    thickness: Float[Array, " layer"] = eqx.field(converter=as_float)
    refractive_index: Float[Array, " layer"] = eqx.field(converter=as_float)

    def __check_init__(self):
        if self.thickness.ndim != 1 or self.thickness.shape != self.refractive_index.shape:
            shapes = f"{self.thickness.shape} and {self.refractive_index.shape}"
            raise ValueError(f"`thickness` and `refractive_index` must be (layer,), got {shapes}.")
        check_fields(self, thickness=NOT_NEGATIVE, refractive_index=INDEX)

    @property
    @one_program
    def total(self) -> Scalar:
        """Thickness of all layers, mm."""
        return self.thickness.sum()

    @property
    @one_program
    def shortening(self) -> Scalar:
        """By how much the reduced thickness is below the thickness, `sum t (1 - 1/n)`, mm."""
        return (self.thickness * (1 - 1 / self.refractive_index)).sum()

    @property
    def slabs(self) -> list[tuple[Scalar, Scalar]]:
        """Thickness and index of each layer."""
        return list(zip(self.thickness, self.refractive_index, strict=True))


class Sample(eqx.Module):
    """The medium that holds the object, such as water or a gel.

    *Differentiable.*

    Parameters
    ----------
    refractive_index
        Of the medium.
    surface
        Depth at which the medium begins, from the array's front, mm. None, the default, is a medium in contact with
        what is in front of it: the layers on the array, or its plano face.
    layers
        Between the medium and the air, from the medium toward the array: a cover slip, the bottom of a dish. They end
        where the medium begins.

    Raises
    ------
    ValueError
        If the index is below 1 or the surface behind the array's front (traced values are not checked).

    Examples
    --------
    >>> import dataclasses
    >>> wet = dataclasses.replace(scope, sample=gs.Sample(1.43, surface=19.0))
    >>> print(round(float(wet.reduced_depth(21.0)), 3))  # 19 mm of air, 2 mm of gel, 1 mm of the plate
    21.098
    """

    refractive_index: Float[Array, ""] = eqx.field(converter=as_float)
    surface: Float[Array, ""] | None = eqx.field(converter=as_float_or_none, default=None)
    layers: Layers | None = None

    def __check_init__(self):
        check_fields(self, refractive_index=INDEX, surface=NOT_NEGATIVE)


def object_index(sample: Sample | None) -> Scalar | float:
    """Index of the object's medium: an object that moves by `dz` moves by `dz / index` of reduced depth."""
    return 1 if sample is None else sample.refractive_index


def object_surface(filters: Layers | None, sample: Sample | None) -> Scalar:
    """Depth at which the object's medium begins, mm; if that is air, where the filters end."""
    if sample is not None and sample.surface is not None:
        return sample.surface
    parts = filters, None if sample is None else sample.layers
    return sum(part.total for part in parts if part is not None)


def reduced_distance(depth: Scalars, filters: Layers | None, sample: Sample | None) -> Scalars:
    """Reduced distance from the array's front to a depth in the object's medium, mm."""
    reduced = depth if filters is None else depth - filters.shortening
    if sample is None:
        return reduced
    if sample.layers is not None:
        reduced = reduced - sample.layers.shortening
    return reduced - (depth - object_surface(filters, sample)) * (1 - 1 / sample.refractive_index)


def depth_of_reduced(reduced: Scalars, filters: Layers | None, sample: Sample | None) -> Scalars:
    """Depth in the object's medium at a reduced distance from the array's front, mm: inverts `reduced_distance`."""
    at_zero = reduced_distance(array_namespace(reduced).zeros((), reduced.dtype), filters, sample)
    return (reduced - at_zero) * object_index(sample)


def tilted_shortening(depth: Scalars, filters: Layers | None, sample: Sample | None) -> Scalars:
    """By how much layers that tilt with the array shorten the distance to a depth, `sum t (1 - 1/n)`, mm.

    These are the filters, and a sample in contact with them or the array; one with a surface of its own is level.
    """
    contact = sample if sample is not None and sample.surface is None else None
    return depth - reduced_distance(depth, filters, contact)


def tilted_index(sample: Sample | None) -> Scalar | float:
    """Index of the medium in front of a tilted array: that of a sample in contact, else 1, air.

    A lens that is higher by `h` has `h` less of it in front.
    """
    return 1 if sample is None or sample.surface is not None else sample.refractive_index


def check_room(
    sensor_distance: Scalar, filters: Layers | None, windows: Layers | None, sample: Sample | None, orientation: str
) -> None:
    """Raise `ValueError` unless layers fit where they are to be; traced values are not checked."""
    leaves = jax.tree.leaves((sensor_distance, filters, windows, sample))
    if not all(isinstance(leaf, Array | np.ndarray) and not isinstance(leaf, Tracer) for leaf in leaves):
        return
    # On the host: JAX would compile a sum for each shape.
    total = lambda *parts: float(sum(np.sum(np.asarray(part.thickness)) for part in parts if part is not None))
    needs = [("sensor_distance", float(sensor_distance), total(windows), "the windows are")]
    if sample is not None:
        front = total(filters, sample.layers)
        begins = front if sample.surface is None else float(sample.surface)
        needs.append(("surface", begins, front, "the layers in front of the medium are"))
        if orientation == "curved" and not begins and float(sample.refractive_index) != 1:
            raise ValueError("`sample` must begin beyond the lenses where their curved side is in front, got contact.")
    for name, found, needed, what in needs:
        # Less a rounding: what touches fits.
        if found < needed * (1 - 1e-6):
            raise ValueError(f"`{name}` must be {needed:.6g} mm, as thick as {what}, or more, got {found:.6g} mm.")


def layers_in_front(filters: Layers | None, sample: Sample | None) -> list[tuple[Scalar, Scalar]]:
    """Thickness and index of all between the array's front and the object's medium, from the array outward, mm.

    A sample with a surface has a gap of air before it, whose thickness may be 0.
    """
    front = [] if filters is None else filters.slabs
    if sample is None:
        return front
    cover = [] if sample.layers is None else sample.layers.slabs[::-1]
    gap = [] if sample.surface is None else [(sample.surface - sum(t for t, _ in (*front, *cover)), 1.0)]
    return [*front, *gap, *cover]


def object_slabs(depth: Scalars, filters: Layers | None, sample: Sample | None) -> list[tuple[Scalars, Scalar]]:
    """Thickness and index of what a ray crosses between the array and a depth that is not air, mm."""
    slabs = [] if filters is None else filters.slabs
    if sample is None:
        return slabs
    slabs = slabs + ([] if sample.layers is None else sample.layers.slabs)
    return [*slabs, (depth - object_surface(filters, sample), sample.refractive_index)]


def object_indices(filters: Layers | None, sample: Sample | None) -> list[Scalar]:
    """Indices that a ray meets from the object's medium, which comes first, to the array's front."""
    return [object_index(sample), *(index for _, index in reversed(layers_in_front(filters, sample)))]
