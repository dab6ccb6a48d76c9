"""Arrays of several lens types: the groups of lenses that image alike.

Images are linear in the lenses: the image is the sum of the images by each type, whose lenses are identical. The lenses
of a tilted array differ in their distance from the sensor: they are divided into bands of height, which are as types.
"""

import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float64, Int

from ..geometry import Imager
from .apertures import clear_area
from .raytrace import to_numpy

# Bands of height of a tilted array: within one the blur changes by so many pixels; so many at most, as each costs as
# much as an array without tilt.
_BLUR, _BANDS = 2.0, 5


def height_bands(imager: Imager) -> Int[np.ndarray, " lens"]:
    """Number the lenses by bands of height: all 0 unless the array is so tilted that its lenses differ in blur."""
    heights = np.asarray(to_numpy(imager).heights)
    low, spread = heights.min(), np.ptp(heights)
    blur = spread * float(np.max(imager.array.aperture_diameter)) / float(imager.reduced_sensor_distance)
    count = min(max(math.ceil(blur / (_BLUR * imager.sensor.pixel_pitch)), 1), _BANDS)
    return np.minimum((heights - low) / (spread / count or 1), count - 1).astype(int)


def lens_groups(imager: Imager) -> tuple[tuple[int, ...], ...]:
    """Indices of lenses that image alike: those of a type, and of a band of height if the array is tilted."""
    types, bands = np.asarray(imager.array.type_of_lens), height_bands(imager)
    numbers = np.unique(bands * (types.max() + 1) + types, return_inverse=True)[1]
    return tuple(tuple(np.flatnonzero(numbers == number).tolist()) for number in range(numbers.max() + 1))


def split_by_type(imager: Imager, lenses: Sequence[Sequence[int]]) -> list[Imager]:
    """The imager with the lenses of each type alone, whose apertures the other lenses still bound."""
    return [eqx.tree_at(lambda i: i.array, imager, imager.array.subset(which)) for which in lenses]


def split_groups(imager: Imager) -> tuple[list[Imager], tuple[tuple[int, ...], ...]]:
    """The imager with the lenses of each group alone, and the `lens_groups`; itself where all lenses are alike."""
    groups = lens_groups(imager)
    return [imager] if len(groups) == 1 else split_by_type(imager, groups), groups


def relative_areas(imagers: Sequence[Imager]) -> Float64[np.ndarray, " type"]:
    """Mean clear area of each type over that of all lenses: its relative light near the axis."""
    areas = [np.asarray(clear_area(one.array), np.float64) for one in imagers]
    return np.array([area.mean() for area in areas]) / np.concatenate(areas).mean()
