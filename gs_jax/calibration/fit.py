"""Estimates the geometry of a microscope from captures of point sources, or of an unknown sparse scene."""

import dataclasses
import os
import warnings
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Float, Float64, Int

from ..base.arrays import check_finite
from ..base.errors import InputError, InputWarning
from ..base.progress import Progress
from ..base.typing import Image
from ..detection.point_finder import find_points
from ..microscope.geometry import Imager
from ..microscope.grid import Grid
from ..microscope.lenses import EACH
from . import initial_guess as guesses, spot_model as model
from .initial_guess import MIN_SPOTS, InitialGuess
from .spot_model import FITTABLE, FITTED, OF_SAMPLE, CoreOffsets, Observations, Unknowns
from .spots import (
    NARROW_WINDOW,
    CaptureFit,
    MisfitError,
    Sources,
    SpotLists,
    Spots,
    assign_spots,
    best_alternative,
    capture_fits,
    describe_misfit,
    find_blurred_spots_mm,
    find_spots_mm,
)

# Distances within which spots are assigned, over `match_radius`: wide, then narrow.
_WITHIN = (1.0, 0.5, 0.25)
# Prior standard deviation of lenses: of a printed array, mm; and of unlisted lenses, over `match_radius`.
_PRINTED, _UNLISTED = 0.01, 17.0
# Captures in which spots are searched for at once, each with several times its memory.
_THREADS = 2
_MAX_STEPS = 300
# Numbers of spots are padded to a multiple of this, so that few shapes are compiled.
_MULTIPLE = 256
# Least median of the distances of blurred spots' coordinates from a fit, pixels, and the width in that of a sharp spot
# over it: the loss is linear beyond two standard deviations.
_LEAST_BLURRED, _OVER_MEDIAN = 0.01, 2 / 0.6745 / model.OUTLIER
# What is guessed from the pattern of the lenses, if it is fitted.
_POSE = ("sensor_distance", "rotation", "shift")
# What the pattern of the lenses alone determines.
PATTERN_FITTED = ("rotation", "shift", "scale")
# Of an unknown scene, which determines neither sensor distance nor shift.
SELF_FITTED = ("rotation", "tilt")
_SELF_FITTABLE = (*SELF_FITTED, "lenses", *OF_SAMPLE)
# Most and fewest points that self-calibration uses.
_MOST_POINTS, _MIN_POINTS = 60, 5
# Number of bright sources that the search for the rotation uses.
_ROTATION_SOURCES = 5


class Calibration(NamedTuple):
    """Result of a calibration.

    Parameters
    ----------
    imager
        The microscope. The array's centers are mirrored, y to -y, if `mirrored`, and moved if lenses were fitted.
    mirrored
        Whether the array is the other way round than in the design.
    values, deviations
        Fitted values and their standard errors, by names with units. Of `lenses` only the median error of all, mm.
    sources
        The points with their fitted coordinates, mm, and the capture of each.
    spots, residuals
        The spots, and their predicted less their observed positions, `(x, y)`, pixels.
    captures
        Of each capture the number of spots used and expected, and their residual, pixels RMS.
    """

    imager: Imager
    mirrored: bool
    values: dict[str, float]
    deviations: dict[str, float]
    sources: Sources
    spots: Spots
    residuals: Float64[np.ndarray, "spot 2"]
    captures: Sequence[CaptureFit] = ()

    @property
    def rms(self) -> float:
        """Root mean square of the residuals' lengths, pixels."""
        return float(np.sqrt((self.residuals**2).sum(1).mean()))


