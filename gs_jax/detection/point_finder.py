"""Finds points in a capture: positions at which nearly all lenses see one. Host code, but for the back-projection.

The paper's particle clustering (`gs_jax.detection.particles`) needs a volume alone, and finds fewer. Points are rows
`(x, y, z, intensity)`, mm; `gs_jax.rasterize` makes a volume of them.
"""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int

from ..base.arrays import host_code, jit
from ..base.errors import InputError, check_kind
from ..base.progress import Progress
from ..base.typing import Image
from ..microscope.geometry import Imager, check_beyond
from ..microscope.grid import Grid
from ..optics.psf_core import warn_if_blurred
from ..projection.backprojection import backproject
from .background import DetectionImage, Pixels, filter_bands, subtract_background
from .spot_fit import fit_points
from .view_samples import (
    COARSE,
    THRESHOLD_SNR,
    VIEW_SHARE,
    LensType,
    OwnLight,
    ViewSamples,
    lens_types_of,
    log_false_alarms,
    median_of_type,
    num_hypotheses,
    sample_views_by_type,
    search_grid,
    separate_points,
    survival_function,
    view_quantile,
)

Points = Float64[np.ndarray, "_ 4"]
Positions = Float64[np.ndarray, "_ 3"]

# Fewest lenses that determine three coordinates with redundancy.
_MIN_LENSES = 3
# Part of its light that a point must keep when the points that were found before it are subtracted.
_OWN_LIGHT = 0.5
# Expected number of false alarms in a capture: one in ten captures.
_FALSE_ALARMS = 0.1
# A candidate's neighbourhood is searched so often, each time half as wide: to 1/16 of a voxel, before spots are fitted.
_REFINEMENTS = 4
# Planes that are back-projected at once. Planes, and voxels along an axis less one, are rounded up to multiples of
# these, so that other depths and magnifications find the program.
_PLANES, _FEW_PLANES, _FEW_VOXELS = 32, 8, 16
# Depths at which cores are traced, and margin beyond the grid, relative to the depth.
_TRACED, _MARGIN = 9, 0.05
# Consequence, in warnings, where spots are not sharp.
NOT_TRUSTED = "no point is to be trusted"
# The second search, on what the points of the first do not explain, finds points close to brighter ones.
_SEARCHES = 2


