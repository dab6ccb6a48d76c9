"""The emission band of a design as a few wavelengths, and the spectrum files that designs name."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from ..base.errors import InputError
from ..emission import EmissionBand
from ..io.point_tables import read_columns
from ..layers import Sample
from ..materials import index_of
from .tables import ImagingTable, LayersTable, LayerTable, LensTable, SampleTable

# Wavelengths of an even band, by Gauss and Legendre, and of a spectrum.
_EVEN, _PARTS = 3, 5
_MOST = 100_000


def emission_band(
    imaging: ImagingTable, lens: LensTable, layers: LayersTable, sample: SampleTable | Sample
) -> EmissionBand | None:
    """The band of a design's tables, None for light of one wavelength. A `Sample` has no dispersion."""
    if not imaging.bandwidth_nm and not imaging.spectrum_nm:
        return None
    wavelengths, weights = _lines(imaging)

    def shifts(material):
        middle = index_of(material, imaging.wavelength_nm)
        return [index_of(material, wavelength) - middle for wavelength in wavelengths]

    def of_layers(tables: Sequence[LayerTable]):
        return np.transpose([shifts(table.refractive_index) for table in tables]) if tables else None

    table = sample if isinstance(sample, SampleTable) else None
    return EmissionBand(
        weights,
        wavelengths / 1e6,
        lens=shifts(lens.refractive_index),
        filters=of_layers(layers.object),
        windows=of_layers(layers.sensor),
        sample=None if table is None else shifts(table.refractive_index),
        cover=None if table is None else of_layers(table.layers[::-1]),
    )


def _lines(imaging: ImagingTable) -> tuple[Float64[np.ndarray, " line"], Float64[np.ndarray, " line"]]:
    """Wavelengths, nm, and their shares of the light."""
    if imaging.bandwidth_nm:
        nodes, weights = np.polynomial.legendre.leggauss(_EVEN)
        return imaging.wavelength_nm + nodes * imaging.bandwidth_nm / 2, weights / 2
    wavelength, light = np.array(sorted(imaging.spectrum_nm)).T
    # Parts of equal light, each with its mean wavelength.
    grid = np.linspace(wavelength[0], wavelength[-1], 200 * _PARTS)
    density = np.interp(grid, wavelength, light)
    part = np.minimum(np.cumsum(density) / density.sum() * _PARTS, _PARTS - 1e-9).astype(int)
    total = np.bincount(part, density, _PARTS)
    means = np.bincount(part, density * grid, _PARTS)
    lit = total > 0
    return means[lit] / total[lit], total[lit] / total.sum()


def check_band(imaging: ImagingTable) -> None:
    """Raise `ValueError` unless the keys of the band fit together."""
    width, spectrum, middle = imaging.bandwidth_nm, imaging.spectrum_nm, imaging.wavelength_nm
    if width and spectrum:
        raise ValueError("only one of `imaging.bandwidth_nm` and `imaging.spectrum_nm` may be given")
    if width and not width < middle:
        raise ValueError(f"`imaging.bandwidth_nm` must be below `imaging.wavelength_nm`, {middle:g} nm, got {width:g}")
    if not spectrum:
        return
    wavelengths, light = np.array(spectrum).T
    if (count := len(set(wavelengths))) < 2 or count < len(wavelengths):
        got = f"{len(wavelengths)} of which {count} differ"
        raise ValueError(f"`imaging.spectrum_nm` must be two or more wavelengths, each once, got {got}")
    if not light.any():
        raise ValueError("`imaging.spectrum_nm` must have light at some wavelength, got none")
    if not min(wavelengths) <= middle <= max(wavelengths):
        ends = f"{min(wavelengths):g} to {max(wavelengths):g} nm, of the spectrum"
        raise ValueError(f"`imaging.wavelength_nm` must be within {ends}, got {middle:g}")


def inline_spectrum(path: Path, data: dict[str, Any]) -> None:
    """Replace, in the tables of the design file `path`, `imaging.spectrum_file` by `imaging.spectrum_nm`."""
    imaging = data.get("imaging")
    if not isinstance(imaging, dict) or "spectrum_file" not in imaging:
        return
    name = imaging.pop("spectrum_file")
    if not isinstance(name, str) or "spectrum_nm" in imaging:
        raise InputError(f"`imaging.spectrum_file` must be a file's name, without `imaging.spectrum_nm` ({path}).")
    try:
        rows = read_columns(path.parent / name, ("wavelength_nm", "light"), most=_MOST)
    except InputError as error:
        raise InputError(f"`imaging.spectrum_file`: {error} ({path})") from error
    imaging["spectrum_nm"] = rows.numbers.tolist()