def calibrate(
    images: Sequence[Image],
    points: Float[np.ndarray, "source 3"],
    imager: Imager,
    *,
    captures: Int[np.ndarray, " source"] | None = None,
    fit: Sequence[str] = FITTED,
    find_lenses: bool = False,
    blurred: Collection[int] = (),
    progress: Progress | None = None,
) -> Calibration:
    """Estimate a microscope's geometry from captures of point sources, starting from its design.

    *Host.*

    The spots of each capture are matched to the lenses at any rotation, mirrored or not, with a sensor distance within
    a quarter of the design's. Then what `fit` names is fitted by Levenberg-Marquardt to the spots within the field
    radius, with a robust loss. Spots are predicted by exact rays, so that aberrations bias nothing.

    Parameters
    ----------
    images
        Captures, in pixels of any unit.
    points
        `(x, y, z)` of the sources, mm, in the sensor's frame; NaN is unknown and fitted, too.
    imager
        The microscope as designed.
    captures
        Image of each source, from 0; by default one source in each, in their order.
    fit
        Of `sensor_distance`, `rotation`, `shift`, `tilt`, `scale` of the array, `depth_offset` of all sources, and
        `lenses`, each of which is within about 10 um of its listed position. Of the imager's sample, `sample_at`, the
        depth at which it begins, and `sample_index`: both need points of known depths, and a sensor distance from a
        calibration in air, whose error they multiply (`sample_at` by about eight; standard errors take what is not
        fitted as exact). Without `sensor_distance`, `rotation` and `shift` the imager's pose is trusted.
    find_lenses
        Find the lenses themselves, whatever positions the design lists, and fit only sensor distance and depth offset
        of `fit`: the lenses' positions contain rotation, shift, scale and tilt. Needs known points. If the design has
        lenses of several types, the type of each is estimated from the light of its spots.
    blurred
        Captures, from 0, in which every lens has one wide spot of any shape: of a source out of focus or aberrated, or
        of an even white surface, whose middle is the source's place. Middles of such spots are on chief rays, and
        weigh in inverse proportion to their scatter about the fit. With `scale`, their pattern may have half to one and
        a half times the size that the design's has.
    progress
        Shows how far the work is.

    Raises
    ------
    InputError
        If points and captures do not fit together, a pixel is not finite, no pattern of lenses is found, or the spots
        do not determine what is to be fitted. If a capture has few of the spots that the geometry of the others
        predicts, the message says whether all would fit with an axis reversed or captures swapped.

    Examples
    --------
    >>> import dataclasses
    >>> array = gs.MicrolensArray(gs.random_layout(20, (6.0, 6.0), pitch=1.2, seed=1), size=(6.0, 6.0))
    >>> listed = gs.Imager(array, gs.Sensor((600, 600), 0.0135), sensor_distance=5.8, field_radius=3.0)
    >>> true = dataclasses.replace(listed, sensor_distance=5.9, rotation=0.02)
    >>> points = np.array([[0.0, 0.0, 18.0], [0.5, 0.3, 20.0], [0.0, 0.0, 22.0]])  # one source a capture
    >>> images = [gs.simulate(np.array([[*point, 1.0]]), true, optics="near", psf="geometric") for point in points]
    >>> result = gs.calibrate(images, points, listed, fit=("sensor_distance", "rotation"))
    >>> print(round(float(result.imager.sensor_distance), 1), round(float(result.imager.rotation), 3), result.mirrored)
    5.9 0.02 False
    """
    progress = progress or Progress()
    captures = np.arange(len(points)) if captures is None else captures
    sources = Sources(np.array(points, np.float64), np.asarray(captures))
    if unknown_names := [name for name in fit if name not in FITTABLE]:
        raise InputError(f"fit must be some of {', '.join(FITTABLE)}, got {', '.join(unknown_names)}.")
    sources.check(len(images), imager, fit, blurred)
    if blurred and (count := len(imager.array.centers)) < MIN_SPOTS:
        raise InputError(f"captures: a pattern needs an array of {MIN_SPOTS} lenses or more, got {count}.")
    imager = model.with_surface(imager, fit)
    for number, image in enumerate(images, 1):
        _check_image(f"capture {number}", image, imager)

    def spots_of(number: int):
        if number in blurred:
            return find_blurred_spots_mm(images[number], imager)
        return find_spots_mm(images[number], imager, int((sources.captures == number).sum())), 1.0

    # SciPy's filters release the GIL.
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _THREADS)) as threads:
        results = threads.map(spots_of, range(len(images)))
        tracked = zip(results, progress.track(images, "Finding spots"), strict=True)
        spots, widths = zip(*(result for result, _ in tracked), strict=True)
    sources = sources._replace(blur=np.array(widths))
    search = _Search(images, list(spots), imager, fit, find_lenses, np.isnan(sources.points), {})

    def remedy() -> str | None:
        with progress.step("Trying other positions"):
            return best_alternative(sources, search.explain, lambda changed: search.fit(changed).captures)

    try:
        with progress.step("Matching lenses"):
            initial = search.guess(sources)
    except InputError as error:
        if (other := remedy()) is None:
            raise
        raise InputError(f"{str(error).rstrip('.?')}; {other}") from error
    if initial.scale != 1:
        # Windows are as large as the pattern turned out to be.
        assert initial.sources.blur is not None
        for k in blurred:
            search.spots[k], initial.sources.blur[k] = find_blurred_spots_mm(images[k], initial.imager)
    try:
        result = search.refine(initial, progress)
    except MisfitError as error:
        raise MisfitError(error.fits, describe_misfit(error.fits, remedy())) from error
    if find_lenses:
        return _drop_unseen_lenses(result)
    if blurred:
        _add_change_by_window(result, search, initial, blurred)
    if "scale" in fit:
        for numbers in (result.values, result.deviations):
            numbers["scale"] *= initial.scale
    return result._replace(mirrored=initial.mirrored)


