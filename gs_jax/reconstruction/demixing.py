"""Demixing: the light of regions in each capture, by least squares of their own images through the model. Host code.

No volume is needed: a capture is explained by one image for each region, its light not negative, and by a background
that is smooth over the sensor, of any sign. Pixels are weighted by their variance.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Float64, Int
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from ..base.errors import InputError
from ..base.progress import Progress
from ..base.typing import Image
from ..microscope.geometry import Imager, check_beyond
from ..optics.apertures import split_groups
from ..projection.point_sources import full_imager_of_points

# Numbers in the images of all regions, of which only the brightest pixels are kept where the sensor has more.
_MOST = 2**25
# Cosine modes of the background along each axis of the sensor.
_MODES = 3
# Least eigenvalue of the correlation of the images: below it regions cannot be told apart.
_LEAST = 1e-5
_TINY = 1e-30

Emitters = Float[np.ndarray, "emitter 4"]


class RegionImages(NamedTuple):
    """Images of regions, each of the light 1, in the `pixels` of a sensor that are used: their flat indices."""

    numbers: Int[np.ndarray, " region"]
    shape: tuple[int, int]
    pixels: Int[np.ndarray, " pixel"]
    images: Float32[np.ndarray, "region pixel"]


class Demixing(NamedTuple):
    """What the demixing of all captures of a recording shares.

    `columns` are the images of regions and the modes of the background, and `weights` one over the variance of each
    pixel; `gram` is the normal matrix, and `factor` the Cholesky factor of its Schur complement, which has the regions
    without the background. The light of a region is a weighted sum of pixels, as long as no light is held at 0:
    `squares` are these weights, squared.
    """

    shape: tuple[int, int]
    pixels: Int[np.ndarray, " pixel"]
    columns: Float32[np.ndarray, "column pixel"]
    weights: Float32[np.ndarray, " pixel"]
    gram: Float64[np.ndarray, "column column"]
    factor: Float64[np.ndarray, "region region"]
    squares: Float32[np.ndarray, "region pixel"]


class Demixed(NamedTuple):
    """Light of each region in a capture, all that it emits, in counts, and its standard error."""

    light: Float64[np.ndarray, " region"]
    error: Float64[np.ndarray, " region"]


def image_regions(
    regions: Sequence[Emitters],
    imager: Imager,
    *,
    numbers: Int[np.ndarray, " region"] | None = None,
    progress: Progress | None = None,
) -> RegionImages:
    """Image each region through the full model.

    Parameters
    ----------
    regions
        Emitters `(x, y, z, intensity)` of each, mm; a point is a region of one.
    imager
        The microscope, with the pixels of the captures.
    numbers
        Of the regions, for messages. None: from 1.
    progress
        Shows how many are imaged.

    Raises
    ------
    InputError
        If a depth is before the object's medium, or a region casts no light on the sensor.
    """
    progress, everything = progress or Progress(), np.concatenate(regions)
    check_beyond(imager, everything[:, 2], "regions: depths")
    image_of = _imager_of(everything, imager, progress)
    total = image_of(everything) if len(regions) > 1 else None
    count = min(total.size if total is not None else _MOST, _MOST // len(regions))
    pixels = np.arange(np.prod(imager.sensor.shape))
    if total is not None and count < total.size:
        pixels = np.sort(np.argpartition(-total.ravel(), count)[:count])
    images = np.empty((len(regions), len(pixels)), np.float32)
    numbers = np.arange(1, len(regions) + 1) if numbers is None else numbers
    for row, region in enumerate(progress.track(regions, "Imaging regions")):
        images[row] = image_of(region).ravel()[pixels]
        if not images[row].max() > _TINY:
            raise InputError(f"region {numbers[row]} must cast light on the sensor, got none.")
    return RegionImages(numbers, imager.sensor.shape, pixels, images)


def _imager_of(points: Emitters, imager: Imager, progress: Progress) -> Callable[[Emitters], np.ndarray]:
    """The function that images some of these points; always with a dark one that is as far from the axis as any.

    So the stray light of all has nodes of one shape, and one program.
    """
    far = float(np.abs(points[:, :2]).max())
    dark = np.array([[far, far, points[0, 2], 0.0]])
    every = np.concatenate([points, dark])
    imagers = [full_imager_of_points(every, group, progress) for group in split_groups(imager)[0]]

    def image_of(some: Emitters) -> np.ndarray:
        return np.sum([image(np.concatenate([some, dark])) for image in imagers], 0)

    return image_of


def prepare_demixing(regions: RegionImages, captures: Iterable[Image]) -> Demixing:
    """Weight the pixels by their variance in the mean of some captures, and factorise the normal equations.

    The variance is taken as a constant and a multiple of the light, fitted to what a fit with equal weights leaves.

    Raises `InputError` if regions cast images that cannot be told apart, or captures have another shape.
    """
    columns = np.concatenate([regions.images, _modes(regions)])
    parts = [_values(capture, regions) for capture in captures]
    mean = np.asarray(np.mean(parts, axis=0, dtype=np.float64))
    _check_distinct(regions)
    equal = _normal_equations(regions, columns, np.ones(len(mean), np.float32))
    explained, background = _explain(equal, np.asarray(mean, np.float32))
    left, light = mean - explained - background, np.maximum(explained, 0)
    (constant, share), _ = nnls(np.column_stack([np.ones(len(left)), light]), left**2)
    variance = constant + share * light
    variance = np.maximum(variance, max(1e-6 * float(variance.max()), _TINY))
    weights = (variance.mean() / variance).astype(np.float32)
    return _normal_equations(regions, columns, weights)


def _values(capture: Image, used: "RegionImages | Demixing") -> Float32[np.ndarray, " pixel"]:
    """The pixels of a capture that are used."""
    if capture.shape != used.shape:
        raise InputError(f"capture must have the sensor's shape {used.shape}, got {capture.shape}.")
    return np.asarray(capture, np.float32).ravel()[used.pixels]


def _modes(regions: RegionImages) -> Float32[np.ndarray, "mode pixel"]:
    places = np.unravel_index(regions.pixels, regions.shape)
    waves = [
        np.cos(np.pi * np.arange(_MODES)[:, None] * (at + 0.5) / n) for at, n in zip(places, regions.shape, strict=True)
    ]
    return (waves[0][:, None] * waves[1][None]).reshape(_MODES**2, -1).astype(np.float32)


def _check_distinct(regions: RegionImages, least: float = _LEAST) -> None:
    normed = regions.images / np.linalg.norm(regions.images, axis=1, keepdims=True)
    alike = (normed @ normed.T).astype(np.float64)
    if np.linalg.eigvalsh(alike)[0] < least:
        pair = np.unravel_index(np.argmax(alike - 2 * np.eye(len(alike))), alike.shape)
        first, second = sorted(regions.numbers[list(pair)])
        raise InputError(f"regions must cast different images, got {first} and {second} alike: leave one out.")


def _normal_equations(regions: RegionImages, columns, weights) -> Demixing:
    count, gram = len(regions.images), np.empty((len(columns), len(columns)))
    for number, column in enumerate(columns):
        gram[number] = columns @ (weights * column)
    own, modes = gram[:count, :count], gram[count:, count:]
    across = gram[:count, count:]
    try:
        schur = own - across @ np.linalg.solve(modes, across.T)
        factor = np.linalg.cholesky((schur + schur.T) / 2)
        sums = np.linalg.inv(gram)[:count].astype(np.float32) @ columns
    except np.linalg.LinAlgError:
        # Alike beside the background, or in the few pixels that have weight.
        if count > 1:
            _check_distinct(regions, math.inf)
        raise InputError(
            f"region {regions.numbers[0]} must cast an image unlike the background, which is smooth."
        ) from None
    sums *= weights
    return Demixing(regions.shape, regions.pixels, columns, weights, gram, factor, np.square(sums, out=sums))


def _explain(system: Demixing, values: Float32[np.ndarray, " pixel"]):
    """The light of the regions in a capture, and its background, both in the pixels that are used."""
    count = len(system.factor)
    solution = _solve(system, values)
    return solution[:count] @ system.columns[:count], solution[count:] @ system.columns[count:]


def _solve(system: Demixing, values: Float32[np.ndarray, " pixel"]) -> Float32[np.ndarray, " column"]:
    count = len(system.factor)
    right = (system.columns @ (system.weights * values)).astype(np.float64)
    across, modes = system.gram[:count, count:], system.gram[count:, count:]
    alone = right[:count] - across @ np.linalg.solve(modes, right[count:])
    light = nnls(system.factor.T, solve_triangular(system.factor, alone, lower=True))[0]
    background = np.linalg.solve(modes, right[count:] - across.T @ light)
    return np.concatenate([light, background]).astype(np.float32)


def demix(capture: Image, system: Demixing) -> Demixed:
    """Return the light of each region in a capture; `InputError` if it has another shape.

    The standard error is that of least squares without bounds, from what is left in each pixel, whatever its variance
    (White, Econometrica 48, 817, 1980), as if pixels were independent. It has the noise and, in part, what the model
    lacks. An error of a region's place or image that is the same in all captures changes the scale of its trace, which
    the standard error does not tell.
    """
    values = _values(capture, system)
    solution = _solve(system, values)
    left = values - solution @ system.columns
    variance = system.squares @ left**2 * (len(values) / max(len(values) - len(solution), 1))
    return Demixed(solution[: len(system.factor)].astype(np.float64), np.sqrt(variance.astype(np.float64)))
