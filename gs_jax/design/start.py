"""Designs to start from: the paper's, defaults of what a lab does not know, and the documentation of all keys.

The documentation serves comments in files, the schema for editors and the page of keys. It is read from the fields of
the tables, whose titles are meanings and whose descriptions are allowed values.
"""

import math
import textwrap
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, get_origin

import numpy as np
from jaxtyping import Bool, Float
from pydantic import BaseModel, ValidationError

from ..base.errors import InputError
from ..io.toml import table_of
from ..microscope.layouts import PITCH_BY_SPACING, nearest_neighbour_distances, random_layout
from .design import Design, as_toml
from .tables import LENS_KEYS, ArrayTable, CentersTable, ImagingTable, LensTable, SensorTable
from .validation import USUAL, beside_sensor, unit_of

# The paper's material, plate and light.
PDMS, PLATE_MM, GREEN_NM = 1.43, 1.0, 520.0
# Of the paper's microscope: lenses that see a point; diameter over the square root of a lens's area, without holes.
LENSES_PER_POINT, DIAMETER_BY_SPACING = 14, 1.46
# Thickness of a plate between its lenses at least, mm.
_SHEET_MM = 0.3
# So few lenses leave holes, and no centre is farther from the middle of a plate.
FEW, FARTHEST_MM = 30, 100.0
# Share of the nearest depth that the field radius is at most: beyond, aberrations leave little of an image.
WIDEST = 0.25

Known = Mapping[str, Any]


def radius_of(focal_length: float, refractive_index: float) -> float:
    """Radius of the sphere of a plano-convex lens in air, `R = f (n - 1)`, mm."""
    return float(f"{focal_length * (refractive_index - 1):.9g}")


def generated_centers(count: int, size: tuple[float, float], seed: int = 0) -> Float[np.ndarray, "lens 2"]:
    """A random layout in the proportions of the paper's, mm; `InputError` as `random_layout`.

    Centres are half a pitch from the plate's edge, or more: it cuts no lens in half.
    """
    spacing = math.sqrt(size[0] * size[1] / count)
    inner = tuple(max(side - PITCH_BY_SPACING * spacing, side / 2) for side in size)
    diameter = DIAMETER_BY_SPACING * math.sqrt(inner[0] * inner[1] / count) if count >= FEW else None
    return random_layout(count, inner, diameter=diameter, seed=seed).round(4)


def check_in_mm(centers: Float[np.ndarray, "lens 2"]) -> None:
    """Raise `InputError` unless centres without a unit may well be in mm."""
    if (reach := float(np.abs(centers).max(initial=0))) > FARTHEST_MM:
        raise InputError(
            f"centres reach {reach:g} without a unit: give --centers-unit um or px, or mm if that is meant."
        )


def check_centered(centers: Float[np.ndarray, "lens 2"]) -> None:
    """Raise `InputError` unless centres without an origin lie about it."""
    if len(centers) > 1 and (centers >= 0).all():
        raise InputError("no x or y is below 0: give --centers-origin corner, or center if that is meant.")


def plate_of(centers: Float[np.ndarray, "lens 2"]) -> tuple[float, float]:
    """The smallest centred plate with half a pitch about the lenses, `(x, y)` in mm."""
    pitch = float(nearest_neighbour_distances(centers).mean()) if len(centers) > 1 else 0.0
    width, height = (2 * np.abs(centers).max(axis=0) + pitch).tolist()
    return _up(width), _up(height)


def clash(key: str, value: Any, known: Known) -> str | None:
    """The line about a value that contradicts other known ones; None if it does not."""
    if key == "working_distance_mm" and not value[0] < value[1]:
        return f"must be near below far, got {value}."
    if key == "aperture_diameter_mm" and value > (sphere := 2 * known["radius_of_curvature_mm"]):
        return f"must be at most {sphere:g} mm, twice the radius of curvature, got {value}."
    if key == "size_mm" and (centers := known.get("centers")) is not None:
        if (np.abs(centers) > np.array(value) / 2).any():
            width, height = plate_of(centers)
            return f"must be a plate that holds all lenses, such as {width:g} {height:g}, got {value}."
    return None


def within_reach(known: Known) -> Bool[np.ndarray, " lens"]:
    """Which lenses have an image on the sensor: those that a design may have."""
    plate = known["substrate_thickness_mm"] / known["refractive_index"]
    near = known["working_distance_mm"][0] + plate
    angle = math.radians(known.get("rotation_deg", 0.0))
    turned = known["centers"] @ np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    distance = beside_sensor(turned, tuple(known["shape"]), known["pixel_pitch_um"])
    return distance <= known["sensor_distance_mm"] / near * known["field_radius_mm"]