class _Search(NamedTuple):
    """Initial guesses and fits for sources that captures may show; `unknown` coordinates `(source, 3)` are fitted."""

    images: Sequence[Image]
    spots: list[Float64[np.ndarray, "_ 2"]]
    imager: Imager
    names: Sequence[str]
    find_lenses: bool
    unknown: np.ndarray
    # Matches of patterns, see `guess_from_pattern`.
    cache: dict

    def guess(self, sources: Sources) -> InitialGuess:
        if self.find_lenses:
            initial = guesses.guess_without_lenses(self.spots, sources, self.imager, self.images)
        elif set(self.names).isdisjoint(_POSE):
            initial = guesses.guess_from_pose(self.spots, sources, self.imager)
        else:
            free = "scale" in self.names
            initial = guesses.guess_from_pattern(self.spots, sources, self.imager, free_scale=free, cache=self.cache)
        held = [name for name in _POSE[: 1 if self.find_lenses else None] if name not in self.names]
        values = {name: getattr(self.imager, name) for name in held}
        return initial._replace(imager=guesses.posed(initial.imager, **values))

    def refine(self, initial: InitialGuess, progress: Progress | None = None) -> Calibration:
        names, lens_sd = self.names, _PRINTED
        if self.find_lenses:
            names = [*(name for name in names if name in ("sensor_distance", "depth_offset")), "lenses"]
            lens_sd = _UNLISTED * model.match_radius(initial.imager.array.centers)
        return refine(self.spots, initial.imager, initial.sources, self.unknown, names, lens_sd, progress)

    def explain(self, sources: Sources) -> list[CaptureFit]:
        """What the initial guess explains of each capture."""
        return guesses.explained(self.spots, self.guess(sources))

    def fit(self, sources: Sources) -> Calibration:
        return self.refine(self.guess(sources))


def _add_change_by_window(result: Calibration, search: _Search, initial: InitialGuess, blurred) -> None:
    """Add to the deviations what a narrower window changes: the middle of a wide spot depends on the window."""
    spots = list(search.spots)
    for k in blurred:
        spots[k], _ = find_blurred_spots_mm(search.images[k], initial.imager, NARROW_WINDOW)
    try:
        narrow = search._replace(spots=spots).refine(initial).values
    except InputError:
        text = "wide spots are not found through a narrower window: standard deviations leave out what it changes."
        warnings.warn(InputWarning(text), stacklevel=3)
        return
    for name, value in result.values.items():
        result.deviations[name] = float(np.hypot(result.deviations[name], value - narrow[name]))


def _drop_unseen_lenses(result: Calibration) -> Calibration:
    seen, lenses = np.unique(result.spots.lenses, return_inverse=True)
    array = result.imager.array
    numbers = {name: np.asarray(array.of_lenses(name))[seen] for name in EACH}
    array = dataclasses.replace(array, centers=np.asarray(array.centers)[seen], types=None, **numbers)
    imager = eqx.tree_at(lambda i: i.array, result.imager, array)
    return result._replace(imager=imager, spots=result.spots._replace(lenses=lenses))


