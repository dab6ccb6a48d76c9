"""Between a design's tables and the geometry: layers, sample and emission band, and the tables of an imager.

Tables of an imager are in the file's units, with the fewest decimals that reproduce its numbers.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from ..base.errors import InputError, short_repr
from ..microscope.geometry import Imager
from ..microscope.lenses import lenses_by_type
from ..microscope.media import EmissionBand, Layers, Sample, index_of, layers_in_front, object_surface, reduced_distance
from ..optics import theory
from ..optics.apertures import clear_diameter
from .tables import ImagingTable, LayerTable, SampleTable

# The names of no sample, and the table of none.
AIR, NO_SAMPLE = "air", SampleTable(refractive_index=1.0)
_NO_SAMPLE = (AIR, "none")


def layers_of(tables: Sequence[LayerTable], wavelength_nm: float) -> Layers | None:
    """Layers of tables, in their order; None without any."""
    if not tables:
        return None
    indices = [index_of(table.refractive_index, wavelength_nm) for table in tables]
    return Layers([table.thickness_mm for table in tables], indices)


def sample_of(table: SampleTable, wavelength_nm: float) -> Sample | None:
    """The sample of a table; None for air."""
    index = index_of(table.refractive_index, wavelength_nm)
    if index == 1 and not table.layers and table.surface_mm is None:
        return None
    # In files layers go outward, as those on the array; a `Sample` has them from the medium.
    return Sample(index, table.surface_mm, layers_of(table.layers[::-1], wavelength_nm))


def default_sample(design) -> SampleTable:
    """The table `[sample]`, or that of air: for checks, which have to choose."""
    return NO_SAMPLE if design.sample is None else design.sample


def sample_table(design, name: str | None) -> SampleTable:
    """The sample of a name, or the default one (None), as the file has it.

    Raises `InputError` if there is none of this name, or no default among several.
    """
    if name is None:
        if design.sample is None and design.samples:
            names = ", ".join(design.samples)
            raise InputError(
                "`sample` must be given (--sample NAME, or sample in a study): the design has no default [sample], "
                f"but [samples]: {names}; none stands for air."
            )
        return default_sample(design)
    if name not in (*_NO_SAMPLE, *design.samples):
        names = ", ".join([*design.samples, AIR])
        raise InputError(f"`sample` must be one of [samples] in the design, {names}, got {short_repr(name)}.")
    return NO_SAMPLE if name in _NO_SAMPLE else design.samples[name]


def format_medium(imager: Imager) -> str:
    """The medium of the object, and the layers between it and the array, as text."""
    sample, medium = imager.sample, "air"
    if sample is not None:
        medium = f"n = {float(sample.refractive_index):.4g} from z = {float(imager.sample_surface):.5g} mm"
    slabs = layers_in_front(imager.filters, sample)
    layers = [f"{float(t):g} mm of n = {float(n):g}" for t, n in slabs if float(n) != 1]
    return f"{medium}, behind {' and '.join(layers)}" if layers else medium


def reduced_depth(design, depth: float, index: float | None = None) -> float:
    """Reduced depth `z'` in the default sample, mm, of lenses of the design's index or another."""
    wavelength = design.imaging.wavelength_nm
    filters, sample = layers_of(design.layers.object, wavelength), sample_of(default_sample(design), wavelength)
    in_front = _plate(design, index) if design.lens.orientation == "plano" else 0.0
    return float(reduced_distance(depth, filters, sample)) + in_front


def reduced_sensor_distance(design, distance: float, index: float | None = None) -> float:
    """Reduced sensor distance `v'`, mm, of lenses of the design's index or another."""
    windows = layers_of(design.layers.sensor, design.imaging.wavelength_nm)
    behind = _plate(design, index) if design.lens.orientation == "curved" else 0.0
    return distance - (0.0 if windows is None else float(windows.shortening)) + behind


def object_begins(design) -> float:
    """Depth at which the default sample begins, or air beyond the filters, mm."""
    wavelength = design.imaging.wavelength_nm
    sample = sample_of(default_sample(design), wavelength)
    return float(f"{float(object_surface(layers_of(design.layers.object, wavelength), sample)):.9g}")


