"""Numbers of a design that are possible but hardly meant: a slip of the unit, as a question in words."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from .checks import plate_as_air

# What is usual, in the unit of the key. Wide: the smallest and the largest that anybody builds of microlenses.
USUAL: dict[str, tuple[float, float]] = {
    "sensor.pixel_pitch_um": (0.5, 50.0),
    "lens.radius_of_curvature_mm": (0.1, 50.0),
    "lens.refractive_index": (1.3, 4.1),
    "lens.aperture_diameter_mm": (0.02, 20.0),
    "lens.focal_length_mm": (0.1, 100.0),
    "array.size_mm": (0.5, 200.0),
    "array.substrate_thickness_mm": (0.01, 20.0),
    "imaging.sensor_distance_mm": (0.5, 100.0),
    "imaging.working_distance_mm": (0.2, 2000.0),
    "imaging.wavelength_nm": (150.0, 15_000.0),
    "imaging.field_radius_mm": (0.02, 200.0),
}
_FACTORS = (1e-3, 1e3, 1e-6, 1e6, 1e9)
_LADDER = ("nm", "um", "mm", "m")
# No length, and an integer beyond is no float.
_ENDLESS = 1e30
# The sensor is usually this many times nearer or farther than where the image forms, at most.
_OFF = 3.0
# Beyond this multiple of the depth the field is not seen by any lens: 63 degrees.
_WIDEST = 2.0
# Lenses that are nearer than this part of their diameter are lenses of another unit, as metres that are read as mm.
_CLOSEST = 50.0

# Lenses whose nearest is looked for.
_SOME = 100


def slips(data: Mapping[str, Any]) -> list[str]:
    """A question for each number of a design's tables, right or wrong, that another unit would make a usual one.

    Parameters
    ----------
    data
        The tables as a file has them; of what is no number nothing is said.
    """
    return [question for key in USUAL if (question := slip(key, _value(data, key)))]


def slip(key: str, value: Any) -> str | None:
    """The question that a value of a key raises; None if it is usual, or no positive number."""
    numbers = _positive(value)
    low, high = USUAL[key]
    if not numbers or all(low <= each <= high for each in numbers):
        return None
    found, unit = f"{key} = {_numbers(numbers)}", unit_of(key)
    if (other := _other(key, numbers)) is None:
        return f"{found}: is it meant? Usual is {low:g} to {high:g} {unit}".rstrip() + "."
    meant, their_unit = other
    said = f" ({_numbers(numbers)} {their_unit})" if their_unit else ""
    return f"{found}: did you mean {_numbers(meant)} {unit}{said}?"


def meant(key: str, value: Any) -> float | list[float] | None:
    """What a value was that is another unit's: a usual one in the key's own unit; None if there is none."""
    if slip(key, value) is None or (other := _other(key, _positive(value))) is None:
        return None
    return other[0] if isinstance(value, list | tuple) else other[0][0]


def doubts(data: Mapping[str, Any]) -> list[str]:
    """Questions that valid tables of a design raise: those of `slips`, or else what does not go together."""
    return slips(data) or list(_unlikely(data))


def unit_of(key: str) -> str:
    """The unit that a key ends in; empty if none."""
    unit = key.rpartition("_")[2]
    return unit if unit in (*_LADDER, "deg") else ""


def _positive(value: Any) -> list[float]:
    """As floats, the positive numbers that a value is; none if it is anything else."""
    numbers = list(value) if isinstance(value, list | tuple) else [value]
    right = all(type(each) in (int, float) and 0 < each < _ENDLESS for each in numbers)
    return [float(each) for each in numbers] if right else []


def _other(key: str, numbers: list[float]) -> tuple[list[float], str | None] | None:
    """The usual numbers that a power of a thousand makes of these, and the name of the unit that these then have."""
    low, high = USUAL[key]
    if (unit := unit_of(key)) not in _LADDER:
        return None
    for factor in _FACTORS:
        usual = [float(f"{each * factor:.9g}") for each in numbers]
        if all(low <= each <= high for each in usual):
            step = _LADDER.index(unit) + round(math.log10(factor) / 3)
            return usual, _LADDER[step] if 0 <= step < len(_LADDER) else None
    return None


def _value(data: Mapping[str, Any], key: str) -> Any:
    table, _, name = key.partition(".")
    inner = data.get(table)
    found = inner.get(name) if isinstance(inner, Mapping) else None
    if table == "lens" and (numbers := sorted(set(_positive(found)))):
        return [numbers[0], numbers[-1]] if len(numbers) > 1 else numbers[0]  # of each lens: the extremes tell
    return found


def _numbers(values: list[float]) -> str:
    shown = [f"{value:.9g}" for value in values]
    return shown[0] if len(shown) == 1 else f"[{', '.join(shown)}]"


def _unlikely(data: Mapping[str, Any]) -> Iterator[str]:
    lens, array, imaging = data["lens"], data["array"], data["imaging"]
    near, far = imaging["working_distance_mm"]
    kind = lens.get("orientation", "plano")
    front, back = plate_as_air(array["substrate_thickness_mm"], lens["refractive_index"], kind)
    v = imaging["sensor_distance_mm"]
    radius, diameters = (np.array(lens[key], float) for key in ("radius_of_curvature_mm", "aperture_diameter_mm"))
    f = np.array(lens.get("focal_length_mm") or radius / (lens["refractive_index"] - 1))
    least, most = float(f.min()), float(f.max())
    focal = f"{least:.4g}" if least == most else f"{least:.4g} to {most:.4g}"
    depths = f"{near:g} to {far:g} mm"
    if near + front <= least:
        said = f"imaging.working_distance_mm = [{near:g}, {far:g}]: is it meant?"
        yield f"{said} Nearer than the focal length, {focal} mm, no real image forms."
    else:
        image = lambda f, depth: 1 / (1 / f - 1 / (depth + front)) - back if depth + front > f else math.inf
        longest, shortest = image(most, near), image(least, far)
        if not shortest / _OFF <= v <= longest * _OFF:
            said = f"imaging.sensor_distance_mm = {v:g}: is it meant?"
            yield f"{said} Lenses of f = {focal} mm image {depths} at {shortest:.4g} to {longest:.4g} mm."
    if (field := imaging["field_radius_mm"]) > _WIDEST * far:
        yield f"imaging.field_radius_mm = {field:g}: is it meant? A lens sees so far beside its axis at {depths}."
    if (diameter := float(diameters.max())) > 2 * (plate_size := max(array["size_mm"])):
        yield f"lens.aperture_diameter_mm = {diameter:g}: is it meant? The whole plate is {plate_size:g} mm."
    pitch = _pitch(np.array(array["centers_mm"], float))
    if pitch < diameter / _CLOSEST:
        yield (
            f"array.centers_mm: lenses of {diameter:g} mm are {pitch:.3g} mm apart; did you mean "
            f"{pitch * 1000:.3g} mm, a list in another unit?"
        )
    half = np.minimum(np.minimum(diameters, pitch) / 2, radius)
    height = float(np.max(radius - np.sqrt(radius**2 - half**2)))  # of spheres, which others are not far from
    if 0 < (thickness := array["substrate_thickness_mm"]) < height and not lens.get("focal_length_mm"):
        said = f"array.substrate_thickness_mm = {thickness:g}: is it meant?"
        yield f"{said} It counts to the vertices of the lenses, which alone are {height:.3g} mm high."


def _pitch(centers: np.ndarray) -> float:
    """Mean distance of a hundred lenses or so from their nearest; infinite where they are too few to tell."""
    if len(centers) <= 2:
        return math.inf
    some = centers[:: len(centers) // _SOME + 1]
    # Without SciPy, whose import takes longer. The nearest is the lens itself.
    return float(np.mean([np.partition(np.hypot(*(centers - center).T), 1)[1] for center in some]))
