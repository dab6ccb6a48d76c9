"""An emission band as a few wavelengths, each with the refractive indices that it has."""

import equinox as eqx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .base.arrays import FINITE, NOT_NEGATIVE, POSITIVE, as_float, as_float_or_none, check_fields


class EmissionBand(eqx.Module):
    """Wavelengths that stand for an emission band, by their shares of the light that is detected.

    *Host.* Tables of PSFs are means over them; the map and what follows from it take the imager's own wavelength.

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
    >>> import gs_jax as gs
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
