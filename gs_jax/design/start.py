"""Designs to start from: the paper's, and what follows from the few numbers that a lab knows of lenses and camera."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ..base.errors import InputError
from ..layouts import PITCH_BY_SPACING, nearest_neighbour_distances, random_layout
from .design import Design
from .tables import ArrayTable, ImagingTable, LensTable, SensorTable
from .validation import beside_sensor

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
    """Of the sphere of a plano-convex lens in air, `R = f (n - 1)`, mm."""
    return float(f"{focal_length * (refractive_index - 1):.9g}")


def generated_centers(count: int, size: tuple[float, float], seed: int = 0) -> Float[np.ndarray, "lens 2"]:
    """A random layout in the proportions of the paper's, mm; `InputError` as `random_layout`.

    Centres are half a pitch from the plate's edge, or more: it cuts no lens in half.
    """
    spacing = math.sqrt(size[0] * size[1] / count)
    inner = tuple(max(side - PITCH_BY_SPACING * spacing, side / 2) for side in size)
    diameter = DIAMETER_BY_SPACING * math.sqrt(inner[0] * inner[1] / count) if count >= FEW else None
    return random_layout(count, inner, diameter=diameter, seed=seed).round(4)


def check_unit_said(centers: Float[np.ndarray, "lens 2"]) -> None:
    """Of centres without a unit: `InputError` unless they may well be mm."""
    if (reach := float(np.abs(centers).max(initial=0))) > FARTHEST_MM:
        raise InputError(
            f"centres reach {reach:g} without a unit: give --centers-unit um or px, or mm if that is meant."
        )


def check_origin_said(centers: Float[np.ndarray, "lens 2"]) -> None:
    """Of centres without an origin: `InputError` unless they lie about it."""
    if len(centers) > 1 and (centers >= 0).all():
        raise InputError("no x or y is below 0: give --centers-origin corner, or center if that is meant.")


def plate_of(centers: Float[np.ndarray, "lens 2"]) -> tuple[float, float]:
    """The smallest centred plate with half a pitch about the lenses, `(x, y)` in mm."""
    pitch = float(nearest_neighbour_distances(centers).mean()) if len(centers) > 1 else 0.0
    width, height = (2 * np.abs(centers).max(axis=0) + pitch).tolist()
    return _up(width), _up(height)


def clash(key: str, value: Any, known: Known) -> str | None:
    """What of the others a value does not go with, as a line; None if it goes with all that are known."""
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


def _sensor_size(known: Known) -> tuple[float, float]:
    height, width = (n * known["pixel_pitch_um"] / 1000 for n in known["shape"])
    return round(width, 4), round(height, 4)


def _size(known: Known) -> tuple[float, float]:
    return _sensor_size(known) if known.get("centers") is None else plate_of(known["centers"])


def _diameter(known: Known) -> float | None:
    centers = known["centers"]
    if len(centers) < 2:
        return None
    if known.get("count"):
        width, height = known["size_mm"]
        wanted = DIAMETER_BY_SPACING * math.sqrt(width * height / len(centers))
    else:
        wanted = float(nearest_neighbour_distances(centers).mean())
    # Beyond, light along the axis is totally reflected, long before a hemisphere.
    return _three_digits(min(wanted, 2 * known["radius_of_curvature_mm"] / known["refractive_index"]))


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


# What is not said follows from what is, in the order in which keys are asked for; without one there is no default.
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
