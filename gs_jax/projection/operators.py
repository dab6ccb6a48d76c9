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

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> A = gs.forward_operator(scope, grid)
    >>> A.in_structure().shape, A.out_structure().shape
    ((3, 41, 41), (200, 200))
    """
    volume = jax.ShapeDtypeStruct(grid.volume_shape, imager.sensor_distance.dtype)
    return lx.FunctionLinearOperator(lambda volume: forward(volume, imager, grid, optics), volume)
