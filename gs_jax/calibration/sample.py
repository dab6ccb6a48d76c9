"""The sample of a calibration: its numbers by the names of `fit`, and whether they can be fitted and have been."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..base.errors import InputError
from ..design.conversion import default_sample, layers_of, sample_table, sample_tables
from ..design.design import Design
from ..geometry import Imager
from ..layers import Layers, object_surface
from ..materials import index_of

# Where the sample begins, mm, and its refractive index.
OF_SAMPLE = ("sample_at", "sample_index")


def number(imager: Imager, name: str) -> Any:
    """A number of the imager, or of its sample by a name of `OF_SAMPLE`."""
    sample: Any = imager.sample
    of_sample = {"sample_at": "surface", "sample_index": "refractive_index"}
    return getattr(sample, of_sample[name]) if name in of_sample else getattr(imager, name)


def with_surface(imager: Imager, fit: Sequence[str]) -> Imager:
    """The imager with a surface of its sample, if that is to be fitted: the layers behind the last gap of air are its.

    `InputError` if the imager has no sample, or one without such a gap.
    """
    wanted = [name for name in fit if name in OF_SAMPLE]
    if not wanted:
        return imager
    sample, filters = imager.sample, imager.filters
    if sample is None:
        raise InputError(f"fit: {wanted[0]} needs a microscope with a sample, got one in air.")
    if "sample_at" not in wanted or sample.surface is not None:
        return imager
    gaps = [] if filters is None else np.flatnonzero(np.asarray(filters.refractive_index) == 1)
    if filters is None or not len(gaps):
        raise InputError("fit: sample_at needs a sample behind a gap of air, got one in contact with what is there.")
    # Layers of a sample go from the medium to the array.
    behind = [*([] if sample.layers is None else sample.layers.slabs), *filters.slabs[: gaps[-1] : -1]]
    sample = dataclasses.replace(sample, surface=imager.sample_surface, layers=_layers(behind))
    return dataclasses.replace(imager, filters=_layers(filters.slabs[: gaps[-1]]), sample=sample)


def _layers(slabs) -> Layers | None:
    return Layers(*map(np.array, zip(*slabs, strict=True))) if slabs else None


def check_fitted_sample(imager: Imager) -> None:
    """`InputError` if a fit puts the sample's surface into the layers before it, or its index below that of air."""
    if (sample := imager.sample) is None:
        return
    least = float(object_surface(imager.filters, dataclasses.replace(sample, surface=None)))
    for name, value, lowest, unit in (
        ("sample_at", sample.surface, least, " mm, where the layers before it end,"),
        ("sample_index", sample.refractive_index, 1.0, ""),
    ):
        if value is not None and float(value) < lowest * (1 - 1e-6):
            needs = f"{name} must be {lowest:.6g}{unit} or more"
            raise InputError(f"captures: {needs}, got {float(value):.6g} as what fits the spots best; hold {name}.")


def with_sample(design: Design, imager: Imager, name: str | None) -> Design:
    """The design with the sample of an imager as `[sample]`, or as the one of `[samples]` with this name.

    What is named in the design, materials and layers, keeps its name where it has the same numbers. A fit of the
    surface may have made the device's layers behind the gap of air the sample's, with which they move.
    """
    sample, wavelength = imager.sample, 1e6 * float(imager.wavelength)
    before = default_sample(design) if name is None else sample_table(design, name)
    assert sample is not None
    found = sample_tables(sample)
    if np.isclose(index_of(before.refractive_index, wavelength), float(sample.refractive_index), rtol=1e-6):
        found["refractive_index"] = before.refractive_index
    if _alike(layers_of(before.layers[::-1], wavelength), sample.layers):
        found["layers"] = before.model_dump()["layers"]
    kept = design.layers.object[: 0 if imager.filters is None else len(imager.filters.thickness)]
    layers = design.layers.model_copy(update={"object": kept})
    if name in design.samples:
        return design.replace(layers=layers, samples={**design.samples, name: found})
    return design.replace(layers=layers, sample=found)


def _alike(one: Layers | None, other: Layers | None) -> bool:
    if one is None or other is None or len(one.thickness) != len(other.thickness):
        return False
    return np.allclose(np.array(one.slabs), np.array(other.slabs), rtol=1e-6)