def _up(length: float) -> float:
    return math.ceil(max(length, 0.01) * 100) / 100


def _size(known: Known) -> tuple[float, float]:
    """The smallest plate for the lenses, or the sensor's size."""
    if known.get("centers") is not None:
        return plate_of(known["centers"])
    height, width = (n * known["pixel_pitch_um"] / 1000 for n in known["shape"])
    return round(width, 4), round(height, 4)


def _diameter(known: Known) -> float | None:
    centers = known["centers"]
    if len(centers) < 2:
        return None
    if known.get("count"):
        width, height = known["size_mm"]
        diameter = DIAMETER_BY_SPACING * math.sqrt(width * height / len(centers))
    else:
        diameter = float(nearest_neighbour_distances(centers).mean())
    # Beyond, light along the axis is totally reflected, long before a hemisphere.
    return _three_digits(min(diameter, 2 * known["radius_of_curvature_mm"] / known["refractive_index"]))


def _thickness(known: Known) -> float:
    """The paper's, or what the height of the lenses needs."""
    radius = known["radius_of_curvature_mm"]
    height = radius - math.sqrt(max(radius**2 - known["aperture_diameter_mm"] ** 2 / 4, 0.0))
    return max(PLATE_MM, _up(height + _SHEET_MM))


def _sensor_distance(known: Known) -> float | None:
    """The thin-lens image of the middle of the working distance, as 1/z' goes."""
    f = known["radius_of_curvature_mm"] / (known["refractive_index"] - 1)
    plate = known["substrate_thickness_mm"] / known["refractive_index"]
    inverse = 1 / f - sum(1 / (depth + plate) for depth in known["working_distance_mm"]) / 2
    return float(f"{1 / inverse:.4g}") if inverse > 0 else None


def _field_radius(known: Known) -> float:
    width, height = known["size_mm"]
    usual = math.sqrt(LENSES_PER_POINT * width * height / (math.pi * len(known["centers"])))
    return _three_digits(min(usual, WIDEST * known["working_distance_mm"][0]))


def _three_digits(value: float) -> float:
    return math.floor(float(f"{value:.12g}") * 1000) / 1000 if value >= 0.01 else value


# Defaults, which follow from the keys before them in this order; None if there is none.
DEFAULTS: dict[str, Callable[[Known], Any]] = {
    "refractive_index": lambda known: PDMS,
    "size_mm": _size,
    "aperture_diameter_mm": _diameter,
    "substrate_thickness_mm": _thickness,
    "sensor_distance_mm": _sensor_distance,
    "wavelength_nm": lambda known: GREEN_NM,
    "field_radius_mm": _field_radius,
}


def geomscope(*, sensor_distance_mm: float = 5.8) -> Design:
    """The paper's microscope (Table 1), with a random layout of our own of the same statistics.

    *Host.*

    Parameters
    ----------
    sensor_distance_mm
        The paper prints about 4 mm, where a point at 20 mm is far out of focus: its thin-lens image forms at
        6.06 mm, and traced rays are sharpest at 5.8 mm.

    Examples
    --------
    >>> import gs_jax as gs
    >>> gs.geomscope().imaging.sensor_distance_mm, gs.geomscope(sensor_distance_mm=4.0).imaging.sensor_distance_mm
    (5.8, 4.0)
    """
    size = (20.0, 20.0)
    centers = random_layout(200, size, pitch=1.23, pitch_sd=0.09, diameter=2.0, seed=0).round(4)
    return Design(
        name="geomscope",
        sensor=SensorTable(pixel_pitch_um=4.5, shape=(5120, 5120)),
        lens=LensTable(radius_of_curvature_mm=2.0, refractive_index=1.43, aperture_diameter_mm=2.0),
        array=ArrayTable(size_mm=size, substrate_thickness_mm=1.0, centers_mm=tuple(map(tuple, centers.tolist()))),
        imaging=ImagingTable(
            sensor_distance_mm=sensor_distance_mm,
            working_distance_mm=(18.0, 30.0),
            wavelength_nm=520.0,
            field_radius_mm=3.0,
        ),
    )


FRAME = (
    "Lengths have the unit that their key ends in. +x is along a row of the image as it is shown (right), +y along a "
    "column (down), both from the sensor's middle; depths z are positive from the array's front toward the object, the "
    "sensor distance v is positive from its back to the sensor."
)
_WIDTH = 110


class Key(NamedTuple):
    """A key of a design file. `table` is empty at the top level, `usual` where there is no usual range."""

    table: str
    name: str
    unit: str
    meaning: str
    allowed: str
    usual: str
    required: bool

    @property
    def text(self) -> str:
        """Meaning, allowed values and usual range."""
        allowed = f"; {self.allowed}" if self.allowed != "a table" else ""
        return f"{self.meaning}{allowed}{f'; usually {self.usual}' if self.usual else ''}"


