"""A sheet in a capture: an image that is in focus everywhere and a depth map, with the volume they make."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from ..base.arrays import host_code
from ..base.errors import InputError, short_repr
from ..base.progress import Progress
from ..base.typing import Image, Volume
from ..microscope.geometry import Imager
from ..microscope.grid import Grid
from ..projection.forward_model import Optics
from ..solvers.base import estimate_of
from ..solvers.surface import RESTARTED_STEPS, State, Surface, depth_of_sheets, restarted
from .pipeline import Reconstructor, check_call

# Columns of less light, of the 99th percentile, have no depth.
_DARK = 0.03
# What one more sheet leaves unexplained, of what these leave, below which these are too few. Where they are enough it
# was 1.03 or more, as the one more takes fewer steps, 0.85 for two sheets and 0.56 for blobs.
_TOO_FEW = 0.95
# What a fit that starts from the last one may leave unexplained, of what the last one that started afresh left.
_CHANGED = 1.1


class SurfaceFit(NamedTuple):
    """Sheets of a capture, `(sheet, y, x)`.

    Parameters
    ----------
    brightness
        In focus everywhere; the light of a column, in the unit of the volume.
    depth, depth_sd
        Depth, and its standard deviation by the Hessian of the fit, mm; NaN where it is dark.
    volume
        The sheets on the planes of the grid, by linear shares of two planes.
    error, free_error, further_error
        RMS of what the sheets, the few steps of free voxels from which they start, and a fit with one more sheet do not
        explain of the capture, relative to its RMS; the last two, and `depth_sd`, are NaN in those frames of a
        recording that start from the one before.
    """

    brightness: Float32[np.ndarray, "sheet y x"]
    depth: Float32[np.ndarray, "sheet y x"]
    depth_sd: Float32[np.ndarray, "sheet y x"]
    volume: Volume
    error: float
    free_error: float
    further_error: float

    @property
    def warning(self) -> str | None:
        """What to say if one more sheet explains more, or free voxels do; None if not."""
        if not (self.error > self.free_error or self.further_error < _TOO_FEW * self.error):
            return None
        count = len(self.depth)
        some = "a sheet leaves" if count == 1 else f"{count} sheets leave"
        return (
            f"{some} {self.error:.0%} of the capture unexplained, {count + 1} sheets {self.further_error:.0%}, free "
            f"voxels {self.free_error:.0%}: depths may be wrong; try {count + 1} sheets, or another method"
        )


@host_code()
def fit_surface(
    image: Image,
    imager: Imager,
    grid: Grid,
    method: Surface = Surface(),
    *,
    optics: Optics | str = "full",
    progress: Progress | None = None,
) -> SurfaceFit:
    """Fit sheets to an image: a brightness and a depth for each column of the grid.

    *Host.*

    Fits one more sheet, too, to see whether these are enough.

    Parameters
    ----------
    image, imager, grid, optics, progress
        As for `reconstruct`; the depths ascend.
    method
        Number of sheets one behind the other, and smoothness.

    Raises
    ------
    InputError
        As for `reconstruct`.

    Examples
    --------
    >>> fit = gs.fit_surface(image, scope, grid, optics="near")
    >>> fit.depth.shape, fit.brightness.shape
    ((1, 41, 41), (1, 41, 41))
    """
    if not isinstance(method, Surface):
        raise InputError(f"method must be a Surface(), got {short_repr(method)}.")
    check_call(image, imager, method, optics)
    progress = progress or Progress()
    return fit_sheets(Reconstructor(imager, grid, method, optics, progress=progress), image, progress)[0]


# State of a fit, and what the last one that started afresh did not explain.
LastFit = tuple[State, float]


def fit_sheets(reconstructor: Reconstructor, image: Image, progress: Progress) -> tuple[SurfaceFit, LastFit]:
    """Fit the sheets of `reconstructor.method`, and one more; return what the next image may start from."""
    method: Any = reconstructor.method
    state = reconstructor.run(reconstructor.init(image), progress)
    fit = _maps(reconstructor, state.solver)
    further = reconstructor.by(dataclasses.replace(method, steps=RESTARTED_STEPS, sheets=method.sheets + 1))
    start = state._replace(solver=restarted(state.solver, method.sheets + 1, cold_start=True))
    one_more = float(further.run(start, progress).solver.errors[1])
    return fit._replace(further_error=one_more), (state.solver, fit.error)


def follow_sheets(
    reconstructor: Reconstructor, image: Image, last: LastFit | None, progress: Progress
) -> tuple[SurfaceFit, LastFit]:
    """`fit_sheets` from the last fit on, in a third of the steps and without one more sheet.

    It starts afresh if the scene has changed so much that it explains less than the last one that started afresh did.
    """
    if last is not None:
        method: Any = reconstructor.method
        short = reconstructor.by(dataclasses.replace(method, steps=RESTARTED_STEPS))
        start = restarted(last[0], method.sheets, cold_start=False)
        state = short.run(short.init(image, start), progress)
        fit = _maps(short, state.solver)
        if fit.error < _CHANGED * last[1]:
            unknown = dict.fromkeys(("free_error", "further_error"), float("nan"))
            return fit._replace(depth_sd=np.full_like(fit.depth_sd, np.nan), **unknown), (state.solver, last[1])
    return fit_sheets(reconstructor, image, progress)


def _maps(reconstructor: Reconstructor, state: State) -> SurfaceFit:
    depths = np.asarray(reconstructor.problem.grid.depths, np.float64)
    step = float(np.abs(np.gradient(depths)).mean()) if depths.size > 1 else 0.0
    planes, sd = (np.asarray(part, np.float64) for part in depth_of_sheets(state))
    brightness = np.asarray(state.sheets.root, np.float32) ** 2
    dark = ~(brightness > _DARK * np.percentile(brightness, 99))
    free, error = (float(part) for part in state.errors)
    places = (np.interp(planes, np.arange(depths.size), depths), step * sd)
    depth, depth_sd = (np.where(dark, np.nan, part).astype(np.float32) for part in places)
    volume = np.asarray(estimate_of(Surface(), state), np.float32)
    return SurfaceFit(brightness, depth, depth_sd, volume, error, free, error)
