"""The imaging system as a linear operator, volume to image."""

import jax
import lineax as lx

from ..geometry import Imager
from ..voxels import Grid
from .forward_model import Optics, forward


def forward_operator(imager: Imager, grid: Grid, optics: Optics = None) -> lx.AbstractLinearOperator:
    """The forward model as a `lineax` operator; its transpose `.T` is the exact adjoint.

    Of pinholes the adjoint is `backproject`. Build it inside the jitted function that uses it: as an argument, each
    new operator would recompile.

    Parameters
    ----------
    imager, grid, optics
        As for `forward`.

    Returns
    -------
    lineax.AbstractLinearOperator
        From `grid.volume_shape` to `sensor.shape`, both of the imager's type. Matrix-free.
    """
    volume = jax.ShapeDtypeStruct(grid.volume_shape, imager.sensor_distance.dtype)
    return lx.FunctionLinearOperator(lambda volume: forward(volume, imager, grid, optics), volume)