def design_keys() -> dict[str, Key]:
    """All keys of design files by their path, such as `sensor.shape`, in the order of the tables."""
    keys = {}
    for table, model in _models().items():
        fields = model.model_fields | (CentersTable.model_fields if table == "array" else {})
        for name, field in fields.items():
            path = f"{table}.{name}".removeprefix(".")
            unit, usual = unit_of(name), ""
            if path in USUAL:
                usual = "{:g} to {:g} {}".format(*USUAL[path], unit).rstrip()
            keys[path] = Key(table, name, unit, field.title or "", field.description or "", usual, field.is_required())
    return keys


def problem(path: str, value: Any) -> str | None:
    """The error of a value of the key at `path`, checked by itself; None if it is allowed."""
    table, _, name = path.partition(".")
    try:
        Design.model_validate({table: {name: value}})
    except ValidationError as error:  # as all others are missing
        if any(problem["loc"][:2] == (table, name) for problem in error.errors()):
            return f"must be {design_keys()[path].allowed}, got {value}."
    return None


def commented(design: Design) -> str:
    """A design as TOML with a comment on each key."""
    known, data = design_keys(), design.model_dump(exclude_defaults=True)
    lines = [*_comment(f"A microscope for gs-jax. {FRAME}"), "", *_comment(known["name"].text)]
    lines.append(as_toml({"name": data.pop("name")}).rstrip())
    # The centres are long.
    for table in sorted(data, key=lambda table: (table in ("array", "provenance"), table == "provenance")):
        title = known[table].meaning
        lines += ["", *_comment(f"{title[:1].upper()}{title[1:]}.")]
        if table in ("provenance", "samples", "channels"):
            lines.append(as_toml({table: data[table]}).rstrip())
            continue
        lines.append(f"[{table}]")
        for name, value in data[table].items():
            lines += _comment(known[f"{table}.{name}"].text)
            inner = [key for key in known.values() if key.table == f"{table}.{name}"]
            lines += [line for key in inner for line in _comment(f"{key.name}: {key.text}")]
            lines.append(as_toml({name: value}).rstrip())
    return "\n".join(lines) + "\n"


def schema() -> dict[str, Any]:
    """The JSON schema of design files, for editors."""
    result = Design.model_json_schema()
    array = result["$defs"]["ArrayTable"]
    array["properties"] |= CentersTable.model_json_schema()["properties"]
    array["required"].remove("centers_mm")
    array["oneOf"] = [{"required": [name]} for name in ("centers_mm", "centers_file")]
    # The centres file may have these columns.
    lens = result["$defs"]["LensTable"]
    lens["required"] = [name for name in lens["required"] if name not in LENS_KEYS]
    keys = design_keys()
    for table, model in _models().items():
        where = result["$defs"][model.__name__] if table else result
        for name, field in where["properties"].items():
            field.pop("title", None)
            field["description"] = keys[f"{table}.{name}".removeprefix(".")].text
    file = {"type": "string", "minLength": 1, "description": "in place of `spectrum_nm`: the name of a CSV file"}
    result["$defs"]["ImagingTable"]["properties"]["spectrum_file"] = file
    return {"$schema": "http://json-schema.org/draft-07/schema#"} | _for_toml(result) | {"title": "A design of gs-jax"}


def _models(table: str = "", model: type[BaseModel] = Design) -> dict[str, type[BaseModel]]:
    """A table and those in it by their names; those of `[samples]` have the keys of `[sample]`."""
    models = {table: model}
    for name, field in model.model_fields.items():
        if get_origin(field.annotation) is not dict and (inner := table_of(field.annotation)):
            models |= _models(f"{table}.{name}".removeprefix("."), inner)
    return models


def _comment(text: str) -> list[str]:
    return [f"# {line}" for line in textwrap.wrap(text, _WIDTH, break_on_hyphens=False)]


def _for_toml(node: Any) -> Any:
    """Remove null, which TOML lacks, and `prefixItems` (draft 2020-12), which not all editors know."""
    if isinstance(node, list):
        return [_for_toml(inner) for inner in node]
    if not isinstance(node, dict):
        return node
    node = {key: _for_toml(value) for key, value in node.items() if value is not None}
    choices = [choice for choice in node.get("anyOf", ()) if choice != {"type": "null"}]
    if len(choices) == 1:
        node = {key: value for key, value in node.items() if key != "anyOf"} | choices[0]
    if items := node.pop("prefixItems", None):
        node["items"] = items[0]
    return node
