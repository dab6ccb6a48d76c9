"""A sheet in a capture: an image that is in focus everywhere and a depth map, with the volume they make."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from ..base.errors import InputError, short_repr
from ..base.progress import Progress
from ..geometry import Imager
from ..grid import Grid
from ..projection.forward_model import PsfModel
from ..solvers.surface import Surface, depth_of_sheets
from ..typing import Image, Volume
from .pipeline import check_call, reconstructor

# Columns of less light, of the 99th percentile, have no depth.
_DARK = 0.03


class SurfaceFit(NamedTuple):
    """Sheets of a capture, `(layer, y, x)`.

    Parameters
    ----------
    brightness
        In focus everywhere; the light of a column, in the unit of the volume.
    depth, depth_sd
        Depth, and its standard deviation by the Hessian of the fit, mm; NaN where it is dark.
    volume
        The sheets on the planes of the grid, by linear shares of two planes.
    error, free_error
        RMS of what the sheets, and the few steps of free voxels from which they start, do not explain of the capture,
        relative to its RMS.
    """

    brightness: Float32[np.ndarray, "layer y x"]
    depth: Float32[np.ndarray, "layer y x"]
    depth_sd: Float32[np.ndarray, "layer y x"]
    volume: Volume
    error: float
    free_error: float

    @property
    def warning(self) -> str | None:
        """What to say if sheets explain less than free voxels do; None if not."""
        if not self.error > self.free_error:
            return None
        some, more = ("a sheet leaves", "2") if len(self.depth) == 1 else (f"{len(self.depth)} sheets leave", "more")
        return (
            f"{some} {self.error:.0%} of the capture unexplained, free voxels {self.free_error:.0%}: "
            f"the scene may be no sheet; try {more} sheets, or another method"
        )


def fit_surface(
    image: Image,
    imager: Imager,
    grid: Grid,
    method: Surface = Surface(),
    *,
    optics: PsfModel | str = "full",
    progress: Progress | None = None,
) -> SurfaceFit:
    """Fit sheets to an image: a brightness and a depth for each column of the grid.

    *Host.*

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
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> import numpy as np
    >>> point = np.array([[0.2, -0.1, 20.0, 1.0]])  # x, y, z in mm, and its light
    >>> image = gs.simulate(point, scope, optics="near", psf="geometric")
    >>> fit = gs.fit_surface(image, scope, grid, optics="near")
    >>> fit.depth.shape, fit.brightness.shape
    ((1, 41, 41), (1, 41, 41))
    """
    if not isinstance(method, Surface):
        raise InputError(f"method must be a Surface(), got {short_repr(method)}.")
    check_call(image, imager, grid, method, optics)
    progress = progress or Progress()
    return surface_fitter(imager, grid, method, optics=optics, progress=progress)(image, progress)


def surface_fitter(
    imager: Imager, grid: Grid, method: Surface, *, optics: PsfModel | str, progress: Progress
) -> Callable[[Image, Progress], SurfaceFit]:
    """Prepare `fit_surface` for many images; parameters and errors as there."""
    depths = np.asarray(grid.depths, np.float64)
    step = float(np.abs(np.gradient(depths)).mean()) if depths.size > 1 else 0.0

    def read(solver, state):
        planes, sd = (np.asarray(part, np.float64) for part in depth_of_sheets(state))
        brightness = np.asarray(state.sheets.root, np.float32) ** 2
        dark = ~(brightness > _DARK * np.percentile(brightness, 99))
        free, error = (float(part) for part in state.errors)
        places = (np.interp(planes, np.arange(depths.size), depths), step * sd)
        depth, depth_sd = (np.where(dark, np.nan, part).astype(np.float32) for part in places)
        return SurfaceFit(brightness, depth, depth_sd, np.asarray(solver.estimate(state), np.float32), error, free)

    return reconstructor(imager, grid, method, optics=optics, progress=progress, read=read)