def _check_image(name: str, image: Image, imager: Imager) -> None:
    if image.shape != imager.sensor.shape:
        raise InputError(f"{name} must have the sensor's shape {imager.sensor.shape}, got {image.shape}.")
    check_finite(name, image)


def refine(
    spots: SpotLists,
    imager: Imager,
    sources: Sources,
    unknown: np.ndarray,
    fit: Sequence[str],
    lens_sd: float = _PRINTED,
    progress: Progress | None = None,
) -> Calibration:
    """Fit from an initial guess that predicts spots, mm, within a twentieth of the pitch.

    `unknown` `(source, 3)` says which coordinates of the sources are fitted, `fit` what else; `lens_sd` is the prior
    standard deviation of lenses, mm. `InputError` if the spots do not determine what is to be fitted.
    """
    fit = [name for name in FITTABLE if name in fit]
    radius, solver = model.match_radius(imager.array.centers), optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    current, points, state = imager, sources.points, None
    assigned = data = None

    def fits(off=None) -> list[CaptureFit]:
        assert assigned is not None
        return capture_fits(assigned, spots, sources, imager.sensor.pixel_pitch, off)

    for within in (progress or Progress()).track(_WITHIN, "Fitting"):
        if assigned is not None and data is not None:
            sources = _reweight(sources, assigned, np.asarray(model.residuals(state, data))[: len(assigned.lenses)])
        offsets = model.trace_core_offsets(current, points[sources.sharp, 2], fit)
        assigned = assign_spots(spots, sources._replace(points=points), current, offsets, within * radius)
        if not len(assigned.lenses):
            _check_captures(fits())
        data = _observations(imager, sources, unknown, assigned, offsets)
        state = state or model.initial_unknowns(fit, data)
        if not jax.tree.leaves(state):
            raise InputError(f"calibration: fit one or more of {', '.join(FITTABLE)}, got nothing to fit.")
        try:
            model.check_determined(model.standard_errors(state, data, lens_sd, model.NOISE), radius)
        except InputError:
            # Perhaps for lack of captures whose spots would have been needed.
            _check_captures(fits())
            raise
        args = data, jnp.asarray(lens_sd, data.positions.dtype)
        options = {"throw": False, "max_steps": _MAX_STEPS}
        state = optx.least_squares(model.weighted_residuals, solver, state, args, **options).value
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state)):
            _check_captures([fit._replace(fits=False) for fit in fits()])
        current, points = model.apply_to_imager(state, imager), np.asarray(model.source_points(state, data), np.float64)
    assert state is not None and assigned is not None and data is not None
    model.check_fitted_sample(current)
    off = np.asarray(model.residuals(state, data), np.float64)[: len(assigned.lenses)]
    _check_captures(captures := fits(off))
    over_width = off / sources.blurs[assigned.sources, None]
    errors = model.standard_errors(state, data, lens_sd, model.estimate_noise(over_width, state, assigned.lenses))
    model.check_determined(errors, radius)
    for name, error in model.jackknife_errors(state, data, lens_sd).items():
        errors[name] = max(errors[name], error)
    sources = sources._replace(points=points)
    return Calibration(current, False, model.named_values(state), errors, sources, assigned, off, captures)


def _check_captures(fits: Sequence[CaptureFit]) -> None:
    if not all(fit.fits for fit in fits):
        raise MisfitError(fits, describe_misfit(fits, None, tried=False))


def _reweight(sources: Sources, spots: Spots, off) -> Sources:
    """The sources with `blur` by how far blurred spots are from where the fit has them.

    The loss then sees outliers of a pattern whatever its width: discs at its edge, which are drawn to their neighbours.
    """
    if sources.blur is None or sources.sharp.all():
        return sources
    blur = sources.blur.copy()
    for source in np.flatnonzero(~sources.sharp):
        mine = np.abs(off[spots.sources == source])
        if len(mine) >= MIN_SPOTS:
            blur[sources.captures[source]] = max(float(np.median(mine)), _LEAST_BLURRED) * _OVER_MEDIAN
    return sources._replace(blur=blur)


