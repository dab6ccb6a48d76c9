"""The imager at each wavelength of its emission band."""

import equinox as eqx

from ..geometry import Imager
from ..typing import Scalar


def emission_lines(imager: Imager) -> list[tuple[Scalar, Imager]]:
    """Share of the light and imager of each wavelength of the band; without a band, the imager itself."""
    band, parts = imager.band, _dispersive(imager)
    if band is None:
        return [(1.0, imager)]
    for part, shift in parts:
        if shift.shape[1:] != part.refractive_index.shape:
            shape = *shift.shape[:1], *part.refractive_index.shape
            raise ValueError(f"`band` must have {shape} refractive indices of a part of the imager, got {shift.shape}.")

    def line(k):
        indices = [part.refractive_index + shift[k] for part, shift in parts]
        places = lambda i: [i.band, i.wavelength, *(part.refractive_index for part, _ in _dispersive(i))]
        return eqx.tree_at(places, imager, [None, band.wavelengths[k], *indices])

    return [(band.weights[k], line(k)) for k in range(len(band))]


def _dispersive(imager: Imager) -> list:
    """Parts of an imager whose index depends on the wavelength, and their shifts."""
    band, sample = imager.band, imager.sample
    if band is None:
        return []
    cover = None if sample is None else sample.layers
    parts = imager.array, imager.filters, imager.windows, sample, cover
    shifts = band.lens, band.filters, band.windows, band.sample, band.cover
    return [(part, shift) for part, shift in zip(parts, shifts, strict=True) if part is not None and shift is not None]
