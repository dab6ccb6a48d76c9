"""Design tables of an imager: in the file's units, with the fewest decimals that reproduce its numbers."""

from typing import Any

import numpy as np

from ..base.errors import InputError
from ..geometry import Imager
from ..layers import Layers, Sample
from ..lenses import lenses_by_type
from ..optics import theory
from ..optics.apertures import clear_diameter


def tables_of(imager: Imager) -> dict[str, Any]:
    """All tables of an imager; it has no working distance."""
    array, sensor = imager.array, imager.sensor
    if array.size is None:
        raise InputError("`array.size` must be given: a design has a plate of finite size.")
    if imager.band is not None:
        raise InputError("`band` must be None: a design makes its own, of its materials and `imaging.bandwidth_nm`.")
    tilt = (0.0, 0.0) if imager.tilt is None else _scaled(np.degrees(np.arctan(np.asarray(imager.tilt))))
    focal_length = array.thin_lens_focal_length
    return {
        "sensor": {
            "pixel_pitch_um": _scaled(np.float64(1000 * sensor.pixel_pitch)),
            "shape": sensor.shape,
            "origin_mm": sensor.origin if any(sensor.origin) else None,
        },
        "lens": {
            "radius_of_curvature_mm": _decimal(array.radius_of_curvature),
            "refractive_index": _decimal(array.refractive_index),
            "aperture_diameter_mm": _decimal(array.aperture_diameter),
            "orientation": array.orientation,
            "conic_constant": _decimal(array.conic_constant),
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
    return [_decimal(part) for part in value] if value.ndim else float(str(value[()]))


def _scaled(value: Any) -> Any:
    """Numbers, or lists of them, without the last digits, which the change of units rounds."""
    digits = np.finfo(value.dtype).precision
    return [_scaled(part) for part in value] if value.ndim else float(f"{value:.{digits}g}")