def spot_residuals(
    result: Calibration, images: Sequence[Image], points: Float[np.ndarray, "image 3"]
) -> Float64[np.ndarray, "spot 2"]:
    """Residuals of captures of other points under a calibration, `(x, y)`, pixels."""
    imager, sources = result.imager, Sources(points, np.arange(len(points)))
    offsets, spots = model.trace_core_offsets(imager, points[:, 2]), [find_spots_mm(image, imager) for image in images]
    assigned = assign_spots(spots, sources, imager, offsets, model.match_radius(imager.array.centers))
    data = _observations(imager, sources, np.zeros_like(points, bool), assigned, offsets)
    return np.asarray(model.residuals(Unknowns(), data), np.float64)[: len(assigned.lenses)]


def _observations(imager: Imager, sources: Sources, unknown, spots: Spots, offsets: CoreOffsets) -> Observations:
    count, dtype = len(spots.lenses), imager.sensor_distance.dtype
    more = -count % _MULTIPLE if count else _MULTIPLE
    of, lenses = (np.pad(values, (0, more)) for values in (spots.sources, spots.lenses))
    positions = np.pad(spots.positions.astype(dtype), ((0, more), (0, 0)))
    points, blur = sources.points.astype(dtype), np.asarray(sources.blurs, dtype)[of]
    arrays = points, np.argwhere(unknown), of, lenses, positions, np.arange(count + more) < count, blur
    # `device_put`, as JAX would compile programs to make arrays of these shapes.
    return Observations(imager, *map(jax.device_put, arrays), offsets=offsets)


def self_calibrate(
    image: Image, imager: Imager, grid: Grid, *, fit: Sequence[str] = SELF_FITTED, progress: Progress | None = None
) -> Calibration:
    """Find rotation and tilt in a capture of unknown points, from a design that is right to some degrees.

    The rotation at which most rays of several lenses meet is searched for, if it is fitted. `find_points` finds points,
    then their positions and the geometry are fitted to the spots together (bundle adjustment). Sensor distance, shift
    and scale are the design's, as any others explain the same capture by another scene.

    To first order that holds for a sample, too: its surface and its index only stretch and move the depths of points
    that nobody knows. Just the aberration of oblique rays tells them apart. Sixty points in 4 mm of gel give its
    surface to 0.3 mm, which is 0.1 mm in the points' depths, and its index to 0.15, which is refused. Points of known
    depths give both, to 3 um and 0.001: see `calibrate`.

    Parameters
    ----------
    image, imager
        A capture of a sparse scene (points, beads, cells), and the microscope as designed.
    grid
        The box of these voxels contains the scene.
    fit
        Of `rotation`, `tilt`, `lenses`, `sample_at` and `sample_index`.
    progress
        Shows how far the work is.

    Raises
    ------
    InputError
        If fewer than five points are found, something else is to be fitted, or the spots do not determine it.
    """
    progress = progress or Progress()
    if other := [name for name in fit if name not in _SELF_FITTABLE]:
        allowed = f"{', '.join(_SELF_FITTABLE[:-1])} and {_SELF_FITTABLE[-1]}"
        raise InputError(f"fit must be some of {allowed} for a scene, got {', '.join(other)}.")
    imager = model.with_surface(imager, fit)
    _check_image("capture", image, imager)
    depths = np.asarray(grid.depths, np.float64)
    with progress.step("Searching for the rotation"):
        spots = find_spots_mm(image, imager, _ROTATION_SOURCES)
        rotated = guesses.search_rotation(spots, imager, (depths.min(), depths.max())) if "rotation" in fit else imager
    points = find_points(image, rotated, grid, progress=progress)[:_MOST_POINTS, :3]
    if len(points) < _MIN_POINTS:
        needs = f"a sparse scene in focus with {_MIN_POINTS} or more points is needed"
        raise InputError(f"capture: {needs}, got {len(points)} on which the lenses agree.")
    spots = find_spots_mm(image, imager, len(points))
    sources = Sources(points, np.zeros(len(points), int))
    return refine([spots], rotated, sources, np.ones(points.shape, bool), fit, progress=progress)
