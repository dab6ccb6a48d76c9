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
from ..detection.point_finder import find_points
from ..geometry import Imager
from ..grid import Grid
from ..lenses import EACH
from ..typing import Image
from .initial_guess import (
    InitialGuess,
    explained,
    guess_from_pattern,
    guess_from_pose,
    guess_without_lenses,
    search_rotation,
)
from .jackknife import jackknife_errors
from .misfits import best_alternative, describe_misfit, would_fit
from .pattern_matching import MIN_SPOTS
from .sample import OF_SAMPLE, check_fitted_sample, with_surface
from .sources import (
    CaptureFit,
    MisfitError,
    Sources,
    SpotLists,
    Spots,
    assign_spots,
    capture_fits,
    find_blurred_spots_mm,
    find_spots_mm,
)
from .spot_model import (
    FITTABLE,
    FITTED,
    NOISE,
    OUTLIER,
    CoreOffsets,
    Observations,
    Unknowns,
    apply_to_imager,
    check_determined,
    estimate_noise,
    initial_unknowns,
    match_radius,
    named_values,
    residuals,
    source_points,
    standard_errors,
    trace_core_offsets,
    weighted_residuals,
)
from .spots import NARROW_WINDOW

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
_LEAST_BLURRED, _OVER_MEDIAN = 0.01, 2 / 0.6745 / OUTLIER
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
    >>> import gs_jax as gs, numpy as np
    >>> array = gs.MicrolensArray(gs.random_layout(20, (6.0, 6.0), pitch=1.2, seed=1), size=(6.0, 6.0))
    >>> listed = gs.Imager(array, gs.Sensor((600, 600), 0.0135), sensor_distance=5.8, field_radius=3.0)
    >>> true = dataclasses.replace(listed, sensor_distance=5.9, rotation=0.02)
    >>> places = np.array([[0.0, 0.0, 18.0], [0.5, 0.3, 20.0], [0.0, 0.0, 22.0]])  # one source a capture
    >>> images = [gs.simulate(np.array([[*place, 1.0]]), true, optics="near", psf="geometric") for place in places]
    >>> found = gs.calibrate(images, places, listed, fit=("sensor_distance", "rotation"))
    >>> print(round(float(found.imager.sensor_distance), 1), round(float(found.imager.rotation), 3), found.mirrored)
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
    imager = with_surface(imager, fit)
    for number, image in enumerate(images, 1):
        _check_image(f"capture {number}", image, imager)
    # SciPy's filters release the GIL.
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _THREADS)) as threads:
        work = [
            threads.submit(_spots_of, number, image, imager, sources, blurred) for number, image in enumerate(images)
        ]
        found = [one.result() for one, _ in zip(work, progress.track(images, "Finding spots"), strict=True)]
    spots, blur = [each for each, _ in found], np.array([width for _, width in found])
    sources = sources._replace(blur=blur)
    unknown = np.isnan(sources.points)
    cache: dict = {}

    def guess(meant: Sources) -> InitialGuess:
        if find_lenses:
            initial = guess_without_lenses(spots, meant, imager, images)
        elif set(fit).isdisjoint(_POSE):
            initial = guess_from_pose(spots, meant, imager)
        else:
            initial = guess_from_pattern(spots, meant, imager, free_scale="scale" in fit, cache=cache)
        held = [name for name in _POSE[: 1 if find_lenses else None] if name not in fit]
        where = lambda i: [getattr(i, name) for name in held]
        return initial._replace(imager=eqx.tree_at(where, initial.imager, where(imager)) if held else initial.imager)

    def fit_guess(initial: InitialGuess, progress: Progress | None = None) -> Calibration:
        if not find_lenses:
            return refine(spots, initial.imager, initial.sources._replace(blur=blur), unknown, fit, progress=progress)
        names = [*(name for name in fit if name in ("sensor_distance", "depth_offset")), "lenses"]
        lens_sd = _UNLISTED * match_radius(initial.imager.array.centers)
        return refine(spots, initial.imager, initial.sources, unknown, names, lens_sd, progress)

    def alternative() -> tuple[str, float] | None:
        with progress.step("Trying other positions"):
            return best_alternative(
                sources, lambda meant: explained(spots, guess(meant)), lambda meant: fit_guess(guess(meant)).captures
            )

    try:
        with progress.step("Matching lenses"):
            initial = guess(sources)
    except InputError as error:
        if (other := alternative()) is None:
            raise
        raise InputError(f"{str(error).rstrip('.?')}; {would_fit(other)}") from error
    if initial.scale != 1:
        # Windows are as large as the pattern turned out to be.
        for k in blurred:
            spots[k], blur[k] = find_blurred_spots_mm(images[k], initial.imager)
    try:
        result = fit_guess(initial, progress)
    except MisfitError as error:
        raise MisfitError(error.fits, describe_misfit(error.fits, alternative())) from error
    if find_lenses:
        return _drop_unseen_lenses(result)
    if blurred:
        # Where the middle of a wide spot is depends on the window that looks.
        for k in blurred:
            spots[k], _ = find_blurred_spots_mm(images[k], initial.imager, NARROW_WINDOW)
        try:
            narrow = fit_guess(initial).values
        except InputError:
            text = "wide spots are not found through a narrower window: standard deviations leave out what it changes."
            warnings.warn(InputWarning(text), stacklevel=2)
            narrow = result.values
        for name, value in result.values.items():
            result.deviations[name] = float(np.hypot(result.deviations[name], value - narrow[name]))
    if "scale" in fit:
        for numbers in (result.values, result.deviations):
            numbers["scale"] *= initial.scale
    return result._replace(mirrored=initial.mirrored)


