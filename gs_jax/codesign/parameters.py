"""What of a microscope is free in a co-design, and between which bounds.

A `Parent` is the design that an optimisation starts from, `start_values` are its parameters by name, and `candidate`
is the microscope of other values: everything that an objective needs, differentiable in all of them. `new_design`
goes back to a file. Names carry the unit of the study file, and so do the values here: all are mm but the index, the
conic constant and the aspheric terms A_4, A_6, ..., in mm^-3, mm^-5, ....
Solvers do not see units: `Bounds` maps a value to a number of order one without any bound, and back; `Box`, for the one
solver that keeps bounds by itself, to its share of the way between them.
"""

import math
from collections.abc import Mapping
from types import MappingProxyType

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import ValidationError

from ..base.converters import as_float
from ..base.errors import InputError
from ..designs.checks import plate_as_air
from ..designs.design import Design
from ..designs.microscope import Microscope
from ..geometry import Imager
from ..io.tables import one_line
from ..layouts.cells import cell_edges
from ..lenses import MicrolensArray
from ..optics.aperture import aperture_area, pitch, wedge

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

# What a pitch leaves as it is, beside radius and aperture.
_UNSCALED = ("refractive_index", "conic_constant", "aspheric_terms", "sensor_distance_mm")
# How near to a bound a start may be, as a fraction of the range: on the bound the map has no slope, and no way back.
_NEAREST = 0.01
# Aspheric terms of a lens without any, where they are free.
_TERMS = 2
# Digits of a written length: 0.1 um is finer than a printer, and than a camera's mount.
_DIGITS = 4


