"""Optics of lenses that differ: what is computed for one lens unit, for each type of lens, and how much a kind counts.

Images are linear in the lenses: the image by all is the sum of the images by each type, whose lenses are alike.

Whether a microscope is in focus: the part of a spot's light that falls into its core. Host code."""

import math
import warnings
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Float64

from ..base.errors import InputWarning
from ..geometry import Imager
from ..grid import Grid
from ..lenses import lenses_by_type
from .field_varying import FieldVaryingPsf
from .psf_core import clear_area, ensquared_light

# Points of the field at which a lens's light is computed.
_LIGHT_FIELDS = 17


class PerTypePsf(eqx.Module):
    """Optics of each type of lens; `gs_jax.optics_of` makes it.

    `lenses`: which are of the type. `optics`: its PSF at each depth, with the sum of the light that it has over that of
    the mean lens; or all of its light.
    """

    lenses: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    optics: tuple[Float[Array, "_ _ _"] | FieldVaryingPsf, ...]  # each of its own size


def split_by_type(imager: Imager, lenses: Sequence[Sequence[int]]) -> list[Imager]:
    """The imager with the lenses of each type alone; the others still end these where their surfaces meet."""
    return [eqx.tree_at(lambda i: i.array, imager, imager.array.subset(which)) for which in lenses]


def relative_areas(imagers: Sequence[Imager]) -> Float64[np.ndarray, " kind"]:
    """Mean clear area of each type's lenses over that of all lenses: the light that a kind has near its axis."""
    areas = [np.asarray(clear_area(one.array), np.float64) for one in imagers]
    return np.array([area.mean() for area in areas]) / np.concatenate(areas).mean()


def type_weights(
    imagers: Sequence[Imager], depths: Float64[np.ndarray, " depth"], side: float
) -> Float64[np.ndarray, "kind depth"]:
    """How much each kind counts in a sum over the lenses, at each depth; 1 on average over the lenses.

    A point of brightness a gives the pixel that lens j reads for its voxel `y_j = s_j a + noise`. Of all sums `w_j y_j`
    that with the weights `w_j = s_j / var_j` has the largest signal over noise (matched filter, Gauss and Markov). The
    noise is the camera's and that of the light of all voxels, which is about the same under every lens, so a lens
    counts by `s_j`: the share of the point's light that it brings into a square about its core, by exact rays over its
    field. Lenses that are alike count equally.

    Parameters
    ----------
    imagers
        `split_by_type`.
    depths
        From the array's front, mm.
    side
        Of the square on the sensor that a voxel is read from, mm.
    """
    fields = np.linspace(0, imagers[0].field_radius, _LIGHT_FIELDS)
    # Lenses are spread evenly: there are as many more at a field as its circle is longer.
    signal = np.stack([ensquared_light(one, depths, fields, side) @ fields for one in imagers])
    count = np.array([len(one.array.centers) for one in imagers], np.float64)
    mean = count @ signal / count.sum()
    return np.divide(signal, mean, out=np.ones_like(signal), where=mean > 0)


# Least part of a spot's light, of lenses within the field radius, that must fall into its core. The paper's microscope
# has 21 to 51 % in focus, over 18 to 22 mm, and 1 % with its sensor at 4 mm; its first lenses on pixels three times as
# wide have 6 % there, and show one of three points.
MIN_SHARPNESS = 0.08
# Half the side, in pixels, of the square in which the light of a core is summed, and fields at which it is.
HALF_SIDE, FIELDS = 3, 17


def core_width(imager: Imager) -> float:
    """Side of the square in which the light of a core is summed, mm."""
    return (2 * HALF_SIDE + 1) * imager.sensor.pixel_pitch


def sharpness(imager: Imager, grid: Grid) -> float:
    """The part of a spot's light that falls into its core, of lenses within the field radius.

    The least over the depths of a grid, by exact rays. Points are found by their cores: below `MIN_SHARPNESS` what is
    found are caustics, and no points.
    """
    depths = np.unique([float(grid.depths.min()), float(grid.depths.max())])
    fields = np.linspace(0, imager.field_radius, FIELDS)
    each = [imager] if imager.array.alike else split_by_type(imager, lenses_by_type(imager.array))
    in_square = lambda one, side: ensquared_light(one, depths, fields, side) @ fields
    # At each depth the type of lenses that is the sharpest.
    core = core_width(imager)
    return float(np.max([in_square(one, core) / in_square(one, math.inf) for one in each], 0).min())


def blur_warning(share: float, what: str, then: str) -> str | None:
    """A warning that something needs sharper spots than this `sharpness`, and what that means; None if not."""
    if share >= MIN_SHARPNESS:
        return None
    found = f"{share:.1%} of a spot's light falls into its core"
    return f"out of focus at these depths: {found}, where {what} need {MIN_SHARPNESS:.0%}; {then}"


def warn_if_blurred(imager: Imager, grid: Grid, what: str, then: str) -> None:
    """`InputWarning` where spots are not sharp enough for something."""
    if blurred := blur_warning(sharpness(imager, grid), what, then):
        warnings.warn(blurred, InputWarning, stacklevel=3)
