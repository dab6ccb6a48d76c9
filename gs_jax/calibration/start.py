"""Where a calibration begins: rotation, mirror, shift and sensor distance from the pattern of the lenses."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float64, Int, Shaped
from scipy.spatial import KDTree

from ..base.errors import InputError
from ..detection.consistency import signal
from ..geometry import Imager
from ..lenses import EACH, MicrolensArray, lenses_by_type
from ..optics.lens_types import FIELDS
from ..optics.psf_core import ensquared_light
from ..optics.raytrace import to_numpy
from .matching import Similarity, match, match_shift, meeting_lenses, near_of
from .sources import Sources, assigned
from .unknowns import moved_lenses, offsets_of

# How far the sensor's distance may be off, relative, and in how many steps it is searched for without known lenses.
_DISTANCE, _STEPS = 0.25, 51
# Without a known depth: scale of the pattern, and how far it may be off, relative.
_SCALE, _SCALE_OFF = 1.3, 0.2
# Guesses that are compared.
_GUESSES = 6
# Share of the spots that must be on lenses which other captures show, too.
_SHARED = 0.5
# How near lines pass that meet in a lens of no list, in field radii: 0.06 mm of the paper's.
_MEETING = 0.02
# Half the sides of the squares of a spot that tell a lens's type, pixels, and how often types are chosen again.
_SQUARES, _ROUNDS = (1, 5), 10
# Least share of a point's light in a square, whose logarithm is finite.
_LEAST_SHARE = 1e-12


class Start(NamedTuple):
    """A geometry and sources that explain most spots."""

    imager: Imager
    mirrored: bool
    sources: Sources


def begin(found: Sequence[Float64[np.ndarray, "_ 2"]], sources: Sources, imager: Imager) -> Start:
    """From the capture with the clearest pattern; of several sources, that which explains most spots of all captures.

    Parameters
    ----------
    found
        Spots of each capture, `(x, y)`, mm, brightest first.
    sources, imager
        What is known.

    Raises
    ------
    InputError
        If no capture has a clear pattern.
    """
    centers = np.asarray(imager.array.centers, np.float64)
    guesses = []
    for source, point in enumerate(sources.points):
        capture = int(sources.captures[source])
        scale, tolerance = _scale(imager, point[2])
        others = int((sources.captures == capture).sum())
        guesses.append((match(found[capture], centers, scale, tolerance, others), source))
    guesses.sort(key=lambda guess: -guess[0].on_lenses)
    best = guesses[0][0]
    if not best.is_clear:
        text = f"{best.on_lenses} of {best.tried} bright spots on lenses at best"
        raise InputError(f"captures: found {text}, allowed: the spots of point sources in most, and this array.")
    # Points that lack a coordinate say less of the geometry.
    clear = [(each, source) for each, source in guesses if each.is_clear]
    clear.sort(key=lambda guess: int(np.isnan(sources.points[guess[1]]).sum()))
    # Where each capture has one source, the clearest pattern is that source's.
    alone = len(np.unique(sources.captures)) == len(sources.captures)
    guesses = clear[: 1 if alone else _GUESSES]
    starts = [_begun(each, source, found, sources, imager) for each, source in guesses]
    return starts[0] if len(starts) == 1 else max(starts, key=lambda start: _explained(found, start))


def _scale(imager: Imager, depth: float) -> tuple[float, float]:
    """Of the pattern on the sensor, and how far it may be off, relative."""
    if np.isnan(depth):
        return _SCALE, _SCALE_OFF
    scale = float(imager.scale(depth))
    return scale, _DISTANCE * (1 - 1 / scale)


def _explained(found, start: Start) -> int:
    offsets = offsets_of(start.imager, start.sources.points[:, 2])
    return len(assigned(found, start.sources, start.imager, offsets, near_of(start.imager.array.centers)).lenses)


def _begun(best: Similarity, source: int, found, sources: Sources, imager: Imager) -> Start:
    seen = _seen(best, sources.points[source], imager)
    return Start(seen, best.mirrored, _placed(found, sources, seen))


def _seen(found: Similarity, point, imager: Imager) -> Imager:
    """`p = s c - M q` with `s = 1 + M`: scale, rotation and shift of the pattern say where the array is."""
    scale, (x, y, z) = abs(found.factor), point
    magnification = scale - 1
    array = _mirrored(imager.array) if found.mirrored else imager.array
    reduced = imager.reduced_sensor_distance if np.isnan(z) else magnification * float(imager.reduced_depth(z))
    distance = reduced - imager.array.reduced_thickness_back
    shift = (found.shift + magnification * complex(x, y)) / scale
    shift = imager.shift if np.isnan(shift) else (shift.real, shift.imag)
    where = lambda i: (i.array, i.sensor_distance, i.rotation, i.shift)
    typed = lambda value: jnp.asarray(value, imager.sensor_distance.dtype)
    return eqx.tree_at(where, imager, (array, typed(distance), typed(found.rotation), typed(shift)))


def _mirrored(array: MicrolensArray) -> MicrolensArray:
    """The complex conjugate of the matches: y against -y."""
    return moved_lenses(array, array.centers * jnp.asarray([[1.0, -1.0]], array.centers.dtype))


def _placed(found, sources: Sources, imager: Imager) -> Sources:
    """Sources with coordinates that nobody gave, from where the pattern of the lenses is in their captures."""
    points, left = sources.points.copy(), [np.asarray(spots) for spots in found]
    # Spots of the sources that are known are not those of the others.
    for source in np.argsort(np.isnan(points).any(1), kind="stable"):
        capture = int(sources.captures[source])
        missing = np.isnan(points[source])
        if missing.any():
            points[source] = np.where(missing, _place(left[capture], points[source, 2], imager), points[source])
        left[capture] = _without(left[capture], points[source], imager)
    return sources._replace(points=points)


def _place(spots, depth: float, imager: Imager) -> tuple[float, float, float]:
    """Where the source is that most of the spots are of, at a depth, or at any if that is NaN."""
    if np.isnan(depth):
        near = match(spots, np.asarray(imager.array.centers, np.float64), *_scale(imager, depth))
        magnification = max(abs(near.factor) - 1, 1e-3)
        depth = max(float(imager.reduced_sensor_distance) / magnification - float(imager.reduced_depth(0.0)), 1e-3)
    magnification = float(imager.magnification(depth))
    pattern = (1 + magnification) * np.asarray(imager.centers, np.float64)
    shift, _ = match_shift(spots, pattern, near_of(imager.array.centers))
    x, y = -shift / magnification
    return float(x), float(y), depth


def _without(spots, point, imager: Imager):
    """The spots that are not of a source."""
    views = to_numpy(imager).views_of_all(np.asarray(point, np.float64)[None])
    seen = np.linalg.norm(views.offset[:, 0], axis=1) < imager.field_radius
    if not len(spots) or not seen.any():
        return spots
    return spots[np.asarray(KDTree(views.spot[seen, 0]).query(spots)[0]) > near_of(imager.array.centers)]


def begin_without_lenses(
    found: Sequence[Float64[np.ndarray, "_ 2"]],
    sources: Sources,
    imager: Imager,
    images: Sequence[Shaped[Array | np.ndarray, "row column"]] = (),
) -> Start:
    """Finds lens centres in what the captures of known points have in common, at the best sensor distance.

    Where the design's lenses are of several types, `images` tell which type each lens is, by the light of its spots.

    Raises
    ------
    InputError
        If a point is not known, a capture has several, or too few spots meet.
    """
    points = sources.points
    if np.isnan(points).any() or len(np.unique(sources.captures)) < len(points) or len(points) < 2:
        text = f"{int(np.isnan(points).any(1).sum())} of {len(points)} points unknown"
        allowed = "known points, two or more, one in each capture, to find lenses"
        raise InputError(f"positions: found {text}, allowed: {allowed}.")
    spots = [found[int(k)] for k in sources.captures]
    nominal = np.asarray(imager.magnification(points[:, 2]), np.float64)
    steps, near = np.linspace(1 - _DISTANCE, 1 + _DISTANCE, _STEPS), _MEETING * imager.field_radius
    met = np.array([meeting_lenses(spots, points[:, :2], step * nominal, near / 4)[2] for step in steps])
    step = float(steps[met == met.max()].mean())
    centers, count, _ = meeting_lenses(spots, points[:, :2], step * nominal, near)
    if not count or count < _SHARED * sum(map(len, spots)):
        text = f"{count} of {sum(map(len, spots))} spots on lenses that several captures show"
        allowed = "half of them; are positions and the sensor's pixels right?"
        raise InputError(f"captures: found {text}, allowed: {allowed}")
    where = lambda i: (i.array, i.sensor_distance, i.rotation, i.shift, i.tilt)
    zero = jnp.zeros((), imager.sensor_distance.dtype)
    distance = imager.reduced_sensor_distance * step - imager.array.reduced_thickness_back
    # Rotation, shift and tilt are in the lenses' places.
    types = [imager.array.lens(int(which[0])) for which in lenses_by_type(imager.array)]
    new = (moved_lenses(types[0], centers), distance, zero, jnp.zeros(2, zero.dtype), None)
    start = eqx.tree_at(where, imager, new, is_leaf=lambda leaf: leaf is None)
    if len(types) > 1:
        of_type = [eqx.tree_at(lambda i: i.array, start, moved_lenses(one, centers)) for one in types]
        array = array_of_types(
            types, centers, lens_types([images[int(k)] for k in sources.captures], spots, points, of_type)
        )
        start = eqx.tree_at(lambda i: i.array, start, array)
    return Start(start, False, sources)


def array_of_types(types: Sequence[MicrolensArray], centers, of_lens: Int[np.ndarray, " lens"]) -> MicrolensArray:
    """Lenses at some centres, each with the numbers of its type."""
    numbers = {name: np.array([float(getattr(one, name)) for one in types])[of_lens] for name in EACH}
    return dataclasses.replace(types[0], centers=jnp.asarray(centers, types[0].centers.dtype), **numbers)


def lens_types(
    images: Sequence[Shaped[Array | np.ndarray, "row column"]],
    spots: Sequence[Float64[np.ndarray, "_ 2"]],
    points: Float64[np.ndarray, "image 3"],
    imagers: Sequence[Imager],
) -> Int[np.ndarray, " lens"]:
    """The type of each lens, by the light of its spots in a small and in a large square, one point in each image.

    Exact rays predict the light for each type, up to the brightness of the source and the camera's blur: a factor for
    each capture and square. Types and factors are those of the least sum of absolute deviations of the logarithms.
    """
    host, count = to_numpy(imagers[0]), len(imagers[0].array.centers)
    near, fields = near_of(host.array.centers), np.linspace(0, host.field_radius, FIELDS)
    sides = [(2 * half + 1) * host.sensor.pixel_pitch for half in _SQUARES]
    depths = np.unique(points[:, 2])
    tables = np.array([[ensquared_light(one, depths, fields, side) for side in sides] for one in imagers])
    off = np.full((len(imagers), len(images), len(sides), count), np.nan)
    for number, (image, places, point) in enumerate(zip(images, spots, points, strict=True)):
        views = host.views_of_all(point[None])
        field = np.linalg.norm(views.offset[:, 0], axis=1)
        distance, nearest = map(np.asarray, KDTree(places).query(views.spot[:, 0]))
        seen = np.flatnonzero((distance < near) & (field < host.field_radius))
        light, middle = signal(image).light, np.rint(host.sensor.to_pixels(places[nearest[seen]])).astype(int)
        for square, half in enumerate(_SQUARES):
            side = np.arange(-half, half + 1)
            at = [np.clip(part[:, None] + side, 0, size - 1) for part, size in zip(middle.T, light.shape, strict=True)]
            total = light[at[0][:, :, None], at[1][:, None]].sum((1, 2))
            table = tables[:, square, np.searchsorted(depths, point[2])]
            expected = np.stack([np.interp(field[seen], fields, row) for row in table])
            logs = np.log(np.where(total > 0, total, np.nan)) - np.log(np.maximum(expected, _LEAST_SHARE))
            off[:, number, square, seen] = logs
    off = off[:, np.isfinite(off).any((0, 2, 3))]
    total = lambda gain: np.nansum(np.abs(off - gain[..., None]), (1, 2))
    solutions = []
    # Alternate from the factors by which some lens is of some type.
    for number, lens in np.ndindex(len(imagers), count):
        gain = off[number, :, :, lens]
        for _ in range(_ROUNDS):
            gain = np.nanmedian(off[total(gain).argmin(0), :, :, np.arange(count)], 0)
        solutions.append(total(gain))
    return min(solutions, key=lambda cost: cost.min(0).sum()).argmin(0)