@host_code()
def find_points(
    image: Image | DetectionImage, imager: Imager, grid: Grid, *, progress: Progress | None = None
) -> Points:
    """Find the points that a capture shows: those that nearly all of their lenses see.

    *Host.*

    1. The image's background is subtracted (`subtract_background`).
    2. The logarithms of what exceeds the noise are back-projected onto voxels of two pixels: their sum is high where
       all lenses are lit, not where one is bright. Its local maxima, refined between the voxels, are candidates.
    3. In order of brightness, a candidate is a point if 7 of 10 of its lenses are lit above the noise, more than chance
       would light anywhere in the volume (`log_false_alarms`), and mostly not by points before it. The light of each
       point is subtracted from the views of the others, by the shape of its own spots.
    4. The search is repeated on what the image holds beside the points, for those near brighter ones.
    5. The shapes of all spots, by exact rays, are fitted to the pixels, also under the lenses beyond the field radius
       that are bright and sharp enough: they place the point and measure its light (`gs_jax.detection.spot_fit`).

    Nothing is random. Thresholds are multiples of the image's own noise, which is taken to be at least a thousandth of
    the brightest spot: points whose spots have less than a two-hundredth of its height are not found. Points are
    searched for where the bright cores of the spots land, by exact rays (`gs_jax.optics.psf_core.core_distortion`);
    lenses of several types are read at depths where they are sharp.

    Parameters
    ----------
    image
        `sensor.shape`, linear, in any unit, on any offset; or the result of `subtract_background`.
    imager
        The microscope.
    grid
        The box of these voxels is searched, at most as large as the sensor. Their size has no effect.
    progress
        Shows how far the search is.

    Returns
    -------
    ndarray
        `(point, 4)`, brightest first. The intensity is all that the point emits, in every direction, in the image's
        unit: the height of its spots over that of exact rays.

    Raises
    ------
    ValueError
        If the image is not `sensor.shape`.
    InputError
        If a pixel is not finite, or there are fewer than three lenses, which cannot agree on a point.

    Warns
    -----
    InputWarning
        If the microscope is out of focus at the grid's depths (`gs_jax.optics.psf_core`). Not for a
        `DetectionImage`, as of the frames of a recording.

    Examples
    --------
    >>> array = gs.MicrolensArray(gs.random_layout(20, (6.0, 6.0), pitch=1.2, seed=1), size=(6.0, 6.0))
    >>> scope = gs.Imager(array, gs.Sensor((900, 900), 0.009), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> truth = np.array([[0.5, -0.4, 19.5, 1.0], [-0.7, 0.2, 20.5, 0.8]])
    >>> image = gs.simulate(truth, scope, optics="near", psf="geometric")
    >>> found = gs.find_points(image, scope, grid)
    >>> gs.localization(found, truth).f1
    1.0
    """
    check_kind("imager", imager, Imager, "an Imager, as `design.imager()` is")
    check_kind("grid", grid, Grid, "a Grid")
    progress = progress or Progress()
    detection = image if isinstance(image, DetectionImage) else subtract_background(image)
    if (lenses := len(imager.array.centers)) < _MIN_LENSES:
        number = f"{lenses} lens" if lenses == 1 else f"{lenses} lenses"
        raise InputError(f"points: {_MIN_LENSES} or more lenses must agree on a point, got {number}.")
    check_beyond(imager, np.asarray(grid.depths), "points: depths")
    if detection.light.shape != imager.sensor.shape:
        raise ValueError(f"`image` must be of the sensor's shape {imager.sensor.shape}, got {detection.light.shape}.")
    if not isinstance(image, DetectionImage):
        warn_if_blurred(imager, grid, "points", NOT_TRUSTED)
    depths = _depths_around(grid)
    lens_types = lens_types_of(imager, depths)
    voxels = search_grid(imager, grid)
    least = THRESHOLD_SNR * float(detection.noise.min())
    survival = survival_function(detection.light, least)
    points, samples, own = _accept(np.zeros((0, 3)), detection, survival, lens_types, voxels)
    for _ in range(_SEARCHES):
        new = _search(detection._replace(light=own.rest), least, lens_types, voxels, progress)
        with progress.step("Comparing lenses"):
            points, samples, own = _accept(np.concatenate([points, new]), detection, survival, lens_types, voxels)
    brightness = view_quantile(own.light, samples.seen, 0.5)
    del own  # It has an image as large as the capture.
    fit = fit_points(points, brightness, detection, lens_types)
    points = np.column_stack([fit.positions, fit.intensities])
    points = points[_inside(points, grid, _step(voxels) / COARSE)]
    return points[np.argsort(-points[:, 3], kind="stable")]


def _search(
    rest: DetectionImage, least: float, lens_types: Sequence[LensType], voxels: Grid, progress: Progress
) -> Positions:
    """Candidates in an image, refined between the voxels."""
    # A spot between two voxels must not be missed.
    dilated = rest._replace(light=_dilate(rest.light))
    new = _candidates(dilated, lens_types, voxels, progress)
    with progress.step("Comparing lenses"):
        views = sample_views_by_type(new, dilated, lens_types)
        lit = _lit(views, survival_function(dilated.light, least), num_hypotheses(voxels))
        return _refine(new[lit], voxels, rest, lens_types)


def _ends(grid: Grid) -> tuple[float, float]:
    depths = np.asarray(grid.depths, np.float64)
    return depths.min(), depths.max()


