"""Validation of designs: errors where the parts do not fit together, questions where a number is implausible.

`check_whole` reports one problem at a time and names its key. `slips` and `doubts` ask about numbers that are possible
but unusual, such as a length in another unit.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ..microscope.lenses import sag_slope_over_r
from .conversion import check_band, check_path, object_begins, reduced_depth, reduced_sensor_distance
from .tables import LENS_KEYS

MIN_SPACING_MM = 1e-3
# Radii at which the slope of a lens is checked.
_RADII = 64


def check_whole(design) -> None:
    """Raise `ValueError` unless the numbers, the plate, the lenses and the sensor of a design fit together."""
    check_band(design.imaging)
    near, far = design.imaging.working_distance_mm
    if not near < far:
        raise ValueError(f"`imaging.working_distance_mm` must be [near, far], near below far, got [{near}, {far}]")
    _check_lenses(design)
    check_path(design)
    _check_plate(design)
    _check_reach(design)


def of_each(design, key: str) -> tuple[float, ...]:
    """One of `LENS_KEYS` as a number for each lens."""
    value = getattr(design.lens, key)
    return value if isinstance(value, tuple) else (value,) * len(design.array.centers_mm)


def _check_lenses(design) -> None:
    lens, count = design.lens, len(design.array.centers_mm)
    for key in LENS_KEYS:
        if (given := len(of_each(design, key))) != count:
            raise ValueError(f"`lens.{key}` must be one number or {count}, one a lens, got {given}")
    first: dict[tuple[float, ...], int] = {}
    for number, shape in enumerate(zip(*(of_each(design, key) for key in LENS_KEYS), strict=True), 1):
        first.setdefault(shape, number)
    for (radius, aperture, conic), number in first.items():
        of_lens = f" of lens {number}" if len(first) > 1 else ""
        if aperture > (end := widest_diameter(radius, conic)):
            where = "twice `lens.radius_of_curvature_mm`" if not conic else "where the conic ends"
            most = f"at most {round(end, 6)} mm, {where}"
            raise ValueError(f"`lens.aperture_diameter_mm` must be {most}, got {aperture}{of_lens}")
        radii = np.linspace(0, aperture / 2, _RADII + 1)[1:-1]
        rising = sag_slope_over_r(radii**2, radius, conic, lens.aspheric_terms) <= 0
        if rising.any():
            which = f"lens {number} rises" if of_lens else "lenses rise"
            got = f"{list(lens.aspheric_terms)}, with which {which} at {radii[np.argmax(rising)]:.3g} mm"
            raise ValueError(f"`lens.aspheric_terms` must give lenses that fall from the vertex to the rim, got {got}")


def widest_diameter(radius: float, conic_constant: float) -> float:
    """Largest diameter of a conic surface, mm; infinite for paraboloids and hyperboloids."""
    return 2 * radius / math.sqrt(1 + conic_constant) if conic_constant > -1 else math.inf


def _check_plate(design) -> None:
    """All lenses are on the plate, and apart."""
    centers, half = np.array(design.array.centers_mm), np.array(design.array.size_mm) / 2
    outside = (np.abs(centers) > half + 1e-9).any(axis=1)
    if outside.any():
        plate = f"within the plate `array.size_mm`, |x| up to {half[0]} mm and |y| up to {half[1]} mm"
        lens = _lens(design, int(np.argmax(outside)))
        raise ValueError(f"`array.centers_mm` must be {plate}, got {lens}{_other_reading(centers, half)}")
    if pair := _close_pair(centers):
        got = f"{_lens(design, pair[0])} and lens {pair[1] + 1} nearer to it"
        raise ValueError(f"`array.centers_mm` must be at least {MIN_SPACING_MM} mm apart, got {got}")


def _other_reading(centers: np.ndarray, half: np.ndarray) -> str:
    """Ask, after `; `, in which unit or from which origin centres would be on a plate of half the size `half`."""
    reach, positive = np.abs(centers).max(axis=0), (centers >= 0).all()
    if positive and (reach <= 2 * half).all():
        return '; are they counted from a corner (`centers_origin = "corner"`)?'
    # Of micrometres some lens is in the outer half of the plate.
    if (reach / 1000 <= half).all() and (reach / 1000 > half / 2).any():
        return '; are they micrometres (`centers_unit = "um"`)?'
    if positive and (reach / 1000 <= 2 * half).all() and (reach / 1000 > half).any():
        return '; are they micrometres from a corner (`centers_unit = "um"`, `centers_origin = "corner"`)?'
    return ""


def _close_pair(centers: np.ndarray) -> tuple[int, int] | None:
    # Two lenses in one cell of half the spacing are too close. Without such pairs few lenses are close along x.
    _, cells = np.unique(np.floor(centers / (MIN_SPACING_MM / 2)), axis=0, return_inverse=True)
    order = np.argsort(cells.ravel(), kind="stable")
    together = np.flatnonzero(np.diff(cells.ravel()[order]) == 0)
    if together.size:
        return int(order[together[0]]), int(order[together[0] + 1])
    along, least, pairs = np.argsort(centers[:, 0], kind="stable"), MIN_SPACING_MM * (1 - 1e-9), []
    for step in range(1, len(centers)):
        apart = centers[along[step:]] - centers[along[:-step]]
        if apart[:, 0].min() > least:
            break
        near = np.flatnonzero(np.hypot(*apart.T) <= least)
        pairs += [tuple(sorted(map(int, pair))) for pair in zip(along[near], along[near + step], strict=True)]
    return min(pairs, default=None)


def _check_reach(design) -> None:
    """Each lens has a sub-image on the sensor; on a region of a larger sensor one lens has."""
    distance, radius = reach(design)
    beyond = distance > radius
    if beyond.all() or (beyond.any() and design.sensor.origin_mm is None):
        index = int(np.argmax(beyond))
        most = f"at most {radius:.4g} mm beside the sensor, the radius of a lens's image of the field"
        raise ValueError(
            f"`array.centers_mm` must be {most}, got {_lens(design, index)}, {distance[index]:.4g} mm beside it"
        )


def reach(design) -> tuple[Float[np.ndarray, " lens"], float]:
    """Distance of each lens beside the sensor, and the radius of its image of the field at the nearest depth, mm.

    That image is the disc `v'/z' field_radius` about its vertex.
    """
    imaging, calibration = design.imaging, design.calibration
    angle = math.radians(calibration.rotation_deg)
    rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    centers = np.array(design.array.centers_mm) @ rotation.T + calibration.shift_mm
    middle = np.array(design.sensor.origin_mm or (0.0, 0.0))
    distance = beside_sensor(centers - middle, design.sensor.shape, design.sensor.pixel_pitch_um)
    nearest = max(imaging.working_distance_mm[0], object_begins(design))
    magnification = reduced_sensor_distance(design, imaging.sensor_distance_mm) / reduced_depth(design, nearest)
    return distance, magnification * imaging.field_radius_mm


def beside_sensor(
    centers: Float[np.ndarray, "lens 2"], shape: tuple[int, int], pixel_pitch_um: float
) -> Float[np.ndarray, " lens"]:
    """Lateral distance of each lens from a sensor, mm; 0 above it."""
    half = np.array(shape)[::-1] * pixel_pitch_um / 2000
    return np.hypot(*np.maximum(np.abs(centers) - half, 0).T)


def _lens(design, index: int) -> str:
    return f"lens {index + 1} at {list(design.array.centers_mm[index])} mm"


# Usual ranges, in the unit of the key: the smallest and the largest microlenses that are built.
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
    "layers.object.thickness_mm": (0.01, 100.0),
    "layers.sensor.thickness_mm": (0.01, 20.0),
    "sample.refractive_index": (1.0, 2.0),
    "sample.surface_mm": (0.0, 2000.0),
    "sample.layers.thickness_mm": (0.01, 100.0),
}
_FACTORS = (1e-3, 1e3, 1e-6, 1e6, 1e9)
_LADDER = ("nm", "um", "mm", "m")
# Larger numbers are not lengths, and larger integers not floats.
_LARGEST = 1e30
# Largest usual ratio of sensor distance and image distance, and of field radius and depth (63 degrees).
_MOST_OFF, _WIDEST = 3.0, 2.0
# Lenses closer than their diameter over this number are in another unit, such as metres that are read as mm.
_CLOSEST = 50.0
# Lenses whose nearest neighbour is computed.
_SOME = 100


def slips(data: Mapping[str, Any]) -> list[str]:
    """Questions about numbers of a design's tables that would be usual in another unit.

    `data`: the tables of a file; entries that are not numbers are ignored.
    """
    questions = (slip(key, value, name) for key in USUAL for name, value in _values(data, key))
    return [question for question in questions if question]


def slip(key: str, value: Any, name: str | None = None) -> str | None:
    """The question about a value of a key, called `name` in it; None if it is usual, or not a positive number."""
    numbers = _positive(value)
    (low, high), unit = USUAL[key], unit_of(key)
    if not numbers or all(low <= number <= high for number in numbers):
        return None
    question = other_unit(numbers, USUAL[key], unit)
    question = question or f"is it meant? Usual is {low:g} to {high:g} {unit}".rstrip() + "."
    return f"{name or key} = {_numbers(numbers)}: {question}"


def other_unit(numbers: list[float], usual: tuple[float, float], unit: str) -> str | None:
    """Ask whether unusual numbers are in another unit, in which they would be usual; None if there is no such unit."""
    if not numbers or all(usual[0] <= number <= usual[1] for number in numbers):
        return None
    if (other := _other(usual, unit, numbers)) is None:
        return None
    meant, their_unit = other
    as_given = f" ({_numbers(numbers)} {their_unit})" if their_unit else ""
    return f"did you mean {_numbers(meant)} {unit}{as_given}?"


def meant(key: str, value: Any) -> float | list[float] | None:
    """The value converted to the key's unit if it looks as if it was given in another one; otherwise None."""
    if slip(key, value) is None or (other := _other(USUAL[key], unit_of(key), _positive(value))) is None:
        return None
    return other[0] if isinstance(value, list | tuple) else other[0][0]


