"""A self-check on a capture of any sparse scene: the geometry at which the lenses agree, without known sources."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from ..base.errors import InputError
from ..base.progress import Progress
from ..detection.locate import find_points
from ..geometry import Imager
from ..grid import Grid
from ..typing import Image
from .fit import Calibration, refine, spots_in
from .matching import near_of
from .sources import Sources

# What is fitted by default: a scene of unknown depth and place tells neither sensor distance nor shift.
FITTED = ("rotation", "tilt")
# Brightest points that are used, and fewest.
_POINTS, _FEWEST = 60, 5
# The rotation is searched for so far on either side of the design's, in such steps, radians, by so many bright spots.
_ROTATION, _ROTATION_STEP, _SPOTS = np.radians(5.0), np.radians(0.4), 5
# Lenses agree on a point within this on the sensor, over `near_of`; steps of the depth move its spots by less.
_NEAR = 0.5


def calibrate_by_scene(
    image: Image,
    imager: Imager,
    grid: Grid,
    *,
    fit: Sequence[str] = FITTED,
    progress: Progress | None = None,
) -> Calibration:
    """Finds rotation and tilt, from a design that is right to some degrees, in a capture of points that nobody knows.

    The rotation at which most spots of several lenses meet in points is searched for. `find_points` finds these, then
    their places and the geometry are fitted to the spots together (a bundle adjustment). Sensor distance, shift and
    scale are those of the design: any others show the same scene elsewhere.

    Parameters
    ----------
    image
        A capture of a sparse scene: points, beads, cells.
    imager
        The microscope as designed.
    grid
        Where the scene is: the box of these voxels.
    fit
        Of `rotation`, `tilt` and `lenses`.
    progress
        Shows how far it is.

    Raises
    ------
    InputError
        If the lenses agree on fewer than five points, or something else is to be fitted.
    """
    progress = progress or Progress()
    other = [name for name in fit if name not in (*FITTED, "lenses")]
    if other:
        raise InputError(f"--from-scene: found {', '.join(other)} to fit, allowed: rotation, tilt, lenses.")
    depths = np.asarray(grid.depths, np.float64)
    with progress.step("Looking for the rotation"):
        turned = _turned(spots_in(image, imager, _SPOTS), imager, (depths.min(), depths.max()))
    found = find_points(image, turned, grid, progress=progress)[:_POINTS, :3]
    if len(found) < _FEWEST:
        text = f"{len(found)} points that the lenses agree on"
        raise InputError(f"capture: found {text}, allowed: {_FEWEST} or more, of a sparse scene in focus.")
    spots = spots_in(image, imager, len(found))
    sources = Sources(found, np.zeros(len(found), int))
    return refine([spots], turned, sources, np.ones(found.shape, bool), fit, progress=progress)


def _turned(spots: Float64[np.ndarray, "spot 2"], imager: Imager, depths: tuple[float, float]) -> Imager:
    """At the rotation where most lines through spots and lenses meet."""
    near, far = (float(imager.magnification(depth)) for depth in depths)
    within = _NEAR * near_of(imager.array.centers)
    step = within / imager.field_radius
    magnifications = np.linspace(far, near, max(int(np.ceil((near - far) / step)) + 1, 2))
    turns = np.arange(-np.floor(_ROTATION / _ROTATION_STEP), np.floor(_ROTATION / _ROTATION_STEP) + 1) * _ROTATION_STEP
    met = [max(_meeting(spots, _by(imager, turn), m, within) for m in magnifications) for turn in turns]
    return _by(imager, float(turns[int(np.argmax(met))]))


def _by(imager: Imager, turn: float) -> Imager:
    return eqx.tree_at(lambda i: i.rotation, imager, imager.rotation + jnp.asarray(turn, imager.rotation.dtype))


def _meeting(spots, imager: Imager, magnification: float, within: float) -> float:
    """How clearly lines meet in a plane: the sum of squares of how many pass where most do."""
    centers = np.asarray(imager.centers, np.float64)
    points = ((1 + magnification) * centers - spots[:, None]) / magnification
    seen = np.linalg.norm(points - centers, axis=-1) < imager.field_radius
    points = points[seen]
    if not len(points):
        return 0.0
    count = KDTree(points).query_ball_point(points, within / magnification, return_length=True)
    # The mean of these counts would be the same for any pattern of as many lines; peaks are what differs.
    return float((np.asarray(count, float) ** 3).sum())
