"""Optics of lenses that differ: what is computed for one lens unit, for each kind of lens, and how much a kind counts.

Images are linear in the lenses: the image by all is the sum of the images by each kind, whose lenses are alike.
"""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Float64

from ..geometry import Imager
from ..lenses import kinds
from .cores import core_shares
from .full import FullOptics
from .light import clear_area

# Points of the field at which a lens's light is computed.
_FIELDS = 17


class KindOptics(eqx.Module):
    """Optics of each kind of lens; `gs_jax.optics_of` makes it.

    `lenses`: which are of the kind. `optics`: its PSF at each depth, with the sum of the light that it has over that of
    the mean lens; or all of its light.
    """

    lenses: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    optics: tuple[Float[Array, "_ _ _"] | FullOptics, ...]  # each of its own size


def lenses_by_kind(imager: Imager) -> tuple[tuple[int, ...], ...]:
    """Which lenses of an imager are of each kind. Host code."""
    return tuple(tuple(which.tolist()) for which in kinds(imager.array))


def of_kinds(imager: Imager, lenses: Sequence[Sequence[int]]) -> list[Imager]:
    """The imager with the lenses of each kind alone; the others still end these where their surfaces meet."""
    return [eqx.tree_at(lambda i: i.array, imager, imager.array.some(np.array(which))) for which in lenses]


def relative_areas(imagers: Sequence[Imager]) -> Float64[np.ndarray, " kind"]:
    """Mean clear area of each kind's lenses over that of all lenses: the light that a kind has near its axis."""
    areas = [np.asarray(clear_area(one.array), np.float64) for one in imagers]
    return np.array([area.mean() for area in areas]) / np.concatenate(areas).mean()


def kind_weights(
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
        `of_kinds`.
    depths
        From the array's front, mm.
    side
        Of the square on the sensor that a voxel is read from, mm.
    """
    fields = np.linspace(0, imagers[0].field_radius, _FIELDS)
    # Lenses are spread evenly: there are as many more at a field as its circle is longer.
    signal = np.stack([core_shares(one, depths, fields, side) @ fields for one in imagers])
    count = np.array([len(one.array.centers) for one in imagers], np.float64)
    mean = count @ signal / count.sum()
    return np.divide(signal, mean, out=np.ones_like(signal), where=mean > 0)