def doubts(data: Mapping[str, Any], design) -> list[str]:
    """Questions about a design and its tables in a file: those of `slips`, or else unlikely combinations."""
    return slips(data) or list(_unlikely(design))


def unit_of(key: str) -> str:
    """The unit at the end of a key; empty if there is none."""
    unit = key.rpartition("_")[2]
    return unit if unit in (*_LADDER, "deg") else ""


def _positive(value: Any) -> list[float]:
    """The positive numbers of a value as floats; empty for anything else."""
    numbers = list(value) if isinstance(value, list | tuple) else [value]
    is_right = all(type(number) in (int, float) and 0 < number < _LARGEST for number in numbers)
    return [float(number) for number in numbers] if is_right else []


def _other(usual: tuple[float, float], unit: str, numbers: list[float]) -> tuple[list[float], str | None] | None:
    """Usual numbers that differ by a power of a thousand, and the unit in which the given numbers would be these."""
    if unit not in _LADDER:
        return None
    low, high = usual
    for factor in _FACTORS:
        scaled = [float(f"{number * factor:.9g}") for number in numbers]
        if all(low <= number <= high for number in scaled):
            step = _LADDER.index(unit) + round(math.log10(factor) / 3)
            return scaled, _LADDER[step] if 0 <= step < len(_LADDER) else None
    return None


