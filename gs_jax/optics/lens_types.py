"""Arrays of several lens types: the optics of each type, its weight in sums over the lenses, and the sharpness.

Images are linear in the lenses: the image is the sum of the images by each type, whose lenses are identical. The lenses
of a tilted array differ in their distance from the sensor: they are divided into bands of height, which are as types.
"""

import math
import warnings
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Float, Float64, Int

from ..base.caches import cache_by_value
from ..base.errors import InputWarning
from ..geometry import Imager
from ..grid import Grid
from .apertures import clear_area
from .psf_core import ensquared_light
from .raytrace import to_numpy

# Smallest fraction of a spot's light in its core for finding points. The paper's microscope has 21 to 51 % in focus,
# over 18 to 22 mm, and 1 % with its sensor at 4 mm; its first lenses on pixels three times as wide have 6 % there, and
# show one of three points.
MIN_SHARPNESS = 0.08
# Bands of height of a tilted array: within one the blur changes by so many pixels; so many at most, as each costs as
# much as an array without tilt.
_BLUR, _BANDS = 2.0, 5
# Half the side of the square that collects a core's light, in pixels, and fields at which that is computed.
HALF_SIDE, FIELDS = 3, 17
# A coordinate that no object has, mm.
_FAR = 1e6


def height_bands(imager: Imager) -> Int[np.ndarray, " lens"]:
    """The number of each lens's band of height, 0 unless the array is so tilted that its lenses differ in blur."""
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


def interleave(centers: Float[np.ndarray, "lens 2"], types: int) -> Int[np.ndarray, " lens"]:
    """Assign a lens type, 0 to `types - 1`, to each lens, in about equal numbers, so that neighbours differ.

    Column after column, each lens gets the type that is rarest among its six nearest neighbours so far, and of those
    the rarest on the plate.
    """
    assigned = np.full(len(centers), -1)
    if types == 1 or len(centers) == 1:
        return assigned + 1
    # Imaging needs no layouts, and importing SciPy takes as long as a back-projection.
    from scipy.spatial import KDTree

    distance, near = (np.asarray(part)[:, 1:] for part in KDTree(centers).query(centers, k=min(7, len(centers))))
    columns = np.round(centers[:, 0] / distance[:, 0].mean())
    for lens in np.lexsort((centers[:, 1], columns)):
        others = np.bincount(assigned[near[lens]][assigned[near[lens]] >= 0], minlength=types)
        rare = np.bincount(assigned[assigned >= 0], minlength=types)
        assigned[lens] = np.lexsort((rare, others))[0]
    return assigned


def relative_areas(imagers: Sequence[Imager]) -> Float64[np.ndarray, " type"]:
    """Mean clear area of each type over that of all lenses: its relative light near the axis."""
    areas = [np.asarray(clear_area(one.array), np.float64) for one in imagers]
    return np.array([area.mean() for area in areas]) / np.concatenate(areas).mean()


def type_weights(
    imagers: Sequence[Imager], depths: Float64[np.ndarray, " depth"], side: float, bands: ArrayLike | None = None
) -> Float64[np.ndarray, "type depth"]:
    """Weights of the types in a sum over the lenses, at each depth; their mean over the lenses of each band is 1.

    Matched filter: a point of brightness a gives the pixel that lens j reads for its voxel `y_j = s_j a + noise`, and
    of all sums `w_j y_j` that with `w_j = s_j / var_j` has the largest signal over noise. The variance (camera, and
    light of all voxels) is about the same under every lens, so the weight is `s_j`: the fraction of the point's light
    in a square of `side` (mm, on the sensor) about the core, by exact rays over the field. `imagers` are
    `split_by_type`'s. Lenses of other bands of height see other points, and are not compared.
    """
    fields = np.linspace(0, imagers[0].field_radius, FIELDS)
    # Lenses are spread evenly: their number at a field is proportional to the circle's length.
    signal = np.stack([ensquared_light(one, depths, fields, side) @ fields for one in imagers])
    count = np.array([len(one.array.centers) for one in imagers], np.float64)
    same = np.equal.outer(*2 * (np.zeros(len(imagers)) if bands is None else np.asarray(bands),)) * count
    mean = same @ signal / same.sum(1, keepdims=True)
    return np.divide(signal, mean, out=np.ones_like(signal), where=mean > 0)


def core_width(imager: Imager) -> float:
    """Side of the square that collects a core's light, mm."""
    return (2 * HALF_SIDE + 1) * imager.sensor.pixel_pitch


# Captures of a microscope share it.
@cache_by_value(maxsize=8)
def sharpness(imager: Imager, grid: Grid) -> float:
    """Fraction of a spot's light in its core, for lenses within the field radius: the least over the grid's depths.

    By exact rays, for the sharpest type at each depth. Below `MIN_SHARPNESS` bright places are caustics, not points.
    """
    depths = np.asarray(grid.depths, np.float64)
    depths = np.unique([depths.min(), depths.max()])
    fields = np.linspace(0, imager.field_radius, FIELDS)
    each = split_groups(imager)[0]
    light = lambda one, side: ensquared_light(one, depths, fields, side) @ fields
    core = core_width(imager)
    return float(np.max([light(one, core) / light(one, math.inf) for one in each], 0).min())


def blur_warning(fraction: float, what: str, then: str) -> str | None:
    """Text for a `sharpness` below `MIN_SHARPNESS`: `what` needs more, else `then`; None if it is sharp enough."""
    if fraction >= MIN_SHARPNESS:
        return None
    found = f"{fraction:.1%} of a spot's light falls into its core"
    return f"out of focus at these depths: {found}, where {what} need {MIN_SHARPNESS:.0%}; {then}"


def warn_if_blurred(imager: Imager, grid: Grid, what: str, then: str) -> None:
    """Issue `blur_warning` as an `InputWarning`."""
    if text := blur_warning(sharpness(imager, grid), what, then):
        warnings.warn(text, InputWarning, stacklevel=3)
