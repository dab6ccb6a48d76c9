"""What of a microscope is free in a co-design, and between which bounds.

A `Parent` is the design that an optimisation starts from, `start_values` are its parameters by name, and `candidate`
is the microscope of other values: everything that an objective needs, differentiable in all of them. `new_design`
goes back to a file. Names carry the unit of the study file, and so do the values here: all are mm but the index, the
conic constant and the aspheric terms A_4, A_6, ..., in mm^-3, mm^-5, .... Of lenses that differ, radius, aperture and
conic constant are a value for each type, in the order of their first lenses; which lens is of which type stays.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64
from pydantic import ValidationError

from ..base.arrays import as_float
from ..base.errors import InputError
from ..design.centers import LENS_KEYS
from ..design.checks import plate_as_air
from ..design.design import Design
from ..design.microscope import Microscope
from ..geometry import Imager
from ..io.toml import one_line
from ..lenses import EACH, lenses_by_type, type_of_lens
from ..optics.apertures import VoronoiCells, pitch, voronoi_cells

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


class Parent(eqx.Module):
    """A design with what its file does not say: where it is judged.

    `cells`: of its lenses, None if they may move or differ. `lenses`: which are of each type. `pitch`: mean distance
    of nearest neighbours, mm; 1 for one lens. `middle`, `span`: of the depths that count, from the plate, mm.
    `depth_count`: how many they are. `circle_of_confusion`: mm. `exposure`: as of a `Microscope`.
    """

    imager: Imager
    cells: VoronoiCells | None
    pitch: Float[Array, ""] = eqx.field(converter=as_float)
    middle: Float[Array, ""] = eqx.field(converter=as_float)
    span: Float[Array, ""] = eqx.field(converter=as_float)
    circle_of_confusion: Float[Array, ""] = eqx.field(converter=as_float)
    depth_count: int = eqx.field(static=True)
    largest_magnification: float = eqx.field(static=True)
    exposure: float = eqx.field(static=True)
    lenses: tuple[tuple[int, ...], ...] = eqx.field(static=True)


def parent_of(
    design: Design,
    *,
    depths_mm: tuple[float, float] | None = None,
    circle_of_confusion: float | None = None,
    depth_count: int = 6,
    exposure: float = 1e4,
    free: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> Parent:
    """A design as an optimisation sees it.

    Parameters
    ----------
    depths_mm
        Nearest and farthest depth that count; by default the design's working distance.
    circle_of_confusion
        Diameter of the circle of confusion, mm; by default two pixels.
    depth_count
        Depths between them, both included.
    exposure
        Electrons that a mm^2 of clear aperture, 20 mm away, gets of a lit place of 40 um x 40 um.
    free
        Between which bounds parameters will be replaced. Lens centres that may move take longer.
    """
    near, far = depths_mm or design.imaging.working_distance_mm
    imager = design.imager()
    stays = imager.array.alike and "centers_mm" not in free
    if "aspheric_terms" in free and not imager.array.aspheric_terms.size:
        none = jnp.zeros(_TERMS, imager.sensor_distance.dtype)
        imager = eqx.tree_at(lambda i: i.array.aspheric_terms, imager, none)
    return Parent(
        imager,
        voronoi_cells(np.array(design.array.centers_mm), design.array.size_mm) if stays else None,
        pitch(imager.array.centers)[0] if len(design.array.centers_mm) > 1 else 1.0,
        (near + far) / 2,
        far - near,
        2 * imager.sensor.pixel_pitch if circle_of_confusion is None else circle_of_confusion,
        depth_count,
        _largest_magnification(design, near, far, free),
        exposure,
        lenses_by_type(imager.array),
    )


def _largest_magnification(design: Design, near: float, far: float, free: Mapping[str, tuple[float, float]]) -> float:
    """`v'/z'` (Eq. 3) with the farthest sensor, nearest depth and highest index, of the design and of the bounds."""
    most = lambda name, own: max(own, free.get(name, (own, own))[1])
    least = lambda name, own: min(own, free.get(name, (own, own))[0])
    # Of an index that is free the one that makes it largest: the plate is in front, or behind.
    in_front = design.lens.orientation == "plano"
    index = (most if in_front else least)("refractive_index", design.lens.refractive_index)
    front, back = plate_as_air(design.array.substrate_thickness_mm, index, design.lens.orientation)
    nearest = (near + far - most("depth_span_mm", far - near)) / 2
    distance = most("sensor_distance_mm", design.imaging.sensor_distance_mm)
    return (distance + back) / (nearest + front)


def start_values(parent: Parent) -> Values:
    """Every parameter of the parent, by name."""
    array = parent.imager.array
    if len(parent.lenses) > 1:
        first, count = np.array([which[0] for which in parent.lenses]), len(array.centers)
        numbers = {name: jnp.broadcast_to(getattr(array, name), count)[first] for name in EACH}
        array = dataclasses.replace(array, centers=array.centers[first], **numbers)
    return {
        "sensor_distance_mm": parent.imager.sensor_distance,
        "radius_of_curvature_mm": array.radius_of_curvature,
        "aperture_diameter_mm": array.aperture_diameter,
        "refractive_index": array.refractive_index,
        "conic_constant": array.conic_constant,
        "aspheric_terms": array.aspheric_terms,
        "pitch_mm": parent.pitch,
        "centers_mm": parent.imager.array.centers,
        "depth_span_mm": parent.span,
    }


def candidate(parent: Parent, values: Values) -> Microscope:
    """The parent with some of its parameters replaced; differentiable in all of them.

    Parameters
    ----------
    values
        By name, any subset of `NAMES`. A pitch scales the pattern and the plate about the middle, by its ratio to the
        parent's; `centers_mm` are the centres before that, and the parent's own if it has `cells`.
    """
    values = start_values(parent) | values
    scale = values["pitch_mm"] / parent.pitch
    where = lambda i: (
        i.array.centers,
        i.array.radius_of_curvature,
        i.array.aperture_diameter,
        i.array.conic_constant,
        i.array.refractive_index,
        i.array.aspheric_terms,
        i.sensor_distance,
    )
    radius, diameter, conic = (of_lenses(parent, values[name]) for name in LENS_KEYS)
    terms, others = values["aspheric_terms"], (values["refractive_index"], values["sensor_distance_mm"])
    numbers = (scale * values["centers_mm"], radius, diameter, conic, others[0], terms, others[1])
    imager = eqx.tree_at(where, parent.imager, numbers)
    offsets = jnp.linspace(-0.5, 0.5, parent.depth_count, dtype=scale.dtype)
    return Microscope(
        imager,
        parent.middle + values["depth_span_mm"] * offsets,
        field_radius=jnp.array(imager.field_radius, scale.dtype),
        circle_of_confusion=parent.circle_of_confusion,
        plate_scale=scale,
        largest_magnification=parent.largest_magnification,
        exposure=parent.exposure,
        cells=parent.cells,
        directions=_EDGES,
        lenses=parent.lenses if len(parent.lenses) > 1 else (),
    )


def of_lenses(parent: Parent, value: Float[Array, "..."]) -> Float[Array, "..."]:
    """A value for each lens, of one for each type; one of all lenses stays."""
    if value.ndim == 0:
        return value
    return value[type_of_lens(parent.imager.array)]


def new_design(design: Design, parent: Parent, values: Values) -> Design:
    """The design of these values as a file holds it: the working distance is the one that was asked for.

    Lengths and the refractive index are to four decimals (0.1 um), conics and aspheric terms to seven significant
    digits.

    Raises
    ------
    InputError
        If the values make no microscope.
    """
    values = start_values(parent) | values
    shared = ("sensor_distance_mm", "refractive_index", "depth_span_mm")
    numbers = {name: round(float(values[name]), _DIGITS) for name in shared}
    scale = float(values["pitch_mm"] / parent.pitch)
    size = [round(scale * side, _DIGITS) for side in design.array.size_mm]
    # Rounding may not push a lens off the plate.
    half = np.array(size) / 2
    centers = np.clip(np.round(scale * np.asarray(values["centers_mm"], float), _DIGITS), -half, half)
    middle = float(parent.middle)
    working = [round(middle + sign * numbers["depth_span_mm"] / 2, _DIGITS) for sign in (-1, 1)]
    data = design.model_dump()
    data["lens"] |= {name: _of_lenses_rounded(parent, name, values[name]) for name in LENS_KEYS}
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


def _of_lenses_rounded(parent: Parent, name: str, value: Float[Array, "..."]) -> float | list[float]:
    """One number if all types come to the same."""
    numbers = of_lenses(parent, value)
    numbers = np.round(np.asarray(numbers, float), _DIGITS) if name.endswith("_mm") else significant(numbers)
    return numbers.tolist() if np.ptp(numbers) else float(numbers.flat[0])
