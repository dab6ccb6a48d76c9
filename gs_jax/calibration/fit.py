"""The geometry of a microscope from captures of point sources whose places are known, at least in part."""

import dataclasses
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Float, Float64, Int

from ..base.arrays import check_finite
from ..base.errors import InputError
from ..base.progress import Progress
from ..geometry import Imager
from ..lenses import EACH
from ..typing import Image
from .matching import near_of
from .sources import Sources, Spots, assigned
from .spots import find_spots
from .start import begin, begin_without_lenses
from .uncertainty import check_known, deviations_of, noise_of, values_of
from .unknowns import (
    FITTABLE,
    FITTED,
    NOISE,
    Known,
    Offsets,
    Unknowns,
    applied,
    found_points,
    guessed,
    offsets_of,
    residuals,
    weighed,
)

# Spots looked for in a capture, for each of its sources.
_SPOTS = 60
# How near a spot must be to where it is due, over `near_of`: wide, then narrow.
_WITHIN = (1.0, 0.5, 0.25)
# Standard deviation that lenses may have from their places: of a printed array, mm, whatever its pitch, as printers
# have it; and of no list, over `near_of`.
_PRINTED, _ANYWHERE = 0.01, 17.0
# Captures that are looked at side by side, each with several times its memory.
_THREADS = 2
# Steps of the solver at most.
_MOST_STEPS = 300
# Spots in an array of them: a multiple, so that few shapes are compiled.
_MULTIPLE = 256


class Calibration(NamedTuple):
    """What was found.

    Parameters
    ----------
    imager
        The microscope; its array's centres are mirrored, y against -y, if `mirrored`, and moved if they were fitted.
    mirrored
        Whether the array is the other way round than in the design.
    values, deviations
        What was fitted, in the units of its names, and the standard deviations from the Gauss-Newton covariance. Of
        `lenses` only the deviation, the median of all, mm.
    sources
        The points with what was found of them, mm, and the capture of each.
    spots, residuals
        The spots, and how far each is from where it should be, `(x, y)`, pixels.
    """

    imager: Imager
    mirrored: bool
    values: dict[str, float]
    deviations: dict[str, float]
    sources: Sources
    spots: Spots
    residuals: Float64[np.ndarray, "spot 2"]

    @property
    def rms(self) -> float:
        """Of the distances, pixels."""
        return float(np.sqrt((self.residuals**2).sum(1).mean()))


