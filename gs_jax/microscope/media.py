"""Media in the light's path: refractive indices by name and wavelength, emission bands, plane layers and samples.

Indices are relative to air, as catalogues of glass list them. The formulas are published fits. Batches of a polymer
differ by more than the last digits: measure yours where that matters, and give the number.

A plane-parallel layer moves a ray sideways by `t tan(theta)`, whatever is before and behind it, so that the order of
layers counts for Fresnel losses alone. Near the axis a layer of thickness `t` and index `n` is as `t/n` of air, its
reduced thickness. Lengths are in millimetres.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..base.arrays import (
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    array_namespace,
    as_float,
    as_float_or_none,
    check_fields,
    one_program,
)
from ..base.errors import InputError, short_repr
from ..base.typing import Scalar, Scalars
from .lenses import INDEX


class Material(NamedTuple):
    """Index as a function of the wavelength in micrometres, and the wavelengths of its source, nm."""

    formula: Callable[[float], float]
    shortest: float
    longest: float


def _sellmeier(*terms: tuple[float, float]) -> Callable[[float], float]:
    """`n^2 = 1 + sum B L^2 / (L^2 - C)` of terms `(B, C)`, for a wavelength L in micrometres."""
    return lambda wavelength: math.sqrt(1 + sum(b * wavelength**2 / (wavelength**2 - c) for b, c in terms))


def _cauchy(terms: Sequence[float]) -> Callable[[float], float]:
    """`n = A + B / L^2 + C / L^4 + ...` for a wavelength L in micrometres."""
    return lambda wavelength: sum(term / wavelength ** (2 * power) for power, term in enumerate(terms))


MATERIALS = {
    "air": Material(lambda wavelength: 1.0, 0.0, math.inf),
    # Sylgard 184, 10:1: V. Gupta et al., ACS Appl. Mater. Interfaces 11, 28189 (2019). Our fit to their table, to 5e-7.
    # It gives 1.4114 at 589 nm; the data sheet of Sylgard 184 has 1.4118. The GEOMScope paper takes 1.43.
    "PDMS": Material(_cauchy((1.402892, 2.43441e-3, 1.83519e-4)), 300.0, 1200.0),
    # Both of N. Sultanova, S. Kasarova, I. Nikolov, Acta Phys. Pol. A 116, 585 (2009).
    "PMMA": Material(_sellmeier((1.1819, 0.011313)), 436.8, 1052.0),
    "polystyrene": Material(_sellmeier((1.4435, 0.020216)), 436.8, 1052.0),
    # N-BK7: catalogue of Schott.
    "BK7": Material(
        _sellmeier((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)), 300.0, 2500.0
    ),
    # I. H. Malitson, J. Opt. Soc. Am. 55, 1205 (1965).
    "fused silica": Material(
        _sellmeier((0.6961663, 0.0684043**2), (0.4079426, 0.1162414**2), (0.8974794, 9.896161**2)), 210.0, 3710.0
    ),
    # At 20 degrees Celsius: M. Daimon, A. Masumura, Appl. Opt. 46, 3811 (2007).
    "water": Material(
        _sellmeier(
            (0.5684027565, 0.005101829712),
            (0.1726177391, 0.01821153936),
            (0.02086189578, 0.02620722293),
            (0.1130748688, 10.69792721),
        ),
        182.0,
        1129.0,
    ),
}


def refractive_index(material: str, wavelength_nm: float) -> float:
    """The refractive index of a material, relative to air.

    *Host.*

    Parameters
    ----------
    material
        "PDMS", "PMMA", "polystyrene", "BK7" (N-BK7), "fused silica", "water" or "air".
    wavelength_nm
        In air, nm.

    Raises
    ------
    InputError
        If there is no such material, or its source does not cover the wavelength.

    Examples
    --------
    >>> round(gs.refractive_index("BK7", 587.6), 4), round(gs.refractive_index("PDMS", 520.0), 4)
    (1.5168, 1.4144)
    """
    if material not in MATERIALS:
        raise InputError(f"`material` must be one of {', '.join(MATERIALS)}, got {short_repr(material)}.")
    formula, shortest, longest = MATERIALS[material]
    if not shortest <= wavelength_nm <= longest:
        raise InputError(
            f"the wavelength must be {shortest:g} to {longest:g} nm for the index of {material}, got {wavelength_nm:g}."
        )
    return formula(wavelength_nm / 1000)


def index_of(material: float | str, wavelength_nm: float) -> float:
    """An index as it is, or that of a material."""
    return refractive_index(material, wavelength_nm) if isinstance(material, str) else material


class EmissionBand(eqx.Module):
    """Wavelengths that stand for an emission band, by their shares of the light that is detected.

    *Host.*

    Tables of PSFs are means over them; the map and what follows from it take the imager's own wavelength.

    Parameters
    ----------
    weights
        Share of the light of each wavelength `(line,)`; they add up to 1.
    wavelengths
        `(line,)`, mm.
    lens, filters, windows, sample, cover
        How far the refractive index of the lenses `(line,)`, of the layers `(line, layer)` and of the object's medium
        `(line,)` is above that at the imager's wavelength. None where there is no such part, or no dispersion.

    Raises
    ------
    ValueError
        If the numbers are not one for each wavelength, or out of range, or the weights do not add up to 1 (traced
        values are not checked).

    Examples
    --------
    >>> band = gs.EmissionBand([0.25, 0.5, 0.25], [505e-6, 520e-6, 535e-6], lens=[0.0008, 0.0, -0.0008])
    >>> len(band)
    3
    >>> gs.geomscope().replace(bandwidth_nm=40.0, refractive_index="PDMS").imager().band.wavelengths.shape
    (3,)
    """

    weights: Float[Array, " line"] = eqx.field(converter=as_float)
    wavelengths: Float[Array, " line"] = eqx.field(converter=as_float)
    lens: Float[Array, " line"] | None = eqx.field(converter=as_float_or_none, default=None)
    filters: Float[Array, "line layer"] | None = eqx.field(converter=as_float_or_none, default=None)
    windows: Float[Array, "line layer"] | None = eqx.field(converter=as_float_or_none, default=None)
    sample: Float[Array, " line"] | None = eqx.field(converter=as_float_or_none, default=None)
    cover: Float[Array, "line layer"] | None = eqx.field(converter=as_float_or_none, default=None)

    def __check_init__(self):
        count = self.weights.shape
        for name in ("wavelengths", "lens", "filters", "windows", "sample", "cover"):
            if (value := getattr(self, name)) is not None and value.shape[:1] != count:
                raise ValueError(f"`{name}` must have a row for each of {count[0]} wavelengths, got {value.shape}.")
        check_fields(self, weights=NOT_NEGATIVE, wavelengths=POSITIVE, lens=FINITE, sample=FINITE)
        if not isinstance(self.weights, Tracer) and abs((total := float(np.sum(self.weights))) - 1) > 1e-3:
            raise ValueError(f"`weights` must add up to 1, got {total:.6g}.")

    def __len__(self) -> int:
        return len(self.weights)


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
