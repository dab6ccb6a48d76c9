"""Whether a microscope is in focus: the part of a spot's light that falls into its core. Host code."""

import math
import warnings

import numpy as np

from ..base.errors import InputWarning
from ..geometry import Imager
from ..grid import Grid
from .cores import core_shares
from .kinds import lenses_by_kind, of_kinds

# Least part of a spot's light, of lenses within the field radius, that must fall into its core. The paper's microscope
# has 21 to 51 % in focus, over 18 to 22 mm, and 1 % with its sensor at 4 mm; its first lenses on pixels three times as
# wide have 6 % there, and show one of three points.
LEAST_SHARP = 0.08
# Half the side, in pixels, of the square in which the light of a core is summed, and fields at which it is.
HALF_SIDE, FIELDS = 3, 17


def core_side(imager: Imager) -> float:
    """Side of the square in which the light of a core is summed, mm."""
    return (2 * HALF_SIDE + 1) * imager.sensor.pixel_pitch


def sharpness(imager: Imager, grid: Grid) -> float:
    """The part of a spot's light that falls into its core, of lenses within the field radius.

    The least over the depths of a grid, by exact rays. Points are found by their cores: below `LEAST_SHARP` what is
    found are caustics, and no points.
    """
    depths = np.unique([float(grid.depths.min()), float(grid.depths.max())])
    fields = np.linspace(0, imager.field_radius, FIELDS)
    each = [imager] if imager.array.alike else of_kinds(imager, lenses_by_kind(imager))
    in_square = lambda one, side: core_shares(one, depths, fields, side) @ fields
    # At each depth the kind of lenses that is the sharpest.
    core = core_side(imager)
    return float(np.max([in_square(one, core) / in_square(one, math.inf) for one in each], 0).min())


def blur_of(share: float, what: str, then: str) -> str | None:
    """A warning that something needs sharper spots than this `sharpness`, and what that means; None if not."""
    if share >= LEAST_SHARP:
        return None
    found = f"{share:.1%} of a spot's light falls into its core"
    return f"out of focus at these depths: {found}, where {what} need {LEAST_SHARP:.0%}; {then}"


def warn_if_blurred(imager: Imager, grid: Grid, what: str, then: str) -> None:
    """`InputWarning` where spots are not sharp enough for something."""
    if blurred := blur_of(sharpness(imager, grid), what, then):
        warnings.warn(blurred, InputWarning, stacklevel=3)