def calibrate(
    images: Sequence[Image],
    points: Float[np.ndarray, "source 3"],
    imager: Imager,
    *,
    captures: Int[np.ndarray, " source"] | None = None,
    fit: Sequence[str] = FITTED,
    find_lenses: bool = False,
    progress: Progress | None = None,
) -> Calibration:
    """Finds a microscope's geometry in captures of point sources, from a design that is about right.

    *Host.*

    The spots of each capture are matched to the lenses at any rotation, mirrored or not, with a sensor distance within
    a quarter of the design's. Then what `fit` names is fitted by Levenberg-Marquardt to the spots within the field
    radius, with a robust loss. Where spots are is predicted by exact rays: what aberrations do is not fitted away.

    Parameters
    ----------
    images
        Captures, in pixels of any unit.
    points
        `(x, y, z)` of the sources, mm, in the sensor's frame; NaN is not known and is fitted, too.
    imager
        The microscope as designed.
    captures
        Which image each source is in, from 0; by default one a source, in their order.
    fit
        Of `sensor_distance`, `rotation`, `shift`, `tilt`, `scale` of the array, `depth_offset` of all sources, and
        `lenses`, each of which is within about 10 um of where it is listed.
    find_lenses
        Finds the lenses themselves, whatever the design lists, and of `fit` only the sensor's distance and the depths'
        offset: rotation, shift, scale and tilt are in the lenses' places. Needs known points.
    progress
        Shows how far it is.

    Raises
    ------
    InputError
        If points and captures do not fit together, a pixel is not finite, no pattern of lenses is seen, or the spots do
        not determine what is to be fitted.

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
    sources.check(len(images))
    sources.check_fit(fit)
    for number, image in enumerate(images, 1):
        check_finite(f"capture {number}", image)
    many = [int((sources.captures == number).sum()) for number in range(len(images))]
    # Filters of SciPy, which run beside each other.
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _THREADS)) as threads:
        spots = threads.map(spots_in, images, [imager] * len(images), many)
        found = [each for each, _ in zip(spots, progress.track(images, "Finding spots"), strict=True)]
    with progress.step("Matching lenses"):
        if find_lenses:
            start = begin_without_lenses(found, sources, imager, images)
        else:
            start = begin(found, sources, imager)
    if find_lenses:
        fit = [*(name for name in fit if name in ("sensor_distance", "depth_offset")), "lenses"]
    loose = _ANYWHERE * near_of(start.imager.array.centers) if find_lenses else _PRINTED
    result = refine(found, start.imager, start.sources, np.isnan(sources.points), fit, loose, progress)
    return _seen_alone(result) if find_lenses else result._replace(mirrored=start.mirrored)


def _seen_alone(found: Calibration) -> Calibration:
    """With the lenses that have spots."""
    seen, lenses = np.unique(found.spots.lenses, return_inverse=True)
    array = found.imager.array
    numbers = {name: value[seen] if (value := getattr(array, name)).ndim else value for name in EACH}
    array = dataclasses.replace(array, centers=array.centers[seen], **numbers)
    imager = eqx.tree_at(lambda i: i.array, found.imager, array)
    return found._replace(imager=imager, spots=found.spots._replace(lenses=lenses))


def refine(
    found: Sequence[Float64[np.ndarray, "_ 2"]],
    imager: Imager,
    sources: Sources,
    unknown: np.ndarray,
    fit: Sequence[str],
    loose: float = _PRINTED,
    progress: Progress | None = None,
) -> Calibration:
    """The fit, from a geometry and sources that put spots within a twentieth of the pitch of where they are.

    Parameters
    ----------
    found
        Spots of each capture, `(x, y)`, mm.
    imager, sources
        The start.
    unknown
        `(source, 3)`: which coordinates of the sources are fitted.
    fit, loose
        What else is, and how far lenses may be from their places (a standard deviation), mm.
    progress
        Shows how far it is.

    Raises
    ------
    InputError
        If the spots do not determine what is to be fitted.
    """
    fit = [name for name in FITTABLE if name in fit]
    done, near = None, near_of(imager.array.centers)
    for within in (progress or Progress()).track(_WITHIN, "Fitting"):
        done = _fitted(found, imager, sources, unknown, fit, loose, within * near, done)
    assert done is not None
    state, known, spots = done
    off = np.asarray(residuals(state, known), np.float64)[: len(spots.lenses)]
    deviations = deviations_of(state, known, loose, noise_of(off, state, spots))
    check_known(deviations, near)
    sources = sources._replace(points=np.asarray(found_points(state, known), np.float64))
    return Calibration(applied(state, imager), False, values_of(state), deviations, sources, spots, off)


class _Fitted(NamedTuple):
    """A round of the fit."""

    state: Unknowns
    known: Known
    spots: Spots


def _fitted(found, imager: Imager, sources: Sources, unknown, fit, loose, within, before: _Fitted | None) -> _Fitted:
    """With the spots that are near to where the round before puts them."""
    here, points = imager, sources.points
    if before:
        here, points = applied(before.state, imager), np.asarray(found_points(before.state, before.known), np.float64)
    offsets = offsets_of(here, points[:, 2])
    spots = assigned(found, sources._replace(points=points), here, offsets, within)
    known = _known(imager, sources.points, unknown, spots, offsets)
    start = before.state if before else guessed(fit, known)
    if not jax.tree.leaves(start):
        raise InputError(f"calibration: found nothing to fit, allowed: some of {', '.join(FITTABLE)}.")
    check_known(deviations_of(start, known, loose, NOISE), near_of(imager.array.centers))
    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    given = known, jnp.asarray(loose, known.places.dtype)
    state = optx.least_squares(weighed, solver, start, given, throw=False, max_steps=_MOST_STEPS).value
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state)):
        raise InputError("captures: found no geometry that explains the spots, allowed: spots of the given sources.")
    return _Fitted(state, known, spots)


def spots_in(image, imager: Imager, sources: int = 1) -> Float64[np.ndarray, "spot 2"]:
    """Places of the brightest spots on the sensor, mm."""
    return np.asarray(imager.sensor.to_mm(find_spots(image, _SPOTS * sources)), np.float64)


def residuals_of(
    found: Calibration, images: Sequence[Image], points: Float[np.ndarray, "image 3"]
) -> Float64[np.ndarray, "spot 2"]:
    """How far the spots of captures of other points are from where a calibration puts them, `(x, y)`, pixels."""
    imager, sources = found.imager, Sources(points, np.arange(len(points)))
    offsets = offsets_of(imager, points[:, 2])
    spots = assigned(
        [spots_in(image, imager) for image in images], sources, imager, offsets, near_of(imager.array.centers)
    )
    known = _known(imager, points, np.zeros_like(points, bool), spots, offsets)
    return np.asarray(residuals(Unknowns(), known), np.float64)[: len(spots.lenses)]


def _known(imager: Imager, points, unknown, spots: Spots, offsets: Offsets) -> Known:
    size = -(-max(len(spots.lenses), 1) // _MULTIPLE) * _MULTIPLE
    dtype = imager.sensor_distance.dtype
    padded = lambda part: jnp.asarray(np.pad(part, [(0, size - len(part)), *[(0, 0)] * (part.ndim - 1)]))
    are = jnp.arange(size) < len(spots.lenses)
    indices = jnp.asarray(np.argwhere(unknown))
    places = padded(spots.places).astype(dtype)
    return Known(
        imager, jnp.asarray(points, dtype), indices, padded(spots.sources), padded(spots.lenses), places, are, offsets
    )