def format_path(design) -> list[str]:
    """Layers and sample, a line each."""
    lines = []
    for side, layers in (("in front", design.layers.object), ("on the sensor", design.layers.sensor)):
        slabs = [f"{layer.thickness_mm:g} mm of n = {layer.refractive_index!s}" for layer in layers]
        lines += [f"  {side}: {', '.join(slabs)}"] if slabs else []
    if (default := default_sample(design)) != NO_SAMPLE:
        lines.append(f"  objects in n = {default.refractive_index!s}, from z = {object_begins(design):g} mm")
    if design.samples:
        choice = " and no default" if design.sample is None else ""
        lines.append(f"  samples by name: {', '.join(design.samples)}{choice}")
    return lines


def check_path(design) -> None:
    """Raise `ValueError` unless the layers and samples have room, and their materials are known at the wavelength."""
    wavelength = design.imaging.wavelength_nm
    for key, material in _materials(design).items():
        try:
            index = index_of(material, wavelength)
        except InputError as error:
            raise ValueError(f"`imaging.wavelength_nm` and `{key}`: {str(error).removesuffix('.')}") from error
        if key == "lens.refractive_index" and not index > 1:
            raise ValueError(f'`lens.refractive_index` must be above 1, got "{material}"')
    for name in design.samples.keys() & _NO_SAMPLE:
        raise ValueError(f'`samples.{name}` must have another name: "{name}" is no sample')
    behind, v = _total(design.layers.sensor), design.imaging.sensor_distance_mm
    if behind > v:
        raise ValueError(f"`layers.sensor` must be at most `imaging.sensor_distance_mm`, {v:g} mm, got {behind:g} mm")
    _check_sample(design, "sample", default_sample(design))
    for name, table in design.samples.items():
        _check_sample(design, f"samples.{name}", table)
    start, working = object_begins(design), list(design.imaging.working_distance_mm)
    if working[1] <= start:
        allowed = f"beyond {start:g} mm, where layers end and the object's medium begins"
        raise ValueError(f"`imaging.working_distance_mm` must be {allowed}, got {working}")


def _check_sample(design, key: str, table: SampleTable) -> None:
    if sample_of(table, design.imaging.wavelength_nm) is None:
        return
    inside = _total(design.layers.object) + _total(table.layers)
    if table.surface_mm is not None and table.surface_mm < inside * (1 - 1e-9):
        parts = f"the thickness of `layers.object` and `{key}.layers`"
        raise ValueError(f"`{key}.surface_mm` must be {inside:g} mm or more, {parts}, got {table.surface_mm:g}")
    if design.lens.orientation == "curved" and not (table.surface_mm or inside):
        raise ValueError(f"`{key}.surface_mm` must be given with the curved side in front, got a sample in contact")


def _total(layers: Sequence[LayerTable]) -> float:
    return sum((layer.thickness_mm for layer in layers), 0.0)


def _plate(design, index: float | None) -> float:
    return design.array.substrate_thickness_mm / (design.refractive_index if index is None else index)


def _materials(design) -> dict[str, Any]:
    """All indices by their keys."""
    tables = {"sample": default_sample(design)} | {f"samples.{name}": table for name, table in design.samples.items()}
    lists = {"layers.object": design.layers.object, "layers.sensor": design.layers.sensor}
    lists |= {f"{key}.layers": table.layers for key, table in tables.items()}
    layers = {f"{key}[{i}]": layer for key, layers in lists.items() for i, layer in enumerate(layers)}
    tables = {"lens": design.lens} | tables | layers
    return {f"{key}.refractive_index": table.refractive_index for key, table in tables.items()}


# Wavelengths of an even band, by Gauss and Legendre, and of a spectrum.
_EVEN, _PARTS = 3, 5


def emission_band(design, sample: SampleTable | Sample) -> EmissionBand | None:
    """The band of a design and a sample, None for light of one wavelength. A `Sample` has no dispersion."""
    imaging, layers = design.imaging, design.layers
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
        lens=shifts(design.lens.refractive_index),
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
    bright = total > 0
    return means[bright] / total[bright], total[bright] / total.sum()


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


