"""What is wrong with a design that only the whole of it shows: its parts do not fit together.

One problem at a time; each message names its key. What is checked here is a `design.Design` that is being made.
"""

import math

import numpy as np
from jaxtyping import Float

from ..lenses import sag_slope_over_r
from .centers import LENS_KEYS, other_reading

MIN_SPACING_MM = 1e-3
# Radii at which a lens is asked whether it falls.
_RADII = 64


def check_whole(design) -> None:
    """Raises `ValueError` unless the numbers, the plate, the lenses and the sensor of a design fit together."""
    for check in (_check_numbers, _check_lenses, _check_plate, _check_spacing, _check_reach):
        check(design)


_CENTERS = "`array.centers_mm`"


def _check_numbers(design) -> None:
    near, far = design.imaging.working_distance_mm
    if not near < far:
        raise ValueError(f"`imaging.working_distance_mm` must be [near, far], near below far, got [{near}, {far}]")


def of_each(design, key: str) -> tuple[float, ...]:
    """The number that each lens has, of one of `LENS_KEYS`."""
    value = getattr(design.lens, key)
    return value if isinstance(value, tuple) else (value,) * len(design.array.centers_mm)


def _check_lenses(design) -> None:
    lens, count = design.lens, len(design.array.centers_mm)
    for key in LENS_KEYS:
        if (found := len(of_each(design, key))) != count:
            raise ValueError(f"`lens.{key}` must be one number or {count}, one a lens, got {found}")
    first: dict[tuple[float, ...], int] = {}
    for number, one in enumerate(zip(*(of_each(design, key) for key in LENS_KEYS), strict=True), 1):
        first.setdefault(one, number)
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
    """Of a conic surface, mm: where it is vertical; infinite of paraboloids and hyperboloids."""
    return 2 * radius / math.sqrt(1 + conic_constant) if conic_constant > -1 else math.inf


def plate_as_air(thickness: float, refractive_index: float, orientation: str) -> tuple[float, float]:
    """The plate before the lens vertices and behind them, as so much air, mm: `t/n` and 0, or the other way round."""
    reduced = thickness / refractive_index
    return (reduced, 0.0) if orientation == "plano" else (0.0, reduced)


def _check_plate(design) -> None:
    centers = np.array(design.array.centers_mm)
    half = np.array(design.array.size_mm) / 2
    outside = (np.abs(centers) > half + 1e-9).any(axis=1)
    if outside.any():
        plate = f"within the plate `array.size_mm`, |x| up to {half[0]} mm and |y| up to {half[1]} mm"
        lens = _lens(design, int(np.argmax(outside)))
        raise ValueError(f"{_CENTERS} must be {plate}, got {lens}{other_reading(centers, half)}")


def _check_spacing(design) -> None:
    if pair := _close_pair(np.array(design.array.centers_mm)):
        got = f"{_lens(design, pair[0])} and lens {pair[1] + 1} nearer to it"
        raise ValueError(f"{_CENTERS} must be at least {MIN_SPACING_MM} mm apart, got {got}")


def _close_pair(centers: np.ndarray) -> tuple[int, int] | None:
    # Two in one cell of half the spacing are too close. Without them few are close to any along x.
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
        raise ValueError(f"{_CENTERS} must be {most}, got {_lens(design, index)}, {distance[index]:.4g} mm beside it")


def reach(design) -> tuple[Float[np.ndarray, " lens"], float]:
    """How far beside the sensor each lens is, and how far its image of the field goes at the nearest depth, mm.

    That image is the disc `v'/z' field_radius` about its vertex.
    """
    imaging, calibration = design.imaging, design.calibration
    angle = math.radians(calibration.rotation_deg)
    rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    centers = np.array(design.array.centers_mm) @ rotation.T + calibration.shift_mm
    middle = np.array(design.sensor.origin_mm or (0.0, 0.0))
    distance = beside_sensor(centers - middle, design.sensor.shape, design.sensor.pixel_pitch_um)
    lens = design.lens
    front, back = plate_as_air(design.array.substrate_thickness_mm, lens.refractive_index, lens.orientation)
    near, v = imaging.working_distance_mm[0] + front, imaging.sensor_distance_mm + back
    radius = v / near * imaging.field_radius_mm
    return distance, radius


def beside_sensor(
    centers: Float[np.ndarray, "lens 2"], shape: tuple[int, int], pixel_pitch_um: float
) -> Float[np.ndarray, " lens"]:
    """How far from a sensor each lens is, mm; 0 above it."""
    half = np.array(shape)[::-1] * pixel_pitch_um / 2000
    return np.hypot(*np.maximum(np.abs(centers) - half, 0).T)


def _lens(design, index: int) -> str:
    return f"lens {index + 1} at {list(design.array.centers_mm[index])} mm"
