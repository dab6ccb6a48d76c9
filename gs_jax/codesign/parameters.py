"""The parameters of a co-design: what of an imager, and of its depths, a study may free.

`evaluated` gives the imager of a design and its `Conditions`, `start_values` their parameters by name, `candidate` the
imager and conditions of other values, differentiable in all of them, and `new_design` a design file's. Names carry the
unit of the study file, and so do the values here: all are mm but the index, the conic constant and the aspheric terms
A_4, A_6, ..., in mm^-3, mm^-5, .... Where lenses differ, radius, aperture and conic constant are one value a lens type,
in the order of their first lenses; the type of each lens stays.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64
from pydantic import ValidationError

from ..base.errors import InputError
from ..design.centers import LENS_KEYS
from ..design.design import Design
from ..design.light_path import reduced_depth, reduced_sensor_distance
from ..geometry import Imager
from ..io.toml import one_line
from ..lenses import EACH, type_of_lens
from ..objectives.conditions import Conditions
from ..optics.apertures import pitch, voronoi_cells

Values = dict[str, Float[Array, "..."]]

NAMES = (
    "sensor_distance_mm",
    "radius_of_curvature_mm",
    "aperture_diameter_mm",
    "refractive_index",
    "conic_constant",
    "aspheric_terms",
    "pitch_mm",
    "centers_mm",
    "depth_span_mm",
)

# Aspheric terms of a lens without any, where they are free.
_TERMS = 2
# Digits of a written length: 0.1 um is finer than a printer, and than a camera's mount.
_DIGITS = 4
# Significant digits of numbers that are no length, as many as float32 has: of a term of the surface picometres of sag.
_SIGNIFICANT = 7
# Of lenses that differ: enough for the mean clear aperture of a type to 1e-3, an eighth of the work of all.
_EDGES = 64


def evaluated(
    design: Design,
    *,
    depths_mm: tuple[float, float] | None = None,
    circle_of_confusion: float | None = None,
    depth_count: int = 6,
    exposure: float = 1e4,
    free: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> tuple[Imager, Conditions]:
    """The imager of a design and the conditions under which a search evaluates it.

    Parameters
    ----------
    depths_mm
        Nearest and farthest depth; by default the design's working distance.
    circle_of_confusion
        Diameter of the circle of confusion, mm; two pixels by default.
    depth_count
        Depths between them, both included.
    exposure
        As of `Conditions`.
    free
        Bounds of the parameters that will be replaced. Free lens centres take longer.
    """
    near, far = depths_mm or design.imaging.working_distance_mm
    imager = design.imager()
    dtype = imager.sensor_distance.dtype
    fixed = imager.array.alike and "centers_mm" not in free
    if "aspheric_terms" in free and not imager.array.aspheric_terms.size:
        imager = eqx.tree_at(lambda i: i.array.aspheric_terms, imager, jnp.zeros(_TERMS, dtype))
    at = Conditions(
        depths_between(jnp.asarray((near + far) / 2, dtype), jnp.asarray(far - near, dtype), depth_count),
        circle_of_confusion,
        exposure=exposure,
        largest_magnification=_largest_magnification(design, near, far, free),
        directions=_EDGES,
        cells=voronoi_cells(np.array(design.array.centers_mm), design.array.size_mm) if fixed else None,
    )
    return imager, at


def depths_between(middle: Float[Array, ""], span: Float[Array, ""], count: int) -> Float[Array, " depth"]:
    """Evenly spaced depths about a middle, mm."""
    return middle + span * jnp.linspace(-0.5, 0.5, count, dtype=middle.dtype)


def _largest_magnification(design: Design, near: float, far: float, free: Mapping[str, tuple[float, float]]) -> float:
    """`v'/z'` (Eq. 3) with the farthest sensor, nearest depth and highest index, of the design and of the bounds."""
    most = lambda name, own: max(own, free.get(name, (own, own))[1])
    least = lambda name, own: min(own, free.get(name, (own, own))[0])
    # Of an index that is free the one that makes it largest: the plate is in front, or behind.
    in_front = design.lens.orientation == "plano"
    index = (most if in_front else least)("refractive_index", design.refractive_index)
    nearest = (near + far - most("depth_span_mm", far - near)) / 2
    distance = most("sensor_distance_mm", design.imaging.sensor_distance_mm)
    return reduced_sensor_distance(design, distance, index) / reduced_depth(design, nearest, index)


def start_values(imager: Imager, at: Conditions) -> Values:
    """Every parameter by name. Of lenses that differ, radius, aperture and conic constant have one value a type."""
    array = imager.array
    first = np.unique(type_of_lens(array), return_index=True)[1]
    numbers = [getattr(array, name) for name in EACH]
    if len(first) > 1:
        # A number that all types share may differ between them in a search.
        numbers = [jnp.broadcast_to(number, len(array.centers))[first] for number in numbers]
    radius, diameter, conic = numbers
    return {
        "sensor_distance_mm": imager.sensor_distance,
        "radius_of_curvature_mm": radius,
        "aperture_diameter_mm": diameter,
        "refractive_index": array.refractive_index,
        "conic_constant": conic,
        "aspheric_terms": array.aspheric_terms,
        "pitch_mm": _pitch(imager),
        "centers_mm": array.centers,
        "depth_span_mm": at.depths[-1] - at.depths[0],
    }


def _pitch(imager: Imager) -> Float[Array, ""]:
    """Mean distance of nearest neighbours; 1 for a single lens."""
    centers = imager.array.centers
    return pitch(centers)[0] if len(centers) > 1 else jnp.ones((), centers.dtype)


def candidate(imager: Imager, at: Conditions, values: Values) -> tuple[Imager, Conditions]:
    """An imager and its conditions with some parameters replaced; differentiable in all of them.

    Parameters
    ----------
    values
        By name, any subset of `NAMES`. A pitch scales the pattern and the plate about the middle; `centers_mm` are the
        centres before that, and the imager's own if `at` has `cells`.
    """
    values = start_values(imager, at) | values
    scale = values["pitch_mm"] / _pitch(imager)
    replaced = {
        "centers": scale * values["centers_mm"],
        "size": None if imager.array.size is None else scale * imager.array.size,
        "refractive_index": values["refractive_index"],
        "aspheric_terms": values["aspheric_terms"],
        **{name: of_lenses(imager, values[key]) for name, key in zip(EACH, LENS_KEYS, strict=True)},
    }
    array = dataclasses.replace(imager.array, **replaced)
    depths = depths_between(at.middle.depths[0], values["depth_span_mm"], at.depths.size)
    imager = dataclasses.replace(imager, array=array, sensor_distance=values["sensor_distance_mm"])
    return imager, dataclasses.replace(at, depths=depths)


def of_lenses(imager: Imager, value: Float[Array, "..."]) -> Float[Array, "..."]:
    """A value for each lens, given one for each type; a single number stays."""
    return value if value.ndim == 0 else value[type_of_lens(imager.array)]


def new_design(design: Design, imager: Imager, at: Conditions, values: Values) -> Design:
    """The design of these values as a file holds it: the working distance is the one that was asked for.

    Lengths and the refractive index are to four decimals (0.1 um), conics and aspheric terms to seven significant
    digits.

    Raises `InputError` if the values make no microscope.
    """
    values = start_values(imager, at) | values
    shared = ("sensor_distance_mm", "refractive_index", "depth_span_mm")
    numbers = {name: round(float(values[name]), _DIGITS) for name in shared}
    scale = float(values["pitch_mm"] / _pitch(imager))
    size = [round(scale * side, _DIGITS) for side in design.array.size_mm]
    # Rounding may not push a lens off the plate.
    half = np.array(size) / 2
    centers = np.clip(np.round(scale * np.asarray(values["centers_mm"], float), _DIGITS), -half, half)
    middle = float(at.depths[0] + at.depths[-1]) / 2
    working = [round(middle + sign * numbers["depth_span_mm"] / 2, _DIGITS) for sign in (-1, 1)]
    data = design.model_dump()
    data["lens"] |= {name: _of_lenses_rounded(imager, name, values[name]) for name in LENS_KEYS}
    # A material stays unless its index was searched for.
    if not isinstance(design.lens.refractive_index, str) or values["refractive_index"] != imager.array.refractive_index:
        data["lens"] |= {"refractive_index": numbers["refractive_index"]}
    data["lens"] |= {"aspheric_terms": significant(values["aspheric_terms"]).tolist()}
    data["array"] |= {"size_mm": size, "centers_mm": centers.tolist()}
    data["imaging"] |= {"sensor_distance_mm": numbers["sensor_distance_mm"], "working_distance_mm": working}
    try:
        return Design.model_validate(data)
    except ValidationError as error:
        raise InputError(f"the values found make no microscope: {one_line(error, Design, {})}.") from error


def significant(value: Float[Array, "..."]) -> Float64[np.ndarray, "..."]:
    """Numbers to seven significant digits."""
    numbers = np.asarray(value, float)
    return np.array([float(f"{number:.{_SIGNIFICANT}g}") for number in numbers.flat]).reshape(numbers.shape)


def _of_lenses_rounded(imager: Imager, name: str, value: Float[Array, "..."]) -> float | list[float]:
    """One number if all types come to the same."""
    numbers = of_lenses(imager, value)
    numbers = np.round(np.asarray(numbers, float), _DIGITS) if name.endswith("_mm") else significant(numbers)
    return numbers.tolist() if np.ptp(numbers) else float(numbers.flat[0])