def tables_of(imager: Imager) -> dict[str, Any]:
    """All tables of an imager; it has no working distance."""
    array, sensor = imager.array, imager.sensor
    if array.size is None:
        raise InputError("`array.size` must be given: a design has a plate of finite size.")
    if imager.band is not None:
        raise InputError("`band` must be None: a design makes its own, of its materials and `imaging.bandwidth_nm`.")
    tilt = (0.0, 0.0) if imager.tilt is None else _scaled(np.degrees(np.arctan(np.asarray(imager.tilt))))
    focal_length = array.thin_lens_focal_length

    def of_lenses(name: str) -> Any:
        of_types = np.ravel(getattr(array, name))
        return _decimal(of_types[0] if (of_types == of_types[0]).all() else array.of_lenses(name))

    return {
        "sensor": {
            "pixel_pitch_um": _scaled(np.float64(1000 * sensor.pixel_pitch)),
            "shape": sensor.shape,
            "origin_mm": sensor.origin if any(sensor.origin) else None,
        },
        "lens": {
            "radius_of_curvature_mm": of_lenses("radius_of_curvature"),
            "refractive_index": _decimal(array.refractive_index),
            "aperture_diameter_mm": of_lenses("aperture_diameter"),
            "orientation": array.orientation,
            "conic_constant": of_lenses("conic_constant"),
            "aspheric_terms": _decimal(array.aspheric_terms),
            "focal_length_mm": None if focal_length is None else _decimal(focal_length),
        },
        "array": {
            "size_mm": _decimal(array.size),
            "substrate_thickness_mm": _decimal(array.substrate_thickness),
            "centers_mm": _decimal(array.centers),
        },
        "imaging": {
            "sensor_distance_mm": _decimal(imager.sensor_distance),
            "wavelength_nm": _scaled(1e6 * np.asarray(imager.wavelength)),
            "field_radius_mm": imager.field_radius,
        },
        "calibration": {
            "rotation_deg": _scaled(np.degrees(np.asarray(imager.rotation))),
            "shift_mm": _decimal(imager.shift),
            "tilt_deg": tilt,
        },
        "layers": {"object": _layers(imager.filters), "sensor": _layers(imager.windows)},
    } | ({} if imager.sample is None else {"sample": sample_tables(imager.sample)})


def _layers(layers: Layers | None) -> list[dict[str, float]]:
    if layers is None:
        return []
    numbers = zip(_decimal(layers.thickness), _decimal(layers.refractive_index), strict=True)
    return [{"thickness_mm": thickness, "refractive_index": index} for thickness, index in numbers]


def sample_tables(sample: Sample) -> dict[str, Any]:
    """The table of a sample."""
    return {
        "refractive_index": _decimal(sample.refractive_index),
        "surface_mm": None if sample.surface is None else _decimal(sample.surface),
        "layers": _layers(sample.layers)[::-1],
    }


def sharp_depths(imager: Imager) -> tuple[float, float]:
    """Nearest and farthest depth in focus for any lens type (Eq. 8), with a circle of confusion of two pixels, mm.

    Raises `InputError` if no depth is in focus, or the depth of field is infinite.
    """
    v, circle_of_confusion, ends = float(imager.reduced_sensor_distance), 2 * imager.sensor.pixel_pitch, []
    for which in lenses_by_type(imager.array):
        array = imager.array.subset(which)
        focal_length = float(array.focal_length)
        in_focus = 1 / focal_length - 1 / v
        if in_focus > 0:
            sharp = focal_length, focal_length / float(clear_diameter(array)), 1 / in_focus, circle_of_confusion
            ends += [float(limit(*sharp)) for limit in (theory.near_limit, theory.far_limit)]
    near, far = (float(imager.depth_of(np.asarray(end))) for end in (min(ends, default=0.0), max(ends, default=0.0)))
    near = max(near, float(imager.sample_surface))
    if not 0 < near < far < np.inf:
        why = "the sharp depths have no end" if ends and not far < np.inf else "no depth is in focus"
        raise InputError(f"working_distance_mm must be given as [nearest, farthest] in mm: {why}.")
    return round(near, 4), round(far, 4)


def _decimal(value: Any) -> Any:
    """Numbers, or lists of them, with the fewest decimals that reproduce them."""
    value = np.asarray(value)
    return [_decimal(inner) for inner in value] if value.ndim else float(str(value[()]))


def _scaled(value: Any) -> Any:
    """Numbers, or lists of them, without the last digits, which the change of units rounds."""
    digits = np.finfo(value.dtype).precision
    return [_scaled(inner) for inner in value] if value.ndim else float(f"{value:.{digits}g}")