def _values(data: Mapping[str, Any], key: str) -> Iterator[tuple[str, Any]]:
    """All values of a key with their names; those of `[sample]` in `[samples]` too."""
    table, _, name = key.partition(".")
    inner = data.get(table)
    if table == "lens" and isinstance(inner, Mapping) and (numbers := sorted(set(_positive(inner.get(name))))):
        yield key, numbers if len(numbers) == 1 else [numbers[0], numbers[-1]]  # one number a lens: the extremes
    else:
        yield from _within(data, key.split("."), "")
    if table == "sample" and isinstance(named := data.get("samples"), Mapping):
        for sample, inner in named.items():
            yield from _within(inner, name.split("."), f"samples.{sample}")


def _within(node: Any, steps: list[str], path: str) -> Iterator[tuple[str, Any]]:
    """Yield the values at the end of some steps into tables and lists of tables, with their paths."""
    if not steps:
        yield path, node
    elif isinstance(node, Mapping) and steps[0] in node:
        yield from _within(node[steps[0]], steps[1:], f"{path}.{steps[0]}".removeprefix("."))
    elif isinstance(node, list | tuple):
        for i, inner in enumerate(node):
            yield from _within(inner, steps, f"{path}[{i}]")


def _numbers(values: list[float]) -> str:
    shown = [f"{value:.9g}" for value in values]
    return shown[0] if len(shown) == 1 else f"[{', '.join(shown)}]"


