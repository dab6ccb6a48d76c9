"""The imaging system as a linear operator, volume to image."""

import equinox as eqx
import jax
import lineax as lx

from ..geometry import Grid, Imager
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


class Unmatched(eqx.Module):
    """An operator with another one in the place of its transpose: `A.mv` is `forward`'s, `A.T.mv` is `back`'s.

    Enough of an operator for Richardson-Lucy, which comes to its end in fewer steps if what goes back is sharper than
    the adjoint (Zeng and Gullberg, IEEE Trans. Med. Imaging 19, 548, 2000).
    """

    forward: lx.AbstractLinearOperator
    back: lx.AbstractLinearOperator

    @property
    def T(self) -> "Unmatched":
        return Unmatched(self.back, self.forward)

    def mv(self, vector):
        return self.forward.mv(vector)

    def in_structure(self):
        return self.forward.in_structure()

    def out_structure(self):
        return self.forward.out_structure()
