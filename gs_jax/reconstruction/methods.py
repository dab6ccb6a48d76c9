"""Every way from an image to a volume, as an object that holds its options, and by name."""

from collections.abc import Callable

import equinox as eqx

from ..base.errors import InputError
from ..solvers.admm import ADMM
from ..solvers.fista import FISTA
from ..solvers.iteration import Solver, check_options
from ..solvers.richardson_lucy import RichardsonLucy


class BackProjection(eqx.Module):
    """`backproject`, the paper's reconstruction: one step, no PSF.

    Parameters
    ----------
    interpolation
        Between pixels, `"linear"` or `"nearest"` (the paper's).
    normalize
        Divide by the summed weights, so that a uniform image gives a uniform volume.

    Raises
    ------
    InputError
        If there is no such interpolation.
    """

    interpolation: str = eqx.field(static=True, default="linear")
    normalize: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if self.interpolation not in ("linear", "nearest"):
            raise InputError(f"interpolation: found {self.interpolation!r}, allowed: linear, nearest.")


class ListRichardsonLucy(eqx.Module):
    """Richardson-Lucy on the pixel-voxel lists of back-projection: no PSF, and as local.

    Each voxel is multiplied by the mean ratio, weighted by the envelope, over the pixels that back-projection would
    read: it is `RichardsonLucy` with the ray operator, whose `A'(ratio) / A'1` is
    `backproject(ratio, ..., normalize=True)`. Parameters and errors as there.
    """

    steps: int = eqx.field(static=True, default=20)
    tolerance: float = eqx.field(static=True, default=0.0)
    accelerate: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check_options(self)

    @property
    def solver(self) -> RichardsonLucy:
        return RichardsonLucy(self.steps, self.tolerance, accelerate=self.accelerate)


Method = BackProjection | ListRichardsonLucy | Solver

# By the name that the command line and the benchmark know it by: from the number of steps to the method.
METHODS: dict[str, Callable[[int], Method]] = {
    "backproject": lambda steps: BackProjection(),
    "list-rl": ListRichardsonLucy,
    "richardson-lucy": RichardsonLucy,
    "fista": FISTA,
    "admm": ADMM,
}