def _unlikely(design) -> Iterator[str]:
    lens, array, imaging = design.lens, design.array, design.imaging
    near, far = imaging.working_distance_mm
    working, depths = f"imaging.working_distance_mm = [{near:g}, {far:g}]: is it meant?", f"{near:g} to {far:g} mm"
    if near < (start := object_begins(design)):
        yield f"{working} The object's medium begins at {start:g} mm."
    v = imaging.sensor_distance_mm
    behind = reduced_sensor_distance(design, v) - v
    radius, diameters = np.array(lens.radius_of_curvature_mm, float), np.array(lens.aperture_diameter_mm, float)
    f = np.array(lens.focal_length_mm or radius / (design.refractive_index - 1))
    least, most = float(f.min()), float(f.max())
    focal = f"{least:.4g}" if least == most else f"{least:.4g} to {most:.4g}"
    nearest, farthest = reduced_depth(design, near), reduced_depth(design, far)
    if nearest <= least:
        yield f"{working} Nearer than the focal length, {focal} mm, no real image forms."
    else:
        longest = 1 / (1 / most - 1 / nearest) - behind if nearest > most else math.inf
        shortest = 1 / (1 / least - 1 / farthest) - behind
        if not shortest / _MOST_OFF <= v <= longest * _MOST_OFF:
            images = f"Lenses of f = {focal} mm image {depths} at {shortest:.4g} to {longest:.4g} mm."
            yield f"imaging.sensor_distance_mm = {v:g}: is it meant? {images}"
    if (field := imaging.field_radius_mm) > _WIDEST * far:
        yield f"imaging.field_radius_mm = {field:g}: is it meant? A lens sees so far beside its axis at {depths}."
    if (diameter := float(diameters.max())) > 2 * (plate_size := max(array.size_mm)):
        yield f"lens.aperture_diameter_mm = {diameter:g}: is it meant? The whole plate is {plate_size:g} mm."
    pitch = _pitch(np.array(array.centers_mm, float))
    if pitch < diameter / _CLOSEST:
        meant = f"did you mean {pitch * 1000:.3g} mm, a list in another unit?"
        yield f"array.centers_mm: lenses of {diameter:g} mm are {pitch:.3g} mm apart; {meant}"
    half = np.minimum(np.minimum(diameters, pitch) / 2, radius)
    height = float(np.max(radius - np.sqrt(radius**2 - half**2)))  # of spheres, which others are not far from
    if 0 < (thickness := array.substrate_thickness_mm) < height and not lens.focal_length_mm:
        question = f"array.substrate_thickness_mm = {thickness:g}: is it meant?"
        yield f"{question} It counts to the vertices of the lenses, which alone are {height:.3g} mm high."


def _pitch(centers: np.ndarray) -> float:
    """Mean distance of about a hundred lenses from their nearest neighbour; infinite for two lenses or fewer."""
    if len(centers) <= 2:
        return math.inf
    some = centers[:: len(centers) // _SOME + 1]
    # Without SciPy, whose import takes longer. The nearest point is the lens itself.
    return float(np.mean([np.partition(np.hypot(*(centers - center).T), 1)[1] for center in some]))
