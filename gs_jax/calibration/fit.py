"""The sensor's distance, the array's rotation and shift, from captures of single point sources at known places."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Float64, Num

from ..base.errors import InputError
from ..base.progress import Progress
from ..geometry import Imager, MicrolensArray, chief_ray
from .matching import Similarity, match
from .spots import core_offsets, find_spots

# Spots looked for in a capture.
_SPOTS = 60
# How far the sensor's distance may be off, relative, and what lens a spot is of, mm on the sensor: wide, then narrow.
_DISTANCE, _WITHIN = 0.25, (0.06, 0.03, 0.015)
# Of the sensor's distance, relative, for the slope of what exact rays say.
_STEP = 1e-2
# Residuals beyond so many pixels count less (Huber).
_OUTLIER = 0.5
# Fields at which exact rays are traced, and the degree of what is laid through them.
_FIELDS, _DEGREE = 13, 7
# Parameters whose common direction changes nothing by more than this, relative, are not determined.
_LEAST = 1e-6
NAMES = ("sensor_distance_mm", "rotation_deg", "shift_x_mm", "shift_y_mm")


class Spots(NamedTuple):
    """Spots that are of known lenses: their points, lenses and places, mm on the sensor."""

    points: Float64[np.ndarray, "spot 3"]
    lenses: np.ndarray
    places: Float64[np.ndarray, "spot 2"]
    captures: np.ndarray


class Calibration(NamedTuple):
    """What was found.

    Parameters
    ----------
    imager
        The microscope; its array's centres are mirrored, y against -y, if `mirrored`.
    mirrored
        Whether the array is the other way round than in the design.
    deviations
        Standard deviations of `NAMES`, from the Gauss-Newton covariance and the residuals.
    spots, residuals
        The spots, and how far each is from where it should be, `(x, y)`, pixels.
    """

    imager: Imager
    mirrored: bool
    deviations: dict[str, float]
    spots: Spots
    residuals: Float64[np.ndarray, "spot 2"]

    @property
    def rms(self) -> float:
        """Of the distances, pixels."""
        return float(np.sqrt((self.residuals**2).sum(1).mean()))


def calibrate(
    images: Sequence[Num[Array | np.ndarray, "row column"]],
    points: Float[np.ndarray, "image 3"],
    imager: Imager,
    *,
    progress: Progress | None = None,
) -> Calibration:
    """Finds a microscope's geometry in captures of a point source, from a design that is about right.

    The spots of each capture are matched to the lenses at any rotation, mirrored or not, with a sensor distance within
    a quarter of the design's. Then sensor distance, rotation and shift are fitted by Levenberg-Marquardt to the spots
    within the field radius, with a robust loss. Where spots are is predicted by exact rays: what aberrations do is not
    fitted away.

    Parameters
    ----------
    images
        One a point.
    points
        `(x, y, z)` of the source in each, mm, in the sensor's frame.
    imager
        The microscope as designed.

    Raises
    ------
    InputError
        As `check_positions`; if no pattern of lenses is seen in any image, or the spots do not determine the geometry.
    """
    progress = progress or Progress()
    check_positions(points, len(images))
    found = [_spots_in(image, imager) for image in progress.track(images, "Finding spots")]
    with progress.step("Matching lenses"):
        start, mirrored = _start(found, points, imager)
    fitted, spots = start, None
    for within in progress.track(_WITHIN, "Fitting"):
        offset = _offsets(fitted, points)
        spots = _assigned(found, points, fitted, offset, within)
        if len(spots.lenses) < len(NAMES):
            raise InputError(f"captures: found {len(spots.lenses)} spots of lenses, allowed: {len(NAMES)} or more.")
        fitted = _fitted(fitted, spots, offset)
    assert spots is not None
    offset = _offsets(fitted, points)
    residuals = _residuals_of(fitted, spots, offset)
    return Calibration(fitted, mirrored, _deviations(fitted, spots, offset), spots, residuals)


def check_positions(points: Float[np.ndarray, "image 3"], count: int) -> None:
    """`InputError` unless there is a point for each of some captures, in front of the plate."""
    if not count or len(points) != count:
        raise InputError(f"positions: found {len(points)} for {count} captures, allowed: one for each.")
    if not (points[:, 2] > 0).all():
        raise InputError(f"positions: found the depth {points[:, 2].min():g} mm, allowed: above 0.")


def residuals_of(
    found: Calibration, images: Sequence[Num[Array | np.ndarray, "row column"]], points: Float[np.ndarray, "image 3"]
) -> Float64[np.ndarray, "spot 2"]:
    """How far the spots of other captures are from where a calibration puts them, `(x, y)`, pixels."""
    imager = found.imager
    seen = [_spots_in(image, imager) for image in images]
    offset = _offsets(imager, points)
    return _residuals_of(imager, _assigned(seen, points, imager, offset, _WITHIN[0]), offset)


def _spots_in(image, imager: Imager) -> Float64[np.ndarray, "spot 2"]:
    """Places on the sensor, mm."""
    return np.asarray(imager.sensor.to_mm(find_spots(image, _SPOTS)), np.float64)


def _residuals_of(imager: Imager, spots: Spots, offset) -> Float64[np.ndarray, "spot 2"]:
    return np.asarray(_residuals(_free(imager), _known(imager, spots, offset)), np.float64)


def _start(found, points, imager) -> tuple[Imager, bool]:
    """The geometry that the capture with the clearest pattern shows."""
    centers = np.asarray(imager.array.centers, np.float64)
    scales = np.asarray(imager.scale(points[:, 2]), np.float64)
    matches = [
        match(spots, centers, scale, _DISTANCE * (1 - 1 / scale)) for spots, scale in zip(found, scales, strict=True)
    ]
    clearest = max(range(len(matches)), key=lambda k: matches[k].on_lenses)
    best = matches[clearest]
    if not best.is_clear:
        text = f"{best.on_lenses} of {best.tried} bright spots on lenses at best"
        raise InputError(f"captures: found {text}, allowed: the spots of one point source in most, and this array.")
    return _seen(best, points[clearest], imager), best.mirrored


def _seen(found: Similarity, point, imager: Imager) -> Imager:
    """`p = s c - M q` with `s = 1 + M`: scale, rotation and shift of the pattern say where the array is."""
    scale, (x, y, z) = abs(found.factor), point
    magnification = scale - 1
    shift = (found.shift + magnification * complex(x, y)) / scale
    array = _mirrored(imager.array) if found.mirrored else imager.array
    distance = magnification * float(imager.reduced_depth(z))
    where = lambda i: (i.array, i.sensor_distance, i.rotation, i.shift)
    typed = lambda value: jnp.asarray(value, imager.sensor_distance.dtype)
    new = (array, typed(distance), typed(found.rotation), typed((shift.real, shift.imag)))
    return eqx.tree_at(where, imager, new)


def _mirrored(array: MicrolensArray) -> MicrolensArray:
    """The complex conjugate of the matches, and a turn, are x against -x: y against -y is what they say."""
    return eqx.tree_at(lambda a: a.centers, array, array.centers * jnp.asarray([[1.0, -1.0]], array.centers.dtype))


def _offsets(imager: Imager, points) -> dict[float, np.ndarray]:
    """Of cores from chief rays, by depth, and how they change with the sensor's distance: `(2, power)`.

    Coefficients of odd powers of the field, which even out the rays' noise.
    """
    depths, fields = np.unique(points[:, 2]), np.linspace(0, imager.field_radius, _FIELDS)
    powers, v = _powers(fields / imager.field_radius), float(imager.sensor_distance)
    moved = eqx.tree_at(lambda i: i.sensor_distance, imager, imager.sensor_distance * (1 + _STEP))
    here, beyond = (core_offsets(each, depths, fields) for each in (imager, moved))
    fit = lambda row: np.linalg.lstsq(powers, row)[0]
    return {
        float(z): np.stack([fit(row), fit(slope / (v * _STEP))])
        for z, row, slope in zip(depths, here, beyond - here, strict=True)
    }


def _powers(part):
    return part[:, None] ** np.arange(1, _DEGREE + 1, 2)


def _assigned(found, points, imager: Imager, offset, within: float) -> Spots:
    """The spot nearest to where each lens within the field radius should have one, if it is near enough."""
    rows, centers = [], np.asarray(imager.centers, np.float64)
    for number, (spots, point) in enumerate(zip(found, points, strict=True)):
        lenses = np.flatnonzero(np.hypot(*(centers - point[:2]).T) < imager.field_radius)
        if not len(spots) or not len(lenses):
            continue
        expected = _expected(imager, np.tile(point, (len(lenses), 1)), lenses, offset)
        distance = np.linalg.norm(expected[:, None] - spots[None], axis=-1)
        nearest = distance.argmin(1)
        for k in np.flatnonzero(distance.min(1) < within):
            rows.append((point, lenses[k], spots[nearest[k]], number))
    if not rows:
        return Spots(np.zeros((0, 3)), np.zeros(0, int), np.zeros((0, 2)), np.zeros(0, int))
    return Spots(*map(np.array, zip(*rows, strict=True)))


def _expected(imager: Imager, points, lenses, offset) -> Float64[np.ndarray, "spot 2"]:
    at_0 = Spots(points, lenses, np.zeros((len(lenses), 2)), np.zeros(len(lenses), int))
    return _residuals_of(imager, at_0, offset) * imager.sensor.pixel_pitch


def _shift_of_cores(imager: Imager, spots: Spots, offset) -> Float64[np.ndarray, "2 spot 2"]:
    """Where exact rays put the core of each spot, from its chief ray, mm, and its slope by the sensor's distance."""
    beside = spots.points[:, :2] - np.asarray(imager.centers, np.float64)[spots.lenses]
    field = np.hypot(*beside.T)
    away = np.divide(beside, field[:, None], out=np.zeros_like(beside), where=field[:, None] > 0)
    coefficients = np.array([offset[float(z)] for z in spots.points[:, 2]]).reshape(len(field), 2, -1)
    along = (_powers(field / imager.field_radius)[:, None] * coefficients).sum(-1)
    return along.T[..., None] * away


