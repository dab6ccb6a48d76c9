"""Refractive indices of materials by name and wavelength, relative to air, as catalogues of glass list them; bands.

The formulas are published fits. Batches of a polymer differ by more than the last digits: measure yours where that
matters, and give the number.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .base.arrays import FINITE, NOT_NEGATIVE, POSITIVE, as_float, as_float_or_none, check_fields
from .base.errors import InputError, short_repr


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
    # N. Sultanova, S. Kasarova, I. Nikolov, Acta Phys. Pol. A 116, 585 (2009).
    "PMMA": Material(_sellmeier((1.1819, 0.011313)), 436.8, 1052.0),
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
        "PDMS", "PMMA", "BK7" (N-BK7), "fused silica", "water" or "air".
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
