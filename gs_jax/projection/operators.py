"""The imaging system as a linear operator, volume to image."""

import equinox as eqx
import jax
import lineax as lx

from ..geometry import Grid, Imager
from .backprojection import backproject_adjoint


def ray_operator(imager: Imager, grid: Grid, *, method: str = "linear") -> lx.AbstractLinearOperator:
    """The ray-optics forward model; its transpose `.T` is `backproject`, exactly.

    Build it inside the jitted function that uses it: as an argument, each new operator would recompile.

    Parameters
    ----------
    imager, grid, method
        As for `backproject`.

    Returns
    -------
    lineax.AbstractLinearOperator
        From `grid.volume_shape` to `sensor.shape`, both of the imager's type. Matrix-free.
    """
    volume = jax.ShapeDtypeStruct(grid.volume_shape, imager.sensor_distance.dtype)
    return lx.FunctionLinearOperator(eqx.Partial(backproject_adjoint, imager=imager, grid=grid, method=method), volume)