def _known(imager: Imager, spots: Spots, offset) -> tuple[Any, ...]:
    """What `_residuals` does not change."""
    cores = _shift_of_cores(imager, spots, offset)
    return (imager, *map(jnp.asarray, (spots.points, spots.lenses, spots.places, cores)))


def _free(imager: Imager) -> Float[Array, "4"]:
    return jnp.concatenate([imager.sensor_distance[None], imager.rotation[None], imager.shift])


def _with(imager: Imager, free: Float[Array, "4"]) -> Imager:
    where = lambda i: (i.sensor_distance, i.rotation, i.shift)
    return eqx.tree_at(where, imager, (free[0], free[1], free[2:]))


@jax.jit
def _residuals(free: Float[Array, "4"], known: Any) -> Float[Array, "spot 2"]:
    """Where spots should be, less where they are, pixels."""
    imager, points, lenses, places, cores = known
    before, imager = imager.sensor_distance, _with(imager, free)
    points, places, cores = (x.astype(free.dtype) for x in (points, places, cores))
    magnification = imager.magnification(points[:, 2])[:, None]
    moved = cores[0] + (free[0] - before) * cores[1]
    expected = chief_ray(imager.centers[lenses], points[:, :2], magnification) + moved
    return (expected - places) / imager.sensor.pixel_pitch


