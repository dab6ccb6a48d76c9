"""How far points can be trusted: what their lenses say."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Float64, Int, Shaped

from ..geometry import Imager
from ..grid import Grid
from ..optics.lens_types import core_width
from ..optics.psf_core import apparent_depths
from .consistency import Signal, agreed_level, log_false_alarms, signal, survival
from .locate import LIT, SHARE, count_of, searched_voxels
from .type_views import lens_types_of, readings_of

# Depths at which it is asked which types of lenses can see points.
_DEPTHS = 9
# What a file holds in the place of the logarithm of 0.
_LEAST_LOG = -999.0


class Evidence(NamedTuple):
    """What speaks for points, one entry for each.

    Parameters
    ----------
    lit, lenses
        How many lenses see it above the noise, and how many there are that could.
    log10_false_alarms
        How many points as good as it chance would show in such a capture, on average, as a logarithm.
    signal_to_noise
        The light that 7 in 10 of its lenses read, over the noise there.
    """

    lit: Int[np.ndarray, " point"]
    lenses: Int[np.ndarray, " point"]
    log10_false_alarms: Float64[np.ndarray, " point"]
    signal_to_noise: Float64[np.ndarray, " point"]


def point_evidence(
    points: Float[np.ndarray, "point 4"],
    image: Shaped[Array | np.ndarray, "row column"] | Signal,
    imager: Imager,
    grid: Grid,
) -> Evidence:
    """What speaks for the points that `find_points` found in an image, with the same arguments and errors."""
    light, places = image if isinstance(image, Signal) else signal(image), np.array(points[:, :3], np.float64)
    # Cores lie, and are looked for, where chief rays of other depths land.
    ends = np.array([grid.depths.min(), grid.depths.max()], np.float64)
    depths = np.concatenate([ends, points[:, 2]])
    lens_types = lens_types_of(imager, np.linspace(depths.min(), depths.max(), _DEPTHS), core_width(imager))
    apparent = np.asarray(apparent_depths(imager, depths), np.float64) if len(lens_types) == 1 else depths
    places[:, 2] = apparent[2:]
    seen = readings_of(places, light, lens_types)
    lenses, noise = seen.seen.sum(1), seen.noise.max(1, initial=0)
    level = agreed_level(seen.light, seen.seen, SHARE)
    tests = count_of(searched_voxels(imager, grid.at(apparent[:2])))
    log = log_false_alarms(level, lenses, SHARE, survival(light.light), tests) / math.log(10)
    lit = (seen.seen & (seen.light > LIT * seen.noise)).sum(1)
    signal_to_noise = np.divide(level, noise, out=np.zeros_like(level), where=noise > 0)
    return Evidence(lit, lenses, np.clip(log, _LEAST_LOG, -_LEAST_LOG), signal_to_noise)
