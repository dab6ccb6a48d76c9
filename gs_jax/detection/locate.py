"""Points out of a capture: what the lenses agree on. Host code, but for the back-projection in it.

The paper's particle clustering (`gs_jax.detection.clustering`) takes bright groups of voxels for points. Here a
candidate is checked against the capture: a true point is seen by nearly all lenses in reach, a ghost by some. Points
are rows `(x, y, z, intensity)`, mm; `gs_jax.simulation.phantoms.rasterize` makes a volume of them.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Float64, Shaped
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree

from ..base.errors import InputError
from ..base.progress import Progress
from ..geometry import Imager
from ..grid import Grid
from ..optics.lens_types import FIELDS, HALF_SIDE, core_width, warn_if_blurred
from ..optics.psf_core import apparent_depths, ensquared_light
from ..projection.backprojection import backproject
from .background import in_bands
from .consistency import (
    REACH,
    Readings,
    Signal,
    agreed_level,
    log_false_alarms,
    select_readings,
    signal,
    spot_profile,
    survival,
    without_spots,
)
from .type_views import LensType, lens_types_of, readings_of

Points = Float64[np.ndarray, "_ 4"]
Places = Float64[np.ndarray, "_ 3"]

# Share of its lenses that must see a point; the others may be blocked, scratched, or under a brighter point.
SHARE = 0.7
# Lit is what exceeds the noise this many times. Back-projected are the logarithms of what exceeds it half as much.
LIT = 5.0
# Three numbers are found from two of each lens.
_FEWEST = 3
# Part of its light that a point must keep when the points that were found before it are taken away.
_OWN = 0.5
# Points by chance in a capture, on average: one in ten captures.
_FALSE_ALARMS = 0.1
# Times that a candidate's neighbourhood is searched, each half as wide: to 1/128 of a voxel, 0.3 um.
_REFINEMENTS = 7
# Width of the voxels that are searched first, pixels.
_COARSE = 2
# Most planes that are searched at once.
_PLANES = 32
# Depths at which the share of a spot's light in its core is computed.
_DEPTHS = 5
# Depths whose cores are traced, and how far they go beyond the grid, in depths.
_TRACED, _BEYOND = 9, 0.05
# What is to be said of points where spots are not sharp.
NOT_TRUSTED = "no point is to be trusted"
# Searches: the second, without the light that the first explains, finds what is close to brighter points.
_SEARCHES = 2


def find_points(
    image: Shaped[Array | np.ndarray, "row column"] | Signal,
    imager: Imager,
    grid: Grid,
    *,
    progress: Progress | None = None,
) -> Points:
    """Finds the points that a capture shows: those that nearly all of their lenses see.

    *Host.*

    1. The background is taken off the image (`consistency.signal`).
    2. The logarithms of what exceeds the noise are back-projected onto voxels of two pixels. A sum of logarithms is
       high where all lenses are lit, not where one is bright. Its local maxima, then searched between the voxels, are
       candidates.
    3. Brightest first, a candidate is a point if 7 of 10 of its lenses are lit above the noise, more than chance would
       light them anywhere in the volume (`consistency.log_false_alarms`), and mostly not by points that were found
       before. The light of these is subtracted from the readings, with the spot's shape as this image shows it.
    4. All is repeated once on what the image holds beside the points, for those in the shadow of brighter ones.

    No threshold depends on the scene, and nothing is random. Points are looked for where the bright cores of the spots
    land, by exact rays (`gs_jax.optics.psf_core.apparent_depths`).

    Parameters
    ----------
    image
        `sensor.shape`, linear, in any unit, on any offset; or what `consistency.signal` made of it.
    imager
        What took it.
    grid
        Where to look: the box of these voxels, at most as large as the sensor. How large the voxels are has no effect.
    progress
        Shows how far the search is.

    Returns
    -------
    ndarray
        `(point, 4)`, brightest first. The intensity is all that the point sends out, in every direction, in the image's
        unit: the light in the middle of its spots over the share that exact rays bring there.

    Raises
    ------
    ValueError
        If the image is not `sensor.shape`.
    InputError
        If a pixel is not finite, or there are fewer than three lenses, which cannot agree on a point.

    Warns
    -----
    InputWarning
        If the microscope is out of focus at the grid's depths (`gs_jax.optics.lens_types`). Of an image, not of a
        `Signal`, which is for many images of one microscope.

    Examples
    --------
    >>> import gs_jax as gs, numpy as np
    >>> array = gs.MicrolensArray(gs.random_layout(20, (6.0, 6.0), pitch=1.2, seed=1), size=(6.0, 6.0))
    >>> scope = gs.Imager(array, gs.Sensor((900, 900), 0.009), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> truth = np.array([[0.5, -0.4, 19.5, 1.0], [-0.7, 0.2, 20.5, 0.8]])
    >>> image = gs.simulate(truth, scope, optics="near", psf="geometric")
    >>> found = gs.find_points(image, scope, grid)
    >>> gs.localization(found, truth).f1
    1.0
    """
    progress = progress or Progress()
    seen = image if isinstance(image, Signal) else signal(image)
    if (lenses := len(imager.array.centers)) < _FEWEST:
        found = f"{lenses} lens" if lenses == 1 else f"{lenses} lenses"
        raise InputError(f"points: found {found}, allowed: {_FEWEST} lenses or more, which have to agree on a point.")
    if seen.light.shape != imager.sensor.shape:
        raise ValueError(f"`image` must be of the sensor's shape {imager.sensor.shape}, got {seen.light.shape}.")
    if not isinstance(image, Signal):
        warn_if_blurred(imager, grid, "points", NOT_TRUSTED)
    depths = _around(grid)
    lens_types = lens_types_of(imager, depths, core_width(imager))
    # Of lenses that differ, each type is read where its own cores land: points are at their depths all along.
    apparent = np.asarray(apparent_depths(imager, depths), np.float64) if len(lens_types) == 1 else depths
    searched = grid.at(np.interp(np.asarray(grid.depths), depths, apparent))
    voxels = searched_voxels(imager, searched)
    # What is less is not lit.
    least = LIT * float(seen.noise.min())
    as_bright = survival(seen.light, least)
    points, spots, own = _consistent(np.zeros((0, 3)), seen, as_bright, lens_types, voxels)
    for _ in range(_SEARCHES):
        rest = seen._replace(light=without_spots(seen.light, spots, own))
        # A spot between two voxels must not be missed.
        wide = rest._replace(light=_brightest_neighbour(rest.light))
        new = _candidates(wide, lens_types, voxels, progress)
        with progress.step("Comparing lenses"):
            lit = _lit(readings_of(new, wide, lens_types), survival(wide.light, least), count_of(voxels))
            new = _refined(new[lit], voxels, rest, lens_types)
            points, spots, own = _consistent(np.concatenate([points, new]), seen, as_bright, lens_types, voxels)
    # Until here, depths were those of chief rays.
    points = np.column_stack([points[:, :2], np.interp(points[:, 2], apparent, depths)])
    found = np.column_stack([points, _intensity(points, spots, own, seen, lens_types)])
    found = found[_inside(found, grid, float(voxels.depths[1] - voxels.depths[0]) / _COARSE)]
    return found[np.argsort(-found[:, 3], kind="stable")]


def _around(grid: Grid) -> Float64[np.ndarray, " depth"]:
    """Depths that hold the grid's, and more on both sides."""
    near, far = float(grid.depths.min()), float(grid.depths.max())
    beyond = max(_BEYOND * far, (far - near) / 4)
    return np.linspace(near - min(beyond, near / 2), far + beyond, _TRACED)


def searched_voxels(imager: Imager, grid: Grid) -> Grid:
    """Coarse voxels that fill the sensor and the grid's depths, and a plane beyond: maxima need neighbours."""
    near, far = float(grid.depths.min()), float(grid.depths.max())
    middle = (near + far) / 2
    pitch = _COARSE * imager.sensor.pixel_pitch / float(imager.magnification(middle))
    # A lens at the field radius sees a point move from plane to plane as from voxel to voxel.
    step = pitch * float(imager.reduced_depth(middle)) / imager.field_radius
    planes = near + step * np.arange(-1, math.ceil((far - near) / step) + 2)
    # `at`, as planes about the nearest depth may reach behind the array's front.
    return Grid.over(imager.sensor, depths=[middle], pitch=pitch).at(planes)


def _inside(points: Points, grid: Grid, step: float) -> Bool[np.ndarray, " point"]:
    """Which points lie in the grid's voxels, the outer planes of which are a step thick."""
    x, y, z = points[:, :3].T
    left, right, bottom, top = grid.extent
    lateral = (left <= x) & (x <= right) & (top <= y) & (y <= bottom)
    near, far = float(grid.depths.min()), float(grid.depths.max())
    return lateral & (near - step / 2 <= z) & (z <= far + step / 2)


def count_of(voxels: Grid) -> int:
    """Places that are told apart: voxels of a pixel."""
    return voxels.depths.size * math.prod(voxels.shape) * _COARSE**3


def _brightness(light: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """What is summed over the lenses: the logarithm of what exceeds the noise, so that no lens outweighs the others."""
    return np.log(np.maximum(light / np.where(noise > 0, noise, np.inf) / (LIT / 2), 1))


def _brightest_neighbour(light: Float32[np.ndarray, "row column"]) -> Float32[np.ndarray, "row column"]:
    """The most of 3 x 3 pixels; beyond the edge it goes on."""
    result = np.empty_like(light)

    def most(band):
        tall = light[np.clip(np.arange(band.start - 1, band.stop + 1), 0, len(light) - 1)]
        most = np.maximum(np.maximum(tall[:-2], tall[1:-1]), tall[2:])
        wide = result[band]
        wide[:, -1] = most[:, -1]
        np.maximum(most[:, :-1], most[:, 1:], out=wide[:, :-1])
        np.maximum(wide[:, 1:], most[:, :-1], out=wide[:, 1:])

    in_bands(len(light), most)
    return result


def _candidates(rest: Signal, lens_types: Sequence[LensType], voxels: Grid, progress: Progress) -> Places:
    """Local maxima of the summed logarithms, at voxels."""
    bright = np.empty_like(rest.light)

    def brighten(band):
        bright[band] = _brightness(rest.light[band], rest.noise[band])

    in_bands(len(bright), brighten)
    image, last = jax.device_put(bright), voxels.depths.size - 1
    # Each part has a plane of its neighbours; all are equally long, planes after the end repeat.
    parts = math.ceil((last - 1) / _PLANES)
    inner = math.ceil((last - 1) / parts)
    found = [np.zeros((0, 3))]
    for first in progress.track(range(0, last - 1, inner), "Searching for points"):
        some = np.minimum(first + np.arange(inner + 2), last)
        volume = _summed(image, lens_types, voxels.at(voxels.depths[some]))
        is_maximum = np.asarray(_is_maximum(volume))
        # NumPy takes long to find them in three dimensions at once.
        maxima = np.stack(np.unravel_index(np.flatnonzero(is_maximum), is_maximum.shape), -1) + (first + 1, 1, 1)
        found.append(voxels.to_mm(maxima[maxima[:, 0] < last]))
    return np.concatenate(found)


def _summed(image, lens_types: Sequence[LensType], voxels: Grid) -> Float[Array, "depth y x"]:
    """`backproject` by all lenses that can see each plane."""
    if len(lens_types) == 1:
        return backproject(image, lens_types[0].imager, voxels)
    depths = np.asarray(voxels.depths, np.float64)
    light = [
        (lens_type.sees(depths), backproject(image, lens_type.imager, voxels.at(lens_type.place(depths))))
        for lens_type in lens_types
    ]
    parts = [jnp.where(seen[:, None, None], volume, 0) for seen, volume in light]
    return sum(parts[1:], parts[0])


@jax.jit
def _is_maximum(volume: Float[Array, "depth y x"]) -> Bool[Array, "_ _ _"]:
    """Which inner voxels exceed what three lenses would read, and all 26 neighbours; the last of equal neighbours."""
    inner = volume[1:-1, 1:-1, 1:-1]
    highest = inner > _FEWEST * SHARE * math.log(2)
    for step in np.ndindex(3, 3, 3):
        there = volume[tuple(slice(at, at + n) for at, n in zip(step, inner.shape, strict=True))]
        highest &= inner >= there if step <= (1, 1, 1) else inner > there
    return highest


def _refined(points: Places, voxels: Grid, rest: Signal, lens_types: Sequence[LensType]) -> Places:
    """Points moved uphill between the voxels: to the best of 27 places, twice as close each time."""
    step = float(voxels.depths[1] - voxels.depths[0])
    around = (np.array(list(np.ndindex(3, 3, 3))) - 1) * (voxels.pitch, voxels.pitch, step)
    each = np.arange(len(points))
    for part in 0.5 ** np.arange(1, _REFINEMENTS + 1):
        places = points[:, None] + part * around
        seen = readings_of(places.reshape(-1, 3), rest, lens_types)
        brightness = _brightness(seen.light, seen.noise).sum(1).reshape(places.shape[:2])
        points = places[each, brightness.argmax(1)]
    return points


def _lit(seen: Readings, as_bright, tests: int) -> np.ndarray:
    """Which points enough of their lenses see, and more than by chance."""
    count, noise = seen.seen.sum(1), seen.noise.max(1, initial=0)
    level = agreed_level(seen.light, seen.seen, SHARE)
    log_alarms = log_false_alarms(level, count, SHARE, as_bright, tests)
    return (level > LIT * noise) & (log_alarms <= np.log(_FALSE_ALARMS)) & (count >= _FEWEST)


def _consistent(
    candidates: Places, signal: Signal, as_bright, lens_types: Sequence[LensType], voxels: Grid
) -> tuple[Places, Readings, Float64[np.ndarray, "point lens"]]:
    """The points among the candidates, their readings, and their own part of what was read.

    Brightest first; from the readings of each, the light of the points before it is taken away. Nearer than a coarse
    voxel to one of them there is no other point, only the rim of its spot.
    """
    seen = readings_of(candidates, signal, lens_types)
    order = np.argsort(-agreed_level(seen.light, seen.seen, SHARE), kind="stable")
    candidates, seen = candidates[order], select_readings(seen, order)
    tests = count_of(voxels)
    profile = spot_profile(seen, signal.light)
    spots, owner = seen.pixels[seen.seen], np.argwhere(seen.seen)
    tree = KDTree(spots)
    left, height, points = seen.light.copy(), np.zeros_like(seen.light), np.zeros(len(candidates), bool)
    places = candidates / (voxels.pitch, voxels.pitch, float(voxels.depths[1] - voxels.depths[0]))
    for number, mine in enumerate(seen.seen):
        if (np.linalg.norm(places[points] - places[number], axis=1) < 1).any():
            continue
        one = select_readings(seen, slice(number, number + 1))._replace(light=left[number : number + 1].copy())
        excess = one.light - _OWN * _median_of_type(seen, seen.light, number)
        if not (agreed_level(excess, one.seen, SHARE)[0] >= 0 and _lit(one, as_bright, tests)[0]):
            continue
        points[number] = True
        height[number] = np.maximum(_median_of_type(seen, left, number), 0)
        pixels, heights = seen.pixels[number, mine], height[number, mine]
        for pixel, own, others in zip(pixels, heights, tree.query_ball_point(pixels, REACH), strict=True):
            distance = np.hypot(*(spots[others] - pixel).T)
            left[tuple(owner[others].T)] -= own * np.interp(distance, np.arange(REACH + 1), profile)
    return candidates[points], select_readings(seen, points), (left + height)[points]


def _median_of_type(
    seen: Readings, light: Float64[np.ndarray, "point lens"], point: int
) -> Float64[np.ndarray, " lens"]:
    """Median light of one point over the lenses of each lens's type, as types are not equally sharp; 0 where unseen."""
    median = np.zeros(light.shape[1])
    kind = np.zeros(len(median), int) if seen.lens_type is None else seen.lens_type[point]
    for number in np.unique(kind[seen.seen[point]]):
        same = seen.seen[point] & (kind == number)
        median[same] = np.median(light[point, same])
    return median


def _intensity(
    points: Places, seen: Readings, own: np.ndarray, signal: Signal, lens_types: Sequence[LensType]
) -> Float64[np.ndarray, " point"]:
    """What the points send out, the median of the lenses.

    Summed in a square about each spot; of it the part that is the point's own in the middle; over the share of the
    point's light that falls into the square.
    """
    side = np.arange(-HALF_SIDE, HALF_SIDE + 1)
    middle = np.floor(seen.pixels + 0.5).astype(int)
    row, column = (np.clip(middle[..., axis, None] + side, 0, n - 1) for axis, n in enumerate(signal.light.shape))
    total = signal.light[row[..., :, None], column[..., None, :]].sum((-2, -1))
    expected = _expected(points, seen, lens_types[0].imager)
    for number, lens_type in enumerate(lens_types[1:], 1):
        expected = np.where(seen.lens_type == number, _expected(points, seen, lens_type.imager), expected)
    use = seen.seen & (seen.light > 0) & (expected > 0)
    ratio = np.where(use, total * own / np.where(use, seen.light * expected, 1), 0)
    return np.array([np.median(some[which]) if which.any() else 0.0 for some, which in zip(ratio, use, strict=True)])


def _expected(points: Places, seen: Readings, imager: Imager) -> Float64[np.ndarray, "point lens"]:
    """The share of a point's light that falls into the square about the core of each lens's spot, by exact rays."""
    if not len(points):
        return np.zeros_like(seen.light)
    depths = np.linspace(points[:, 2].min(), points[:, 2].max(), _DEPTHS if np.ptp(points[:, 2]) > 0 else 1)
    fields = np.linspace(0, imager.field_radius, FIELDS)
    shares = ensquared_light(imager, depths, fields, core_width(imager))
    place = np.interp(points[:, 2], depths, np.arange(len(depths)))[:, None]
    at = np.stack(np.broadcast_arrays(place, seen.field / fields[1]))
    return map_coordinates(shares, at.reshape(2, -1), order=1, mode="nearest").reshape(seen.field.shape)