def _robust(free, known):
    """Of Huber's loss, as a residual: its square grows like the distance where that is large."""
    residual = _residuals(free, known)
    squared = jnp.sum(residual**2, -1, keepdims=True)
    large = squared > _OUTLIER**2
    distance = jnp.sqrt(jnp.where(large, squared, 1.0))
    return residual * jnp.where(large, jnp.sqrt(2 * _OUTLIER * distance - _OUTLIER**2) / distance, 1.0)


def _fitted(imager: Imager, spots: Spots, offset) -> Imager:
    known = _known(imager, spots, offset)
    _check_determined(jax.jacfwd(_residuals)(_free(imager), known), imager)
    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    return _with(imager, optx.least_squares(_robust, solver, _free(imager), known, throw=False).value)


def _check_determined(jacobian, imager: Imager) -> None:
    """Each parameter by what of it moves a spot by a millimetre."""
    columns = np.asarray(jacobian, np.float64).reshape(-1, len(NAMES)) * imager.sensor.pixel_pitch
    values = np.linalg.svd(columns, compute_uv=False)
    if values[-1] < _LEAST * values[0]:
        raise InputError(f"captures: found spots that do not tell {', '.join(NAMES)} apart, allowed: more points.")


def _deviations(imager: Imager, spots: Spots, offset) -> dict[str, float]:
    known = _known(imager, spots, offset)
    residual = _residuals_of(imager, spots, offset).ravel()
    jacobian = np.asarray(jax.jacfwd(_residuals)(_free(imager), known), np.float64).reshape(-1, len(NAMES))
    # The median: outliers are not the noise.
    variance = (np.median(np.abs(residual)) / 0.6745) ** 2 * residual.size / max(residual.size - len(NAMES), 1)
    deviations = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)) * variance)
    deviations[1] = math.degrees(deviations[1])
    return dict(zip(NAMES, deviations.tolist(), strict=True))