class Bounds(eqx.Module):
    """The values between two bounds as a smooth, invertible image of all numbers `x`: `(1 + x / sqrt(1 + x^2)) / 2` of
    the way from the lowest to the highest.

    A logistic curve would do as well but for its ends, so flat that a search that comes there does not come back.
    Bounds may be arrays that broadcast against the value, in its unit.
    """

    low: Float[Array, "..."] = eqx.field(converter=as_float)
    high: Float[Array, "..."] = eqx.field(converter=as_float)

    def value(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The value of a number of order one."""
        return self.low + (self.high - self.low) * (1 + free / jnp.sqrt(1 + free**2)) / 2

    def free(self, value: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The inverse of `value`. Values at a bound or beyond it are first taken within, by 1 % of the range."""
        share = jnp.clip((value - self.low) / (self.high - self.low), _NEAREST, 1 - _NEAREST)
        return (2 * share - 1) / (2 * jnp.sqrt(share * (1 - share)))


class Box(eqx.Module):
    """The values between two bounds by their share of the way from the lowest to the highest, 0 to 1."""

    low: Float[Array, "..."] = eqx.field(converter=as_float)
    high: Float[Array, "..."] = eqx.field(converter=as_float)

    def value(self, free: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The value of a share."""
        return self.low + (self.high - self.low) * free

    def free(self, value: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The inverse of `value`. Values beyond a bound are first taken to it."""
        return jnp.clip((value - self.low) / (self.high - self.low), 0, 1)


class Cells(eqx.Module):
    """The edges of the Voronoi cells of lenses that stay where they are: the fast way to their clear aperture.

    `height`: distance of the edge's line from its lens, mm. `low`, `high`: the edge's ends along it, from the foot.
    """

    height: Float[Array, " edge"] = eqx.field(converter=as_float)
    low: Float[Array, " edge"] = eqx.field(converter=as_float)
    high: Float[Array, " edge"] = eqx.field(converter=as_float)


class Parent(eqx.Module):
    """A design with what its file does not say: where it is judged.

    `cells`: of its lenses, None if they may move. `pitch`: mean distance of nearest neighbours, mm; 1 for one lens.
    `middle`, `span`: of the depths that count, from the plate, mm. `depth_count`: how many they are. `confusion`:
    mm. `exposure`: as of a `Microscope`.
    """

    imager: Imager
    cells: Cells | None
    pitch: Float[Array, ""] = eqx.field(converter=as_float)
    middle: Float[Array, ""] = eqx.field(converter=as_float)
    span: Float[Array, ""] = eqx.field(converter=as_float)
    confusion: Float[Array, ""] = eqx.field(converter=as_float)
    depth_count: int = eqx.field(static=True)
    largest_magnification: float = eqx.field(static=True)
    exposure: float = eqx.field(static=True)


def parent_of(
    design: Design,
    *,
    depths_mm: tuple[float, float] | None = None,
    confusion: float | None = None,
    depth_count: int = 6,
    exposure: float = 1e4,
    free: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> Parent:
    """A design as an optimisation sees it.

    Parameters
    ----------
    depths_mm
        Nearest and farthest depth that count; by default the design's working distance.
    confusion
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
    if "aspheric_terms" in free and not imager.array.aspheric_terms.size:
        none = jnp.zeros(_TERMS, imager.sensor_distance.dtype)
        imager = eqx.tree_at(lambda i: i.array.aspheric_terms, imager, none)
    return Parent(
        imager,
        None if "centers_mm" in free else _cells(design),
        pitch(imager.array.centers)[0] if len(design.array.centers_mm) > 1 else 1.0,
        (near + far) / 2,
        far - near,
        2 * imager.sensor.pixel_pitch if confusion is None else confusion,
        depth_count,
        _largest_magnification(design, near, far, free),
        exposure,
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


def _cells(design: Design) -> Cells:
    edges = cell_edges(np.array(design.array.centers_mm), design.array.size_mm)
    return Cells(edges.height, edges.low, edges.high)


def _clear_area(cells: Cells | None, array: MicrolensArray) -> Float[Array, ""]:
    """Of all lenses together, mm^2."""
    if cells is None:
        return jnp.sum(aperture_area(array))
    radius = array.aperture_diameter / 2
    return jnp.sum(wedge(cells.high, cells.height, radius) - wedge(cells.low, cells.height, radius))


def start_values(parent: Parent) -> Values:
    """Every parameter of the parent, by name."""
    array = parent.imager.array
    return {
        "sensor_distance_mm": parent.imager.sensor_distance,
        "radius_of_curvature_mm": array.radius_of_curvature,
        "aperture_diameter_mm": array.aperture_diameter,
        "refractive_index": array.refractive_index,
        "conic_constant": array.conic_constant,
        "aspheric_terms": array.aspheric_terms,
        "pitch_mm": parent.pitch,
        "centers_mm": array.centers,
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
        i.array.refractive_index,
        i.array.conic_constant,
        i.array.aspheric_terms,
        i.sensor_distance,
    )
    # Areas before scaling, on the plate as it is: its size cannot be traced.
    radius, diameter = values["radius_of_curvature_mm"], values["aperture_diameter_mm"]
    others = tuple(values[name] for name in _UNSCALED)
    unscaled = eqx.tree_at(where, parent.imager, (values["centers_mm"], radius, diameter / scale, *others))
    area, count = _clear_area(parent.cells, unscaled.array), parent.imager.array.centers.shape[0]
    imager = eqx.tree_at(where, parent.imager, (scale * values["centers_mm"], radius, diameter, *others))
    offsets = jnp.linspace(-0.5, 0.5, parent.depth_count, dtype=scale.dtype)
    return Microscope(
        imager,
        parent.middle + values["depth_span_mm"] * offsets,
        clear_diameter=scale * jnp.sqrt(4 / math.pi / count * area),
        field_radius=jnp.array(imager.field_radius, scale.dtype),
        confusion=parent.confusion,
        plate_scale=scale,
        largest_magnification=parent.largest_magnification,
        exposure=parent.exposure,
    )


def new_design(design: Design, parent: Parent, values: Values) -> Design:
    """The design of these values as a file holds it: lengths to 0.1 um, the working distance that was asked for.

    Raises
    ------
    InputError
        If the values make no microscope.
    """
    values = start_values(parent) | values
    numbers = {name: round(float(values[name]), _DIGITS) for name in NAMES if values[name].ndim == 0}
    scale = float(values["pitch_mm"] / parent.pitch)
    size = [round(scale * side, _DIGITS) for side in design.array.size_mm]
    # Rounding may not push a lens off the plate.
    half = np.array(size) / 2
    centers = np.clip(np.round(scale * np.asarray(values["centers_mm"], float), _DIGITS), -half, half)
    middle = float(parent.middle)
    working = [round(middle + sign * numbers["depth_span_mm"] / 2, _DIGITS) for sign in (-1, 1)]
    data = design.model_dump()
    of_lens = ("radius_of_curvature_mm", "aperture_diameter_mm", "refractive_index", "conic_constant")
    data["lens"] |= {name: numbers[name] for name in of_lens}
    data["lens"] |= {"aspheric_terms": np.round(np.asarray(values["aspheric_terms"], float), _DIGITS).tolist()}
    data["array"] |= {"size_mm": size, "centers_mm": centers.tolist()}
    data["imaging"] |= {"sensor_distance_mm": numbers["sensor_distance_mm"], "working_distance_mm": working}
    try:
        return Design.model_validate(data)
    except ValidationError as error:
        raise InputError(f"the values found make no microscope: {one_line(error, Design, {})}.") from error