def _spots_of(number: int, image: Image, imager: Imager, sources: Sources, blurred: Collection[int]):
    """The spots of a capture, and their width in that of a sharp one."""
    if number in blurred:
        return find_blurred_spots_mm(image, imager)
    return find_spots_mm(image, imager, int((sources.captures == number).sum())), 1.0


def _drop_unseen_lenses(result: Calibration) -> Calibration:
    seen, lenses = np.unique(result.spots.lenses, return_inverse=True)
    array = result.imager.array
    numbers = {name: value[seen] if (value := getattr(array, name)).ndim else value for name in EACH}
    array = dataclasses.replace(array, centers=array.centers[seen], **numbers)
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
    radius, solver = match_radius(imager.array.centers), optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    current, points, state = imager, sources.points, None
    assigned = data = None
    for within in (progress or Progress()).track(_WITHIN, "Fitting"):
        if assigned is not None and data is not None:
            sources = _reweight(sources, assigned, np.asarray(residuals(state, data))[: len(assigned.lenses)])
        offsets = trace_core_offsets(current, points[sources.sharp, 2], fit)
        assigned = assign_spots(spots, sources._replace(points=points), current, offsets, within * radius)
        if not len(assigned.lenses):
            _check_captures(capture_fits(assigned, spots, sources, imager.sensor.pixel_pitch))
        data = _observations(imager, sources, unknown, assigned, offsets)
        state = state or initial_unknowns(fit, data)
        if not jax.tree.leaves(state):
            raise InputError(f"calibration: fit one or more of {', '.join(FITTABLE)}, got nothing to fit.")
        _check_determined(standard_errors(state, data, lens_sd, NOISE), radius, spots, sources, assigned, imager)
        args = data, jnp.asarray(lens_sd, data.positions.dtype)
        state = optx.least_squares(weighted_residuals, solver, state, args, throw=False, max_steps=_MAX_STEPS).value
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state)):
            fits = capture_fits(assigned, spots, sources, imager.sensor.pixel_pitch)
            _check_captures([fit._replace(fits=False) for fit in fits])
        current, points = apply_to_imager(state, imager), np.asarray(source_points(state, data), np.float64)
    assert state is not None and assigned is not None and data is not None
    check_fitted_sample(current)
    off = np.asarray(residuals(state, data), np.float64)[: len(assigned.lenses)]
    fits = capture_fits(assigned, spots, sources, imager.sensor.pixel_pitch, off)
    _check_captures(fits)
    over_width = off / sources.blurs[assigned.sources, None]
    errors = standard_errors(state, data, lens_sd, estimate_noise(over_width, state, assigned.lenses))
    check_determined(errors, radius)
    for name, error in jackknife_errors(state, data, lens_sd).items():
        errors[name] = max(errors[name], error)
    sources = sources._replace(points=points)
    return Calibration(current, False, named_values(state), errors, sources, assigned, off, fits)


def _check_captures(fits: Sequence[CaptureFit]) -> None:
    if not all(fit.fits for fit in fits):
        raise MisfitError(fits, describe_misfit(fits, None, tried=False))


def _check_determined(errors, radius: float, spots: SpotLists, sources: Sources, assigned: Spots, imager: Imager):
    """`check_determined`, after captures whose spots would have been needed."""
    try:
        check_determined(errors, radius)
    except InputError:
        _check_captures(capture_fits(assigned, spots, sources, imager.sensor.pixel_pitch))
        raise


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
    offsets, spots = trace_core_offsets(imager, points[:, 2]), [find_spots_mm(image, imager) for image in images]
    assigned = assign_spots(spots, sources, imager, offsets, match_radius(imager.array.centers))
    data = _observations(imager, sources, np.zeros_like(points, bool), assigned, offsets)
    return np.asarray(residuals(Unknowns(), data), np.float64)[: len(assigned.lenses)]


def _observations(imager: Imager, sources: Sources, unknown, spots: Spots, offsets: CoreOffsets) -> Observations:
    size = -(-max(len(spots.lenses), 1) // _MULTIPLE) * _MULTIPLE
    dtype = imager.sensor_distance.dtype
    of, lenses, positions = (np.pad(part, [(0, size - len(part)), *[(0, 0)] * (part.ndim - 1)]) for part in spots[:3])
    points, blur = sources.points.astype(dtype), np.asarray(sources.blurs, dtype)[of]
    valid, unknown = np.arange(size) < len(spots.lenses), np.argwhere(unknown)
    # JAX would compile programs to make arrays of these shapes.
    points, unknown, of, lenses = map(jax.device_put, (points, unknown, of, lenses))
    positions, valid, blur = map(jax.device_put, (positions.astype(dtype), valid, blur))
    return Observations(imager, points, unknown, of, lenses, positions, valid, blur, offsets)


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
    imager = with_surface(imager, fit)
    _check_image("capture", image, imager)
    depths = np.asarray(grid.depths, np.float64)
    with progress.step("Searching for the rotation"):
        spots = find_spots_mm(image, imager, _ROTATION_SOURCES)
        rotated = search_rotation(spots, imager, (depths.min(), depths.max())) if "rotation" in fit else imager
    points = find_points(image, rotated, grid, progress=progress)[:_MOST_POINTS, :3]
    if len(points) < _MIN_POINTS:
        needs = f"a sparse scene in focus with {_MIN_POINTS} or more points is needed"
        raise InputError(f"capture: {needs}, got {len(points)} on which the lenses agree.")
    spots = find_spots_mm(image, imager, len(points))
    sources = Sources(points, np.zeros(len(points), int))
    return refine([spots], rotated, sources, np.ones(points.shape, bool), fit, progress=progress)