def _depths_around(grid: Grid) -> Float64[np.ndarray, " depth"]:
    near, far = _ends(grid)
    margin = max(_MARGIN * far, (far - near) / 4)
    return np.linspace(near - min(margin, near / 2), far + margin, _TRACED)


def _inside(points: Points, grid: Grid, step: float) -> Bool[np.ndarray, " point"]:
    """Which points lie in the grid's voxels, whose outer planes are a step thick."""
    x, y, z = points[:, :3].T
    left, right, bottom, top = grid.extent
    lateral = (left <= x) & (x <= right) & (top <= y) & (y <= bottom)
    near, far = _ends(grid)
    return lateral & (near - step / 2 <= z) & (z <= far + step / 2)


def _log_snr(light: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Logarithm of the signal-to-noise ratio over half the threshold, so that no lens outweighs the others."""
    snr = np.divide(light, noise, out=np.zeros_like(light), where=noise > 0)
    snr /= THRESHOLD_SNR / 2
    return np.log(np.maximum(snr, 1, out=snr), out=snr)


def _dilate(light: Pixels) -> Pixels:
    """Maximum of 3 x 3 pixels."""

    def dilate(x):
        x = np.maximum(np.maximum(x[:-2], x[1:-1]), x[2:])
        return np.maximum(np.maximum(x[:, :-2], x[:, 1:-1]), x[:, 2:])

    return filter_bands(light, 1, dilate)


def _candidates(rest: DetectionImage, lens_types: Sequence[LensType], voxels: Grid, progress: Progress) -> Positions:
    """Local maxima of the back-projected logarithms, at voxels."""
    planes, image = np.asarray(voxels.depths, np.float64), jax.device_put(_log_snr(rest.light, rest.noise))
    last = len(planes) - 1
    # Parts are equally long: each has a plane of its neighbours, and the last plane repeats.
    parts = math.ceil((last - 1) / (_PLANES - 2))
    inner = _rounded_up(math.ceil((last - 1) / parts) + 2, _FEW_PLANES) - 2
    wider = [_rounded_up(count - 1, _FEW_VOXELS) + 1 for count in voxels.shape]
    beyond = (np.array([0, *wider]) - [0, *voxels.shape]) // 2
    search = Grid([1.0], wider, voxels.pitch, voxels.origin)
    imagers, points = tuple(lens_type.imager for lens_type in lens_types), [np.zeros((0, 3))]
    for first in progress.track(range(0, last - 1, inner), "Searching for points"):
        depths = planes[np.minimum(first + np.arange(inner + 2), last)]
        distortions = tuple(lens_type.distortion_at(depths) for lens_type in lens_types)
        sharp = tuple(lens_type.sees(depths) for lens_type in lens_types)
        part = eqx.tree_at(lambda g: g.depths, search, depths.astype(voxels.depths.dtype))
        is_maximum = np.asarray(_maxima(image, imagers, part, distortions, sharp, np.array(voxels.shape)))
        # Faster than `np.argwhere` in three dimensions.
        maxima = np.stack(np.unravel_index(np.flatnonzero(is_maximum), is_maximum.shape), -1) + (first + 1, 1, 1)
        points.append(_to_mm(voxels, (maxima - beyond)[maxima[:, 0] < last]))
    return np.concatenate(points)


def _rounded_up(count: int, step: int) -> int:
    return -(-count // step) * step


def _to_mm(voxels: Grid, index: Int[np.ndarray, "_ 3"]) -> Positions:
    """`Grid.to_mm` by NumPy: another shape of the grid would compile other programs."""
    origin, planes = (np.asarray(part, np.float64) for part in (voxels.origin, voxels.depths))
    place = origin[::-1] + (index[:, 1:] - (np.array(voxels.shape) - 1) / 2) * voxels.pitch
    return np.column_stack([place[:, ::-1], planes[index[:, 0]]])


@jit
def _maxima(
    image: Float[Array, "row column"],
    imagers: tuple[Imager, ...],
    voxels: Grid,
    distortions: tuple[Float[Array | np.ndarray, " depth"], ...],
    sharp: tuple[Bool[Array | np.ndarray, " depth"], ...],
    shape: Int[Array | np.ndarray, "2"],
) -> Bool[Array, "_ _ _"]:
    """Which inner voxels, of the middle ones of this shape, exceed their neighbours and what three lenses would read.

    The image is back-projected by the lenses that are sharp in each plane. Of equal neighbours the last one counts.
    """
    volume = jnp.zeros((), image.dtype)
    for imager, distortion, sees in zip(imagers, distortions, sharp, strict=True):
        of_type = backproject(image, imager, voxels, distortion=distortion)
        volume = volume + jnp.where(sees[:, None, None], of_type, 0)
    inner = volume[1:-1, 1:-1, 1:-1]
    rows, columns = (
        jnp.abs(2 * jnp.arange(count) - (count - 1)) <= size - 3
        for count, size in zip(inner.shape[1:], shape, strict=True)
    )
    highest = (inner > _MIN_LENSES * VIEW_SHARE * math.log(2)) & (rows[:, None] & columns[None])[None]
    for step in np.ndindex(3, 3, 3):
        neighbour = volume[tuple(slice(at, at + n) for at, n in zip(step, inner.shape, strict=True))]
        highest &= inner >= neighbour if step <= (1, 1, 1) else inner > neighbour
    return highest


def _voxel_size(voxels: Grid) -> tuple:
    return voxels.pitch, voxels.pitch, _step(voxels)


def _step(voxels: Grid) -> float:
    first, second = np.asarray(voxels.depths, np.float64)[:2]
    return second - first


def _refine(points: Positions, voxels: Grid, rest: DetectionImage, lens_types: Sequence[LensType]) -> Positions:
    """Move points uphill between the voxels, to the best of 27 positions, twice as close each time."""
    around = (np.array(list(np.ndindex(3, 3, 3))) - 1) * _voxel_size(voxels)
    for part in 0.5 ** np.arange(1, _REFINEMENTS + 1):
        positions = points[:, None] + part * around
        samples = sample_views_by_type(positions.reshape(-1, 3), rest, lens_types)
        brightness = _log_snr(samples.light, samples.noise).sum(1).reshape(positions.shape[:2])
        points = positions[np.arange(len(points)), brightness.argmax(1)]
    return points


def _lit(samples: ViewSamples, survival, tests: int) -> Bool[np.ndarray, " point"]:
    """Which points enough of their lenses see, and more than by chance."""
    count, noise = samples.seen.sum(1), samples.noise.max(1, initial=0)
    level = view_quantile(samples.light, samples.seen)
    log_alarms = log_false_alarms(level, count, survival, tests)
    return (level > THRESHOLD_SNR * noise) & (log_alarms <= np.log(_FALSE_ALARMS)) & (count >= _MIN_LENSES)


def _accept(
    candidates: Positions, image: DetectionImage, survival, lens_types: Sequence[LensType], voxels: Grid
) -> tuple[Positions, ViewSamples, OwnLight]:
    """The points among the candidates, their samples, and their own light.

    Within a coarse voxel of a point there is no other, only the rim of its spot.
    """
    samples, taken = sample_views_by_type(candidates, image, lens_types), []
    tests, scaled = num_hypotheses(voxels), candidates / _voxel_size(voxels)

    def take(number, left):
        if (np.linalg.norm(scaled[taken] - scaled[number], axis=1) < 1).any():
            return False
        one = samples.select([number])
        own = view_quantile((left - _OWN_LIGHT * median_of_type(samples, number))[None], one.seen)[0]
        if own < 0 or not _lit(one._replace(light=left[None]), survival, tests)[0]:
            return False
        taken.append(number)
        return True

    own = separate_points(samples, image.light, take)
    return candidates[own.taken], samples.select(own.taken), own
